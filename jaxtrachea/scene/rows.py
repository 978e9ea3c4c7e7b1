"""The tools of one step, and what all of them share: a program for one serves all.

How a tool holds its place does not depend on its shape.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.contact.patches import Touch
from jaxtrachea.scene.anchor import Instant
from jaxtrachea.scene.instruments import views
from jaxtrachea.scene.lumen import Side, Whereabouts, next_side, whereabouts
from jaxtrachea.scene.stage import Poses, Scene


def without_part(seen: Touch) -> Touch:
    """A contact of any tool, of the fields that one of a single part has."""
    return eqx.tree_at(lambda v: v.part, seen, None, is_leaf=lambda v: v is None)


class Rows(NamedTuple):
    """A step of several tools, with an axis of tools.

    Attributes:
        state: before it.
        path: where they are, one row each.
        seen: their contacts; a tool that is not present counts as clear of the wall.
        at: outside or in the lumen.
        footprint: see `stage.Scene`.
    """

    state: Any
    path: Poses
    seen: Touch
    at: Whereabouts
    footprint: Float[Array, " m"]


def gather(
    scene: Scene, state: Any, paths: list[Poses], seen: list[Touch], present: Bool[Array, " m"]
) -> Rows:
    """Gather what each tool sees."""
    each = views(scene)
    off = [
        eqx.tree_at(lambda v: v.gap, without_part(v), jnp.where(there, v.gap, 1 + jnp.abs(v.gap)))
        for v, there in zip(seen, present, strict=True)
    ]
    at = [whereabouts(*one) for one in zip(each, paths, off, strict=True)]
    footprints = [view.footprint for view in each]
    rows = jax.tree.map(lambda *v: jnp.stack(v), *zip(paths, off, at, footprints, strict=True))
    path, contact, at, footprints = rows
    state = dataclasses.replace(state, touching=state.touching & present)
    return Rows(state, path, contact, jax.tree.map(lambda v: v[:, 0], at), footprints)


def enter(scene: Scene, row: Rows) -> tuple[Scene, Instant, Any, Bool[Array, "1"]]:
    """The scene as one tool sees it, where it is, its side of the wall, and if it is the lumen."""
    side = next_side(row.state.side, row.at)
    view = dataclasses.replace(scene, footprint=row.footprint)
    return view, Instant(row.path, row.seen), side, (side == Side.IN_LUMEN)[None]
