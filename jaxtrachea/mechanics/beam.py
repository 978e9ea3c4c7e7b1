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

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, check_word, real, shaped
from jaxtrachea._numerics import picked
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
#: Rings up to which many contact positions are placed among them by one comparison each.
FEW = 32


class Side(NamedTuple):
    """One side seen from its clamp: spans, rings and loads in that order.

    `h`, `EI`, `GA`: n + 1 spans; `k`, `load`: n rings. None: without shear, without ring loads.
    """

    h: Float[Array, "*side spans"]
    EI: Float[Array, "*side spans"]
    GA: Float[Array, "*side spans"] | None
    k: Float[Array, "*side n"]
    load: Float[Array, "*side n"] | None


class _Node(NamedTuple):
    """Tip of a side: compliance, and motion (w, theta) under ring loads alone (None without)."""

    g: Compliance
    free: tuple[Float[Array, "*s"], Float[Array, "*s"]] | None


def _add_span(node: _Node, h, EI, GA) -> _Node:
    free = node.free
    if free is not None:
        free = (free[0] + h * free[1], free[1])
    return _Node(add_span(node.g, h, EI, GA), free)


def sweep(side: Side) -> tuple[_Node, _Node, Float[Array, " n"]]:
    """Carry the compliance from the clamp over all rings.

    Returns:
        The node after the last ring; the nodes after every ring; the part 1 / (1 + k a) of a tip
        force that gets past each ring.
    """
    zero = jnp.zeros_like(side.h[0])

    def step(node, ring):
        h, EI, GA, k, load = ring
        g, free = _add_span(node, h, EI, GA)
        passed = 1 / (1 + k * g.a)
        if load is not None and free is not None:
            pull = (load - k * free[0]) * passed
            free = (free[0] + g.a * pull, free[1] + g.b * pull)
        node = _Node(add_support(g, k), free)
        return node, (node, passed)

    clamp = _Node(Compliance(zero, zero, zero, zero), None if side.load is None else (zero, zero))
    GA = None if side.GA is None else side.GA[:-1]
    last, (nodes, passed) = jax.lax.scan(step, clamp, (side.h[:-1], side.EI[:-1], GA, side.k,
                                                       side.load))  # fmt: skip
    return last, nodes, passed


def both_sides(beam: Beam, ring_load=None) -> Side:
    """The beam read from A and from B, stacked on a leading axis."""

    def both(v):
        return jnp.stack([v, v[::-1]])

    # Span lengths before mirroring: length - x would cost short spans their digits.
    h = both(jnp.diff(_ends(beam)))
    GA = None if beam.GA is None else both(beam.GA)
    load = None if ring_load is None else both(ring_load)
    return Side(h, both(beam.EI), GA, both(beam.k), load)


def _ends(beam: Beam):
    """Both clamps and the supports, mm; shape (n + 2,)."""
    return jnp.concatenate([jnp.zeros_like(beam.x[:1]), beam.x, beam.length[None]])


def _reach(
    beam: Beam, s_c, *, written_out: bool = False
) -> tuple[Int[Array, "2"], Float[Array, "2"], Float[Array, "2"]]:
    """Rings on either side of C, distance to the last of them, and to the clamp.

    A ring exactly at C belongs to side A.

    Args:
        s_c: mm.
        written_out: a comparison for each ring and no sum over them, which of many lanes no single
            kernel can make (`fusion.REDUCED`).
    """
    ends, n = _ends(beam), beam.x.shape[0]
    if written_out:
        count, before, after = jnp.zeros((), int), ends[0], ends[1]
        for i in range(1, n + 1):
            passed = ends[i] <= s_c
            count = count + passed.astype(count.dtype)
            before = jnp.where(passed, ends[i], before)
            after = jnp.where(passed, ends[i + 1], after)
    else:
        count = jnp.sum(beam.x <= s_c)
        before, after = picked(ends, count), picked(ends, count + 1)
    last = jnp.stack([s_c - before, after - s_c])
    return jnp.stack([count, n - count]), last, jnp.stack([s_c, beam.length - s_c])


