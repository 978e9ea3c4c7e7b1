"""A tool from a surface file: convex bodies, their corners the vertices of its parts."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.contact import shapes
from jaxtrachea.trachea.cleaning import Surface, labels
from jaxtrachea.trachea.mesh import MeshError, edge_counts, unique_rows, volume
from jaxtrachea.trachea.objects import combined
from jaxtrachea.trachea.surface_file import parts_of
from jaxtrachea.units import UnitError, unit_factor

#: Share of its size that a surface may lie inside of its convex hull.
HOLLOW = 0.01
#: Share of the size of an object within which corners are one.
WELDED = 1e-7
#: Triangles at one edge this near to each other, rad, lie on one another.
SAME_TURN = 1e-6
#: Share of its hull that a closed body may leave empty.
EMPTY = 0.1
#: Corners of a convex part at most: the cost of a contact grows with them.
MAX_CORNERS = 256
#: Share of its size that corners may be left out by, at most.
COARSEST = 0.01


def read_tool(path: Path, unit: str | None, rounding: float) -> tuple[shapes.Shape, str]:
    """A tool about the origin of its file, one convex body or several, and a note on its size.

    Several bodies are the objects of the file, and what of one hangs together by its edges; they
    may touch each other, share a face, or overlap.

    Args:
        path: STL, OBJ, PLY, GLB and what else trimesh reads.
        unit: of the file; None: mm.
        rounding: mm, on top of the surface on every side.

    Raises:
        MeshError: no surface, a body that is not convex or inside out, more bodies than a tool may
            have, or one with more corners than it may have and none that can be left out.
    """
    try:
        scale = unit_factor(unit or "mm", "length")
    except UnitError as error:
        raise MeshError(str(error), key="unit") from None
    objects = {
        name: _welded(Surface(part.vertices * float(scale), part.faces))
        for name, part in parts_of(path).items()
    }
    whole = _welded(combined(list(objects.values())))
    found = _bodies(objects, whole)
    kept, left_out = [], 0.0
    for name, body in found.items():
        corners, out = _corners(body, name)
        kept.append(shapes.cloud(corners, rounding, float))
        left_out = max(left_out, out)
    sizes = " x ".join(f"{v:.3g}" for v in np.ptp(_points(whole), axis=0))
    of = f" {len(kept)} convex parts," if len(kept) > 1 else ""
    count = sum(part.vertices.shape[1] for part in kept)
    note = f"tool: {sizes} mm,{of} {count} corners"
    if left_out > 0:
        note += f"; those left out stand out of it by up to {left_out:.2g} mm"
    return kept[0] if len(kept) == 1 else shapes.compound(kept), note


def _bodies(objects: dict[str, Surface], whole: Surface) -> dict[str, Surface]:
    """All in one where that is convex and no closed bodies lie apart; else what hangs together.

    Raises:
        MeshError: bodies that are no convex parts of a tool.
    """
    pieces = _pieces(whole)
    apart = len(pieces) > 1 and all(map(_closed, pieces))
    if not apart and _unlike_hull(whole) is None:
        return {"it": whole}
    found = {}
    for name, part in objects.items():
        pieces = _pieces(part)
        names = [name] if len(pieces) == 1 else [f"{name}, body {i}" for i in range(len(pieces))]
        found |= dict(zip(names, pieces, strict=True))
    found = found if len(found) > 1 else {"it": whole}
    _check_bodies(found)
    return found


def _welded(surface: Surface) -> Surface:
    """Corners at one place are one vertex; collapsed triangles are left out."""
    vertices, size = surface.vertices, float(np.ptp(surface.vertices, axis=0).max())
    first, same = unique_rows(np.round((vertices - vertices.min(axis=0)) / (WELDED * size or 1)))
    faces = same[surface.faces]
    return Surface(vertices[first], faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def _pieces(surface: Surface) -> list[Surface]:
    """What hangs together by its edges; bodies that share a face or an edge are apart."""
    vertices, faces = surface
    piece = labels(_neighbours(vertices, faces), len(faces))
    found = []
    for label in np.unique(piece):
        used, own = np.unique(faces[piece == label], return_inverse=True)
        found.append(Surface(vertices[used], own.reshape(-1, 3)))
    return found


def _neighbours(vertices, faces) -> Int[np.ndarray, "pairs 2"]:
    """Triangles that go on in each other at an edge, by their numbers."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    same = unique_rows(np.sort(edges, axis=1))[1]
    order = np.argsort(same, kind="stable")
    twice = np.bincount(same)[same[order]] == 2
    found, others = [order[twice].reshape(-1, 2)], order[~twice]
    for at in np.split(others, np.flatnonzero(np.diff(same[others])) + 1):
        found.append(_across(vertices, faces, edges, at))
    return np.concatenate(found) // 3


