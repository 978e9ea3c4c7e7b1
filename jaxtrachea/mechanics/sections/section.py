r"""One ring of the skeleton: an inextensible arch in seven modes, and a muscle that stretches.

The mid-line of the wall is a circle of radius R, cartilage in |phi| <= alpha, muscle behind. Modes
q, mm: symmetric a1, a2, a3, e and antisymmetric b0, b1, b2, b3. Radial and tangential shapes of a_m
are (cos m phi, -sin m phi / m), of b_m (sin m phi, cos m phi / m); a1, b1 are translations, b0 is a
roll, e stretches the muscle. At any size of q, with t(x) = (-sin x, cos x) and n(x) = (cos x,
sin x) as (y, z):

- rotation theta = [b0 + sum_{m=2,3} (m - 1/m)(a_m sin m phi - b_m cos m phi)] / R
  + l_a sin phi + l_b cos phi, strain eps = e / R behind, 0 in front;
- closure, which gives l_a and l_b: int (1 + eps) t(phi + theta) dphi = 0 round the ring;
- mid-line u' = R [(1 + eps) t(phi + theta) - t(phi)], with the mean (a1, b1);
- outer surface u + (R_o - R) [n(phi + theta) - n(phi)].

The energy is that of bending (exact change of curvature theta' / R), of the bed behind and of the
muscle. On the midline of the tube q is symmetric: half a ring and l_a alone then do (`Grid`).

Gauss points lie on either side of +-alpha, where strain and bending stiffness jump, so that the
quadrature converges exponentially.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._numerics import cos_sin, epsilon, full_precision, largest

#: Gauss points on the half of the cartilage and on that of the muscle, and on the way to a point.
FRONT, BACK, WAY = 12, 8, 10
#: Places in the symmetric modes q[:4] and, in the same order of halves, the antisymmetric q[4:].
A1, STRETCH, B1 = 0, 3, 5


class Shape(eqx.Module):
    """Cross-section at rest, the same for all rings.

    Attributes:
        radius: R of the mid-line, mm.
        offset: from there to the outer surface, R_o - R, mm.
        half_angle: alpha, rad.
    """

    radius: Float[Array, ""]
    offset: Float[Array, ""]
    half_angle: Float[Array, ""]


class Ring(eqx.Module):
    """Stiffness of one ring with its pitch of wall; each field a scalar, or one value a ring.

    Attributes:
        pitch: length of tube that belongs to the ring, mm.
        EI_C: bending stiffness in front, N mm^2 a ring (all of its pitch).
        EI_M: likewise behind.
        Et_M: modulus times thickness of the muscle, N/mm.
        k_n: bed behind, along the outer normal, N/mm^3.
        k_t: likewise along the circumference.
        c_K: softening of bending with the change of curvature, mm^2; 0: linear.
    """

    pitch: Float[Array, "*rings"]
    EI_C: Float[Array, "*rings"]
    EI_M: Float[Array, "*rings"]
    Et_M: Float[Array, "*rings"]
    k_n: Float[Array, "*rings"]
    k_t: Float[Array, "*rings"]
    c_K: Float[Array, "*rings"]


class Grid(NamedTuple):
    """Quadrature round the ring (half of it, with double weights, on the midline).

    Attributes:
        phi: angles, rad; front and back of phi > 0, then of phi < 0.
        weights: of an integral round the whole ring.
        behind: 1 on the muscle, 0 on the cartilage.
        turn: rotation per mode and per multiplier, 1/mm and 1; shape (modes + closures, points).
        curve: its derivative by phi.
        to_y: from u_y' at all points to u_y (mean zero) at those behind.
        to_z: likewise for z.
    """

    phi: Float[Array, " points"]
    weights: Float[Array, " points"]
    behind: Float[Array, " points"]
    turn: Float[Array, "shapes points"]
    curve: Float[Array, "shapes points"]
    to_y: Float[Array, "back points"]
    to_z: Float[Array, "back points"]

    @property
    def midline(self) -> bool:
        """Whether only symmetric modes are there (static)."""
        return self.turn.shape[0] == 5

    @property
    def modes(self) -> int:
        """Number of modes q (static)."""
        return 4 if self.midline else 8

    @property
    def back(self) -> np.ndarray:
        """Places of the points behind (static)."""
        half = np.arange(FRONT, FRONT + BACK)
        return half if self.midline else np.concatenate([half, half + FRONT + BACK])


def _gauss(count, dtype):
    """Gauss-Legendre points and weights on (0, 1)."""
    points, weights = np.polynomial.legendre.leggauss(count)
    return ((points + 1) / 2).astype(dtype), (weights / 2).astype(dtype)


def _integrals(count):
    """Integrals on (0, x_i) of the polynomials that are 1 at one Gauss point of (0, 1), else 0."""
    points, weights = np.polynomial.legendre.leggauss(count)
    P = np.polynomial.legendre.legvander(points, count)
    n = np.arange(1, count)
    up = np.concatenate([points[:, None] + 1, (P[:, n + 1] - P[:, n - 1]) / (2 * n + 1)], 1)
    fit = (2 * np.arange(count) + 1)[:, None] / 2 * P[:, :count].T * weights
    return up @ fit / 2


def turn_shapes(phi: Float[Array, " m"], radius: Float[Array, ""], midline: bool):
    """Rotation of each mode and multiplier at angles phi, and its derivative; (shapes, m) each."""
    o, i = jnp.zeros_like(phi), jnp.ones_like(phi) / radius
    s1, s2, s3, c1, c2, c3 = (f(m * phi) for f in (jnp.sin, jnp.cos) for m in (1, 2, 3))
    turn = [o, 1.5 * s2 / radius, 8 / 3 * s3 / radius, o]
    curve = [o, 3 * c2 / radius, 8 * c3 / radius, o]
    if midline:
        return jnp.stack([*turn, s1]), jnp.stack([*curve, c1])
    turn += [i, o, -1.5 * c2 / radius, -8 / 3 * c3 / radius, s1, c1]
    curve += [o, o, 3 * s2 / radius, 8 * s3 / radius, c1, -s1]
    return jnp.stack(turn), jnp.stack(curve)


def make_grid(shape: Shape, *, midline: bool) -> Grid:
    """The quadrature of a cross-section.

    Args:
        midline: half a ring, for symmetric modes only.
    """
    dtype = shape.radius.dtype
    alpha, rest = shape.half_angle, jnp.pi - shape.half_angle
    (x_f, w_f), (x_b, w_b) = _gauss(FRONT, dtype), _gauss(BACK, dtype)
    phi = jnp.concatenate([alpha * x_f, alpha + rest * x_b])
    weights = jnp.concatenate([alpha * w_f, rest * w_b])
    behind = jnp.concatenate([jnp.zeros_like(x_f), jnp.ones_like(x_b)])
    whole = jnp.broadcast_to(alpha * w_f, (BACK, FRONT))
    up = jnp.concatenate([whole, rest * _integrals(BACK).astype(dtype)], 1)
    if midline:
        weights, to_z = 2 * weights, up
    else:
        phi, weights = jnp.concatenate([phi, -phi]), jnp.concatenate([weights, weights])
        behind = jnp.concatenate([behind, behind])
        none = jnp.zeros_like(up)
        to_z = jnp.block([[up, none], [none, -up]])
    mean = -mean_weights(phi, weights)[None]
    to_z, to_y = (to_z, to_z + mean) if midline else (to_z + mean, to_z + mean)
    turn, curve = turn_shapes(phi, shape.radius, midline)
    return Grid(phi, weights, behind, turn, curve, to_y, to_z)


def mean_weights(phi: Float[Array, " m"], weights: Float[Array, " m"]) -> Float[Array, " m"]:
    """Mean round the ring of what is 0 at phi = 0, from its derivative at the points (by parts)."""
    return weights * (jnp.sign(phi) / 2 - phi / (2 * jnp.pi))


def small_solve(M: Float[Array, "c c"], r: Float[Array, "c ..."]) -> Float[Array, "c ..."]:
    """M^-1 r for one or two unknowns."""
    if M.shape[0] == 1:
        return r / M[0, 0]
    det = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
    return jnp.stack([M[1, 1] * r[0] - M[0, 1] * r[1], M[0, 0] * r[1] - M[1, 0] * r[0]]) / det


def _gap(lam, turn, stretch, grid: Grid):
    """Misfit of the ring's ends over R along z and, off the midline, y; its derivative by lam.

    The derivative is (gaps, multipliers).
    """
    shapes = grid.turn[grid.modes :]
    c, s = cos_sin(grid.phi + turn + lam @ shapes)
    rows = grid.weights[None] * jnp.concatenate([jnp.ones_like(grid.phi)[None], shapes])
    along_z = rows @ (stretch * c)
    along_y = rows @ (stretch * s)
    if grid.midline:
        return along_z[:1], -along_y[1:, None]
    return jnp.stack([along_z[0], along_y[0]]), jnp.stack([-along_y[1:], along_z[1:]])


@jax.custom_jvp
def close_ring(
    turn: Float[Array, " points"], stretch: Float[Array, " points"], grid: Grid
) -> Float[Array, " closures"]:
    """The multipliers l_a (and l_b) that close the ring; NaN where Newton's steps find none.

    Args:
        turn: rotation of the modes alone, at the points.
        stretch: 1 + eps there.
    """

    def step(state):
        lam, _, count = state
        gap, slope = _gap(lam, turn, stretch, grid)
        change = small_solve(slope, gap)
        return lam - change, largest(jnp.abs(change)), count + 1

    # A step of a tenth of the square root of eps leaves an error of less than eps.
    small = 0.1 * epsilon(turn.dtype) ** 0.5

    def moves(state):
        return (state[1] > small) & (state[2] < 16)

    none = jnp.zeros(grid.turn.shape[0] - grid.modes, turn.dtype)
    begin = none, jnp.asarray(jnp.inf, turn.dtype), jnp.zeros((), jnp.int32)
    lam, change, _ = jax.lax.while_loop(moves, step, begin)
    return jnp.where(change <= small, lam, jnp.nan)


@close_ring.defjvp
@full_precision
def _close_ring_jvp(primals, tangents):
    lam = close_ring(*primals)
    _, grown, slope = jax.jvp(lambda *given: _gap(lam, *given), primals, tangents, has_aux=True)
    return lam, -small_solve(slope, grown)


class Line(NamedTuple):
    """The deformed mid-line at the points of a grid.

    Attributes:
        w: modes and multipliers, one array.
        stretch: 1 + eps.
        c: cosine of phi + theta.
        s: sine.
        slope_y: u_y', mm.
        slope_z: u_z', mm.
    """

    w: Float[Array, " shapes"]
    stretch: Float[Array, " points"]
    c: Float[Array, " points"]
    s: Float[Array, " points"]
    slope_y: Float[Array, " points"]
    slope_z: Float[Array, " points"]


def deform(q: Float[Array, " modes"], grid: Grid, shape: Shape) -> Line:
    """The mid-line for modes q, closed."""
    turn = q @ grid.turn[: grid.modes]
    stretch = 1 + q[STRETCH] / shape.radius * grid.behind
    lam = close_ring(turn, stretch, grid)
    x = grid.phi + turn + lam @ grid.turn[grid.modes :]
    c, s = cos_sin(x)
    slope_y = shape.radius * (jnp.sin(grid.phi) - stretch * s)
    slope_z = shape.radius * (stretch * c - jnp.cos(grid.phi))
    return Line(jnp.concatenate([q, lam]), stretch, c, s, slope_y, slope_z)


def bend(kappa, c_K):
    """Energy of bending over EI, with its first two derivatives: kappa^2 / 2 for c_K = 0."""
    root = jnp.sqrt(1 + c_K * kappa * kappa)
    return kappa * kappa / (1 + root), kappa / root, 1 / root**3


def bed_motion(line: Line, grid: Grid, shape: Shape):
    """Displacement of the outer surface behind, y and z, mm; (back,) each."""
    phi, c, s = grid.phi[grid.back], line.c[grid.back], line.s[grid.back]
    y = line.w[A1] + grid.to_y @ line.slope_y + shape.offset * (c - jnp.cos(phi))
    z = grid.to_z @ line.slope_z + shape.offset * (s - jnp.sin(phi))
    return y, z if grid.midline else z + line.w[B1]


def energy(q: Float[Array, " modes"], ring: Ring, grid: Grid, shape: Shape) -> Float[Array, ""]:
    """Energy of one ring with its bed and muscle, N mm.

    Args:
        q: modes, mm; (4,) on the midline, else (8,).
        grid: of this shape.
    """
    return line_energy(deform(q, grid, shape), ring, grid, shape)


def line_energy(line: Line, ring: Ring, grid: Grid, shape: Shape) -> Float[Array, ""]:
    """`energy` of a line that is known."""
    EI = jnp.where(grid.behind > 0, ring.EI_M, ring.EI_C)
    kappa = line.w @ grid.curve / shape.radius
    bending = jnp.sum(grid.weights * EI * bend(kappa, ring.c_K)[0]) * shape.radius
    y, z = bed_motion(line, grid, shape)
    phi = grid.phi[grid.back]
    u_n, u_t = y * jnp.cos(phi) + z * jnp.sin(phi), z * jnp.cos(phi) - y * jnp.sin(phi)
    area = grid.weights[grid.back] * (shape.radius + shape.offset) * ring.pitch
    bed = jnp.sum(area * (ring.k_n * u_n**2 + ring.k_t * u_t**2)) / 2
    return bending + bed + muscle(ring, shape) * line.w[STRETCH] ** 2 / 2


def muscle(ring: Ring, shape: Shape):
    """Stiffness of the muscle against the mode e, N/mm."""
    return 2 * (jnp.pi - shape.half_angle) * ring.pitch * ring.Et_M / shape.radius


def line_motion(line: Line, phi: Float[Array, ""], grid: Grid, shape: Shape) -> Float[Array, "2"]:
    """Displacement of the outer surface at phi, rad, on the cartilage: inward and round it, mm."""
    y, z = way_to(line, phi, grid, shape).motion
    normal, side = jnp.cos(phi), jnp.sin(phi)
    return jnp.stack([-y * normal - z * side, z * normal - y * side])


class Way(NamedTuple):
    """From the anterior midline to a point of the outer surface.

    Attributes:
        turn: rotation per mode and multiplier at Gauss points of the way and, last, at its end.
        by_turn_y: derivative of y by the rotation at each of them, mm.
        by_turn_z: that of z.
        motion: displacement of the end, y and z, mm.
    """

    turn: Float[Array, "shapes points"]
    by_turn_y: Float[Array, " points"]
    by_turn_z: Float[Array, " points"]
    motion: tuple[Float[Array, ""], Float[Array, ""]]


def way_to(line: Line, phi: Float[Array, ""], grid: Grid, shape: Shape) -> Way:
    """The way to an angle on the cartilage, rad, where nothing strains."""
    x, weights = _gauss(WAY, phi.dtype)
    points = jnp.concatenate([phi * x, phi[None]])
    lengths = jnp.concatenate([shape.radius * phi * weights, shape.offset[None]])
    turn = turn_shapes(points, shape.radius, grid.midline)[0]
    c, s = cos_sin(points + line.w @ turn)
    c_0, s_0 = cos_sin(points)
    mean = -mean_weights(grid.phi, grid.weights)
    y = lengths[:-1] @ (s_0 - s)[:-1] + shape.offset * (c - c_0)[-1]
    z = lengths[:-1] @ (c - c_0)[:-1] + shape.offset * (s - s_0)[-1]
    y = y + line.w[A1] + mean @ line.slope_y
    if not grid.midline:
        z = z + line.w[B1] + mean @ line.slope_z
    by_turn_y = -lengths * jnp.concatenate([c[:-1], s[-1:]])
    by_turn_z = lengths * jnp.concatenate([-s[:-1], c[-1:]])
    return Way(turn, by_turn_y, by_turn_z, (y, z))
