r"""A cartilage ring: two-hinge C-arch on the muscular mat, its ends joined by a tie (paper fig. 3).

The ring of radius R spans |phi| <= alpha from the anterior midline; y points forward, z to the
side. Its ends U (phi = -alpha) and V (+alpha) each stand on springs k_M / 2 in y and in z and are
joined behind by the muscular bar, a tie k_t. Three levels of detail:

- `mat`: the ring is rigid and moves on the mat alone, k = k_M (the paper: d_i = P_i / k);
- `arch`: the stiffness 1 / (e^T C e) in one direction e;
- `arch2`: the compliance C for both components of a load, `ring_compliance`.

The paper names the arch and the tie but prints no equations for them; these are the unit-load
method with one redundant, the thrust H across the ends. Bending only, no axial or shear strain of
the arch; small displacements.

Every function takes one ring and one angle. For all rings of a tube `vmap` over the fields that
differ, k_M say: what depends on the angle alone is then computed once.

Units: mm, N, N mm^2, N/mm, mm/N, rad.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon
from jaxtrachea.mechanics._matrix2 import apply
from jaxtrachea.status import RingStatus


class Ring(eqx.Module):
    """Section and supports of one ring.

    Attributes:
        radius: R of the ring line, mm.
        half_angle: alpha, rad, in (0, pi); table 1: 2 pi / 3.
        EI: bending stiffness E_C I_C of the cartilage in the plane of the ring, N mm^2, positive;
            inf: rigid.
        k_M: stiffness of the mat under the ring, N/mm, positive.
        k_t: stiffness of the muscular bar between the ends, N/mm, in [0, inf]; see `tie_stiffness`.
    """

    radius: Float[Array, ""]
    half_angle: Float[Array, ""]
    EI: Float[Array, ""]
    k_M: Float[Array, ""]
    k_t: Float[Array, ""]


class RingResponse(NamedTuple):
    """Motion of a ring under a load; components (y, z). NaN where `status` is not OK.

    Attributes:
        joint: displacement of the loaded point, mm.
        end_U: displacement of the end U (phi = -alpha), mm.
        end_V: displacement of the end V (phi = +alpha), mm.
        opening: how much further apart the ends are, mm.
        thrust: H = k_e opening, what holds the ends together: tie and lateral springs, N.
        tie: tension of the muscular bar, N.
        status: a `RingStatus` as int8.
    """

    joint: Float[Array, "2"]
    end_U: Float[Array, "2"]
    end_V: Float[Array, "2"]
    opening: Float[Array, ""]
    thrust: Float[Array, ""]
    tie: Float[Array, ""]
    status: Int[Array, ""]


def tie_stiffness(EA: Float[Array, ""], radius: Float[Array, ""], half_angle: Float[Array, ""]):
    """Stiffness of the muscular bar as a straight bar between the ends, N/mm.

    E_M A_M / (2 R sin alpha), with `EA` = E_M A_M in N.
    """
    return EA / (2 * radius * jnp.sin(half_angle))


class _Shares(NamedTuple):
    """Vertical reactions of U and V per unit load (P_y, P_z), by statics; P_z / 2 at each end."""

    U: Float[Array, "2"]
    V: Float[Array, "2"]


def _shares(ring: Ring, phi) -> _Shares:
    tilt_y = jnp.sin(phi) / jnp.sin(ring.half_angle) / 2
    tilt_z = (jnp.cos(phi) - jnp.cos(ring.half_angle)) / jnp.sin(ring.half_angle) / 2
    return _Shares(jnp.stack([0.5 - tilt_y, tilt_z]), jnp.stack([0.5 + tilt_y, -tilt_z]))


def _moments(ring: Ring, phi_load, phi):
    """Bending moment at `phi` over R of the simply supported arch, per unit load; shape (m, 2)."""
    share = _shares(ring, phi_load)
    half = jnp.asarray(np.array([[0.0, 0.5]]), phi.dtype)
    rise = (jnp.cos(phi) - jnp.cos(ring.half_angle))[:, None] * half
    from_V = (jnp.sin(ring.half_angle) - jnp.sin(phi))[:, None] * share.V[None] + rise
    from_U = (jnp.sin(ring.half_angle) + jnp.sin(phi))[:, None] * share.U[None] - rise
    return jnp.where((phi > phi_load)[:, None], from_V, from_U)


def _quadrature(breaks, order):
    """Gauss-Legendre points and weights on the pieces between `breaks`, both flat."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    nodes, weights = (jnp.asarray(v, breaks.dtype)[None] for v in (nodes, weights))
    middle, half = (breaks[1:] + breaks[:-1]) / 2, (breaks[1:] - breaks[:-1]) / 2
    return (middle[:, None] + half[:, None] * nodes).ravel(), (half[:, None] * weights).ravel()


