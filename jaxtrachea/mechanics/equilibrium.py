"""Local indentation and skeleton deflection together (normal press).

The only place where contact force and deflection are solved for at once. Both couplings are closed
forms up to one scaled cubic (`_numerics.cubic_ratio`); derivatives are those of the equilibrium.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import cubic_ratio
from jaxtrachea.mechanics.force_law import Law, duffing, fold_depth
from jaxtrachea.status import PressStatus


class Equilibrium(NamedTuple):
    """Solved press, one entry per tool displacement.

    Attributes:
        depth: local indentation d, mm.
        force: contact force, N. NaN where `status` says there is no stable solution.
        status: a `PressStatus` as int8.
    """

    depth: Float[Array, "*n"]
    force: Float[Array, "*n"]
    status: Int[Array, "*n"]


class Sensitivity(NamedTuple):
    """Derivatives of the contact force, one entry per tool displacement.

    Attributes:
        displacement: N/mm.
        compliance: N^2/mm.
        k_1: mm.
        k_3: mm^3.
    """

    displacement: Float[Array, "*n"]
    compliance: Float[Array, "*n"]
    k_1: Float[Array, "*n"]
    k_3: Float[Array, "*n"]


def press_series(
    displacement: Float[Array, "*n"], compliance: Float[Array, ""], law: Law
) -> Equilibrium:
    """Series coupling: displacement = local indentation + skeleton deflection.

    (1 + c k_1) d + c k_3 d^3 = D, solved as d = delta g(u) with delta = D / (1 + c k_1) and
    u = 27/4 c k_3 / (1 + c k_1) delta^2. Unique for k_3 >= 0; for k_3 < 0 stable up to the fold of
    the coupled problem, u = -1, beyond which depth and force are NaN.

    Args:
        displacement: D after first touch, mm; any shape.
        compliance: c, deflection of the skeleton at C per unit force, mm/N, not negative.
        law: local law; k_1 > 0.
    """
    depth, force = _series(displacement, compliance, law.k_1, law.k_3)
    u = _scaled_cubic(displacement, compliance, law.k_1, law.k_3)[1]
    return Equilibrium(depth, force, status_of(displacement, depth + force, u <= -1))


def _scaled_cubic(displacement, compliance, k_1, k_3):
    """The scaled displacement delta and the argument u of `press_series`."""
    stiffening = 1 + compliance * k_1
    delta = displacement / stiffening
    return delta, 6.75 * (compliance * k_3 / stiffening) * delta * delta


@jax.custom_jvp
def _series(displacement, compliance, k_1, k_3):
    """Indentation and force of `press_series`, with the derivatives of the equilibrium d + c F = D.

    Both are differentiated here: the derivative of F(d) by the law would be the difference of its
    growth at fixed d and of the growth of c F, which cancel on a soft skeleton.
    """
    delta, u = _scaled_cubic(displacement, compliance, k_1, k_3)
    depth = delta * cubic_ratio(u)
    return depth, duffing(depth, Law(k_1, k_3))


@_series.defjvp
def _series_jvp(primals, tangents):
    _, compliance, k_1, k_3 = primals
    d_displacement, d_compliance, d_k_1, d_k_3 = tangents
    depth, force = _series(*primals)
    d2 = depth * depth
    slope = k_1 + 3 * k_3 * d2
    share = 1 / (1 + compliance * slope)
    pushed = share * (d_displacement - force * d_compliance)
    grown = depth * (d_k_1 + d2 * d_k_3)
    return (depth, force), (pushed - (compliance * share) * grown, slope * pushed + share * grown)


def sensitivity(depth: Float[Array, "*n"], compliance: Float[Array, ""], law: Law) -> Sensitivity:
    """Derivatives of the contact force at a solved press (series coupling; total: compliance 0).

    What `jax.jvp` of `press_series` gives, for callers that want every derivative from one depth.
    """
    d2 = depth * depth
    slope = law.k_1 + 3 * law.k_3 * d2
    share = 1 / (1 + compliance * slope)
    passed = depth * share
    return Sensitivity(
        slope * share, -slope * (law.k_1 + law.k_3 * d2) * passed, passed, d2 * passed
    )


def press_total(
    displacement: Float[Array, "*n"], compliance: Float[Array, ""], law: Law
) -> Equilibrium:
    """Total coupling, as printed in the paper: F = Duffing(D) with D the whole displacement of C.

    The local part is D - c F and can come out negative (status NEGATIVE_LOCAL). Force-displacement
    data then say nothing about the skeleton. NaN past the law's own fold.

    Args: as `press_series`.
    """
    folded = (jnp.abs(displacement) >= fold_depth(law)) & (law.k_3 < 0)
    force = duffing(displacement, law)
    depth = displacement - compliance * force
    negative = depth * displacement < 0
    status = status_of(displacement, depth + force, folded)
    status = jnp.where((status == PressStatus.OK) & negative, PressStatus.NEGATIVE_LOCAL, status)
    hide = lambda v: jnp.where(folded, jnp.nan, v)  # noqa: E731
    return Equilibrium(hide(depth), hide(force), status.astype(jnp.int8))


def status_of(displacement, result, folded) -> Int[Array, "..."]:
    """PAST_FOLD, NO_CONTACT, NON_FINITE or OK."""
    status = jnp.where(displacement == 0, PressStatus.NO_CONTACT, PressStatus.OK)
    status = jnp.where(jnp.isfinite(result), status, PressStatus.NON_FINITE)
    return jnp.where(folded, PressStatus.PAST_FOLD, status).astype(jnp.int8)
