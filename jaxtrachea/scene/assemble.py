"""A scene put together: what is there, its program, and the same with another skeleton or mesh."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._arguments import check_fits, check_word
from jaxtrachea.contact.search import STANDARD
from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.mechanics.levels.choose import AnyMaterial, level_type
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.mechanics.press_contacts import MOST_CONTACTS
from jaxtrachea.mechanics.sections.wall import Points, gather_points
from jaxtrachea.scene.declare import PlanError, SceneFacts
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.facts import facts_of, facts_together
from jaxtrachea.scene.instruments import paths_in_order, rows_of, scene_of
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.sizes import OUTER, RADIUS, check_sizes, check_width
from jaxtrachea.scene.stage import (
    Instrument,
    Poses,
    Presses,
    Scene,
    Tool,
    check_material,
    check_path,
)
from jaxtrachea.scene.wall import checked_walls, contact_settings, near_patches, round_wall
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh
from jaxtrachea.trachea.sizes import check_tube

#: Distance between the circles of the dent's centres: share of the tool's size; at least, on Table
#: 1's tube, mm.
FOOTPRINT, LEAST = 0.6, 4.0
#: Of a tool that a program does not fit.
CURE = "make a scene for this tool (a program for the largest tool serves smaller ones)"
#: Tools of one scene, at most.
MOST_TOOLS = MOST_CONTACTS


def make_scene(
    geometry: Geometry,
    material: AnyMaterial,
    path: Poses | Presses | Mapping[str, Poses | Presses],
    *,
    tool: Tool | Shape | None | Mapping[str, Tool | Shape] = None,
    mesh: Mesh | None = None,
    radius: float | None = None,
    effects: EffectOptions = EffectOptions(),
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Put a scene together and choose its program from the path (concrete numbers).

    Args:
        geometry: the tube at rest.
        material: read only for which optional values are there; a `SectionMaterial` makes a scene
            of deforming cross-sections.
        path: what the plan is made for; other paths may follow if they need no more. Several tools
            have a mapping of their names to paths: they move side by side and feel one another.
        tool: with its friction, or its shape alone, in any dtype: the scene has that of
            `geometry`; a shape is needed for `Poses`. For a mapping of paths a mapping of the same
            names; None for presses.
        mesh: the surface; without one `effects.want_surface` must be false. Of deforming
            cross-sections a straight one only follows: a tool touches a round wall of `radius`.
        radius: of the tube's outside, mm; None: of a `SectionMaterial` that of its mid-line and
            offset; else that of the mesh (of an imported one it is
            `geometry.radius`); without a mesh as much larger than `geometry.radius` as in Table 1
            (12.6 of 11.3 mm).
        effects: what is not left to the rules.
        progress: called with (patches of the wall done since the last call, patches in all).

    Raises:
        PlanError: a wish that cannot be met, such as several tools where contacts are not coupled.
        MeshError: patches for the contact that are not where the mesh is.
        SizeError: a length that no trachea and no tool has: the unit is wrong, most likely; a
            `half_width` beyond the tool.
        ValueError: a path without rows, arrays of a wrong length, or matrices of the path that are
            no rotations; what is no tube, material, path, tool, mesh or no options; more than 16
            tools, tools and paths of different names, two tools on one and the same path.
    """
    paths, tools = _named(path, tool)
    check_material(geometry, material)
    check_word("mesh", mesh, Mesh | None)
    check_word("effects", effects, EffectOptions)
    dtype = geometry.length.dtype
    shapes = {n: jax.tree.map(lambda v: jnp.asarray(v, dtype), t.shape) for n, t in tools.items()}
    sections = not level_type(material).hangs_on_rings
    outer = _outside(geometry, material, mesh) if radius is None else jnp.asarray(radius, dtype)
    check_tube(geometry, effects.onset_width, effects.transition)
    for shape in shapes.values():
        check_sizes(geometry, float(outer), shape)
    tube = None
    if isinstance(next(iter(paths.values())), Poses):
        if any(shape is None for shape in shapes.values()):
            raise PlanError("contact", "the path moves a tool", "there is none", "give a tool")
        if mesh is None or (sections and mesh.frames is None):
            tube = round_wall(geometry, float(outer))
        else:
            tube = checked_walls(geometry, mesh, progress)
    _check_friction(tools, effects)
    kinds: dict[str, Any] = {n: t.contact or effects.contact for n, t in tools.items()}
    mixed = len(set(kinds.values())) > 1
    of_all = "unilateral" if mixed else next(iter(kinds.values()))
    effects = dataclasses.replace(effects, contact=of_all)
    instruments = []
    for name, shape in shapes.items():
        near, quality, mu = 1, STANDARD, tools[name].friction
        if shape is not None and tube is not None:
            near = near_patches(shape, geometry, tube.centres.shape[0])
            quality = contact_settings(shape, geometry)
        instruments.append(Instrument(
            name=name, tool=shape, friction=None if mu is None else jnp.asarray(mu, dtype),
            footprint=jnp.asarray(_footprint(shape, float(outer)), dtype), near=near,
            quality=quality, contact=kinds[name] if mixed else None,
        ))  # fmt: skip
    binding = None if mesh is None or sections else regions.bind(mesh, geometry)
    spacing = max((instrument.footprint for instrument in instruments), key=float)
    scene = Scene(
        geometry=geometry, radius=outer, tube=tube, tool=None, friction=None, mesh=mesh,
        binding=binding, footprint=spacing, near=1,
        plan=make_plan(SceneFacts(mesh=False), EffectOptions(want_surface=False)),  # not read
    )  # fmt: skip
    each = [scene_of(scene, instrument) for instrument in instruments]
    facts = facts_together([
        facts_of(view, material, paths[name], bonded=kinds[name] == "bonded", several=len(each) > 1)
        for view, name in zip(each, kinds, strict=True)
    ], glued=mixed)  # fmt: skip
    if isinstance(path, Mapping):
        scene = dataclasses.replace(scene, instruments=tuple(instruments))
    else:
        scene = each[0]
    plan = make_plan(facts, effects)
    for shape in shapes.values():
        check_width(geometry, shape, plan.options.half_width)
    if plan.surface is None or mesh is None:
        return dataclasses.replace(scene, mesh=None, binding=None, plan=plan)
    runs, points = local.runs(mesh.s, spacing), _points(mesh) if sections else None
    return dataclasses.replace(scene, plan=plan, runs=runs, points=points)


