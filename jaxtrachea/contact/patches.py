r"""A tube as a row of convex patches, and the contact of a convex tool with it.

Each patch covers the tube between two borders (rings, say) and is a convex core swept by a ball
(`shapes`). Beyond its borders it runs on inside its neighbours, rounded like the end of a capsule,
so that a tool pressed in deeply is not pushed out through a border. A tube bent along its
centreline is one patch after another; the hollows between two borders are bridged.

    gap = -(1/beta) log sum_i exp(-beta gap_i)    over the patches near the tool

with the smooth signed distances gap_i of `distance`; witness points and normal are averaged with
the same weights. So everything stays smooth where the contact moves from one patch to the next.

A tool of several convex parts (`shapes.compound`) is the sum over pairs of part and patch: where
two parts are equally deep the contact goes from one to the other within some 1 / beta.

The gap is that of the whole row up to the patches left out: `Touch.left_out` is a certified lower
bound of theirs, from -h_A(d) - h_B(-d) <= distance, which holds for every unit vector d.

`straight_patches` are those of a smooth round tube, `walls.patches_of` those of a surface. Lengths
in mm.
"""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import float_dtype
from jaxtrachea._numerics import first_largest, largest, lowest, total
from jaxtrachea.contact.distance import approach, signed_distance
from jaxtrachea.contact.line import Centreline, skeleton_coordinates
from jaxtrachea.contact.pose import Pose, transform
from jaxtrachea.contact.search import LEAD, PREFERRED, STANDARD, Settings
from jaxtrachea.contact.shapes import ArrayLike, Shape, heights, sharp_support
from jaxtrachea.contact.shapes import mean as middle
from jaxtrachea.status import ContactStatus

#: Steps towards the nearest points of two cores in the broad phase.
NEARING = 6
#: Share of a patch in the contact from which its status counts.
COUNTS = 1e-3
#: Share of the size by which the place may lie beside that of the deepest part of a tool.
APART = 0.05
#: Share of the size from which on another part that touches makes a contact of its own.
SECOND = 0.25


class Patches(eqx.Module):
    """A tube as a row of convex patches.

    Attributes:
        shapes: the patches, stacked: vertices (patches, 3, n), radius (patches,).
        centres: a point inside each, mm; shape (patches, 3).
        line: the centreline, for s and phi.
        lost: how far the surface at most stands out of each patch (thinning, rounding), mm.
        filled: how far it at most lies inside of it (hollows bridged), mm.
        uncertain: patches that are not the surface; None: all are.
    """

    shapes: Shape
    centres: Float[Array, "patches 3"]
    line: Centreline
    lost: Float[Array, " patches"]
    filled: Float[Array, " patches"]
    uncertain: Bool[Array, " patches"] | None = None


class Touch(eqx.Module):
    """Where a tool touches the tube, or would first.

    Attributes:
        gap: smoothed signed distance, mm; negative: penetration.
        point: of the tube's surface nearest to (deepest in) the tool, mm; shape (3,).
        tool_point: the same of the tool.
        normal: of the tube, outward unit vector, from the tube to the tool; shape (3,).
        s: position of `point` along the centreline, mm; beyond the ends on its continuation.
        phi: its angle round the centreline from the anterior midline, rad, in (-pi, pi].
        patch: the one with the smallest gap.
        left_out: lower bound of the gaps of the patches not searched, mm; not below `gap`: none of
            them is nearer.
        bound: the gap of the sharp patches is at most this larger than `gap`, mm.
        status: a `ContactStatus` as int8.
        part: of the tool, the one with the smallest gap; None: the tool is one convex body.
    """

    gap: Float[Array, ""]
    point: Float[Array, "3"]
    tool_point: Float[Array, "3"]
    normal: Float[Array, "3"]
    s: Float[Array, ""]
    phi: Float[Array, ""]
    patch: Int[Array, ""]
    left_out: Float[Array, ""]
    bound: Float[Array, ""]
    status: Int[Array, ""]
    part: Int[Array, ""] | None = None

    @property
    def complete(self) -> Bool[Array, "*lanes"]:
        """Whether the patches left out are known to be further away."""
        return self.left_out >= self.gap


