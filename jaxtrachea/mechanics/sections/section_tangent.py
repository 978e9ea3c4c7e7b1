"""Forces and stiffness of one ring by its modes, and the motion of its surface, in closed form.

With w = (q, l) the energy is explicit, and the closure holds by multipliers mu: the gradient is
L_q and the Hessian Z^T L_ww Z for L = U - mu . closure, Z = (1; dl/dq).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.mechanics.sections.section import (
    A1,
    B1,
    FRONT,
    STRETCH,
    Grid,
    Line,
    Ring,
    Shape,
    bed_motion,
    bend,
    mean_weights,
    muscle,
    small_solve,
    way_to,
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


def _added(x, more, place: int, axis: int = 0):
    """An array with more added at a place along an axis; no scatter (`fusion.fuse`)."""
    shape = np.ones(x.ndim, int)
    shape[axis] = x.shape[axis]
    here = (np.arange(x.shape[axis]) == place).reshape(shape)
    return jnp.where(here, x + jnp.expand_dims(more, axis), x)


def _added_behind(x, more, grid: Grid):
    """An array with more added at the points `grid.back`: last of each half."""
    halves = jnp.split(more, 1 if grid.midline else 2)
    return x + jnp.concatenate([jnp.pad(half, (FRONT, 0)) for half in halves])


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
    on_turn = _added_behind(on_turn, shape.offset * (loads.bed_z * c - loads.bed_y * s), grid)
    # One product, also below: its start takes longer than its sums.
    total = _by_turn_and_curve(grid) @ jnp.concatenate([on_turn, loads.moment])
    pulled = jnp.sum(grid.behind * (loads.z * line.c - loads.y * line.s))
    total = _added(total, pulled + muscle(ring, shape) * line.w[STRETCH], STRETCH)
    total = _added(total, jnp.sum(loads.bed_y), A1)
    return total if grid.midline else _added(total, jnp.sum(loads.bed_z), B1)


def _by_turn_and_curve(grid: Grid):
    """Rotation and its derivative by w; (shapes, 2 points)."""
    return jnp.concatenate([grid.turn, grid.curve], 1)


def _slopes(line: Line, grid: Grid, shape: Shape):
    """Derivatives of u_y' and u_z' by w; (shapes, points) each."""
    by_turn = (shape.radius * line.stretch)[None] * grid.turn
    y, z = -by_turn * line.c[None], -by_turn * line.s[None]
    return (
        _added(y, -line.s * grid.behind, STRETCH),
        _added(z, line.c * grid.behind, STRETCH),
    )


def _gaps(line: Line, grid: Grid, shape: Shape):
    """Derivative of the closure by w; (gaps, shapes)."""
    d_y, d_z = _slopes(line, grid, shape)
    slopes = (d_z,) if grid.midline else (d_z, d_y)
    return jnp.stack([v @ grid.weights for v in slopes])


def _held(line: Line, loads: _Loads, ring: Ring, grid: Grid, shape: Shape):
    """Loads with the multipliers of the closure taken off, the gradient then, and dl/dq."""
    gaps = _gaps(line, grid, shape)
    by_lam = gaps[:, grid.modes :]
    free = _gradient(line, loads, ring, grid, shape)
    mu = small_solve(by_lam.T, free[grid.modes :])
    held = loads._replace(z=loads.z - mu[0] * grid.weights)
    if not grid.midline:
        held = held._replace(y=loads.y - mu[1] * grid.weights)
    gradient = free[: grid.modes] - mu @ gaps[:, : grid.modes]
    return held, gradient, -small_solve(by_lam, gaps[:, : grid.modes])


def line_forces(line: Line, ring: Ring, grid: Grid, shape: Shape) -> Float[Array, " modes"]:
    """dU/dq of `section.energy`, N."""
    return _held(line, _loads(line, ring, grid, shape), ring, grid, shape)[1]


def line_tangent(
    line: Line, ring: Ring, grid: Grid, shape: Shape
) -> tuple[Float[Array, " modes"], Float[Array, "modes modes"]]:
    """dU/dq, N, and d2U/dq2, N/mm."""
    loads, gradient, follow = _held(line, _loads(line, ring, grid, shape), ring, grid, shape)
    kappa = line.w @ grid.curve / shape.radius
    EI = jnp.where(grid.behind > 0, ring.EI_M, ring.EI_C)
    stiff = grid.weights * EI * bend(kappa, ring.c_K)[2] / shape.radius
    squares = _turn_squares(line, loads.y, loads.z, shape)
    c, s = line.c[grid.back], line.s[grid.back]
    by_offset = -shape.offset * (loads.bed_y * c + loads.bed_z * s)
    squares = _added_behind(squares, by_offset, grid)
    hessian = _weighted_squares(_by_turn_and_curve(grid), jnp.concatenate([squares, stiff]))
    hessian = hessian + _bed_part(line, ring, grid, shape)
    hessian = _mix_stretch(hessian, line, loads.y, loads.z, grid)
    stretched = _added(jnp.zeros_like(line.w), muscle(ring, shape), STRETCH)
    hessian = _added(hessian, stretched, STRETCH)
    return gradient, _along_closed(hessian, follow)


def _along_closed(hessian, follow):
    """Z^T H Z with Z = (1; follow)."""
    n = follow.shape[1]
    mixed = hessian[:n, n:] @ follow
    return hessian[:n, :n] + mixed + mixed.T + follow.T @ hessian[n:, n:] @ follow


class Surface(NamedTuple):
    """The outer surface at one angle: inward normal and circumference, with derivatives by q.

    Attributes:
        motion: mm.
        slope: its derivative.
        curved: second derivative of the motion along a given force, N/mm.
    """

    motion: Float[Array, " directions"]
    slope: Float[Array, "directions modes"]
    curved: Float[Array, "modes modes"]


def surface_tangent(
    line: Line, phi: Float[Array, ""], force: Float[Array, " directions"], grid: Grid, shape: Shape
) -> Surface:
    """`section.line_motion` with its derivatives, those of the second order along a force.

    Args:
        line: the section, closed.
        phi: angle of the point on the cartilage, rad.
        force: inward and, unless it has one entry, along the circumference, N.
        grid: of the line.
    """
    way = way_to(line, phi, grid, shape)
    y, z = way.motion
    count = force.shape[0]
    normal, side = jnp.cos(phi), jnp.sin(phi)
    axes = jnp.stack([jnp.stack([-normal, -side]), jnp.stack([-side, normal])])[:count]
    mean = mean_weights(grid.phi, grid.weights)
    on_y, on_z = -axes[:, :1] * mean[None], -axes[:, 1:] * mean[None]
    if grid.midline:
        on_z = jnp.zeros_like(on_z)
    # Gradient by w of each direction.
    d_y, d_z = _slopes(line, grid, shape)
    free = on_y @ d_y.T + on_z @ d_z.T
    at_way = axes[:, :1] * way.by_turn_y[None] + axes[:, 1:] * way.by_turn_z[None]
    free = _added(free + at_way @ way.turn.T, axes[:, 0], A1, 1)
    free = free if grid.midline else _added(free, axes[:, 1], B1, 1)
    gaps, n = _gaps(line, grid, shape), grid.modes
    mu = small_solve(gaps[:, n:].T, free[:, n:].T)
    slope = free[:, :n] - mu.T @ gaps[:, :n]
    # The second derivative along the force, with the multipliers of the closure.
    held = mu @ force
    loads_z = force @ on_z - held[0] * grid.weights
    loads_y = force @ on_y - (0 if grid.midline else held[1] * grid.weights)
    along = force @ axes
    hessian = _weighted_squares(grid.turn, _turn_squares(line, loads_y, loads_z, shape))
    # What turns y turns into z, and z into -y.
    squares = along[1] * way.by_turn_y - along[0] * way.by_turn_z
    hessian = hessian + (way.turn * squares[None]) @ way.turn.T
    hessian = _mix_stretch(hessian, line, loads_y, loads_z, grid)
    curved = _along_closed(hessian, -small_solve(gaps[:, n:], gaps[:, :n]))
    return Surface(axes @ jnp.stack([y, z]), slope, curved)


def _bed_part(line: Line, ring: Ring, grid: Grid, shape: Shape):
    """Sum of stiffness times the squares of the bed's first derivatives."""
    d_y, d_z = _slopes(line, grid, shape)
    lever = shape.offset * grid.turn[:, grid.back]
    y = d_y @ grid.to_y.T - lever * line.s[grid.back][None]
    z = d_z @ grid.to_z.T + lever * line.c[grid.back][None]
    y = _added(y, jnp.ones_like(y[0]), A1)
    z = z if grid.midline else _added(z, jnp.ones_like(z[0]), B1)
    phi = grid.phi[grid.back][None]
    normal, tangential = y * jnp.cos(phi) + z * jnp.sin(phi), z * jnp.cos(phi) - y * jnp.sin(phi)
    moved = jnp.concatenate([normal, tangential], 1)
    return (moved * jnp.concatenate(_bed_stiffness(ring, grid, shape))[None]) @ moved.T


def _turn_squares(line: Line, y, z, shape: Shape):
    """Second derivative by the rotation at each point, of loads y, z on the slopes."""
    return shape.radius * line.stretch * (y * line.s - z * line.c)


def _mix_stretch(hessian, line: Line, y, z, grid: Grid):
    """Adds the second derivatives by rotation and stretch of the muscle."""
    mixed = grid.turn @ (-grid.behind * (y * line.c + z * line.s))
    return _added(_added(hessian, mixed, STRETCH), mixed, STRETCH, 1)


def _weighted_squares(shapes, weights):
    """sum_p w_p v_p v_p^T: the table of products is the same for all rings, one product a batch."""
    i, j = np.triu_indices(shapes.shape[0])
    packed = (shapes[i] * shapes[j]) @ weights
    place = np.zeros((shapes.shape[0],) * 2, int)
    place[i, j] = place[j, i] = np.arange(i.size)
    return packed[place]
