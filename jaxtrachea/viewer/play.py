"""A recording as one page that plays by itself: no server, nothing from outside."""

import base64
import hashlib
import html
import importlib.metadata
import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.output.read import SimulationFileError, read_simulation
from jaxtrachea.output.recording import MovingTool, NoSurface, recording_of
from jaxtrachea.output.solids import rings_on
from jaxtrachea.viewer.frame import Frame
from jaxtrachea.viewer.protocol import frame_of, tools_packet, tube_arrays, tube_of
from jaxtrachea.viewer.scene import Handled

HERE = Path(__file__).parent
#: Bytes of displacements in a page at most; of a longer recording some rows are left out, evenly.
MOST_BYTES = 2**26
#: Series of a simulation that a page shows.
SHOWN = ("status", "frame", "force", "gap", "phi", "vertices", "displacement")
#: Largest number of an int16.
TOP = 32767


class PlayError(InputError):
    """A recording that cannot be played, and why."""


def of_frames(handled: Handled, frames: Sequence[Frame]) -> str:
    """The page of frames that were recorded.

    Args:
        handled: the scene that they are of.
        frames: in order; those without vertices are shown by their status.

    Raises:
        PlayError: no frame has vertices, or three.js is not installed.
    """
    arrays = tube_arrays(*tube_of(handled.staged.scene))
    return _page(handled.title, handled.names, handled.tools, arrays, frames)


def of_file(path: Path, title: str = "") -> str:
    """The page of a `simulation.h5`.

    Args:
        title: of the page; empty: the name of the file.

    Raises:
        PlayError: no such file, none of a simulation, one of another version, or without a surface.
    """
    try:
        stored = read_simulation(path)
    except SimulationFileError as error:
        raise PlayError.like(error) from None
    try:
        recorded = recording_of(stored)
    except NoSurface as error:
        raise PlayError.like(error, place=str(path)) from None
    series, rest = stored.simulation, stored.rest
    assert rest is not None
    shapes = stored.tool if isinstance(stored.tool, dict) else {"tool": stored.tool}
    tools = [shapes.get(moving.name) for moving in recorded.tools]
    poses = np.stack([_poses(moving, series.vertices) for moving in recorded.tools], axis=1)
    frames = []
    for i, pose in enumerate(poses):
        given = {name: getattr(series, name) for name in SHOWN}
        row = {name: None if v is None else v[i] for name, v in given.items()}
        frames.append(frame_of(tools, pose, SimpleNamespace(**row), 0.0))
    where = rings_on(rest["s"], rest["phi"], rest["distance"], stored.rings)
    arrays = tube_arrays(rest["vertices"], rest["faces"], *where)
    names = [moving.name for moving in recorded.tools]
    return _page(title or path.stem, names, tools, arrays, frames, place=str(path))


def _poses(moving: MovingTool, walls: Any) -> np.ndarray:
    """Of one tool in every row, see `Touch`; one that cannot be seen is at its contact."""
    turn, place = moving.rotation, moving.translation
    if moving.triangles is None:
        turn = np.broadcast_to(np.eye(3), turn.shape)
        place = np.asarray(walls)[range(len(turn)), moving.nearest]
    return np.nan_to_num(np.concatenate([turn.reshape(-1, 9), place], axis=1))


def _page(
    title: str, names: Sequence[str], tools: Sequence[Shape | None], arrays: dict[str, np.ndarray],
    frames: Sequence[Frame], place: str = "",
) -> str:  # fmt: skip
    rest = arrays["rest"]
    solved = [f for f in frames if f.vertices is not None]
    if not solved:
        raise PlayError("no row has a surface: nothing to play", place=place)
    most = max(MOST_BYTES // (6 * len(rest)), 2)
    rows = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), most)).round().astype(int))
    kept = [frames[i] for i in rows]
    moves = np.stack([0 * rest if f.vertices is None else f.vertices - rest for f in kept])
    step = float(abs(moves).max()) / TOP or 1.0
    arrays = arrays | {
        "heads": np.stack([f.head for f in kept]),
        "poses": np.stack([[t.pose for t in f.touches] for f in kept]).astype(np.float32),
        "moves": np.round(moves / step).astype(np.int16),
    }
    first = np.stack([t.pose for t in kept[0].touches])
    more = {"step": step, "rows": (rows + 1).tolist(), "of": len(frames)}
    return _html(title, tools_packet(title, names, tools, first, arrays, **more))


def _html(title: str, data: bytes) -> str:
    three, notice = three_js()
    imports = {"three-bundle": _address(three), "core": _address((HERE / "core.js").read_bytes())}
    script = (HERE / "play.js").read_text()
    modules = json.dumps({"imports": imports})
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in (modules, script)
    )
    policy = (
        f"default-src 'none'; script-src {hashes} data:; style-src 'unsafe-inline'; "
        "img-src data: blob:; media-src blob:"
    )
    fields = {
        "@POLICY@": policy, "@TITLE@": html.escape(title), "@NOTICE@": notice.replace("--", "- -"),
        "@PACKET@": base64.b64encode(data).decode(), "@MAP@": modules, "@SCRIPT@": script,
    }  # fmt: skip
    page = (HERE / "play.html.in").read_text()
    for name, value in fields.items():
        page = page.replace(name, value, 1)
    return page


def _address(script: bytes) -> str:
    return f"data:text/javascript;base64,{base64.b64encode(script).decode()}"


def three_js() -> tuple[bytes, str]:
    """three.js as the extra `viewer` brings it, and its notice.

    Raises:
        PlayError: the extra is not installed.
    """
    found = importlib.util.find_spec("nicegui")
    if found is None or not found.submodule_search_locations:
        raise PlayError(
            "play.html needs the extra 'viewer'", cure="pip install 'jaxtrachea[viewer]'"
        )
    folder = Path(found.submodule_search_locations[0])
    script = (folder / "elements" / "scene" / "dist" / "index.js").read_bytes()
    begin = script[: script.index(b"*/")].decode()
    own = " ".join(line.strip(" */") for line in begin.splitlines() if "opyright" in line)
    files = importlib.metadata.files("nicegui") or []
    terms = next((f.read_text() for f in files if f.name == "LICENSE"), "MIT")
    return script, f"This page holds three.js. {own}.\nAs bundled by NiceGUI:\n\n{terms}"
