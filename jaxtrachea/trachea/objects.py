"""Which objects of a file are pieces of one surface, and what is left out."""

import itertools

import numpy as np

from jaxtrachea.trachea.cleaning import WELD, Surface
from jaxtrachea.trachea.mesh import MeshError, edge_counts, face_vectors, unique_rows

#: Share of the area that an object may have that is left out, if it may be a piece of the wall; how
#: far one that is closed may reach beyond the wall's ends, over the wall's length (the carinas of
#: the Visible Human, closed objects of 4 and 6 % of the area: 0.007 and 0.015).
LEFT_OUT, BEYOND = 0.02, 0.03


def area_of(surface: Surface) -> float:
    """Area of all triangles."""
    return float(np.linalg.norm(face_vectors(*surface), axis=1).sum() / 2)


def combined(surfaces: list[Surface]) -> Surface:
    """All triangles in one."""
    shift = np.cumsum([0, *(len(f.vertices) for f in surfaces[:-1])])
    vertices = np.concatenate([f.vertices for f in surfaces])
    faces = [f.faces + at for f, at in zip(surfaces, shift, strict=True)]
    return Surface(vertices, np.concatenate(faces))


def joined(parts: dict[str, Surface]) -> tuple[dict[str, Surface], dict[str, str]]:
    """Objects that share open edges, joined under the name of the largest; and that of each."""
    from scipy.spatial import KDTree

    of = {name: name for name in parts}
    if len(parts) == 1:
        return parts, of
    far = WELD * max(float(np.ptp(part.vertices, axis=0).max()) for part in parts.values())
    edges = {name: _open_edges(part) for name, part in parts.items()}
    trees = {name: KDTree(at) for name, at in edges.items() if len(at)}
    for a, b in itertools.combinations(trees, 2):
        if of[a] != of[b] and trees[a].count_neighbors(trees[b], far):
            of = {name: of[a] if group == of[b] else group for name, group in of.items()}
    groups = {}
    for group in set(of.values()):
        names = [name for name in parts if of[name] == group]
        largest = max(names, key=lambda name: area_of(parts[name]))
        groups[largest] = combined([parts[name] for name in names])
        of |= dict.fromkeys(names, largest)
    return groups, of


def _open_edges(part: Surface) -> np.ndarray:
    """Middles of the edges that one triangle has; shape (edges, 3)."""
    first, same = unique_rows(part.vertices)
    pairs, count = edge_counts(same[part.faces])
    return part.vertices[first][pairs[count == 1]].mean(axis=1)


def check_left_out(parts: dict[str, Surface], wall: str, rings, chosen, notes: list[str]) -> None:
    """Note the objects that are neither wall nor rings; refuse one that may be a piece of the wall.

    Args:
        parts: the objects, after `joined`.
        wall: name of the wall.
        rings: name of the rings, or None.
        chosen: whether the user named the wall.
        notes: get a line for each.

    Raises:
        MeshError: an object of more than 2 % of the area is open, or reaches beyond the wall.
    """
    areas = {name: area_of(surface) for name, surface in parts.items()}
    middle = parts[wall].vertices.mean(axis=0)
    along = np.linalg.eigh(np.cov((parts[wall].vertices - middle).T))[1][:, -1]
    reach = parts[wall].vertices @ along
    for name in sorted(set(parts) - {wall, rings}):
        share = areas[name] / sum(areas.values())
        notes.append(f"left out: {name} ({100 * share:.1f} % of the area)")
        way = parts[name].vertices @ along
        beyond = max(reach.min() - way.min(), way.max() - reach.max()) > BEYOND * np.ptp(reach)
        if chosen or share <= LEFT_OUT or not (beyond or len(_open_edges(parts[name]))):
            continue
        raise MeshError(
            f"the object {name!r} has {100 * share:.1f} % of the area and may be a piece of the "
            f"wall, {wall!r}, but does not meet its edges",
            cure="join them in one object, or give {} (which leaves the other out)",
            arguments=("part=",),
        )
