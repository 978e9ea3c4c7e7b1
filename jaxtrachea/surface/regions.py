r"""Global shape: the motion of the skeleton's key points carried to every vertex (paper 2.4).

The key points lie on three lines along the tube: J at phi_c, and the ring ends U at -alpha and V at
+alpha; on each, at the clamp A, the rings and the clamp B (the nodes). The contact C splits the J
line; of a tool with a width its two edges do, of several tools all contacts. Along the tube a
vertex lies in a patch between two nodes, round the tube in one of three regions, U-J, J-V and the
back V-U. The three lines are interpolated along s, then linearly in phi.

- `linear`: displacement vectors, linear between the key points.
- `hermite` (default): the same, but the transverse displacement of the J line is the beam's cubic,
  exact for a beam without shear flexibility.
- `phong`: as printed, magnitude and the angle to the normal are interpolated, linear between the
  key points. One angle does not fix a direction: it is carried as two, in the cross-section and
  out of it (module `phong`).

Vectors are along (tangent, anterior, lateral) of the centreline, in mm. `bind` is done once for a
mesh, `weigh` once for an angle of contact.
"""

import functools
import math
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import check_word, without_program
from jaxtrachea._linear import linear, replaced
from jaxtrachea._numerics import added, epsilon, total
from jaxtrachea.surface import phong
from jaxtrachea.surface.blocks import Blocks, in_blocks, to_blocks, to_vertices
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh

Method = Literal["linear", "hermite", "phong"]

#: Least angle between the J line and the lines U and V, rad; see `weigh`.
NARROWEST = 0.05


class Binding(eqx.Module):
    """Where every vertex stands among the nodes; depends on the rest state alone.

    Attributes:
        s: position along the centreline, mm; shape (blocks, width), see `blocks`.
        phi: angle round it, rad.
        fraction: way to the node above, in [0, 1].
        patch: index of the node below the vertices of each block.
        nodes: A, rings, B, mm; shape (nodes,).
        half_angle: of the rings, rad.
        blocks: in which the vertices stand; None: each is a block of its own.
    """

    s: Float[Array, "blocks width"]
    phi: Float[Array, "blocks width"]
    fraction: Float[Array, "blocks width"]
    patch: Int[Array, " blocks"]
    nodes: Float[Array, " nodes"]
    half_angle: Float[Array, ""]
    blocks: Blocks | None = None


class Weights(eqx.Module):
    """Share of the lines U, J and V in the motion of every vertex; they add up to 1.

    Attributes:
        lines: of U, J and V; one array, since the processor then computes them in one loop.
        phi_c: angle of contact, rad.
    """

    lines: Float[Array, "3 blocks width"]
    phi_c: Float[Array, ""]

    U = property(lambda self: self.lines[..., 0, :, :])
    J = property(lambda self: self.lines[..., 1, :, :])
    V = property(lambda self: self.lines[..., 2, :, :])


class Keys(eqx.Module):
    """Motion of the key points; rows are A, the rings, B (see `clamped`).

    Attributes:
        s_c: contact position, mm; of a tool with a width the two positions of its edges, of several
            tools all of these, in order.
        contact: displacement of C with the skeleton, mm; shape (3,). Of each place, if they differ.
        joints: displacement of the J line at the nodes, mm; shape (nodes, 3).
        U: displacement of the ring ends at -alpha, mm; shape (nodes, 3).
        V: displacement of the ring ends at +alpha, mm; shape (nodes, 3).
        slopes: d/ds of the (y, z) displacement of the J line at the nodes; shape (nodes, 2). Only
            `hermite` needs it.
        contact_slope: the same at C; shape (2,). At each of several places: shape (places, 2).
    """

    s_c: Float[Array, "*places"]
    contact: Float[Array, "*own 3"]
    joints: Float[Array, "nodes 3"]
    U: Float[Array, "nodes 3"]
    V: Float[Array, "nodes 3"]
    slopes: Float[Array, "nodes 2"] | None = None
    contact_slope: Float[Array, "*places 2"] | None = None


