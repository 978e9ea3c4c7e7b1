"""A C-ringed trachea made from a `Geometry`: the outer surface, closed by a lid at each end."""

import math

import jax
import numpy as np

from jaxtrachea._arguments import check_word
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh, vertex_normals

#: Wall of Table 1, and how far a ring stands out of it, mm; of another wall the same share.
WALL, RELIEF = 2.6, 0.6


def make_tube(
    geometry: Geometry,
    *,
    around: int = 35,
    along: int = 97,
    wall: float = WALL,
    relief: float | None = None,
    flatten: float = 0.15,
    lids: bool = True,
) -> Mesh:
    """The outer surface of a straight trachea with rings that stand out and a flatter back.

    A grid of `around` x `along` quadrilaterals, each cut in two, and two lids of `around` - 2
    triangles: the defaults make 3,430 vertices and the paper's 6,856 triangles, watertight.
    Of the rows, the one nearest to each ring stands on its crest, and those between are evenly
    spaced from crest to crest. Where rows are too few for that (two rings nearest to one row, or a
    ring nearest to an end) all rows are evenly spaced, and crests lie lower than asked for.
    Between the rings the radius is `geometry.radius` + `wall` / 2 - `relief`; a ring adds
    `relief` cos^2 over its height and fades out towards its ends.

    Args:
        geometry: length, rings, radius of the ring line, half-angle and ring height.
        around: vertices round the tube, at least 3.
        along: rows of quadrilaterals, at least 1. To be seen, a ring needs about two of them.
        wall: thickness, mm; table 1: 2.6.
        relief: how far a ring stands out, mm; 0: smooth; None: the share of the wall that is 0.6 mm
            of table 1's.
        flatten: by what part of the radius the posterior midline is drawn in; 0: round.
        lids: whether to close the ends; without, a tube open at both ends.

    Raises:
        ValueError: naming the argument.
    """
    check_word("geometry", geometry, Geometry)
    check_word("around", around, int)
    check_word("along", along, int)
    check_word("wall", wall, float)
    check_word("relief", relief, float | None)
    length, radius, alpha = (
        float(v) for v in (geometry.length, geometry.radius, geometry.half_angle)
    )
    relief = RELIEF * (wall / WALL) if relief is None else relief
    outer = radius + wall / 2 - relief
    if around < 3 or along < 1:
        raise ValueError(f"around, along are {around}, {along}; expected at least 3 and 1")
    if not (wall >= 0 and relief >= 0 and outer > 0):
        raise ValueError(
            f"wall {wall:g} mm and relief {relief:g} mm leave a radius of {outer:g} mm; "
            "expected both not negative and a positive radius"
        )
    if wall > radius:
        raise ValueError(
            f"wall is {wall:g} mm, thicker than the radius of {radius:g} mm; expected a thinner "
            "one; check the units of both"
        )
    if not 0 <= flatten < 1:
        raise ValueError(f"flatten is {flatten:g}; expected a number in [0, 1)")
    s = np.repeat(_rows(geometry, length, along), around)
    turn = 2 * math.pi * np.arange(around) / around
    phi = np.tile(np.where(turn > math.pi, turn - 2 * math.pi, turn), along + 1)
    distance = (outer + relief * _rings(geometry, s, phi)) * (1 - flatten * _back(phi, alpha))
    vertices = np.stack([s, distance * np.cos(phi), distance * np.sin(phi)], axis=1)
    faces = _grid(around, along)
    if lids:
        lid = _lid(around)
        faces = np.concatenate([faces, lid[:, ::-1], lid + along * around])
    dtype = geometry.length.dtype
    floats = (vertices, vertex_normals(vertices, faces), s, phi, distance)
    # Put on the device as they are: `jnp.asarray` would compile a conversion for every shape.
    vertices, normals, s, phi, distance = (jax.device_put(np.asarray(v, dtype)) for v in floats)
    return Mesh(vertices, jax.device_put(faces.astype(np.int32)), normals, s, phi, distance)


def _rows(geometry: Geometry, length, along):
    """Rows along the tube: even, but with one on the crest of each ring where they are near enough.

    Else the crest of a coarse mesh lies as far below the ring's as the rows happen to stand.
    """
    even = np.linspace(0, length, along + 1)
    rings = np.asarray(geometry.ring_positions, float)
    near = np.rint(rings * along / length)
    if near[0] < 1 or near[-1] > along - 1 or np.any(np.diff(near) < 1):
        return even  # more rings than rows
    at = np.concatenate([[0], near, [along]])
    return np.interp(np.arange(along + 1), at, np.concatenate([[0], rings, [length]]))


def _rings(geometry: Geometry, s, phi):
    """1 on the crest of a ring, 0 away from the rings and behind their ends."""
    off = np.abs(s[:, None] - np.asarray(geometry.ring_positions, float)).min(axis=1)
    alpha, fade = float(geometry.half_angle), 0.2
    across = np.clip((alpha - np.abs(phi)) / fade, 0, 1)
    crest = np.cos(math.pi * np.clip(off / float(geometry.ring_height), 0, 0.5)) ** 2
    return crest * across**2 * (3 - 2 * across)


def _back(phi, alpha):
    """0 on the arc of the rings, 1 on the posterior midline, level at both."""
    return np.sin(math.pi / 2 * np.clip((np.abs(phi) - alpha) / (math.pi - alpha), 0, 1)) ** 2


def _grid(around, along):
    """Two triangles for each quadrilateral, outward for y, z counter-clockwise about x."""
    row, column = np.divmod(np.arange(around * along), around)
    a, b = row * around + column, row * around + (column + 1) % around
    c, d = a + around, b + around
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def _lid(around):
    """The polygon 0 .. around - 1 cut in a zigzag, which leaves no needles."""
    order = np.arange(around)
    zigzag = np.where(order % 2 == 0, order // 2, around - 1 - order // 2)
    faces = np.stack([zigzag[:-2], zigzag[1:-1], zigzag[2:]], axis=1)
    faces[0::2] = faces[0::2][:, [0, 2, 1]]
    return faces
