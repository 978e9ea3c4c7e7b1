"""A line in space by samples, and where a point stands on it: s along it, phi round it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import total

#: Newton steps to the nearest point of the centreline without, then with derivative.
STEPS, LAST_STEPS = 3, 2
#: Smallest slope of the projection, 1 - curvature x distance: the centre of the bend is not passed.
LEAST_SLOPE = 0.05


class Centreline(eqx.Module):
    """Samples of a smooth line, evenly spaced in arc length; two are enough for a straight one.

    Attributes:
        s: arc length of the samples, mm; shape (samples,).
        points: mm; shape (samples, 3).
        tangents: unit vectors along rising s.
        anterior: unit vectors across, where the angle phi is zero.
    """

    s: Float[Array, " samples"]
    points: Float[Array, "samples 3"]
    tangents: Float[Array, "samples 3"]
    anterior: Float[Array, "samples 3"]


def skeleton_coordinates(
    line: Centreline, point: Float[Array, "3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Position s (mm) of the nearest point of the centreline and angle phi round it (rad).

    The root of t(s) . (point - c(s)) by Newton steps, the last two of them differentiable: exact
    up to the third derivative. Valid nearer to the line than its radius of curvature. On the line
    itself phi is 0, with derivative 0.

    Args:
        point: mm; shape (3,).
    """

    def step(s, p, line):
        c, t, bend, _ = point_at(line, s)
        slope = total(t * t) - total(bend * (p - c))
        return s + total(t * (p - c)) / jnp.maximum(slope, LEAST_SLOPE)

    p, fixed = jax.lax.stop_gradient((point, line))
    s = fixed.s[jnp.argmin(total((fixed.points - p[None]) ** 2))]
    for _ in range(STEPS):
        s = step(s, p, fixed)
    for _ in range(LAST_STEPS):
        s = step(s, point, line)
    c, t, _, anterior = point_at(line, s)
    out, lateral = point - c, jnp.cross(t, anterior)
    y, z = total(out * anterior), total(out * lateral)
    on_line = (y == 0) & (z == 0)
    return s, jnp.arctan2(jnp.where(on_line, 0, z), jnp.where(on_line, 1, y))


def point_at(line: Centreline, s: Float[Array, ""]) -> tuple[Float[Array, "3"], ...]:
    """Point, first and second derivative (cubic by samples and tangents), anterior direction.

    The tangent is not quite of length 1 between the samples, nor is the anterior direction; beyond
    the ends the line goes on straight.

    Args:
        s: arc length, mm.
    """
    last = line.s.shape[0] - 1
    h = (line.s[-1] - line.s[0]) / last
    inside = jnp.clip(s, line.s[0], line.s[-1])
    place = jax.lax.stop_gradient((inside - line.s[0]) / h)
    i = jnp.clip(jnp.floor(place).astype(int), 0, last - 1)
    u, beyond = (inside - line.s[i]) / h, s - inside
    p0, p1, t0, t1 = line.points[i], line.points[i + 1], line.tangents[i], line.tangents[i + 1]
    rise = (p1 - p0) / h
    c = p0 + h * u * (t0 + u * (3 * rise - 2 * t0 - t1 + u * (t0 + t1 - 2 * rise)))
    t = t0 + u * (6 * rise - 4 * t0 - 2 * t1 + 3 * u * (t0 + t1 - 2 * rise))
    bend = (6 * rise - 4 * t0 - 2 * t1 + 6 * u * (t0 + t1 - 2 * rise)) / h
    across = line.anterior[i] + u * (line.anterior[i + 1] - line.anterior[i])
    return c + beyond * t, t, jnp.where(beyond == 0, bend, 0), across
