"""Finding the skeleton in a surface: centreline, anterior side and rings, from cross-sections.

A plane across the centreline cuts the triangles in segments; rays from the centre meet them. The
farthest hit is the outer contour, whatever the inner wall does, so that single and double walls
are read alike. Lengths in mm, host arrays in float64.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.mesh import MeshError

RAYS = 72
#: Cross-sections through which the centreline is laid.
STATIONS = 60
#: Angles of the rays, rad, ascending; 0 along the first axis of the frame.
ANGLES = 2 * math.pi * (np.arange(RAYS) + 0.5) / RAYS - math.pi
#: The arc on which rings are looked for: the anterior side, clear of the rings' ends.
ARC = np.abs(ANGLES) < 1.6
#: What a row of rings is: their least number; distance of neighbours over the radius (17 rings of a
#: human trachea: 0.7; table 1: 0.9); distance over the median one; share of the length they take.
FEWEST, PITCH, EVEN, SHARE = 4, (0.2, 2.0), (0.4, 2.2), 0.4
#: Cartilage may fork and join, which gives two crests near each other (Visible Human male: 0.35).
FORKED = 0.2


class Line(NamedTuple):
    """A centreline: points, arc length, and frames with columns (tangent, anterior, lateral)."""

    points: np.ndarray
    s: np.ndarray
    frames: np.ndarray

    def at(self, s) -> tuple[np.ndarray, np.ndarray]:
        """Points and frames at positions s."""
        points = np.stack([np.interp(s, self.s, v) for v in self.points.T], -1)
        mixed = np.stack(
            [np.interp(s, self.s, v) for v in self.frames.reshape(-1, 9).T], -1
        ).reshape(*np.shape(s), 3, 3)
        x = mixed[..., 0] / np.linalg.norm(mixed[..., 0], axis=-1, keepdims=True)
        y = mixed[..., 1] - x * np.sum(x * mixed[..., 1], axis=-1, keepdims=True)
        y = y / np.linalg.norm(y, axis=-1, keepdims=True)
        return points, np.stack([x, y, np.cross(x, y)], axis=-1)


class Located(NamedTuple):
    """Skeleton coordinates of points: s, phi, distance, frames (points, 3, 3)."""

    s: np.ndarray
    phi: np.ndarray
    distance: np.ndarray
    frames: np.ndarray


class Rings(NamedTuple):
    """What was found of the rings; `source` in words."""

    positions: np.ndarray
    half_angle: float
    radius: float
    height: float
    source: str


class Shape(NamedTuple):
    """The outer contour along the line: radius (stations, rays), NaN where a ray meets nothing.

    `cartilage`: whether a ray meets the rings' own surface, or None.
    """

    line: Line
    s: np.ndarray
    radius: np.ndarray
    cartilage: np.ndarray | None

    @classmethod
    def scan(cls, line: Line, vertices, faces, cartilage) -> "Shape":
        """Cut the surface every 0.4 mm."""
        s = np.linspace(0, line.s[-1], max(50, int(line.s[-1] / 0.4)))[1:-1]
        points, frames = line.at(s)

        def cut(vertices, faces):
            cells = Cells.of(vertices, faces)
            rows = zip(points, frames, strict=True)
            return np.stack([contour(cells.near(p, q[:, 0]), p, q) for p, q in rows])

        hit = None if cartilage is None else np.isfinite(cut(*cartilage))
        return cls(line, s, cut(vertices, faces), hit)

    def end_radii(self) -> tuple[float, float]:
        """Mean radius over the first and the last seventh."""
        n = max(1, len(self.s) // 7)
        return float(np.nanmean(self.radius[:n])), float(np.nanmean(self.radius[-n:]))


class Cells(NamedTuple):
    """Triangles sorted into small cubes, so that a plane meets few of them.

    `corners` (faces, 3, 3) in the order of the cubes; `count` triangles in each; `centre` and
    `reach`: a ball round those of each.
    """

    corners: np.ndarray
    count: np.ndarray
    centre: np.ndarray
    reach: np.ndarray

    @classmethod
    def of(cls, vertices, faces) -> "Cells":
        """Cubes with edges of a 64th of the surface."""
        corners = vertices[faces]
        middle = corners.mean(axis=1)
        low, size = middle.min(axis=0), np.ptp(middle, axis=0).max() / 64 or 1.0
        at = ((middle - low) / size).astype(int) @ [10000, 100, 1]
        order = np.argsort(at, kind="stable")
        first = np.unique(at[order], return_index=True)[1]
        corners, count = corners[order], np.diff(first, append=len(order))
        centre = np.add.reduceat(middle[order], first) / count[:, None]
        away = np.linalg.norm(corners - np.repeat(centre, count, axis=0)[:, None], axis=2)
        return cls(corners, count, centre, np.maximum.reduceat(away.max(axis=1), first))

    def near(self, point, normal) -> np.ndarray:
        """Corners of all triangles that a plane may cut, and of some others."""
        hit = np.abs((self.centre - point) @ normal) <= self.reach * (1 + 1e-9)
        return self.corners[np.repeat(hit, self.count)]


def contour(corners, centre, frame) -> np.ndarray:
    """Distance of the farthest hit of each ray in the plane across `frame`'s tangent, or NaN.

    Args:
        corners: of the triangles; shape (faces, 3, 3).
        centre: from which the rays go.
        frame: columns tangent, and the two axes of the plane.
    """
    below = (corners - centre) @ frame[:, 0] < 0
    across = (corners[(below.sum(axis=1) % 3) != 0] - centre) @ frame
    below = across[:, :, 0] < 0
    alone = np.where(below.sum(axis=1) == 1, below.argmax(axis=1), below.argmin(axis=1))
    rows = np.arange(len(across))
    tip = across[rows, alone]
    ends = []
    for step in (1, 2):
        foot = across[rows, (alone + step) % 3]
        way = tip[:, 0] / (tip[:, 0] - foot[:, 0])
        ends.append(tip[:, 1:] + way[:, None] * (foot - tip)[:, 1:])
    first, side = ends[0], ends[1] - ends[0]
    ray = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]  # noqa: E731
    slope = cross(ray[:, None], side[None])
    slope = np.where(slope == 0, np.inf, slope)
    far = cross(first, side)[None] / slope
    way = cross(first[None], ray[:, None]) / slope
    far = np.where((way >= 0) & (way <= 1) & (far > 0), far, -np.inf).max(axis=1, initial=-np.inf)
    return np.where(far > 0, far, np.nan)


def find_centreline(vertices, faces, given=None) -> Line:
    """The line through the centroids of the outer contours, over the length of the surface.

    A quartic in the position along the main axis, found in four rounds; straight beyond the last
    whole cross-section. Good for a tube that bends, not for one that turns back.
    """
    if given is not None:
        if given.ndim != 2 or given.shape[1] != 3 or len(given) < 2:
            raise MeshError(f"centreline has shape {given.shape}; expected (points, 3)")
        return _over(vertices, _fine(given))
    corners = vertices[faces]
    weight = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    middle = corners.mean(axis=1)
    centre = np.average(middle, axis=0, weights=weight)
    spread, axes = np.linalg.eigh(np.cov((middle - centre).T, aweights=weight))
    if spread[2] < 3 * spread[1]:
        raise MeshError("it is not longer than wide: no axis to follow; give centreline=")
    axes = axes[:, ::-1]
    along = (vertices - centre) @ axes[:, 0]
    margin = 0.05 * np.ptp(along)
    stations = np.linspace(along.min() + margin, along.max() - margin, STATIONS)
    curve, cells = [np.zeros(1)] * 2, Cells.of(vertices, faces)
    for _ in range(4):
        seen, off = _centres(cells, centre, axes, stations, curve)
        if len(seen) < STATIONS / 2:
            raise MeshError(
                f"only {len(seen)} of {STATIONS} cross-sections close round the axis; "
                "expected a tube: repair it, or give centreline="
            )
        curve = [np.polynomial.polynomial.polyfit(seen, v, 4) for v in off.T]
    t = np.linspace(seen.min(), seen.max(), 60)
    value = np.polynomial.polynomial.polyval
    local = np.stack([t, *(value(t, c) for c in curve)], axis=1)
    return _over(vertices, _fine(centre + local @ axes.T))


def _centres(cells, centre, axes, stations, curve):
    """Centroids of the whole outer contours, as (position along the axis, offset across it)."""
    value, slope = np.polynomial.polynomial.polyval, np.polynomial.polynomial.polyder
    found = []
    for t in stations:
        here = centre + axes @ np.array([t, *(value(t, c) for c in curve)])
        tangent = axes @ np.array([1, *(value(t, slope(c)) for c in curve)])
        frame = _frame(tangent, axes[:, 1])
        radius = contour(cells.near(here, frame[:, 0]), here, frame)
        whole = np.isfinite(radius)
        if whole.mean() < 0.9:
            continue
        r = np.interp(ANGLES, ANGLES[whole], radius[whole], period=2 * math.pi)
        offset = [np.sum(r**3 * f(ANGLES)) / np.sum(r**2) * 2 / 3 for f in (np.cos, np.sin)]
        found.append(axes.T @ (here + frame[:, 1:] @ offset - centre))
    found = np.array(found).reshape(-1, 3)
    return found[:, 0], found[:, 1:]


def _frame(tangent, towards):
    x = tangent / np.linalg.norm(tangent)
    y = towards - x * (x @ towards)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _fine(points):
    """The same line in steps of about 0.5 mm, evenly."""
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.linspace(0, s[-1], max(20, int(s[-1] / 0.5)))
    return np.stack([np.interp(even, s, v) for v in points.T], axis=1)


def _over(vertices, points) -> Line:
    """Lengthen or cut the line straight to where the surface begins and ends, with its frames."""
    reach = np.ptp(vertices, axis=0).max()
    ends = []
    for end, inner in ((points[0], points[9]), (points[-1], points[-10])):
        ends.append(end + (end - inner) / np.linalg.norm(end - inner) * reach)
    line = _framed(_fine(np.concatenate([ends[:1], points, ends[1:]])))
    s = locate(line, vertices).s
    return _framed(line.at(np.linspace(s.min(), s.max(), int(np.ptp(s) / 0.5) + 2))[0])


def _framed(points) -> Line:
    """Arc length, and frames that turn about the tangent no more than they must."""
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    tangents = np.gradient(points, s, axis=0)
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = [_frame(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])]
    for tangent in tangents[1:]:
        frames.append(_frame(tangent, frames[-1][:, 1]))
    return Line(points, s, np.stack(frames))


def turned(line: Line) -> Line:
    """The same line from the other end."""
    return _framed(line.points[::-1])


def locate(line: Line, points) -> Located:
    """Skeleton coordinates of points: the nearest point of the line, and the angle round it."""
    from scipy.spatial import KDTree

    start, step = line.points[:-1], np.diff(line.points, axis=0)
    length = np.linalg.norm(step, axis=1)
    nearest = np.asarray(KDTree(line.points).query(points)[1])
    beside = np.clip(nearest[:, None] + np.arange(-2, 2), 0, len(start) - 1)
    least, s = np.full(len(points), np.inf), np.empty(len(points))
    for i in beside.T:
        away = points - start[i]
        way = np.clip(np.sum(away * step[i], axis=1) / length[i] ** 2, 0, 1)
        miss = np.sum((away - way[:, None] * step[i]) ** 2, axis=1)
        s = np.where(miss < least, line.s[i] + way * length[i], s)
        least = np.minimum(miss, least)
    centre, frames = line.at(s)
    across = np.einsum("vji,vj->vi", frames, points - centre)
    phi = np.arctan2(across[:, 2], across[:, 1])
    return Located(s, phi, np.hypot(across[:, 1], across[:, 2]), frames)


def _relief(shape: Shape, to_ends: bool = False) -> np.ndarray:
    """How far the contour stands out of its surroundings along s, mm.

    The surroundings: the mean over a window as long as the radius. Within half a window of an end
    the relief is NaN, or else they are continued straight, so that a ring there is seen too; NaN
    then where the contour runs into a lid.
    """
    step = shape.s[1] - shape.s[0]
    span = max(5, int(np.nanmean(shape.radius) / step) | 1)
    out = np.full_like(shape.radius, np.nan)
    if len(shape.s) <= 2 * span:
        return out
    window, half = np.ones(span) / span, span // 2
    level = np.stack([np.convolve(v, window, "valid") for v in shape.radius.T], axis=1)
    out[half:-half] = shape.radius[half:-half] - level
    if not to_ends:
        return out
    i = np.arange(half)[:, None]
    slope = lambda first, last: (last - first) / (span - 1)  # noqa: E731
    out[:half] = shape.radius[:half] - level[0] + slope(level[0], level[span - 1]) * (half - i)
    out[-half:] = shape.radius[-half:] - level[-1] - slope(level[-span], level[-1]) * (i + 1)
    steep = np.abs(np.diff(shape.radius, axis=0)).mean(axis=1) > step  # a lid: more than 45 deg
    low, high = np.flatnonzero(steep[:half]), np.flatnonzero(steep[-half:])
    out[: low[-1] + 1 if len(low) else 0] = np.nan
    out[len(out) - half + high[0] if len(high) else len(out) :] = np.nan
    return out


def find_anterior(shape: Shape, given=None) -> Shape:
    """Turn the frames so that angle 0 is the anterior midline.

    In this order: the direction given; opposite the gap of the cartilage; the side on which the
    relief is; opposite the flat side of the wall.
    """
    if given is not None:
        mean = np.asarray(given, float)
        across = np.einsum("nji,j->ni", shape.line.frames, mean).mean(axis=0)
        if np.hypot(across[1], across[2]) < 0.2 * max(np.linalg.norm(mean), 1e-300):
            raise MeshError("anterior= points along the tube; expected a direction across it")
        angle = math.atan2(across[2], across[1])
    elif shape.cartilage is not None:
        angle, _ = _side(shape.cartilage.mean(axis=0))
    else:
        angle, clear = _side(np.nan_to_num(_middle(_relief(shape) ** 2)))
        if not clear or not _has_relief(shape):
            angle = _opposite_flat(shape)
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    line = shape.line._replace(frames=shape.line.frames @ turn)
    moved = lambda v: np.stack(  # noqa: E731
        [np.interp(ANGLES + angle, ANGLES, row, period=2 * math.pi) for row in v.astype(float)]
    )
    cartilage = None if shape.cartilage is None else moved(shape.cartilage) > 0.5
    return Shape(line, shape.s, moved(shape.radius), cartilage)


def _middle(rows):
    """Median over the stations that see the whole contour."""
    whole = np.isfinite(rows).all(axis=1)
    return np.mean(rows[whole], axis=0) if whole.any() else np.full(RAYS, np.nan)


def _has_relief(shape: Shape) -> bool:
    """Whether the waves of the relief are more than 1 % of the radius."""
    return bool(np.sqrt(_middle(_relief(shape) ** 2)).max() > 0.01 * np.nanmean(shape.radius))


def _side(strength) -> tuple[float, bool]:
    """Direction in which `strength` lies, and whether it clearly does."""
    total = np.sum(strength * np.exp(1j * ANGLES))
    return float(np.angle(total)), bool(np.abs(total) > 0.1 * max(strength.sum(), 1e-300))


def _opposite_flat(shape: Shape) -> float:
    """Opposite the angle at which a D-shaped contour is nearest to its centre."""
    mean = _middle(shape.radius)
    smooth = np.mean([np.roll(mean, k) for k in range(-4, 5)], axis=0)
    low = int(np.argmin(smooth))
    others = np.roll(smooth, -low)[RAYS // 6 : -RAYS // 6]
    if not others.min() > 1.03 * smooth[low]:
        raise MeshError(
            "no flat side, no relief of rings: which side is anterior? Give anterior= or rings="
        )
    return float(ANGLES[low] + math.pi)


def find_rings(shape: Shape, positions=None, half_angle=None) -> Rings:
    """Ring positions, opening and size, from the cartilage or else from the relief of the wall."""
    step, mean = shape.s[1] - shape.s[0], _middle(shape.radius)
    radius = float(np.mean(mean[ARC]))
    if shape.cartilage is not None:
        source, strength = "the cartilage", shape.cartilage.mean(axis=0)
        profile, fall = shape.cartilage[:, ARC].mean(axis=1), 0.15
    else:
        source, relief = "the relief of the wall", _relief(shape)
        strength = np.sqrt(np.nan_to_num(_middle(relief**2)))
        inner = np.nan_to_num(np.mean(relief[:, ARC], axis=1))
        fall = max(0.01 * radius, 0.3 * float(np.ptp(inner)))
        profile = np.mean(_relief(shape, to_ends=True)[:, ARC], axis=1)
        seen = np.flatnonzero(np.isfinite(profile))
        profile = np.interp(np.arange(len(profile)), seen, profile[seen]) if len(seen) else inner
    n = max(1, round(1.2 / step))
    padded = np.pad(profile, (n // 2, n - 1 - n // 2), "edge")
    smooth = np.convolve(padded, np.ones(n) / n, "valid")
    if positions is not None:
        found, source = np.asarray(positions, float), "the positions given"
    else:
        if shape.cartilage is not None:  # which may begin or end with the surface
            smooth = np.pad(smooth, 1)
            found = shape.s[np.clip(_peaks(smooth, fall) - 1, 0, len(shape.s) - 1)]
        else:
            found = shape.s[_peaks(smooth, fall)]
        _check_row(found, source, radius, shape.line.s[-1], shape.cartilage is not None)
    if half_angle is None:
        known = shape.cartilage is not None or positions is None
        half_angle = _half_angle(strength) if known else 2 * math.pi / 3
    height = 4.0 if len(found) < 2 else 0.4 * float(np.median(np.diff(found)))
    if shape.cartilage is not None:
        height = float(profile.sum() * step / len(found))
    return Rings(found, half_angle, radius, height, source)


def _check_row(found, source, radius, length, own) -> None:
    """Refuse crests that are no row of rings.

    Args:
        found: their positions, mm.
        source: in words.
        radius: of the wall, mm.
        length: of the tube, mm.
        own: whether they come from the cartilage itself: then they may fork, and be fewer.
    """
    gaps, fewest = np.diff(found), 2 if own else FEWEST
    pitch = float(np.median(gaps)) if len(gaps) else 0.0
    least = FORKED if own else EVEN[0]
    if len(found) < fewest:
        fault = f"at least {fewest}"
    elif not PITCH[0] * radius <= pitch <= PITCH[1] * radius:
        fault = f"them {PITCH[0] * radius:.2g} to {PITCH[1] * radius:.2g} mm apart"
    elif gaps.min() < least * pitch or gaps.max() > EVEN[1] * pitch:
        fault = f"them even, {least * pitch:.2g} to {EVEN[1] * pitch:.2g} mm apart"
    elif len(found) * pitch < SHARE * length and not own:
        fault = f"them on {100 * SHARE:.0f} % of its {length:.4g} mm or more"
    else:
        return
    at = ", ".join(f"{v:.1f}" for v in found[:8]) + (", ..." if len(found) > 8 else "")
    raise MeshError(
        f"found {len(found)} rings in {source}{f' (s = {at} mm)' if at else ''}, expected {fault}; "
        "a lumen shows none: give the outer wall, or rings=, the cartilage's own surface, or "
        "ring_positions="
    )


def _half_angle(strength) -> float:
    """Half of the arc about 0 on which `strength` is above half its usual value there."""
    level = 0.5 * np.median(strength[ARC])
    right = np.argmax(np.append(strength[RAYS // 2 :] < level, True))
    left = np.argmax(np.append(strength[: RAYS // 2][::-1] < level, True))
    return float(right + left) * math.pi / RAYS


def _peaks(profile, fall) -> np.ndarray:
    """Centres of the waves of `profile` that rise and fall by more than `fall`."""
    found, high, low, rising = [], 0, 0, False
    for i, value in enumerate(profile):
        if value > profile[high]:
            high = i
        if value < profile[low]:
            low = i
        if rising and value < profile[high] - fall:
            found, low, rising = [*found, high], i, False
        elif not rising and value > profile[low] + fall:
            high, rising = i, True
    tops = []
    for top in found:  # a crest cut flat: its middle
        level = profile[top] - fall / 2
        first, last = top, top
        while first > 0 and profile[first - 1] > level:
            first -= 1
        while last < len(profile) - 1 and profile[last + 1] > level:
            last += 1
        tops.append(round((first + last) / 2))
    return np.array(tops, int)
