r"""The ligament as a continuous beam on ring supports: the force method (paper 2.3, eqs. 3-8).

The contact point C divides the ligament into two cantilevers AC and BC, each clamped at its far end
and resting on spring supports, the rings. Two forms of the same force method are here:

- `recursion` (default): the tip compliance of the part between the clamp and a node is carried from
  node to node; every ring releases one redundant reaction, so no matrix is formed. O(n).
- `reactions`: the paper's dense system for all redundants at once (`mechanics.reactions`).

Signs: deflection w and load F point the same way (inward for a press); a reaction R_i is positive
when the ring pushes back against F; theta = dw/ds. Valid for small deflections and slopes.

Units: mm, N, N mm^2 (bending stiffness), N (shear stiffness kappa G A), N/mm (rings), mm/N.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.mechanics.compliance import (
    Beam,
    Compliance,
    Deflection,
    Split,
    add_span,
    add_support,
    divide_load,
    force_shares,
    join,
    sides,
)
from jaxtrachea.mechanics.reactions import deflect_dense

Form = Literal["recursion", "reactions"]


class _Side(NamedTuple):
    """One side seen from its clamp, with the tip compliance at every node.

    `h` are the spans in the order of the side. `after` holds n + 1 entries: at the clamp (zero),
    then after each ring with that ring included; `passed` is the part 1 / (1 + k a) of a tip force
    that gets past the ring. `free` is the motion (w, theta) of the same nodes under ring loads
    alone, None without them.
    """

    h: Float[Array, "*side spans"]
    EI: Float[Array, "*side spans"]
    GA: Float[Array, "*side spans"] | None
    k: Float[Array, "*side n"]
    load: Float[Array, "*side n"] | None
    after: Compliance
    passed: Float[Array, "*side n"]
    free: tuple[Float[Array, "*side spans"], Float[Array, "*side spans"]] | None


def _sweep(h, EI, k, GA, load) -> _Side:
    """Carry the compliance (and the free motion under ring loads) from the clamp over all rings."""
    zero = jnp.zeros_like(h[0])

    def step(carry, ring):
        g, free = carry
        h_i, EI_i, GA_i, k_i, load_i = ring
        g = add_span(g, h_i, EI_i, GA_i)
        passed = 1 / (1 + k_i * g.a)
        if load_i is not None:
            w, theta = free[0] + h_i * free[1], free[1]
            pull = (load_i - k_i * w) * passed
            free = (w + g.a * pull, theta + g.b * pull)
        g = add_support(g, k_i)
        return (g, free), (g, free, passed)

    start = (Compliance(zero, zero, zero, zero), None if load is None else (zero, zero))
    rings = (h[:-1], EI[:-1], None if GA is None else GA[:-1], k, load)
    _, (after, free, passed) = jax.lax.scan(step, start, rings)
    with_clamp = lambda v: jnp.concatenate([jnp.zeros_like(v[:1]), v])  # noqa: E731
    after, free = jax.tree.map(with_clamp, (after, free))
    return _Side(h, EI, GA, k, load, after, passed, free)


def _ends(beam: Beam):
    """Both clamps and the supports, mm; shape (n + 2,)."""
    return jnp.concatenate([jnp.zeros_like(beam.x[:1]), beam.x, beam.length[None]])


def _sweep_both(beam: Beam, ring_load=None) -> _Side:
    """Sweeps from A and from B, stacked on a leading axis; independent of the contact position."""
    both = lambda v: None if v is None else jnp.stack([v, v[::-1]])  # noqa: E731
    # Span lengths before mirroring: length - x would cost short spans their digits.
    h = both(jnp.diff(_ends(beam)))
    return jax.vmap(_sweep)(h, both(beam.EI), both(beam.k), both(beam.GA), both(ring_load))


class _Tips(NamedTuple):
    """Both sides at C: compliance, free motion, distance from the clamp and from the last ring.

    `count` is the number of rings of each side.
    """

    g: Compliance
    free: tuple[Float[Array, "2"], Float[Array, "2"]] | None
    s: Float[Array, "2"]
    last: Float[Array, "2"]
    count: Int[Array, "2"]


def _reach(swept: _Side, beam: Beam, s_c) -> _Tips:
    """Add the last span of each side, up to C. A ring exactly at C belongs to side A."""
    count_A = jnp.sum(beam.x <= s_c)
    count = jnp.stack([count_A, beam.x.shape[0] - count_A])
    ends = _ends(beam)
    last = jnp.stack([s_c - ends[count_A], ends[count_A + 1] - s_c])

    def one(side, h, count):
        at = lambda v: jax.lax.dynamic_index_in_dim(v, count, keepdims=False)  # noqa: E731
        g, free, EI, GA = jax.tree.map(at, (side.after, side.free, side.EI, side.GA))
        free = None if free is None else (free[0] + h * free[1], free[1])
        return add_span(g, h, EI, GA), free

    g, free = jax.vmap(one)(swept, last, count)
    return _Tips(g, free, jnp.stack([s_c, beam.length - s_c]), last, count)


def contact_compliance(
    beam: Beam, s_c: Float[Array, "*m"], *, split: Split = "continuous"
) -> Float[Array, "*m"]:
    """Deflection of C per unit normal force at C for every contact position: O(n + m).

    The two sweeps over the rings are done once; each position then costs one span step per side.

    Args:
        beam: the beam and its supports.
        s_c: contact positions, mm, in [0, length]; scalar or shape (m,).
        split: `continuous` (deflection and rotation agree at C; C1 in s_c) or `independent` (paper
            eq. 3; jumps as C crosses a ring).

    Returns:
        Compliance, mm/N, of the shape of `s_c`.
    """
    swept = _sweep_both(beam)

    def one(s):
        tips = _reach(swept, beam, s)
        if split == "independent":
            return jnp.sum(force_shares(tips.s) ** 2 * tips.g.a)
        return join(*sides(tips.g)).w

    return one(s_c) if s_c.ndim == 0 else jax.vmap(one)(s_c)


def deflect(
    beam: Beam,
    s_c: Float[Array, ""],
    force: Float[Array, ""],
    *,
    split: Split = "continuous",
    form: Form = "recursion",
    ring_load: Float[Array, " n"] | None = None,
) -> Deflection:
    """Deflection, rotation and reaction at every support under a normal force at C.

    Args:
        beam: the beam and its supports.
        s_c: contact position, mm, in [0, length].
        force: N.
        split: how the force divides between AC and BC, see `contact_compliance`.
        form: `recursion` or the paper's dense `reactions` (same answer, see module docstring;
            needs k > 0).
        ring_load: further forces on the supports themselves, in the direction of `force`, N; shape
            (n,). With them `reaction` is still the force between ring and beam: w_i = (R_i +
            ring_load_i) / k_i. Use float64 with them: the free motions of the two sides under these
            loads largely cancel (float32 can be left with one digit at the joints).

    Returns:
        The `Deflection`; differentiable in every argument.

    Raises:
        ValueError: `ring_load` asked of `reactions`.
    """
    if form == "reactions":
        if ring_load is not None:
            raise ValueError("ring_load is not part of form='reactions'; use form='recursion'")
        return deflect_dense(beam, s_c, force, split=split)
    swept = _sweep_both(beam, ring_load)
    tips = _reach(swept, beam, s_c)
    w_C, theta_C, V, M = divide_load(tips.g, tips.s, force, split, tips.free)
    w, theta, R = jax.vmap(_back_substitute)(swept, tips.last, tips.count, V, M)
    in_A = beam.x <= s_c
    both = lambda v, sign: jnp.where(in_A, v[0], sign * v[1][::-1])  # noqa: E731
    return Deflection(w_C, theta_C, both(w, 1), both(theta, -1), both(R, 1), V[0], M[0])


def _back_substitute(side: _Side, last, count, V, M):
    """From the load (V, M) at C back to the clamp: w, theta and R at every support."""
    order = jnp.arange(side.k.shape[0])
    held = order < count
    h = jnp.where(order == count - 1, last, side.h[1:])
    h, k = jnp.where(held, h, 0), jnp.where(held, side.k, 0)
    passed = jnp.where(held, side.passed, 1)
    load = None if side.load is None else jnp.where(held, side.load, 0)

    def step(tip, ring):
        V, M = tip
        h_i, k_i, passed_i, load_i, g, free = ring
        M = M + h_i * V
        w, theta = g.a * V + g.b * M, g.b * V + g.c * M
        R = k_i * w
        # V - R, without losing what little gets past a stiff ring.
        rest = passed_i * V - k_i * g.b * M
        if load_i is not None:
            from_loads = k_i * free[0] - load_i
            w, theta = w + free[0], theta + free[1]
            R, rest = R + from_loads, rest - from_loads
        return (rest, M), (w, theta, R)

    after, free = jax.tree.map(lambda v: v[1:], (side.after, side.free))
    rings = (h, k, passed, load, after, free)
    _, out = jax.lax.scan(step, (V, M), rings, reverse=True)
    return out