def _up_to(side: Side, count, last) -> Side:
    """The side cut off at C: the span that holds C shortened, everything beyond it zero."""
    order = jnp.arange(side.h.shape[0])
    h = jnp.where(order == count, last, jnp.where(order < count, side.h, 0))
    held = order[:-1] < count
    load = None if side.load is None else jnp.where(held, side.load, 0)
    return side._replace(h=h, k=jnp.where(held, side.k, 0), load=load)


def _tip(side: Side, node: _Node) -> _Node:
    """Add the last span."""
    return _add_span(node, side.h[-1], side.EI[-1], None if side.GA is None else side.GA[-1])


def _check_shapes(beam: Beam) -> None:
    """Refuse a beam whose spans and supports do not fit each other."""
    check_word("beam", beam, Beam)
    n = shaped("Beam.x", beam.x, ("any number of",)).shape[0]
    if n == 0:
        raise ValueError("Beam.x has no values; expected one support or more")
    shaped("Beam.length", beam.length, ())
    shaped("Beam.k", beam.k, (n,), why=" (one for each support)")
    why = f" ({n} supports make {n + 1} spans)"
    shaped("Beam.EI", beam.EI, (n + 1,), why=why)
    if beam.GA is not None:
        shaped("Beam.GA", beam.GA, (n + 1,), why=why)


def _compliance_at(tips: Compliance, s, split: Split):
    """Deflection of C per unit force from the tips of both sides, `s` away from their clamps."""
    if split == "independent":
        return jnp.sum(force_shares(s) ** 2 * tips.a)
    return join(*sides(tips)).w


def contact_compliance(
    beam: Beam, s_c: ArrayLike, *, split: Split = "continuous"
) -> Float[Array, "*m"]:
    """Deflection of C per unit normal force at C for every contact position: O(n + m).

    The two sweeps over the rings are done once; each position then costs one span step per side.
    NaN off the beam.

    Args:
        beam: the beam and its supports.
        s_c: contact positions, mm, on [0, length]; scalar or shape (m,).
        split: `continuous` (deflection and rotation agree at C; C1 in s_c) or `independent` (paper
            eq. 3; jumps as C crosses a ring).

    Returns:
        Compliance, mm/N, of the shape of `s_c`.

    Raises:
        ValueError: an unknown `split`, no numbers, or of a wrong number of spans or supports.
    """
    check_word("split", split, Split)
    _check_shapes(beam)
    s_c = real("s_c", s_c, beam.x.dtype)
    if s_c.ndim > 1:
        raise ValueError(f"s_c has shape {s_c.shape}; expected a scalar or one axis")
    return _contact_compliance(beam, s_c, split)


@functools.partial(jax.jit, static_argnames="split", inline=True)
def _contact_compliance(beam: Beam, s_c: Float[Array, "*m"], split: Split) -> Float[Array, "*m"]:
    """`contact_compliance`, of arguments that are checked."""
    both = both_sides(beam)
    on = (s_c >= 0) & (s_c <= beam.length)
    s_c = jnp.where(on, s_c, beam.length / 2)
    if s_c.ndim == 0:
        count, last, s = _reach(beam, s_c)
        cut = jax.vmap(_up_to)(both, count, last)
        tips = jax.vmap(lambda side: _tip(side, sweep(side)[0]))(cut)
        return jnp.where(on, _compliance_at(tips.g, s, split), jnp.nan)
    _, nodes, _ = jax.vmap(sweep)(both)

    def with_clamp(v):
        return jnp.concatenate([jnp.zeros_like(v[:, :1]), v], axis=1)

    nodes = jax.tree.map(with_clamp, nodes)

    def one(s_c):
        count, last, s = _reach(beam, s_c, written_out=beam.x.shape[0] <= FEW)

        def at(v):
            return v[jnp.arange(2), count]

        GA = None if both.GA is None else at(both.GA)
        tips = add_span(jax.tree.map(at, nodes.g), last, at(both.EI), GA)
        return _compliance_at(tips, s, split)

    return jnp.where(on, jax.vmap(one)(s_c), jnp.nan)


