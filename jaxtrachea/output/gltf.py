"""A simulation as an animated GLB (glTF 2.0), which plays in viewers, and its last row as a mesh.

Format: Khronos glTF 2.0, ISO/IEC 12113:2022. The wall is a mesh with a morph target for each row,
each tool a node that moves. Lengths are in metres, as glTF wants; y is anterior and up.
The library of meshes writes both files too, but takes 0.5 s to load: a third of a quick command.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.files.atomic import write_whole
from jaxtrachea.output.recording import Recording
from jaxtrachea.trachea.mesh import vertex_normals

#: Rows at most: viewers hold a few hundred targets.
MAX_ROWS = 100
#: Rows a second where the path has no time.
ROWS_A_SECOND = 10.0
#: Colours of wall and rings, linear.
WALL, RING = (0.60, 0.17, 0.15), (0.86, 0.73, 0.62)
#: glTF's numbers of types and targets.
_FLOAT, _UNSIGNED, _VERTICES, _INDICES = 5126, 5125, 34962, 34963


class _Buffer:
    """Arrays one after the other, and what glTF says of each."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, target: int | None = None, *, bounds: bool = False) -> int:
        """Append an array; the number of its accessor."""
        whole = values.dtype.kind in "iu"
        values = np.ascontiguousarray(values, "<u4" if whole else "<f4")
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        self.data += values.tobytes()
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor = {
            "bufferView": len(self.views) - 1, "count": len(values), "type": kind,
            "componentType": _UNSIGNED if whole else _FLOAT,
        }  # fmt: skip
        if bounds:
            columns = values.reshape(len(values), -1)
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(path: Path, recording: Recording) -> None:
    """Write the animation; of more than `MAX_ROWS` solved rows, these many evenly.

    Colours show wall and rings; glTF moves no colours. Between two rows everything moves evenly.

    Raises:
        OSError: the file cannot be written.
    """
    solved = [i for i, wall in enumerate(recording.walls) if wall is not None]
    few = np.linspace(0, len(solved) - 1, min(len(solved), MAX_ROWS)).round().astype(int)
    rows = np.asarray(solved)[np.unique(few)]
    buffer = _Buffer()
    meshes = [{"name": "trachea", **_wall(buffer, recording, rows)}]
    nodes: list[dict[str, Any]] = [{"name": "trachea", "mesh": 0}]
    times = recording.times[rows] - recording.times[rows[0]]
    clock = buffer.add(times / (1 if recording.timed else ROWS_A_SECOND), bounds=True)
    moves = [(0, "weights", np.eye(len(rows)).ravel())]
    for tool in recording.tools:
        if tool.triangles is None:
            continue
        surface = _surface(buffer, *tool.triangles, material=1)
        meshes.append({"name": tool.name, "primitives": [surface]})
        turns, shifts = _quaternions(tool.rotation[rows]), tool.translation[rows] / 1e3
        nodes.append({"name": tool.name, "mesh": len(nodes), "rotation": turns[0].tolist(),
                      "translation": shifts[0].tolist()})  # fmt: skip
        number = len(nodes) - 1
        moves += [(number, "rotation", turns), (number, "translation", shifts)]
    samplers = [{"input": clock, "output": buffer.add(values)} for *_, values in moves]
    channels = [
        {"sampler": i, "target": {"node": node, "path": what}}
        for i, (node, what, _) in enumerate(moves)
    ]
    animation = {"name": "simulation", "samplers": samplers, "channels": channels}
    write_whole(path, _binary(buffer, nodes=nodes, meshes=meshes, animations=[animation]))


def write_meshes(folder: Path, faces: np.ndarray, vertices: np.ndarray) -> None:
    """A surface as deformed.ply (mm) and deformed.glb (m, as glTF wants).

    Args:
        folder: where to.
        faces: triangles of the wall, shape (faces, 3).
        vertices: of the wall, mm, shape (vertices, 3).

    Raises:
        OSError: a file cannot be written.
    """
    triangles = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    triangles["count"], triangles["corners"] = 3, faces
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    data = head.encode() + vertices.astype("<f4").tobytes() + triangles.tobytes()
    write_whole(folder / "deformed.ply", data)
    buffer = _Buffer()
    meshes = [{"name": "trachea", "primitives": [_surface(buffer, vertices, faces, material=0)]}]
    nodes = [{"name": "trachea", "mesh": 0}]
    write_whole(folder / "deformed.glb", _binary(buffer, nodes=nodes, meshes=meshes))


def _wall(buffer: _Buffer, recording: Recording, rows: np.ndarray) -> dict[str, Any]:
    """The mesh of the wall at rest, with its targets; the first row is shown at rest."""
    rest, faces = recording.rest / 1e3, recording.faces
    normals = _normals(rest, faces)
    color = np.where(recording.ring[:, None], RING, WALL)
    attributes = {
        "POSITION": buffer.add(rest, _VERTICES, bounds=True),
        "NORMAL": buffer.add(normals, _VERTICES), "COLOR_0": buffer.add(color, _VERTICES),
    }  # fmt: skip
    targets = []
    for row in rows:
        wall = np.asarray(recording.walls[row]) / 1e3
        moved = buffer.add(wall - rest, _VERTICES, bounds=True)
        turned = buffer.add(_normals(wall, faces) - normals, _VERTICES)
        targets.append({"POSITION": moved, "NORMAL": turned})
    primitive = {
        "attributes": attributes, "indices": buffer.add(faces.ravel(), _INDICES), "material": 0,
        "targets": targets,
    }  # fmt: skip
    return {"primitives": [primitive], "weights": [1.0] + [0.0] * (len(rows) - 1)}


def _surface(buffer: _Buffer, corners: np.ndarray, faces: np.ndarray, material: int) -> dict:
    """A mesh that keeps its shape."""
    attributes = {
        "POSITION": buffer.add(corners / 1e3, _VERTICES, bounds=True),
        "NORMAL": buffer.add(_normals(corners, faces), _VERTICES),
    }
    indices = buffer.add(faces.ravel(), _INDICES)
    return {"attributes": attributes, "indices": indices, "material": material}


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of the vertices; upwards where all triangles are degenerate: glTF wants unit normals."""
    normals = vertex_normals(vertices, faces)
    return np.where(normals.any(axis=1, keepdims=True), normals, [0.0, 1.0, 0.0])


def _quaternions(rotation: np.ndarray) -> np.ndarray:
    """x, y, z, w of each row, each on the side of the one before."""
    from scipy.spatial.transform import Rotation

    out = Rotation.from_matrix(rotation).as_quat()
    turns = np.sum(out[1:] * out[:-1], axis=1) < 0
    out[1:] *= np.where(np.cumsum(turns) % 2, -1, 1)[:, None]
    return out


def _materials() -> list[dict[str, Any]]:
    """White for what vertices colour, and the tool, which one sees through."""
    wall = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 0.7}
    tool = {"baseColorFactor": [0.35, 0.45, 0.6, 0.6], "metallicFactor": 0.2,
            "roughnessFactor": 0.4}  # fmt: skip
    return [
        {"name": "wall", "pbrMetallicRoughness": wall, "doubleSided": True},
        {"name": "tool", "pbrMetallicRoughness": tool, "alphaMode": "BLEND"},
    ]


def _binary(buffer: _Buffer, nodes: list, **parts: list) -> bytes:
    """Header, JSON and arrays, each to a multiple of four bytes."""
    data = bytes(buffer.data)
    document = {
        "asset": {"version": "2.0", "generator": "jaxtrachea"},
        "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes, **parts,
        "materials": _materials(), "accessors": buffer.accessors, "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
