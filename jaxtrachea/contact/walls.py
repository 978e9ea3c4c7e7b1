r"""A surface round a centreline cut into convex patches.

Each patch is the convex hull of the surface between two borders, opened by a ball of radius r (all
balls of that radius that fit into the hull): its core is the hull with every side face moved
inwards by r, cut off by planes across the centreline at the borders.
Corners sharper than the ball are lost a little, by r theta^2 / 8 between two faces at
a small angle theta; hollows are bridged. Both are measured and stored.

On numbers, once; nothing here is traced.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jaxtrachea._arguments import float_dtype
from jaxtrachea.contact.line import Centreline
from jaxtrachea.contact.patches import Patches, check_borders
from jaxtrachea.contact.search import coarse_directions
from jaxtrachea.contact.shapes import ArrayLike, Shape

#: Directions in which losses are measured.
PROBES = 2000
#: A direction or face belongs to the side of the tube where its sine to the centreline is below.
SIDEWAYS = 0.5
#: Planes that tell which points are shallow.
FEW = 64
#: What a vertex of a core adds to it at least, over the radius of the largest ball that fits.
LEAST = 1e-5
#: Planes straight across, which hold a patch together where no face looks sideways.
ACROSS = 8


class TubeSurface(NamedTuple):
    """The surface of a tube, by the way along its centreline.

    Attributes:
        vertices: of the outer surface (an inner one does no harm, but counts as `filled`), mm;
            shape (vertices, 3).
        faces: its triangles; shape (faces, 3).
        s: position of every vertex along the centreline, mm; shape (vertices,).
        centres: point of the centreline beside each vertex, mm; None: straight along x, (s, 0, 0).
        frames: columns tangent, anterior, lateral of the centreline there; None: identity.
    """

    vertices: ArrayLike
    faces: ArrayLike
    s: ArrayLike
    centres: ArrayLike | None = None
    frames: ArrayLike | None = None


def patches_of(
    surface: TubeSurface,
    borders: ArrayLike,
    *,
    rounding: float = 0.5,
    overlap: float = 0.5,
    spacing: float = 1.0,
    most: int = 32,
    dtype=None,
    progress: Callable[[int, int], None] | None = None,
) -> Patches:
    """The convex patches of a surface, one between every two borders.

    Open ends run on beyond the first and last border, rounded.

    Args:
        surface: its vertices, faces and centreline.
        borders: s of the ends and of the borders between, mm, rising; shape (patches + 1,).
        rounding: radius r of the ball over the largest that fits, in (0, 1). More is smoother, and
            needs fewer vertices, but loses more at corners.
        overlap: by how much a patch runs on beyond its borders before it is rounded, mm.
        spacing: of the samples of a curved centreline, mm, positive.
        most: vertices kept of each core, at least 4.
        dtype: of every array; the default float type of JAX if None.
        progress: called with (patches done since the last call, patches in all).

    Raises:
        ValueError: naming the argument or the span.
    """
    at = check_borders(borders)
    v, s = np.asarray(surface.vertices, float), np.asarray(surface.s, float)
    faces, centres, frames = np.asarray(surface.faces), surface.centres, surface.frames
    _check(v, s, (centres, frames), (rounding, overlap, spacing, most))
    if centres is not None and frames is not None:
        centres, frames = np.asarray(centres, float), np.asarray(frames, float)
    line = _line(s, centres, frames, at, spacing)
    tube = _Tube(v, s, _edges(faces, s), line)
    hulls = []
    for span in zip(at[:-1], at[1:], strict=True):
        hulls.append(_between(tube, span, overlap, rounding, most))
        if progress is not None:
            progress(1, len(at) - 1)
    count = max(p[0].shape[1] for p in hulls)
    cores = np.stack([_filled_up(p[0], count) for p in hulls])

    def cast(x):
        return jax.device_put(np.asarray(x, float_dtype(dtype)))  # nothing is compiled

    shapes = Shape(cast(cores), cast([p[1] for p in hulls]))
    middles, lost, filled = (cast([p[i] for p in hulls]) for i in (2, 3, 4))
    return Patches(shapes, middles, Centreline(*map(cast, line)), lost, filled)


class _Tube(NamedTuple):
    """Vertices, their s, edges of the surface and the centreline, as `_line` gives it."""

    vertices: np.ndarray
    s: np.ndarray
    edges: np.ndarray
    line: tuple


def _check(
    v: np.ndarray, s: np.ndarray, curved: tuple, numbers: tuple[float, float, float, int]
) -> None:
    """Refuse arguments of `patches_of` that mean no tube."""
    if v.ndim != 2 or v.shape[1] != 3 or s.shape != v.shape[:1] or not np.isfinite(v).all():
        raise ValueError(
            f"vertices, s: expected finite (n, 3) and (n,), found {v.shape} and {s.shape}"
        )
    if (curved[0] is None) != (curved[1] is None):
        raise ValueError("centres, frames: expected both (a curved tube) or neither (a straight)")
    rounding, overlap, spacing, most = numbers
    if not 0 < rounding < 1 or not overlap >= 0 or not spacing > 0 or most < 4:
        raise ValueError(
            "rounding, overlap, spacing, most: expected in (0, 1), not below 0, positive and at "
            f"least 4, found {rounding:g}, {overlap:g}, {spacing:g}, {most}"
        )


def _between(tube: _Tube, span: tuple[float, float], overlap: float, rounding: float, most: int):
    """The patch between two borders, as `_patch`."""
    from scipy.spatial import QhullError

    (low, high), (v, s, edges, line) = span, tube
    a, b = np.clip((low - overlap, high + overlap), s.min(), s.max())
    inside = v[(s >= a) & (s <= b)]
    try:
        ends = [_section(v, s, edges, x) for x in (a, b)]
        own = [_section(v, s, edges, x) for x in span]
        own = np.concatenate([*own, v[(s >= low) & (s <= high)]])
        return _patch(inside, ends, own, _station(line, (a, b)), rounding, most)
    except (QhullError, ValueError) as error:
        raise ValueError(
            f"the surface between s = {low:g} and {high:g} mm encloses nothing: "
            f"{len(inside)} vertices; expected a tube round its centreline there"
        ) from error


def _line(s, centres, frames, at, spacing):
    """Even samples of s, point, tangent and anterior of the centreline."""
    if centres is None or frames is None:
        x = at[[0, -1]]
        axes = np.eye(3)[:, None].repeat(2, axis=1)
        return x, x[:, None] * axes[0], axes[0], axes[1]
    known, first = np.unique(s, return_index=True)
    x = np.linspace(known[0], known[-1], int(np.ptp(known) / spacing) + 2)

    def spread(rows):
        return np.stack([np.interp(x, known, r) for r in rows[first].T], axis=1)

    points, tangents, anterior = map(spread, (centres, frames[:, :, 0], frames[:, :, 1]))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    anterior -= np.sum(anterior * tangents, axis=1, keepdims=True) * tangents
    return x, points, tangents, anterior / np.linalg.norm(anterior, axis=1, keepdims=True)


def _station(line, at):
    """Point in the middle of a span, and the tangents at its middle and both of its ends."""
    x, points, tangents, _ = line

    def pick(rows, y):
        return np.array([np.interp(y, x, r) for r in rows.T])

    middle = (at[0] + at[1]) / 2
    beyond = middle - np.clip(middle, x[0], x[-1])
    return pick(points, middle) + beyond * tangents[0], [pick(tangents, y) for y in (middle, *at)]


def _edges(faces, s):
    """Every edge that is not level once, from its lower end to its upper one; shape (2, edges)."""
    i, j = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T.astype(np.int64)
    low, high = np.where(s[i] <= s[j], i, j), np.where(s[i] <= s[j], j, i)
    rising = s[high] > s[low]
    both = np.unique(low[rising] * len(s) + high[rising])
    return np.stack(np.divmod(both, len(s)))


def _section(v, s, edges, at):
    """Points where the edges cross s = at; none beyond the ends."""
    i, j = edges[:, (s[edges[0]] <= at) & (s[edges[1]] >= at)]
    return v[i] + ((at - s[i]) / (s[j] - s[i]))[:, None] * (v[j] - v[i])


def _patch(inside, ends, own, station, rounding, most):
    """Core (3, n), radius, middle, lost and filled of one patch."""
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    middle, (t, t_low, t_high) = station
    side = _sides(np.concatenate([inside, *ends]), t)
    largest = (-(side[:, :3] @ middle) - side[:, 3]).min()
    filled = _deepest(own, side)
    r = rounding * largest
    caps = np.stack(
        [[*-t_low, (ends[0] @ t_low).min()], [*t_high, -(ends[1] @ t_high).max()]]
    )  # the core ends there: swept by the ball, a patch is not cut off but rounded
    planes = np.concatenate([np.unique(np.round(side, 12), axis=0) + [0, 0, 0, r], caps])
    core = HalfspaceIntersection(planes, middle).intersections
    core = core[ConvexHull(core).vertices]
    d = coarse_directions(PROBES)[0]
    kept = core[_extreme(core @ d.T, most, LEAST * largest)]
    if len(own) > PROBES:  # those that stand out
        own = own[ConvexHull(own).vertices]
    lost = (own @ d.T - (kept @ d.T).max(axis=0)).max() - r
    return kept.T, r, middle, max(lost, 0), max(filled, 0)


def _deepest(points, planes):
    """Largest depth of the points below all planes; most are shallow, as a few planes tell."""

    def depth(points, planes):
        return (-(points @ planes[:, :3].T) - planes[:, 3]).min(axis=1)

    bound = depth(points, planes[:: max(1, len(planes) // FEW)])
    order, deepest = np.argsort(-bound), -np.inf
    for start in range(0, len(order), PROBES):
        rows = order[start : start + PROBES]
        if bound[rows[0]] <= deepest:
            break
        deepest = max(deepest, depth(points[rows], planes).max())
    return deepest


def _sides(points, t):
    """Planes round the points: faces of their hull that look sideways, and a few straight across.

    Where the tube opens steeply there is none of the first kind; the others always close it.
    """
    from scipy.spatial import ConvexHull

    faces = ConvexHull(points).equations
    across = np.linalg.svd(t[None])[2][1:]
    turn = 2 * np.pi * np.arange(ACROSS) / ACROSS
    d = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    straight = np.concatenate([d, -(points @ d.T).max(axis=0)[:, None]], axis=1)
    return np.concatenate([faces[np.abs(faces[:, :3] @ t) < SIDEWAYS], straight])


def _extreme(heights, most, least):
    """Of the rows (vertices by directions) up to `most` that keep the maxima best, one by one.

    No more where each adds at most `least` to a maximum: of the corners that roundings make where
    faces lie in one plane each would count in the softmax, which then bulges there.
    """
    full, chosen = heights.max(axis=0), []
    reached = np.full_like(full, -np.inf)
    while len(chosen) < min(most, len(heights)):
        worst = np.argmax(full - reached)
        if full[worst] - reached[worst] <= least:
            break
        chosen.append(int(heights[:, worst].argmax()))
        reached = np.maximum(reached, heights[chosen[-1]])
    return chosen


def _filled_up(core, count):
    """More vertices in the middle of the core, where they weigh nothing."""
    middle = core.mean(axis=1, keepdims=True)
    return np.concatenate([core, np.repeat(middle, count - core.shape[1], axis=1)], axis=1)
