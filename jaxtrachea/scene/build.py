"""From a scene specification to a `Scene`: reads the files that it names."""

import csv
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.config import EvenRings, SpecError, TracheaSection
from jaxtrachea.contact import shapes
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.scene import wall_check
from jaxtrachea.scene.operations import count_operations
from jaxtrachea.scene.plan import PlanError, Wishes
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.sizes import SizeError
from jaxtrachea.scene.spec import PathSection, SceneSpec, SceneTracheaSection, ToolSection
from jaxtrachea.scene.stage import Poses, Presses, Scene, facts_of, make_scene
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.imported import read_mesh
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.section import geometry_of
from jaxtrachea.trachea.tube import make_tube
from jaxtrachea.units import UnitError, column_unit, convert

#: Steps of a press or a line that names none.
STEPS = 10

#: Longest table of points or poses that is read.
MAX_BYTES = 64 * 2**20

#: Meshes that scenes of `configs/` name, and where they come from.
MESHES = {
    "meshes/trachea.glb": "3D Reference Organ for Trachea, Male v1.0 (GLB, CC BY 4.0), "
    "doi:10.48539/HBM969.WCCJ.636",
}

#: Arguments of `read_mesh` that a scene calls otherwise, or does not have.
KEYS = {
    "rings=": "cartilage=",
    "ring_positions": "rings",
    "give centreline=": "give centreline= to read_mesh (from Python)",
}


#: Begins a stage of work by its name; returns what takes (steps done since, steps in all), or None.
Counted = Callable[[str], Callable[[int, int], None] | None]


class Staged(NamedTuple):
    """A scene ready to run: the scene, its material and path, the files read, notes on the mesh."""

    scene: Scene
    material: Material
    path: Poses | Presses
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def stage(spec: SceneSpec, folder: Path, counted: Counted | None = None) -> Staged:
    """Read what the specification names and choose the program.

    Args:
        spec: the scene.
        folder: that relative file names start from.
        counted: begins a stage of the work of this name; returns what its steps are told to.

    Raises:
        SpecError: a file or a value that cannot be used, with its key.
    """
    files: list[Path] = []
    counted = counted or _uncounted
    geometry, mesh, notes = _trachea(spec.trachea, folder, files, counted)
    material = Material(**spec.material.model_dump())
    tool = None if spec.tool is None else _tool(spec.tool, folder, files)
    path = _path(spec, folder, files, geometry)
    friction = None if spec.tool is None else spec.tool.friction
    radius = float(geometry.radius) + spec.trachea.wall / 2
    if spec.trachea.file is not None:
        radius = float(geometry.radius)  # that of the outer wall
    try:
        scene = make_scene(
            geometry, material, path, tool=tool, friction=friction, mesh=mesh, radius=radius,
            wishes=wishes_of(spec), progress=counted("cutting its wall into patches"),
        )  # fmt: skip
    except PlanError as error:
        raise SpecError(f"effects.{error}") from None
    except MeshError as error:
        name = Path(spec.trachea.file or "").name
        raise SpecError(f"trachea.file: {name}: {_in_keys(str(error))}") from None
    except SizeError as error:
        raise SpecError(str(error).replace("geometry.", "trachea.")) from None
    if scene.tube is not None and mesh is not None:
        lost, filled = float(scene.tube.lost.max()), float(scene.tube.filled.max())
        notes += (
            f"contact patches: the surface stands out of them by up to {lost:.2g} mm; hollows (and "
            f"an inner wall) are bridged up to {filled:.2g} mm deep",
            wall_check.measure(mesh, geometry, scene.tube).sentence,
        )
        if doubt := wall_check.look_beyond(mesh, geometry, scene.tube).sentence:
            notes += (doubt,)
    return Staged(scene, material, path, tuple(files), notes + dropped_effects(scene))


def _uncounted(_: str) -> None:
    """Nobody looks on."""


def dropped_effects(scene: Scene) -> tuple[str, ...]:
    """Friction that was asked for and is not in the program, with its reason."""
    if scene.friction is None or scene.plan.friction:
        return ()
    effect = next(e for e in scene.plan.effects if e.name == "friction")
    return (f"friction: off, {effect.reason}",)


def stage_sweep(spec: SceneSpec, staged: Staged, s: np.ndarray, phi: np.ndarray) -> Scene:
    """The scene with the program of its sweep: the path may need less than presses everywhere.

    Args:
        spec: with a table [sweep].
        staged: from `stage`.
        s: of every contact point, mm; shape (points,).
        phi: rad.
    """
    assert spec.sweep is not None
    inward = np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], axis=1)
    bare = dataclasses.replace(staged.scene, mesh=None)
    facts = facts_of(bare, staged.material, Presses(s, phi, spec.sweep.depth * inward))
    wishes = dataclasses.replace(
        wishes_of(spec), seat="auto", friction="off", second_plane="auto", axial="off",
        end_motion="off", surface="off", dent="off", want_surface=False, want_joints=False,
        want_ring_ends=False,
    )  # fmt: skip
    return dataclasses.replace(staged.scene, plan=make_plan(facts, wishes))


