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
    """A hole: from where to where along the tube and round it, and its width round it, mm."""

    s: tuple[float, float]
    phi: tuple[float, float]
    wide: float

    @property
    def size(self) -> float:
        """The larger of length and width, mm."""
        return max(self.s[1] - self.s[0], self.wide)

    @property
    def in_front(self) -> bool:
        """Whether it reaches into the arc of the rings."""
        return self.phi[0] < FRONT and self.phi[1] > -FRONT

    @property
    def words(self) -> str:
        """Its size and place."""
        low, high = (round(math.degrees(v)) for v in self.phi)
        return (
            f"a hole of {self.s[1] - self.s[0]:.2g} x {self.wide:.2g} mm at s = {self.s[0]:.1f} to "
            f"{self.s[1]:.1f} mm, phi = {low} to {high} degrees"
        )


def holes_of(surface: Surface, line: Line) -> list[Hole]:
    """Holes of the surface, the largest first; its open ends, loops round the line, are none."""
    pairs, count = edge_counts(surface.faces)
    used, pairs = np.unique(pairs[count == 1], return_inverse=True)
    if not len(used):
        return []
    label = labels(pairs.reshape(-1, 2), len(used))
    where = locate(line, surface.vertices[used])
    found = []
    for loop in range(label.max() + 1):
        of = label == loop
        s, phi, distance = where.s[of], where.phi[of], where.distance[of]
        middle = float(np.angle(np.exp(1j * phi).sum()))
        away = np.angle(np.exp(1j * (phi - middle)))
        if np.ptp(away) > math.radians(ROUND):
            continue
        wide = float(np.ptp(away) * distance.mean())
        around = middle + float(away.min()), middle + float(away.max())
        found.append(Hole((float(s.min()), float(s.max())), around, wide))
    return sorted(found, key=lambda hole: -hole.size)
