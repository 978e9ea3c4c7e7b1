r"""The ligament as a continuous beam on ring supports: the force method (paper 2.3, eqs. 3-8).

The contact point C divides the ligament into two cantilevers AC and BC, each clamped at its far end
and resting on spring supports, the rings. Two forms of the same force method are here:

- `recursion` (default): the tip compliance of the part between the clamp and a node is carried from
  node to node; every ring releases one redundant reaction, so no matrix is formed. O(n).
- `reactions`: the paper's dense system (delta + I/k) R = Delta for all redundants at once, with the
  printed influence coefficients corrected (docs/model.md). O(n^3) and less accurate; kept as the
  reference of the paper's own algorithm.

Signs: deflection w and load F point the same way (inward for a press); a reaction R_i is positive
when the ring pushes back against F; theta = dw/ds. Valid for small deflections and slopes.

Units: mm, N, N mm^2 (bending stiffness), N (shear stiffness kappa G A), N/mm (rings), mm/N.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Split = Literal["continuous", "independent"]
Form = Literal["recursion", "reactions"]


class Beam(eqx.Module):
    """A straight beam clamped at both ends, on n spring supports.

    Attributes:
        x: support positions, mm, strictly increasing in (0, length); shape (n,).
        length: mm.
        EI: bending stiffness of each span, N mm^2, positive; shape (n + 1,).
        k: stiffness of each support, N/mm, not negative; shape (n,).
        GA: shear stiffness kappa G A of each span, N; shape (n + 1,). None: no shear flexibility
            (Bernoulli-Euler, as in the paper).
    """

    x: Float[Array, " n"]
    length: Float[Array, ""]
    EI: Float[Array, " spans"]
    k: Float[Array, " n"]
    GA: Float[Array, " spans"] | None = None


class Compliance(NamedTuple):
    """Tip compliance [[a, b], [b, c]] of a cantilever: (w, theta) = G (V, M).

    a: mm/N; b: 1/N (deflection per moment = rotation per force); c: 1/(N mm); det = a c - b^2,
    1/N^2. Any common shape. The determinant is carried because with it spans, supports and the
    parallel combination of two sides need sums of positive terms only: nothing cancels.
    """

    a: Float[Array, "*s"]
    b: Float[Array, "*s"]
    c: Float[Array, "*s"]
    det: Float[Array, "*s"]


class Deflection(NamedTuple):
    """Response of the beam to a force at C.

    Attributes:
        w_C: deflection of C, mm. With `independent` the two beams disagree there; this is then the
            deflection conjugate to the force, sum(share^2 * compliance) * F.
        theta_C: rotation of C, rad (`independent`: that of beam AC).
        w: deflection of the beam at each support, mm; shape (n,).
        theta: rotation of the section at each support, rad; shape (n,).
        reaction: force of each support against the load, N; shape (n,).
        force_A: part of the force carried by beam AC, N.
        moment_A: moment that beam BC exerts on AC at C, N mm (0 for `independent`).
    """

    w_C: Float[Array, ""]
    theta_C: Float[Array, ""]
    w: Float[Array, " n"]
    theta: Float[Array, " n"]
    reaction: Float[Array, " n"]
    force_A: Float[Array, ""]
    moment_A: Float[Array, ""]


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


def add_span(g: Compliance, h, EI, GA=None) -> Compliance:
    """Tip compliance after a span of length h: bending exactly, shear if GA is given."""
    a, b, c, det = g
    f = h / EI
    det = det + f * (a + h * (b + h * (c / 3 + f / 12)))
    a = a + h * (2 * b + h * (c + f / 3))
    if GA is not None:
        a = a + h / GA
        det = det + (h / GA) * (c + f)
    return Compliance(a, b + h * (c + f / 2), c + f, det)


def add_support(g: Compliance, k) -> Compliance:
    """Tip compliance after a support of stiffness k at the tip (one redundant released).

    c - k b^2 q is written as (c + k det) q, which subtracts nothing.
    """
    a, b, c, det = g
    q = 1 / (1 + k * a)
    return Compliance(a * q, b * q, c * q + (k * q) * det, det * q)


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


def _reach(sides: _Side, beam: Beam, s_c) -> _Tips:
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

    g, free = jax.vmap(one)(sides, last, count)
    return _Tips(g, free, jnp.stack([s_c, beam.length - s_c]), last, count)


def _side(tree, i):
    return jax.tree.map(lambda v: v[i], tree)


class _Joint(NamedTuple):
    """Two sides joined at C, for a unit force there: G_A (G_A + S G_B S)^-1 S G_B S and its parts.

    S = diag(1, -1) mirrors side B. V, M: load on each side in its own signs; w, theta: motion of C;
    `inverse`: entries of the symmetric (G_A + S G_B S)^-1. Products are divided by a_A + a_B before
    they are summed, to stay within the range of float32.
    """

    w: Float[Array, ""]
    theta: Float[Array, ""]
    V: Float[Array, "2"]
    M: Float[Array, "2"]
    inverse: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]


def _join(A: Compliance, B: Compliance) -> _Joint:
    """Deflection and rotation agree at C; every result but theta is a sum of positive terms."""
    scale = A.a + B.a
    a_A, a_B, b_A, b_B = A.a / scale, B.a / scale, A.b / scale, B.b / scale
    det_A, det_B = A.det / scale, B.det / scale
    det = det_A + det_B + a_A * B.c + a_B * A.c + 2 * b_A * B.b
    V_A = (det_B + a_B * A.c + b_A * B.b) / det
    V_B = (det_A + a_A * B.c + b_A * B.b) / det
    M = -(b_A * B.a + A.a * b_B) / det
    return _Joint(
        w=(a_A * det_B + a_B * det_A) * (scale / det),
        theta=(A.b * det_B - B.b * det_A) / det,
        V=jnp.stack([V_A, V_B]),
        M=jnp.stack([M, M]),
        inverse=((A.c + B.c) / scale / det, (b_B - b_A) / det, 1 / det),
    )


def _force_shares(s):
    """Paper eq. 3: F_AC : F_BC = L_BC^3 : L_AC^3."""
    cubes = (s / jnp.sum(s)) ** 3
    return cubes[::-1] / jnp.sum(cubes)


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
    sides = _sweep_both(beam)

    def one(s):
        tips = _reach(sides, beam, s)
        if split == "independent":
            return jnp.sum(_force_shares(tips.s) ** 2 * tips.g.a)
        return _join(_side(tips.g, 0), _side(tips.g, 1)).w

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
    sides = _sweep_both(beam, ring_load)
    tips = _reach(sides, beam, s_c)
    w_C, theta_C, V, M = _split_load(tips, force, split)
    w, theta, R = jax.vmap(_back_substitute)(sides, tips.last, tips.count, V, M)
    in_A = beam.x <= s_c
    join = lambda v, sign: jnp.where(in_A, v[0], sign * v[1][::-1])  # noqa: E731
    return Deflection(w_C, theta_C, join(w, 1), join(theta, -1), join(R, 1), V[0], M[0])


def _split_load(tips: _Tips, force, split):
    """Motion (w, theta) of C; force and moment there on both sides (A, B), in their own signs."""
    g, free = tips.g, tips.free
    if split == "independent":
        shares = _force_shares(tips.s)
        V = shares * force
        w, theta = g.a * V, g.b * V
        if free is not None:
            w, theta = w + free[0], theta + free[1]
        return jnp.sum(shares * w), theta[0], V, jnp.zeros_like(V)
    joint = _join(_side(g, 0), _side(g, 1))
    w, theta, V, M = (v * force for v in joint[:4])
    if free is not None:
        # Misfit of the free motions at C, closed by a force and a moment between the two sides.
        gap_w, gap_theta = free[0][1] - free[0][0], -free[1][1] - free[1][0]
        vv, vm, mm = joint.inverse
        dV, dM = vv * gap_w + vm * gap_theta, vm * gap_w + mm * gap_theta
        w = w + free[0][0] + g.a[0] * dV + g.b[0] * dM
        theta = theta + free[1][0] + g.b[0] * dV + g.c[0] * dM
        V, M = V + jnp.stack([dV, -dV]), M + jnp.stack([dM, dM])
    return w, theta, V, M


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


def _influence(beam: Beam, s):
    """Influence coefficients of one cantilever of length s: unit forces at rings, V and M at tip.

    Returns the (n + 2, n + 2) matrix of displacements int m_p m_q / EI dx (+ shear) and the
    (n + 1, n + 2) matrix of rotations at the rings and the tip, each integral exact by Simpson's
    rule span by span. Rows of rings beyond the tip are those of a ring at the tip; mask them.
    """
    ends = jnp.concatenate([jnp.zeros_like(beam.x[:1]), jnp.minimum(beam.x, s), s[None]])
    low, high = ends[:-1], ends[1:]
    points = jnp.stack([low, (low + high) / 2, high])
    at = ends[1:]
    arm = jnp.maximum(at[:, None, None] - points[None], 0)
    m = jnp.concatenate([arm, jnp.ones_like(arm[:1])])
    weight = jnp.array([1, 4, 1], s.dtype)[:, None] * ((high - low) / (6 * beam.EI))[None]
    displacement = jnp.einsum("pts,qts,ts->pq", m, m, weight)
    before = (at[:, None] >= high[None]).astype(s.dtype)
    if beam.GA is not None:
        cut = jnp.concatenate([before, jnp.zeros_like(before[:1])])
        displacement = displacement + jnp.einsum("ps,qs,s->pq", cut, cut, (high - low) / beam.GA)
    return displacement, jnp.einsum("ps,qts,ts->pq", before, m, weight)


def _dense_side(beam: Beam, s, held):
    """Redundants of one cantilever for unit V and M at its tip: (delta + I/k) R = Delta."""
    n = beam.x.shape[0]
    displacement, rotation = _influence(beam, s)
    both = held[:, None] & held[None]
    flexibility = jnp.where(both, displacement[:n, :n], 0)
    flexibility = flexibility + jnp.diag(1 / jnp.where(held, beam.k, 1))
    load = jnp.where(held[:, None], displacement[:n, n:], 0)
    R = jnp.linalg.solve(flexibility, load)
    tip = displacement[n:, n:] - load.T @ R
    theta = rotation[:n, n:] - jnp.where(held[None], rotation[:n, :n], 0) @ R
    det = tip[0, 0] * tip[1, 1] - tip[0, 1] ** 2
    return Compliance(tip[0, 0], tip[0, 1], tip[1, 1], det), R, theta


def deflect_dense(
    beam: Beam, s_c: Float[Array, ""], force: Float[Array, ""], *, split: Split = "continuous"
) -> Deflection:
    """The paper's own algorithm: all redundant reactions of a side from one dense system.

    Same arguments and result as `deflect` with `form="reactions"`. Loses digits where rings are
    much stiffer than the ligament (docs/beam_accuracy.md has the table).
    """
    mirrored = Beam(
        (beam.length - beam.x)[::-1],
        beam.length,
        beam.EI[::-1],
        beam.k[::-1],
        None if beam.GA is None else beam.GA[::-1],
    )
    in_A = beam.x <= s_c
    s = jnp.stack([s_c, beam.length - s_c])
    held = jnp.stack([in_A, ~in_A[::-1]])
    stacked = jax.tree.map(lambda v, w: jnp.stack([v, w]), beam, mirrored)
    g, R, theta = jax.vmap(_dense_side)(stacked, s, held)
    count = jnp.sum(held, axis=1)
    w_C, theta_C, V, M = _split_load(_Tips(g, None, s, jnp.zeros_like(s), count), force, split)
    tip = jnp.stack([V, M], axis=1)
    R, theta = jnp.einsum("sip,sp->si", R, tip), jnp.einsum("sip,sp->si", theta, tip)
    R = jnp.where(in_A, R[0], R[1][::-1])
    theta = jnp.where(in_A, theta[0], -theta[1][::-1])
    return Deflection(w_C, theta_C, R / beam.k, theta, R, V[0], M[0])
