"""A tool from a surface file: one convex body, its corners the vertices of the shape."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxtrachea.contact import shapes
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.objects import combined
from jaxtrachea.trachea.surface_file import parts_of
from jaxtrachea.units import UnitError, unit_factor

#: Share of its size that a surface may lie inside of its convex hull.
HOLLOW = 0.01
#: Corners of a tool at most: the cost of a contact grows with them.
MAX_CORNERS = 256
#: Share of its size that corners may be left out by, at most.
COARSEST = 0.01


def read_tool(path: Path, unit: str | None, rounding: float) -> tuple[shapes.Shape, str]:
    """A convex tool about the origin of its file, and a note on its size.

    Args:
        path: STL, OBJ, PLY, GLB and what else trimesh reads.
        unit: of the file; None: mm.
        rounding: mm, on top of the surface on every side.

    Raises:
        MeshError: no surface, not convex, or with more corners than a tool may have and none that
            can be left out.
    """
    try:
        scale = unit_factor(unit or "mm", "length")
    except UnitError as error:
        raise MeshError(str(error), key="unit") from None
    surface = combined(list(parts_of(path).values()))
    corners = surface.vertices[surface.faces] * float(scale)
    points = np.unique(corners.reshape(-1, 3), axis=0)
    size = float(np.ptp(points, axis=0).max())
    # Two bodies apart have their corners on the hull, but not the middle of their inner faces.
    inside = np.concatenate([points, corners.mean(axis=1)])
    hollow = max(-float(_outside(inside, _planes(points)).min()), 0.0)
    if hollow > HOLLOW * size:
        raise MeshError(
            f"it is not convex: its surface lies {hollow:.3g} mm and more inside of its hull",
            cure="cut it into convex parts, and take the one that touches the trachea",
        )
    kept, left_out = _corners(points, size)
    sizes = " x ".join(f"{v:.3g}" for v in np.ptp(points, axis=0))
    note = f"tool: {sizes} mm, {len(kept)} corners"
    if left_out > 0:
        note += f"; those left out stand out of it by up to {left_out:.2g} mm"
    return shapes.cloud(kept, rounding, float), note


def _planes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "faces 4"]:
    """Planes of the convex hull, outward normals first.

    Raises:
        MeshError: flat, or a line.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points).equations
    except (QhullError, ValueError):
        raise MeshError(
            "it is flat; expected a body", cure="give it a thickness, or take shape = 'cloud'"
        ) from None


def _outside(points: Float[np.ndarray, "n 3"], planes: Float[np.ndarray, "f 4"]) -> np.ndarray:
    """Distance above the nearest plane of a hull, mm; negative inside; (n,)."""
    return np.concatenate([
        np.max(part @ planes[:, :3].T + planes[:, 3], axis=1)
        for part in np.array_split(points, 1 + points.size * len(planes) // 10**7)
    ])  # fmt: skip


def _corners(points: Float[np.ndarray, "n 3"], size: float) -> tuple[np.ndarray, float]:
    """Corners of the hull, as many as a tool may have, and how far the others stand out, mm."""
    kept = np.asarray(shapes.hull(points, dtype=float).vertices).T
    if len(kept) <= MAX_CORNERS:
        return kept, 0.0
    few = _foremost(kept, MAX_CORNERS)
    left_out = max(float(_outside(kept, _planes(few)).max()), 0.0)
    if left_out > COARSEST * size:
        raise MeshError(
            f"it has {len(kept)} corners; of {MAX_CORNERS} some stand out by {left_out:.2g} mm",
            cure="simplify the surface, or replace round edges by rounding = '1 mm'",
        )
    return few, left_out


def _foremost(points: Float[np.ndarray, "n 3"], count: int) -> np.ndarray:
    """Those of the points that are foremost in one of so many directions, spread evenly."""
    middle = points.mean(axis=0)
    n = np.arange(count) + 0.5
    z, angle = 1 - 2 * n / count, np.pi * (1 + 5**0.5) * n
    ring = np.sqrt(1 - z * z)
    ways = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return points[np.unique(np.argmax((points - middle) @ ways.T, axis=0))]