def wishes_of(spec: SceneSpec) -> Wishes:
    """What the specification asks for."""
    output = spec.output
    return Wishes(
        **spec.effects.model_dump(), want_surface=output.surface, want_joints=output.joints,
        want_ring_ends=output.ring_ends, **spec.model.model_dump(),
    )  # fmt: skip


def shares(staged: Staged) -> tuple[int, dict[str, float]]:
    """Operations of the whole program, and the share of each effect that can be taken away."""
    scene = staged.scene
    count = lambda s: count_operations(simulate, s, staged.material, staged.path)  # noqa: E731
    whole, found = count(scene), {}
    for effect in scene.plan.effects:
        less = scene.plan.without(effect.name)
        if less is not None and effect.level not in ("off", "mat"):
            found[effect.name] = 1 - count(dataclasses.replace(scene, plan=less)) / whole
    if scene.plan.contact:
        moved = jax.eval_shape(simulate, scene, staged.material, staged.path)
        given = jax.tree.map(
            lambda v: jnp.zeros(v.shape, v.dtype), (moved.s, moved.phi, moved.displacement)
        )
        # Compared without dent, which takes another form without a tool.
        plan = dataclasses.replace(scene.plan, dent=0)
        bare = dataclasses.replace(plan, contact=False)
        rest = count_operations(
            simulate, dataclasses.replace(scene, plan=bare), staged.material, Presses(*given)
        )
        found["contact"] = (count(dataclasses.replace(scene, plan=plan)) - rest) / whole
    return whole, found


def _trachea(section: SceneTracheaSection, folder: Path, files: list[Path], counted: Counted):
    if section.file is not None:
        return _imported(section, folder, files, counted(f"reading {Path(section.file).name}"))
    named = section.model_fields_set & set(TracheaSection.model_fields)
    given = {name: getattr(section, name) for name in named}
    if isinstance(section.rings, EvenRings):
        given["rings"] = section.rings
    if given.get("half_angle", 0) is None:
        del given["half_angle"]
    geometry = geometry_of(TracheaSection.model_construct(**given))
    try:
        mesh = make_tube(geometry, around=section.around, along=section.along, wall=section.wall)
    except ValueError as error:
        raise SpecError(f"trachea: {error}") from None
    return geometry, mesh, ()


def _imported(section: SceneTracheaSection, folder: Path, files: list[Path], progress):
    path = _file(folder, section.file or "", "trachea.file", files)
    cartilage = section.cartilage
    if cartilage is not None and (folder / cartilage).is_file():
        cartilage = _file(folder, cartilage, "trachea.cartilage", files)
    rings = section.rings if isinstance(section.rings, list) else None
    try:
        read = read_mesh(
            path, unit=section.unit, part=section.part, rings=cartilage, larynx=section.larynx,
            anterior=section.anterior, ring_positions=rings, half_angle=section.half_angle,
            progress=progress,
        )  # fmt: skip
    except (MeshError, UnitError) as error:
        raise SpecError(f"trachea.file: {_in_keys(str(error))}") from None
    return read.geometry, read.mesh, read.notes


def _in_keys(message: str) -> str:
    """The message with the keys of a scene for the arguments of `read_mesh`."""
    for argument, key in KEYS.items():
        message = message.replace(argument, key)
    return message


def _tool(section: ToolSection, folder: Path, files: list[Path]) -> shapes.Shape:
    rounding = section.rounding or 0.0
    if section.shape == "sphere":
        return shapes.sphere(section.radius or 0.0)
    if section.shape == "capsule":
        return shapes.capsule((section.length or 0.0) / 2, section.radius or 0.0)
    if section.shape == "cylinder":
        return shapes.cylinder(
            (section.length or 0.0) / 2, section.radius or 0.0, rounding, dtype=float
        )
    if section.shape == "box":
        return shapes.box(np.asarray(section.size) / 2, rounding)
    path = _file(folder, section.file or "", "tool.file", files)
    rows = _table(path, "tool.file", ("x", "y", "z"), ())
    return shapes.hull(rows, rounding)


def _path(spec: SceneSpec, folder: Path, files: list[Path], geometry: Geometry) -> Poses | Presses:
    if spec.path[0].kind == "press":
        return _presses(spec.path, geometry)
    legs = [_leg(leg, i, folder, files) for i, leg in enumerate(spec.path)]
    translation, vectors = (np.concatenate(v) for v in zip(*legs, strict=True))
    turn = jax.vmap(lambda v: pose_from_vector(v, jnp.zeros_like(v)).rotation)
    return Poses(turn(jnp.asarray(vectors)), jnp.asarray(translation))


