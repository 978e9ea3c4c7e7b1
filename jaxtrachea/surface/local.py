r"""Local shape: the dent under the tool, added to the global shape by radial functions.

u(x) = u_global(x) + sum_j w_j psi(|x - x_j| / r), psi(q) = (1 - q)_+^4 (4 q + 1), which is C2,
positive definite in space, and exactly 0 from r on. The weights meet given targets at the centres:
the local indentation at C, what keeps the surface out of the tool under its footprint, and 0 on a
collar round it.

Source of psi: Wendland, "Piecewise polynomial, positive definite and compactly supported radial
functions of minimal degree", Adv. Comput. Math. 4 (1995), doi:10.1007/BF02123482. The paper names
the local deformation but prints no equation for it.

Points are those of the tube bent straight (`Mesh.straight`), displacements along (tangent,
anterior, lateral); mm. Most vertices are beyond every centre's reach: `Runs` picks the others.
"""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._linear import linear
from jaxtrachea._numerics import added, epsilon, total

#: Centres on circles round C, by the number of centres; the outermost circle is the collar.
CIRCLES = {1: (), 8: (7,), 16: (6, 9), 32: (6, 10, 15)}
#: How far each centre reaches in a scene, in spacings.
REACH = 3


class Dent(eqx.Module):
    """A fitted local correction.

    Attributes:
        centres: mm; shape (centres, 3).
        weights: mm; shape (centres, 3), or (centres, 1) with `way`.
        reach: r, beyond which nothing moves, mm.
        way: along which all centres move, mm, of which `weights` are shares; None: each its own.
    """

    centres: Float[Array, "centres 3"]
    weights: Float[Array, "centres components"]
    reach: Float[Array, ""]
    way: Float[Array, "3"] | None = None


class Runs(eqx.Module):
    """The vertices in the order of s, in which those near a contact are one run.

    Attributes:
        order: vertices by s; None: they already are in this order.
        rank: place of each vertex in it, or None.
        longest: most vertices that a dent with 0, 1, 2 or 3 circles can reach, wherever it lies
            (static: the number of vertices a program computes).
        s: of the vertices in order, mm; None: one run of all.
    """

    order: Int[Array, " vertices"] | None
    rank: Int[Array, " vertices"] | None
    longest: tuple[int, ...] = eqx.field(static=True)
    s: Float[Array, " vertices"] | None = None


def runs(s: Float[Array, " vertices"], spacing: Float[Array, ""]) -> Runs:
    """Put vertices in order (concrete numbers; traced ones become one run of all).

    Args:
        s: of the vertices, mm.
        spacing: between the circles of the centres, mm.
    """
    if isinstance(s, Tracer) or isinstance(spacing, Tracer):
        return Runs(None, None, (len(s),) * 4)
    at = np.asarray(s, float)
    order = np.argsort(at, kind="stable")
    at = at[order]
    longest = tuple(
        int((np.searchsorted(at, at + 2 * half, side="right") - np.arange(len(at))).max(initial=0))
        for half in (_half_width(circles, float(spacing)) for circles in range(4))
    )
    if (np.diff(order) > 0).all():
        return Runs(None, None, longest, jnp.asarray(s))
    rank = np.argsort(order)
    return Runs(
        jnp.asarray(order, jnp.int32), jnp.asarray(rank, jnp.int32), longest, jnp.asarray(s)[order]
    )


def _half_width(circles: int, spacing):
    """Way along the tube from C beyond which a dent moves nothing, and a little more, mm."""
    return (circles + REACH) * spacing * 1.001


