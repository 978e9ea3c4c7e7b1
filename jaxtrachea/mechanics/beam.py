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
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import solve_2x2

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

    a: mm/N; b: 1/N (deflection per moment = rotation per force); c: 1/(N mm). Any common shape.
    """

    a: Float[Array, "*s"]
    b: Float[Array, "*s"]
    c: Float[Array, "*s"]


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

    `after` holds n + 1 entries: at the clamp (zero), then after each ring with that ring included.
    `free` is the motion (w, theta) of the same nodes under ring loads alone, None without them.
    """

    x: Float[Array, "*side n"]
    EI: Float[Array, "*side spans"]
    GA: Float[Array, "*side spans"] | None
    k: Float[Array, "*side n"]
    load: Float[Array, "*side n"] | None
    after: Compliance
    free: tuple[Float[Array, "*side spans"], Float[Array, "*side spans"]] | None


def add_span(g: Compliance, h, EI, GA=None) -> Compliance:
    """Tip compliance after a span of length h: bending exactly, shear if GA is given."""
    a, b, c = g
    f = h / EI
    a = a + h * (2 * b + h * (c + f / 3))
    if GA is not None:
        a = a + h / GA
    return Compliance(a, b + h * (c + f / 2), c + f)


def add_support(g: Compliance, k) -> Compliance:
    """Tip compliance after a support of stiffness k at the tip (one redundant released)."""
    a, b, c = g
    q = 1 / (1 + k * a)
    return Compliance(a * q, b * q, c - (b * q) * (k * b))


def _sweep(x, EI, k, GA, load) -> _Side:
    """Carry the compliance (and the free motion under ring loads) from the clamp over all rings."""
    zero = jnp.zeros_like(x[0])
    h = jnp.diff(x, prepend=jnp.zeros_like(x[:1]))

    def step(carry, ring):
        g, free = carry
        h_i, EI_i, GA_i, k_i, load_i = ring
        g = add_span(g, h_i, EI_i, GA_i)
        if load_i is not None:
            w, theta = free[0] + h_i * free[1], free[1]
            pull = (load_i - k_i * w) / (1 + k_i * g.a)
            free = (w + g.a * pull, theta + g.b * pull)
        g = add_support(g, k_i)
        return (g, free), (g, free)

    start = (Compliance(zero, zero, zero), None if load is None else (zero, zero))
    rings = (h, EI[:-1], None if GA is None else GA[:-1], k, load)
    _, nodes = jax.lax.scan(step, start, rings)
    with_clamp = lambda v: jnp.concatenate([jnp.zeros_like(v[:1]), v])  # noqa: E731
    after, free = jax.tree.map(with_clamp, nodes)
    return _Side(x, EI, GA, k, load, after, free)


def _sweep_both(beam: Beam, ring_load=None) -> _Side:
    """Sweeps from A and from B, stacked on a leading axis; independent of the contact position."""
    both = lambda v, w: jnp.stack([v, w[::-1]])  # noqa: E731
    same = lambda v: None if v is None else both(v, v)  # noqa: E731
    x = both(beam.x, beam.length - beam.x)
    return jax.vmap(_sweep)(x, same(beam.EI), same(beam.k), same(beam.GA), same(ring_load))


class _Tips(NamedTuple):
    """Both sides at C: compliance, free motion, distance from the clamp, and the rings held."""

    g: Compliance
    free: tuple[Float[Array, "2"], Float[Array, "2"]] | None
    s: Float[Array, "2"]
    held: Bool[Array, "2 n"]


def _reach(sides: _Side, length, s_c) -> _Tips:
    """Add the last span of each side, up to C. A ring exactly at C belongs to side A."""
    s = jnp.stack([s_c, length - s_c])
    in_A = sides.x[0] <= s_c
    held = jnp.stack([in_A, ~in_A[::-1]])

    def one(side, s_i, count):
        at = lambda v: jax.lax.dynamic_index_in_dim(v, count, keepdims=False)  # noqa: E731
        h = s_i - at(jnp.concatenate([jnp.zeros_like(side.x[:1]), side.x]))
        g, free, EI, GA = jax.tree.map(at, (side.after, side.free, side.EI, side.GA))
        free = None if free is None else (free[0] + h * free[1], free[1])
        return add_span(g, h, EI, GA), free

    g, free = jax.vmap(one)(sides, s, jnp.sum(held, axis=1))
    return _Tips(g, free, s, held)