def deflect(
    beam: Beam,
    s_c: ArrayLike,
    force: ArrayLike,
    *,
    split: Split = "continuous",
    form: Form = "recursion",
    ring_load: ArrayLike | None = None,
) -> Deflection:
    """Deflection, rotation and reaction at every support under a normal force at C.

    Args:
        beam: the beam and its supports.
        s_c: contact position, mm, on [0, length]; elsewhere all is NaN.
        force: N.
        split: how the force divides between AC and BC, see `contact_compliance`.
        form: `recursion` or the paper's dense `reactions` (same answer, see module docstring).
        ring_load: further forces on the supports themselves, in the direction of `force`, N; shape
            (n,). With them `reaction` is still the force between ring and beam: w_i = (R_i +
            ring_load_i) / k_i. Use float64 with them: the free motions of the two sides under these
            loads largely cancel (float32 can be left with one digit at the joints).

    Returns:
        The `Deflection`; differentiable in every argument.

    Raises:
        ValueError: an unknown word, no numbers or a wrong number of them, or `ring_load` asked of
            `reactions`.
    """
    check_word("split", split, Split)
    check_word("form", form, Form)
    _check_shapes(beam)
    dtype = beam.x.dtype
    s_c, force = shaped("s_c", s_c, (), dtype=dtype), shaped("force", force, (), dtype=dtype)
    if ring_load is not None:
        why = " (one for each ring)"
        ring_load = shaped("ring_load", ring_load, beam.x.shape, dtype=dtype, why=why)
        if form == "reactions":
            raise ValueError("ring_load is not part of form='reactions'; use form='recursion'")
    return _deflect(beam, s_c, force, split, form, ring_load)


@functools.partial(jax.jit, static_argnames=("split", "form"), inline=True)
def _deflect(
    beam: Beam,
    s_c: Float[Array, ""],
    force: Float[Array, ""],
    split: Split,
    form: Form,
    ring_load: Float[Array, " n"] | None,
) -> Deflection:
    """`deflect`, of arguments that are checked."""
    on = (s_c >= 0) & (s_c <= beam.length)
    place = jnp.where(on, s_c, beam.length / 2)
    found = deflect_on(beam, place, force, split, form, ring_load)
    return jax.tree.map(lambda v: jnp.where(on, v, jnp.nan), found)


def deflect_on(
    beam: Beam,
    s_c: Float[Array, ""],
    force: Float[Array, ""],
    split: Split = "continuous",
    form: Form = "recursion",
    ring_load: Float[Array, " n"] | None = None,
) -> Deflection:
    """`deflect`, of arguments that are checked and a place on the beam."""
    if form == "reactions":
        return deflect_dense(beam, s_c, force, split=split)
    count, last, s = _reach(beam, s_c)
    cut = jax.vmap(_up_to)(both_sides(beam, ring_load), count, last)
    end, nodes, passed = jax.vmap(sweep)(cut)
    tips = jax.vmap(_tip)(cut, end)
    w_C, theta_C, V, M = divide_load(tips.g, s, force, split, tips.free)
    w, theta, R = jax.vmap(_back_substitute)(cut, nodes, passed, V, M)
    in_A = beam.x <= s_c

    def both(v, sign):
        return jnp.where(in_A, v[0], sign * v[1][::-1])

    return Deflection(w_C, theta_C, both(w, 1), both(theta, -1), both(R, 1), V[0], M[0])


def _back_substitute(side: Side, nodes: _Node, passed, V, M):
    """From the load (V, M) at the tip back to the clamp: w, theta and R at every support."""

    def step(tip, ring):
        V, M = tip
        h, k, load, passed, (g, free) = ring
        M = M + h * V
        w, theta = g.a * V + g.b * M, g.b * V + g.c * M
        R = k * w
        # V - R, without losing what little gets past a stiff ring.
        rest = passed * V - k * g.b * M
        if load is not None:
            from_loads = k * free[0] - load
            w, theta = w + free[0], theta + free[1]
            R, rest = R + from_loads, rest - from_loads
        return (rest, M), (w, theta, R)

    rings = (side.h[1:], side.k, side.load, passed, nodes)
    _, out = jax.lax.scan(step, (V, M), rings, reverse=True)
    return out
