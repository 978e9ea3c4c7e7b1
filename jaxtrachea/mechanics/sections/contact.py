r"""The tool on the wall: where it acts, what of the rings moves there, and how the surface follows.

A contact at (s_c, phi_c) acts on the modes q_C of the section there,
q_C = N y + S g: N are the shape functions of a shear-flexible beam between its two rings, S the
beam's own compliance with both rings held, g = (dv/dq)^T F the force on the modes and v the motion
of the outer surface at phi_c (inward normal, circumference), exact at any size. On a ring S = 0.

A round tool near a ring rests on the ring: it acts at `effective_place`, nearer to the ring than
it is.

A flat punch is two contacts, its edges, which move alike (`mechanics.punch`). In one span each
moves the other, S is then a matrix of edges for every mode; in two spans neither does.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea.mechanics.sections.span import Span, selector


class Place(NamedTuple):
    """What each contact moves: one of a point, two of a punch.

    Attributes:
        shares: N, modes at the contact per unknown of each node.
        own: S, of the modes at one by the force on the same modes at another, mm/N.
        weight: of the wall between rings in the local compliance, 0 on a ring, 1 mid-span.
    """

    shares: Float[Array, "contacts nodes parities 4 7"]
    own: Float[Array, "contacts contacts parities 4"]
    weight: Float[Array, " contacts"]


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


def span_of(nodes: Float[Array, " nodes"], s: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """Number of the span that holds s; of two the upper."""
    j = jnp.sum(nodes <= s[..., None], -1) - 1
    return jnp.clip(j, 0, nodes.shape[0] - 2)


def acting_place(nodes: Float[Array, " nodes"], s_c, footprint):
    """The span that holds a contact, and how far behind its lower end the contact acts, mm."""
    j = span_of(nodes, s_c)
    return j, effective_place(s_c, nodes[j], nodes[j + 1], footprint) - nodes[j]


class Modal(NamedTuple):
    """A span as a beam for each mode.

    Attributes:
        shear: a, N/mm times mm.
        bending: c; 1 for modes that do not warp.
        warps: 1 for those that do, else 0.
    """

    shear: Float[Array, "parities 4"]
    bending: Float[Array, "parities 4"]
    warps: Float[np.ndarray, "parities 4"]


def modal_stiffness(shear: Float[Array, "p 4"], axial: Float[Array, "p 3 3"]) -> Modal:
    """The modes of `Span.shear` and `Span.axial`, each for itself."""
    E = selector(shear.shape[0], shear.dtype)
    warps = E.sum(2)
    c = jnp.einsum("pkw,pww->pk", jnp.asarray(E), axial)
    return Modal(shear, jnp.where(warps > 0, c, 1), warps)


def _bending_share(h, beam: Modal):
    """1 / (1 + 12 c / (a h^2)): 1 for a beam that only bends, 0 for modes that do not warp."""
    return beam.warps / (1 + 12 * beam.bending / (beam.shear * h * h))


def end_shares(x: Float[Array, ""], h: Float[Array, ""], beam: Modal):
    """Shape functions of q and psi of the lower end and of the upper, at x behind the lower one.

    Returns:
        Two pairs (of q, 1; of psi, mm), of shape (parities, 4) each.
    """
    both, z = _bending_share(h, beam), x / h
    w_L = 1 - z + both * (z - 3 * z**2 + 2 * z**3)
    w_R = z - both * (z - 3 * z**2 + 2 * z**3)
    shear = (1 - both) * (z - z**2) / 2
    r_L, r_R = h * (both * (z - 2 * z**2 + z**3) + shear), h * (both * (z**3 - z**2) - shear)
    return (w_L, r_L), (w_R, r_R)


def own_deflection(
    x: Float[Array, ""], load: Float[Array, ""], h: Float[Array, ""], beam: Modal
) -> Float[Array, "parities 4"]:
    """Deflection of a span with both ends held, at x by a unit force at `load`, mm/N.

    The mean, by the share of bending, of a beam that only bends and of one whose ends turn alike.
    """
    near, far = jnp.minimum(x, load), h - jnp.maximum(x, load)
    both, product = _bending_share(h, beam), near * far
    rest = h - far
    clamped = product**2 * (3 * rest * (h - near) - far * near) / (6 * h**3)
    turned = 3 * h * (near + far) - h * h - 3 * product - 2 * (near**2 + far**2)
    bent = both * clamped + (1 - both) * product * turned / (12 * h)
    return product / (h * beam.shear) + beam.warps * bent / beam.bending


def place_on(
    nodes: Float[Array, " nodes"],
    s: Float[Array, " contacts"],
    spans: Span,
    footprint: Float[Array, ""],
) -> Place:
    """The places of contacts.

    Args:
        nodes: both ends of the tube and the rings between, mm.
        s: their positions, mm, within the tube.
        spans: all of them, stacked.
        footprint: see `effective_place`.
    """
    at = jax.vmap(lambda s: acting_place(nodes, s, footprint))
    spans_of, loads = at(s)

    def one(s, j, x):
        h, stiff = spans.h[j], modal_stiffness(spans.shear[j], spans.axial[j])
        E = jnp.asarray(selector(stiff.shear.shape[0], x.dtype))
        (w_L, r_L), (w_R, r_R) = end_shares(x, h, stiff)

        def share(w, r):
            held = jnp.eye(4, dtype=w.dtype)[None] * w[:, :, None]
            return jnp.concatenate([held, E * r[:, :, None]], 2)

        none = jnp.zeros((nodes.shape[0], *E.shape[:2], 7), x.dtype)
        shares = none.at[j].set(share(w_L, r_L)).at[j + 1].set(share(w_R, r_R))
        both = jax.vmap(lambda load: own_deflection(x, load, h, stiff))(loads)
        own = jnp.where((spans_of == j)[:, None, None], both, 0)
        return Place(shares, own, jnp.sin(jnp.pi * (s - nodes[j]) / h) ** 2)

    return jax.vmap(one)(s, spans_of, loads)
