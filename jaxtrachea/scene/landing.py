"""Where and how a tool first touches: between two rows of its path.

The row of first touch stands in the tube already. The tool came there in a straight line from the
last row that is finite, and the gap fell in proportion: so place, pose and material point of the
first touch lie between those of the two rows, by the share of the step that went on in contact. The
place is off by the square of the step, as the gap along a step is.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import product, product_of_rows, total
from jaxtrachea.contact.patches import Touch
from jaxtrachea.contact.pose import Pose, inverse, nearest_rotation, transform
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.curve import frame_at
from jaxtrachea.scene.stage import Poses, Scene, at_row

#: Least 1 + cos of the angle between the normals at the first touch and at the row in contact.
LEAST = 0.5


class Landing(NamedTuple):
    """The tool as it first touches.

    Attributes:
        s: contact position, mm.
        phi: contact angle, rad.
        point: of the tube at rest, mm; shape (3,).
        body: the tool's material point that touches, in the tool's frame, mm; shape (3,).
        rotation: of the tool; shape (3, 3).
        translation: of its origin, mm; shape (3,).
        frame: tangent, anterior and lateral direction at s as columns; None: the tube is straight.
        way: of the material point since then, as displacements of presses; shape (rows, 3).
    """

    s: Float[Array, ""]
    phi: Float[Array, ""]
    point: Float[Array, "3"]
    body: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    frame: Float[Array, "3 3"] | None
    way: Float[Array, "rows 3"]


def landing(scene: Scene, path: Poses, seen: Touch, first: Int[Array, ""]) -> Landing:
    """The first touch of a path, and the way of every row since then.

    Where the contact jumped in that step (from corner to corner of a tool that turned, say), the
    place lies between both: only a finer path tells which touched first.

    Args:
        scene: with a tube.
        seen: its contact with the tube at rest, row by row.
        first: the row of first touch; if it does not touch, the place is its own.
    """
    row = jnp.arange(seen.gap.shape[0])
    earlier = jnp.max(jnp.where((row < first) & ~jnp.isnan(seen.gap), row, -1))
    before = jnp.where(earlier < 0, first, earlier)

    def body_at(row):
        pose = Pose(at_row(path.rotation, row), at_row(path.translation, row))
        return transform(inverse(pose), at_row(seen.tool_point, row)[:, None])[:, 0]

    def points_of(body):
        return product_of_rows(path.rotation, body) + path.translation

    def inward_at(s, phi):
        frame = axes_at(scene, s)
        inward = local_frame(phi)[0]
        return inward if frame is None else product(frame, inward)

    def step_of(rows):
        return at_row(rows, before) - at_row(rows, first)

    body, gap = body_at(first), at_row(seen.gap, first)
    share = _share(gap, at_row(seen.gap, before))

    def mix(rows):
        return at_row(rows, first) + share * step_of(rows)

    s, phi = at_row(seen.s, first), at_row(seen.phi, first)
    inward, turn = inward_at(s, phi), step_of(seen.phi)
    s, phi = mix(seen.s), phi + share * jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    phi = jnp.arctan2(jnp.sin(phi), jnp.cos(phi))
    body = body + share * (body_at(before) - body)
    points = points_of(body)
    # In by the gap along its own normal, and along the wall: on a round one the chord between both
    # places is at right angles to the mean of their normals.
    mean = inward + inward_at(s, phi)
    step = -step_of(points)
    chord = step - total(step * mean) / jnp.maximum(total(inward * mean), LEAST) * inward
    moved = share * chord - gap * inward
    way, frame = points - at_row(points, first)[None] + moved[None], axes_at(scene, s)
    turned = nearest_rotation(mix(path.rotation), at_row(path.rotation, first))
    return Landing(
        s=s, phi=phi, point=mix(seen.point), body=body, rotation=turned,
        translation=at_row(points, first) - moved - product(turned, body), frame=frame,
        way=way if frame is None else product(way, frame),
    )  # fmt: skip


def _share(gap, earlier):
    """Share of the step that went on in contact; 0 where it did not begin outside or end inside."""
    closing = earlier - gap
    share = -gap / jnp.where(closing > 0, closing, 1)
    return jnp.where((closing > 0) & (share >= 0) & (share <= 1), share, 0)


def axes_at(scene: Scene, s) -> Float[Array, "3 3"] | None:
    """Tangent, anterior and lateral direction as columns; None where the tube is straight."""
    if scene.plan.curved and scene.tube is not None:
        return frame_at(scene.tube.line, s)
    return None