def clamped(
    s_c: Float[Array, "*places"],
    contact: Float[Array, "*own 3"],
    joints: Float[Array, "rings 3"],
    U: Float[Array, "rings 3"],
    V: Float[Array, "rings 3"],
    slopes: Float[Array, "rings 2"] | None = None,
    contact_slope: Float[Array, "*places 2"] | None = None,
    *,
    clamps: Float[Array, "2 3"] | None = None,
) -> Keys:
    """Keys of a tube whose ends do not turn.

    Args:
        s_c: contact position, mm; or several in order, see `Keys`.
        contact: displacement of C, mm; of each place, if they differ.
        joints: displacement of the joints J_i, mm; so for `U` and `V`.
        U: of the ring ends at -alpha.
        V: of the ring ends at +alpha.
        slopes: d/ds of (y, z) at the joints.
        contact_slope: the same at C, or at each place.
        clamps: displacement of the ends A and B of the tube as a whole, mm; None: held.
    """
    held = jnp.zeros(3, contact.dtype)
    first, last = (held, held) if clamps is None else clamps

    def between(a, rows, b):
        return jnp.concatenate([a[None], rows, b[None]])

    joints, U, V = (between(first, rows, last) for rows in (joints, U, V))
    if slopes is not None:
        slopes = between(held[:2], slopes, held[:2])
    return Keys(s_c, contact, joints, U, V, slopes, contact_slope)


def bind(mesh: Mesh, geometry: Geometry, known: Binding | None = None) -> Binding:
    """Find the patch of every vertex and the fraction of the way through it.

    Args:
        geometry: with the rings.
        known: binding of the same mesh to other rings: spares sorting the vertices anew.
    """
    given = (mesh.s, mesh.phi, geometry, known)
    xp = _library(given)
    inner, length, s, phi = (
        xp.asarray(v) for v in (geometry.ring_positions, geometry.length, mesh.s, mesh.phi)
    )
    nodes = xp.concatenate([xp.zeros_like(inner[:1]), inner, length[None]])
    patch = xp.searchsorted(inner, s, side="right").astype(np.int32)
    before = None if known is None else known.blocks
    blocks = in_blocks(mesh.s, without_program(patch), nodes.shape[0] - 1, before)
    xp = _library((given, blocks))  # within a traced function blocks are traced in any case
    s, phi, patch = (to_blocks(xp.asarray(v), blocks) for v in (s, phi, patch))
    nodes, patch = xp.asarray(nodes), patch[:, 0]
    low, high = (nodes[v][:, None] for v in (patch, patch + 1))
    fraction = xp.clip((s - low) / (high - low), 0, 1)
    s = xp.clip(s, nodes[0], nodes[-1])
    s, phi, fraction, patch, nodes = (without_program(v) for v in (s, phi, fraction, patch, nodes))
    return Binding(s, phi, fraction, patch, nodes, geometry.half_angle, blocks)


def _library(values):
    """The numpy of concrete numbers, for which nothing is compiled, or that of traced ones."""
    return jnp if any(isinstance(v, Tracer) for v in jax.tree.leaves(values)) else np


def weigh(binding: Binding, phi_c: Float[Array, ""]) -> Weights:
    """Angular shares of the lines U, J and V, linear in phi within each region.

    As phi_c comes closer than `NARROWEST` to an end of the rings, the line of that end steps back
    into the membrane to keep this distance: the motion stays continuous, its derivatives bounded
    and C itself exact, while the key at the ring end is met up to 0.05 rad off its place.

    Args:
        binding: from `bind`.
        phi_c: angle of contact, rad, in [-alpha, alpha].

    Returns:
        The weights; NaN if C lies behind the ends of the rings.
    """
    shares = line_shares(binding.phi, phi_c, binding.half_angle)
    return Weights(jnp.stack(shares), phi_c)


@jax.custom_jvp
def line_shares(
    phi: Float[Array, "*many"], phi_c: Float[Array, ""], alpha: Float[Array, ""]
) -> tuple[Array, ...]:
    """Of U, J and V at the angles phi; see `weigh`."""
    on = jnp.abs(phi_c) <= alpha * (1 + 8 * epsilon(phi.dtype))
    to_U = jnp.maximum(alpha, NARROWEST - phi_c)
    to_V = jnp.maximum(alpha, NARROWEST + phi_c)
    # One division for all vertices of a region. Hidden by NaN: behind the ends of the rings.
    hidden = jnp.where(on, 1, jnp.nan).astype(phi.dtype)
    from_U = jnp.clip((phi + to_U) * (hidden / (phi_c + to_U)), 0, 1)
    from_V = jnp.clip((to_V - phi) * (hidden / (to_V - phi_c)), 0, 1)
    behind = jnp.maximum(phi - to_V, -phi - to_U) * (1 / (2 * math.pi - to_U - to_V))
    behind = jnp.clip(behind, 0, 1)
    U = (1 - from_U) * (1 - behind) + (1 - from_V) * behind
    V = (1 - from_V) * (1 - behind) + (1 - from_U) * behind
    return U, from_U * from_V, V


