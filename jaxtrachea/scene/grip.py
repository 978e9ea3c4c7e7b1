"""A step on a place that gives way by the rule of `scene.anchor`, or is glued."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.mechanics.oblique import press_at
from jaxtrachea.mechanics.press_history import Samples
from jaxtrachea.scene.anchor import (
    Anchor,
    Instant,
    anchor_at,
    follow,
    has_left,
    largest_slide,
    place_of,
    press_vector,
    re_anchor,
    yielded,
)
from jaxtrachea.scene.programs import Moved, moved_by, moved_in_time
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.trachea.material import Material


class Slip(NamedTuple):
    """The way a tool has slid along the tube and round it since it touched, mm.

    Attributes:
        held: on the place that it holds; shape (2,).
        before: on the places before; shape (2,).
        stored: elastic energy of the press, N mm.
        force: of the press, N; shape (3,).
        depth: its local indentation, mm; shape (3,).
    """

    held: Float[Array, "2"]
    before: Float[Array, "2"]
    stored: Float[Array, ""]
    force: Float[Array, "3"]
    depth: Float[Array, "3"]


class Grip(NamedTuple):
    """A place and its press in one step.

    Attributes:
        anchor: the place.
        after: what the next step begins with.
        touching: the tool is on it.
        way: of the press, see `anchor.press_vector`.
        solve: from presses, and samples of a force that relaxes, to what they do; None: the program
            of the plan.
        slip: None: no friction.
        total: slip since it touched, mm; (3,); likewise.
    """

    anchor: Anchor
    after: Anchor
    touching: Bool[Array, ""]
    way: Float[Array, "3"]
    solve: Callable[..., Moved] | None
    slip: Slip | None = None
    total: Float[Array, "3"] | None = None


def grip(
    scene: Scene, material: Material, state: Any, last: Instant, here: Instant, first: Anchor, hit
) -> Grip:
    """Press the place without friction."""
    depth = -here.seen.gap[0]
    if scene.plan.options.contact == "bonded":
        anchor = pick(state.touching, state.anchor, first)
        after, touching = anchor, hit | state.touching
        place, way = place_of(scene, material, anchor), press_vector(scene, anchor, here.path)
        way = jnp.where(touching, way, 0)
    else:
        held = state.touching & hit
        away = held & has_left(scene, state.anchor, last, here)
        followed = follow(scene, state.anchor, here, largest_slide(scene, depth))
        anchor = pick(held, followed, first)
        anchor, touching = pick(away, anchor_at(scene, here), anchor), hit
        place, way = place_of(scene, material, anchor), press_vector(scene, anchor, here.path)
        way = jnp.where(hit, yielded(scene, way, jnp.where(hit, depth, 1), place), way)
        anchor = after = re_anchor(scene, anchor, way, here.path)

    def solve(presses: Presses, samples: Samples | None = None) -> Moved:
        assert place is not None
        if samples is not None:
            return moved_in_time(place, presses, scene.plan, samples)
        return moved_by(press_at(place, presses.displacement, scene.plan.options), scene.plan)

    return Grip(anchor, after, touching, way, None if place is None else solve)


def pick(when, a, b):
    """One of two trees of arrays."""
    return jax.tree.map(lambda v, w: jnp.where(when, v, w), a, b)
