r"""Signed distance of two convex shapes, with witness points, normal, bounds and derivatives.

    phi(A, B) = -min over |d| = 1 of [h_A(d) + h_B(-d)]

with the smoothed support functions of `shapes`: positive apart, negative (minus the penetration
depth) in overlap, one formula for both. The minimiser d is the normal from A to B.

Bounds: with the sharp shapes' signed distance phi*, in exact arithmetic,

    phi <= lower <= phi* <= upper,    phi* - phi <= log(N_A N_B) / beta at the lowest minimum.

`lower` is the sharp support at the normal found and holds for every direction. `upper` is the
distance of two points of the sharp cores less the radii; it is tight only where these are apart.

Derivatives: the normal's by the implicit function theorem at the stopped solution, the distance's
by Danskin's theorem; no loop is differentiated. Forward and reverse, any order. Where the minimum
is flat (status FLAT) curvatures below 1e-6 of the size are lifted to that, to keep derivatives
finite.

Source: duality of distance and support functions, Gilbert, Johnson & Keerthi, "A fast procedure for
computing the distance between complex objects in three-dimensional space", IEEE J. Robot. Autom. 4
(1988), doi:10.1109/56.2083. Envelope theorem: Danskin, "The theory of max-min, with applications",
SIAM J. Appl. Math. 14 (1966), doi:10.1137/0114053.

Results are in the frame of A, lengths in mm (any one unit: the search is scale-free).
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon, largest, solve_2x2, total
from jaxtrachea.contact.pose import Pose, rotate
from jaxtrachea.contact.search import (
    FLOOR,
    STANDARD,
    Model,
    Pair,
    Settings,
    descend,
    eigenvalues,
    find_normal,
    floor_of,
    model,
    newton_step,
    polish,
    sharp_table,
    tangents,
)
from jaxtrachea.contact.shapes import Shape, Support, mean, sharp_support, support
from jaxtrachea.status import ContactStatus

#: Share of 1/beta by which a stopped search may miss its minimum and still count as converged.
TOLERANCE = 0.01
#: Roundings of coordinates up to which their difference counts as none.
ROUNDINGS = 4


class Contact(eqx.Module):
    """The pair's signed distance and what belongs to it, in the frame of A.

    Attributes:
        distance: smoothed signed distance phi, mm.
        normal: unit vector from A to B at the contact; shape (3,).
        point_a: point of A's smoothed boundary nearest to (deepest in) B, mm; shape (3,).
        point_b: the same of B. point_b - point_a = distance * normal, up to `residual`.
        lower: certified lower bound of the sharp signed distance, mm; not differentiable.
        upper: certified upper bound of it, mm; not differentiable.
        residual: gradient left over along the sphere, relative to the size of the pair.
        curvature: smaller eigenvalue of the Hessian on the sphere, relative to the same.
        status: a `ContactStatus` as int8; FLAT where other normals are as right, as far as those
            were found (`track` looks for none). Of flat faces against each other the normal is the
            only one, the points are not.
    """

    distance: Float[Array, ""]
    normal: Float[Array, "3"]
    point_a: Float[Array, "3"]
    point_b: Float[Array, "3"]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    residual: Float[Array, ""]
    curvature: Float[Array, ""]
    status: Int[Array, ""]


@functools.partial(jax.jit, static_argnames="settings", inline=True)
def signed_distance(
    a: Shape,
    b: Shape,
    pose: Pose,
    settings: Settings = STANDARD,
    *,
    beta: Float[Array, ""] | None = None,
) -> Contact:
    """Signed distance of two convex shapes, searched over all directions.

    Among several equal minima (a ball at the centre of a cube) the one furthest along
    `search.PREFERRED` in the frame of A is taken, of those found, and the status is FLAT. In
    overlap the lowest minimum can be missed; the distance is then that of another face, too small,
    and `lower` is still a bound (docs/evidence/contact.md has the rates).

    Args:
        a: shape A.
        b: shape B, of the same dtype.
        pose: from B's frame to A's.
        beta: sharpness, 1/mm, positive; default `settings.sharpness` over the size of the pair,
            without the derivative of that size.

    Returns:
        The `Contact`; differentiable in a, b, pose and beta.
    """
    scaled = _scaled(a, b, pose, settings, beta)
    pair = jax.lax.stop_gradient(scaled.pair)
    rows = sharp_table(pair.a, settings.directions)
    d, tied = find_normal(pair, rows, _towards(pair), settings)
    return _contact(a, b, scaled, d, tied)


def track(
    a: Shape,
    b: Shape,
    pose: Pose,
    direction: Float[Array, "3"],
    settings: Settings = STANDARD,
    *,
    beta: Float[Array, ""] | None = None,
) -> Contact:
    """Signed distance by a few steps from a known direction, without a search.

    For paths of small steps (turns of 0.01 rad; docs/evidence/contact.md has the rates): give the
    normal of the pose before. It stays in the basin it is in; a status other than OK asks for
    `signed_distance`.

    Args:
        a: shape A.
        b: shape B, of the same dtype.
        pose: from B's frame to A's.
        direction: not zero, need not be of length 1, taken without derivative; shape (3,).
        settings: `sharpness` and `warm_steps` are used.
        beta: as in `signed_distance`.
    """
    return _track(a, b, pose, direction, settings, beta)


@functools.partial(jax.jit, static_argnames="settings", inline=True)
def _track(
    a: Shape,
    b: Shape,
    pose: Pose,
    direction: Float[Array, "3"],
    settings: Settings,
    beta: Float[Array, ""] | None,
) -> Contact:
    """`track`, as one program."""
    scaled = _scaled(a, b, pose, settings, beta)
    d, pair = jax.lax.stop_gradient((direction, scaled.pair))
    d = d / largest(jnp.abs(d))
    d, _ = polish(pair, d / jnp.sqrt(total(d * d)), settings.warm_steps)
    return _contact(a, b, scaled, d)


def approach(
    a: Shape,
    b: Shape,
    pose: Pose,
    direction: Float[Array, "3"] | None = None,
    settings: Settings = STANDARD,
    *,
    beta: Float[Array, ""] | None = None,
) -> Contact:
    """Signed distance of two shapes whose cores are apart, from a direction up to 0.3 rad off.

    There is one minimum then. Two steps more than `track`, and no limit to the first one. Where the
    cores overlap the distance is that along some normal: it says that they do, but not how far.

    The arguments are those of `track`; the direction is a unit vector. None: from one middle to the
    other, however far off, in three times as many steps.
    """
    scaled = _scaled(a, b, pose, settings, beta)
    d, pair = jax.lax.stop_gradient((direction, scaled.pair))
    if d is None:
        d, _ = descend(pair, _towards(pair), 3 * settings.warm_steps)
    else:
        d, _ = descend(pair, d, settings.warm_steps + 2)
    return _contact(a, b, scaled, d)


class _Scaled(eqx.Module):
    """The dimensionless pair about A's centre (mm), with its size (mm); those two are constants."""

    pair: Pair
    centre: Float[Array, "3"]
    size: Float[Array, ""]


