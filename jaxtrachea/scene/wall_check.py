"""Whether the patches that a tool touches lie where the mesh is: gaps against its closest points.

Balls stand beside points of the outer wall, drawn by area. The gap to the patches (sharp: without
the smoothing of `Touch.gap`, which `Touch.bound` limits) is compared with the distance to the
closest of all triangles. Between the rings an error beyond the limit refuses the mesh; beyond them
(forks, flares, open ends) it makes the patch a doubtful one. On numbers, once; nothing here is
traced.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxtrachea.contact.patches import Patches
from jaxtrachea.scene.sizes import RADIUS
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh, MeshError, face_vectors

#: Balls that are tried.
COUNT = 400
#: Their radius, and how far they are moved off the wall at most, in and out; shares of the radius.
BALL, AWAY = 0.3, 0.1
#: By how much a patch runs on beyond each border of Table 1's tube, mm; on any at most this share
#: of the rings' distance.
OVERLAP, OVERLAP_SHARE = 0.5, 0.15
#: Least limit of the worst, as a share of the radius: meshes are made of facets.
LEAST_LIMIT = 0.02
#: Patches that are searched for each.
NEAREST = 4
#: Classes of triangles by size, each half of the next; points that are searched together.
SIZES, CHUNK = 12, 100
#: Width of a triangle over its length, below which roundings say where its normal points.
SLIVER = 1e-6
#: Sine of the least angle between a triangle of the outer wall and the radial direction.
OUTWARD = 0.3
#: The median may be this share of the limit of the worst.
USUAL = 0.25


class WallError(NamedTuple):
    """Gap of the patches less that of the mesh, for a sample of balls beside the wall.

    Attributes:
        error: mm; positive: the tool touches too late; shape (balls,).
        gap: of the mesh, mm.
        s: position of the balls, mm.
        limit: of the worst, mm; see `limit_of`.
    """

    error: np.ndarray
    gap: np.ndarray
    s: np.ndarray
    limit: float

    @property
    def median(self) -> float:
        """Median of |error|, mm."""
        return float(np.median(np.abs(self.error)))

    @property
    def worst(self) -> float:
        """Largest |error|, mm."""
        return float(np.abs(self.error).max())

    @property
    def sentence(self) -> str:
        """What `plan` tells."""
        return (
            f"contact gap against the mesh's closest points, {len(self.error)} balls beside the "
            f"wall: median {self.median:.2g} mm, worst {self.worst:.2g} mm (limit "
            f"{self.limit:.2g} mm)"
        )


def limit_of(geometry: Geometry) -> float:
    """Largest error of the gap that a trachea explains, mm.

    A patch is convex: it bridges a hollow as long as itself, p^2 / (8 R) deep if the wall bends
    with the radius R. p: the median distance of the rings and what a patch runs on beyond its
    borders (at most R in all); R: the radius of the tube, the sharpest bend that its rings leave
    room for. At least `LEAST_LIMIT` of R.
    """
    radius = float(geometry.radius)
    p = min(spacing_of(geometry) + 2 * overlap_of(geometry), radius)
    return max(p**2 / (8 * radius), LEAST_LIMIT * radius)


def spacing_of(geometry: Geometry) -> float:
    """Median distance of the rings, mm; at most the radius."""
    radius, rings = float(geometry.radius), np.asarray(geometry.ring_positions, float)
    return min(float(np.median(np.diff(rings))), radius) if len(rings) > 1 else radius


def overlap_of(geometry: Geometry) -> float:
    """By how much a patch runs on beyond each border, mm: a share of the radius."""
    size = float(geometry.radius) / RADIUS
    return min(OVERLAP * size, OVERLAP_SHARE * spacing_of(geometry))


def checked_span(geometry: Geometry) -> tuple[float, float]:
    """Where the wall is checked, mm: from the first to the last ring; a radius about a lone one."""
    rings = np.asarray(geometry.ring_positions, float)
    reach = float(geometry.radius) if len(rings) == 1 else 0.0
    return float(rings[0]) - reach, float(rings[-1]) + reach


def measure(mesh: Mesh, geometry: Geometry, patches: Patches, count: int = COUNT) -> WallError:
    """Gaps of balls beside the wall, along the rings (`checked_span`)."""
    centres, s, radius = _balls(mesh, geometry, count)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    gap = _distance(vertices[faces], centres) - radius
    return WallError(_sharp_gap(patches, centres)[0] - radius - gap, gap, s, limit_of(geometry))


def check(mesh: Mesh, geometry: Geometry, patches: Patches) -> WallError:
    """`measure`, and the limit.

    Raises:
        MeshError: the patches are not the wall.
    """
    seen = measure(mesh, geometry, patches)
    if seen.worst <= seen.limit and seen.median <= USUAL * seen.limit:
        return seen
    at = float(seen.s[np.abs(seen.error).argmax()])
    off = (
        f"a tool would not touch it where it is: the contact gap is off by {seen.median:.2g} mm in "
        f"the median and by {seen.worst:.2g} mm at worst (at s = {at:.3g} mm), expected at most "
        f"{USUAL * seen.limit:.2g} and {seen.limit:.2g} mm for rings this far apart"
    )
    if mesh.frames is None:
        cure = "make {} smaller, so that its rings stand out less"
        raise MeshError(f"the tube: {off}", cure=cure, arguments=("relief",))
    raise MeshError(
        f"{off}; is it the outer wall, one tube without branches and sharp bends?",
        cure="give that surface, or {}, where the rings are",
        arguments=("ring_positions",),
    )


class Beyond(NamedTuple):
    """What balls beyond the first and the last ring say of the patches there.

    Attributes:
        uncertain: patches that are further off than the limit somewhere; shape (patches,).
        worst: largest |error| there, mm; 0 without any.
        s: first and last position of the balls of doubtful patches before the rings, and behind
            them, mm; NaN without any.
    """

    uncertain: np.ndarray
    worst: float
    s: tuple[tuple[float, float], tuple[float, float]]

    @property
    def sentence(self) -> str:
        """What `plan` tells; nothing where all is well."""
        spans = [f"{a:.3g} to {b:.3g} mm" for a, b in self.s if a <= b]
        if not spans:
            return ""
        return (
            f"at s = {' and '.join(spans)}, beyond the rings, the contact gap is off by up to "
            f"{self.worst:.2g} mm (a fork, an open end or a flare, bridged): touches there are "
            "unsure"
        )


def look_beyond(mesh: Mesh, geometry: Geometry, patches: Patches) -> Beyond:
    """Gaps of balls beside the wall beyond the first and the last ring. Arguments as `measure`."""
    none = (math.nan, math.nan)
    uncertain = np.zeros(patches.centres.shape[0], bool)
    try:
        centres, s, radius = _balls(mesh, geometry, COUNT, beyond=True)
    except MeshError:  # no wall there
        return Beyond(uncertain, 0.0, (none, none))
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    signed, patch = _sharp_gap(patches, centres)
    error = np.abs(signed - _distance(vertices[faces], centres))
    uncertain[patch[error > limit_of(geometry)]] = True
    rows = uncertain[patch]
    if not rows.any():
        return Beyond(uncertain, 0.0, (none, none))
    middle = float(np.mean(np.asarray(geometry.ring_positions)))

    def span(v):
        return (float(v.min()), float(v.max())) if len(v) else none

    ends = span(s[rows & (s < middle)]), span(s[rows & (s > middle)])
    return Beyond(uncertain, float(error[rows].max()), ends)


def _balls(mesh, geometry, count, beyond=False):
    """Centres beside the outer wall along the rings, or else beyond them; s; their radius."""
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    vector = face_vectors(vertices, faces)
    area = np.linalg.norm(vector, axis=1)
    normal = vector / np.where(area > 0, area, 1)[:, None]
    phi, s = np.asarray(mesh.phi, float), np.asarray(mesh.s, float)
    out = np.stack([0 * phi, np.cos(phi), np.sin(phi)], axis=1)
    if mesh.frames is not None:
        out = np.einsum("vij,vj->vi", np.asarray(mesh.frames, float), out)
    first, last = checked_span(geometry)
    at = s[faces]
    weight = area * (np.einsum("fi,fi->f", normal, out[faces[:, 0]]) > OUTWARD)
    between = (at.min(axis=1) >= first) & (at.max(axis=1) <= last)
    weight *= ~between if beyond else between
    if not weight.sum() > 0:
        where = f"from s = {first:.3g} to {last:.3g} mm, along its rings,"
        raise MeshError(f"no triangle {where} faces outwards; expected an outer wall")
    rng = np.random.default_rng(0)
    face = rng.choice(len(faces), count, p=weight / weight.sum())
    share = rng.dirichlet([1, 1, 1], count)
    point = np.einsum("fi,fij->fj", share, vertices[faces[face]])
    size = float(geometry.radius)
    away = BALL * size + AWAY * size * rng.uniform(-1, 1, count)
    centres = point + away[:, None] * normal[face]
    return centres, np.sum(share * at[face], axis=1), BALL * size


def _distance(corners, points):
    """Of points to the closest of all triangles, each with a centre near enough to hold it.

    Triangles of about one size share a tree, so that a few large ones do not widen every search.
    """
    from scipy.spatial import KDTree

    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    size = np.ceil(np.log2(np.maximum(reach / reach.max(), 2.0**-SIZES))).astype(int)
    found = np.full(len(points), np.inf)
    for one in np.unique(size):
        rows = np.flatnonzero(size == one)
        tree = KDTree(middle[rows])
        away = np.minimum(tree.query(points)[0], found) + reach[rows].max()
        for at in range(0, len(points), CHUNK):
            some = slice(at, at + CHUNK)
            near = tree.query_ball_point(points[some], away[some])
            found[some] = np.minimum(found[some], _nearest(corners[rows], points[some], near))
    return found


def _nearest(corners, points, near):
    """Distance of each point to the closest of the triangles listed for it; inf without any."""
    count, found = np.array([len(v) for v in near]), np.full(len(points), np.inf)
    listed = np.flatnonzero(count)
    if not len(listed):
        return found
    point = np.repeat(points, count, axis=0)
    away = _away(corners[np.concatenate(near).astype(int)], point)
    first = np.concatenate([[0], np.cumsum(count[listed])[:-1]])
    found[listed] = np.minimum.reduceat(away, first)
    return found


def _away(corners, points):
    """Distance of each point to its triangle; a sliver is no more than its edges."""
    start, edge = corners, np.roll(corners, -1, axis=1) - corners
    off = points[:, None] - start
    square = np.einsum("tei,tei->te", edge, edge)
    along = np.einsum("tei,tei->te", off, edge) / np.where(square > 0, square, 1)
    beside = off - np.clip(along, 0, 1)[:, :, None] * edge
    found = np.sqrt(np.einsum("tei,tei->te", beside, beside)).min(axis=1)
    normal = np.cross(edge[:, 0], edge[:, 1])
    size = np.linalg.norm(normal, axis=1)
    over = np.einsum("tei,ti->te", np.cross(edge, off), normal).min(axis=1) >= 0
    over &= size > SLIVER * square.max(axis=1)
    height = np.abs(np.einsum("ti,ti->t", off[:, 0], normal)) / np.where(over, size, 1)
    return np.where(over, np.minimum(found, height), found)


def _sharp_gap(patches: Patches, points):
    """Signed distance of points to the union of the patches, and which patch is the nearest."""
    from scipy.spatial import ConvexHull

    cores = np.asarray(patches.shapes.vertices, float).transpose(0, 2, 1)
    radius = np.asarray(patches.shapes.radius, float)
    hulls = [ConvexHull(core) for core in cores]
    depth = [(points @ h.equations[:, :3].T + h.equations[:, 3]).max(axis=1) for h in hulls]
    bounds = np.stack(depth, axis=1) - radius  # exact inside a core, else a lower bound
    found, nearest = np.full(len(points), np.inf), np.zeros(len(points), int)
    for rank in np.argsort(bounds, axis=1)[:, :NEAREST].T:
        for i in np.unique(rank):
            rows = np.flatnonzero(rank == i)
            inside = depth[i][rows] <= 0
            far = _distance(hulls[i].points[hulls[i].simplices], points[rows])
            signed = np.where(inside, depth[i][rows], far) - radius[i]
            nearest[rows] = np.where(signed < found[rows], i, nearest[rows])
            found[rows] = np.minimum(found[rows], signed)
    return found, nearest