@functools.partial(line_shares.defjvp, symbolic_zeros=True)
def _line_shares_jvp(primals, tangents):
    """Going back, how all of them change by one angle comes before what that adds up to."""
    moving = [i for i, v in enumerate(tangents) if not isinstance(v, SymbolicZero)]

    def along(fixed, i, v):
        return jax.jvp(lambda v: line_shares.fun(*replaced(fixed, [i], [v])), (fixed[i],), (v,))[1]

    def push(fixed, tangents):
        terms = [along(fixed, i, v) for i, v in zip(moving, tangents, strict=True)]
        return [added(of_one) for of_one in zip(*terms, strict=True)]

    def pull(fixed, cotangents):
        out = []
        for i in moving:
            rises = along(fixed, i, jnp.ones_like(fixed[i]))
            pairs = zip(cotangents, rises, strict=True)
            by_each = added(g * v for g, v in pairs if g is not None)
            out.append(by_each if i == 0 else total(total(by_each).ravel()))
        return out

    out = line_shares(*primals)
    return out, tuple(linear(push, pull, primals, [tangents[i] for i in moving], out))


def interpolate(
    binding: Binding, weights: Weights, keys: Keys, *, method: Method = "hermite"
) -> Float[Array, "vertices 3"]:
    """Displacement of every vertex along (tangent, anterior, lateral), mm.

    Args:
        binding: from `bind`.
        weights: from `weigh`.
        keys: motion of the key points.
        method: see module docstring.

    Raises:
        ValueError: an unknown `method`, `hermite` without slopes, or keys for another number of
            rings.
    """
    check_word("method", method, Method)
    if keys.joints.shape[0] != binding.nodes.shape[0]:
        raise ValueError(
            f"keys have {keys.joints.shape[0]} rows; expected {binding.nodes.shape[0]}, "
            "one for A, each ring and B (see `clamped`)"
        )
    if method == "phong":
        return _phong(binding, weights, keys)
    slopes = None
    if method == "hermite":
        if keys.slopes is None or keys.contact_slope is None:
            raise ValueError("method='hermite' needs slopes and contact_slope; or use 'linear'")
        slopes = keys.slopes, keys.contact_slope
    u = _carry(binding, weights, keys.s_c, keys.joints, keys.contact, keys.U, keys.V, slopes)
    return to_vertices(u, binding.blocks)


def _carry(binding: Binding, weights: Weights, s_c, joints, contact, U, V, slopes=None):
    """Along the tube between the nodes, round it between the lines.

    Each by itself: of the lines all arrays are small, and the processor takes several vertices of a
    block at a time. With `to_vertices` in one loop it would take one after the other.

    Returns:
        Shape (blocks, components, width).
    """

    def lines(s_c, joints, contact, U, V, slopes):
        line = _joint_line(binding.nodes, s_c, joints, contact, slopes)
        return jnp.concatenate([*line, *_ends(U, s_c), *_ends(V, s_c)], axis=1)

    def across(weights, s_c, patches):
        beyond = tuple(binding.s >= s for s in _each(s_c))

        # Of the patch that C splits, a vertex belongs to the lower or to the upper part. What a
        # block needs of all parts is read at once.
        def read(patch):
            return jax.lax.dynamic_slice_in_dim(patches, patch, 1 + len(beyond))

        rows = jax.vmap(read)(binding.patch)
        shares = weights.U, weights.J, weights.V
        return _combine(shares, binding.fraction, binding.s, beyond, rows)

    return across(weights, s_c, lines(s_c, joints, contact, U, V, slopes))


def _ends(values, s_c):
    """What there is at a node and how it rises to the next; rows as of `_joint_line`."""
    above = jnp.concatenate([values[1:], *[values[-1:]] * len(_each(s_c))])
    below = jnp.concatenate([values, *[values[-1:]] * (len(_each(s_c)) - 1)])
    return below, above - below


def _joint_line(nodes, s_c, joints, contact, slopes: tuple[Array, Array] | None = None):
    """The J line, with C (or both edges of the tool, or all of several) as further nodes.

    Linear between the nodes; where `slopes` are given (nodes, C), the last components are cubic.

    Returns:
        Columns, of shape (nodes, ...): where each patch begins, mm; one over its length; the
        coefficients of 1, t, t^2, t^3 in it, t = 0..1, of each component.
    """
    values, below = joints, []
    for i, s in enumerate(_each(s_c)):
        below.append(jnp.sum(nodes[1:-1] <= s))
        own = contact if contact.ndim == 1 else contact[i]
        nodes, values = _insert(nodes, s, below[-1]), _insert(values, own, below[-1])
    span, low, high = jnp.diff(nodes), values[:-1], values[1:]
    leave = land = high - low
    if slopes is not None:
        turn = slopes[0]
        for own, at in zip(_each(slopes[1], 1), below, strict=True):
            turn = _insert(turn, own, at)
        straight = leave[:, : leave.shape[1] - turn.shape[1]]
        leave, land = (
            jnp.concatenate([straight, span[:, None] * v], 1) for v in (turn[:-1], turn[1:])
        )
    rise = high - low
    cubic = low, leave, 3 * rise - 2 * leave - land, leave + land - 2 * rise
    return nodes[:-1, None], 1 / jnp.where(span > 0, span, jnp.inf)[:, None], *cubic


