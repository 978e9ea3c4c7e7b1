"""A scene put together: what is there, its program, and the same with another skeleton or mesh."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._arguments import check_fits, check_word
from jaxtrachea.contact.search import STANDARD
from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.mechanics.levels.choose import AnyMaterial, level_type
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.mechanics.sections.wall import Points, gather_points
from jaxtrachea.scene.declare import PlanError, SceneFacts
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.facts import facts_of
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.sizes import OUTER, RADIUS, check_sizes, check_width
from jaxtrachea.scene.stage import Poses, Presses, Scene, Tool, check_material, check_path
from jaxtrachea.scene.wall import checked_walls, contact_settings, near_patches, round_wall
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh

#: Distance between the circles of the dent's centres: share of the tool's size; at least, on Table
#: 1's tube, mm.
FOOTPRINT, LEAST = 0.6, 4.0
#: Of a tool that a program does not fit.
CURE = "make a scene for this tool (a program for the largest tool serves smaller ones)"


def make_scene(
    geometry: Geometry,
    material: AnyMaterial,
    path: Poses | Presses,
    *,
    tool: Tool | Shape | None = None,
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
        path: what the plan is made for; other paths may follow if they need no more.
        tool: with its friction, or its shape alone, in any dtype: the scene has that of
            `geometry`; a shape is needed for `Poses`.
        mesh: the surface; without one `effects.want_surface` must be false. Of deforming
            cross-sections a straight one only follows: a tool touches a round wall of `radius`.
        radius: of the tube's outside, mm; None: of a `SectionMaterial` that of its mid-line and
            offset; else that of the mesh (of an imported one it is
            `geometry.radius`); without a mesh as much larger than `geometry.radius` as in Table 1
            (12.6 of 11.3 mm).
        effects: what is not left to the rules.
        progress: called with (patches of the wall done since the last call, patches in all).

    Raises:
        PlanError: a wish that cannot be met.
        MeshError: patches for the contact that are not where the mesh is.
        SizeError: a length that no trachea and no tool has: the unit is wrong, most likely; a
            `half_width` beyond the tool.
        ValueError: a path without rows, arrays of a wrong length, or matrices of the path that are
            no rotations; what is no tube, material, path, tool, mesh or no options.
    """
    check_path(path)
    check_material(geometry, material)
    check_word("tool", tool, Tool | Shape | None)
    check_word("mesh", mesh, Mesh | None)
    check_word("effects", effects, EffectOptions)
    if not len(path.s if isinstance(path, Presses) else path.translation):
        raise ValueError("path has no rows; expected at least one")
    tool = tool if isinstance(tool, Tool) else Tool(tool)
    dtype = geometry.length.dtype
    shape = jax.tree.map(lambda v: jnp.asarray(v, dtype), tool.shape)
    friction = tool.friction
    kind = level_type(material)
    own, sections = kind.thickness(long_run(material)), not kind.hangs_on_rings
    if radius is None and own is not None:
        outer = geometry.radius + own / 2
    else:
        outer = _outer(geometry, mesh) if radius is None else jnp.asarray(radius, dtype)
    check_sizes(geometry, float(outer), shape)
    if isinstance(path, Poses) and shape is None:
        raise PlanError("contact", "the path moves a tool", "there is none", "give a tool")
    tube, near, quality = None, 1, STANDARD
    if shape is not None and isinstance(path, Poses):
        if mesh is None or (sections and mesh.frames is None):
            tube = round_wall(geometry, float(outer))
        else:
            tube = checked_walls(geometry, mesh, progress)
        near = near_patches(shape, geometry, tube.centres.shape[0])
        quality = contact_settings(shape, geometry)
    mu = None if friction is None else jnp.asarray(friction, dtype)
    binding = None if mesh is None or sections else regions.bind(mesh, geometry)
    spacing = jnp.asarray(_footprint(shape, float(outer)), dtype)
    scene = Scene(
        geometry=geometry, radius=outer, tube=tube, tool=shape, friction=mu, mesh=mesh,
        binding=binding, footprint=spacing, near=near, quality=quality,
        plan=make_plan(SceneFacts(mesh=False), EffectOptions(want_surface=False)),  # not read
    )  # fmt: skip
    facts = facts_of(scene, material, path, bonded=effects.contact == "bonded")
    plan = make_plan(facts, effects)
    check_width(geometry, shape, plan.options.half_width)
    if plan.surface is None or mesh is None:
        return dataclasses.replace(scene, mesh=None, binding=None, plan=plan)
    runs, points = local.runs(mesh.s, spacing), _points(mesh) if sections else None
    return dataclasses.replace(scene, plan=plan, runs=runs, points=points)


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


def _outer(geometry: Geometry, mesh: Mesh | None):
    """Radius of the outside, mm: of an imported mesh read with it, of a made one its crests."""
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
