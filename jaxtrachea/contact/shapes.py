r"""Convex shapes as rounded vertex clouds, and their smoothed support function.

A shape is the convex hull of N vertices v_i, swept by a ball of radius r (one vertex: a sphere;
two: a capsule; eight: a box). Its support function is smoothed by entropy (log-sum-exp):

    h(d) = (1/beta) log sum_i exp(beta v_i . d) + r,    |d| = 1,
    0 <= h(d) - (max_i v_i . d + r) <= log(N) / beta.

The smoothed shape therefore contains the sharp one and sticks out by at most log(N) / beta. Its
boundary point with normal d is the gradient of h continued homogeneously,
x(d) = sum_i p_i v_i + (H(p)/beta + r) d, with the softmax weights p and their entropy H(p).

A vertex may count 0 times in the sum: so shapes of unlike numbers of vertices are stacked, and the
smoothed shape stays what it is. A body that is not convex is a stack of convex parts (`compound`).

Source: smoothing of a maximum by its entropic conjugate, Nesterov, "Smooth minimization of
non-smooth functions", Math. Program. 103 (2005), doi:10.1007/s10107-004-0552-5.

Vertices are stored as three rows (3, N), so that everything stays elementwise. Lengths in mm.
"""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike as _ArrayLike
from jaxtyping import Array, Float

from jaxtrachea._numerics import largest, total
from jaxtrachea.contact.pose import Pose, check_rotations, transform

#: Numbers, arrays and nested lists of them.
ArrayLike = _ArrayLike | Sequence
#: Of a hull's extent, what a point must stand out of the faces round it to be a corner.
FLAT = 1e-5
#: Thickness over length of a hull from which on that is looked for: thin plates would lose sides.
THIN = 0.01
#: Convex parts of a tool at most: the cost of a contact grows with them.
MAX_PARTS = 32


class Shape(eqx.Module):
    """A convex hull of vertices, swept by a ball.

    Interior, repeated, collinear or coplanar vertices are allowed. With a leading axis it is a
    tool of several convex parts (`compound`), or the patches of a wall.

    Attributes:
        vertices: mm, one row per coordinate; shape (3, n).
        radius: of the ball, mm, not negative.
        counts: whether each vertex counts in the smoothed sum, shape (n,): 0 for one that repeats
            another to fill up (`padded`), positive for the others; None: all do.
    """

    vertices: Float[Array, "*lanes 3 n"]
    radius: Float[Array, "*lanes"]
    counts: Float[Array, "*lanes n"] | None = None


class Support(eqx.Module):
    """The smoothed support function in one direction d.

    Attributes:
        value: h(d), mm.
        point: point of the smoothed boundary with normal d, mm; shape (3,).
        core: softmax mean of the vertices, a point of the sharp hull without its radius, mm.
    """

    value: Float[Array, ""]
    point: Float[Array, "3"]
    core: Float[Array, "3"]


def support(shape: Shape, direction: Float[Array, "3"], beta: Float[Array, ""]) -> Support:
    """Smoothed support function, its boundary point and the softmax mean.

    Args:
        direction: unit vector; shape (3,).
        beta: sharpness, 1/mm, positive. The bias is at most log(n) / beta.
    """
    along = heights(shape.vertices, direction)
    value, weights = log_mean(along, beta, shape.counts)
    core = total(shape.vertices * weights[None])
    beyond = value - total(weights * along) + shape.radius
    return Support(value + shape.radius, core + beyond * direction, core)


def heights(vertices: Float[Array, "3 n"], direction: Float[Array, "3"]) -> Float[Array, " n"]:
    """v_i . d for every vertex."""
    x, y, z = vertices
    return x * direction[0] + y * direction[1] + z * direction[2]


def log_mean(
    along: Float[Array, " n"],
    beta: Float[Array, ""],
    counts: Float[Array, " n"] | None = None,
):
    """(1/beta) log sum exp(beta x) of what counts and the softmax weights, without overflow."""
    if along.shape[0] == 1:  # a ball
        return along[0], jnp.ones_like(along)
    top = jax.lax.stop_gradient(largest(along))
    e = jnp.exp(beta * (along - top))
    e = e if counts is None else jnp.where(counts > 0, e, 0)
    whole = total(e)
    return top + jnp.log(whole) / beta, e / whole


def mean(vertices: Float[Array, "3 n"], counts: Float[Array, " n"] | None = None):
    """Mean of the vertices that count, mm; shape (3,)."""
    if counts is not None:
        own = (counts > 0).astype(vertices.dtype)
        return total(vertices * own[None]) / total(own)
    return total(vertices) / vertices.shape[1]


def sharp_support(shape: Shape, direction: Float[Array, "3"]) -> Float[Array, ""]:
    """max_i v_i . d + r, mm: the support function without smoothing."""
    return largest(heights(shape.vertices, direction)) + shape.radius


