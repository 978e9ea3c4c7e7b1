"""From a scene specification to a `Scene`: reads the files that it names."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.config import EvenRings, SpecError, TracheaSection
from jaxtrachea.contact import shapes
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.mechanics.levels.choose import AnyMaterial, level_type
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.sections.material import (
    FROM_FACTORS,
    SECTION_VALUES,
    Factors,
    SectionMaterial,
    Wall,
    from_wall,
)
from jaxtrachea.relaxation import laws
from jaxtrachea.scene import wall_check
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.declare import PlanError
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.facts import facts_of
from jaxtrachea.scene.paths import named_file, path_of, read_table
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.scene.spec_parts import NEEDED, SceneTracheaSection, ShapeSection, ToolSection
from jaxtrachea.scene.stage import Poses, Presses, Scene, Tool
from jaxtrachea.scene.tool_file import read_tool
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.imported import Landmarks, read_mesh
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.mesh import Mesh, MeshError
from jaxtrachea.trachea.section import geometry_of
from jaxtrachea.trachea.sizes import SizeError
from jaxtrachea.trachea.tube import make_tube
from jaxtrachea.units import UnitError

#: Arguments of Python functions that a scene calls otherwise, or does not have.
KEYS = {
    "rings": "cartilage",
    "rings=": "cartilage=",
    "ring_positions": "rings",
    "ring_positions=": "rings=",
    "geometry.length": "trachea.length",
    "geometry.radius": "trachea.radius",
    "geometry.ring_height": "trachea.ring_height",
    "onset_width": "model.onset_width",
    "transition": "model.transition",
    "half_width": "model.half_width",
    "relief": "trachea.relief",
}


#: Begins a stage of work by its name; returns what takes (steps done since, steps in all), or None.
Counted = Callable[[str], Callable[[int, int], None] | None]


class Staged(NamedTuple):
    """A scene ready to run: the scene, its material and path, the files read, notes on the mesh."""

    scene: Scene
    material: AnyMaterial
    path: Poses | Presses | dict[str, Poses | Presses]
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def stage(spec: SceneSpec, folder: Path, counted: Counted | None = None) -> Staged:
    """Read what the specification names and choose the program.

    Args:
        folder: that relative file names start from.
        counted: begins a stage of the work of this name; returns what its steps are told to.

    Raises:
        SpecError: a file or a value that cannot be used, with its key.
    """
    files: list[Path] = []
    counted = counted or (lambda text: None)
    geometry, mesh, notes = _trachea(spec.trachea, folder, files, counted)
    material = material_of(spec, geometry)
    notes += ends_not_given(spec)
    if mesh is None:
        mesh = _tube(spec.trachea, geometry, material)
    tool, seen = _tools(spec.tool, folder, files)
    notes += seen
    path = path_of(spec, folder, files, geometry)
    material = relaxing(spec, material, path)
    radius = float(geometry.radius) + spec.trachea.wall / 2
    if spec.trachea.file is not None:
        radius = float(geometry.radius)  # that of the outer wall
    if (own := level_type(material).thickness(long_run(material))) is not None:
        radius = float(geometry.radius) + float(own) / 2
    try:
        scene = make_scene(
            geometry, material, path, tool=tool, mesh=mesh, radius=radius,
            effects=effects_of(spec), progress=counted("cutting its wall into patches"),
        )  # fmt: skip
    except PlanError as error:
        raise SpecError.like(error, key=f"effects.{error.key}") from None
    except MeshError as error:
        if spec.trachea.file is None:
            raise SpecError.like(error.renamed(KEYS), key="trachea") from None
        error.place = Path(spec.trachea.file).name
        raise _of_file(error) from None
    except SizeError as error:
        raise SpecError.like(error.renamed(KEYS)) from None
    except ValueError as error:
        if not spec.names:
            raise
        raise SpecError(f"path: {error}") from None  # paths of tools that do not go together
    if scene.tube is not None and scene.plan.mechanics.hangs_on_rings:
        lost, filled = float(scene.tube.lost.max()), float(scene.tube.filled.max())
        notes += (
            f"contact patches: the surface stands out of them by up to {lost:.2g} mm; hollows (and "
            f"an inner wall) are bridged up to {filled:.2g} mm deep",
            wall_check.measure(mesh, geometry, scene.tube).sentence,
        )
        if caveat := wall_check.look_beyond(mesh, geometry, scene.tube).sentence:
            notes += (caveat,)
    notes += dropped_effects(scene)
    return Staged(scene=scene, material=material, path=path, files=tuple(files), notes=notes)


def material_of(spec: SceneSpec, geometry: Geometry) -> AnyMaterial:
    """The material of [material], or of [sections] and what [wall] gives beside it.

    Raises:
        SpecError: a wall that cannot be.
    """
    if spec.material is not None:
        return Material(**spec.material.model_dump())
    named = {} if spec.sections is None else spec.sections.model_dump(exclude_none=True)
    if spec.wall is None:
        return SectionMaterial(**named)
    moduli = spec.wall.model_dump()
    tool_radius = moduli.pop("tool_radius")
    try:
        half = 0.0 if spec.effects.width == "point" else spec.model.half_width
        wall = from_wall(geometry, Wall(**moduli), tool_radius=tool_radius, half_width=half)
    except InputError as error:
        raise SpecError.like(error, key=f"wall.{error.key}") from None
    fitted = [name for name, p in SECTION_VALUES.items() if p.fit and not p.fit.fixed]
    if all(name in named for name in (*fitted, *FROM_FACTORS)):
        named["extrapolated"] = 0.0  # nothing is left of the factors
    return dataclasses.replace(wall, **named)


def relaxing(
    spec: SceneSpec, material: AnyMaterial, path: Poses | Presses | dict[str, Poses | Presses]
) -> AnyMaterial:
    """The material with what [relaxation] says; `power` covers the times of the path."""
    if spec.relaxation is None:
        return material
    span = laws.Span(Options.shortest, Options.longest)
    if isinstance(path, dict):
        path = next(iter(path.values()))  # the clock is the same for all
    if path.time is not None:
        steps = np.diff(np.asarray(path.time))
        if (steps > 0).any():
            span = laws.Span(float(steps[steps > 0].min()), float(steps.sum()))
    section = spec.relaxation
    values = {name: jnp.asarray(v) for name, v in section.numbers.items()}
    made = laws.relaxation(section.branches, values, span, parts=section.apart)
    return RelaxingMaterial(material, made)


def ends_not_given(spec: SceneSpec) -> tuple[str, ...]:
    """Of numbers in [sections] alone: what a fit takes from [wall], and here is another default."""
    if spec.material is not None or spec.wall is not None or spec.sections is None:
        return ()
    of_wall = {f.name for f in dataclasses.fields(Factors)}
    taken = [
        f"{f.name} = {f.default:g}"
        for f in dataclasses.fields(SectionMaterial)
        if f.name in of_wall - {*NEEDED} and getattr(spec.sections, f.name) is None
    ]
    if not taken:
        return ()
    return (
        f"sections: {', '.join(taken)} (not given). A fit has what its wall gives, c_end = 0 among "
        "it: for estimates of a fit name them, or give the [wall] of the fit",
    )


def dropped_effects(scene: Scene) -> tuple[str, ...]:
    """Friction that was asked for and is not in the program; levels that make numbers doubtful."""
    notes = []
    rubs = any(v.friction is not None for v in (scene, *scene.instruments))
    for effect in scene.plan.effects:
        if effect.name == "friction" and rubs and not scene.plan.friction:
            notes.append(f"friction: off, {effect.reason}")
        if effect.caveat:
            notes.append(f"{effect.name}: {effect.level}, {effect.caveat}")
    return tuple(notes)


def stage_sweep(spec: SceneSpec, staged: Staged, s: np.ndarray, phi: np.ndarray) -> Scene:
    """The scene with the program of its sweep: the path may need less than presses everywhere.

    Args:
        spec: with a table [sweep].
        staged: from `stage`.
        s: of every contact point, mm; shape (points,).
        phi: rad.

    Raises:
        SpecError: a sweep that no program of a scene can press.
    """
    assert spec.sweep is not None
    inward = np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], axis=1)
    staged = staged._replace(scene=dataclasses.replace(staged.scene, instruments=()))
    bare = dataclasses.replace(staged.scene, mesh=None)
    facts = facts_of(bare, staged.material, Presses(s, phi, spec.sweep.depth * inward))
    bare_effects = dataclasses.replace(
        effects_of(spec), contact_point="auto", friction="off", second_plane="auto", axial="off",
        end_motion="off", surface="off", dent="off", relaxation="off", want_surface=False,
        want_joints=False, want_ring_ends=False,
    )  # fmt: skip
    try:
        plan = make_plan(facts, bare_effects)
    except PlanError as error:
        cure = f"{error.cure}; a sweep of the midline alone has phi_count = 1"
        raise SpecError.like(error, key=f"sweep: effects.{error.key}", cure=cure) from None
    return dataclasses.replace(staged.scene, plan=plan)


def effects_of(spec: SceneSpec) -> EffectOptions:
    """What the specification asks for."""
    output = spec.output
    return EffectOptions(
        **spec.effects.model_dump(), want_surface=output.surface, want_joints=output.joints,
        want_ring_ends=output.ring_ends, **spec.model.model_dump(),
    )  # fmt: skip


def _trachea(section: SceneTracheaSection, folder: Path, files: list[Path], counted: Counted):
    if section.file is not None:
        return _imported(section, folder, files, counted(f"reading {Path(section.file).name}"))
    named = section.model_fields_set & set(TracheaSection.model_fields)
    given = {name: getattr(section, name) for name in named}
    if isinstance(section.rings, EvenRings):
        given["rings"] = section.rings
    if given.get("half_angle", 0) is None:
        del given["half_angle"]
    return geometry_of(TracheaSection.model_construct(**given)), None, ()


def _tube(section: SceneTracheaSection, geometry: Geometry, material: AnyMaterial) -> Mesh:
    """The generated surface; of deforming cross-sections round, at the outside of their wall."""
    key, size = "trachea", {"wall": section.wall, "relief": section.relief}
    if (own := level_type(material).thickness(material)) is not None:
        size = {"wall": float(own), "relief": 0.0, "flatten": 0.0}
        key = f"trachea: a wall of deforming cross-sections of {size['wall']:g} mm (twice offset)"
    try:
        return make_tube(geometry, around=section.around, along=section.along, lids=True, **size)
    except ValueError as error:
        raise SpecError(f"{key}: {error}") from None


def _imported(section: SceneTracheaSection, folder: Path, files: list[Path], progress):
    path = named_file(folder, section.file or "", "trachea.file", files)
    cartilage = section.cartilage
    if cartilage is not None and (folder / cartilage).is_file():
        cartilage = named_file(folder, cartilage, "trachea.cartilage", files)
    rings = section.rings if isinstance(section.rings, list) else None
    landmarks = Landmarks(
        larynx=section.larynx, anterior=section.anterior, ring_positions=rings,
        half_angle=section.half_angle,
        centreline=None if section.centreline is None else np.array(section.centreline),
    )  # fmt: skip
    try:
        read = read_mesh(
            path, landmarks, unit=section.unit, part=section.part, rings=cartilage,
            progress=progress,
        )  # fmt: skip
    except (MeshError, UnitError) as error:
        raise _of_file(error) from None
    return read.geometry, read.mesh, read.notes


def _of_file(error: InputError) -> SpecError:
    """What is wrong with the mesh, with the keys of a scene for the arguments of `read_mesh`."""
    named = error.renamed(KEYS)
    key = ": ".join(part for part in ("trachea.file", error.place, named.key) if part)
    return SpecError.like(named, place="", key=key, joint=named.joint if named.key else ": ")


def _tools(
    section: ToolSection | list[ToolSection] | None, folder: Path, files: list[Path]
) -> tuple[Tool | dict[str, Tool] | None, tuple[str, ...]]:
    """The tool, or several by name; and notes on their files."""
    if section is None:
        return None, ()
    if isinstance(section, ToolSection):
        shape, notes = _tool(section, "tool", folder, files)
        return Tool(shape, section.friction, section.contact), notes
    tools, notes = {}, ()
    for i, one in enumerate(section):
        shape, seen = _tool(one, f"tool.{i}", folder, files)
        tools[one.name] = Tool(shape, one.friction, one.contact)
        notes += tuple(f"{one.name}: {note}" for note in seen)
    return tools, notes


def _tool(
    section: ToolSection, key: str, folder: Path, files: list[Path]
) -> tuple[shapes.Shape, tuple[str, ...]]:
    """The shape of the tool, its parts where they stand, and notes on their files."""
    if section.parts is None:
        return _shape(section, key, folder, files)
    found, poses, notes = [], [], ()
    for i, part in enumerate(section.parts):
        shape, seen = _shape(part, f"{key}.parts.{i}", folder, files)
        turn, place = part.rotation or [0.0] * 3, part.position or [0.0] * 3
        found.append(jax.tree.map(lambda v: jnp.asarray(v, float), shape))
        poses.append(jax.jit(pose_from_vector)(np.asarray(turn, float), np.asarray(place, float)))
        notes += seen
    try:
        return shapes.compound(found, poses), notes
    except ValueError as error:
        raise SpecError(str(error).replace("shapes:", f"{key}.parts:", 1)) from None


def _shape(
    section: ShapeSection, key: str, folder: Path, files: list[Path]
) -> tuple[shapes.Shape, tuple[str, ...]]:
    """A shape of the specification, and notes on its file."""
    rounding, radius = section.rounding or 0.0, section.radius or 0.0
    half = (section.length or 0.0) / 2
    if section.shape == "sphere":
        return shapes.sphere(radius), ()
    if section.shape == "capsule":
        return shapes.capsule(half, radius), ()
    if section.shape == "cylinder":
        return shapes.cylinder(half, radius, rounding, dtype=float), ()
    if section.shape == "box":
        return shapes.box(np.asarray(section.size) / 2, rounding), ()
    path = named_file(folder, section.file or "", f"{key}.file", files)
    if section.shape == "cloud":
        table = read_table(path, f"{key}.file", ("x", "y", "z"), {})
        points = np.stack(list(table.values()), axis=1)
        return shapes.hull(points, rounding), ()
    try:
        shape, note = read_tool(path, section.unit, rounding)
    except MeshError as error:
        place = error.key if error.key else f"file: {path.name}"
        raise SpecError.like(error, place="", key=f"{key}.{place}") from None
    return shape, (note,)
