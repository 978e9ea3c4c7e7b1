"""On which side of the wall a tool is, as far as its way tells; and where the tube ends."""

import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxtrachea._numerics import product
from jaxtrachea.contact.line import Centreline, point_at
from jaxtrachea.contact.patches import Touch
from jaxtrachea.scene.stage import Poses, Scene

#: A contact on the face that closes a patch at an end of the tube: distance from the end over the
#: radius, and least part of the normal along the tube (that of a wall with relief is below 0.4).
RIM, ALONG = 0.08, 0.8


class Side(enum.IntEnum):
    """Where a tool is, as far as its way tells."""

    UNTOLD = 0
    BEFORE_AN_END = 1
    IN_LUMEN = 2
    OUTSIDE = 3


class Whereabouts(NamedTuple):
    """What a pose tells of it; shape (rows,) each.

    Attributes:
        known: the pose and its contact are finite.
        off: the contact lies beyond an end, or on a face that closes it.
        clear: the tool does not touch.
        within: all of it, or of one of its parts, lies within the inner wall.
        centred: its middle, or that of one of its parts, lies within the middle of the wall.
    """

    known: Bool[Array, " rows"]
    off: Bool[Array, " rows"]
    clear: Bool[Array, " rows"]
    within: Bool[Array, " rows"]
    centred: Bool[Array, " rows"]


def whereabouts(scene: Scene, path: Poses, seen: Touch) -> Whereabouts:
    """Look at the place of the tool.

    Its corners' distance from the centreline, not the gap, says what is within: patches of a mesh
    are closed, and deep in one of them the nearest way out may be the one along the tube. The wall
    of an imported mesh has no thickness here.
    """
    if scene.tool is None or scene.tube is None:
        raise ValueError("scene.tool is None; contact needs a tool")
    gap = jax.lax.stop_gradient(seen.gap)
    wall = 2 * jnp.maximum(scene.radius - scene.geometry.radius, 0)
    room = scene.radius - wall - scene.tool.radius
    line = scene.tube.line if scene.plan.curved else None
    off_axis = jax.vmap(functools.partial(_off_axis, line))

    def look(vertices, room):
        corners = product(path.rotation, vertices) + path.translation[:, :, None]
        square = jax.vmap(off_axis, 2, 1)(corners)
        within = (jnp.max(square, axis=1) < room * room) & (room > 0)
        centred = off_axis(jnp.mean(corners, axis=2)) < (scene.radius - wall / 2) ** 2
        return jnp.sum(corners, axis=(1, 2)), within, centred

    if scene.tool.radius.ndim == 0:
        finite, within, centred = look(scene.tool.vertices, room)
    else:  # one part in the lumen is enough
        each = jax.vmap(look)(scene.tool.vertices, room)
        finite, within, centred = jnp.sum(each[0], 0), jnp.any(each[1], 0), jnp.any(each[2], 0)
    return Whereabouts(
        known=jnp.isfinite(finite + gap), off=off_the_end(scene, seen), clear=gap >= 0,
        within=within, centred=centred,
    )  # fmt: skip


def next_side(side: Int[Array, ""], at: Whereabouts) -> Int[Array, ""]:
    """The side after one more pose (fields of `at` without rows).

    A tool that does not touch the tube beside its ends is outside; one that touches stays on its
    side. A way that begins wholly within the inner wall begins in the lumen; a tool that comes
    over an end is in the lumen if its middle is.
    """
    begins = jnp.where(side == Side.UNTOLD, at.within, at.centred)
    inside = jnp.where(side <= Side.BEFORE_AN_END, begins, side == Side.IN_LUMEN)
    touching = jnp.where(inside, Side.IN_LUMEN, Side.OUTSIDE)
    beside = ~at.off | (at.within & ~at.clear)
    new = jnp.where(at.clear, Side.OUTSIDE, touching)
    return jnp.where(at.known, jnp.where(beside, new, Side.BEFORE_AN_END), side)


def _off_axis(line: Centreline | None, point):
    """Square of the distance from the centreline (by its nearest sample), mm^2."""
    if line is None:
        return jnp.sum(point[1:] ** 2)
    away = point[None] - line.points
    square = jnp.sum(away * away, axis=1)
    nearest = jnp.argmin(square)
    return square[nearest] - jnp.sum(away[nearest] * line.tangents[nearest]) ** 2


def off_the_end(scene: Scene, seen: Touch) -> Bool[Array, " rows"]:
    """Rows whose contact lies beyond an end of the tube, or on the face that closes it.

    Patches of a mesh are closed, the tube is not: at its ends there is no wall across.
    """
    s, length = seen.s, scene.geometry.length
    beyond = (s < 0) | (s > length)
    if scene.tube is None:
        return beyond
    if scene.plan.curved:
        line = scene.tube.line
        tangent = jax.vmap(lambda v: point_at(line, v)[1])(s)
        along = jnp.sum(seen.normal * tangent, axis=1)
    else:
        along = seen.normal[:, 0]
    rim = RIM * scene.radius
    return beyond | ((s < rim) & (along < -ALONG)) | ((s > length - rim) & (along > ALONG))


def in_lumen(scene: Scene, path: Poses, seen: Touch) -> Bool[Array, " rows"]:
    """Rows of a tool in the lumen, by its way so far (`next_side`)."""
    at = whereabouts(scene, path, seen)

    def step(side, at):
        side = next_side(side, at)
        return side, (side == Side.IN_LUMEN) & at.known

    return jax.lax.scan(step, jnp.asarray(Side.UNTOLD), at)[1]