def pattern(count: int) -> tuple[Float[np.ndarray, "centres 2"], Bool[np.ndarray, " centres"]]:
    """C first, then circles of radius 1, 2, 3 about it; and which centres form the collar.

    Args:
        count: 1 (the peak alone), 8, 16 or 32.

    Raises:
        ValueError: for any other count.
    """
    if count not in CIRCLES:
        raise ValueError(f"count is {count}; expected one of {', '.join(map(str, CIRCLES))}")
    offsets, collar = [np.zeros((1, 2))], [False]
    for i, n in enumerate(CIRCLES[count]):
        angle = 2 * math.pi * np.arange(n) / n
        offsets.append((i + 1) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        collar += [i + 1 == len(CIRCLES[count])] * n
    return np.concatenate(offsets), np.array(collar)


def centres(
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    distance: Float[Array, ""],
    spacing: Float[Array, ""],
    count: int,
) -> Float[Array, "centres 3"]:
    """The pattern laid round the tube about C, mm.

    Args:
        s_c: contact position, mm.
        phi_c: angle of contact, rad.
        distance: of C from the centreline, mm, positive.
        spacing: between the circles, along and round the tube, mm.
        count: see `pattern`.
    """
    offsets = jnp.asarray(pattern(count)[0], s_c.dtype)
    phi = phi_c + offsets[:, 1] * (spacing / distance)
    across = distance * jnp.cos(phi), distance * jnp.sin(phi)
    return jnp.stack([s_c + offsets[:, 0] * spacing, *across], axis=1)


def targets(local: Float[Array, "3"], sag: Float[Array, " centres"]) -> Float[Array, "centres 3"]:
    """What the local correction must be at the centres of `pattern`.

    The dent under the footprint is shallower than at C by the sag, and nowhere reversed.

    Args:
        local: local part of the displacement of C, mm.
        sag: how much shallower than at C the tool lies over each centre of the rest surface,
            against `local`, mm; at C itself it is not read, on the collar neither.

    Returns:
        mm; shape (centres, 3): `local` at C, 0 on the collar.
    """
    return shares(local, sag)[:, None] * local[None]


def shares(local: Float[Array, "3"], sag: Float[Array, " centres"]) -> Float[Array, " centres"]:
    """Share of each centre in the local part of the displacement of C; see `targets`."""
    collar = pattern(sag.shape[0])[1]
    square = jnp.sum(local**2)
    depth = jnp.sqrt(jnp.where(square > 0, square, 1))
    share = jnp.where(square > 0, jnp.maximum(1 - sag / depth, 0), 0)
    at_C = np.arange(len(collar)) == 0
    return jnp.where(at_C, 1, jnp.where(collar, 0, share))


def fit(
    centres: Float[Array, "centres 3"],
    targets: Float[Array, "centres components"],
    reach: Float[Array, ""],
    way: Float[Array, "3"] | None = None,
    softness: Float[Array, " centres"] | None = None,
) -> Dent:
    """The correction that takes the values `targets` at `centres`, by Cholesky factors.

    A ridge of 16 eps n keeps repeated centres solvable (they share their mean target); elsewhere
    the targets are met to 16 eps n times the weights (1 mm: 2e-4 mm in float32).

    Args:
        centres: mm.
        targets: displacement at each centre, mm; with `way` shares of it, shape (centres, 1).
        reach: r, mm, positive. 2 to 5 spacings keep the condition number below 1e3.
        way: of centres that all move along it, mm: a third of the work.
        softness: of each target, not negative: what its weight costs, in the units of psi; the
            target of a softer centre gives way to those of others beside it. None: 0 throughout.
    """
    n = centres.shape[0]

    def solve(centres, targets, reach):
        matrix = kernel(centres, centres, reach)
        ridge = 16 * n * epsilon(matrix.dtype)
        if softness is not None:
            ridge = ridge + softness[:, None]
        matrix = matrix + ridge * jnp.eye(n, dtype=matrix.dtype)
        targets = targets.astype(jnp.result_type(targets, matrix))
        factor = jax.scipy.linalg.cho_factor(matrix, lower=True)

        def meet(weights):
            columns = [_spread(w, centres, centres, reach) for w in weights.T]
            return jnp.stack(columns, axis=1) + ridge * weights

        def weigh(_, targets):
            return jax.scipy.linalg.cho_solve(factor, targets)

        return jax.lax.custom_linear_solve(meet, targets, weigh, symmetric=True)

    return Dent(centres, solve(centres, targets, reach), reach, way)


def correction(dent: Dent, points: Float[Array, "points 3"]) -> Float[Array, "points 3"]:
    """Local displacement of every point, mm; exactly 0 beyond the reach of all centres."""
    return _together(dent, _columns(dent, points))


def _columns(dent: Dent, points):
    """Its components at the points, or with a way the share of it."""
    # One at a time: XLA for CPUs takes five times as long for a product with three columns.
    return [_spread(w, dent.centres, points, dent.reach) for w in dent.weights.T]


_dot = functools.partial(jnp.dot, precision="highest")


@jax.custom_jvp
def _spread(weights, centres, points, reach):
    """Sum of the kernels of all centres at every point; shape (points,)."""
    return _dot(weights, kernel(centres, points, reach))


@functools.partial(_spread.defjvp, symbolic_zeros=True)
def _spread_jvp(primals, tangents):
    """By the slope of psi over q, 20 (1 - q)^3, which has no pole; going back by products."""
    moving = [i for i, v in enumerate(tangents) if not isinstance(v, SymbolicZero)]

    def push(fixed, tangents):
        weights, centres, points, reach = fixed
        moved = dict(zip(moving, tangents, strict=True))
        q = _distance(centres, points, reach)
        closing = [q**2 * moved[3] * reach] if 3 in moved else []
        for k in range(3):
            way = points[None, :, k] - centres[:, None, k]
            closing += [way * moved[1][:, None, k]] if 1 in moved else []
            closing += [-way * moved[2][None, :, k]] if 2 in moved else []
        change = [_dot(moved[0], _psi(q))] if 0 in moved else []
        if closing:
            change.append(_dot(weights, _steepness(q) * added(closing)) / reach**2)
        return [added(change)]

    def moments(pulls, at):
        return jnp.stack([_dot(pulls, v) for v in at.T], axis=1)

    def pull(fixed, cotangents):
        (weights, centres, points, reach), (g,) = fixed, cotangents
        q = _distance(centres, points, reach)
        pulls = weights[:, None] * _steepness(q) * (g / reach**2)[None]
        # From the first centre: differences of small numbers.
        x, c = (v - centres[:1] for v in (points, centres))
        by = (
            lambda: _dot(_psi(q), g),
            lambda: moments(pulls, x) - jnp.sum(pulls, axis=1)[:, None] * c,
            lambda: moments(pulls.T, c) - jnp.sum(pulls, axis=0)[:, None] * x,
            lambda: jnp.sum(pulls * q**2) * reach,
        )
        return [by[i]() for i in moving]

    out = _spread(*primals)
    return out, linear(push, pull, primals, [tangents[i] for i in moving], [out])[0]


def _together(dent: Dent, columns):
    if dent.way is None:
        return jnp.stack(columns, axis=1)
    # As a product of matrices: going back, its parts are such products too, not plain sums.
    return jnp.einsum("p,c->pc", columns[0], dent.way, precision="highest")


def add_correction(
    u: Float[Array, "points 3"],
    dent: Dent,
    points: Float[Array, "points 3"],
    runs: Runs,
    s_c: Float[Array, ""],
) -> Float[Array, "points 3"]:
    """Add the `correction` of a dent about s_c to u; computed only where it can reach.

    Args:
        u: displacement of every vertex, mm.
        dent: with centres as from `centres`, reaching `REACH` of their spacings.
        points: all vertices.
        runs: of these points.
        s_c: contact position, mm.

    Returns:
        mm. NaN in the run if `runs` was made for a smaller spacing or for other vertices, so that
        a vertex within reach is not in it.
    """
    circles = len(CIRCLES[dent.centres.shape[0]])
    length = min(runs.longest[circles], points.shape[0])

    half = _half_width(circles, dent.reach / REACH)
    start = jnp.zeros((), jnp.int32)
    if runs.s is not None:
        first = jnp.searchsorted(runs.s, s_c - half).astype(jnp.int32)
        start = jnp.minimum(first, points.shape[0] - length)
    place = jnp.arange(points.shape[0], dtype=jnp.int32) if runs.rank is None else runs.rank
    outside = (place < start) | (place >= start + length)
    reached = jnp.abs(points[:, 0] - s_c) <= half * (1 - 5e-4)
    whole = total((outside & reached).astype(jnp.int32)) == 0

    def cut(v):
        return jax.lax.dynamic_slice_in_dim(v, start, length)

    run = cut(points) if runs.order is None else points[cut(runs.order)]
    # By itself: of vertices that begin anywhere the processor would take one after the other.
    here = _columns(dent, jax.lax.optimization_barrier(run.T).T)
    rest = points.shape[0] - length

    def spread(v):
        # A slice of what is padded by zeros: cheaper than writing the run into zeros.
        v = jax.lax.dynamic_slice_in_dim(jnp.pad(v, (rest, rest)), rest - start, points.shape[0])
        return v if runs.rank is None else v[runs.rank]

    return u + _together(dent, [spread(jnp.where(whole, v, jnp.nan)) for v in here])


def kernel(points, centres, reach):
    """Psi between points and centres: 1 at a centre, 0 from `reach` on; (points, centres)."""
    return _psi(_distance(points, centres, reach))


def _distance(points, centres, reach):
    """Between points and centres, in reaches, 1 from there on; shape (points, centres)."""
    ways = (p[:, None] - c[None] for p, c in zip(points.T, centres.T, strict=True))
    square = added(v**2 for v in ways) * (1 / (reach * reach))
    inside = square < 1
    away = inside & (square > 0)  # before the root, whose derivative at 0 is not finite
    return jnp.where(away, jnp.sqrt(jnp.where(away, square, 1)), jnp.where(inside, 0, 1))


def _psi(q):
    return (1 - q) ** 4 * (4 * q + 1)


def _steepness(q):
    """Minus its slope, over q."""
    return 20 * (1 - q) ** 3