def _presses(legs: list[PathSection], geometry: Geometry) -> Presses:
    s, phi, D = [], [], []
    length, alpha = float(geometry.length), float(geometry.half_angle)
    for i, leg in enumerate(legs):
        at, angle, steps = leg.s or 0.0, leg.phi or 0.0, leg.steps or STEPS
        if not 0 <= at <= length:
            raise SpecError(
                f"path.{i}.s: {at:g} mm; expected a place on the tube, 0 to {length:g} mm"
            )
        if abs(angle) > alpha:
            raise SpecError(
                f"path.{i}.phi: {np.degrees(angle):.4g} deg; expected within the rings, "
                f"-{np.degrees(alpha):.4g} to {np.degrees(alpha):.4g} deg"
            )
        s += [at] * steps
        phi += [angle] * steps
        whole = np.asarray(leg.displacement)
        D += [whole * (k + 1) / steps for k in range(steps)]
    return Presses(np.array(s), np.array(phi), np.array(D))


def _leg(leg: PathSection, i: int, folder: Path, files: list[Path]):
    """Translations and rotation vectors of one leg."""
    if leg.kind == "file":
        path = _file(folder, leg.file or "", f"path.{i}.file", files)
        rows = _table(path, f"path.{i}.file", ("x", "y", "z"), ("rx", "ry", "rz"))
        return rows[:, :3], rows[:, 3:]
    if leg.kind == "line":
        steps = leg.steps or STEPS
        if steps < 2:
            raise SpecError(f"path.{i}.steps: {steps}; expected at least 2, the start and the end")
        places = np.linspace(np.asarray(leg.start), np.asarray(leg.end), steps)
    else:
        places = np.asarray(leg.positions)
    turn = np.asarray(leg.rotation or [0.0, 0.0, 0.0])
    return places, np.broadcast_to(turn, places.shape)


def _file(folder: Path, name: str, key: str, files: list[Path]) -> Path:
    path = folder / name
    try:
        found = bool(name) and path.is_file()
    except (OSError, ValueError):
        found = False
    if not found:
        from_where = _source(name) if key == "trachea.file" else ""
        raise SpecError(
            f"{key}: there is no file {name!r} in the scene's folder; check the name{from_where}"
        )
    files.append(path)
    return path


def _source(name: str) -> str:
    """Where a mesh of `configs/` comes from, which the repository does not hold."""
    if name not in MESHES:
        return ""
    return f", or fetch it: {MESHES[name]}, and save it under this name (docs/surface.md)"


def _table(path: Path, key: str, needed: tuple[str, ...], optional: tuple[str, ...]) -> np.ndarray:
    """Columns of a CSV file with units in its header; optional columns that lack are 0."""
    if path.stat().st_size > MAX_BYTES:
        raise SpecError(f"{key}: {path.name} has more than {MAX_BYTES} bytes; thin it out")
    try:
        rows = [row for row in csv.reader(path.read_text("utf-8-sig").splitlines()) if row]
    except (UnicodeDecodeError, csv.Error, OSError):
        raise SpecError(f"{key}: {path.name} is not a CSV file in UTF-8; save it as one") from None
    heads = [column_unit(cell) for cell in rows[0]] if rows else []
    names = [name for name, _ in heads]
    expected = ", ".join(f"{name} [mm]" for name in needed)
    if missing := [name for name in needed if name not in names]:
        raise SpecError(
            f"{key}: {path.name} has no column {missing[0]!r}; expected a header {expected}"
        )
    if len(rows) < 2:
        raise SpecError(f"{key}: {path.name} has no rows; expected at least one")
    columns = []
    for name in (*needed, *optional):
        if name not in names:
            columns.append(np.zeros(len(rows) - 1))
            continue
        at, dimension = names.index(name), "length" if name in needed else "angle"
        unit = heads[at][1]
        try:
            if unit is None:
                raise UnitError(f"no unit; write {name} [{'mm' if name in needed else 'deg'}]")
            values = convert(np.array([_cell(row, at, i) for i, row in enumerate(rows[1:], 1)]),
                             unit, dimension)  # fmt: skip
        except ValueError as error:
            raise SpecError(f"{key}: {path.name}, column {name!r}: {error}") from None
        if not np.isfinite(values).all():
            raise SpecError(f"{key}: {path.name}, column {name!r}: expected finite numbers")
        columns.append(values)
    return np.stack(columns, axis=1)


def _cell(row: list[str], at: int, number: int) -> float:
    """A number of the table.

    Raises:
        ValueError: it is none, or is missing.
    """
    if at >= len(row):
        raise ValueError(f"row {number} below the header has {len(row)} cells; complete it")
    try:
        return float(row[at])
    except ValueError:
        raise ValueError(
            f"{row[at]!r} in row {number} below the header; expected a number"
        ) from None
