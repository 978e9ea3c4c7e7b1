r"""Friction of several tools that feel each other, each with a return map of its own.

Every tool arrives at a wall that the others move: with C_ij the motion of contact i by the force at
contact j, in components (inward normal, tangent, tangent) of both,

    F_j = S_j(D_j - sum_{i != j} C_ji F_i),

S_j: a step of `friction` on the own block C_jj, so that stick, slide and lift-off are exact for
each. One tool alone is that step. Solved by sweeps over the tools, then by Newton's method; of its
point and one sweep more the one that misses less is kept, so that a corner between stick and slide
does not throw it off. Coulomb's law has no energy: for high friction and strong coupling of normal
and tangent more than one solution may exist, and then the one found depends on the sweeps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import epsilon, largest
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb, Slide, land_and_slide
from jaxtrachea.status import PressStatus

HIGH = jax.lax.Precision.HIGHEST
#: Sweeps with a Newton step each, at most; 2 to 6 are usual.
STEPS = 40


class Stand(NamedTuple):
    """What a step of m tools goes on from.

    Attributes:
        slip: way slid since first touch, mm; shape (m, 2).
        above: height over the wall, mm; 0 in contact; (m,).
        force: of the step before, N, where the search begins; (m, 3).
    """

    slip: Float[Array, "m 2"]
    above: Float[Array, " m"]
    force: Float[Array, "m 3"]


class _Step(NamedTuple):
    """A step of m tools as functions of the forces of all; arguments of `slide_together`."""

    displacement: Float[Array, "m 3"]
    compliance: Float[Array, "m 3 m 3"]
    law: Law
    friction: Coulomb
    before: Stand

    def arrival(self, force, of=slice(None)):
        """Displacement of the tools against the wall that the others move."""
        return self.displacement[of] - moved_by_others(self.compliance, force, of)

    def answer(self, arrived):
        """What each tool does where it arrives: slip and height, and the `Slide`."""
        rest = self._alone()
        return jax.vmap(land_and_slide)(arrived, *rest)

    def force(self, arrived, of=slice(None)):
        """The force of one tool or all, N; zeros where a tool has none."""
        given = jax.tree.map(lambda v: v[of], self._alone())
        answer = land_and_slide if arrived.ndim == 1 else jax.vmap(land_and_slide)
        force = answer(arrived, *given)[1].force
        return jnp.where(jnp.isfinite(force), force, 0)

    def miss(self, force):
        """What the answers differ by from these forces, (m, 3), and the derivative of force - it.

        That is 1 + J C_off with J of the answers by their arrival; shape (3 m, 3 m).
        """

        def one(arrived, *rest):
            force = land_and_slide(arrived, *rest)[1].force
            return force, force

        J, found = jax.vmap(jax.jacfwd(one, has_aux=True))(self.arrival(force), *self._alone())
        known = jnp.isfinite(jnp.sum(found, axis=1))
        found = jnp.where(known[:, None], found, 0)
        J, m = jnp.where(known[:, None, None], J, 0), len(force)
        rows = jnp.einsum("iab,ibjc->iajc", J, _others(self.compliance), precision=HIGH)
        return found - force, jnp.eye(3 * m, dtype=J.dtype) + rows.reshape(3 * m, 3 * m)

    def _alone(self):
        i = jnp.arange(len(self.displacement))
        slip, above, _ = self.before
        return self.compliance[i, :, i], self.law, self.friction, slip, above


def slide_together(
    displacement: Float[Array, "m 3"],
    compliance: Float[Array, "m 3 m 3"],
    law: Law,
    friction: Coulomb,
    before: Stand,
) -> tuple[Stand, Slide]:
    """One step of m tools: stick, slide and lift-off of each, with the forces of all others.

    Derivatives are those of the equilibrium, to first order; one-sided where a tool touches, or
    passes from sticking to sliding.

    Args:
        displacement: of each tool at the end of the step, (inward normal, tangent, tangent) of its
            contact, mm, without what others do to the wall; see `slide_path`.
        compliance: of the skeleton, in the same directions, mm/N; symmetric.
        law: local laws, coefficients of shape (m,); k_1 > 0.
        friction: between each tool and the surface; `mu` of shape (m,).
        before: where the step begins.

    Returns:
        Where it ends, and the `Slide` of each tool. LIFTED: it would touch, but others move the
        wall away. NOT_CONVERGED: no balance was found. If one tool has no solution, none has a
        number, all have its status, and the next step begins where this one did.
    """
    known = jnp.isfinite(jnp.sum(displacement))
    in_air = jnp.array([-1.0, 0.0, 0.0], displacement.dtype)

    def where(solved):
        D = jnp.where(solved, displacement, in_air)
        return _Step(D, jnp.where(solved, compliance, 0), law, friction, before)

    start = jnp.where(known, before.force, 0)
    *found, missed = _balance(*jax.lax.stop_gradient((where(known), start)))
    balanced = missed <= epsilon(start.dtype) ** 0.75
    # No derivative is NaN because of a step without a solution: another one is computed.
    step, balance = where(known & balanced), known & balanced
    force, slope = (
        jnp.where(balance, v, other) for v, other in zip(found, _no_force(start), strict=True)
    )
    force = _follow(step, force, slope)
    (slip, above), found = step.answer(step.arrival(force))
    status = found.status
    failed = jnp.max(jnp.where(_has_number(status), PressStatus.OK, status))
    failed = jnp.where(balanced, failed, PressStatus.NOT_CONVERGED)
    failed = jnp.where(known, failed, PressStatus.NON_FINITE)
    solved = failed == PressStatus.OK
    lifted = (status == PressStatus.NO_CONTACT) & (displacement[:, 0] > 0)
    status = jnp.where(lifted, PressStatus.LIFTED, status)
    after = Stand(slip, above, found.force)
    after = jax.tree.map(lambda new, old: jnp.where(solved, new, old), after, before)
    depth, force, lost = (
        jnp.where(solved, v, jnp.nan) for v in (found.depth, found.force, found.dissipated)
    )
    status = jnp.where(solved, status, failed).astype(jnp.int8)
    sliding = found.sliding & solved
    return after, Slide(depth, force, after.slip, lost, sliding, status, found.began)


def slide_paths(
    displacement: Float[Array, "steps m 3"],
    compliance: Float[Array, "m 3 m 3"],
    law: Law,
    friction: Coulomb,
    lands: Bool[Array, "steps m"] | None = None,
) -> Slide:
    """Follow m tools side by side; see `friction.slide_path`, which this is for one tool.

    Args:
        displacement: of all tools at the end of each step, mm.
        compliance: see `slide_together`; so for the rest.
        law: -
        friction: -
        lands: whether a tool first touches the wall at rest in the step: its way counts from there,
            unless others have raised the wall to it before. There it stands over what they have
            dragged, and above what they have pressed. None: all ways count from the start.

    Returns:
        A `Slide` with leading axes (steps, m); `began` is that of the first contact.
    """
    none = jnp.zeros_like(displacement[0])

    def step(state, row):
        (before, met, began), (D, lands) = state, row
        if lands is not None:
            moved = moved_by_others(compliance, before.force)
            anew = lands & (before.above > 0) & (moved[:, 0] >= 0)
            slip = jnp.where(anew[:, None], -moved[:, 1:], before.slip)
            above = jnp.where(anew, moved[:, 0], before.above)
            before = Stand(slip, above, before.force)
        after, slid = slide_together(D, compliance, law, friction, before)
        began = jnp.where(met[:, None], began, slid.began)
        met = met | (slid.status == PressStatus.OK)
        return (after, met, began), slid._replace(began=began)

    start = Stand(none[:, 1:], none[:, 0], none), jnp.zeros(len(none), bool), none[:, 1:]
    return jax.lax.scan(step, start, (displacement, lands))[1]


def moved_by_others(
    compliance: Float[Array, "m 3 m 3"], force: Float[Array, "m 3"], of=slice(None)
) -> Float[Array, "*m 3"]:
    """Motion of the wall under one tool, or under each, by the forces of all others, mm."""
    return jnp.einsum("...ajb,jb->...a", _others(compliance)[of], force, precision=HIGH)


def _others(compliance):
    """The compliance without the blocks of a contact by itself."""
    one = jnp.eye(len(compliance), dtype=compliance.dtype)
    return compliance * (1 - one)[:, None, :, None]


def _has_number(status):
    return (status == PressStatus.OK) | (status == PressStatus.NO_CONTACT)


def _no_force(force):
    """Of tools in the air: their forces, and the `_Step.miss` of them by these."""
    return jnp.zeros_like(force), jnp.eye(force.size, dtype=force.dtype)


def _balance(step: _Step, start):
    """Forces of all tools, the `_Step.miss` of them by these, and the largest miss over them.

    From a sweep over the tools to a Newton step, and from there by a sweep again. A Newton step
    that does not come closer is left for a second sweep.
    """

    def sweep(force):
        def tool(j, force):
            return force.at[j].set(step.force(step.arrival(force, j), j))

        return jax.lax.fori_loop(0, len(force), tool, force)

    def goes_on(state):
        count, *_, missed, _ = state
        return (count < STEPS) & ~(missed <= 32 * epsilon(start.dtype))

    def newton(state):
        count, best, slope, before, trial = state
        force = sweep(trial)
        miss, new = step.miss(force)
        off, size = (largest(jnp.abs(v).reshape(-1)) for v in (miss, force))
        missed = jnp.where(off > 0, off / jnp.where(size > 0, size, off), 0)
        closer = missed < before
        onward = jnp.where(closer, force + _solve(new, miss), best)
        best, slope = jnp.where(closer, force, best), jnp.where(closer, new, slope)
        return count + 1, best, slope, jnp.where(closer, missed, jnp.inf), onward

    far = jnp.full((), jnp.inf, start.dtype)
    begin = jnp.zeros((), int), start, _no_force(start)[1], far, start
    _, force, slope, missed, _ = jax.lax.while_loop(goes_on, newton, begin)
    return force, slope, missed


@jax.custom_jvp
def _follow(step: _Step, force, slope):
    """The forces in balance, with their derivatives by the step."""
    return force


@_follow.defjvp
def _follow_jvp(primals, tangents):
    step, force, slope = primals
    _, moved = jax.jvp(lambda step: step.force(step.arrival(force)), (step,), (tangents[0],))
    return force, _solve(slope, moved)


def _solve(matrix, force):
    return jnp.linalg.solve(matrix, force.reshape(-1)).reshape(force.shape)
