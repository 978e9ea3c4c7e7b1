"""Repairing what a surface file may hold: doubles, slivers, dust, triangles turned inwards."""

from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.mesh import MeshError, edge_counts, face_vectors, unique_rows, volume

#: Triangles of the coarsest tube that still shows a shape.
FEWEST = 24
#: Corners nearer to each other than this share of the size, and than `SHORT` of the usual edge, are
#: one; share of the area that may be dropped.
WELD, SHORT, LOOSE = 5e-5, 0.1, 0.02


class Surface(NamedTuple):
    """Triangles: vertices (vertices, 3) and their numbers, faces (faces, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


def clean(surface: Surface) -> tuple[Surface, list[str]]:
    """Join vertices at the same place; drop collapsed and repeated triangles and small fragments.

    Slivers stay: they weigh nothing in normals or sections.

    Raises:
        MeshError: nothing is left, loose pieces have more than 2 % of the area, the surface
            branches, or its triangles face opposite ways.
    """
    if not np.ptp(surface.vertices, axis=0).max() > 0:
        raise MeshError("all vertices lie in one point; expected the surface of a trachea")
    (vertices, faces), notes = join_corners(surface)
    if not len(faces):
        raise MeshError("every triangle is collapsed; expected the surface of a trachea")
    if len(faces) < FEWEST:
        raise MeshError(f"{len(faces)} triangles are no trachea; expected at least {FEWEST}")
    kept = _large_pieces(vertices, faces)
    if not kept.all():
        _check_dropped(vertices, faces, kept, notes)
    used, faces = np.unique(faces[kept], return_inverse=True)
    cleaned = Surface(vertices[used], faces.reshape(-1, 3))
    return _outward(cleaned, notes), notes


def join_corners(surface: Surface) -> tuple[Surface, list[str]]:
    """Corners at one place are one vertex, those of open edges if they are nearly so; and notes.

    Triangles that collapse and repeated ones are dropped.
    """
    size, notes = np.ptp(surface.vertices, axis=0).max(), []
    grid = np.round((surface.vertices - surface.vertices.min(axis=0)) / (1e-7 * size))
    first, same = unique_rows(grid)
    vertices, faces = surface.vertices[first], same[surface.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    once, _ = unique_rows(np.sort(faces, axis=1))
    keep = np.zeros(len(faces), bool)
    keep[once] = True
    keep &= whole
    if not keep.all():
        notes.append(f"{np.sum(~keep)} collapsed or repeated triangles dropped")
    to = _nearly_one(vertices, faces[keep], WELD * size)
    if joined := int(np.sum(to != np.arange(len(to)))):
        notes.append(f"{joined} corners of open edges joined with those beside them")
    faces = to[faces[keep]]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return Surface(vertices, faces), notes


def _nearly_one(vertices, faces, far):
    """The vertex that each becomes: on open edges the first of those that lie beside it."""
    from scipy.spatial import KDTree

    to = np.arange(len(vertices))
    pairs, count = edge_counts(faces)
    ends = np.unique(pairs[count == 1])
    if not len(ends):
        return to
    usual = float(np.median(np.linalg.norm(np.diff(vertices[pairs], axis=1), axis=2)))
    near = KDTree(vertices[ends]).query_pairs(min(far, SHORT * usual), output_type="ndarray")
    across = ~np.isin(ends[near] @ [len(to), 1], pairs @ [len(to), 1])  # no edge collapses
    label = labels(near[across], len(ends))
    to[ends] = ends[np.unique(label, return_index=True)[1]][label]
    return to


def labels(pairs: np.ndarray, count: int) -> np.ndarray:
    """Which connected piece each of `count` points is in, linked by `pairs` (links, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _large_pieces(vertices, faces):
    """Which faces are of pieces longer than a third of the longest; the rest is dust."""
    label = labels(faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(vertices))
    order = np.argsort(label, kind="stable")
    first = np.unique(label[order], return_index=True)[1]
    low, high = (f.reduceat(vertices[order], first, axis=0) for f in (np.minimum, np.maximum))
    size = np.linalg.norm(high - low, axis=1)
    return size[label[faces[:, 0]]] > size.max() / 3


def _check_dropped(vertices, faces, kept, notes: list[str]) -> None:
    """Note the fragments that are dropped; refuse more than dust."""
    notes.append(f"{np.sum(~kept)} triangles of small loose fragments dropped")
    area = np.linalg.norm(face_vectors(vertices, faces), axis=1)
    share = area[~kept].sum() / area.sum()
    notes.append(f"their share of the area: {100 * share:.2g} %")
    if share > LOOSE:
        at = np.average(vertices[faces[~kept]].mean(axis=1), axis=0, weights=area[~kept])
        raise MeshError(
            f"loose pieces have {100 * share:.1f} % of its area (their middle: "
            f"{', '.join(f'{v:.4g}' for v in at)} in the file), expected {100 * LOOSE:.0f} % or "
            "less; join them to the wall, or remove them from the file"
        )


def _outward(surface: Surface, notes: list[str]) -> Surface:
    """Turn triangles outwards if the whole surface is inside out; refuse a mixed one."""
    vertices, faces = surface
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    if len(unique_rows(directed)[0]) < len(directed):
        pairs, count = edge_counts(faces)
        if np.any(count > 2):
            raise MeshError(
                f"{np.sum(count > 2)} edges belong to more than two triangles; expected a surface "
                "that does not branch: repair it first"
            )
        raise MeshError("neighbouring triangles face opposite ways; make the normals consistent")
    if volume(vertices, faces) < 0:
        notes.append("the surface was inside out: triangles turned")
        return Surface(vertices, faces[:, ::-1])
    _, count = edge_counts(faces)
    if np.any(count == 1):
        notes.append(f"{np.sum(count == 1)} open edges")
    return surface
