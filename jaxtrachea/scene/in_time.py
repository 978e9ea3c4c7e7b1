"""Rows of a scene as samples of a force that relaxes, and what came before them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.mechanics.contacts_in_time import each_at_rest
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial
from jaxtrachea.mechanics.press_history import History, Samples, at_rest
from jaxtrachea.mechanics.press_in_time import validated
from jaxtrachea.mechanics.samples import in_order
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.scene.refusals import REFUSALS
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.status import PressStatus


class Before(NamedTuple):
    """What came before the rows of a force that relaxes.

    Attributes:
        history: what is remembered.
        time: of every row, s; of a single step None.
        dt: how long a single step takes, s; of a path None.
    """

    history: History
    time: Float[Array, " rows"] | None = None
    dt: Float[Array, ""] | None = None


def before_path(scene: Scene, material: AnyMaterial, path: Poses | Presses) -> Before | None:
    """Rest, of a force that relaxes; else None.

    Raises:
        ValueError: a path without times.
    """
    if (rest := resting(scene, material)) is None:
        return None
    if path.time is None:
        raise ValueError("path.time is None; expected a time for every row: the plan relaxes")
    tools = len(scene.instruments)
    return Before(each_at_rest(rest, tools) if tools else rest, path.time)


def resting(scene: Scene, material: AnyMaterial) -> History | None:
    """The history of nothing, of one tool; None: the force does not relax."""
    plan = scene.plan
    if not isinstance(material, RelaxingMaterial) or not plan.has("relaxation"):
        return None
    vector = plan.second_plane or not plan.mechanics.hangs_on_rings
    return at_rest(material.relaxation, plan.options, vector and not scene.instruments)


def samples_of(
    relaxation: Relaxation, before: Before, displacement: Float[Array, "rows ..."], refused
) -> tuple[Samples, Bool[Array, " rows"]]:
    """Rows as samples of a force that relaxes, and which of them go back in time.

    Args:
        displacement: of the tool, or of all of them, mm.
        refused: rows by status.
    """
    rows, dtype = displacement.shape[0], displacement.dtype
    if before.time is not None:
        time, order = in_order(before.time, jnp.sum(displacement.reshape(rows, -1), axis=1))
        back = order == PressStatus.BACK_IN_TIME
        dt = jnp.diff(time, prepend=time[:1]).astype(dtype)
    else:
        assert before.dt is not None
        dt, back = before.dt[None], jnp.zeros(1, bool)
    relaxation, why = validated(relaxation, jnp.asarray(PressStatus.OK, jnp.int8))
    status = jnp.broadcast_to(why, (rows,))
    for code in REFUSALS:
        if code in refused:
            status = jnp.where(refused[code], code, status).astype(jnp.int8)
    skipped = back | refused[PressStatus.NON_FINITE]
    return Samples(before.history, relaxation, dt, status, skipped), back
