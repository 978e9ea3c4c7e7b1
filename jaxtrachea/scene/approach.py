"""From the tool's positions to presses at contact points: where it touches, and how far it goes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.contact.patches import Touch
from jaxtrachea.contact.pose import Pose, inverse, transform
from jaxtrachea.scene.curve import frame_at
from jaxtrachea.scene.stage import Poses, Presses, Scene, touch_tube
from jaxtrachea.skeleton import local_frame


class Approach(NamedTuple):
    """A path of the tool as presses.

    Attributes:
        seen: contact of every row with the tube at rest.
        presses: displacements along (tangent, anterior, lateral) at the contact.
        inward: normal of the straight tube at the contact; shape (rows, 3).
        first: row of first touch, where the tool stays; None: every row is a press of its own.
        frame: those directions as columns in the frame of the mesh; None: straight tube, identity.
    """

    seen: Touch
    presses: Presses
    inward: Float[Array, "rows 3"]
    first: Int[Array, ""] | None
    frame: Float[Array, "rows 3 3"] | None


def approach(scene: Scene, path: Poses) -> Approach:
    """Let the tool touch the tube at rest, and say what it does to the place it touches."""
    seen = touch_tube(scene, path)
    inward = jax.vmap(lambda phi: local_frame(phi)[0])(seen.phi)
    frame = None
    if scene.plan.curved and scene.tube is not None:
        line = scene.tube.line
        frame = jax.vmap(lambda s: frame_at(line, s))(seen.s)
    if scene.plan.seat == "each":
        presses = Presses(seen.s, seen.phi, -seen.gap[:, None] * inward)
        return Approach(seen, presses, inward, None, frame)
    rows = seen.gap.shape[0]
    touching = seen.gap < 0
    first = jnp.where(jnp.any(touching), jnp.argmax(touching), jnp.argmin(seen.gap))
    D = _followed(path, seen, first, _at(inward, first), None if frame is None else frame[first])
    if scene.plan.options.contact == "bonded":
        D = jnp.where((jnp.arange(rows) >= first)[:, None], D, 0)
    spread = lambda v: jnp.broadcast_to(_at(v, first), v.shape)  # noqa: E731
    presses = Presses(spread(seen.s), spread(seen.phi), D)
    return Approach(seen, presses, spread(inward), first, None if frame is None else spread(frame))


def _followed(path: Poses, seen: Touch, first, inward, frame):
    """Displacement of the tool's material point that touches first, from its first touch on.

    Before the row of first touch the tool came in a straight line: the part of that step which it
    still went along the surface counts, so that a finer path changes nothing.
    """
    before = jnp.maximum(first - 1, 0)
    pose = Pose(_at(path.rotation, first), _at(path.translation, first))
    body = transform(inverse(pose), _at(seen.tool_point, first)[:, None])[:, 0]
    points = jax.vmap(lambda R, T: R @ body + T)(path.rotation, path.translation)
    way = points - _at(points, first)[None]
    if frame is not None:
        way = way @ frame
    gap = _at(seen.gap, first)
    closing = _at(seen.gap, before) - gap
    left = jnp.where(closing > 0, -gap / jnp.where(closing > 0, closing, 1), 0)
    step = -_at(way, before)
    step = step - jnp.dot(step, inward) * inward
    return way + (left * step - gap * inward)[None]


def backed_out(path: Poses, made: Approach) -> Poses:
    """Where the tool stands when it just touches, before it presses."""
    inward = made.inward
    if made.frame is not None:
        inward = jnp.einsum("rij,rj->ri", made.frame, inward)
    gap, rotation, translation = made.seen.gap, path.rotation, path.translation
    if made.first is not None:
        first = lambda v: jnp.broadcast_to(_at(v, made.first), v.shape)  # noqa: E731
        gap, rotation, translation = first(gap), first(rotation), first(translation)
    return Poses(rotation, translation + gap[:, None] * inward)


def _at(v, row):
    return jax.lax.dynamic_index_in_dim(v, row, keepdims=False)
