r"""Local law and skeleton relax apart: branches of their own, one equilibrium a sample.

Both parts are as in `relaxation.filter`, the local law with the elastic force e(d) and the
skeleton with y = u / c. At the end of a step both carry the contact force,

    F = A e(d) + B = A_s y + B_s,   d + c y = D,

so d + (c A / A_s) e(d) = D - c (B - B_s) / A_s: the law in series with another compliance, and a
displacement that is shifted (`Law.series`). A unilateral contact lets go where F < 0: the tool has
left, and either part recovers by itself, e = -B / A and y = -B_s / A_s.

Of parts with the same branches the force is that of `relax` of the elastic press.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import added
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.relaxation.steps import (
    Branches,
    differentiable_in_lanes,
    factors,
    fading,
)


class Parts(NamedTuple):
    """A press in time, one entry per sample.

    Attributes:
        force: N.
        depth: local indentation, mm; where the tool has left, of the surface as it is.
        load: elastic force of the skeleton, N, which C and the joints follow.
        folded: whether the press is past the fold; it and all later ones are NaN.
    """

    force: Float[Array, " N"]
    depth: Float[Array, " N"]
    load: Float[Array, " N"]
    folded: Bool[Array, " N"]


def relax_parts(
    time: Float[Array, " N"],
    displacement: Float[Array, " N"],
    compliance: Float[Array, ""],
    law: Law,
    local: Branches,
    skeleton: Branches,
    unilateral: bool = True,
) -> Parts:
    """Press in time, from rest before the first sample; of second order in the step.

    Args:
        time: s, never falling; padding as in `relax`.
        displacement: D after first touch, mm.
        compliance: c of the skeleton, mm/N, in the long run.
        law: local law, in the long run.
        local: branches of the local law.
        skeleton: branches of the skeleton, all of it alike.
        unilateral: the contact lets go where it would pull (static).
    """
    loop = _unilateral if unilateral else _bonded
    parts = [(*fading(time, part), part.gamma) for part in (local, skeleton)]
    return Parts(*loop(*parts, displacement, compliance, law))


class Directions(NamedTuple):
    """Changes of what `relax_parts` reads, in K directions.

    Attributes:
        displacement: mm; (K, N).
        compliance: mm/N; (K,).
        law: of its coefficients; (K,) each.
        local: of gamma and tau of the branches; (K, B) each.
        skeleton: likewise.
    """

    displacement: Float[Array, "K N"]
    compliance: Float[Array, " K"]
    law: Law
    local: Branches
    skeleton: Branches


def relax_parts_with_derivatives(
    time: Float[Array, " N"],
    displacement: Float[Array, " N"],
    compliance: Float[Array, ""],
    law: Law,
    branches: tuple[Branches, Branches],
    along: Directions,
    unilateral: bool = True,
) -> tuple[Parts, Float[Array, "K N"], Float[Array, "K N"]]:
    """`relax_parts`, and derivatives of force and load, carried beside it.

    Args:
        time: s; as in `relax_parts`, with the next three.
        displacement: mm.
        compliance: mm/N.
        branches: of the local law and of the skeleton.
        along: directions of the derivatives.
        unilateral: as in `relax_parts` (static).
    """
    parts = [(*fading(time, part), part.gamma) for part in branches]
    local, skeleton = (
        # A branch that never relaxes has no change of log tau.
        Branches(d.gamma.T, jnp.where(d.tau == 0, 0, d.tau / part.tau[None]).T)
        for d, part in zip((along.local, along.skeleton), branches, strict=True)
    )
    samples = along.displacement.T
    along = along._replace(displacement=samples, local=local, skeleton=skeleton)
    run = _with_derivatives if unilateral else _bonded_with_derivatives
    found, d_force, d_load = run(*parts, displacement, compliance, law, along)
    return Parts(*found), d_force.T, d_load.T


def way_of(load: Float[Array, " N"], compliance: Float[Array, ""], law: Law) -> Float[Array, " N"]:
    """Way of an elastic press whose skeleton is as deflected, mm; NaN past the fold of the law.

    Of parts that relax alike it is the way of the tool. Where they relax apart the skeleton is
    deflected more or less than that says, and with it the shape that softens.
    """
    return compliance * load + law.under(load)


def _loop(local, skeleton, displacement, compliance, law: Law, unilateral: bool = True):
    """Force, depth, load and fold; arrays may have lanes as their last axis.

    Args:
        local: x, lost and gamma of the local law, see `relaxation.steps`.
        skeleton: those of the skeleton.
        displacement: (N, *lanes).
    """
    (x, lost, gamma), (x_s, lost_s, gamma_s) = local, skeleton

    def step(state, sample):
        (x, lost), (x_s, lost_s), D = sample
        fading = factors(x, lost, gamma), factors(x_s, lost_s, gamma_s)
        return one_sample(state, fading, D, compliance, law, unilateral)

    zero = jnp.zeros_like(displacement[0])
    start = (zero,) * gamma.shape[0], zero, (zero,) * gamma_s.shape[0], zero
    return jax.lax.scan(step, start, ((x, lost), (x_s, lost_s), displacement))[1]


def one_sample(before, fading, displacement, compliance, law: Law, unilateral: bool):
    """What is remembered after a sample; its force, depth, load and fold.

    Args:
        before: what the branches of the local law carry, its elastic force, and the same of the
            skeleton, N.
        fading: `factors` of the local law, and of the skeleton.
        displacement: after first touch, mm.
    """
    h, e, q, y = before
    (kept, _, share), (kept_s, _, share_s) = fading
    A, B = 1 + added(share), _carried(kept, share, h, e)
    A_s, B_s = 1 + added(share_s), _carried(kept_s, share_s, q, y)
    solved = law.series(displacement - compliance * ((B - B_s) / A_s), compliance * (A / A_s))
    force, new, depth = A * solved.force + B, solved.force, solved.depth
    if unilateral:
        left = force < 0
        alone = jnp.where(left, -B / A, 0)
        force, new = jnp.where(left, 0, force), jnp.where(left, alone, new)
        depth = jnp.where(left, law.under(alone), depth)
    load = (force - B_s) / A_s
    h = tuple(E * h + P * (new - e) for E, P, h in zip(kept, share, h, strict=True))
    q = tuple(E * q + P * (load - y) for E, P, q in zip(kept_s, share_s, q, strict=True))
    return (h, new, q, load), (force, depth, load, solved.folded)


def _carried(kept, share, h, e):
    """B: what a step carries over of a part."""
    return added(E * h - P * e for E, P, h in zip(kept, share, h, strict=True))


def _bonded_loop(*given):
    return _loop(*given, unilateral=False)


_unilateral = differentiable_in_lanes(_loop)
_bonded = differentiable_in_lanes(_bonded_loop)


def _part_with_derivatives(sample, state, gamma, d_gamma, d_log_tau):
    """What a step carries of a part, see `_loop`, and the derivatives of that."""
    (x, lost), (h, e, dh, de), count = sample, state, range(gamma.shape[0])
    kept, mean, share = jax.lax.optimization_barrier(factors(x, lost, gamma))
    # E by log tau is x E, P is P - gamma E.
    d_kept = [d_log_tau[b] * (x[b] * kept[b])[None] for b in count]
    d_share = [
        d_gamma[b] * mean[b][None] + d_log_tau[b] * (share[b] - gamma[b] * kept[b])[None]
        for b in count
    ]
    d_B = added(
        d_kept[b] * h[b][None] + kept[b][None] * dh[b] - d_share[b] * e[None] - share[b][None] * de
        for b in count
    )
    found = 1 + added(share), _carried(kept, share, h, e), added(d_share), d_B
    return jax.lax.optimization_barrier(((kept, share, d_kept, d_share), *found))


def _after(parts, state, new, d_new):
    """The state of a part after a step to another elastic force."""
    h, before, dh, d_before = state
    moved, d_moved = new - before, d_new - d_before
    own = [*zip(*parts, h, dh, strict=True)]
    h = tuple(E * a + P * moved for E, P, _, _, a, _ in own)
    dh = tuple(
        dE * a[None] + E[None] * da + dP * moved[None] + P[None] * d_moved
        for E, P, dE, dP, a, da in own
    )
    return h, new, dh, d_new


def _loop_with_derivatives(
    local,
    skeleton,
    displacement,
    compliance,
    law: Law,
    along: Directions,
    unilateral: bool = True,
):
    """`_loop`, and derivatives of force and load in K directions; lanes as there.

    Those of the equilibrium of a step. What several results read is stored (the barriers): XLA
    would compute it anew for each of them.

    Args:
        local: see `_loop`, with the next four.
        displacement: (N, *lanes).
        along: changes, of gamma and of log tau each (B, K, *lanes), of the displacement
            (N, K, *lanes), of compliance and coefficients (K, *lanes).
    """
    (x, lost, gamma), (x_s, lost_s, gamma_s) = local, skeleton
    barrier = jax.lax.optimization_barrier
    d_law = list(along.law.coefficients().values())

    def step(state, sample):
        mine, its = state
        own, other, D, d_D = sample
        parts, A, B, d_A, d_B = _part_with_derivatives(own, mine, gamma, *along.local)
        parts_s, A_s, B_s, d_A_s, d_B_s = _part_with_derivatives(
            other, its, gamma_s, *along.skeleton
        )
        per = 1 / A_s
        shift, ratio = (B - B_s) * per, A * per
        solved = law.series(D - compliance * shift, compliance * ratio)
        force, new, depth = A * solved.force + B, solved.force, solved.depth
        left = force < 0
        if unilateral:
            alone = jnp.where(left, -B / A, 0)
            force, new = jnp.where(left, 0, force), jnp.where(left, alone, new)
            depth = jnp.where(left, law.under(alone), depth)
        load, slope = (force - B_s) * per, law.tangent(depth)
        powers = [*law.powers(depth).values()]
        force, new, load, slope, left, powers = barrier((force, new, load, slope, left, powers))
        by_law = added(p[None] * d for p, d in zip(powers, d_law, strict=True))
        d_shift = (d_B - d_B_s - shift[None] * d_A_s) * per[None]
        d_ratio = (d_A - ratio[None] * d_A_s) * per[None]
        pushed = d_D - along.compliance * (shift + ratio * new)[None]
        pushed = pushed - compliance[None] * (d_shift + d_ratio * new[None])
        softer = 1 / (1 + compliance * ratio * slope)
        d_new = (slope * softer)[None] * pushed + softer[None] * by_law
        if unilateral:
            d_new = jnp.where(left[None], -(d_B + new[None] * d_A) / A[None], d_new)
        d_new = barrier(d_new)
        d_force = d_A * new[None] + A[None] * d_new + d_B
        d_force = jnp.where(left[None], 0, d_force) if unilateral else d_force
        d_load = barrier((d_force - d_B_s - load[None] * d_A_s) * per[None])
        state = _after(parts, mine, new, d_new), _after(parts_s, its, load, d_load)
        return state, ((force, depth, load, solved.folded), d_force, d_load)

    zero, none = jnp.zeros_like(displacement[0]), jnp.zeros_like(along.displacement[0])
    start = tuple(((zero,) * len(g), zero, (none,) * len(g), none) for g in (gamma, gamma_s))
    samples = (x, lost), (x_s, lost_s), displacement, along.displacement
    return jax.lax.scan(step, start, samples)[1]


def _bonded_loop_with_derivatives(*given):
    return _loop_with_derivatives(*given, unilateral=False)


_with_derivatives = differentiable_in_lanes(_loop_with_derivatives)
_bonded_with_derivatives = differentiable_in_lanes(_bonded_loop_with_derivatives)
