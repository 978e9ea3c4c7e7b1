"""Triangles of a tool, its distance from points, rings on a wall, lines where it crosses a level.

For pictures and mesh files: numpy, no derivative. Lengths in mm.
"""

import contextlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.trachea.mesh import face_vectors

#: Directions on the sphere: a ball of 5 mm is drawn within 0.03 mm.
DIRECTIONS = 600
#: Radius that a part without a volume is drawn with, mm.
THINNEST = 0.05


class Triangles(NamedTuple):
    """A triangle mesh.

    Attributes:
        vertices: mm; shape (vertices, 3).
        faces: three vertices each, counter-clockwise seen from outside; shape (faces, 3).
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


class Crossings(NamedTuple):
    """Segments on the edges of triangles; a value per vertex is interpolated by `at`.

    Attributes:
        start: first vertex of the edge at both ends of each segment; shape (segments, 2).
        stop: second vertex of that edge.
        share: place on the edge, 0 at the first vertex, 1 at the second.
    """

    start: Int[np.ndarray, "segments 2"]
    stop: Int[np.ndarray, "segments 2"]
    share: Float[np.ndarray, "segments 2"]

    def at(self, values: np.ndarray) -> np.ndarray:
        """Values at both ends of every segment; shape (segments, 2, ...).

        Args:
            values: of every vertex; shape (vertices, ...).
        """
        share = self.share.reshape(self.share.shape + (1,) * (values.ndim - 1))
        return (1 - share) * values[self.start] + share * values[self.stop]


def sphere_directions(count: int = DIRECTIONS) -> Float[np.ndarray, "count 3"]:
    """Unit vectors spread evenly by the golden angle."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def tool_triangles(tool: Shape, count: int = DIRECTIONS) -> Triangles:
    """The surfaces of a tool's convex parts about its own origin.

    Each is the hull of the support points in `count` directions and along the axes, so it lies
    inside the tool by at most 1 - cos of half the angle between directions, times the radius. A
    point, a line or a plate without a radius is drawn with `THINNEST`.
    """
    parts = [_triangles(part, count) for part in parts_of(tool)]
    shift = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + at for part, at in zip(parts, shift, strict=True)]
    return Triangles(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _triangles(shape: Shape, count: int) -> Triangles:
    """The surface of one convex body."""
    from scipy.spatial import ConvexHull, QhullError

    corners, radius = np.asarray(shape.vertices, float).T, float(shape.radius)

    def rounded(radius: float) -> np.ndarray:
        ways = np.concatenate([sphere_directions(count), np.eye(3), -np.eye(3)])
        return corners[np.argmax(ways @ corners.T, axis=1)] + radius * ways

    points = rounded(radius) if radius > 0 else corners
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):  # flat, or too few corners
        points = rounded(THINNEST)
        hull = ConvexHull(points)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = points[used], faces.reshape(hull.simplices.shape)
    inward = np.sum(face_vectors(vertices, faces) * hull.equations[:, :3], axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Triangles(vertices, faces)


def tool_distance(tool: Shape, points: np.ndarray) -> np.ndarray:
    """Signed distance of points from a tool about its own origin, mm; negative inside.

    Of each convex part it is the largest of d . x - h(d) over directions d, with the support
    function h: the normals of the faces and 4,000 others. The error is below a hundredth of the
    part's size.

    Args:
        points: in its frame; shape (points, 3).
    """
    return np.min([_distance(part, points) for part in parts_of(tool)], axis=0)


def _distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    """`tool_distance` of one convex body."""
    from scipy.spatial import ConvexHull, QhullError

    ways, corners = sphere_directions(4000), np.asarray(shape.vertices, float)
    with contextlib.suppress(QhullError, ValueError):  # a ball, a capsule or a plate has no faces
        ways = np.concatenate([ways, ConvexHull(corners.T).equations[:, :3]])
    reach = (ways @ corners).max(axis=1) + float(shape.radius)
    return np.max(points @ ways.T - reach, axis=1)


def rings_on(s, phi, distance, rings: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that lie on a ring (bool), and the vertex of each ring on the anterior midline.

    Args:
        s: of the vertices along the centreline, mm.
        phi: round it, rad.
        distance: from it, mm.
        rings: `position` of each and `height`, mm, and `half_angle`, rad.
    """
    s, phi, distance = (np.asarray(v, float) for v in (s, phi, distance))
    away = np.abs(s[:, None] - np.asarray(rings["position"], float))
    ring = (away.min(axis=1) <= float(rings["height"]) / 2) & (
        abs(phi) <= float(rings["half_angle"])
    )
    return ring, np.hypot(away, (distance * phi)[:, None]).argmin(axis=0)


def nearest_vertices(s, phi, rest: Mapping[str, np.ndarray]) -> Int[np.ndarray, " rows"]:
    """Vertex of a wall that is nearest to each place on it; the first where a place is NaN.

    Args:
        s: of the places along the centreline, mm; shape (rows,).
        phi: round it, rad; likewise.
        rest: `s`, `phi` and `distance` of the vertices, mm and rad.
    """
    s, phi = (np.asarray(v, float)[:, None] for v in (s, phi))
    turn = np.asarray(rest["phi"] - phi + np.pi) % (2 * np.pi) - np.pi
    away = np.hypot(rest["s"] - s, rest["distance"] * turn)
    return np.nan_to_num(away, nan=np.inf).argmin(axis=1)


def crossings(faces: np.ndarray, values: np.ndarray, level: float = 0.0) -> Crossings:
    """Where a linear function on triangles takes a value: a plane's section, an outline.

    Args:
        faces: shape (faces, 3).
        values: of every vertex; shape (vertices,). Triangles with NaN give nothing.
        level: the value sought.
    """
    above = values > level
    count = above[faces].sum(axis=1)
    mixed = (count == 1) | (count == 2)
    mixed &= np.isfinite(values[faces]).all(axis=1)
    corners = faces[mixed]
    lone = above[corners] == (count[mixed] == 1)[:, None]  # the corner that is alone on its side
    first = np.argmax(lone, axis=1)
    rows = np.arange(len(corners))
    start = corners[rows, first]
    stop = np.stack([corners[rows, (first + 1) % 3], corners[rows, (first + 2) % 3]], axis=1)
    begin = values[start][:, None]
    share = (level - begin) / (values[stop] - begin)
    return Crossings(np.repeat(start[:, None], 2, axis=1), stop, share)