def straight_patches(borders: ArrayLike, radius: ArrayLike, *, overlap=0.5, dtype=None) -> Patches:
    """A straight round tube along x, exact: its patches are capsules, two vertices each.

    The tube runs on beyond the first and last border as a half ball; s is then outside of them.
    No polygon; what a real wall has besides (relief of the rings, flat back) is left out.

    Args:
        borders: s of the ends and of the borders between, mm, rising; shape (patches + 1,).
        radius: outer radius, mm, positive; may be traced.
        overlap: by how much a patch runs on beyond its borders before it is rounded, mm.
        dtype: of every array; the default float type of JAX if None.

    Raises:
        ValueError: naming the argument.
    """
    at = check_borders(borders)
    dtype = float_dtype(dtype)
    r = jnp.asarray(radius, dtype)
    if r.ndim != 0 or not isinstance(r, Tracer) and not float(r) > 0:
        raise ValueError(f"radius: expected a positive number, found {radius}")
    if not overlap >= 0:
        raise ValueError(f"overlap: expected a length not below 0, found {overlap}")
    count = len(at) - 1
    vertices, centres = np.zeros((count, 3, 2)), np.zeros((count, 3))
    vertices[:, 0] = np.stack([at[:-1] - overlap, at[1:] + overlap], axis=1)
    centres[:, 0] = (at[:-1] + at[1:]) / 2
    ends, zero = at[[0, -1]], np.zeros(count)
    axes = np.eye(3)[:, None].repeat(2, axis=1)

    def put(v):
        return jax.device_put(np.asarray(v, dtype))  # nothing is compiled

    line = Centreline(*map(put, (ends, ends[:, None] * axes[0], *axes[:2])))
    radii = jnp.broadcast_to(r, (count,)) if isinstance(r, Tracer) else put(np.full(count, r))
    return Patches(Shape(put(vertices), radii), put(centres), line, *[put(zero)] * 2)


def check_borders(borders) -> np.ndarray:
    """Borders as numbers, finite and rising; a ValueError otherwise."""
    at = np.asarray(borders, float)
    if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all() or np.any(np.diff(at) <= 0):
        raise ValueError(f"borders: expected two or more rising numbers, found {borders}")
    return at


def touch(
    tool: Shape,
    pose: Pose,
    patches: Patches,
    settings: Settings = STANDARD,
    *,
    near: int = 2,
    beta: Float[Array, ""] | None = None,
    search: bool = False,
) -> Touch:
    """Contact of a tool with the tube; a pure function of one pose.

    Args:
        tool: a convex shape, or several (`shapes.compound`), of the dtype of the patches.
        pose: from the tool's frame to the tube's.
        settings: accuracy and work of each signed distance.
        near: number of patches searched, those with the lowest bounds. Two are enough for tools
            about as long as a patch; `Touch.complete` says so. Of a tool of several parts that of
            pairs of part and patch.
        beta: sharpness, 1/mm; default `settings.sharpness` over the half-extents of the largest
            patch and of the tool, which counts for no more than the patch.
        search: over all directions, as `signed_distance`. Without, each patch starts from the
            direction of the broad phase, as `track`: several times faster and the same until the
            tool's core reaches into the core of a patch (penetration beyond both radii). Deeper,
            the way out may be another than the shortest; the status is then NOT_CONVERGED, as it
            is where a doubtful patch is touched.

    Returns:
        The `Touch`; differentiable in tool, pose and patches. Its gap changes with a shift of the
        tool by the average of the patches' normals, which is `normal` but for its length. Where two
        parts of the tool are equally deep, place and normal lie between both; if that is more than
        `APART` of the size beside the deepest, the status is FLAT, and so it is where another part
        touches further than `SECOND` of the size from there.

    Raises:
        ValueError: `near` is not between 1 and the number of patches (times that of parts).
    """
    count, parts = patches.centres.shape[0], tool.radius.size
    if not 1 <= near <= count * parts:
        of = "patches" if parts == 1 else f"patches, {count}, times that of parts, {parts}"
        raise ValueError(f"near: expected 1 to {count * parts} (the number of {of}), found {near}")
    return _touch(tool, pose, patches, settings, int(near), beta, bool(search))


