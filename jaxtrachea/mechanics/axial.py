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
        force_A: tension carried by side AC, N (equal at every joint of that side).
        force_B: compression carried by side BC, N; force_A + force_B is the load.
    """

    u_C: Float[Array, ""]
    u: Float[Array, " n"]
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
        k_A: axial spring holding end A, N/mm; None: rigid.
        k_B: axial spring holding end B, N/mm; None: rigid.
    """
    ends = jnp.concatenate([jnp.zeros_like(x[:1]), x, length[None]])
    low, high = ends[:-1], ends[1:]
    zero = jnp.zeros_like(s_c)
    end_A = zero if k_A is None else 1 / k_A
    end_B = zero if k_B is None else 1 / k_B
    # Not minimum: with C on a ring it would halve the derivative of the span that ends there.
    part = lambda upto: jnp.where(upto > high, high, upto) - low  # noqa: E731
    piece = lambda upto: jnp.sum(jnp.where(upto > low, part(upto), 0) / EA)  # noqa: E731
    upto_C, whole = piece(s_c), jnp.sum((high - low) / EA)
    c_A, c_B = end_A + upto_C, end_B + (whole - upto_C)
    share_A = c_B / (c_A + c_B)
    u_C = c_A * share_A * force
    upto_ring = jnp.cumsum((high - low) / EA)[:-1]
    from_A = (end_A + upto_ring) * share_A
    from_B = (end_B + (whole - upto_ring)) * (1 - share_A)
    u = jnp.where(x <= s_c, from_A, from_B) * force
    return Axial(u_C, u, share_A * force, c_A / (c_A + c_B) * force)