class _Tie(NamedTuple):
    """k_e = k_t + k_M / 4 as `hold` / `give`, so that 0 and inf are ordinary values of k_t."""

    hold: Float[Array, ""]
    give: Float[Array, ""]


def _tie(ring: Ring) -> _Tie:
    k_e = ring.k_t + ring.k_M / 4
    return _Tie(jnp.minimum(k_e, 1), 1 / jnp.maximum(k_e, 1))


def _thrust(moments, rise, weights, bend, tie: _Tie):
    """H over `tie.hold`, per unit load: -int M m_H / (int m_H^2 + EI / (R k_e)); shape (2,)."""
    # Over bend where the arch is soft: the derivatives by EI and R then need no difference.
    bend, stiff = jnp.minimum(bend, 1), 1 / jnp.maximum(bend, 1)
    squared = tie.give * stiff + tie.hold * bend * jnp.sum(weights * rise * rise)
    # A rigid arch with a rigid tie is indeterminate; it is given no thrust.
    squared = jnp.where(squared > 0, squared, 1)
    return -bend * jnp.sum((weights * rise)[:, None] * moments, axis=0) / squared


def _influence(ring: Ring, phi, phi_load, breaks, order):
    """Motion at `phi` per unit load at `phi_load`; its thrust over `hold`; (2, 2), (2,)."""
    points, weights = _quadrature(breaks, order)
    tie, bend = _tie(ring), ring.radius**3 / ring.EI
    rise = jnp.cos(points) - jnp.cos(ring.half_angle)

    def bending(angle):
        moments = _moments(ring, angle, points)
        H = _thrust(moments, rise, weights, bend, tie)
        return moments + tie.hold * rise[:, None] * H[None], H

    (m, h), (m_load, h_load) = bending(phi), bending(phi_load)
    share, share_load = _shares(ring, phi), _shares(ring, phi_load)
    settle = share.U[:, None] * share_load.U[None] + share.V[:, None] * share_load.V[None]
    lateral = jnp.asarray(np.diag([0.0, 1.0]), points.dtype)
    rigid = (2 * settle + lateral) / ring.k_M
    # With H inside the moments every term is a square: nothing cancels, C is positive definite.
    arch = bend * jnp.sum((weights[:, None] * m)[:, :, None] * m_load[:, None, :], axis=0)
    stretch = (tie.hold * tie.give) * h[:, None] * h_load[None]
    return rigid + arch + stretch, h_load


def on_ring(half_angle, phi):
    """Whether `phi` lies on the cartilage (to rounding), and an angle that surely does."""
    on = jnp.abs(phi) <= half_angle * (1 + 8 * epsilon(phi.dtype))
    return on, jnp.where(on, phi, 0)