@functools.partial(jax.jit, static_argnames=("settings", "near", "search"), inline=True)
def _touch(
    tool: Shape,
    pose: Pose,
    patches: Patches,
    settings: Settings,
    near: int,
    beta: Float[Array, ""] | None,
    search: bool,
) -> Touch:
    """`touch`, of arguments that are checked."""
    size = _size(tool, patches)
    beta = settings.sharpness / size if beta is None else beta
    pairs = _nearest_pairs(tool, pose, patches, near, LEAD * size)

    def contact(tool, patch, direction):
        if search:
            return signed_distance(patch, tool, pose, settings, beta=beta)
        return approach(patch, tool, pose, direction, settings, beta=beta)

    lanes = (None if pairs.part is None else 0, 0, 0)
    each = jax.vmap(contact, lanes)(pairs.tools, pairs.shapes, pairs.directions)
    low = jax.lax.stop_gradient(-largest(-each.distance))
    e = jnp.exp(-beta * (each.distance - low))
    whole = total(e)
    weight = e / whole
    gap = low - jnp.log(whole) / beta

    def mean(v):
        return total((weight[:, None] * v).T)

    point = mean(each.point_a)
    s, phi = skeleton_coordinates(patches.line, point)
    terms = patches.shapes.vertices.shape[2] * tool.vertices.shape[-1] * near
    deepest, counts = jnp.argmin(each.distance), weight > COUNTS
    worst = jnp.max(jnp.where(counts, each.status, 0))
    if pairs.part is not None:
        place = each.point_a[deepest]
        tied = jnp.sum((point - place) ** 2) > (APART * size) ** 2
        others = (each.distance < 0) & (pairs.part != pairs.part[deepest])
        second = jnp.sum((each.point_a - place[None]) ** 2, axis=1) > (SECOND * size) ** 2
        tied = tied | jnp.any(others & second)
        worst = jnp.where(tied, jnp.maximum(worst, ContactStatus.FLAT), worst)
    if patches.uncertain is not None:
        doubt = jnp.any(counts & patches.uncertain[pairs.patch])
        worst = jnp.where(doubt, jnp.maximum(worst, ContactStatus.NOT_CONVERGED), worst)
    if not search:
        rounded = (
            tool.radius
            if pairs.part is None
            else jnp.min(jnp.where(counts, pairs.tools.radius, jnp.inf))
        )
        deep = gap < -(rounded + jnp.min(pairs.shapes.radius))
        worst = jnp.where(deep, jnp.maximum(worst, ContactStatus.NOT_CONVERGED), worst)
    # Also the patches that are not searched: else which one is nearest is not known.
    finite = jnp.isfinite(gap) & jnp.all(jnp.isfinite(pairs.bounds))
    return Touch(
        gap=gap, point=point, tool_point=mean(each.point_b), normal=_unit(mean(each.normal)), s=s,
        phi=phi, patch=pairs.patch[deepest],
        left_out=jnp.min(jnp.where(pairs.left, pairs.bounds, jnp.inf)),
        bound=jax.lax.stop_gradient(jnp.log(jnp.asarray(terms, gap.dtype)) / beta),
        status=jnp.where(finite, worst, ContactStatus.NON_FINITE).astype(jnp.int8),
        part=None if pairs.part is None else pairs.part[deepest],
    )  # fmt: skip


class _Pairs(NamedTuple):
    """Patches that a tool, or one of its parts, is nearest to.

    Attributes:
        patch: number of each; shape (near,).
        part: of the tool, of each; None: it has one, and `tools` is the tool itself.
        shapes: the patches.
        tools: the parts.
        directions: to start from; shape (near, 3).
        bounds: lower bound of the gap of all pairs, mm; shape (pairs,).
        left: which of those are not among the nearest.
    """

    patch: Int[Array, " near"]
    part: Int[Array, " near"] | None
    shapes: Shape
    tools: Shape
    directions: Float[Array, "near 3"]
    bounds: Float[Array, " pairs"]
    left: Bool[Array, " pairs"]