def _scaled(a: Shape, b: Shape, pose: Pose, settings: Settings, beta) -> _Scaled:
    """Lengths over the size, about A's centre: translations cancel before they are rounded."""
    centre = jax.lax.stop_gradient(mean(a.vertices, a.counts))
    turned = rotate(pose.rotation, b.vertices)
    v_a = a.vertices - centre[:, None]
    v_b = turned + (pose.translation - centre)[:, None]

    others = jnp.maximum(jnp.abs(pose.translation), jnp.abs(centre))
    v_a = _without_rounding(v_a, largest(largest(jnp.abs(a.vertices))))
    v_b = _without_rounding(v_b, largest(jnp.maximum(largest(jnp.abs(turned)), others)))
    size = jax.lax.stop_gradient(_size(v_a, v_b, b.counts, a.radius + b.radius))
    sharpness = jnp.asarray(settings.sharpness, size.dtype) if beta is None else beta * size
    pair = Pair(v_a / size, v_b / size, sharpness, a.counts, b.counts)
    return _Scaled(pair, centre, size)


def _without_rounding(v, largest):
    """Differences that are only rounding of the coordinates they come from are none.

    Coincident points would otherwise have a distance, and a direction that depends on the unit. The
    derivative is kept.
    """
    none = jnp.abs(v) <= ROUNDINGS * epsilon(v.dtype) * largest
    return v - jax.lax.stop_gradient(jnp.where(none, v, 0))


def _size(v_a, v_b, counts_b, radius):
    """Sum of both half-extents; for two bare points their distance, or 1 mm where they coincide."""
    centre_b = mean(v_b, counts_b)
    extent = _reach(v_a) + _reach(v_b - centre_b[:, None]) + radius
    apart = largest(jnp.abs(centre_b))
    size = jnp.where(extent > 0, extent, apart)
    return jnp.where(size > 0, size, 1)


