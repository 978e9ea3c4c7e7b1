"""The scene as arrays: trachea, tool, surface, path; and the facts the plan is made from."""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._arguments import real, shaped
from jaxtrachea.contact.patches import Patches, Touch, straight_patches, touch
from jaxtrachea.contact.pose import Pose, inverse, transform
from jaxtrachea.contact.search import STANDARD, Settings
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.contact.walls import patches_of
from jaxtrachea.mechanics.admission import check_shapes
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene import wall_check
from jaxtrachea.scene.curve import frame_at
from jaxtrachea.scene.plan import Facts, Plan, PlanError, Wishes
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.sizes import check_sizes
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import OPTIONAL, Material
from jaxtrachea.trachea.mesh import Mesh

#: What counts as a normal press on the midline and as one contact point: rad, mm, and share of the
#: motion. Patches of a mesh with a mirror plane are not its mirror images to the last corner: a
#: tool in the plane touches up to 2e-5 rad beside it.
COVERED = 1e-4

#: Distance between the circles of the dent's centres: share of the tool's size; mm at least.
FOOTPRINT, LEAST = 0.6, 4.0

#: Wall of Table 1, mm, where nothing else is known of it.
WALL = 2.6
#: Patches of the tube searched for a contact with a tool shorter than one of them.
NEAR = 2
#: Patches of a mesh: their rounding, and corners of each (docs/scenes.md says what that loses).
ROUNDED, CORNERS = 0.15, 128
#: Longest patch over the usual distance of the rings (at most the radius): beyond the last ring a
#: tube goes on, and one patch would bridge its bend.
LONGEST = 1.5


class Presses(eqx.Module):
    """Presses at known contact points.

    Attributes:
        s: contact position, mm; shape (rows,).
        phi: contact angle from the anterior midline, rad; shape (rows,).
        displacement: of the tool along x (to the larynx), y (anterior), z, mm; shape (rows, 3).
    """

    s: Float[Array, " rows"] = eqx.field(converter=partial(real, "s"))
    phi: Float[Array, " rows"] = eqx.field(converter=partial(real, "phi"))
    displacement: Float[Array, "rows 3"] = eqx.field(converter=partial(real, "displacement"))


class Poses(eqx.Module):
    """A tool's positions in the frame of the mesh (without one: of the tube), in order.

    Attributes:
        rotation: shape (rows, 3, 3).
        translation: of the tool's origin, mm; shape (rows, 3).
    """

    rotation: Float[Array, "rows 3 3"] = eqx.field(converter=partial(real, "rotation"))
    translation: Float[Array, "rows 3"] = eqx.field(converter=partial(real, "translation"))


def check_path(path: Presses | Poses) -> None:
    """Refuse a path whose arrays do not belong together.

    Raises:
        ValueError: the argument, its length and the expected one.
    """
    if isinstance(path, Presses):
        rows = shaped("path.s", path.s, ("rows",)).shape[0]
        shaped("path.phi", path.phi, (rows,), why=" (as path.s has)")
        shaped("path.displacement", path.displacement, (rows, 3), why=" (rows as path.s has)")
    else:
        rows = shaped("path.translation", path.translation, ("rows", 3)).shape[0]
        why = " (rows as path.translation has)"
        shaped("path.rotation", path.rotation, (rows, 3, 3), why=why)


class Scene(eqx.Module):
    """Everything of a scene but its material and its path.

    Attributes:
        geometry: the tube at rest.
        radius: of the tube's outside, where a tool touches it and the dent lies, mm.
        tube: its outside as convex patches, for a tool; or None.
        near: number of patches searched for a contact (static).
        tool: its shape about its own origin, or None.
        friction: Coulomb's coefficient of the tool, or None.
        mesh: the surface at rest, or None.
        binding: of the mesh, or None.
        footprint: distance between the circles of the dent's centres, mm.
        runs: order of the mesh's vertices, for a dent of this footprint; or None.
        plan: the program (static).
        quality: accuracy and work of the search for a contact (static).
    """

    geometry: Geometry
    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    tube: Patches | None
    tool: Shape | None
    friction: Float[Array, ""] | None
    mesh: Mesh | None
    binding: regions.Binding | None
    footprint: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    near: int = eqx.field(static=True)
    plan: Plan = eqx.field(static=True)
    quality: Settings = eqx.field(static=True, default=STANDARD)
    runs: local.Runs | None = None