def _nearest_pairs(tool: Shape, pose: Pose, patches: Patches, near: int, lead) -> _Pairs:
    """By the broad phase; of all pairs the last one stands back by `lead` (mm) behind the first.

    So where two patches are equally near, beside the middle one, roundings do not choose.
    """
    count, alone = patches.centres.shape[0], tool.radius.ndim == 0
    if alone:
        bounds, directions = gap_bounds(tool, pose, patches)
    else:
        bounds, directions = jax.vmap(lambda part: gap_bounds(part, pose, patches))(tool)
        bounds, directions = bounds.reshape(-1), directions.reshape(-1, 3)
    pairs = bounds.shape[0]
    rank = bounds + lead * (jnp.arange(pairs, dtype=bounds.dtype) / pairs)
    chosen, left = lowest(rank, near)
    part = None if alone else jax.lax.div(chosen, jnp.asarray(count, chosen.dtype))
    patch = chosen if part is None else chosen - count * part
    tools = tool if part is None else _rows_at(tool, part)
    shapes = _rows_at(patches.shapes, patch)
    return _Pairs(patch, part, shapes, tools, directions[chosen], bounds, left)


def gap_bounds(
    tool: Shape, pose: Pose, patches: Patches
) -> tuple[Float[Array, " patches"], Float[Array, "patches 3"]]:
    """The broad phase: a certified lower bound of each patch's sharp gap (mm), and its direction.

    Roughly that between the nearest points of the cores. Not differentiable.
    """
    tool, pose, patches = jax.lax.stop_gradient((tool, pose, patches))
    moved = dataclasses.replace(tool, vertices=transform(pose, tool.vertices))

    def bound(patch, centre):
        z = middle(moved.vertices, moved.counts) - centre
        for _ in range(NEARING):  # Frank-Wolfe on the difference of the cores, exact steps
            # Of vertices equally far (flat faces), a fixed one: roundings would choose others.
            ahead = z + LEAD * largest(jnp.abs(z)) * jnp.asarray(PREFERRED, z.dtype)
            tip = _furthest(moved.vertices, -ahead)
            step = tip - _furthest(patch.vertices, ahead) - z
            square = total(step * step)
            share = -total(z * step) / jnp.where(square > 0, square, 1)
            z = z + jnp.clip(share, 0, 1) * step
        d = _unit(z)
        return -(sharp_support(patch, d) + sharp_support(moved, -d)), d

    return jax.vmap(bound)(patches.shapes, patches.centres)


def _furthest(vertices, direction):
    """The vertex furthest along a direction, of equal ones the first."""
    if vertices.shape[1] == 1:
        return vertices[:, 0]
    i = first_largest(heights(vertices, direction))
    return jnp.stack([row[i] for row in vertices])


def _rows_at(shapes: Shape, chosen) -> Shape:
    """Some of the shapes. By rows: XLA runs a program of arrays of at most 512 bytes in order."""
    rows = [shapes.vertices[:, i][chosen] for i in range(3)]
    counts = None if shapes.counts is None else shapes.counts[chosen]
    return Shape(jnp.stack(rows, axis=1), shapes.radius[chosen], counts)


def _unit(v):
    """Unit vector; z for a zero one."""
    square = total(v * v)
    ahead = jnp.asarray((0, 0, 1), v.dtype)
    return jnp.where(square > 0, v, ahead) / jnp.sqrt(jnp.where(square > 0, square, 1))


def _size(tool: Shape, patches: Patches):
    """Half-extents of the largest patch and of a tool up to as large, mm; not differentiable.

    A larger tool is met on no more of its length than a patch: it does not blur the contact more.
    Of several parts the largest counts.
    """
    tool, shapes = jax.lax.stop_gradient((tool, patches.shapes))

    def reach(shape):
        # Axis by axis: sums of fewer entries, which may be in one kernel.
        x, y, z = ((row - middle(row, shape.counts)) ** 2 for row in shape.vertices)
        return jnp.sqrt(largest(x + y + z)) + shape.radius

    def middle(row, counts):
        if counts is not None:
            own = (counts > 0).astype(row.dtype)
            return total(row * own) / total(own)
        return total(row) / row.shape[0]

    patch = jnp.max(jax.vmap(reach)(shapes))
    own = reach(tool) if tool.radius.ndim == 0 else jnp.max(jax.vmap(reach)(tool))
    return patch + jnp.minimum(own, patch)