def cloud(points: ArrayLike, radius: ArrayLike = 0.0, dtype=None) -> Shape:
    """The hull of points, swept by a ball; every point is kept as a vertex, equal ones once.

    Args:
        points: mm; shape (n, 3) with n >= 1 (a list, numpy or JAX array). They may be traced:
            equal ones then count as often as they are there, log(that) / beta of the surface.
        radius: mm, not negative.
        dtype: of the shape; default the dtype of `points`, or JAX's default for numbers.

    Raises:
        ValueError: not an (n, 3) array, or a radius below zero.
    """
    vertices = _numbers(points, dtype)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.shape[0] == 0:
        raise ValueError(f"points: expected shape (n, 3) with n >= 1, found {vertices.shape}")
    if not isinstance(vertices, Tracer):
        _, first = np.unique(vertices + 0.0, axis=0, return_index=True)
        vertices = vertices[np.sort(first)]
    return _shape(vertices.T, radius)


def hull(points: ArrayLike, radius: ArrayLike = 0.0, dtype=None) -> Shape:
    """The hull of points, keeping only its extreme points (the cost of a contact grows with n).

    Faces that are flat to `FLAT` of the extent keep their corners alone: each point that roundings
    lift out of one would count in the smooth support function, which then bulges there. Works on
    numbers, not on traced values. Flat and collinear clouds keep all distinct points.

    Args: as `cloud`.

    Raises:
        ValueError: as `cloud`.
    """
    given = np.asarray(points, float)
    if given.ndim != 2 or given.shape[1] != 3:
        raise ValueError(f"points: expected shape (n, 3) with n >= 1, found {given.shape}")
    return cloud(_corners(np.unique(given, axis=0)), radius, dtype)


def _corners(points: np.ndarray) -> np.ndarray:
    """Those of points that their hull needs; all, where it is flat or is none."""
    from scipy.spatial import ConvexHull, QhullError

    if not np.isfinite(points).all():
        return points
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    flat = FLAT * np.ptp(points, axis=0).max()
    for options in ("Qt",) if extents[-1] < THIN * extents[0] else (f"Qt C-{flat:.3g}", "Qt"):
        try:
            return points[np.sort(ConvexHull(points, qhull_options=options).vertices)]
        except (QhullError, ValueError):  # fewer than four points, or all in one plane
            continue
    return points


def sphere(radius: ArrayLike, dtype=None) -> Shape:
    """A ball about the origin, exact.

    Args:
        radius: mm, not negative.
        dtype: of the shape; default JAX's default.
    """
    dtype = jnp.result_type(radius, float) if dtype is None else dtype
    return _shape(np.zeros((3, 1), dtype), radius)


def capsule(half_length: ArrayLike, radius: ArrayLike, dtype=None) -> Shape:
    """A segment along z from -half_length to half_length, swept by a ball.

    Args:
        half_length: of the straight part, mm.
        radius: mm, not negative.
        dtype: of the shape; default that of `half_length`.
    """
    dtype = jnp.result_type(half_length, float) if dtype is None else dtype
    half = _numbers(half_length, dtype)
    return _shape(half * np.array([[0, 0], [0, 0], [-1, 1]], half.dtype), radius)


def box(half_sizes: ArrayLike, radius: ArrayLike = 0.0, dtype=None) -> Shape:
    """A box about the origin, swept by a ball: half-sizes `half_sizes + radius` over all.

    Args:
        half_sizes: of the core, mm; shape (3,).
        radius: rounding, mm, not negative. With 0 the smoothed edges are so sharp that derivatives
            of the normal reach beta times the size: round what you differentiate.
        dtype: of the shape; default that of `half_sizes`.
    """
    half = _numbers(half_sizes, dtype)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)
    return _shape(half[:, None] * signs.astype(half.dtype), radius)


def cylinder(
    half_length: ArrayLike,
    disc_radius: ArrayLike,
    radius: ArrayLike = 0.0,
    *,
    sides: int = 24,
    dtype=None,
) -> Shape:
    """A cylinder along z as a regular prism inscribed in it, swept by a ball.

    The prism stays inside the cylinder by at most disc_radius (1 - cos(pi / sides)): 0.9 % of the
    disc radius at 24 sides. Smoothing works the other way, by up to log(2 sides) / beta.

    Args:
        half_length: of the core, mm.
        disc_radius: of the core, mm.
        radius: rounding, mm, not negative.
        sides: of the prism, at least 3.
        dtype: of the shape; default that of `disc_radius`.

    Raises:
        ValueError: fewer than three sides, or a radius below zero.
    """
    if sides < 3:
        raise ValueError(f"sides: expected at least 3, found {sides}")
    r = _numbers(disc_radius, dtype)
    half = _numbers(half_length, r.dtype)
    turn, none = 2 * math.pi / sides * np.tile(np.arange(sides), 2), np.zeros(2 * sides)
    across = np.stack([np.cos(turn), np.sin(turn), none]).astype(r.dtype)
    along = np.stack([none, none, np.repeat([-1.0, 1.0], sides)]).astype(r.dtype)
    return _shape(r * across + half * along, radius)


