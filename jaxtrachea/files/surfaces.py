"""Triangles as PLY and GLB, without the half second that a library for meshes takes to load."""

import json
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

#: Of glTF 2.0: kinds of numbers, what a part of the buffer is for, and kinds of chunks.
_FLOAT, _UNSIGNED, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def write_ply(
    path: Path, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> None:
    """A binary PLY, in single precision.

    Args:
        path: of the file.
        vertices: in any unit; the file has none.
        faces: their rows.
    """
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), [("count", "u1"), ("rows", "<i4", 3)])
    rows["count"], rows["rows"] = 3, faces
    path.write_bytes(head.encode() + np.asarray(vertices, "<f4").tobytes() + rows.tobytes())


def write_glb(
    path: Path, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> None:
    """A binary glTF 2.0 of one mesh, in single precision.

    Args:
        path: of the file.
        vertices: m, as the format wants.
        faces: their rows.
    """
    points, rows = np.asarray(vertices, "<f4"), np.asarray(faces, "<u4")
    ends = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    views = [
        {"byteOffset": 0, "byteLength": rows.nbytes, "target": _INDICES},
        {"byteOffset": rows.nbytes, "byteLength": points.nbytes, "target": _VERTICES},
    ]
    described = {
        "asset": {"version": "2.0", "generator": "jaxtrachea"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": _UNSIGNED, "count": rows.size, "type": "SCALAR"},
            {"bufferView": 1, "componentType": _FLOAT, "count": len(points), "type": "VEC3"} | ends,
        ],
        "bufferViews": [{"buffer": 0} | view for view in views],
        "buffers": [{"byteLength": rows.nbytes + points.nbytes}],
    }
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    numbers = rows.tobytes() + points.tobytes()  # whole words both
    chunks = [
        struct.pack("<II", len(content), kind) + content
        for content, kind in ((text, _JSON), (numbers, _BINARY))
    ]
    body = b"".join(chunks)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
