"""Local indentation and skeleton deflection together (normal press).

The only place where contact force and deflection are solved for at once; derivatives are those of
the equilibrium. What the local law is, this module does not know: it asks the law.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.mechanics.force_law import Law, fold_depth
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.status import PressStatus


class Equilibrium(NamedTuple):
    """Solved press, one entry per tool displacement.

    Attributes:
        depth: local indentation d, mm.
        force: contact force, N. NaN where `status` says there is no stable solution.
        status: a `PressStatus` as int8.
        load: force of small strain, N: what the skeleton and its joints follow. None where nothing
            softens: the force.
    """

    depth: Float[Array, "*n"]
    force: Float[Array, "*n"]
    status: Int[Array, "*n"]
    load: Float[Array, "*n"] | None = None


def press_series(
    displacement: Float[Array, "*n"], compliance: Float[Array, ""], law: Law
) -> Equilibrium:
    """Series coupling: displacement = local indentation + skeleton deflection, `Law.series`.

    For two coefficients (1 + c k_1) d + c k_3 d^3 = D, solved as d = delta g(u) with
    delta = D / (1 + c k_1) and u = 27/4 c k_3 / (1 + c k_1) delta^2. Unique for k_3 >= 0; a law
    that softens is stable up to the fold of the coupled problem (u = -1), beyond which depth and
    force are NaN.

    Args:
        displacement: D after first touch, mm; any shape.
        compliance: c, deflection of the skeleton at C per unit force, mm/N, not negative.
        law: local law; k_1 > 0.
    """
    depth, force, folded = law.series(displacement, compliance)
    return Equilibrium(depth, force, status_of(displacement, depth + force, folded))


def press_softening(
    displacement: Float[Array, "*n"],
    compliance: Float[Array, ""],
    law: Law,
    softening: Softening,
) -> Equilibrium:
    """Series coupling of a tube that softens, see `mechanics.softening`.

    Args:
        displacement: D after first touch, mm; any shape.
        compliance: c of the skeleton at small strain, mm/N, not negative.
        law: local law; k_1 > 0.
    """
    e_1, e_2 = (jnp.asarray(e, displacement.dtype) for e in softening)
    displacement, e_1, e_2 = jnp.broadcast_arrays(displacement, e_1, e_2)
    known = jnp.isfinite(displacement) & jnp.isfinite(e_1) & jnp.isfinite(e_2)
    softening = Softening(jnp.where(known, e_1, 0), jnp.where(known, e_2, 0))
    past = softening.past_peak(displacement)
    depth, load, folded = law.series(jnp.where(past, 0, displacement), compliance)
    folded = (folded | past) & known
    # Of a row without a solution 0 times NaN would reach what all share: hidden at the end.
    solved = known & ~folded & jnp.isfinite(load)
    ratio = softening.ratio(jnp.where(solved, displacement, 0))
    force = jnp.where(solved, ratio * jnp.where(solved, load, 0), jnp.nan)
    depth, load = (jnp.where(solved, v, jnp.nan) for v in (depth, load))
    status = status_of(displacement, force, folded)
    return Equilibrium(depth, force, status, load)


def sensitivity(
    solved: Equilibrium,
    compliance: Float[Array, ""],
    law: Law,
    softening: Softening | None = None,
) -> tuple[dict[str, Float[Array, "*n"]], dict[str, Float[Array, "*n"]]]:
    """Derivatives of force and load at a solved press (series coupling; total: compliance 0).

    What `jax.jvp` of `press_series` or `press_softening` gives, for callers that want every
    derivative from one solution.

    Returns:
        Of the contact force and of the load (`Equilibrium.load`), N, each by the name of what it is
        taken by: `displacement`, `compliance`, the coefficients of the law and of the softening.
    """
    depth = solved.depth
    slope, powered = law.tangent(depth), law.powers(depth)
    if softening is None or solved.load is None:
        share = 1 / (1 + compliance * slope)
        force = law.secant(depth * depth) * depth
        by = {"displacement": slope * share, "compliance": -slope * force * share}
        by |= {name: share * v for name, v in powered.items()}
        return by, by
    load = solved.load
    D = depth + compliance * load
    ratio, share = softening.ratio(D), 1 / (1 + compliance * slope)
    of_load = {"displacement": slope * share, "compliance": -slope * load * share}
    of_load |= {name: share * v for name, v in powered.items()}
    of_force = {name: ratio * v for name, v in of_load.items()}
    of_force["displacement"] += softening.slope(D) * load
    of_force |= {"e_1": -D * load, "e_2": D * D * load}
    zero = jnp.zeros_like(load)
    return of_force, of_load | {"e_1": zero, "e_2": zero}


def press_total(
    displacement: Float[Array, "*n"], compliance: Float[Array, ""], law: Law
) -> Equilibrium:
    """Total coupling, as printed in the paper: F = law(D) with D the whole displacement of C.

    The local part is D - c F and can come out negative (status NEGATIVE_LOCAL). Force-displacement
    data then say nothing about the skeleton. NaN past the law's own fold.

    Args: as `press_series`.
    """
    folded = (jnp.abs(displacement) >= fold_depth(law)) & law.softens()
    known = jnp.isfinite(displacement)
    moved = jnp.where(known, displacement, 0)
    force = law.force(moved)
    depth = moved - compliance * force
    negative = depth * moved < 0
    status = status_of(displacement, jnp.where(known, depth + force, jnp.nan), folded)
    status = jnp.where((status == PressStatus.OK) & negative, PressStatus.NEGATIVE_LOCAL, status)

    def hide(v):
        return jnp.where(folded | ~known, jnp.nan, v)

    return Equilibrium(hide(depth), hide(force), status.astype(jnp.int8))


def status_of(displacement, result, folded) -> Int[Array, "..."]:
    """PAST_FOLD, NO_CONTACT, NON_FINITE or OK."""
    status = jnp.where(displacement == 0, PressStatus.NO_CONTACT, PressStatus.OK)
    status = jnp.where(jnp.isfinite(result), status, PressStatus.NON_FINITE)
    return jnp.where(folded, PressStatus.PAST_FOLD, status).astype(jnp.int8)
