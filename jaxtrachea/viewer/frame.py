"""Bytes between the model and the page: one packet for the scene, one frame for every step.

Packet: length of a JSON text (uint32), the text, then the arrays that its `arrays` names, each from
a multiple of four bytes on. Frame: its head (float32, `Frame.head`), then the positions of all
vertices (float32, mm); no positions where the step has no solution. No number of either is NaN.
"""

import json
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.status import PressStatus

#: Of tools, one after the other.
COLOURS = ["#d0703a", "#3a7ca5", "#8a5a9e", "#6b7f3a"]
#: Largest coordinate of a tool that is taken from a page, mm.
FARTHEST = 1e4
#: Longest message that a page may send, bytes.
LONGEST = 4096


class Touch(NamedTuple):
    """One tool in a step.

    Attributes:
        status: of its contact.
        pose: rotation by rows, then the translation, mm; shape (12,).
        force: on the tube in the frame of the mesh, N; shape (3,). Zeros: no solution.
        depth: of the tool below the wall at rest, mm, not negative.
        point: of the contact on the tool, mm; shape (3,).
    """

    status: PressStatus
    pose: Float[np.ndarray, "12"]
    force: Float[np.ndarray, "3"]
    depth: float
    point: Float[np.ndarray, "3"]


class Frame(NamedTuple):
    """What one step shows.

    Attributes:
        touches: of every tool, in the order of the scene.
        seconds: that the step took.
        vertices: of the wall, mm, float32; shape (vertices, 3). None: no solution.
        time: since the scene was ready, s.
    """

    touches: tuple[Touch, ...]
    seconds: float
    vertices: np.ndarray | None
    time: float = 0.0

    def has_force(self, tool: int) -> bool:
        """Whether there is a force of this tool: the step is solved, and the tool touches."""
        return self.vertices is not None and has_force(self.touches[tool].status)

    @property
    def light(self) -> "Frame":
        """The same without its vertices, for long lists."""
        return self._replace(vertices=None if self.vertices is None else self.vertices[:0])

    def pack(self) -> bytes:
        """As bytes; see the module."""
        vertices = b"" if self.vertices is None else np.ascontiguousarray(self.vertices).tobytes()
        return self.head.tobytes() + vertices

    @property
    def head(self) -> np.ndarray:
        """Vertices, milliseconds; of every tool status, force (3), depth, point (3); float32."""
        values = [0 if self.vertices is None else len(self.vertices), 1e3 * self.seconds]
        for touch in self.touches:
            values += [touch.status, *touch.force, touch.depth, *touch.point]
        return np.array(values, np.float32)


def has_force(status: PressStatus) -> bool:
    """Whether a solved step with this status has a force to show."""
    return status.solved and status != PressStatus.NO_CONTACT


def packet(text: dict, arrays: dict[str, np.ndarray]) -> bytes:
    """A text and named arrays as bytes; see the module."""
    parts, listed, start = [], [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        listed.append([name, array.dtype.name, start, array.size])
        parts.append(data.ljust(-(-len(data) // 4) * 4, b"\0"))
        start += len(parts[-1])
    head = json.dumps(text | {"arrays": listed}, allow_nan=False).encode()
    head = head.ljust(-(-len(head) // 4) * 4)
    return np.uint32(len(head)).tobytes() + head + b"".join(parts)


def statuses() -> dict[int, list]:
    """Of each status its name, its sentence, and whether there is a force."""
    return {int(s): [s.name, s.message, has_force(s)] for s in PressStatus}


def read_pose(text: str, tools: int) -> tuple[int, np.ndarray] | None:
    """A tool and its pose, `{"tool": 0, "pose": [12 numbers]}`; None: a frame is acknowledged.

    Raises:
        ValueError: any other text, no such tool, numbers that are too large or not finite, or no
            rotation.
    """
    if len(text) > LONGEST:
        raise ValueError("too long")
    message = json.loads(text)
    if message == "drawn":
        return None
    if not isinstance(message, dict) or set(message) != {"tool", "pose"}:
        raise ValueError("neither a pose nor an acknowledgement")
    tool, numbers = message["tool"], message["pose"]
    if type(tool) is not int or not 0 <= tool < tools:
        raise ValueError("no such tool")
    kinds = isinstance(numbers, list) and all(type(v) in (int, float) for v in numbers)
    if not kinds or len(numbers) != 12:
        raise ValueError("expected 12 numbers")
    pose = np.array(numbers, float)
    if not np.isfinite(pose).all() or abs(pose).max() > FARTHEST:
        raise ValueError("a number is too large or not finite")
    turn = pose[:9].reshape(3, 3)
    if abs(turn @ turn.T - np.eye(3)).max() > 1e-9 or np.linalg.det(turn) < 0:
        raise ValueError("no rotation")
    return tool, pose
