"""A rigid flat punch on the ligament: held level between two points, half a width to each side.

Two forces, half a width before and behind C, hold the ligament at one and the same deflection (a
flat punch that does not tilt, not even where it is so narrow that it is a point). The tool then
feels less of what lies between two rings than a point does. With shear the compliance has a corner,
no jump, where a ring comes under an edge, as that of a point has on a ring. Between the two forces
the ligament is free: it bows away from the tool by some half a width squared times its curvature.

For the flat end of a cylinder of radius r the mean half chord, pi/4 r, is its half width along s.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._numerics import epsilon, picked, product
from jaxtrachea.mechanics.beam import deflect_on
from jaxtrachea.mechanics.compliance import Beam
from jaxtrachea.mechanics.force_law import on_one_ring
from jaxtrachea.mechanics.marks import with_marks, without_marks

#: Points of Gauss and Legendre in [-1, 1] and their weights, for means over the width.
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(8)
#: Rings on one side that may reach a point; where more do, those in between leave nothing to them.
_REACHING = 8


class UnitDeflection(NamedTuple):
    """What moves under a unit force at C; for a punch, the sum of its forces.

    Attributes:
        w_C: deflection of C, mm.
        theta_C: rotation at C, rad; of a punch, which does not tilt, the mean of that at its edges,
            each weighed by its force. Without shear 2 theta_C is the derivative of w_C by s_c.
        w: deflection of the beam at each support, mm; shape (n,).
        theta: rotation of the section at each support, rad; shape (n,).
        reaction: force of each support against the load, N; shape (n,).
        edges: rotation of the ligament at both edges of a punch, rad; None: a point.
    """

    w_C: Float[Array, ""]
    theta_C: Float[Array, ""]
    w: Float[Array, " n"]
    theta: Float[Array, " n"]
    reaction: Float[Array, " n"]
    edges: Float[Array, "2"] | None = None


def punch_deflection(beam: Beam, s_c: Float[Array, ""], half_width: float) -> UnitDeflection:
    """Deflections under a punch at s_c whose forces sum to 1 N.

    Not for a punch that reaches beyond an end of the beam (`press` refuses it): what reaches beyond
    is taken to stand on the clamp there, and nothing moves. NaN where the punch is so narrow that
    its two points differ by rounding alone (a beam without shear feels the square of the width: in
    float32 some hundredth of a span).

    Args:
        s_c: middle of the punch, mm; half a width off both ends.
        half_width: mm, more than 0.
    """
    ends = jnp.clip(jnp.stack([s_c - half_width, s_c + half_width]), 0, beam.length)
    marked, passed, marks = with_marks(beam, ends)
    unit = jax.vmap(lambda s: deflect_on(marked, s, jnp.ones_like(s)))(ends)
    c_11, c_22 = unit.w_C
    c_12 = unit.w[0, marks[1]]
    first, second = c_22 - c_12, c_11 - c_12
    total = first + second
    apart = (total > 100 * epsilon(total.dtype) * (c_11 + c_22)) | (c_11 + c_22 == 0)
    share = jnp.stack([first, second]) / jnp.where(total > 0, total, 1)
    share = jnp.where(apart, share, jnp.nan)

    def add(found, end):
        share, moved = end
        own = jax.tree.map(lambda v: share * without_marks(v, passed, 2), moved)
        return jax.tree.map(jnp.add, found, own), None

    # A loop: of a sum XLA for CPUs makes a part of what reads it, and computes it anew for each
    # of many displacements.
    moved = unit.w, unit.theta, unit.reaction
    none = jax.tree.map(lambda v: jnp.zeros_like(v[0, 2:]), moved)
    w, theta, reaction = jax.lax.scan(add, none, (share, moved))[0]
    edges = product(share, picked(unit.theta, marks))
    return UnitDeflection(
        c_12 + share[0] * second, product(share, edges), w, theta, reaction, edges
    )


def mean_ring_weight(
    s_c: Float[Array, ""],
    ring_positions: Float[Array, " n"],
    transition: Float[Array, ""],
    half_width: float,
) -> Float[Array, ""]:
    """`ring_weight`, its mean over the width of the punch.

    The sum over rings of w_i = `on_one_ring` times 1 - w_j of all rings before it, each integrated
    where it is not 0, from kink to kink: exact where no more than two rings reach a point, else
    (`transition` above the ring distance) to less than 1e-3. In units of the width: of absolute
    positions of its edges a narrow one would keep few figures in float32.
    """
    x, n = ring_positions - s_c, ring_positions.shape[0]
    low, high = x - transition, x + transition
    kink = jnp.concatenate([low[:1], high[:-1]])  # where the ring before ends
    edges = jnp.stack([low, jnp.clip(kink, low, high), high])
    edges = jnp.clip(edges / half_width, -1, 1)
    middle, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    points, weights = (jnp.asarray(v, s_c.dtype)[:, None, None] for v in (_POINTS, _WEIGHTS))
    at = half_width * (middle[None] + half[None] * points)
    share = on_one_ring(at - x[None, None], transition)
    for back in range(1, min(n, _REACHING + 1)):
        other = on_one_ring(at[..., back:] - x[None, None, :-back], transition)
        before = [(0, 0), (0, 0), (back, 0)]
        share = share * jnp.pad(1 - other, before, constant_values=1)
    return jnp.sum(jnp.sum(weights * share, axis=0) * half) / 2
