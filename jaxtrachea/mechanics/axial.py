"""Axial part of the contact force: the ligament as two bars in parallel (paper eq. 2).

The paper's printed eq. 2 leaves out E_B in D_x S_B / L; the ratio of the forces is unaffected.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Axial(NamedTuple):
    """Response to an axial force at C (positive towards end B).

    Attributes:
        u_C: axial displacement of C, mm.
        u: axial displacement at each ring, linear from C to each end, mm; shape (n,).
        u_A: axial displacement of end A on its spring, mm.
        u_B: that of end B.
        force_A: tension carried by side AC, N (equal at every joint of that side).
        force_B: compression carried by side BC, N; force_A + force_B is the load.
    """

    u_C: Float[Array, ""]
    u: Float[Array, " n"]
    u_A: Float[Array, ""]
    u_B: Float[Array, ""]
    force_A: Float[Array, ""]
    force_B: Float[Array, ""]


def stretch(
    x: Float[Array, " n"],
    length: Float[Array, ""],
    EA: Float[Array, " spans"],
    s_c: Float[Array, ""],
    force: Float[Array, ""],
    *,
    k_A: Float[Array, ""] | None = None,
    k_B: Float[Array, ""] | None = None,
) -> Axial:
    """Displacements and forces of the ligament under an axial force at C.

    Args:
        x: ring positions, mm; shape (n,).
        length: mm.
        EA: axial stiffness of each span, N, positive; shape (n + 1,).
        s_c: contact position, mm, in [0, length].
        force: N, positive towards end B (larynx).
        k_A: axial spring holding end A, N/mm, in [0, inf]; None: rigid. Both 0: not finite.
        k_B: axial spring holding end B, N/mm, likewise.
    """
    ends = jnp.concatenate([jnp.zeros_like(x[:1]), x, length[None]])
    low, high = ends[:-1], ends[1:]
    A, B = _end(k_A, s_c), _end(k_B, s_c)
    # Not minimum: with C on a ring it would halve the derivative of the span that ends there. The
    # span at A is begun even at s = 0, or the derivative there would be lost.
    begun = jnp.concatenate([jnp.ones_like(x[:1], bool), s_c > x])
    upto_C = jnp.sum(jnp.where(begun, jnp.where(s_c > high, high, s_c) - low, 0) / EA)
    beyond_C = jnp.sum(jnp.where(begun, jnp.where(s_c > high, 0, high - s_c), high - low) / EA)
    upto_ring = jnp.cumsum((high - low) / EA)[:-1]
    beyond_ring = jnp.cumsum(((high - low) / EA)[::-1])[::-1][1:]
    c_A, c_B = A.give + A.hold * upto_C, B.give + B.hold * beyond_C
    # Each side's compliance is c / hold: a sum of positive terms also for k = 0 and inf.
    both = c_A * B.hold + c_B * A.hold
    from_A = (A.give + A.hold * upto_ring) * (c_B / both)
    from_B = (B.give + B.hold * beyond_ring) * (c_A / both)
    u = jnp.where(x <= s_c, from_A, from_B) * force
    force_A, force_B = A.hold * c_B / both * force, B.hold * c_A / both * force
    return Axial(
        u_C=c_A * (c_B / both) * force, u=u, u_A=A.give * (c_B / both) * force,
        u_B=B.give * (c_A / both) * force, force_A=force_A, force_B=force_B,
    )  # fmt: skip


class _End(NamedTuple):
    """An end spring as k = `hold` / `give`, so that 0 (free) and inf (held) are ordinary values."""

    hold: Float[Array, ""]
    give: Float[Array, ""]


def _end(k, like) -> _End:
    if k is None:
        return _End(jnp.ones_like(like), jnp.zeros_like(like))
    return _End(jnp.minimum(k, 1), 1 / jnp.maximum(k, 1))
