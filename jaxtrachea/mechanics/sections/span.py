r"""Wall between two rings: a shear-flexible beam for each mode (semi-membrane shell, after Vlasov).

The wall warps, u_x = -R sum_m psi_m X_m(phi) with X_m the radial shape of mode m over m^2: three
rotations psi each for the symmetric and the antisymmetric modes (e and b0 do not warp). Membrane
shear and axial strain, with the shapes r_k, t_k of the linear modes and f = 1 in front, rho behind:

    A_kl = G_t R int f t_k t_l dphi,
    C_kl = E_t R^3 int f X_k X_l dphi + D R int_front r_k r_l dphi.

A span of length h: g = (q_R - q_L) / h - E (psi_L + psi_R) / 2, kap = (psi_R - psi_L) / h, energy
W_0 = h/2 (g^T A* g + kap^T C kap) with A* = (A^-1 + h^2/12 E C^-1 E^T)^-1, which makes a linear
prismatic span exact. It softens as W = 2 W_0 / (1 + sqrt(1 + 2 c_W W_0)), convex in (q, psi).

Shapes of different symmetry do not meet in A and C: everything here has a leading axis of parities,
one on the midline, else two, with seven unknowns each: four q and three psi.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.mechanics.sections.section import Grid, Shape

#: Order m of the modes that warp, and their places among the four q of either parity.
ORDERS = (1, 2, 3)
WARPING = ((0, 1, 2), (1, 2, 3))


class Wall(eqx.Module):
    """Stiffness of the spans; each field a scalar or one value a span.

    Attributes:
        Gt_L: shear modulus times thickness, N/mm.
        Et_L: modulus along the tube times thickness, N/mm.
        D_L: bending stiffness of the wall between rings, N mm.
        c_W: softening with the energy of the span, 1/(N mm); 0: linear.
        rho: share of the muscle in shear and stretch of the wall.
    """

    Gt_L: Float[Array, "*spans"]
    Et_L: Float[Array, "*spans"]
    D_L: Float[Array, "*spans"]
    c_W: Float[Array, "*spans"]
    rho: Float[Array, "*spans"]


class Forms(NamedTuple):
    """Integrals of the shapes over front and back; parities first.

    `shear`: of t_k t_l, `stretch`: of X_k X_l, `bend`: of r_k r_l.
    """

    shear_front: Float[Array, "parities 4 4"]
    shear_back: Float[Array, "parities 4 4"]
    stretch_front: Float[Array, "parities 3 3"]
    stretch_back: Float[Array, "parities 3 3"]
    bend_front: Float[Array, "parities 3 3"]


class Span(NamedTuple):
    """One span, ready for use.

    Attributes:
        stiffness: second derivative of W_0 by the unknowns of both ends, left then right.
        shear: diagonal of A.
        axial: C.
        c_W: 1/(N mm).
        h: length, mm.
    """

    stiffness: Float[Array, "*s parities 14 14"]
    shear: Float[Array, "*s parities 4"]
    axial: Float[Array, "*s parities 3 3"]
    c_W: Float[Array, "*s"]
    h: Float[Array, "*s"]


def selector(parities: int, dtype) -> np.ndarray:
    """E of the module docstring: 1 where a rotation belongs to a mode; (parities, 4, 3)."""
    E = np.zeros((parities, 4, 3), dtype)
    for parity, places in enumerate(WARPING[:parities]):
        E[parity, places, np.arange(3)] = 1
    return E


def linear_shapes(phi: Float[Array, " m"], shape: Shape, midline: bool):
    """Radial and tangential shapes of the modes for small q; (parities, 4, m) each.

    Of mode e: the muscle strains by 1/R, the cartilage turns by -2 sin(alpha) / (pi R) sin(phi).
    """
    c, s = jnp.cos(phi), jnp.sin(phi)
    alpha, turn = shape.half_angle, -2 * jnp.sin(shape.half_angle) / jnp.pi
    mean = (-jnp.sin(alpha) - (jnp.pi - alpha) * jnp.cos(alpha)) / jnp.pi
    behind, side = jnp.abs(phi) > alpha, jnp.sign(phi)
    y = turn * jnp.cos(2 * phi) / 4 - mean + jnp.where(behind, c - jnp.cos(alpha), 0)
    z = jnp.where(behind, s - side * jnp.sin(alpha), 0) - turn * (phi / 2 - jnp.sin(2 * phi) / 4)
    radial = [*(jnp.cos(m * phi) for m in ORDERS), y * c + z * s]
    around = [*(-jnp.sin(m * phi) / m for m in ORDERS), z * c - y * s]
    if midline:
        return jnp.stack(radial)[None], jnp.stack(around)[None]
    radial_b = [jnp.zeros_like(phi), *(jnp.sin(m * phi) for m in ORDERS)]
    around_b = [jnp.ones_like(phi), *(jnp.cos(m * phi) / m for m in ORDERS)]
    return (
        jnp.stack([jnp.stack(radial), jnp.stack(radial_b)]),
        jnp.stack([jnp.stack(around), jnp.stack(around_b)]),
    )


def warping_shapes(phi: Float[Array, " m"], midline: bool) -> Float[Array, "parities 3 m"]:
    """X_m of the symmetric and, off the midline, the antisymmetric rotations."""
    even = jnp.stack([jnp.cos(m * phi) / m**2 for m in ORDERS])
    if midline:
        return even[None]
    return jnp.stack([even, jnp.stack([jnp.sin(m * phi) / m**2 for m in ORDERS])])


def make_forms(grid: Grid, shape: Shape) -> Forms:
    """The integrals of the shapes, by the quadrature of the ring."""
    r, t = linear_shapes(grid.phi, shape, grid.midline)
    X = warping_shapes(grid.phi, grid.midline)
    orders = jnp.asarray([m * m for m in ORDERS], X.dtype)[None, :, None]

    def form(v, on):
        return jnp.einsum("pkm,plm,m->pkl", v, v, grid.weights * on)

    front, back = 1 - grid.behind, grid.behind
    return Forms(
        shear_front=form(t, front),
        shear_back=form(t, back),
        stretch_front=form(X, front),
        stretch_back=form(X, back),
        bend_front=form(orders * X, front),
    )


def make_span(wall: Wall, h: Float[Array, ""], forms: Forms, shape: Shape) -> Span:
    """One span of length h, mm; `wall` with scalars."""
    R = shape.radius
    A = wall.Gt_L * R * (forms.shear_front + wall.rho * forms.shear_back)
    C = wall.Et_L * R**3 * (forms.stretch_front + wall.rho * forms.stretch_back)
    C = C + wall.D_L * R * forms.bend_front
    parities = A.shape[0]
    E = jnp.asarray(selector(parities, A.dtype))
    inverse, by_rows = jnp.linalg.inv, E.transpose(0, 2, 1)
    A_star = inverse(inverse(A) + h * h / 12 * (E @ inverse(C) @ by_rows))
    A_star = (A_star + A_star.transpose(0, 2, 1)) / 2
    eye = jnp.broadcast_to(jnp.eye(4, dtype=A.dtype), A.shape) / h
    turn = jnp.broadcast_to(jnp.eye(3, dtype=A.dtype), C.shape) / h
    none = jnp.zeros((parities, 3, 4), A.dtype)
    g = jnp.concatenate([-eye, -E / 2, eye, -E / 2], 2)
    kap = jnp.concatenate([none, -turn, none, turn], 2)

    def square(B, D):
        return B.transpose(0, 2, 1) @ D @ B

    stiffness = h * (square(g, A_star) + square(kap, C))
    return Span(stiffness, jnp.diagonal(A, axis1=1, axis2=2), C, wall.c_W, h)


def span_energy(ends: Float[Array, "parities 14"], span: Span) -> Float[Array, ""]:
    """Energy of a span, N mm, for the unknowns of both its ends."""
    W_0 = jnp.sum(ends * jnp.einsum("pij,pj->pi", span.stiffness, ends)) / 2
    return 2 * W_0 / (1 + jnp.sqrt(1 + 2 * span.c_W * W_0))


def span_forces(ends: Float[Array, "parities 14"], span: Span) -> Float[Array, "parities 14"]:
    """Derivative of `span_energy` by the unknowns of both ends."""
    linear = jnp.einsum("pij,pj->pi", span.stiffness, ends)
    return linear / jnp.sqrt(1 + span.c_W * jnp.sum(ends * linear))


def span_tangent(
    ends: Float[Array, "parities 14"], span: Span
) -> tuple[Float[Array, "parities 14"], Float[Array, "n n"]]:
    """Forces, and their derivative with the parities in one matrix, n = 14 parities."""
    linear = jnp.einsum("pij,pj->pi", span.stiffness, ends)
    soft = 1 / jnp.sqrt(1 + span.c_W * jnp.sum(ends * linear))
    whole = jax.scipy.linalg.block_diag(*span.stiffness)
    along = linear.ravel()
    slope = soft * whole - span.c_W * soft**3 * jnp.outer(along, along)
    return soft * linear, slope