def _across(vertices, faces, edges, at):
    """Pairs of the sides `at` of an edge of several bodies: those with a body's inside between.

    Triangles turn their fronts outwards, so that the inside of one that runs up the edge is
    clockwise of it. All are paired where as many do not run down as up: no closed bodies.
    """
    up = edges[at, 0] < edges[at, 1]
    if up.sum() != (~up).sum() or len(at) == 0:
        return np.stack([at[:-1], at[1:]], axis=1)
    low, high = np.sort(edges[at[0]])
    along = vertices[high] - vertices[low]
    third = faces[at // 3].sum(axis=1) - edges[at].sum(axis=1)
    out = np.cross(along, vertices[third] - vertices[low])
    turn = np.arctan2(np.cross(out[0], out) @ along / np.linalg.norm(along), out @ out[0])
    inside = (turn[up][:, None] - turn[~up][None] - SAME_TURN) % (2 * np.pi)
    return np.stack([at[up], at[~up][np.argmin(inside, axis=1)]], axis=1)


def _closed(body: Surface) -> bool:
    """Whether a volume is known: two triangles at every edge, in opposite directions."""
    directed = body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    once = len(unique_rows(directed)[0]) == len(directed)
    return once and bool((edge_counts(body.faces)[1] == 2).all())


def _check_bodies(found: dict[str, Surface]) -> None:
    """Refuse bodies that are no convex parts of a tool."""
    if len(found) > shapes.MAX_PARTS:
        raise MeshError(
            f"it has {len(found)} bodies; expected at most {shapes.MAX_PARTS} convex parts",
            cure="leave out those that do not touch the trachea, or join them in fewer",
        )
    outward = {name: volume(*body) > 0 for name, body in found.items()}
    for name, body in found.items():
        if how := _unlike_hull(body):
            raise MeshError(
                f"{name} is not convex: {how}",
                cure="cut it into convex parts, each a body by itself or an object of the file "
                "(the Python packages coacd and vhacdx do; trimesh's convex_decomposition calls "
                "the latter)",
            )
        if not outward[name] and any(outward.values()):
            raise MeshError(
                f"{name} is inside out, other bodies are not: its triangles face inwards",
                cure="turn them, or remove it if it is the hole of another",
            )


def _unlike_hull(body: Surface) -> str | None:
    """How a surface differs from its convex hull; None: it is that."""
    hollow = _hollow(body)
    if hollow > HOLLOW * float(np.ptp(body.vertices, axis=0).max()):
        return f"its surface lies {hollow:.3g} mm and more inside of its hull"
    if not _closed(body):
        return None
    # A long thin fork: all of its surface is near its hull.
    own, hull = abs(volume(*body)), _hull(body.vertices).volume
    if own < (1 - EMPTY) * hull:
        return f"its volume is {own:.3g} mm^3, that of its hull {hull:.3g} mm^3"
    return None


def _points(body: Surface) -> Float[np.ndarray, "n 3"]:
    """Different corners of the triangles."""
    return np.unique(body.vertices[body.faces].reshape(-1, 3), axis=0)


def _hollow(body: Surface) -> float:
    """How far the surface lies inside of its hull, mm: at its corners or amid its triangles.

    Two bodies apart have their corners on the hull, but not the middle of their inner faces.
    """
    corners, points = body.vertices[body.faces], _points(body)
    inside = np.concatenate([points, corners.mean(axis=1)])
    return max(-float(_outside(inside, _planes(points)).min()), 0.0)


def _planes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "faces 4"]:
    """Planes of the convex hull, outward normals first."""
    return _hull(points).equations


def _hull(points: Float[np.ndarray, "n 3"]):
    """The convex hull."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points)
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


def _corners(body: Surface, name: str) -> tuple[np.ndarray, float]:
    """Corners of the hull, as many as a part may have, and how far the others stand out, mm."""
    points = _points(body)
    kept = np.asarray(shapes.hull(points, dtype=float).vertices).T
    if len(kept) <= MAX_CORNERS:
        return kept, 0.0
    few = _foremost(kept, MAX_CORNERS)
    left_out = max(float(_outside(kept, _planes(few)).max()), 0.0)
    most = COARSEST * float(np.ptp(points, axis=0).max())
    if left_out > most:
        raise MeshError(
            f"{name} has {len(kept)} corners, a part at most {MAX_CORNERS}, and of so many some "
            f"stand out by {left_out:.2g} mm; expected {most:.2g} mm or less, "
            f"{100 * COARSEST:g} % of its size",
            cure="simplify the surface, give a round tool as a shape, or give what is left of it "
            "within its round edges, say 1 mm, with rounding = '1 mm'",
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
