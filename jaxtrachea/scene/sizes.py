"""Sizes that tools and walls can have; beyond them the unit is most likely wrong."""

import numpy as np

from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.sizes import SizeError, cause, check_geometry
from jaxtrachea.trachea.tube import WALL

#: Longest tool, mm.
LONGEST_TOOL = 1000.0
#: Table 1: radius of the rings' line, and of the outside, mm. What fits this tube by its length is
#: as much longer or shorter for another one as that one is larger or smaller.
RADIUS, OUTER = 11.3, 11.3 + WALL / 2


def check_sizes(geometry: Geometry, outer: float, tool: Shape | None) -> None:
    """Refuse lengths that are most likely given in another unit.

    Args:
        outer: radius of its outside, mm.
        tool: or None.

    Raises:
        SizeError: the first of them.
    """
    check_geometry(geometry)
    radius = float(geometry.radius)
    if not radius / 2 <= outer <= 1.5 * radius:
        raise SizeError(
            f"is {outer:.4g} mm, that of the rings' line {radius:.4g} mm",
            key="radius of the outside",
            expected="it half to one and a half times as large (a wall not thicker than the "
            "radius)",
            cure="check the units of wall and radius",
            joint=" ",
        )
    if tool is not None:
        low, high = extents(tool)
        across = float((high - low).max())
        if not across <= LONGEST_TOOL:
            raise SizeError(
                f"is {across:.4g} mm across",
                key="tool",
                expected=f"at most {LONGEST_TOOL:g} mm",
                cure=f"lengths are in mm: {cause(across)}",
                joint=" ",
            )


def check_width(geometry: Geometry, tool: Shape | None, half_width: float) -> None:
    """Refuse a width that the tube has no place for, or that the tool has not.

    Args:
        tool: or None.
        half_width: of its flat end along the tube, mm.

    Raises:
        SizeError: how wide it is, and how wide it may be.
    """
    most, of = float(geometry.length) / 2, "half the length of the tube"
    if tool is not None:
        reach = max(_reach(part) for part in parts_of(tool))
        most, of = min((most, of), (reach, "as far as the tool reaches from its middle"))
    if half_width > most:
        raise SizeError(
            f"is {half_width:.4g} mm", key="half_width", joint=" ",
            expected=f"at most {most:.4g} mm, {of}",
            cure="of a flat round end it is pi/4 of the radius",
        )  # fmt: skip


def extents(tool: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of a tool, with its rounding, mm; shape (3,) each."""
    parts = [(np.asarray(p.vertices, float), float(p.radius)) for p in parts_of(tool)]
    low = np.min([corners.min(axis=1) - radius for corners, radius in parts], axis=0)
    return low, np.max([corners.max(axis=1) + radius for corners, radius in parts], axis=0)


def _reach(part: Shape) -> float:
    """How far a convex body reaches from its middle, mm."""
    corners = np.asarray(part.vertices, float)
    away = corners - corners.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.sum(away**2, axis=0)).max()) + float(part.radius)
