"""The paper's dense force method: all redundant reactions of a side from one system (paper 2.3).

(delta + I/k) R = Delta with the printed influence coefficients corrected (docs/model.md). O(n^3);
the reference of the paper's own algorithm. `jaxtrachea.mechanics.beam` has the recursion in use.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import full_precision
from jaxtrachea.mechanics.compliance import Beam, Compliance, Deflection, Split, divide_load


def _influence(beam: Beam, s):
    """Influence coefficients of one cantilever of length s: unit forces at rings, V and M at tip.

    Returns the (n + 2, n + 2) matrix of displacements int m_p m_q / EI dx (+ shear) and the
    (n + 1, n + 2) matrix of rotations at the rings and the tip, each integral exact by Simpson's
    rule span by span. Rows of rings beyond the tip are those of a ring at the tip; mask them.
    """
    # At equality, a contact on a ring, `minimum` and `maximum` would pass on half a derivative.
    cut = jnp.where(beam.x > s, s, beam.x)
    ends = jnp.concatenate([jnp.zeros_like(beam.x[:1]), cut, s[None]])
    low, high = ends[:-1], ends[1:]
    points = jnp.stack([low, (low + high) / 2, high])
    at = ends[1:]
    arm = at[:, None, None] - points[None]
    arm = jnp.where(arm >= 0, arm, 0)
    m = jnp.concatenate([arm, jnp.ones_like(arm[:1])])
    weight = jnp.array([1, 4, 1], s.dtype)[:, None] * ((high - low) / (6 * beam.EI))[None]
    displacement = jnp.einsum("pts,qts,ts->pq", m, m, weight)
    order = jnp.arange(high.shape[0])
    before = (order[:, None] >= order[None]).astype(s.dtype)
    if beam.GA is not None:
        cut = jnp.concatenate([before, jnp.zeros_like(before[:1])])
        displacement = displacement + jnp.einsum("ps,qs,s->pq", cut, cut, (high - low) / beam.GA)
    return displacement, jnp.einsum("ps,qts,ts->pq", before, m, weight)


def _dense_side(beam: Beam, s, held):
    """Redundants of one cantilever for unit V and M at its tip.

    (delta + I/k) R = Delta with R = k w: (I + delta k) w = Delta, which k = 0 leaves regular.

    Returns:
        Compliance of the tip; by ring and unit load w, R = k w and theta.
    """
    n = beam.x.shape[0]
    displacement, rotation = _influence(beam, s)
    both = held[:, None] & held[None]
    flexibility = jnp.where(both, displacement[:n, :n], 0)
    load = jnp.where(held[:, None], displacement[:n, n:], 0)
    w = jnp.linalg.solve(jnp.eye(n, dtype=load.dtype) + flexibility * beam.k[None], load)
    R = beam.k[:, None] * w
    tip = displacement[n:, n:] - load.T @ R
    theta = rotation[:n, n:] - jnp.where(held[None], rotation[:n, :n], 0) @ R
    det = tip[0, 0] * tip[1, 1] - tip[0, 1] ** 2
    return Compliance(tip[0, 0], tip[0, 1], tip[1, 1], det), w, R, theta


@full_precision
def deflect_dense(
    beam: Beam, s_c: Float[Array, ""], force: Float[Array, ""], *, split: Split = "continuous"
) -> Deflection:
    """The paper's own algorithm: all redundant reactions of a side from one dense system.

    Same arguments and result as `deflect` with `form="reactions"`. Loses digits where rings are
    much stiffer than the ligament (docs/evidence/beam_accuracy.md has the table).
    """
    mirrored = Beam(
        (beam.length - beam.x)[::-1],
        beam.length,
        beam.EI[::-1],
        beam.k[::-1],
        None if beam.GA is None else beam.GA[::-1],
    )
    in_A = beam.x <= s_c
    s = jnp.stack([s_c, beam.length - s_c])
    held = jnp.stack([in_A, ~in_A[::-1]])
    stacked = jax.tree.map(lambda v, w: jnp.stack([v, w]), beam, mirrored)
    g, *of_rings = jax.vmap(_dense_side)(stacked, s, held)
    w_C, theta_C, V, M = divide_load(g, s, force, split)
    tip = jnp.stack([V, M], axis=1)
    w, R, theta = (jnp.einsum("sip,sp->si", v, tip) for v in of_rings)

    def of_both(v, sign):
        return jnp.where(in_A, v[0], sign * v[1][::-1])

    return Deflection(w_C, theta_C, of_both(w, 1), of_both(theta, -1), of_both(R, 1), V[0], M[0])