def ring_compliance(
    ring: Ring, phi_c: Float[Array, ""], *, order: int = 12
) -> tuple[Float[Array, "2 2"], Int[Array, ""]]:
    """Level `arch2`: displacement of the ring at phi_c per unit load (P_y, P_z) there.

    Args:
        phi_c: angle of the load from the anterior midline, rad, in (-pi, pi].
        order: Gauss-Legendre points on each side of the load. For alpha = 2 pi / 3: 4 leave 1e-3,
            6 leave 2e-6, 8 leave 1e-9, 12 rounding.

    Returns:
        C, mm/N, symmetric positive definite, and a `RingStatus` as int8. Behind the ends of the
        ring (|phi_c| > alpha) the load lies on the muscular bar, which this model knows as a tie
        only: C is NaN there and the status BEHIND_GAP. At the ends themselves C is that of a load
        on the end.
    """
    on, phi = on_ring(ring.half_angle, phi_c)
    breaks = jnp.stack([-ring.half_angle, phi, ring.half_angle])
    C, _ = _influence(ring, phi, phi, breaks, order)
    C = jnp.where(on, (C + C.T) / 2, jnp.nan)
    return C, _status(phi_c, on, jnp.all(jnp.isfinite(C)))


def respond(
    ring: Ring, phi_c: Float[Array, ""], load: Float[Array, "2"], *, order: int = 12
) -> RingResponse:
    """Motion of the joint and of both ends (paper fig. 7c) under a load (P_y, P_z) at phi_c, N.

    Each end settles by S / (k_M / 2) in y, with S its share of the load by statics; along z both
    move by P_z / k_M and apart by `opening`. The spring of end U carries k_M / 2 * end_U.

    Args:
        phi_c: angle of the load, rad, in (-pi, pi].
        load: (P_y, P_z), N.
        order: as in `ring_compliance`.
    """
    on, phi = on_ring(ring.half_angle, phi_c)
    breaks = jnp.stack([-ring.half_angle, phi, ring.half_angle])
    C, h = _influence(ring, phi, phi, breaks, order)
    share, tie = _shares(ring, phi), _tie(ring)

    def settle(end):
        return 2 * jnp.sum(end * load) / ring.k_M

    thrust, shift = tie.hold * jnp.sum(h * load), load[1] / ring.k_M
    opening = tie.give * jnp.sum(h * load)
    stiff = ring.k_t > 1  # N/mm; either form serves, the second loses digits of a weak tie
    pulled = jnp.where(stiff, 0, ring.k_t) * opening
    pulled = jnp.where(stiff, thrust - ring.k_M / 4 * opening, pulled)
    end_U = jnp.stack([settle(share.U), shift - opening / 2])
    end_V = jnp.stack([settle(share.V), shift + opening / 2])

    def hide(v):
        return jnp.where(on, v, jnp.nan)

    status = _status(phi_c, on, jnp.all(jnp.isfinite(C)))
    ends = hide(end_U), hide(end_V)
    return RingResponse(
        hide(apply(C, load)), *ends, hide(opening), hide(thrust), hide(pulled), status
    )


def ring_influence(
    ring: Ring, phi: Float[Array, ""], phi_c: Float[Array, ""], *, order: int = 12
) -> Float[Array, "2 2"]:
    """Displacement of the ring at `phi` per unit load (P_y, P_z) at `phi_c`, mm/N.

    Mapped over `phi` and applied to a load it gives the shape of the ring; at -alpha, alpha
    the motion of U and V. Reciprocal: the influence of phi on phi_c is its transpose.

    Args:
        phi: angle of the observed point, rad, in [-alpha, alpha].
        phi_c: angle of the load, rad, in [-alpha, alpha].
        order: Gauss-Legendre points on each of three pieces, see `ring_compliance`.

    Returns:
        The 2x2 influence; NaN if either point lies behind the ends of the ring.
    """
    (on, phi), (on_c, phi_c) = on_ring(ring.half_angle, phi), on_ring(ring.half_angle, phi_c)
    inner = jnp.minimum(phi, phi_c), jnp.maximum(phi, phi_c)
    breaks = jnp.stack([-ring.half_angle, *inner, ring.half_angle])
    return jnp.where(on & on_c, _influence(ring, phi, phi_c, breaks, order)[0], jnp.nan)


def _status(phi_c, on, finite):
    status = jnp.where(finite, RingStatus.OK, RingStatus.NON_FINITE)
    behind = ~on & jnp.isfinite(phi_c)
    return jnp.where(behind, RingStatus.BEHIND_GAP, status).astype(jnp.int8)
