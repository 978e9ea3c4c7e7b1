"""Plane cuts through a surface, and rays in them: the outer contour round a centre.

A plane across the centreline cuts the triangles in segments; rays from the centre meet them. The
farthest hit is the outer contour, whatever the inner wall does, so that single and double walls
are read alike. Lengths in mm, host arrays in float64.
"""

import math
from typing import NamedTuple

import numpy as np

RAYS = 72
#: Angles of the rays, rad, ascending; 0 along the first axis of the frame.
ANGLES = 2 * math.pi * (np.arange(RAYS) + 0.5) / RAYS - math.pi


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


def contour(corners, centre, frame, outside: bool = True) -> np.ndarray:
    """Distance of the farthest hit of each ray in the plane across `frame`'s tangent, or NaN.

    Args:
        corners: of the triangles; shape (faces, 3, 3).
        centre: from which the rays go.
        frame: columns tangent, and the two axes of the plane.
        outside: NaN, too, where that is a triangle that faces the centre: the inner wall, seen
            through a hole of the outer one.
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

    def cross(a, b):
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    slope = cross(ray[:, None], side[None])
    slope = np.where(slope == 0, np.inf, slope)
    far = cross(first, side)[None] / slope
    way = cross(first[None], ray[:, None]) / slope
    far = np.where((way >= 0) & (way <= 1) & (far > 0), far, -np.inf)
    if not len(across):
        return np.full(RAYS, np.nan)
    last = far.argmax(axis=1)
    far = far[np.arange(RAYS), last]
    a, b, c = across[last].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    inwards = np.sum(normal[:, 1:] * ray, axis=1) < -0.5 * np.linalg.norm(normal, axis=1)
    return np.where((far > 0) & ~(outside & inwards), far, np.nan)
