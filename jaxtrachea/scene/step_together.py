"""A step of several tools that feel each other: the next state of each, and what all of them do."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import full_precision
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.scene.anchor import Instant
from jaxtrachea.scene.approach import on_its_own
from jaxtrachea.scene.grip import pick
from jaxtrachea.scene.hold import hold
from jaxtrachea.scene.instruments import scene_of, touch_together
from jaxtrachea.scene.lumen import Side, next_side, whereabouts
from jaxtrachea.scene.simulation import Simulation, as_simulation
from jaxtrachea.scene.stage import Poses, Scene
from jaxtrachea.scene.together import Together, press_together
from jaxtrachea.status import PressStatus


class States(eqx.Module):
    """What the next step of several tools must know.

    Attributes:
        tools: a `step.State` of each, in the order of `Scene.instruments`.
        present: which of them were there; shape (m,).
        origin: the scene that they belong to (static).
    """

    tools: tuple[Any, ...]
    present: Bool[Array, " m"]
    origin: Any = eqx.field(static=True)


class _Held(NamedTuple):
    """A tool in this step: its next state and way; it is on its place; its pose is known."""

    state: Any
    made: Any
    touching: Bool[Array, ""]
    known: Bool[Array, ""]


@full_precision
def move_tools(
    scene: Scene,
    material: AnyMaterial,
    states: States,
    rotation: Float[Array, "m 3 3"],
    translation: Float[Array, "m 3"],
    present: Bool[Array, " m"],
) -> tuple[States, Simulation, tuple[Together]]:
    """As `step.move_tool`, of all instruments; a tool that is not present is lifted off the wall.

    A pose that is no number takes the numbers of this step from all, and leaves its own state.
    """
    paths = [Poses(R[None], T[None]) for R, T in zip(rotation, translation, strict=True)]
    views = [scene_of(scene, instrument) for instrument in scene.instruments]
    each = zip(views, states.tools, paths, touch_together(scene, paths), present, strict=True)
    held = [
        _hold(view, material, state, path, seen, there) for view, state, path, seen, there in each
    ]
    there = present
    if scene.plan.options.contact == "bonded":
        there = there & jnp.stack([one.touching for one in held])
    made = [one.made for one in held]
    found, moved = press_together(scene, long_run(material), paths, made, there[None])
    result = jax.tree.map(lambda v: v[0], as_simulation(found))
    known = jnp.stack([one.known for one in held])
    wrong = jnp.asarray(PressStatus.NON_FINITE, result.status.dtype)
    result = result._replace(status=jnp.where(jnp.all(known), result.status, wrong))
    after = (pick(h.known, h.state, old) for h, old in zip(held, states.tools, strict=True))
    return States(tuple(after), present, states.origin), result, (moved,)


def _hold(view: Scene, material: AnyMaterial, state: Any, path: Poses, seen, present) -> _Held:
    """One tool on its place; one that is not present counts as clear of the wall."""
    off = eqx.tree_at(lambda v: v.gap, seen, jnp.where(present, seen.gap, 1 + jnp.abs(seen.gap)))
    here = Instant(path, off)
    at = jax.tree.map(lambda v: v[0], whereabouts(view, *here))
    side = next_side(state.side, at)
    inside = (side == Side.IN_LUMEN)[None]
    if view.plan.contact_point == "per_step":
        after = eqx.tree_at(lambda v: v.side, state, side)
        made = on_its_own(view, path, off)._replace(own=seen, inside=inside)
        return _Held(after, made, (off.gap[0] < 0) & ~inside[0], at.known)
    after, _, made, held = hold(view, long_run(material), state, here, inside)
    after = eqx.tree_at(lambda v: v.side, after, side)
    return _Held(after, made._replace(own=seen), held.touching, at.known)
