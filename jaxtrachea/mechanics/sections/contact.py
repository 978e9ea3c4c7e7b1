r"""The tool on the wall: where it acts, what of the rings moves there, and how the surface follows.

A contact at (s_c, phi_c) acts on the modes q_C of the section there,
q_C = N y + S g: N are the shape functions of a shear-flexible beam between its two rings, S the
beam's own compliance with both rings held, g = (dv/dq)^T F the force on the modes and v the motion
of the outer surface at phi_c (inward normal, circumference), exact at any size. On a ring S = 0.

A round tool near a ring rests on the ring: it acts at `effective_place`, nearer to the ring than
it is.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.mechanics.sections.span import Span, selector


class Place(NamedTuple):
    """What a contact moves.

    Attributes:
        shares: N, modes at the contact per unknown of each node; (nodes, parities, 4, 7).
        own: S, diagonal, mm/N.
        weight: of the wall between rings in the local compliance, 0 on a ring, 1 mid-span.
    """

    shares: Float[Array, "nodes parities 4 7"]
    own: Float[Array, "parities 4"]
    weight: Float[Array, ""]


def effective_place(s_c: Float[Array, ""], left, right, footprint):
    """Where in its span a tool acts: (h/2) |2 d / h|^footprint from the nearer end, mm.

    Args:
        s_c: contact position, mm.
        left: of the span that holds it.
        right: likewise.
        footprint: exponent, 1 or more; 1: the tool is a point.
    """
    half = (right - left) / 2
    near_left = s_c - left <= half
    ratio = jnp.where(near_left, s_c - left, right - s_c) / half
    on_end = ratio <= 0
    moved = jnp.where(on_end, 0, jnp.where(on_end, 1, ratio) ** footprint)
    # On an end the power keeps its slope by s_c, 1 for a point and else 0.
    moved = jnp.where(on_end & (footprint == 1), ratio, moved)
    return jnp.where(near_left, left + half * moved, right - half * moved)


def place_on(
    nodes: Float[Array, " nodes"],
    s_c: Float[Array, ""],
    spans: Span,
    footprint: Float[Array, ""],
) -> Place:
    """The place of a contact.

    Args:
        nodes: both ends of the tube and the rings between, mm.
        s_c: contact position, mm, within the tube.
        spans: all of them, stacked.
        footprint: see `effective_place`.
    """
    count = nodes.shape[0] - 1
    j = jnp.clip(jnp.sum(nodes <= s_c) - 1, 0, count - 1)
    left, right, h = nodes[j], nodes[j + 1], spans.h[j]
    x = effective_place(s_c, left, right, footprint) - left
    a = spans.shear[j]
    parities = a.shape[0]
    E = jnp.asarray(selector(parities, a.dtype))
    warps = jnp.sum(E, 2)
    c = jnp.einsum("pkw,pww->pk", E, spans.axial[j])
    c = jnp.where(warps > 0, c, 1)
    both = warps / (1 + 12 * c / (a * h * h))  # share of bending; 0 for modes that do not warp
    z, y = x / h, h - x
    w_L = 1 - z + both * (z - 3 * z**2 + 2 * z**3)
    w_R = z - both * (z - 3 * z**2 + 2 * z**3)
    shear = (1 - both) * (z - z**2) / 2
    r_L, r_R = h * (both * (z - 2 * z**2 + z**3) + shear), h * (both * (z**3 - z**2) - shear)

    def share(w, r):
        held = jnp.eye(4, dtype=w.dtype)[None] * w[:, :, None]
        return jnp.concatenate([held, E * r[:, :, None]], 2)

    none = jnp.zeros((count + 1, *E.shape[:2], 7), a.dtype)
    shares = none.at[j].set(share(w_L, r_L)).at[j + 1].set(share(w_R, r_R))
    # A simply supported span, less what moments hold at its ends; exact for any shear.
    bent = (x * y / h) ** 2 * h / (12 * c) * (1 - both * (1 - 2 * z) ** 2)
    own = x * y / (h * a) + warps * bent
    weight = jnp.sin(jnp.pi * (s_c - left) / h) ** 2
    return Place(shares, own, weight)
