"""What other programs draw of a simulation: the wall, the tool and the contact, row by row."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea._errors import InputError
from jaxtrachea.scene.read import StoredSimulation
from jaxtrachea.scene.solids import Triangles, rings_on, tool_triangles


class NoSurface(InputError):
    """A simulation without a surface."""


class Recording(NamedTuple):
    """A simulation as surfaces, mm.

    Attributes:
        times: of the rows, s, or their numbers from 0 where the path has no time.
        timed: whether they are times.
        rest: vertices of the wall at rest.
        faces: triangles of the wall.
        ring: whether a vertex lies on a ring.
        walls: vertices of the wall in each row; None: the row has no solution.
        nearest: vertex of the wall that is nearest to the contact point of each row.
        at_contact: `force` (N), `s` (mm) and `phi` (rad) of each row.
        tool: its triangles about its own origin; None: presses at given points.
        rotation: of the tool.
        translation: of the tool's origin.
    """

    times: Float[np.ndarray, " rows"]
    timed: bool
    rest: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    ring: Bool[np.ndarray, " vertices"]
    walls: list[Float[np.ndarray, "vertices 3"] | None]
    nearest: Int[np.ndarray, " rows"]
    at_contact: dict[str, np.ndarray]
    tool: Triangles | None
    rotation: Float[np.ndarray, "rows 3 3"]
    translation: Float[np.ndarray, "rows 3"]

    def contact(self, row: int) -> Float[np.ndarray, "3"]:
        """The deformed wall at the contact point of a solved row."""
        wall = self.walls[row]
        assert wall is not None
        return wall[self.nearest[row]]


def recording_of(stored: StoredSimulation) -> Recording:
    """The surfaces of a simulation.

    Args:
        stored: as `read_simulation` gives it.

    Raises:
        NoSurface: it has no surface, or no row was solved.
    """
    series, rest, path = stored.simulation, stored.rest, stored.path
    if rest is None or series.vertices is None:
        raise NoSurface("has no surface", cure="simulate with surface = true in [output]")
    moved = np.asarray(series.vertices, float)
    solved = [bool(np.isfinite(v).all()) for v in moved]
    if not any(solved):
        raise NoSurface("has no solved row", cure="see the status of its rows")
    rows, time = len(moved), series.time
    turn = np.asarray(rest["phi"] - np.asarray(series.phi)[:, None] + np.pi) % (2 * np.pi) - np.pi
    away = np.hypot(rest["s"] - np.asarray(series.s)[:, None], rest["distance"] * turn)
    placed = path is not None
    return Recording(
        times=np.arange(float(rows)) if time is None else np.asarray(time, float),
        timed=time is not None,
        rest=np.asarray(rest["vertices"], float),
        faces=np.asarray(rest["faces"]),
        ring=rings_on(rest["s"], rest["phi"], rest["distance"], stored.rings)[0],
        walls=[v if ok else None for v, ok in zip(moved, solved, strict=True)],
        nearest=np.nan_to_num(away, nan=np.inf).argmin(axis=1),
        at_contact={n: np.asarray(getattr(series, n), float) for n in ("force", "s", "phi")},
        tool=None if stored.tool is None else tool_triangles(stored.tool),
        rotation=np.asarray(path.rotation) if placed else np.tile(np.eye(3), (rows, 1, 1)),
        translation=np.asarray(path.translation) if placed else np.zeros((rows, 3)),
    )