def touch_tube(scene: Scene, path: Poses) -> Touch:
    """Contact of the tool with the tube at rest, row by row, batched.

    The tube is that of the mesh; without a mesh a straight cylinder of `scene.radius`.

    Raises:
        ValueError: no tool.
    """
    if scene.tool is None or scene.tube is None:
        raise ValueError("scene.tool is None; contact needs a tool")
    tool, tube = scene.tool, scene.tube
    one = lambda R, T: touch(tool, Pose(R, T), tube, scene.quality, near=scene.near)  # noqa: E731
    return jax.vmap(one)(path.rotation, path.translation)


def followed(path: Poses, seen: Touch, first, inward, frame):
    """Displacement of the tool's material point that touches first, from its first touch on.

    Before the row of first touch the tool came in a straight line from the last row that is finite:
    the part of that step which it still went along the surface counts, so that a finer path changes
    nothing.

    Args:
        path: of the tool.
        seen: its contact with the tube at rest, row by row.
        first: row of first touch.
        inward: normal of the straight tube there; shape (3,).
        frame: of the centreline there, as columns; None: the tube is straight.

    Returns:
        mm, along (tangent, anterior, lateral); shape (rows, 3).
    """
    row = jnp.arange(seen.gap.shape[0])
    earlier = jnp.max(jnp.where((row < first) & ~jnp.isnan(seen.gap), row, -1))
    before = jnp.where(earlier < 0, first, earlier)
    pose = Pose(at_row(path.rotation, first), at_row(path.translation, first))
    body = transform(inverse(pose), at_row(seen.tool_point, first)[:, None])[:, 0]
    points = jax.vmap(lambda R, T: R @ body + T)(path.rotation, path.translation)
    way = points - at_row(points, first)[None]
    if frame is not None:
        way = way @ frame
    gap = at_row(seen.gap, first)
    closing = at_row(seen.gap, before) - gap
    left = jnp.where(closing > 0, -gap / jnp.where(closing > 0, closing, 1), 0)
    step = -at_row(way, before)
    step = step - jnp.dot(step, inward) * inward
    return way + (left * step - gap * inward)[None]


def at_row(v, row):
    """One row, of a traced number."""
    return jax.lax.dynamic_index_in_dim(v, row, keepdims=False)


