"""Repairing what a surface file may hold: doubles, slivers, dust, triangles turned inwards."""

from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.mesh import MeshError, edge_counts, unique_rows, volume

#: Triangles of the coarsest tube that still shows a shape.
FEWEST = 24


class Surface(NamedTuple):
    """Triangles: vertices (vertices, 3) and their numbers, faces (faces, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


def clean(surface: Surface) -> tuple[Surface, list[str]]:
    """Join vertices at the same place; drop collapsed and repeated triangles and small fragments.

    Slivers stay: they weigh nothing in normals or sections.
    """
    notes = []
    size = np.ptp(surface.vertices, axis=0).max()
    if not size > 0:
        raise MeshError("all vertices lie in one point; expected the surface of a trachea")
    grid = np.round((surface.vertices - surface.vertices.min(axis=0)) / (1e-7 * size))
    first, same = unique_rows(grid)
    faces = same[surface.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    once, _ = unique_rows(np.sort(faces, axis=1))
    keep = np.zeros(len(faces), bool)
    keep[once] = True
    keep &= whole
    if not keep.all():
        notes.append(f"{np.sum(~keep)} collapsed or repeated triangles dropped")
    vertices, faces = surface.vertices[first], faces[keep]
    if not len(faces):
        raise MeshError("every triangle is collapsed; expected the surface of a trachea")
    if len(faces) < FEWEST:
        raise MeshError(f"{len(faces)} triangles are no trachea; expected at least {FEWEST}")
    faces, dropped = _without_fragments(vertices, faces)
    if dropped:
        notes.append(f"{dropped} triangles of small loose fragments dropped")
    used, faces = np.unique(faces, return_inverse=True)
    cleaned = Surface(vertices[used], faces.reshape(-1, 3))
    return _outward(cleaned, notes), notes


def _without_fragments(vertices, faces):
    """Pieces longer than a third of the longest; the rest is dust."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = faces.T
    links = np.concatenate([a, b]), np.concatenate([b, c])
    graph = coo_array((np.ones(len(links[0]), bool), links), shape=(len(vertices),) * 2)
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(label, kind="stable")
    first = np.unique(label[order], return_index=True)[1]
    low, high = (f.reduceat(vertices[order], first, axis=0) for f in (np.minimum, np.maximum))
    size = np.linalg.norm(high - low, axis=1)
    keep = size[label[a]] > size.max() / 3
    return faces[keep], int(np.sum(~keep))


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
