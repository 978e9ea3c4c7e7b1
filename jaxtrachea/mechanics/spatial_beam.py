r"""The ligament bending in two transverse planes, y and z, which the rings couple.

The recursion of `beam` in block form: scalars become 2x2 matrices over the planes (y, z), the
stiffness k_i of a support becomes the compliance C_i of a ring for loads (P_y, P_z) at the angle of
contact (`ring.ring_compliance`). The paper states the vector form of the joint motion
(d_i^x, d_i^y) only; the force method (2.3, eqs. 3-8) is the same.

Each side is described at every node, for a force V and a moment M at its tip, by (W, Y, S):

    w = W (V + Y M),   theta = Y^T w + S M,

W the compliance for forces, S that for moments *with w held*. Against carrying the compliance
[[W, X], [X^T, T]] itself this has two merits. A ring changes W alone: W <- (W^-1 + C^-1)^-1. And
S = T - X^T W^-1 X, the quantity lost to cancellation in a short format, is never formed by
subtraction: a span adds flexibilities J_r F_r J_r^T, and S is their sum over the squares of the
residuals of Y, which is least at Y and therefore does not feel the rounding of Y to first order.

Signs: motions and loads point the same way; a reaction is positive against the load; theta = dw/ds
in each plane. Valid for small deflections and slopes, ligament without torsion.

Units: mm, N, N mm^2 (bending stiffness), N (shear stiffness kappa G A), mm/N (ring compliance).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.mechanics._matrix2 import (
    adj,
    apply,
    congruent,
    det,
    diagonal,
    mul,
    parallel,
    solve,
    trace,
)


class SpatialBeam(eqx.Module):
    """A straight beam clamped at both ends, on n elastic rings that couple its two planes.

    Attributes:
        x: ring positions, mm, strictly increasing in (0, length); shape (n,).
        length: mm.
        EI: bending stiffness of each span in the planes y and z, N mm^2, positive; (n + 1, 2).
        C: compliance of each ring for (P_y, P_z), mm/N, symmetric and positive semi-definite
            (0: rigid); shape (n, 2, 2).
        GA: shear stiffness kappa G A of each span in both planes, N; (n + 1, 2). None: no shear
            flexibility (Bernoulli-Euler, as in the paper).
        integrity: factor on the stiffness of each ring, 0 where it is cut; shape (n,). None: 1.
            A ring with C = 0 must keep some integrity.
    """

    x: Float[Array, " n"]
    length: Float[Array, ""]
    EI: Float[Array, "spans 2"]
    C: Float[Array, "n 2 2"]
    GA: Float[Array, "spans 2"] | None = None
    integrity: Float[Array, " n"] | None = None


class SpatialDeflection(NamedTuple):
    """Response of the beam to a force (F_y, F_z) at C; every entry has the components (y, z).

    Attributes:
        w_C: displacement of C, mm; shape (2,).
        theta_C: rotation dw/ds of C, rad; shape (2,).
        w: displacement of the beam at each ring, mm; shape (n, 2).
        theta: rotation of the section at each ring, rad; shape (n, 2).
        reaction: force of each ring against the load, N; shape (n, 2).
        force_A: part of the force carried by beam AC, N; shape (2,).
        moment_A: moment that beam BC exerts on AC at C, N mm; shape (2,).
    """

    w_C: Float[Array, "2"]
    theta_C: Float[Array, "2"]
    w: Float[Array, "n 2"]
    theta: Float[Array, "n 2"]
    reaction: Float[Array, "n 2"]
    force_A: Float[Array, "2"]
    moment_A: Float[Array, "2"]


class _Tip(NamedTuple):
    """A side seen from its tip: w = f + W (V + Y M), theta = Y^T w + S M + g.

    (f, g) is the motion under ring loads alone: f with the tip free, g the rotation with w held.
    None without ring loads.
    """

    W: Float[Array, "*s 2 2"]
    Y: Float[Array, "*s 2 2"]
    S: Float[Array, "*s 2 2"]
    free: tuple[Float[Array, "*s 2"], Float[Array, "*s 2"]] | None


class _Side(NamedTuple):
    """One side from its clamp: spans, and at n + 1 nodes (clamp, then past each ring) the tip.

    `taken` = C_i-th share of a tip force that the ring takes, `passed` = the rest, both matrices;
    `pull`: force of the ring under the ring loads alone, None without them.
    """

    h: Float[Array, "*side spans"]
    EI: Float[Array, "*side spans 2"]
    GA: Float[Array, "*side spans 2"] | None
    after: _Tip
    taken: Float[Array, "*side n 2 2"]
    passed: Float[Array, "*side n 2 2"]
    pull: Float[Array, "*side n 2"] | None


def _add_span(tip: _Tip, h, EI, GA) -> _Tip:
    """A span = link h, hinge h/EI in its middle, translation h^3/(12 EI) + h/GA at its end."""
    W, Y, S, free = tip
    one = jnp.eye(2, dtype=h.dtype)
    hinge = diagonal(h / EI)
    slide = hinge * (h * h / 12)
    if GA is not None:
        slide = slide + diagonal(h / GA)
    A = one + h * Y
    W_new = congruent(A, W) + h * h * (S + hinge / 4) + slide
    Y_new = solve(W_new, mul(A.T, mul(W, Y)) + h * (S + hinge / 2))
    past_root, past_link, past_hinge = Y - mul(A, Y_new), one - h * Y_new, one - (h / 2) * Y_new
    S_new = congruent(past_root, W) + congruent(past_link, S)
    S_new = S_new + congruent(past_hinge, hinge) + congruent(Y_new, slide)
    if free is not None:
        f, g = free
        free = (apply(A.T, f) + h * g, apply(past_link.T, g) + apply(past_root.T, f))
    return _Tip(W_new, Y_new, S_new, free)


def _add_ring(tip: _Tip, C, integrity, load):
    """A ring at the tip: only W and the free motion change. Returns (tip, taken, passed, pull)."""
    W, Y, S, free = tip
    scale = trace(C) + integrity * trace(W)
    both = (C + integrity * W) / scale
    inverse = adj(both) / det(both)
    taken, passed = integrity * mul(inverse, W / scale), mul(inverse, C / scale)
    held = parallel(C, W, integrity)
    if free is None:
        return _Tip(held, Y, S, None), taken, passed, None
    f, g = free
    pull = integrity * apply(inverse, f / scale) - apply(passed, load)
    free = (apply(passed.T, f) + apply(held, load), g)
    return _Tip(held, Y, S, free), taken, passed, pull


def _sweep(h, EI, GA, C, integrity, load) -> _Side:
    """Carry the tip from the clamp over all rings."""

    def step(tip, ring):
        h_i, EI_i, GA_i, C_i, integrity_i, load_i = ring
        out = _add_ring(_add_span(tip, h_i, EI_i, GA_i), C_i, integrity_i, load_i)
        return out[0], out

    zero = jnp.zeros((2, 2), h.dtype)
    start = _Tip(zero, zero, zero, None if load is None else (zero[0], zero[0]))
    rings = (h[:-1], EI[:-1], None if GA is None else GA[:-1], C, integrity, load)
    _, (after, taken, passed, pull) = jax.lax.scan(step, start, rings)
    after = jax.tree.map(lambda v: jnp.concatenate([jnp.zeros_like(v[:1]), v]), after)
    return _Side(h, EI, GA, after, taken, passed, pull)


def _ends(beam: SpatialBeam):
    """Both clamps and the rings, mm; shape (n + 2,)."""
    return jnp.concatenate([jnp.zeros_like(beam.x[:1]), beam.x, beam.length[None]])


def _sweep_both(beam: SpatialBeam, ring_load=None) -> _Side:
    """Sweeps from A and from B, stacked on a leading axis; independent of the contact position."""

    def both(v):
        return None if v is None else jnp.stack([v, v[::-1]])

    integrity = jnp.ones_like(beam.x) if beam.integrity is None else beam.integrity
    h = both(jnp.diff(_ends(beam)))
    spans = (h, both(beam.EI), both(beam.GA))
    return jax.vmap(_sweep)(*spans, both(beam.C), both(integrity), both(ring_load))


class _Reach(NamedTuple):
    """Both sides at C, with the length of their last span and their number of rings."""

    tips: _Tip
    last: Float[Array, "2"]
    count: Int[Array, "2"]


def _reach(sides: _Side, beam: SpatialBeam, s_c) -> _Reach:
    """Add the last span of each side, up to C. A ring exactly at C belongs to side A."""
    count_A = jnp.sum(beam.x <= s_c)
    count = jnp.stack([count_A, beam.x.shape[0] - count_A])
    ends = _ends(beam)
    last = jnp.stack([s_c - ends[count_A], ends[count_A + 1] - s_c])

    def at(v):
        # Not vmap: going back that would be a scatter, which a single kernel cannot do.
        return jnp.stack(
            [jax.lax.dynamic_index_in_dim(v[i], count[i], keepdims=False) for i in (0, 1)]
        )

    tip, EI, GA = jax.tree.map(at, (sides.after, sides.EI, sides.GA))
    return _Reach(jax.vmap(_add_span)(tip, last, EI, GA), last, count)


def _side(tree, i):
    return jax.tree.map(lambda v: v[i], tree)


def _motion_matrices(A: _Tip, B: _Tip):
    """Compliance of C from both sides, and what the join needs: (C_C, close, sum of Y, lift).

    Rotations agree for M = -close w; a stiffness (Y_A + Y_B) close then joins W_A^-1 + W_B^-1.
    `lift` turns free motions of the sides' parallel combination into that of C.
    """
    bend = A.Y + B.Y
    close = solve(A.S + B.S, bend.T)
    P, stiffness = parallel(A.W, B.W), mul(bend, close)
    PB = mul(P, stiffness)
    lift = adj(jnp.eye(2, dtype=P.dtype) + PB) / (1 + trace(PB) + det(P) * det(stiffness))
    C_C = mul(lift, P)
    return (C_C + C_C.T) / 2, close, bend, lift


def _join(A: _Tip, B: _Tip, force):
    """Motion and rotation of C, and (V, M) of each side in its own signs."""
    C_C, close, bend, lift = _motion_matrices(A, B)
    inverse = solve(A.W + B.W, jnp.eye(2, dtype=force.dtype))
    w, M = apply(C_C, force), jnp.zeros_like(force)
    gap = jnp.zeros_like(force)
    turn_A, turn_B = gap, gap
    if A.free is not None and B.free is not None:
        (f_A, turn_A), (f_B, turn_B) = A.free, B.free
        M = -apply(solve(A.S + B.S, jnp.eye(2, dtype=force.dtype)), turn_A + turn_B)
        mean = apply(B.W, apply(inverse, f_A)) + apply(A.W, apply(inverse, f_B))
        w = w + apply(lift, mean) + apply(C_C, apply(bend, M))
        gap = f_B - f_A
    M = M - apply(close, w)
    push_A, push_B = apply(A.W, apply(A.Y, M)), apply(B.W, apply(B.Y, M))
    V_A = apply(inverse, apply(B.W, force) + push_B - push_A + gap)
    V_B = apply(inverse, apply(A.W, force) + push_A - push_B - gap)
    both = solve(A.S + B.S, jnp.stack([apply(A.Y.T, w) + turn_A, apply(B.Y.T, w) + turn_B], 1))
    theta = apply(B.S, both[:, 0]) - apply(A.S, both[:, 1])
    return w, theta, jnp.stack([V_A, V_B]), jnp.stack([M, M])


def contact_compliance(beam: SpatialBeam, s_c: Float[Array, "*m"]) -> Float[Array, "*m 2 2"]:
    """Compliance of C for forces (F_y, F_z) there, for every contact position: O(n + m).

    The two sweeps over the rings are done once; each position then costs one span step per side.

    Args:
        beam: the beam and its rings.
        s_c: contact positions, mm, in [0, length]; scalar or shape (m,).

    Returns:
        Symmetric compliance, mm/N, of shape (2, 2) or (m, 2, 2); 0 on a clamp.
    """
    sides = _sweep_both(beam)

    def one(s):
        tips = _reach(sides, beam, s).tips
        return _motion_matrices(_side(tips, 0), _side(tips, 1))[0]

    return one(s_c) if s_c.ndim == 0 else jax.vmap(one)(s_c)


def deflect(
    beam: SpatialBeam,
    s_c: Float[Array, ""],
    force: Float[Array, "2"],
    *,
    ring_load: Float[Array, "n 2"] | None = None,
) -> SpatialDeflection:
    """Displacement, rotation and reaction at every ring under an oblique force at C.

    Deflection and rotation agree at C in both planes (the `continuous` split of `beam`).

    Args:
        beam: the beam and its rings.
        s_c: contact position, mm, in [0, length].
        force: (F_y, F_z), N.
        ring_load: further forces on the rings themselves, N; shape (n, 2). `reaction` is still the
            force between ring and beam: w_i = C_i (R_i + ring_load_i) / integrity_i.

    Returns:
        The `SpatialDeflection`; differentiable in every argument.
    """
    sides = _sweep_both(beam, ring_load)
    reach = _reach(sides, beam, s_c)
    w_C, theta_C, V, M = _join(_side(reach.tips, 0), _side(reach.tips, 1), force)
    w, theta, R = jax.vmap(_back_substitute)(sides, reach.last, reach.count, V, M)
    in_A = (beam.x <= s_c)[:, None]

    def join(v, sign):
        return jnp.where(in_A, v[0], sign * v[1][::-1])

    return SpatialDeflection(w_C, theta_C, join(w, 1), join(theta, -1), join(R, 1), V[0], M[0])


def _back_substitute(side: _Side, last, count, V, M):
    """From the load (V, M) at C back to the clamp: w, theta and R at every ring."""
    order = jnp.arange(side.taken.shape[0])
    h = jnp.where(order < count, jnp.where(order == count - 1, last, side.h[1:]), 0)

    def step(load, ring):
        V, M = load
        h_i, held, tip, taken, passed, pull = ring
        M = M + h_i * V
        bend = apply(tip.Y, M)
        w = apply(tip.W, V + bend)
        theta = apply(tip.S, M)
        R = apply(taken, V + bend)
        # V - R, without losing what little gets past a stiff ring.
        rest = apply(passed, V) - apply(taken, bend)
        if pull is not None:
            w, theta = w + tip.free[0], theta + tip.free[1]
            R, rest = R + pull, rest - pull
        theta = theta + apply(tip.Y.T, w)
        return (jnp.where(held, rest, V), M), (w, theta, R)

    after = jax.tree.map(lambda v: v[1:], side.after)
    rings = (h, order < count, after, side.taken, side.passed, side.pull)
    _, out = jax.lax.scan(step, (V, M), rings, reverse=True)
    return out
