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
from jaxtrachea.relaxation.steps import Branches, differentiable_in_lanes, factors, fading


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


def way_of(load: Float[Array, " N"], compliance: Float[Array, ""], law: Law) -> Float[Array, " N"]:
    """Way of an elastic press whose skeleton is as deflected, mm; NaN past the fold of the law.

    Of parts that relax alike it is the way of the tool. Where they relax apart the skeleton is
    deflected more or less than that says, and with it the shape that softens.
    """
    return compliance * load + law.root(load, jnp.ones_like(load), 0.0)


def _loop(local, skeleton, displacement, compliance, law: Law, unilateral: bool = True):
    """Force, depth, load and fold; arrays may have lanes as their last axis.

    Args:
        local: x, lost and gamma of the local law, see `relaxation.steps`.
        skeleton: those of the skeleton.
        displacement: (N, *lanes).
        compliance: of the skeleton.
        law: local law.
        unilateral: static.
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
        compliance: of the skeleton.
        law: local law.
        unilateral: static.
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
        depth = jnp.where(left, law.root(alone, jnp.ones_like(alone), 0.0), depth)
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
