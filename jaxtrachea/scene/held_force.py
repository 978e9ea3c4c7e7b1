"""The force of a session for a device: always finite, and it says how old it is."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.status import PressStatus


class HeldForce(NamedTuple):
    """The contact force of the last step that had one.

    Attributes:
        force: on the tube, N, in the frame of the poses; shape (3,), of several tools (tools, 3).
            Always finite: zeros before the first step that had a force. What the tool feels is its
            opposite.
        status: of the last step, which says why a force is held; before any NO_CONTACT. Of several
            tools one for each.
        held: steps since the one that the force is of; 0: it is of the last step.
    """

    force: Float[np.ndarray, "*tools 3"]
    status: PressStatus | tuple[PressStatus, ...]
    held: int


class LastForce(NamedTuple):
    """What each step leaves for `held_force`, as it is: a step has microseconds.

    Attributes:
        force: of the last step that had one, in the frame of its contact.
        frame: of that contact; None: that of the poses.
        status: of the last step.
        held: see `HeldForce`.
    """

    force: np.ndarray
    frame: np.ndarray | None
    status: int | np.ndarray
    held: int


def no_force(dtype, tools: int = 0) -> LastForce:
    """Before the first step: zeros; `tools`: how many there are, 0: one without a name."""
    if tools:
        status = np.full(tools, PressStatus.NO_CONTACT)
        return LastForce(np.zeros((tools, 3), dtype), None, status, 0)
    return LastForce(np.zeros(3, dtype), None, PressStatus.NO_CONTACT, 0)


def next_force(before: LastForce, step: Simulation) -> LastForce:
    """After one more step, whose result has numpy arrays and no axis of rows."""
    if math.isfinite(sum(step.force.ravel().tolist())):
        return LastForce(step.force, step.frame, step.status, 0)  # pyright: ignore
    return before._replace(status=step.status, held=before.held + 1)


def held_force(last: LastForce) -> HeldForce:
    """For a device."""
    force = last.force
    if last.frame is not None:
        force = np.einsum("...ij,...j->...i", last.frame, force)
    if force.ndim == 1:
        return HeldForce(np.array(force), PressStatus(int(last.status)), last.held)
    status = tuple(PressStatus(int(v)) for v in np.asarray(last.status))
    return HeldForce(np.array(force), status, last.held)
