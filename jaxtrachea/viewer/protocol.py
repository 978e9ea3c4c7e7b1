"""The packet of a scene and the frame of a step, from the records of the model."""

from typing import Any

import numpy as np

from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.scene.solids import rings_on
from jaxtrachea.scene.stage import Scene
from jaxtrachea.status import PressStatus
from jaxtrachea.viewer.frame import Frame, packet, statuses


def frame_of(tool: Shape | None, pose: np.ndarray, result: Any, seconds: float) -> Frame:
    """A step as it is shown; without positions where a number of it is not finite.

    Args:
        tool: about its origin; None: the pose is that of the contact.
        pose: see `Frame`.
        result: one row of a `Simulation`, or what has its fields.
        seconds: that the step took.
    """
    status = PressStatus(int(result.status))
    turn = np.eye(3) if result.frame is None else np.asarray(result.frame, float)
    force = turn @ np.asarray(result.force, float)
    phi = float(result.phi)
    inward = -np.array([0.0, np.cos(phi), np.sin(phi)])
    way = inward @ np.asarray(result.displacement, float) if result.gap is None else -result.gap
    depth, inward = max(float(way), 0.0), turn @ inward
    vertices = np.asarray(result.vertices, np.float32)
    numbers = (force, depth, inward, vertices)
    if not status.solved or not all(np.isfinite(v).all() for v in numbers):
        return Frame(status, pose, np.zeros(3), 0.0, np.zeros(3), seconds, None)
    turned = pose[:9].reshape(3, 3)
    point = pose[9:] + (0 if tool is None else foremost(tool, turned, inward))
    return Frame(status, pose, force, depth, point, seconds, vertices)


def foremost(tool: Shape, rotation: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The point of a turned tool that lies farthest along a unit vector, from its origin, mm."""
    tips = np.concatenate([
        (rotation @ np.asarray(part.vertices, float)).T + float(part.radius) * direction
        for part in parts_of(tool)
    ])  # fmt: skip
    along = tips @ direction
    return tips[along > along.max() - 1e-3].mean(axis=0)


def tube_arrays(
    vertices, faces, ring: np.ndarray, midline: np.ndarray, tool: Shape | None
) -> dict[str, np.ndarray]:
    """Arrays of a packet: the wall at rest and the surface of the tool.

    Args:
        vertices: at rest, mm; shape (vertices, 3).
        faces: of the wall; shape (faces, 3).
        ring: vertices on a ring; bool, shape (vertices,).
        midline: of each ring, the vertex on the anterior midline.
        tool: about its origin; None: there is none.
    """
    corners, sides = (np.zeros((0, 3)),) * 2 if tool is None else tool_surface(tool)
    return {
        "rest": np.asarray(vertices, np.float32), "faces": np.asarray(faces, np.uint32),
        "joints": midline.astype(np.uint32), "tool": corners.astype(np.float32),
        "sides": sides.astype(np.uint32), "ring": ring.astype(np.uint8),
    }  # fmt: skip


def scene_packet(scene: Scene, title: str, pose: np.ndarray) -> bytes:
    """What a page must know of a scene before the first frame."""
    arrays = tube_arrays(*tube_of(scene), scene.tool)
    return packet({"title": title, "pose": pose.tolist(), "statuses": statuses()}, arrays)


def tube_of(scene: Scene) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """Vertices, faces, and `rings_on` of the wall of a scene."""
    mesh, tube = scene.mesh, scene.geometry
    assert mesh is not None
    rings = {"position": tube.ring_positions, "height": tube.ring_height,
             "half_angle": tube.half_angle}  # fmt: skip
    where = rings_on(mesh.s, mesh.phi, mesh.distance, rings)
    return mesh.vertices, mesh.faces, *where


def tool_surface(tool: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a tool with its rounding: corners, mm, and three of them for each side."""
    corners, sides = zip(*map(_surface, parts_of(tool)), strict=True)
    shift = np.cumsum([0, *map(len, corners[:-1])])
    moved = [of + at for of, at in zip(sides, shift, strict=True)]
    return np.concatenate(corners), np.concatenate(moved)


def _surface(tool: Shape) -> tuple[np.ndarray, np.ndarray]:
    """`tool_surface` of one convex body."""
    from scipy.spatial import ConvexHull, QhullError

    cores, radius = np.asarray(tool.vertices, float).T, float(tool.radius)
    points = (cores[:, None] + radius * _directions()).reshape(-1, 3) if radius > 0 else cores
    try:
        found = ConvexHull(points)
    except (QhullError, ValueError):  # flat, or too few corners: as thin as it can be seen
        found = ConvexHull((cores[:, None] + 0.05 * _directions()).reshape(-1, 3))
    corners, sides = found.points, found.simplices.copy()
    a, b, c = (corners[sides[:, i]] for i in range(3))
    inside_out = np.sum(np.cross(b - a, c - a) * found.equations[:, :3], axis=1) < 0
    sides[inside_out] = sides[inside_out][:, ::-1]
    used, numbers = np.unique(sides, return_inverse=True)
    return corners[used], numbers.reshape(sides.shape)


def _directions() -> np.ndarray:
    """Unit vectors spread evenly over a sphere; shape (600, 3).

    Fibonacci's lattice, and both poles of each axis, so that a tool is as wide as it is.
    """
    i = np.arange(594) + 0.5
    z, turn = 1 - 2 * i / 594, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    lattice = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    return np.concatenate([lattice, np.eye(3), -np.eye(3)])
