"""The packet of a scene and the frame of a step, from the records of the model."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.output.solids import rings_on, tool_triangles
from jaxtrachea.scene.stage import Scene
from jaxtrachea.status import PressStatus
from jaxtrachea.viewer.frame import COLOURS, Frame, Touch, packet, statuses


def frame_of(
    tools: Sequence[Shape | None], poses: np.ndarray, result: Any, seconds: float
) -> Frame:
    """A step as it is shown; without positions where a number of it is not finite.

    Args:
        tools: about their origins; None: the pose is that of the contact.
        poses: of the tools, see `Touch`; shape (tools, 12).
        result: one row of a `Simulation`, or what has its fields: of one tool, or with an axis of
            tools.
        seconds: that the step took.
    """
    rows = range(len(tools)) if np.ndim(result.status) else [...]
    touches = [_touch(*one, result) for one in zip(tools, poses, rows, strict=True)]
    vertices = np.asarray(result.vertices, np.float32)
    numbers = [vertices, *(v for t in touches for v in (t.force, t.depth, t.point))]
    if all(t.status.solved for t in touches) and all(np.isfinite(v).all() for v in numbers):
        return Frame(tuple(touches), seconds, vertices)
    none = {"force": np.zeros(3), "depth": 0.0, "point": np.zeros(3)}
    return Frame(tuple(t._replace(**none) for t in touches), seconds, None)


def _touch(tool: Shape | None, pose: np.ndarray, row: Any, result: Any) -> Touch:
    """One tool of a step, a row of its axis of tools (... where it has none); may hold NaN."""
    turn = np.eye(3) if result.frame is None else np.asarray(result.frame, float)[row]
    phi = float(result.phi[row])
    inward = -np.array([0.0, np.cos(phi), np.sin(phi)])
    moved = np.asarray(result.displacement, float)[row]
    way = inward @ moved if result.gap is None else -float(result.gap[row])
    inward = turn @ inward
    point = pose[9:] + (0 if tool is None else foremost(tool, pose[:9].reshape(3, 3), inward))
    force = turn @ np.asarray(result.force, float)[row]
    status = PressStatus(int(result.status[row]))
    return Touch(status, pose, force, float(np.maximum(way, 0.0)), point)


def foremost(tool: Shape, rotation: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The point of a turned tool that lies farthest along a unit vector, from its origin, mm."""
    tips = np.concatenate([
        (rotation @ np.asarray(part.vertices, float)).T + float(part.radius) * direction
        for part in parts_of(tool)
    ])  # fmt: skip
    along = tips @ direction
    if not np.isfinite(direction).all():
        return np.full(3, np.nan)
    return tips[along > along.max() - 1e-3].mean(axis=0)


def tube_arrays(vertices, faces, ring: np.ndarray, midline: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of a packet: the wall at rest.

    Args:
        vertices: at rest, mm; shape (vertices, 3).
        faces: of the wall; shape (faces, 3).
        ring: vertices on a ring; bool, shape (vertices,).
        midline: of each ring, the vertex on the anterior midline.
    """
    return {
        "rest": np.asarray(vertices, np.float32), "faces": np.asarray(faces, np.uint32),
        "joints": midline.astype(np.uint32), "ring": ring.astype(np.uint8),
    }  # fmt: skip


def tools_packet(
    title: str, names: Sequence[str], tools: Sequence[Shape | None], poses: np.ndarray,
    arrays: dict[str, np.ndarray], **more: Any,
) -> bytes:  # fmt: skip
    """What a page must know before the first frame: the wall, the tools and where they are.

    Args:
        names: of the tools.
        tools: about their origins; None: there is none to see.
        poses: of the tools; shape (tools, 12).
        arrays: from `tube_arrays`, and what else the page reads.
        more: likewise, what JSON can hold.
    """
    for k, tool in enumerate(tools):
        corners, sides = (np.zeros((0, 3)),) * 2 if tool is None else tool_triangles(tool)
        arrays = arrays | {f"tool{k}": corners.astype(np.float32),
                           f"sides{k}": sides.astype(np.uint32)}  # fmt: skip
    text = {"title": title, "tools": list(names), "colours": COLOURS, "poses": poses.tolist(),
            "statuses": statuses()}  # fmt: skip
    return packet(text | more, arrays)


def tube_of(scene: Scene) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """Vertices, faces, and `rings_on` of the wall of a scene."""
    mesh, tube = scene.mesh, scene.geometry
    assert mesh is not None
    rings = {"position": tube.ring_positions, "height": tube.ring_height,
             "half_angle": tube.half_angle}  # fmt: skip
    where = rings_on(mesh.s, mesh.phi, mesh.distance, rings)
    return mesh.vertices, mesh.faces, *where