def compound(shapes: Sequence[Shape], poses: Sequence[Pose] | None = None) -> Shape:
    """A tool of several convex parts: forceps, a hook; their surface is that of all together.

    Args:
        shapes: of one dtype; one that has parts itself gives them all. At most `MAX_PARTS` parts.
        poses: of each in the frame of the tool, rotations (checked where they are not traced);
            None: the shapes have that frame.

    Returns:
        The parts, stacked: vertices (parts, 3, n), radius (parts,), counts (parts, n) or None.

    Raises:
        ValueError: no part, or more than there may be; another dtype; poses that are not one a
            shape, or no rotations.
    """
    places = [None] * len(shapes) if poses is None else list(poses)
    if len(places) != len(shapes):
        raise ValueError(f"poses: expected one a shape ({len(shapes)}), found {len(places)}")
    found = []
    for i, (shape, pose) in enumerate(zip(shapes, places, strict=True)):
        if pose is not None and not isinstance(pose.rotation, Tracer):
            check_rotations(f"poses: rotation of part {i}", np.asarray(pose.rotation)[None])
        found += [part if pose is None else _moved(part, pose) for part in parts_of(shape)]
    if not 1 <= len(found) <= MAX_PARTS:
        raise ValueError(f"shapes: expected 1 to {MAX_PARTS} convex parts, found {len(found)}")
    dtype = found[0].vertices.dtype
    for i, part in enumerate(found):
        if part.vertices.dtype != dtype:
            raise ValueError(
                f"shapes: part {i} is {part.vertices.dtype}; expected {dtype}, as the first"
            )
    most = max(part.vertices.shape[1] for part in found)
    if any(part.vertices.shape[1] < most or part.counts is not None for part in found):
        found = [padded(part, most) for part in found]
    return jax.tree.map(lambda *v: _array(_numbers(v)), *found)


def parts_of(shape: Shape) -> list[Shape]:
    """The convex parts of a tool, each with its own vertices: itself, if it has no others."""
    if shape.vertices.ndim == 2:
        return [shape]
    parts = [
        jax.tree.map(lambda v, i=i: _array(_numbers(v)[i]), shape) for i in range(len(shape.radius))
    ]
    return [_unpadded(part) for part in parts]


def _unpadded(shape: Shape) -> Shape:
    """Without the vertices that do not count, where that is known."""
    if shape.counts is None or isinstance(shape.counts, Tracer):
        return shape
    kept = _numbers(shape.vertices)[:, np.asarray(shape.counts) > 0]
    return Shape(_array(kept), shape.radius)


def _moved(shape: Shape, pose: Pose) -> Shape:
    """A shape in another frame."""
    return dataclasses.replace(shape, vertices=jax.jit(transform)(pose, shape.vertices))


def padded(shape: Shape, count: int) -> Shape:
    """The same shape with vertices repeated up to `count` of them, which do not count.

    For stacking shapes under `vmap`.

    Args:
        count: number of vertices wanted, not below the present one.

    Raises:
        ValueError: `count` is below the number of vertices.
    """
    present = shape.vertices.shape[1]
    if count < present:
        raise ValueError(f"count: expected at least {present} (the vertices), found {count}")
    again = np.arange(count)
    vertices = _numbers(shape.vertices)[:, again % present]
    counts = (again < present).astype(vertices.dtype)
    if shape.counts is not None:
        counts = counts * _numbers(shape.counts)[again % present]
    return Shape(_array(vertices), shape.radius, _array(counts))


def _numbers(value, dtype=None):
    """Of NumPy, where they are not traced: each operation of JAX would be compiled by itself."""
    if any(isinstance(v, Tracer) for v in jax.tree.leaves(value)):
        return jnp.asarray(value, dtype)
    host = np.asarray(value)
    return host.astype(jax.dtypes.canonicalize_dtype(host.dtype if dtype is None else dtype))


def _array(value) -> Array:
    return value if isinstance(value, Array) else jax.device_put(value)


def _shape(vertices, radius) -> Shape:
    """Common dtype and the check of the radius, where it is a number."""
    r = _numbers(radius, vertices.dtype)
    if not isinstance(r, Tracer) and np.any(np.asarray(r) < 0):
        raise ValueError(f"radius: expected a length not below 0, found {radius}")
    return Shape(_array(vertices), _array(r))
