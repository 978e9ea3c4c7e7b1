"""The packet of a scene and the frame of a step, from the records of the model."""

from typing import Any

import numpy as np

from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.scene.solids import rings_on, tool_triangles
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
    corners, sides = (np.zeros((0, 3)),) * 2 if tool is None else tool_triangles(tool)
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
