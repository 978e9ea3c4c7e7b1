"""The dent of a tool that slides: it goes with the slip, as deep as the tool reaches there.

The force keeps the place of first touch (`press_path`). The surface must not: on a relief, or round
the tube, the tool reaches less (or more) deep where it has slid to, and the skeleton has sunk by
another amount there. So the dent of first touch is laid where the tool is now, and scaled until the
surface touches the tool.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.contact.distance import signed_distance
from jaxtrachea.contact.pose import Pose, inverse, transform
from jaxtrachea.contact.search import FOR_POINTS
from jaxtrachea.contact.shapes import Shape, sphere
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.stage import Poses
from jaxtrachea.surface import local

#: Vertices nearest to the tool's place that may touch it, and the least share of the dent's peak
#: by which one of them must move to count (what hardly moves would scale the dent without end).
CANDIDATES, LEAST_SHARE = 64, 0.3
#: Newton steps for the scale; the distance along a straight way is convex.
STEPS = 3
#: Largest scale: the surface moves less and less as the dent does (`friction.toml` needs 1.3).
MAX_SCALE = 5.0


def slid(
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    radius: Float[Array, ""],
    slip: Float[Array, "3"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Place on the surface at rest that is under the tool after a slip.

    Args:
        s_c: contact position at first touch, mm.
        phi_c: contact angle there, rad.
        radius: of the surface there, mm.
        slip: way slid, mm.
    """
    _, along, around = local_frame(phi_c) @ slip
    return s_c + along, phi_c + around / radius


def lay_at(dent: local.Dent, way: Float[Array, ""], turn: Float[Array, ""]) -> local.Dent:
    """The dent shifted along the tube by `way` (mm) and round it by `turn` (rad)."""
    s, y, z = dent.centres.T
    c, n = jnp.cos(turn), jnp.sin(turn)
    return dataclasses.replace(dent, centres=jnp.stack([s + way, c * y - n * z, n * y + c * z], 1))


def scale_to_touch(
    tool: Shape,
    pose: Poses,
    near: Float[Array, " vertices"],
    sunk: Float[Array, "vertices 3"],
    dented: Float[Array, "vertices 3"],
) -> Float[Array, ""]:
    """By how much the dent (dented - sunk) is to be scaled until the surface touches the tool.

    By 0 at least and by `MAX_SCALE` at most, so that the surface is continuous where the dent goes
    to 0: a tool that lies further inside of the sunk surface than that stays in it.

    Args:
        pose: of the tool, one row.
        near: distance of every vertex from the tool's place on the surface at rest, mm.
        sunk: vertices moved with the skeleton, in the frame of the tool's pose, mm.
        dented: the same with the dent.
    """
    # A vertex that is no number is no candidate: `top_k` orders NaN by its sign, a maximum may
    # keep it or not.
    near = jnp.where(jnp.isfinite(near), near, jnp.inf)
    _, chosen = jax.lax.top_k(-near, min(CANDIDATES, near.shape[0]))
    start, way = sunk[chosen], (dented - sunk)[chosen]
    square = jnp.sum(way * way, axis=1)
    square = jnp.where(jnp.isfinite(square), square, 0)
    peak = jnp.max(square)
    counts = (square >= LEAST_SHARE**2 * peak) & (square > 0)
    back = inverse(Pose(pose.rotation, pose.translation))
    start, way = transform(back, start.T).T, way @ pose.rotation  # in the frame of the tool

    def root(scale, start, way):
        distance, normal = _distance(tool, start + scale * way)
        slope = normal @ way
        out = slope > 0
        return jnp.where(out, scale - distance / jnp.where(out, slope, 1), -jnp.inf)

    def newton(_, scale):
        needed = jax.vmap(root, (None, 0, 0))(scale, start, way)
        needed = jnp.max(jnp.where(counts, needed, -jnp.inf))
        return jnp.where(jnp.isfinite(needed), jnp.maximum(needed, 0), scale)

    return jnp.minimum(jax.lax.fori_loop(0, STEPS, newton, jnp.ones_like(peak)), MAX_SCALE)


def _distance(tool: Shape, point):
    """Signed distance of a point in the tool's frame, mm, and the outward normal there."""
    if tool.radius.ndim == 1:
        away, normal = jax.vmap(_distance, (0, None))(tool, point)
        nearest = jnp.argmin(away)
        return away[nearest], normal[nearest]
    if tool.vertices.shape[1] == 1:
        off = point - tool.vertices[:, 0]
        square = jnp.sum(off * off)
        away = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
        return away - tool.radius, off / jnp.where(square > 0, away, 1)
    dot = sphere(jnp.zeros_like(tool.radius))
    seen = signed_distance(tool, dot, Pose(jnp.eye(3, dtype=point.dtype), point), FOR_POINTS)
    return seen.distance, seen.normal
