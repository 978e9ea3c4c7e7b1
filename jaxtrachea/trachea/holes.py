"""Holes of a surface: loops of open edges, and where they are. Lengths in mm, angles in rad."""

import math
from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.centreline import Line, locate
from jaxtrachea.trachea.cleaning import Surface, labels
from jaxtrachea.trachea.mesh import edge_counts

#: A loop that goes further round the tube is an end, degrees.
ROUND = 300.0
#: Half of the arc on which rings are looked for, rad: the anterior side, clear of the rings' ends.
FRONT = 1.6


class Hole(NamedTuple):
    """A hole.

    Attributes:
        s: from where to where along the tube, mm.
        phi: the same round it, rad.
        wide: round it, mm.
        area: mm^2; that of a crack is next to nothing.
    """

    s: tuple[float, float]
    phi: tuple[float, float]
    wide: float
    area: float

    @property
    def size(self) -> float:
        """Side of a square of the same area, mm."""
        return math.sqrt(self.area)

    @property
    def in_front(self) -> bool:
        """Whether it reaches into the arc of the rings."""
        return self.phi[0] < FRONT and self.phi[1] > -FRONT

    @property
    def words(self) -> str:
        """Its size and place."""
        low, high = (round((math.degrees(v) + 180) % 360 - 180) for v in self.phi)
        return (
            f"a hole of {self.s[1] - self.s[0]:.2g} x {self.wide:.2g} mm at s = {self.s[0]:.1f} to "
            f"{self.s[1]:.1f} mm, phi = {low} to {high} degrees"
        )


def holes_of(surface: Surface, line: Line) -> list[Hole]:
    """Holes of the surface, the largest first; its open ends, loops round the line, are none."""
    once, count = edge_counts(surface.faces)
    if not np.any(count == 1):
        return []
    directed = surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    size = [len(surface.vertices), 1]
    alone = np.isin(np.sort(directed, axis=1) @ size, once[count == 1] @ size)
    used, pairs = np.unique(directed[alone], return_inverse=True)
    pairs = pairs.reshape(-1, 2)
    label = labels(pairs, len(used))
    points = surface.vertices[used] - surface.vertices[used].mean(axis=0)
    swept = np.cross(points[pairs[:, 0]], points[pairs[:, 1]]) / 2
    where = locate(line, surface.vertices[used])
    found = []
    for loop in range(label.max() + 1):
        of = label == loop
        s, phi, distance = where.s[of], where.phi[of], where.distance[of]
        middle = float(np.angle(np.exp(1j * phi).sum()))
        away = np.angle(np.exp(1j * (phi - middle)))
        if np.ptp(away) > math.radians(ROUND):
            continue
        around = middle + float(away.min()), middle + float(away.max())
        area = float(np.linalg.norm(swept[of[pairs[:, 0]]].sum(axis=0)))
        wide = float(np.ptp(away) * distance.mean())
        found.append(Hole((float(s.min()), float(s.max())), around, wide, area))
    return sorted(found, key=lambda hole: -hole.area)