def _each(v, dimensions: int = 0):
    """What there is at the contact, or at each of several places."""
    return [v] if v.ndim == dimensions else [v[i] for i in range(v.shape[0])]


@jax.custom_jvp
def _combine(shares, fraction, s, beyond, rows):
    """Values of the three lines at the vertices, times their weights.

    Args:
        shares: U, J and V; shape (blocks, width) each.
        fraction: way through the whole patch; shape (blocks, width), as all of the vertices.
        s: of the vertices, mm.
        beyond: whether on the side away from A; of C, or of each place in order.
        rows: of each part of a block's patch, shape (blocks, parts, 2 + 8 components): what
            `_joint_line` gives; then, of the first part alone, U, U by fraction, V and V by it.

    Derivatives by `rows` are two matrix products for each block, the moments of t on each side of C
    and those of U and V; by the rest, sums over the three components. Of the plain sums the
    compiler makes, going back, a reduction over the vertices for each column of the rows, and
    computes everything anew in each (CPU; three times slower).
    """
    U, J, V, f = (v[:, None] for v in (*shares, fraction))
    line, _, (u, along_u, v, along_v) = _lines(_way(s, beyond, rows), beyond, rows)
    return U * (u + f * along_u) + J * line + V * (v + f * along_v)


def _chosen(beyond, parts):
    """At each vertex what there is of its part of the patch."""
    return functools.reduce(
        lambda found, other: jnp.where(other[0], other[1], found),
        zip(beyond, parts[1:], strict=True), parts[0],
    )  # fmt: skip


def _way(s, beyond, rows):
    """The way t of the vertices through their part of the patch."""
    begin, density = (rows[:, :, i, None] for i in (0, 1))
    return _chosen(beyond, list(((s[:, None] - begin) * density).swapaxes(0, 1)))


def _coefficients(row):
    """Of 1, t, t^2, t^3, U, U by fraction, V, V by fraction; shape (blocks, components) each."""
    return jnp.split(row[:, 2:], 8, axis=1)


def _lines(t, beyond, rows):
    """The line J and its slope in t at the vertices, and what there is of the other two."""
    t, past = t[:, None], [v[:, None] for v in beyond]
    parts = [[v[:, :, None] for v in _coefficients(rows[:, i])] for i in range(rows.shape[1])]
    lines = zip(*(of_part[:4] for of_part in parts), strict=True)
    a, b, c, d = (_chosen(past, of_one) for of_one in lines)
    return a + t * (b + t * (c + t * d)), b + t * (2 * c + 3 * t * d), parts[0][4:]


@functools.partial(_combine.defjvp, symbolic_zeros=True)
def _combine_jvp(primals, tangents):
    (shares, fraction, s, beyond, rows), d = primals, tangents
    # By whatever moves: in a scene the rings are at rest, and often the contact is.
    changes = [*d[0], d[1], d[2], d[4]]
    moving = [i for i, v in enumerate(changes) if not isinstance(v, SymbolicZero)]

    def push(fixed, tangents):
        shares, fraction, s, rows, beyond = parted = _parted(fixed)
        slopes, by = _slopes(*parted), dict(zip(moving, tangents, strict=True))
        terms = [slopes[i] * by[i][:, None] for i in by if i < 5]
        if 5 in by:
            moved = jnp.concatenate([rows[:, :, :2], by[5][:, :, 2:]], axis=2)
            change = _combine.fun(shares, fraction, s, beyond, moved)
            begin, density = (rows[:, :, i, None] for i in (0, 1))
            d_begin, d_density = (by[5][:, :, i, None] for i in (0, 1))
            rates = (s[:, None] - begin) * d_density - density * d_begin
            rate = _chosen(beyond, list(rates.swapaxes(0, 1)))
            terms += [change, slopes[5] * rate[:, None]]
        return [added(terms)]

    def pull(fixed, cotangents):
        parted, (g,) = _parted(fixed), cotangents
        slopes = _slopes(*parted)

        def by_vertex(i):
            return added(slopes[i][:, c] * g[:, c] for c in range(g.shape[1]))

        return [by_vertex(i) if i < 5 else _of_rows(*parted, g) for i in moving]

    fixed = [*shares, fraction, s, rows, *beyond]
    out = _combine(*primals)
    return out, linear(push, pull, fixed, [changes[i] for i in moving], [out])[0]