def _side(tree, i):
    return jax.tree.map(lambda v: v[i], tree)


def _share(own: Compliance, other: Compliance, V, M, gap=(0.0, 0.0)):
    """Part of the load (V, M) at C that one side carries, in that side's own signs.

    (G + S G' S)^-1 (S G' S (V, M) + gap), S = diag(1, -1); `gap` is the misfit of the free motions.
    Written per side (never as the remainder of the other) so that a small share keeps its digits.
    """
    r1 = other.a * V - other.b * M + gap[0]
    r2 = other.c * M - other.b * V + gap[1]
    return solve_2x2(own.a + other.a, own.b - other.b, own.c + other.c, r1, r2)


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
        tips = _reach(sides, beam.length, s)
        A, B = _side(tips.g, 0), _side(tips.g, 1)
        if split == "independent":
            f = _force_shares(tips.s)
            return f[0] ** 2 * A.a + f[1] ** 2 * B.a
        V, M = _share(A, B, 1.0, 0.0)
        return A.a * V + A.b * M

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
            ring_load_i) / k_i.

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
    tips = _reach(sides, beam.length, s_c)
    V, M = _split_load(tips, force, split)
    w, theta, R = jax.vmap(_back_substitute)(sides, tips.s, tips.held, V, M)
    ends = tips.g.a * V + tips.g.b * M, tips.g.b * V + tips.g.c * M
    if tips.free is not None:
        ends = ends[0] + tips.free[0], ends[1] + tips.free[1]
    shares = _force_shares(tips.s)
    w_C = jnp.sum(shares * ends[0]) if split == "independent" else ends[0][0]
    join = lambda v, sign: jnp.where(tips.held[0], v[0], sign * v[1][::-1])  # noqa: E731
    return Deflection(w_C, ends[1][0], join(w, 1), join(theta, -1), join(R, 1), V[0], M[0])


def _split_load(tips: _Tips, force, split):
    """Force and moment at C on both sides (A, B), each in its own signs."""
    if split == "independent":
        V = _force_shares(tips.s) * force
        return V, jnp.zeros_like(V)
    A, B = _side(tips.g, 0), _side(tips.g, 1)
    gap = jnp.zeros_like(force), jnp.zeros_like(force)
    if tips.free is not None:
        u, phi = tips.free
        gap = u[1] - u[0], -phi[1] - phi[0]
    V_A, M_A = _share(A, B, force, 0.0, gap)
    V_B, M_B = _share(B, A, force, 0.0, (-gap[0], gap[1]))
    return jnp.stack([V_A, V_B]), jnp.stack([M_A, M_B])


def _back_substitute(side: _Side, s, held, V, M):
    """From the load (V, M) at C back to the clamp: w, theta and R at every support."""
    far = jnp.concatenate([side.x[1:], s[None]])
    h = jnp.where(held, jnp.minimum(far, s) - side.x, 0)
    k = jnp.where(held, side.k, 0)
    load = None if side.load is None else jnp.where(held, side.load, 0)

    def step(tip, ring):
        V, M = tip
        h_i, k_i, load_i, g, free = ring
        M = M + h_i * V
        w, theta = g.a * V + g.b * M, g.b * V + g.c * M
        R = k_i * w
        if load_i is not None:
            w, theta = w + free[0], theta + free[1]
            R = k_i * w - load_i
        return (V - R, M), (w, theta, R)

    after, free = jax.tree.map(lambda v: v[1:], (side.after, side.free))
    _, out = jax.lax.scan(step, (V, M), (h, k, load, after, free), reverse=True)
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
    return Compliance(tip[0, 0], tip[0, 1], tip[1, 1]), R, theta


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
    V, M = _split_load(_Tips(g, None, s, held), force, split)
    tip = jnp.stack([V, M], axis=1)
    R, theta = jnp.einsum("sip,sp->si", R, tip), jnp.einsum("sip,sp->si", theta, tip)
    ends = g.a * V + g.b * M, g.b * V + g.c * M
    w_C = jnp.sum(_force_shares(s) * ends[0]) if split == "independent" else ends[0][0]
    R = jnp.where(in_A, R[0], R[1][::-1])
    theta = jnp.where(in_A, theta[0], -theta[1][::-1])
    return Deflection(w_C, ends[1][0], R / beam.k, theta, R, V[0], M[0])