def make_scene(
    geometry: Geometry,
    material: Material,
    path: Poses | Presses,
    *,
    tool: Shape | None = None,
    friction: float | None = None,
    mesh: Mesh | None = None,
    radius: float | None = None,
    wishes: Wishes = Wishes(),  # noqa: B008 (frozen)
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Put a scene together and choose its program from the path (concrete numbers).

    Args:
        geometry: the tube at rest.
        material: read only for which optional values are there.
        path: what the plan is made for; other paths may follow if they need no more.
        tool: needed for `Poses`.
        friction: Coulomb's coefficient.
        mesh: the surface; without one `wishes.want_surface` must be false.
        radius: of the tube's outside, mm; None: that of the mesh (of an imported one it is
            `geometry.radius`); without a mesh `geometry.radius` + 1.3 (half of Table 1's wall).
        wishes: what is not left to the rules.
        progress: called with (patches of the wall done since the last call, patches in all).

    Raises:
        PlanError: a wish that cannot be met.
        MeshError: patches for the contact that are not where an imported mesh is.
        SizeError: a length that no trachea and no tool has: the unit is wrong, most likely.
        ValueError: a path without rows, arrays of a wrong length, or a negative friction.
    """
    check_path(path)
    check_shapes(geometry, material)
    if not len(path.s if isinstance(path, Presses) else path.translation):
        raise ValueError("path has no rows; expected at least one")
    if friction is not None and not 0 <= float(friction) < np.inf:
        raise ValueError(f"friction is {friction}; expected a finite number, not negative")
    dtype = geometry.length.dtype
    outer = _outer(geometry, mesh) if radius is None else jnp.asarray(radius, dtype)
    check_sizes(geometry, float(outer), tool)
    if isinstance(path, Poses) and tool is None:
        raise PlanError("contact: the path moves a tool, but there is none; give a tool")
    size, tube, near = LEAST, None, 1
    if tool is not None and isinstance(path, Poses):
        if mesh is None:
            tube = _round(geometry, float(outer))
        else:
            tube = _checked_walls(geometry, mesh, progress)
        near = _near_patches(tool, geometry, tube.centres.shape[0])
    if tool is not None:
        extent = np.ptp(np.asarray(tool.vertices), axis=1).min() / 2 + float(tool.radius)
        size = max(FOOTPRINT * extent, LEAST)
    mu = None if friction is None else jnp.asarray(friction, dtype)
    binding = None if mesh is None else regions.bind(mesh, geometry)
    spacing = jnp.asarray(size, dtype)
    placeholder = make_plan(Facts(mesh=mesh is not None), Wishes(want_surface=False))
    fixed = geometry, outer, tube, tool, mu
    scene = Scene(*fixed, mesh, binding, spacing, near, placeholder)
    plan = make_plan(facts_of(scene, material, path), wishes)
    if plan.surface is None or mesh is None:
        return Scene(*fixed, None, None, spacing, near, plan)
    return Scene(*fixed, mesh, binding, spacing, near, plan, runs=local.runs(mesh.s, spacing))


def _outer(geometry: Geometry, mesh: Mesh | None):
    """Radius of the outside, mm: of an imported mesh read with it, of a made one its crests."""
    if mesh is None:
        return geometry.radius + WALL / 2
    return geometry.radius if mesh.frames is not None else jnp.max(mesh.distance)


def with_geometry(scene: Scene, geometry: Geometry) -> Scene:
    """The scene with another skeleton: the surface is bound to it anew, the wall stays as it is.

    May be traced; derivatives of the surface by geometry go through this. (A new geometry put into
    the scene by hand leaves the surface on the old rings.)
    """
    binding = None
    if scene.mesh is not None:
        binding = regions.bind(scene.mesh, geometry, scene.binding)
    return dataclasses.replace(scene, geometry=geometry, binding=binding)


def with_mesh(scene: Scene, mesh: Mesh) -> Scene:
    """The scene with another surface: bound to the rings, and the wall that a tool touches.

    The program stays, but for `curved`, which says what the mesh is.

    Raises:
        MeshError: patches for the contact that are not where an imported mesh is.
    """
    curved = scene.plan.contact and mesh.frames is not None
    plan = dataclasses.replace(scene.plan, curved=curved)
    tube = None if scene.tube is None else _checked_walls(scene.geometry, mesh)
    binding, runs = regions.bind(mesh, scene.geometry), local.runs(mesh.s, scene.footprint)
    parts = {"mesh": mesh, "binding": binding, "tube": tube, "runs": runs, "plan": plan}
    return dataclasses.replace(scene, **parts)


def _round(geometry: Geometry, radius: float) -> Patches:
    """A straight cylinder, in patches about as long as it is wide: so their rounding is small."""
    length = float(geometry.length)
    borders = np.linspace(0, length, max(round(length / (2 * float(geometry.radius))), 1) + 1)
    return straight_patches(borders, radius, dtype=geometry.length.dtype)


def _checked_walls(geometry: Geometry, mesh: Mesh, progress=None) -> Patches:
    """The wall of a mesh; that of an imported one is checked against its triangles."""
    tube = _walls(geometry, mesh, progress)
    if mesh.frames is None:
        return tube
    wall_check.check(mesh, geometry, tube)
    doubtful = wall_check.look_beyond(mesh, geometry, tube).doubtful
    return dataclasses.replace(tube, doubtful=jnp.asarray(doubtful)) if doubtful.any() else tube


def _walls(geometry: Geometry, mesh: Mesh, progress=None) -> Patches:
    """The surface of a mesh, cut midway between the rings: each patch bulges with its ring.

    Spans longer than `LONGEST` says are cut evenly.
    """
    numbers = (mesh.vertices, mesh.faces, mesh.s, mesh.phi, mesh.distance)
    vertices, faces, s, phi, distance = (np.asarray(v) for v in numbers)
    centres = frames = None
    if mesh.frames is not None:
        frames = np.asarray(mesh.frames)
        across = np.stack([distance * np.cos(phi), distance * np.sin(phi)], axis=1)
        centres = vertices - np.einsum("vij,vj->vi", frames[:, :, 1:], across)
    ring = np.asarray(geometry.ring_positions, float)
    ends = max(float(s.min()), 0.0), min(float(s.max()), float(geometry.length))
    between = (ring[1:] + ring[:-1]) / 2
    borders = np.array([ends[0], *between[(between > ends[0]) & (between < ends[1])], ends[1]])
    usual = wall_check.spacing_of(geometry)
    parts = np.ceil(np.diff(borders) / (LONGEST * usual) - 1e-4).astype(int)
    spans = zip(borders[:-1], borders[1:], np.maximum(parts, 1), strict=True)
    borders = np.concatenate([*(np.linspace(a, b, n + 1)[:-1] for a, b, n in spans), borders[-1:]])
    return patches_of(
        vertices, faces, s, borders, centres=centres, frames=frames, rounding=ROUNDED, most=CORNERS,
        overlap=wall_check.overlap_of(geometry), dtype=geometry.length.dtype, progress=progress,
    )  # fmt: skip


def _near_patches(tool: Shape, geometry: Geometry, count: int) -> int:
    """As many patches as the tool can lie along, and one more."""
    length = np.ptp(np.asarray(tool.vertices), axis=1).max() + 2 * float(tool.radius)
    return min(NEAR + int(length * count / float(geometry.length)), count)


def facts_of(scene: Scene, material: Material, path: Poses | Presses) -> Facts:
    """What the rules need to know of a scene and its path."""
    curved = scene.mesh is not None and scene.mesh.frames is not None
    if isinstance(path, Poses):
        seen = jax.jit(touch_tube)(scene, path)
        gap, s, phi = (np.asarray(v, float) for v in (seen.gap, seen.s, seen.phi))
        touching = gap < 0
        row = int(np.argmax(touching)) if touching.any() else int(np.argmin(gap))
        frame = None
        if curved and scene.tube is not None:
            frame = frame_at(scene.tube.line, seen.s[row])
        moved = followed(path, seen, jnp.asarray(row), local_frame(seen.phi[row])[0], frame)
        moved, at = np.asarray(moved, float), slice(row, row + 1)
    else:
        s, phi, moved = (np.asarray(v, float) for v in (path.s, path.phi, path.displacement))
        touching, at = np.ones(len(s), bool), slice(None)
    here = np.broadcast_to(phi[at], s.shape)
    across = np.abs(moved[:, 2] * np.cos(here) - moved[:, 1] * np.sin(here))
    along, way = np.abs(moved[:, 0]), np.sqrt((moved**2).sum(axis=1))
    whole = max(way[touching].max(initial=0), 1e-9)  # not what the tool goes before it touches
    share = lambda v: float(v.max(initial=0) / whole)  # noqa: E731
    keep = lambda v: v if v > COVERED else 0.0  # noqa: E731
    angles = np.abs(phi[touching])
    slip = np.hypot(along, across)[touching].max(initial=0)
    x = np.asarray(scene.geometry.ring_positions, float)
    return Facts(
        poses=isinstance(path, Poses),
        angle=keep(float(angles.max(initial=0))),
        seats=bool(np.ptp(s[touching]) + np.ptp(phi[touching]) > COVERED * whole)
        if touching.any() else False,
        along=keep(share(along[touching])),
        across=keep(share(across[touching])),
        slip=float(slip) if slip > COVERED * whole else 0.0,
        spacing=float(np.diff(x).min()) if len(x) > 1 else float(scene.geometry.length),
        friction=scene.friction is not None,
        known=frozenset(name for name in OPTIONAL if getattr(material, name) is not None),
        mesh=scene.mesh is not None,
        curved=curved,
        near=_near(scene, s, phi),
    )  # fmt: skip


def _near(scene: Scene, s, phi) -> bool:
    """Whether a vertex lies within the reach of a dent at any of the contacts."""
    if scene.mesh is None:
        return False
    r = float(scene.radius)
    C = np.stack([s, r * np.cos(phi), r * np.sin(phi)], axis=1)
    points, reach = np.asarray(scene.mesh.straight, float), local.REACH * float(scene.footprint)
    return any(bool((np.sum((points - c) ** 2, axis=1) < reach**2).any()) for c in C)