def _named(path, tool) -> tuple[dict[str, Poses | Presses], dict[str, Tool]]:
    """Checked paths and tools by name; of a bare path by the empty one."""
    if not isinstance(path, Mapping):
        check_path(path)
        check_word("tool", tool, Tool | Shape | None)
        paths, tools = {"": path}, {"": tool}
    else:
        if not 1 <= len(path) <= MOST_TOOLS:
            raise ValueError(f"path has {len(path)} tools; expected 1 to {MOST_TOOLS}")
        names = [*path]
        if tool is not None and not isinstance(tool, Mapping):
            raise ValueError(
                f"tool is {type(tool).__name__}; expected a mapping of the names of the paths: "
                f"{', '.join(map(repr, names))}"
            )
        paths = dict(zip(names, paths_in_order(names, path), strict=True))
        tools = dict.fromkeys(names) if tool is None else dict(tool)
        if set(tools) != set(names):
            raise ValueError(
                f"tool has the names {', '.join(map(repr, tools))}; expected those of the paths: "
                f"{', '.join(map(repr, names))}"
            )
        for name in names:
            check_word(f"tool {name!r}", tools[name], Tool | Shape | None)
        _check_apart(paths)
        tools = {name: tools[name] for name in names}
    if not min(map(rows_of, path.values() if isinstance(path, Mapping) else [path])):
        raise ValueError("path has no rows; expected at least one")
    return paths, {n: t if isinstance(t, Tool) else Tool(t) for n, t in tools.items()}


def _check_friction(tools: Mapping[str, Tool], effects: EffectOptions) -> None:
    """Refuse friction of some tools alone, or with glued ones: none that is given is left out."""
    without = [name for name, tool in tools.items() if tool.friction is None]
    glued = [n for n, t in tools.items() if (t.contact or effects.contact) == "bonded"]
    why, cure = "", "leave tool.friction out, or set friction 'off'"
    if glued and effects.friction != "off":
        why = f"tool {glued[0]!r}" if glued[0] else "the tool"
        why += " is glued, and friction beside glued tools, or of one, is not derived"
    elif without and effects.friction == "auto":
        why = f"tool {without[0]!r} has none"
        cure = "give each tool its friction (0: it slides freely), or set friction 'off'"
    if why and len(without) < len(tools):
        raise PlanError("friction", "a tool has a coefficient", why, cure)


def _check_apart(paths: Mapping[str, Poses | Presses]) -> None:
    """Refuse two tools that are on one and the same path throughout."""
    seen: dict[bytes, str] = {}
    for name, path in paths.items():
        key = b"".join(np.asarray(v).tobytes() for v in jax.tree.leaves(path))
        if key in seen:
            raise ValueError(
                f"path of tool {name!r} is that of {seen[key]!r} in every row; expected tools in "
                "different places: lead one of them elsewhere, or leave it out"
            )
        seen[key] = name


