"""What other programs draw of a simulation: the wall, the tool and the contact, row by row."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea._errors import InputError
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.output.read import StoredSimulation
from jaxtrachea.output.solids import Triangles, nearest_vertices, rings_on, tool_triangles
from jaxtrachea.scene.stage import Poses


class NoSurface(InputError):
    """A simulation without a surface."""


class MovingTool(NamedTuple):
    """A tool, its way and its contact.

    Attributes:
        name: `tool` where there is but one.
        triangles: about its own origin, mm; None: presses at given points.
        rotation: of the tool.
        translation: of its origin, mm.
        nearest: vertex of the wall that is nearest to its contact point.
        at_contact: `force` (N), `s` (mm) and `phi` (rad).
    """

    name: str
    triangles: Triangles | None
    rotation: Float[np.ndarray, "rows 3 3"]
    translation: Float[np.ndarray, "rows 3"]
    nearest: Int[np.ndarray, " rows"]
    at_contact: dict[str, np.ndarray]


class Recording(NamedTuple):
    """A simulation as surfaces, mm.

    Attributes:
        times: of the rows, s, or their numbers from 0 where the path has no time.
        timed: whether they are times.
        rest: vertices of the wall at rest.
        faces: triangles of the wall.
        ring: whether a vertex lies on a ring.
        walls: vertices of the wall in each row; None: the row has no solution.
        tools: one or several.
    """

    times: Float[np.ndarray, " rows"]
    timed: bool
    rest: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    ring: Bool[np.ndarray, " vertices"]
    walls: list[Float[np.ndarray, "vertices 3"] | None]
    tools: list[MovingTool]


def recording_of(stored: StoredSimulation) -> Recording:
    """The surfaces of a simulation.

    Raises:
        NoSurface: it has no surface, or no row was solved.
    """
    series, rest = stored.simulation, stored.rest
    if rest is None or series.vertices is None:
        raise NoSurface("has no surface", cure="simulate with surface = true in [output]")
    moved = np.asarray(series.vertices, float)
    solved = [bool(np.isfinite(v).all()) for v in moved]
    if not any(solved):
        raise NoSurface("has no solved row", cure="see the status of its rows")
    rows, time = len(moved), series.time
    if isinstance(stored.path, Mapping):
        shapes = stored.tool if isinstance(stored.tool, Mapping) else {}
        tools = [
            _moving(name, shapes.get(name), path, stored, i)
            for i, (name, path) in enumerate(stored.path.items())
        ]
    else:
        assert not isinstance(stored.tool, Mapping)
        tools = [_moving("tool", stored.tool, stored.path, stored, None)]
    return Recording(
        times=np.arange(float(rows)) if time is None else np.asarray(time, float),
        timed=time is not None,
        rest=np.asarray(rest["vertices"], float),
        faces=np.asarray(rest["faces"]),
        ring=rings_on(rest["s"], rest["phi"], rest["distance"], stored.rings)[0],
        walls=[v if ok else None for v, ok in zip(moved, solved, strict=True)],
        tools=tools,
    )


def _moving(
    name: str, shape: Shape | None, path: Poses | None, stored: StoredSimulation, place: int | None
) -> MovingTool:
    """A tool; `place`: its number where the series have an axis of tools."""
    series, rest = stored.simulation, stored.rest
    assert rest is not None

    def own(field: str) -> np.ndarray:
        values = np.asarray(getattr(series, field), float)
        return values if place is None else values[:, place]

    rows, s, phi = len(own("s")), own("s"), own("phi")
    if path is None:
        rotation, translation = np.tile(np.eye(3), (rows, 1, 1)), np.zeros((rows, 3))
    else:  # a shorter path than that of another tool rests at its last row
        at = np.minimum(np.arange(rows), len(path.translation) - 1)
        rotation, translation = (np.asarray(v)[at] for v in (path.rotation, path.translation))
    return MovingTool(
        name=name,
        triangles=None if shape is None else tool_triangles(shape),
        rotation=rotation,
        translation=translation,
        nearest=nearest_vertices(s, phi, rest),
        at_contact={"force": own("force"), "s": s, "phi": phi},
    )
