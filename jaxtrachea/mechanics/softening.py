r"""A skeleton that softens in pressing and stiffens in a draw: one scalar law for its deflection.

The arch of the wall flattens under the tool. Seen from the contact, the skeleton of compliance c
(small strain) answers a deflection u with

    F c = g(u) = u (1 - e_1 u + e_2 u^2),

not odd: u > 0 is a press, u < 0 a draw. In series with the local law: d + u = D, c F(d) = g(u).

Followed as far as either part carries more when it moves further: the local law up to its fold, the
skeleton up to the first zero of g' = 1 - 2 e_1 u + 3 e_2 u^2 (none where e_1^2 <= 3 e_2). Up to
there the equilibrium is unique; past it the status is PAST_FOLD. A local law that softens is
thereby followed less far than in series with a linear skeleton.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import epsilon, first_positive_root, newton_tolerance, rising_root
from jaxtrachea.mechanics.force_law import Law, fold_depth


class Softening(NamedTuple):
    """How the stiffness of the skeleton changes with its own deflection.

    Attributes:
        e_1: 1/mm; positive: a press softens.
        e_2: 1/mm^2.
    """

    e_1: Float[Array, "..."]
    e_2: Float[Array, "..."]

    def linear(self, deflection: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Compliance times force, mm: what a linear skeleton would deflect under the same force."""
        return deflection * self.ratio(deflection)

    def ratio(self, deflection: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Secant stiffness over that at small strain."""
        return 1 + deflection * (self.e_2 * deflection - self.e_1)

    def energy_ratio(self, deflection: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Energy stored at a deflection over that of a linear skeleton at the same deflection."""
        return 1 + deflection * (self.e_2 / 2 * deflection - 2 / 3 * self.e_1)

    def tangent(self, deflection: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Derivative of `linear`."""
        return 1 + deflection * (3 * self.e_2 * deflection - 2 * self.e_1)


class SoftSeries(NamedTuple):
    """Local law and softening skeleton in series, one entry per displacement.

    Attributes:
        depth: local indentation, mm; NaN past the fold and of a row that is not finite, like all
            here.
        deflection: of the skeleton at C, mm.
        force: N.
        folded: whether the displacement lies past the fold.
    """

    depth: Float[Array, "*n"]
    deflection: Float[Array, "*n"]
    force: Float[Array, "*n"]
    folded: Bool[Array, "*n"]


def soft_series(
    displacement: Float[Array, "*n"],
    compliance: Float[Array, "..."],
    law: Law,
    softening: Softening,
) -> SoftSeries:
    """Solve d + u = D, c F(d) = g(u) on the branch through 0, see the module.

    Derivatives, forward and reverse and to any order, are those of the equilibrium. Depth and
    deflection are both accurate relative to themselves, however much smaller one is.

    Args:
        displacement: D, mm; any shape.
        compliance: c of the skeleton at small strain, mm/N, not negative; broadcasts against D.
        law: local law; k_1 > 0.
        softening: of the skeleton.
    """
    depth, deflection, force, folded = _solved(displacement, compliance, law, softening)
    return SoftSeries(depth=depth, deflection=deflection, force=force, folded=folded)


@jax.custom_jvp
def _solved(displacement, compliance, law: Law, softening: Softening):
    displacement, compliance = jnp.broadcast_arrays(displacement, compliance)
    return _newton(displacement, compliance, law, softening)


@_solved.defjvp
def _solved_jvp(primals, tangents):
    _, compliance, law, softening = primals
    dD, dc, d_law, d_softening = tangents
    depth, u, force, folded = _solved(*primals)
    # A row without a solution has derivative 0, so that what all rows share keeps its own.
    solved = jnp.isfinite(force)
    used = depth, u, force, compliance, law, softening
    d, v, F, compliance, law, softening = jax.tree.map(lambda x: jnp.where(solved, x, 0), used)
    slope, rise = law.tangent(d), softening.tangent(v)
    share = jnp.where(solved, 1 / (rise + compliance * slope), 0)
    grown = d * d_law.secant(d * d)
    bent = v * v * (v * d_softening.e_2 - d_softening.e_1)
    du = share * (compliance * (slope * dD + grown) + F * dc - bent)
    d_force = share * (rise * (slope * dD + grown) + slope * (bent - F * dc))
    # Not dD - du, which cancels where the skeleton is soft.
    d_depth = share * (rise * dD + bent - F * dc - compliance * grown)
    none = jnp.zeros(folded.shape, jax.dtypes.float0)
    return (depth, u, force, folded), (d_depth, du, d_force, none)


def _newton(displacement, compliance, law: Law, softening: Softening):
    """Depth, deflection, force and fold by Newton steps for the deflection, in a bracket."""
    draw = displacement < 0
    known = jnp.isfinite(displacement) & jnp.isfinite(compliance)
    for value in jax.tree.leaves((law, softening)):
        known = known & jnp.isfinite(value)
    D = jnp.where(known, jnp.abs(displacement), 0)
    c = jnp.where(known, compliance, 0)
    e_1, e_2 = (jnp.asarray(e, D.dtype) for e in softening)
    soft = Softening(jnp.where(draw, -e_1, e_1), jnp.broadcast_to(e_2, D.shape))
    limit = first_positive_root(jnp.ones_like(D), -2 * soft.e_1, 3 * soft.e_2)
    low = jnp.maximum(D - fold_depth(law), 0)
    high = jnp.minimum(D, limit)

    def excess(u):
        return soft.linear(u) - c * law.force(D - u)

    solvable = (low <= high) & (excess(low) <= 0) & (excess(high) >= 0)

    def excess_and_slope(u):
        return excess(u), soft.tangent(u) + c * law.tangent(D - u)

    def least_step(u):
        # Not below the rounding of u itself; `_polished` does the rest.
        return jnp.maximum(
            newton_tolerance(D.dtype) * jnp.minimum(u, D - u), 4 * epsilon(D.dtype) * D
        )

    linear = c * law.k_1
    start = jnp.clip(D * (linear / (1 + linear)), low, jnp.maximum(low, high))
    u = rising_root(excess_and_slope, least_step, start, low, high, solvable & (D > 0))
    depth, u, force = _polished(D, c, law, soft, u)
    sign = jnp.where(draw, -1, 1)
    out = (jnp.where(solvable & known, sign * v, jnp.nan) for v in (depth, u, force))
    return *out, ~solvable & known


def _polished(D, c, law: Law, soft: Softening, u):
    """The smaller of depth and deflection is a difference: once more from the force of the other.

    Newton's step for one is exact to rounding, since its start is right to half the digits.
    """
    depth = D - u
    by_skeleton = u > depth
    c_safe = jnp.where(by_skeleton, c, 1)
    force = jnp.where(by_skeleton, soft.linear(u) / c_safe, law.force(depth))
    slope = law.tangent(jnp.where(by_skeleton, depth, 0))
    better_depth = depth - (law.force(depth) - force) / slope
    better_u = u - (soft.linear(u) - c * force) / soft.tangent(u)
    return (
        jnp.where(by_skeleton, better_depth, depth),
        jnp.where(by_skeleton, u, better_u),
        force,
    )
