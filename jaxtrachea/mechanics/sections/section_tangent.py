"""Forces and stiffness of one ring by its modes, in closed form: half the time of AD twice.

With w = (q, l) the energy is explicit, and the closure holds by multipliers mu: the gradient is
L_q and the Hessian Z^T L_ww Z for L = U - mu . closure, Z = (1; dl/dq).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.mechanics.sections.section import (
    A1,
    B1,
    STRETCH,
    Grid,
    Line,
    Ring,
    Shape,
    bed_motion,
    bend,
    deform,
    muscle,
    small_solve,
)


class _Loads(NamedTuple):
    """Forces conjugate to what the modes move; (points,) or (back,) each.

    Attributes:
        y: on u_y', N.
        z: on u_z', N.
        bed_y: of the bed at the points behind, N.
        bed_z: likewise.
        moment: on theta', N mm.
    """

    y: Float[Array, " points"]
    z: Float[Array, " points"]
    bed_y: Float[Array, " back"]
    bed_z: Float[Array, " back"]
    moment: Float[Array, " points"]


def _bed_stiffness(ring: Ring, grid: Grid, shape: Shape):
    area = grid.weights[grid.back] * (shape.radius + shape.offset) * ring.pitch
    return area * ring.k_n, area * ring.k_t


def _loads(line: Line, ring: Ring, grid: Grid, shape: Shape) -> _Loads:
    phi = grid.phi[grid.back]
    c, s = jnp.cos(phi), jnp.sin(phi)
    y, z = bed_motion(line, grid, shape)
    k_n, k_t = _bed_stiffness(ring, grid, shape)
    f_n, f_t = k_n * (y * c + z * s), k_t * (z * c - y * s)
    bed_y, bed_z = f_n * c - f_t * s, f_n * s + f_t * c
    EI = jnp.where(grid.behind > 0, ring.EI_M, ring.EI_C)
    moment = grid.weights * EI * bend(line.w @ grid.curve / shape.radius, ring.c_K)[1]
    return _Loads(bed_y @ grid.to_y, bed_z @ grid.to_z, bed_y, bed_z, moment)


def _gradient(line: Line, loads: _Loads, ring: Ring, grid: Grid, shape: Shape):
    """dU/dw with the loads of the slopes as given; (shapes,)."""
    on_turn = -shape.radius * line.stretch * (loads.y * line.c + loads.z * line.s)
    c, s = line.c[grid.back], line.s[grid.back]
    on_turn = on_turn.at[grid.back].add(shape.offset * (loads.bed_z * c - loads.bed_y * s))
    total = grid.turn @ on_turn + grid.curve @ loads.moment
    pulled = jnp.sum(grid.behind * (loads.z * line.c - loads.y * line.s))
    total = total.at[STRETCH].add(pulled + muscle(ring, shape) * line.w[STRETCH])
    total = total.at[A1].add(jnp.sum(loads.bed_y))
    return total if grid.midline else total.at[B1].add(jnp.sum(loads.bed_z))


def _slopes(line: Line, grid: Grid, shape: Shape):
    """Derivatives of u_y' and u_z' by w; (shapes, points) each."""
    by_turn = (shape.radius * line.stretch)[None] * grid.turn
    y, z = -by_turn * line.c[None], -by_turn * line.s[None]
    return (
        y.at[STRETCH].add(-line.s * grid.behind),
        z.at[STRETCH].add(line.c * grid.behind),
    )


def _held(line: Line, loads: _Loads, ring: Ring, grid: Grid, shape: Shape):
    """Loads with the multipliers of the closure taken off, the gradient then, and dl/dq."""
    d_y, d_z = _slopes(line, grid, shape)
    slopes = (d_z,) if grid.midline else (d_z, d_y)
    gaps = jnp.stack([v @ grid.weights for v in slopes])
    by_lam = gaps[:, grid.modes :]
    free = _gradient(line, loads, ring, grid, shape)
    mu = small_solve(by_lam.T, free[grid.modes :])
    held = loads._replace(z=loads.z - mu[0] * grid.weights)
    if not grid.midline:
        held = held._replace(y=loads.y - mu[1] * grid.weights)
    gradient = free[: grid.modes] - mu @ gaps[:, : grid.modes]
    return held, gradient, -small_solve(by_lam, gaps[:, : grid.modes])


def ring_forces(
    q: Float[Array, " modes"], ring: Ring, grid: Grid, shape: Shape
) -> Float[Array, " modes"]:
    """dU/dq of `section.energy`, N."""
    line = deform(q, grid, shape)
    return _held(line, _loads(line, ring, grid, shape), ring, grid, shape)[1]


def ring_tangent(
    q: Float[Array, " modes"], ring: Ring, grid: Grid, shape: Shape
) -> tuple[Float[Array, " modes"], Float[Array, "modes modes"]]:
    """dU/dq, N, and d2U/dq2, N/mm."""
    line = deform(q, grid, shape)
    loads, gradient, follow = _held(line, _loads(line, ring, grid, shape), ring, grid, shape)
    hessian = _bed_part(line, ring, grid, shape) + _curved_part(line, loads, grid, shape)
    EI = jnp.where(grid.behind > 0, ring.EI_M, ring.EI_C)
    kappa = line.w @ grid.curve / shape.radius
    stiff = grid.weights * EI * bend(kappa, ring.c_K)[2] / shape.radius
    hessian = hessian + _weighted_squares(grid.curve, stiff)
    hessian = hessian.at[STRETCH, STRETCH].add(muscle(ring, shape))
    Z = jnp.concatenate([jnp.eye(grid.modes, dtype=q.dtype), follow])
    return gradient, Z.T @ hessian @ Z


def _bed_part(line: Line, ring: Ring, grid: Grid, shape: Shape):
    """Sum of stiffness times the squares of the bed's first derivatives."""
    d_y, d_z = _slopes(line, grid, shape)
    lever = shape.offset * grid.turn[:, grid.back]
    y = d_y @ grid.to_y.T - lever * line.s[grid.back][None]
    z = d_z @ grid.to_z.T + lever * line.c[grid.back][None]
    y = y.at[A1].add(1)
    z = z if grid.midline else z.at[B1].add(1)
    phi = grid.phi[grid.back][None]
    normal, tangential = y * jnp.cos(phi) + z * jnp.sin(phi), z * jnp.cos(phi) - y * jnp.sin(phi)
    k_n, k_t = _bed_stiffness(ring, grid, shape)
    return (normal * k_n[None]) @ normal.T + (tangential * k_t[None]) @ tangential.T


def _curved_part(line: Line, loads: _Loads, grid: Grid, shape: Shape):
    """Loads times second derivatives of what they act on."""
    squares = shape.radius * line.stretch * (loads.y * line.s - loads.z * line.c)
    c, s = line.c[grid.back], line.s[grid.back]
    squares = squares.at[grid.back].add(-shape.offset * (loads.bed_y * c + loads.bed_z * s))
    mixed = grid.turn @ (-grid.behind * (loads.y * line.c + loads.z * line.s))
    part = _weighted_squares(grid.turn, squares)
    return part.at[STRETCH].add(mixed).at[:, STRETCH].add(mixed)


def _weighted_squares(shapes, weights):
    """sum_p w_p v_p v_p^T: the table of products is the same for all rings, one product a batch."""
    count, points = shapes.shape
    table = (shapes[:, None] * shapes[None]).reshape(count * count, points)
    return (table @ weights).reshape(count, count)
