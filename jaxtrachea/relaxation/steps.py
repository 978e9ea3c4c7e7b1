"""The loop over samples of a force that relaxes: one kernel on a CPU, with lanes as its last axis.

Steps over relaxation times are x, and `lost` what a step takes of a branch, expm1(-x).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from jaxtrachea._numerics import added
from jaxtrachea.fusion import fuse


class Branches(NamedTuple):
    """Branches of a relaxation.

    Attributes:
        gamma: strength over that of the force that lasts; not negative; (B,).
        tau: relaxation time, s; (B,). 0 and very small: nothing is left of the branch at the next
            sample; infinite: it does not relax.
    """

    gamma: Float[Array, "*B"]
    tau: Float[Array, "*B"]


def fading(time, branches: Branches):
    """Steps over relaxation times, (N, B), and what they take of a branch: expm1(-x)."""
    dt = jnp.diff(time, prepend=time[:1])
    x = over(dt[:, None], branches.tau[None])
    return x, _lost(x)


@jax.custom_jvp
def over(dt, tau):
    """Steps over relaxation times; where it is 1e154 (float32: 1e19) a branch is 0 anyway."""
    limits = jnp.finfo(tau.dtype)
    return jnp.minimum(dt / jnp.maximum(tau, limits.tiny), math.sqrt(float(limits.max)))


@over.defjvp
def _over_jvp(primals, tangents):
    """In an order that keeps changes in log tau finite where tau^2 is not."""
    x, limits = over(*primals), jnp.finfo(primals[1].dtype)
    tau = jnp.maximum(primals[1], limits.tiny)
    free = x < math.sqrt(float(limits.max))
    return x, jnp.where(free, (tangents[0] - x * tangents[1]) / tau, 0)


#: By size of the numbers: the parts of log 2 (the first with few bits, so that its products with
#: small integers are exact), terms of the series, integers of that size, bits of the mantissa, the
#: exponent of 1, the largest x.
_EXPM1 = {
    8: (6.93147180369123816490e-01, 1.90821492927058770002e-10, 12, jnp.int64, 52, 1023, 700.0),
    4: (0.693359375, -2.12194440e-4, 7, jnp.int32, 23, 127, 80.0),
}


@jax.custom_jvp
def _lost(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """`expm1(-x)` for x >= 0 to an ulp or two: of many numbers several times as quick as XLA's.

    -x = n log 2 + r; of r its series, times 2^n. Added to 1.5 times 2^mantissa, a number is rounded
    to n and has it in its last bits; those, shifted, are the exponent of 2^n.
    """
    high, low, terms, integer, mantissa, bias, most = _EXPM1[x.dtype.itemsize]
    y, rounding = -jnp.minimum(x, most), 1.5 * 2.0**mantissa
    bits = jax.lax.bitcast_convert_type(y * (1 / math.log(2)) + rounding, integer)
    # Its sign bit is none; without this a compiler takes the rounding off again.
    n = jax.lax.bitcast_convert_type(bits & jnp.iinfo(integer).max, x.dtype) - rounding
    r = y - n * high - n * low
    series = jnp.full_like(r, 1 / math.factorial(terms))
    for i in range(terms - 1, 0, -1):
        series = series * r + 1 / math.factorial(i)
    power = jax.lax.bitcast_convert_type((bits + bias) << mantissa, x.dtype)
    return power * (series * r) + (power - 1)


@_lost.defjvp
def _lost_jvp(primals, tangents):
    lost = _lost(*primals)
    return lost, -(1 + lost) * tangents[0]


def _mean(x, lost):
    """(1 - exp(-x)) / x."""
    near = x < jnp.finfo(x.dtype).eps
    return jnp.where(near, 1 - x / 2, -lost / jnp.where(near, 1, x))


def factors(x, lost, gamma):
    """E, (1 - E) / x and P of each branch, as lists: unrolled, it is vectorised over the lanes."""
    count = range(gamma.shape[0])
    mean = [_mean(x[b], lost[b]) for b in count]
    return [1 + lost[b] for b in count], mean, [gamma[b] * mean[b] for b in count]


def _press(kept, share, h, e, elastic, unilateral: bool):
    """Force, elastic force of the surface, whether the tool has left, A and 1 / A, of one step."""
    A = 1 + added(share)
    B = added(E * h - P * e for E, P, h in zip(kept, share, h, strict=True))
    force = A * elastic + B
    left = force < 0
    if not unilateral:
        return force, elastic, jnp.zeros_like(left), A, jnp.ones_like(A)
    per_A = 1 / A
    return jnp.where(left, 0, force), jnp.where(left, -B * per_A, elastic), left, A, per_A


class Carried(NamedTuple):
    """What a part that relaxes remembers; zeros: it was at rest for ever.

    Attributes:
        overload: what each branch carries beside the elastic force, N; (B,), of vectors (B, 3).
        elastic: elastic force of the surface, N; scalar, of vectors (3,).
    """

    overload: Float[Array, "branches ..."]
    elastic: Float[Array, "..."]


def advance(
    before: Carried, dt: Float[Array, ""], elastic, branches: Branches, unilateral: bool
) -> tuple[Carried, Float[Array, "..."]]:
    """One step of `filter.relax`: what is remembered after it, and the force, N.

    A vector of a unilateral contact has its inward component first: where that would pull, the tool
    has left, and all components are those of a surface that recovers by itself.

    Args:
        before: what is remembered.
        dt: time of the step, s, not negative.
        elastic: elastic force of the tool's displacement at its end, N; as `before.elastic`.
        branches: see `Branches`.
        unilateral: whether the contact lets go (static).
    """
    h, e = before
    x = over(dt, branches.tau)
    kept, _, share = factors(x, jnp.expm1(-x), branches.gamma)
    A = 1 + added(share)
    B = added(E * h[b] - P * e for b, (E, P) in enumerate(zip(kept, share, strict=True)))
    force, surface = A * elastic + B, elastic
    if unilateral:
        left = (force if force.ndim == 0 else force[0]) < 0
        force, surface = jnp.where(left, 0, force), jnp.where(left, -B / A, elastic)
    return Carried(pushed(before, kept, share, surface), surface), force


def pushed(before: Carried, kept, share, surface) -> Float[Array, "branches ..."]:
    """What each branch carries after a step that ends at this elastic force."""
    h, e = before
    return jnp.stack(
        [E * h[b] + P * (surface - e) for b, (E, P) in enumerate(zip(kept, share, strict=True))]
    )


def _loop(x, lost, elastic, gamma, unilateral: bool = True):
    """Force and elastic force of the surface; arrays may have lanes as their last axis.

    Args:
        x: see `fading`; (N, B, *lanes), as `lost`.
        lost: what a step takes of a branch.
        elastic: (N, *lanes).
        gamma: (B, *lanes).
    """

    def step(state, sample):
        h, e = state
        x, lost, elastic = sample
        kept, _, share = factors(x, lost, gamma)
        force, new, *_ = _press(kept, share, h, e, elastic, unilateral)
        moved = new - e
        h = tuple(E * h + P * moved for E, P, h in zip(kept, share, h, strict=True))
        return (h, new), (force, new)

    zero = jnp.zeros_like(elastic[0])
    start = (zero,) * gamma.shape[0], zero
    return jax.lax.scan(step, start, (x, lost, elastic))[1]


def _bonded_loop(x, lost, elastic, gamma):
    return _loop(x, lost, elastic, gamma, False)[0]


def in_parallel(x, lost, elastic, gamma):
    """`overloads` by an associative scan: it is linear in all samples."""
    pushed = gamma[None] * _mean(x, lost) * jnp.diff(elastic, prepend=0)[:, None]

    def after(first, then):
        return first[0] * then[0], then[0] * first[1] + then[1]

    return jax.lax.associative_scan(after, (1 + lost, pushed))[1]


def bonded_in_parallel(x, lost, elastic, gamma):
    """Force of a bonded contact, as `bonded_filter`, by `in_parallel`."""
    return elastic + jnp.sum(in_parallel(x, lost, elastic, gamma), axis=-1)


def mean_kept(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """(1 - exp(-x)) / x for x >= 0, the mean of what is kept within a step."""
    return _mean(x, jnp.expm1(-x))


def loop_with_derivatives(
    x, lost, elastic, columns, gamma, along, *, unilateral: bool, surface: bool
):
    """`_loop`, and derivatives of its results by C columns and along K directions; lanes as there.

    What several results read is stored (`barrier`): XLA would compute it anew for each of them.

    Args:
        x: see `_loop`, as `lost`, `elastic` and `gamma`.
        lost: what a step takes of a branch.
        elastic: N.
        columns: derivatives of the elastic force; (N, C, *lanes).
        along: changes of gamma and of log tau, each (B, K, *lanes); None: of their logarithms.
        surface: whether derivatives of the surface's elastic force are asked for (static).

    Returns:
        Force, elastic force, the derivatives of the one and those of the other or None.
    """
    barrier, branches = jax.lax.optimization_barrier, range(gamma.shape[0])
    zero, none_of_columns = jnp.zeros_like(elastic[0]), jnp.zeros_like(columns[0])
    if along is None:
        none_along = jnp.zeros((2 * len(branches), *zero.shape), zero.dtype)
    else:
        none_along = jnp.zeros_like(along.gamma[0])

    def step(state, sample):
        h, e, dh, de = state
        x, lost, elastic, columns = sample
        kept, mean, share = barrier(factors(x, lost, gamma))
        force, new, left, A, per_A = barrier(_press(kept, share, h, e, elastic, unilateral))
        moved = new - e

        def by_branch(b):
            """Change of h' by the branch's own numbers: E by log tau is x E, P is P - gamma E."""
            fading = x[b] * kept[b] * h[b] + (share[b] - gamma[b] * kept[b]) * moved
            if along is None:
                rows = [zero] * (2 * len(branches))
                rows[b], rows[len(branches) + b] = share[b] * moved, fading
                own = jnp.stack(rows)
            else:
                own = along.gamma[b] * (mean[b] * moved)[None] + along.tau[b] * fading[None]
            return jnp.concatenate([none_of_columns, own])

        pushed = barrier(
            [kept[b][None] * dh[b] - share[b][None] * de + by_branch(b) for b in branches]
        )
        d_new, all_pushed = jnp.concatenate([columns, none_along]), added(pushed)
        d_force = A[None] * d_new + all_pushed
        if unilateral:
            d_new = barrier(jnp.where(left[None], -all_pushed * per_A[None], d_new))
            d_force = jnp.where(left[None], 0, A[None] * d_new + all_pushed)
        dh = tuple(pushed[b] + share[b][None] * d_new for b in branches)
        h = tuple(kept[b] * h[b] + share[b] * moved for b in branches)
        return (h, new, dh, d_new), (force, new, d_force, d_new if surface else None)

    none = jnp.concatenate([none_of_columns, none_along])
    start = (zero,) * gamma.shape[0], zero, (none,) * gamma.shape[0], none
    return jax.lax.scan(step, start, (x, lost, elastic, columns))[1]


def _lanes_last(loop):
    """A loop over samples as one kernel on a CPU, also of many lanes (`vmap`), its last axis.

    What one step reads of all lanes lies together then, and is computed several at a time.
    """
    kernel = fuse(loop, streams=True)

    @custom_vmap
    def call(*arrays):
        return kernel(*arrays)

    @call.def_vmap
    def _(count, has_lanes, *arrays):
        def last(v, own):
            return jnp.moveaxis(v, 0, -1) if own else jnp.repeat(v[..., None], count, axis=-1)

        found = call(*jax.tree.map(last, arrays, tuple(has_lanes)))
        lanes_first = jax.tree.map(lambda v: jnp.moveaxis(v, -1, 0), found)
        return lanes_first, jax.tree.map(lambda _: True, found)

    return call


def differentiable_in_lanes(loop):
    """The loop in lanes; its derivatives are those of the loop as it stands, in both modes."""
    in_lanes = jax.custom_jvp(_lanes_last(loop))

    @in_lanes.defjvp
    def _(primals, tangents):
        return in_lanes(*primals), jax.jvp(loop, primals, tangents)[1]

    return in_lanes


unilateral_filter = differentiable_in_lanes(_loop)
bonded_filter = differentiable_in_lanes(_bonded_loop)
