"""Finding the centreline of a surface from cross-sections. Lengths in mm, arrays in float64."""

import math
from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.mesh import MeshError, face_vectors
from jaxtrachea.trachea.sections import ANGLES, Cells, contour

#: Cross-sections through which the centreline is laid.
STATIONS = 60
#: How far a centreline found may run beside the middle, over the radius: 95 % of the sections away
#: from the ends (Visible Human: 0.07 and 0.05; a tube of 92 mm bent by 90 degrees: 0.16).
BESIDE = 0.1
#: Share of the rays from the line that meet the wall all along it, from inside (from outside less
#: than half); largest share of the line's length where fewer may: the wall has holes.
ROUND, OUTSIDE = 0.45, 0.25
#: Furthest turn of a centreline, degrees: a quarter circle, and what is found of it.
TURN = 100.0
#: Least spread of the surface along its axis over that across, squared: 1.5 times as long as wide.
LONGER = 1.5


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

        def cut(vertices, faces, outside=True):
            cells = Cells.of(vertices, faces)
            rows = zip(points, frames, strict=True)
            return np.stack([contour(cells.near(p, q[:, 0]), p, q, outside) for p, q in rows])

        radius = cut(vertices, faces)
        beside = float(np.mean(np.isfinite(radius).mean(axis=1) < ROUND))
        if beside > OUTSIDE:
            raise _missed(f"the centreline runs outside the mesh over {100 * beside:.0f} % of it")
        hit = None if cartilage is None else np.isfinite(cut(*cartilage, outside=False))
        return cls(line, s, radius, hit)

    def end_radii(self) -> tuple[float, float]:
        """Mean radius over the first and the last seventh."""
        n = max(1, len(self.s) // 7)
        return float(np.nanmean(self.radius[:n])), float(np.nanmean(self.radius[-n:]))

    def check_middle(self) -> None:
        """Refuse a line that runs beside the middle of the cross-sections, away from the ends."""
        share = self.s / self.line.s[-1]
        rows = (np.isfinite(self.radius).mean(axis=1) >= 0.9) & (np.abs(share - 0.5) < 0.4)
        usual = float(np.nanmean(self.radius))
        r = np.nan_to_num(self.radius[rows], nan=usual)
        across = [np.sum(r**3 * f(ANGLES), axis=1) for f in (np.cos, np.sin)]
        beside = np.hypot(*across) / np.sum(r**2, axis=1) * 2 / 3
        most = float(np.percentile(beside, 95)) if len(beside) else 0.0
        if most > BESIDE * usual:
            raise MeshError(
                f"the centreline found runs {most:.2g} mm beside the middle of its cross-sections, "
                f"expected at most {BESIDE * usual:.2g}: it bends too sharply to be followed, or "
                "is no tube",
                cure="give {}",
                arguments=("centreline=",),
            )


def find_centreline(vertices, faces, given=None) -> Line:
    """The line through the centroids of the outer contours, over the length of the surface.

    A quartic in the position along the main axis, found in four rounds; straight beyond the last
    whole cross-section. Good for a tube that bends, not for one that turns back.
    """
    if given is not None:
        if given.ndim != 2 or given.shape[1] != 3 or len(given) < 2:
            raise MeshError(f"centreline has shape {given.shape}; expected (points, 3)")
        if not (np.isfinite(given).all() and np.ptp(given, axis=0).max() > 0):
            raise MeshError("centreline is no line: expected finite points, not all at one place")
        return _over(vertices, _fine(given))
    weight = np.linalg.norm(face_vectors(vertices, faces), axis=1)
    middle = vertices[faces].mean(axis=1)
    centre = np.average(middle, axis=0, weights=weight)
    spread, axes = np.linalg.eigh(np.cov((middle - centre).T, aweights=weight))
    if spread[2] < LONGER * spread[1]:
        raise MeshError(
            "it is not longer than wide: no axis to follow",
            cure="give {}",
            arguments=("centreline=",),
        )
    axes = axes[:, ::-1]
    along = (vertices - centre) @ axes[:, 0]
    margin = 0.05 * np.ptp(along)
    stations = np.linspace(along.min() + margin, along.max() - margin, STATIONS)
    curve, cells = [np.zeros(1)] * 2, Cells.of(vertices, faces)
    for _ in range(4):
        seen, off = _centres(cells, centre, axes, stations, curve)
        if len(seen) < STATIONS / 2:
            raise MeshError(
                f"only {len(seen)} of {STATIONS} cross-sections close round the axis",
                cure="expected a tube: repair it, or give {}",
                arguments=("centreline=",),
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
    if s.min() <= 0 or s.max() >= line.s[-1] - 1e-6:
        raise _missed("the centreline, lengthened straight, ends before the mesh does")
    return _framed(line.at(np.linspace(s.min(), s.max(), int(np.ptp(s) / 0.5) + 2))[0])


def _missed(found: str) -> MeshError:
    return MeshError(
        f"{found}; expected points inside it, from one end to the other, in the file's unit and "
        "axes",
        cure="give another {}",
        arguments=("centreline=",),
    )


def _framed(points) -> Line:
    """Arc length, and frames that turn about the tangent no more than they must."""
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    tangents = np.gradient(points, s, axis=0)
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = [_frame(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])]
    for tangent in tangents[1:]:
        frames.append(_frame(tangent, frames[-1][:, 1]))
    return Line(points, s, np.stack(frames))


def check_turn(line: Line) -> None:
    """Refuse a line that turns further than `TURN`: its skeleton would be taken as straight."""
    tangents = line.frames[::5, :, 0]
    turn = math.degrees(math.acos(np.clip((tangents @ tangents.T).min(), -1, 1)))
    if turn > TURN:
        raise MeshError(
            f"its centreline turns by {turn:.0f} degrees, expected at most {TURN:.0f}: its skeleton"
            " is taken as straight; is it one trachea?",
            cure="give {} if it was found wrong",
            arguments=("centreline=",),
        )


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
