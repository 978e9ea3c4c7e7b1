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

from jaxtrachea._numerics import epsilon
from jaxtrachea.mechanics.force_law import Law, fold_depth
from jaxtrachea.mechanics.roots import (
    Rising,
    first_positive_root,
    newton_tolerance,
    rising_root,
)


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
    """Depth, deflection, force and fold, by Newton steps for the deflection."""
    known = jnp.isfinite(displacement) & jnp.isfinite(compliance)
    for value in jax.tree.leaves((law, softening)):
        known = known & jnp.isfinite(value)
    e_1, e_2 = (jnp.asarray(e, displacement.dtype) for e in softening)
    softening = Softening(*jnp.broadcast_arrays(e_1, e_2))
    # Each by itself: what rows share stays one number.
    D, c = (jnp.where(jnp.isfinite(v), v, 0) for v in (displacement, compliance))
    u = rising_root(lambda D, c: _equation(D, c, law, softening), D, c, steps=4)
    folded = jnp.isnan(u) & known
    depth, u, force = (jnp.where(known, v, jnp.nan) for v in _polished(D, c, law, softening, u))
    return depth, u, force, folded


def _equation(D, c, law: Law, softening: Softening) -> Rising:
    """g(u) - c F(D - u) = 0, rising between 0 and D where neither part is past its fold."""
    law_top = fold_depth(law)
    e_1, e_2 = softening
    low = jnp.maximum(jnp.maximum(jnp.minimum(D, 0), D - law_top), -_fold(-e_1, e_2))
    high = jnp.minimum(jnp.minimum(jnp.maximum(D, 0), D + law_top), _fold(e_1, e_2))

    def excess(u):
        return softening.linear(u) - c * law.force(D - u)

    def excess_and_slope(u):
        return excess(u), softening.tangent(u) + c * law.tangent(D - u)

    def least_step(u):
        # Not below the rounding of u itself; `_polished` does the rest.
        small = jnp.minimum(jnp.abs(u), jnp.abs(D - u))
        return jnp.maximum(newton_tolerance(D.dtype) * small, 4 * epsilon(D.dtype) * jnp.abs(D))

    linear = c * law.k_1
    start = D * (linear / (1 + linear))
    solvable = (low <= high) & (excess(low) <= 0) & (excess(high) >= 0)
    of_row = jnp.broadcast_arrays(start, low, high, solvable)
    return Rising(excess_and_slope, least_step, *of_row)


def _fold(e_1, e_2):
    """First deflection u > 0 at which the skeleton carries no more, mm; inf where it nowhere is."""
    return first_positive_root(jnp.ones_like(e_1), -2 * e_1, 3 * e_2)


def _polished(D, c, law: Law, softening: Softening, u):
    """One Newton step more, taken by the smaller of depth and deflection, which is a difference.

    It is exact to rounding, since its start is right to half the digits. By the slope of both parts
    together: that of one alone vanishes at its fold.
    """
    depth = D - u
    by_skeleton = jnp.abs(u) > jnp.abs(depth)
    excess = softening.linear(u) - c * law.force(depth)
    step = excess / (softening.tangent(u) + c * law.tangent(depth))
    small = jnp.where(by_skeleton, depth + step, u - step)
    depth, u = jnp.where(by_skeleton, small, D - small), jnp.where(by_skeleton, D - small, small)
    by_law = law.force(depth)
    by_bend = softening.linear(u) * (1 / jnp.where(c > 0, c, 1))
    return depth, u, jnp.where(by_skeleton, by_bend, by_law)
