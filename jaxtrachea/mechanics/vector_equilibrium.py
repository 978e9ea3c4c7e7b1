"""Local indentation and skeleton displacement together, as vectors (oblique press).

The vector companion of `equilibrium`, in any frame of reference. The local force is parallel to the
local indentation, F = kappa d with the law's secant stiffness kappa, k_1 + k_3 |d|^2 (paper eq. 1),
and k_5 |d|^4 where it is given, so that (1 + kappa C) d = D is linear once kappa is known.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon, largest, product, solve_spd
from jaxtrachea.mechanics.equilibrium import status_of
from jaxtrachea.mechanics.force_law import Law, fold_depth
from jaxtrachea.status import PressStatus

#: Tangent steps of `press_vector`; 6 leave rounding whatever C and the law (test_any_compliance).
STEPS = 8


class VectorEquilibrium(NamedTuple):
    """Solved oblique press.

    Attributes:
        depth: local indentation d, mm; shape (3,).
        force: contact force, N; shape (3,). NaN where there is no stable solution.
        status: a `PressStatus` as int8.
    """

    depth: Float[Array, "3"]
    force: Float[Array, "3"]
    status: Int[Array, ""]


def press_vector(
    displacement: Float[Array, "3"], compliance: Float[Array, "3 3"], law: Law
) -> VectorEquilibrium:
    """Series coupling: d + C F = D with F = kappa(|d|^2) d; odd in D (press or draw).

    1 / |(1 + kappa C)^-1 D| is a concave function of kappa (a power mean of the 1 + kappa c_i).
    Each step replaces it by its tangent a + b kappa and solves |d| (a + b kappa) = 1, the law in
    series with one number (`Law.root`). The tangent lies above, so |d| rises from below and needs
    no safeguard; for D along an axis of C the first step is exact and the answer that of
    `press_series`.

    Unique for a law that nowhere softens. Else (k_3 < 0 or k_5 < 0) the branch from D = 0 is
    followed up to its fold, beyond which depth and force are NaN and the status is PAST_FOLD. For a
    law that softens and then hardens (k_3 < 0 < k_5) the fold is that of the tangents, which is the
    branch's own for D along an axis of C only: of 10,000 random presses 8 were refused whose branch
    has no fold, and 26 solved beyond a dip that the tangents pass over: a stable equilibrium, the
    first for this D, into which the contact snaps. Derivatives are those of the equilibrium.

    Args:
        displacement: D after first touch, mm.
        compliance: C, skeleton at the contact, mm/N, symmetric and positive semi-definite.
        law: local law; k_1 > 0.
    """
    depth, force = _series(displacement, compliance, law)
    given = jnp.sum(displacement) + jnp.sum(compliance) + sum(law.coefficients().values())
    folded = law.softens() & jnp.isfinite(given) & ~jnp.isfinite(jnp.sum(depth))
    status = status_of(largest(jnp.abs(displacement)), jnp.sum(depth + force), folded)
    return VectorEquilibrium(depth, force, status)


def press_vector_total(
    displacement: Float[Array, "3"], compliance: Float[Array, "3 3"], law: Law
) -> VectorEquilibrium:
    """Total coupling, as printed: F = Duffing(|D|) along D; the local part is D - C F.

    NEGATIVE_LOCAL where the skeleton moves further along the force than the tool. NaN past the
    law's own fold.

    Args: as `press_vector`.
    """
    squared = jnp.sum(displacement * displacement)
    folded = law.softens() & (squared >= fold_depth(law) ** 2)
    known = jnp.isfinite(squared)
    moved = jnp.where(known, displacement, 0)
    force = _force(moved, law)
    depth = moved - product(compliance, force)
    result = jnp.where(known, jnp.sum(depth + force), jnp.nan)
    status = status_of(largest(jnp.abs(displacement)), result, folded)
    negative = (status == PressStatus.OK) & (jnp.sum(depth * force) < 0)
    status = jnp.where(negative, PressStatus.NEGATIVE_LOCAL, status).astype(jnp.int8)

    def hide(v):
        return jnp.where(folded | ~known, jnp.nan, v)

    return VectorEquilibrium(hide(depth), hide(force), status)


def _force(depth, law: Law):
    return law.secant(jnp.sum(depth * depth)) * depth


def _secant_motion(direction, compliance, kappa):
    """M^-1 D and M^-2 D with M = 1 + kappa C."""
    M = jnp.eye(3, dtype=direction.dtype) + kappa * compliance
    once = solve_spd(M, direction)
    return once, solve_spd(M, once)


@jax.custom_jvp
def _series(displacement, compliance, law: Law):
    """Local indentation and force of `press_vector`; NaN past the fold."""
    size = largest(jnp.abs(displacement))
    still = size == 0
    direction = jnp.where(still, 1, displacement / jnp.where(still, 1, size))
    scaled = law.in_unit(size)

    def tangent_step(_, t):
        d, e = _secant_motion(direction, compliance, scaled.secant(t * t))
        length = jnp.linalg.norm(d)
        # 1/|d| = a + b kappa, neither formed by a subtraction; a t + b t kappa(t) = 1.
        a, b = jnp.sum(d * e) / length**3, jnp.sum(d * product(compliance, e)) / length**3
        return scaled.root(jnp.ones_like(a), b, a)

    t = jax.lax.fori_loop(0, STEPS, tangent_step, jnp.zeros_like(size))
    d, _ = _secant_motion(direction, compliance, scaled.secant(t * t))
    missed = jnp.abs(jnp.linalg.norm(d) - t) > 100 * epsilon(t.dtype) * t
    depth = jnp.where(law.softens() & missed, jnp.nan, size * d)
    return depth, _force(depth, law)


@_series.defjvp
def _series_jvp(primals, tangents):
    """(1 + C (kappa + 2 kappa' d d^T)) d' = D' - C' F - C f, by the secant system and rank one.

    kappa' is the derivative of kappa by |d|^2, and f the growth of F at fixed d, along d. F' is not
    formed from d', where f and C f would cancel on a soft skeleton. Where there is no solution
    it is that at rest: whoever takes another value there (sliding, for sticking) gets no NaN.
    """
    _, compliance, law = primals
    d_displacement, d_compliance, d_law = tangents
    solution = _series(*primals)
    depth, force = (jnp.where(jnp.isfinite(jnp.sum(solution[0])), v, 0) for v in solution)
    squared = jnp.sum(depth * depth)
    kappa, stiffening = jax.jvp(law.secant, (squared,), (jnp.ones_like(squared),))
    grown = d_law.secant(squared)
    M = jnp.eye(3, dtype=depth.dtype) + kappa * compliance
    y, z = solve_spd(M, d_displacement - product(d_compliance, force)), solve_spd(M, depth)
    v = product(compliance, z)
    share = 1 / (1 + 2 * stiffening * jnp.sum(depth * v))
    along = 2 * stiffening * share * jnp.sum(depth * y)
    d_depth = y - along * v
    d_force = kappa * d_depth + along * depth + (grown * share) * z
    return solution, (d_depth - (grown * share) * v, d_force)
