"""The force of a session that is safe to send to a device: always finite, and said how old it is."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.status import PressStatus


class HeldForce(NamedTuple):
    """The contact force of the last step that had one.

    Attributes:
        force: on the tube, N, in the frame of the poses; shape (3,). Always finite: zeros before
            the first step that had a force. What the tool feels is its opposite.
        status: of the last step, which says why a force is held.
        held: steps since the one that the force is of; 0: it is of the last step.
    """

    force: Float[np.ndarray, "3"]
    status: PressStatus
    held: int


def no_force(dtype) -> HeldForce:
    """Before the first step: zeros."""
    return HeldForce(np.zeros(3, dtype), PressStatus.NO_CONTACT, 0)


def next_force(before: HeldForce, step: Simulation) -> HeldForce:
    """After one more step: its force, or where that is no number the force of before.

    Args:
        before: after the step before.
        step: result of a step, without the axis of rows.
    """
    status = PressStatus(int(step.status))
    force = np.asarray(step.force if step.frame is None else step.frame @ step.force)
    if math.isfinite(sum(force.tolist())):
        return HeldForce(force, status, 0)
    return HeldForce(before.force, status, before.held + 1)
