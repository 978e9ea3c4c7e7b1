"""The frame of a bent tube's centreline: from the straight skeleton into space."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.contact.line import Centreline, point_at


def frame_at(line: Centreline, s: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Columns tangent, anterior, lateral of the centreline at s."""
    return _point_and_frame(line, s)[1]


def lay(line: Centreline, points: Float[Array, "points 3"]) -> Float[Array, "points 3"]:
    """Points of the straightened tube (s, y, z) where they are on the bent one, mm.

    Args:
        points: s along it, then along anterior and lateral, mm.
    """

    def one(point):
        centre, frame = _point_and_frame(line, point[0])
        return centre + frame[:, 1:] @ point[1:]

    return jax.vmap(one)(points)


def distance_from(
    line: Centreline, s: Float[Array, ""], point: Float[Array, "3"]
) -> Float[Array, ""]:
    """Distance of a point from the centreline at s, mm; the point is not on it."""
    away = point - point_at(line, s)[0]
    return jnp.sqrt(jnp.sum(away * away))


def _point_and_frame(line: Centreline, s):
    centre, tangent, _, anterior = point_at(line, s)
    x = tangent / jnp.sqrt(jnp.sum(tangent * tangent))
    y = anterior - jnp.sum(anterior * x) * x
    y = y / jnp.sqrt(jnp.sum(y * y))
    return centre, jnp.stack([x, y, jnp.cross(x, y)], axis=1)