def _points(mesh: Mesh) -> Points:
    """Vertices on the wall of deforming cross-sections."""
    return gather_points(mesh.s, mesh.phi, mesh.distance)


def _footprint(tool: Shape | None, outer: float) -> float:
    """Distance between the circles of the dent's centres, mm, on a tube of this outer radius."""
    least = LEAST * (outer / OUTER)
    if tool is None:
        return least
    extent = max(
        np.ptp(np.asarray(part.vertices), axis=1).min() / 2 + float(part.radius)
        for part in parts_of(tool)
    )
    return max(FOOTPRINT * extent, least)


def _outside(geometry: Geometry, material: AnyMaterial, mesh: Mesh | None):
    """Radius of the outside, mm: half of the wall's thickness beyond its mid-line, if it has one.

    Else of an imported mesh that read with it, of a made one that of its crests.
    """
    thickness = level_type(material).thickness(long_run(material))
    if thickness is not None:
        return geometry.radius + thickness / 2
    if mesh is None:
        return geometry.radius + (OUTER - RADIUS) * (geometry.radius / RADIUS)
    return geometry.radius if mesh.frames is not None else jnp.asarray(np.max(mesh.distance))


def with_geometry(scene: Scene, geometry: Geometry) -> Scene:
    """The scene with another skeleton: the surface is bound to it anew, the wall stays as it is.

    May be traced; derivatives of the surface by geometry go through this. (A new geometry put into
    the scene by hand leaves the surface on the old rings.)
    """
    binding = None
    if scene.mesh is not None and scene.plan.mechanics.hangs_on_rings:
        binding = regions.bind(scene.mesh, geometry, scene.binding)
    return dataclasses.replace(scene, geometry=geometry, binding=binding)


def with_tool(scene: Scene, tool: Shape) -> Scene:
    """The scene with a tool of another size (concrete numbers) and the same program.

    Raises:
        ValueError: more or fewer corners or parts than the tool before, another dtype, or so large
            that the program searches too few patches or moves too few vertices.
        SizeError: larger than any tool, or smaller than its width (`half_width`).
    """
    before, tube, geometry = scene.tool, scene.tube, scene.geometry
    if not isinstance(tool, Shape):
        raise ValueError(f"tool is {type(tool).__name__}; expected a Shape")
    if before is None or tube is None:
        raise ValueError("the scene has no tool; make it with one and a path of Poses")
    if (tool.counts is None) != (before.counts is None):
        raise ValueError(f"tool has corners that only fill up, or has none, unlike before: {CURE}")
    for name in ("vertices", "radius") + (("counts",) if tool.counts is not None else ()):
        check_fits(f"tool.{name}", getattr(tool, name), getattr(before, name), CURE)
    check_sizes(geometry, float(scene.radius), tool)
    check_width(geometry, tool, scene.plan.options.half_width)
    near = near_patches(tool, geometry, tube.centres.shape[0])
    if near > scene.near:
        raise ValueError(
            f"tool lies along up to {near} patches of the wall, and the program searches "
            f"{scene.near}: {CURE}"
        )
    steps, needed = (contact_settings(t, geometry).warm_steps for t in (before, tool))
    if needed > max(steps, scene.quality.warm_steps):
        raise ValueError(f"tool is so long that a contact takes {needed} steps: {CURE}")
    spacing = jnp.asarray(_footprint(tool, float(scene.radius)), scene.footprint.dtype)
    if scene.plan.dent and scene.runs is not None and scene.mesh is not None:
        reached = local.runs(scene.mesh.s, spacing).longest
        if any(a > b for a, b in zip(reached, scene.runs.longest, strict=True)):
            raise ValueError(f"the dent of tool is wider than the program's: {CURE}")
    return dataclasses.replace(scene, tool=tool, footprint=spacing)


def with_mesh(scene: Scene, mesh: Mesh) -> Scene:
    """The scene with another surface: bound to the rings, and the wall that a tool touches.

    The program stays, but for `curved`, which says what the mesh is.

    Raises:
        MeshError: patches for the contact that are not where the mesh is.
    """
    curved = scene.plan.contact and mesh.frames is not None
    plan = dataclasses.replace(scene.plan, curved=curved)
    bound, tube, binding = scene.plan.mechanics.hangs_on_rings, scene.tube, None
    if tube is not None and (bound or mesh.frames is not None):
        tube = checked_walls(scene.geometry, mesh)
    if bound:
        binding = regions.bind(mesh, scene.geometry)
    return dataclasses.replace(
        scene, mesh=mesh, binding=binding, tube=tube, plan=plan,
        runs=local.runs(mesh.s, scene.footprint), points=None if bound else _points(mesh),
    )  # fmt: skip
