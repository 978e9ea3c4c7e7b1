"""A simulation read back from its simulation.h5."""

import json
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.output.results import SCHEMA, SCHEMA_VERSION
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Poses


class SimulationFileError(InputError):
    """A file that is no simulation of this version; the message names the cure."""


class StoredSimulation(NamedTuple):
    """What a simulation.h5 holds; arrays are NumPy's, those of `tool` and `path` JAX's.

    Attributes:
        simulation: the series; None: not asked for, or not modelled.
        units: of every series, by its name.
        plan: a row of each effect: its name, level, `forced` or `auto`, share of the operations
            ("": not computed) and reason.
        provenance: versions, digests of the inputs and times, as in provenance.json.
        tool: its shape about its own origin, mm; None: presses at given points. Of several tools
            by name, in the order of the series' axis of tools.
        path: positions of the tool, or of each; None: presses at given points.
        material: values by name, in the units of docs/reference.md.
        rings: position, height and radius, mm, and half_angle, rad.
        rest: vertices, faces, s, phi and distance of the surface at rest, mm and rad; None: the
            scene has no surface.
    """

    simulation: Simulation
    units: dict[str, str]
    plan: list[list[str]]
    provenance: dict
    tool: Shape | dict[str, Shape | None] | None
    path: Poses | dict[str, Poses | None] | None
    material: dict[str, np.ndarray]
    rings: dict[str, np.ndarray]
    rest: dict[str, np.ndarray] | None


def read_simulation(path: Path | str) -> StoredSimulation:
    """Read a simulation, bit for bit, in the dtypes of the file.

    Args:
        path: of a simulation.h5, or the folder that `jaxtrachea simulate` wrote it into.

    Raises:
        SimulationFileError: no such file, a damaged one, one of another kind or version.
    """
    import h5py

    path = Path(path)
    path = path / "simulation.h5" if path.is_dir() else path
    place, cure = str(path), "name a simulation.h5"
    try:
        file = h5py.File(path, "r")
    except OSError:
        found = "no HDF5 file" if path.is_file() else "no such file"
        raise SimulationFileError(found, place=place, cure=cure) from None
    with file:
        if file.attrs.get("schema") != SCHEMA:
            raise SimulationFileError("not a simulation", place=place, cure=cure)
        version = file.attrs.get("schema_version")
        if version != SCHEMA_VERSION:
            raise SimulationFileError(
                f"is of version {version}", place=place, expected=str(SCHEMA_VERSION),
                cure="simulate the scene again with this version of jaxtrachea",
            )  # fmt: skip
        try:
            return _read(file)
        except (KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
            raise SimulationFileError(
                f"damaged or not written by this program ({error})",
                place=place, cure="simulate the scene again",
            ) from None  # fmt: skip


def _read(file) -> StoredSimulation:
    groups = {
        name: {key: np.asarray(data) for key, data in file[name].items()}
        for name in ("series", "material", "rings", "rest")
        if name in file
    }
    series = {name: groups["series"].get(name) for name in Simulation._fields}
    must = {"s", "phi", "displacement", "force", "depth", "skeleton", "depth_share", "status"}
    if missing := sorted(name for name in must if series[name] is None):
        raise KeyError(f"no series {', '.join(missing)}")
    if (names := json.loads(file.attrs.get("tools", "null"))) is not None:
        found = {name: _tool(file, f"tool/{i}") for i, name in enumerate(names)}
        shape = {name: own for name, (own, _) in found.items()}
        path = {name: own for name, (_, own) in found.items()}
    else:
        shape, path = _tool(file, "tool")
    return StoredSimulation(
        simulation=Simulation(**series),  # pyright: ignore
        units={n: file["series"][n].attrs["units"] for n, v in series.items() if v is not None},
        plan=json.loads(file.attrs["plan"]),
        provenance=json.loads(file.attrs["provenance"]),
        tool=shape,
        path=path,
        material=groups["material"],
        rings=groups["rings"],
        rest=groups.get("rest"),
    )


def _tool(file, group: str) -> tuple[Shape | None, Poses | None]:
    """Shape and positions of a tool; None: presses at given points."""
    if group not in file:
        return None, None
    tool = {key: np.asarray(data) for key, data in file[group].items()}
    time = file["series"].get("time")
    path = Poses(tool["rotation"], tool["translation"], None if time is None else np.asarray(time))
    if "radius" not in tool:
        return None, path
    names = [name for name in ("vertices", "radius", "counts") if name in tool]
    return Shape(**{name: jnp.asarray(tool[name]) for name in names}), path