def _parted(fixed):
    """Shares, fraction, s, rows; beyond."""
    return fixed[:3], fixed[3], fixed[4], fixed[5], fixed[6:]


def _slopes(shares, fraction, s, rows, beyond):
    """Of `_combine`, by U, J, V, fraction, s and t; shape (blocks, components, width) each."""
    U, J, V, f = (v[:, None] for v in (*shares, fraction))
    line, rise, (u, along_u, v, along_v) = _lines(_way(s, beyond, rows), beyond, rows)
    density = _chosen(beyond, list(rows[:, :, 1, None].swapaxes(0, 1)))[:, None]
    by_t = J * rise
    return u + f * along_u, line, v + f * along_v, U * along_u + V * along_v, by_t * density, by_t


def _of_rows(shares, fraction, s, rows, beyond, g):
    """Cotangent of the rows of `_combine`."""
    U, J, V, t, f = (v[:, None] for v in (*shares, _way(s, beyond, rows), fraction))
    # Chosen by place: all rows are one loop then; stacked, each would be its own.
    place, (blocks, parts) = jnp.arange(8)[None, :, None], rows.shape[:2]
    power = jnp.where(place > 1, t * t, 1) * jnp.where(place % 2 == 1, t, 1)
    across = jnp.where(place > 5, V, U) * jnp.where(place % 2 == 1, f, 1)
    basis = jnp.where(place < 4, J * power, across)
    own, rest = [], jnp.ones_like(beyond[0])
    for past in beyond:
        own.append(rest & ~past)
        rest = rest & past
    own = jax.lax.optimization_barrier(jnp.stack([*own, rest], axis=1))
    sides = jnp.where(own[:, :, None], g[:, None], 0)
    moments = jnp.einsum("bkw,bpcw->bpkc", basis, sides, precision="highest")
    line, ends = moments[:, :, :4], added(moments[:, i, 4:] for i in range(parts))
    # What t does at the rows' own begin and length, by its moments on each side.
    times = jnp.arange(1, 4, dtype=g.dtype)[None, None, :, None]
    turned = times * rows[:, :, 2:].reshape(blocks, parts, 8, -1)[:, :, 1:4]
    whole, moment = (jnp.sum(turned * line[:, :, i : i + 3], axis=(2, 3)) for i in (0, 1))
    # In a part without length, whose density is 0, a vertex is at its begin.
    density = rows[:, :, 1]
    moment = jnp.where(density != 0, moment / jnp.where(density != 0, density, 1), 0)
    first = jnp.where(jnp.arange(parts)[None, :, None] == 0, ends.reshape(blocks, 1, -1), 0)
    head = jnp.stack([-density * whole, moment], axis=2)
    return jnp.concatenate([head, line.reshape(blocks, parts, -1), first], axis=2)


def _insert(rows, row, below):
    """`rows` with `row` after the index `below`."""
    order = jnp.arange(rows.shape[0] + 1).reshape((-1,) + (1,) * (rows.ndim - 1))
    before, after = jnp.concatenate([rows, rows[-1:]]), jnp.concatenate([rows[:1], rows])
    return jnp.where(order <= below, before, jnp.where(order == below + 1, row[None], after))


def _phong(binding: Binding, weights: Weights, keys: Keys):
    """Interpolate magnitude and angles to the normal, linear between the key points."""
    # The pole is the inward normal at C for a press, else the outward one; the turn jumps at the
    # opposite pole only, far from where the displacements are.
    phi_c, C = weights.phi_c, keys.contact
    outward = phong.radial(phi_c, C if C.ndim == 1 else jnp.sum(C, axis=0)) > 0
    pole = jnp.where(outward, 1, -1).astype(phi_c.dtype)

    fade = jax.lax.stop_gradient(phong.FADE * (binding.nodes[-1] - binding.nodes[0]))

    def encode(v):
        return phong.encode(v, phi_c, pole, fade)

    joints, U, V = (encode(v.T).T for v in (keys.joints, keys.U, keys.V))
    channels = _carry(binding, weights, keys.s_c, joints, encode(C.T).T, U, V)
    u = phong.decode(channels.swapaxes(0, 1), phi_c, pole).swapaxes(0, 1)
    return to_vertices(u, binding.blocks)
