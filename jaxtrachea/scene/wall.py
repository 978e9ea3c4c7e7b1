"""The outside of the tube as convex patches, for a tool to touch."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxtrachea.contact.patches import Patches, straight_patches
from jaxtrachea.contact.search import FINE, STANDARD, Settings
from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.contact.walls import TubeSurface, patches_of
from jaxtrachea.scene import wall_check
from jaxtrachea.scene.sizes import OUTER, RADIUS
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh

#: Patches of the tube searched for a contact with a tool shorter than one of them.
MIN_STATIONS = 2
#: Parts of a tool that are searched, at most: as many may touch within the smoothing of a contact.
TOUCHING = 4
#: Length of a tool over the radius of the tube from which on a contact takes more steps.
LONG = 8
#: Patches of a mesh: their rounding, and corners of each (docs/simulate.md says what that loses).
ROUNDED, CORNERS = 0.15, 128
#: Longest patch over the usual distance of the rings (at most the radius): beyond the last ring a
#: tube goes on, and one patch would bridge its bend.
LONGEST = 1.5
#: By how much the patches of a round wall run on beyond each border, and the distance of the
#: samples of a curved centreline: on Table 1's tube, mm.
OVERLAP, SPACING = 0.5, 1.0


def round_wall(geometry: Geometry, radius: float) -> Patches:
    """A straight cylinder, in patches about as long as it is wide: so their rounding is small."""
    length = float(geometry.length)
    borders = np.linspace(0, length, max(round(length / (2 * float(geometry.radius))), 1) + 1)
    overlap = OVERLAP * (radius / OUTER)
    return straight_patches(borders, radius, overlap=overlap, dtype=geometry.length.dtype)


def checked_walls(geometry: Geometry, mesh: Mesh, progress=None) -> Patches:
    """The wall of a mesh, checked against its triangles.

    Raises:
        MeshError: it is not where they are.
    """
    tube = patches_of_wall(geometry, mesh, progress)
    wall_check.check(mesh, geometry, tube)
    uncertain = wall_check.look_beyond(mesh, geometry, tube).uncertain
    return dataclasses.replace(tube, uncertain=jnp.asarray(uncertain)) if uncertain.any() else tube


def patches_of_wall(geometry: Geometry, mesh: Mesh, progress=None) -> Patches:
    """The surface of a mesh, cut midway between the rings: each patch bulges with its ring.

    Spans longer than `LONGEST` says are cut evenly.
    """
    numbers = (mesh.vertices, mesh.faces, mesh.s, mesh.phi, mesh.distance)
    vertices, faces, s, phi, distance = (np.asarray(v) for v in numbers)
    centres = frames = None
    if mesh.frames is not None:
        frames = np.asarray(mesh.frames)
        across = np.stack([distance * np.cos(phi), distance * np.sin(phi)], axis=1)
        centres = vertices - np.einsum("vij,vj->vi", frames[:, :, 1:], across)
    ring = np.asarray(geometry.ring_positions, float)
    ends = max(float(s.min()), 0.0), min(float(s.max()), float(geometry.length))
    between = (ring[1:] + ring[:-1]) / 2
    borders = np.array([ends[0], *between[(between > ends[0]) & (between < ends[1])], ends[1]])
    usual = wall_check.spacing_of(geometry)
    parts = np.ceil(np.diff(borders) / (LONGEST * usual) - 1e-4).astype(int)
    spans = zip(borders[:-1], borders[1:], np.maximum(parts, 1), strict=True)
    borders = np.concatenate([*(np.linspace(a, b, n + 1)[:-1] for a, b, n in spans), borders[-1:]])
    surface = TubeSurface(vertices=vertices, faces=faces, s=s, centres=centres, frames=frames)
    spacing = SPACING * (float(geometry.radius) / RADIUS)
    return patches_of(
        surface, borders, rounding=ROUNDED, most=CORNERS,
        overlap=wall_check.overlap_of(geometry), spacing=spacing,
        dtype=geometry.length.dtype, progress=progress,
    )  # fmt: skip


def near_patches(tool: Shape, geometry: Geometry, count: int) -> int:
    """As many patches as the tool can lie along, and one more; of all parts that touch at once."""
    along = sorted(
        min(MIN_STATIONS + int(_longest(part) * count / float(geometry.length)), count)
        for part in parts_of(tool)
    )
    return sum(along[-TOUCHING:])


def contact_settings(tool: Shape, geometry: Geometry) -> Settings:
    """Work of the search for a contact: more steps for a long tool, whose ends leave it less room.

    Of 120 shafts of 300 and 980 mm on a round wall 44 were not converged after 10 steps, none after
    16.
    """
    long = max(map(_longest, parts_of(tool))) > LONG * float(geometry.radius)
    return dataclasses.replace(STANDARD, warm_steps=FINE.warm_steps) if long else STANDARD


def _longest(part: Shape) -> float:
    """Length of a convex body along one of its axes, mm."""
    return float(np.ptp(np.asarray(part.vertices), axis=1).max()) + 2 * float(part.radius)