def _reach(vertices):
    """Largest distance from the origin, without squaring a length in its own unit."""
    scale = largest(largest(jnp.abs(vertices)))
    unit = vertices / jnp.where(scale > 0, scale, 1)
    return scale * jnp.sqrt(largest(total((unit * unit).T)))


def _towards(pair: Pair):
    """Unit vector from A's centre (the origin) to B's; z where they coincide."""
    v = mean(pair.b, pair.counts_b)
    length = jnp.sqrt(total(v * v))
    ahead = jnp.asarray((0, 0, 1), v.dtype)
    return jnp.where(length > FLOOR, v / jnp.where(length > FLOOR, length, 1), ahead)


@jax.custom_jvp
def _normal(pair: Pair, d: Float[Array, "3"]):
    """The minimiser d itself, with its derivative: H dn = -(d gradient at fixed direction)."""
    return d


@_normal.defjvp
def _normal_jvp(primals, tangents_):
    (pair, d), (pair_dot, _) = primals, tangents_
    n = _normal(pair, d)
    _, (g1, g2) = jax.jvp(lambda p: model(p, n).gradient, (pair,), (pair_dot,))
    a, b, c = model(pair, n).hessian
    fixed = jax.lax.stop_gradient((a, b, c))
    lift = jnp.maximum(floor_of(fixed) - eigenvalues(fixed)[0], 0)
    u1, u2 = solve_2x2(a + lift, b, c + lift, -g1, -g2)
    e1, e2 = tangents(n)
    return n, e1 * u1 + e2 * u2


@jax.custom_jvp
def _minimum(pair: Pair, n: Float[Array, "3"]):
    """Value of f at its minimiser; Danskin: the motion of n does not count."""
    return model(pair, n).value


@_minimum.defjvp
def _minimum_jvp(primals, tangents_):
    (pair, n), (pair_dot, _) = primals, tangents_
    _, change = jax.jvp(lambda p: model(p, n).value, (pair,), (pair_dot,))
    return _minimum(pair, n), change


def _contact(a: Shape, b: Shape, scaled: _Scaled, d, tied: Array | bool = False) -> Contact:
    """Everything that is read off at the direction where the search stopped."""
    pair, size = scaled.pair, scaled.size
    n = _normal(pair, jax.lax.stop_gradient(d))
    core_a = Shape(pair.a, a.radius / size, pair.counts_a)
    core_b = Shape(pair.b, b.radius / size, pair.counts_b)
    at_a, at_b = support(core_a, n, pair.beta), support(core_b, -n, pair.beta)
    distance = -size * _minimum(pair, n) - (a.radius + b.radius)
    lower, upper = _bounds(core_a, core_b, at_a, at_b, n)
    m = jax.lax.stop_gradient(model(pair, n))
    low, _ = eigenvalues(m.hessian)
    return Contact(
        distance,
        n,
        size * at_a.point + scaled.centre,
        size * at_b.point + scaled.centre,
        size * lower,
        size * upper,
        jnp.sqrt(m.gradient[0] ** 2 + m.gradient[1] ** 2),
        low,
        _status(m, low, pair.beta, distance, tied),
    )


def _bounds(a: Shape, b: Shape, at_a: Support, at_b: Support, n):
    """Lower and upper bound of the sharp distance, from the normal and from points of the cores."""
    a, b, at_a, at_b, n = jax.lax.stop_gradient((a, b, at_a, at_b, n))
    gap = at_b.core - at_a.core
    upper = jnp.sqrt(total(gap * gap)) - (a.radius + b.radius)
    return -(sharp_support(a, n) + sharp_support(b, -n)), upper


def _status(m: Model, low, beta, distance, tied):
    """Converged by the value that one more Newton step would gain, in units of 1/beta.

    Where the distance bends downwards (a saddle by symmetry, where no gradient leads away) it is no
    minimum, however small the gradient.
    """
    u1, u2 = newton_step(m)
    gain = -0.5 * (m.gradient[0] * u1 + m.gradient[1] * u2)
    floor = floor_of(m.hessian)
    level = (low <= floor) | tied
    status = jnp.where(level, ContactStatus.FLAT, ContactStatus.OK)
    short = (gain * beta > TOLERANCE) | (low < -floor)
    status = jnp.where(short, ContactStatus.NOT_CONVERGED, status)
    finite = jnp.isfinite(distance)
    return jnp.where(finite, status, ContactStatus.NON_FINITE).astype(jnp.int8)
