"""Files of a simulation: HDF5 with units, a table of forces."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from jaxtrachea.files.atomic import hdf5_file
from jaxtrachea.files.table import Table
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.sections.material import SECTION_VALUES
from jaxtrachea.scene.instruments import scene_of
from jaxtrachea.scene.plan import Plan
from jaxtrachea.scene.simulation import OF_TOOLS, Simulation, of_tool
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.scene.sweep import Sweep
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.material import VALUES

SCHEMA, SCHEMA_VERSION = "jaxtrachea-simulation", 2

#: Unit of every series; what is not named is in mm.
UNITS = {"phi": "rad", "force": "N", "loads": "N", "moment": "N mm", "dissipated": "N mm",
         "time": "s", "status": "1", "depth_share": "1", "contact_share": "1"}  # fmt: skip


def plan_rows(plan: Plan, shares: dict[str, float]) -> list[list[str]]:
    """Effect, level, whether forced, share of the operations, reason."""

    def share(name):
        return f"{100 * shares[name]:.1f} %" if name in shares else ""

    return [
        [e.name, e.level, "forced" if e.forced else "auto", share(e.name), e.reason]
        for e in plan.effects
    ]


def write_simulation(
    path: Path,
    scene: Scene,
    material: AnyMaterial,
    motion: Poses | Presses | Mapping[str, Poses | Presses],
    out: Simulation,
    provenance: dict,
) -> None:
    """All series of a simulation; one dataset each, its unit as attribute (docs/simulate.md).

    Of several tools the group `tool` has a group for each, in their order, with its name.
    """
    with hdf5_file(path) as file:
        _head(file, provenance, scene.plan)
        series = file.create_group("series")
        for name, value in out._asdict().items():
            if value is not None:
                data = series.create_dataset(name, data=np.asarray(value), compression="gzip")
                data.attrs["units"] = UNITS.get(name, "mm")
                _name_dimensions(series, data, bool(scene.instruments) and name in OF_TOOLS)
        series["status"].attrs["meaning"] = json.dumps({int(s): s.message for s in PressStatus})
        if isinstance(motion, Mapping):
            file.attrs["tools"] = json.dumps(scene.names)
            for i, instrument in enumerate(scene.instruments):
                own = motion[instrument.name]
                _write_tool(file, f"tool/{i}", scene_of(scene, instrument), own)
        else:
            _write_tool(file, "tool", scene, motion)
        _write_rings(file.create_group("rings"), scene)
        _write_material(file.create_group("material"), material)
        if scene.mesh is not None:
            rest = file.create_group("rest")
            for name in ("vertices", "faces", "s", "phi", "distance"):
                data = rest.create_dataset(name, data=getattr(scene.mesh, name))
                data.attrs["units"] = {"faces": "1", "phi": "rad"}.get(name, "mm")


def _write_tool(file: h5py.File, name: str, scene: Scene, motion: Poses | Presses) -> None:
    """Where a tool stands in each row, and its shape; nothing of presses at points."""
    if not isinstance(motion, Poses):
        return
    tool = file.create_group(name)
    tool.create_dataset("translation", data=motion.translation).attrs["units"] = "mm"
    tool.create_dataset("rotation", data=motion.rotation).attrs["units"] = "1"
    if scene.tool is not None:
        tool.create_dataset("vertices", data=scene.tool.vertices).attrs["units"] = "mm"
        tool.create_dataset("radius", data=scene.tool.radius).attrs["units"] = "mm"
        if scene.tool.counts is not None:
            tool.create_dataset("counts", data=scene.tool.counts).attrs["units"] = "1"


def _name_dimensions(series: h5py.Group, data: h5py.Dataset, of_tools: bool) -> None:
    """Dimension scales as netCDF-4 has them, without values: xarray reads the names."""
    middle = "vertex" if data.name == "/series/vertices" else "ring"
    before = ("row", "tool") if of_tools else ("row",)
    if data.name in ("/series/frame", "/series/stiffness"):
        names = *before, "xyz", "column"
    elif of_tools:
        names = *before, "xyz"
    else:
        names = ("row", "tool", middle, "xyz") if data.ndim == 4 else ("row", middle, "xyz")
        names = ("row", "xyz") if data.ndim == 2 else names
    for axis, (name, size) in enumerate(zip(names, data.shape, strict=False)):
        if name not in series:
            scale = series.create_dataset(name, shape=(size,), dtype=">f4")
            scale.make_scale(f"This is a netCDF dimension but not a netCDF variable.{size:10d}")
        data.dims[axis].attach_scale(series[name])


def _write_rings(group: h5py.Group, scene: Scene) -> None:
    """Where the rings are, and how large."""
    tube = scene.geometry
    for name, value, unit in (
        ("position", tube.ring_positions, "mm"), ("height", tube.ring_height, "mm"),
        ("radius", tube.radius, "mm"), ("half_angle", tube.half_angle, "rad"),
    ):  # fmt: skip
        group.create_dataset(name, data=value).attrs["units"] = unit


def _write_material(group: h5py.Group, material: AnyMaterial) -> None:
    """Every value that is given, with its unit."""
    declared = VALUES | SECTION_VALUES
    for name, value in vars(material).items():
        if value is not None and name in declared:
            group.create_dataset(name, data=value).attrs["units"] = declared[name].unit


def write_forces(path: Path, out: Simulation, tools: Sequence[str] = ()) -> None:
    """A row of numbers for each row of a simulation, as CSV (docs/simulate.md).

    Of several tools, with their names, a row for each of them.
    """
    if not tools:
        rows = _force_rows(out)
    else:
        each = [_force_rows(of_tool(out, i), name) for i, name in enumerate(tools)]
        rows = [row for of_all in zip(*each, strict=True) for row in of_all]
    Table(rows).write_csv(path)


def _force_rows(out: Simulation, tool: str = "") -> list[dict]:
    """The rows of `write_forces` of one tool."""
    names = {"time": ("time_s",), "s": ("s_mm",), "phi": ("phi_rad",), "gap": ("gap_mm",)}
    names |= {
        name: tuple(f"{name}_{axis}_{unit}" for axis in "xyz")
        for name, unit in (("displacement", "mm"), ("force", "N"), ("skeleton", "mm"))
    }
    names["dissipated"] = ("dissipated_N_mm",)
    columns: dict[str, np.ndarray] = {}
    for name, heads in names.items():
        if (value := getattr(out, name)) is not None:
            parts = np.asarray(value, float).reshape(len(out.status), -1).T
            columns |= dict(zip(heads, parts, strict=True))
    columns["depth_share"] = np.asarray(out.depth_share, float)
    rows = []
    for i, status in enumerate(np.asarray(out.status)):
        numbers = {head: float(v[i]) for head, v in columns.items()}
        named = {"row": i + 1} | ({"tool": tool} if tool else {})
        rows.append(named | numbers | {"status": PressStatus(int(status)).name})
    return rows


def write_sweep(path: Path, scene: Scene, s, phi, depth: float, out: Sweep, made: dict) -> None:
    """A sweep over a grid; datasets of shape (s, phi)."""
    units = {"force": "N", "indentation": "mm", "compliance": "mm/N", "depth_share": "1",
             "status": "1"}  # fmt: skip
    with hdf5_file(path) as file:
        _head(file, made, scene.plan)
        file.create_dataset("s", data=s).attrs["units"] = "mm"
        file.create_dataset("phi", data=phi).attrs["units"] = "rad"
        file.create_dataset("depth", data=depth).attrs["units"] = "mm"
        for name, value in out._asdict().items():
            grid = np.asarray(value).reshape(len(s), len(phi))
            file.create_dataset(name, data=grid, compression="gzip").attrs["units"] = units[name]
        file["status"].attrs["meaning"] = json.dumps({int(v): v.message for v in PressStatus})


def _head(file: h5py.File, provenance: dict, plan: Plan) -> None:
    file.attrs["schema"], file.attrs["schema_version"] = SCHEMA, SCHEMA_VERSION
    file.attrs["provenance"] = json.dumps(provenance)
    file.attrs["plan"] = json.dumps(plan_rows(plan, {}))


def last_solved(out: Simulation) -> int | None:
    """The last row that is finite."""
    known = np.isfinite(np.asarray(out.force)).reshape(len(out.force), -1)
    good = np.flatnonzero(known.all(axis=1))
    return int(good[-1]) if len(good) else None
