"""From forces and skeleton to the deformed surface: global shape, and the dent under the tool."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxtrachea._numerics import full_precision, product
from jaxtrachea.contact.distance import approach
from jaxtrachea.contact.pose import Pose, inverse, transform
from jaxtrachea.contact.shapes import Shape, sphere
from jaxtrachea.fusion import one_by_one
from jaxtrachea.mechanics.sections.wall import Points, around, wall_motion
from jaxtrachea.mechanics.validation import has_solution
from jaxtrachea.scene import trail
from jaxtrachea.scene.approach import Approach, backed_out
from jaxtrachea.scene.curve import distance_from, lay
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.mesh import place


@full_precision
def deform(scene: Scene, presses: Presses, moved: Any, path: Any, made: Approach | None):
    """Deformed vertices, row by row; shape (rows, vertices, 3), in the frame of the mesh.

    Args:
        scene: with a surface in its plan.
        presses: -
        moved: what the skeleton does, row by row; fields as in `simulation.Simulation`.
        path: of the tool; read only if `made` is there.
        made: how the tool comes, or None for presses at given points.
    """
    plan, mesh, binding = scene.plan, scene.mesh, scene.binding
    if mesh is None or binding is None or plan.surface is None or plan.surface == "sections":
        raise ValueError("scene.mesh or scene.binding is None; the plan has a surface")
    method = plan.surface
    straight, (runs, radius, tool) = mesh.straight, dent_parts(scene, path, made)
    where = presses.s, presses.phi, radius, tool
    together = plan.contact_point == "fixed"
    if together:  # one contact point for all rows: what depends on it alone is computed once
        where = jax.tree.map(lambda v: v[0], where)
    slides = plan.friction and runs is not None

    def one(moved, where, pose, share):
        s_c, phi_c, radius, tool = where
        keys = regions.clamped(
            _held_at(scene, s_c), moved.skeleton, moved.joints, moved.end_U, moved.end_V,
            moved.slopes, moved.slope_C if moved.slope_edges is None else moved.slope_edges,
            clamps=moved.clamps,
        )  # fmt: skip
        share = regions.weigh(binding, phi_c) if share is None else share
        u = regions.interpolate(binding, share, keys, method=method)
        if runs is None:
            return place(mesh, u)
        dent = _dent(scene, s_c, phi_c, radius, tool, moved.depth)
        if slides:
            r = scene.radius if radius is None else radius
            s_c, turned = trail.slid(s_c, phi_c, r, moved.slip)
            dent = trail.lay_at(dent, s_c - where[0], turned - phi_c)
        dented = place(mesh, local.add_correction(u, dent, straight, runs, s_c))
        if pose is None or scene.tool is None:
            return dented
        near = jnp.sum((straight - dent.centres[:1]) ** 2, axis=1)
        sunk = place(mesh, u)
        return sunk + trail.scale_to_touch(scene.tool, pose, near, sunk, dented) * (dented - sunk)

    moved = moved._replace(force=None, loads=None, dissipated=None, status=None)
    led = path if slides and made is not None else None
    share = regions.weigh(binding, where[1]) if together else None

    def row(moved, own, pose):
        return one(moved, where if together else own, pose, share)

    return one_by_one(row, moved, None if together else where, led)


def _held_at(scene: Scene, s_c):
    """Where the tool holds the ligament, mm: at the contact, or at both edges of its width."""
    half = scene.plan.options.half_width
    return jnp.stack([s_c - half, s_c + half]) if half > 0 else s_c


@full_precision
def deform_sections(scene: Scene, presses: Presses, moved: Any, path: Any, made: Approach | None):
    """Deformed vertices of a wall of deforming cross-sections; as `deform`.

    The dent is what the wall at the contact lacks of the tool's way: the local indentation, and
    what a tool that rests on a ring moves beside it. Rows are computed one after the other: the
    sections of all vertices would be a lot of memory for long paths. Those without a solution are
    computed at rest and hidden then: by 0 times NaN they would reach the derivatives of the others.
    """
    plan, mesh, points = scene.plan, scene.mesh, scene.points
    if mesh is None or points is None:
        raise ValueError("scene.mesh or scene.points is None; the plan has a surface")
    straight, (runs, radius, tool) = mesh.straight, dent_parts(scene, path, made)
    phi = presses.phi if plan.second_plane else jnp.zeros_like(presses.phi)
    shape = scene.geometry.radius, scene.geometry.half_angle
    at_rest = around(points, *shape)

    def contact(phi_c):
        C = Points(points.s, jnp.full(1, points.s.shape[0]), phi_c[None], scene.radius[None])
        return around(C, *shape)

    def one(row):
        along, way, s_c, phi_c, C, radius, tool = row
        both = jax.tree.map(lambda *v: jnp.concatenate(v), at_rest, C)
        u = wall_motion(along, both, phi_c, *shape)
        if runs is None:
            return place(mesh, u[:-1])
        dent = _dent(scene, s_c, phi_c, radius, tool, way - u[-1])
        return place(mesh, local.add_correction(u[:-1], dent, straight, runs, s_c))

    solved = has_solution(moved.status)

    def rows(v, otherwise):
        return jnp.where(solved.reshape(-1, *[1] * (v.ndim - 1)), v, otherwise)

    seen = moved.along, moved.depth + moved.skeleton
    along, way = jax.tree.map(lambda v: rows(v, 0), seen)
    C = jax.vmap(contact)(phi)
    vertices = jax.lax.map(one, (along, way, presses.s, phi, C, radius, tool))
    return rows(vertices, jnp.nan)


def dent_parts(scene: Scene, path: Any, made: Approach | None):
    """Order of the vertices, distance of the contacts from the centreline and the tool backed out.

    None: without a dent; what a dent without the tool's shape does not need.
    """
    plan = scene.plan
    if not plan.dent:
        return None, None, None
    if scene.runs is None:
        raise ValueError("scene.runs is None; the plan has a dent")
    if plan.dent <= 8 or made is None:
        return scene.runs, None, None
    return scene.runs, _distances(scene, made), backed_out(path, made)


def _distances(scene: Scene, made: Approach):
    """Distance of the contacts from the centreline, mm; of the first for all if they share it."""
    assert scene.tube is not None
    line, seen = scene.tube.line, made.seen
    if made.landing is None:
        return jax.vmap(lambda s, point: distance_from(line, s, point))(seen.s, seen.point)
    found = distance_from(line, made.landing.s, made.landing.point)
    return jnp.broadcast_to(found, seen.s.shape)


def _dent(scene: Scene, s_c, phi_c, radius, tool: Poses | None, depth) -> local.Dent:
    """The local correction for one row."""
    count, spacing = scene.plan.dent, scene.footprint

    def centres(s_c, phi_c, radius):
        return local.centres(s_c, phi_c, radius, spacing, count)

    def evenly(depth):
        return local.shares(depth, jnp.zeros(count, depth.dtype))

    def lay_out(s_c, phi_c, radius, tool, depth):
        where = centres(s_c, phi_c, radius)
        bent = scene.tube if scene.plan.curved else None
        off = sag(scene.tool, tool, where if bent is None else lay(bent.line, where))
        return where, local.shares(depth, off)

    radius = scene.radius if radius is None else radius
    if tool is None or scene.tool is None:
        # Rows may share the contact point: outside of a part, all of whose results have lanes.
        where, share = centres(s_c, phi_c, radius), evenly(depth)
    else:
        where, share = lay_out(s_c, phi_c, radius, tool, depth)
    return local.fit(where, share[:, None], local.REACH * spacing, depth)


# Inlined: traced once for all plans of a scene that are compared, as `stage.touch_tube`.
@partial(jax.jit, inline=True)
def sag(tool: Shape, pose: Poses, points):
    """Distance of the tool, just touching, from points of the rest surface, mm."""
    if tool.radius.ndim == 1:
        return jnp.min(jax.vmap(sag, (0, None, None))(tool, pose, points), axis=0)
    if tool.vertices.shape[1] == 1:
        centre = product(pose.rotation, tool.vertices[:, 0]) + pose.translation
        off = points - centre[None]
        return jnp.maximum(jnp.sqrt(jnp.sum(off * off, axis=1)) - tool.radius, 0)
    back = inverse(Pose(pose.rotation, pose.translation))
    point = sphere(jnp.zeros_like(tool.radius))

    def one(x):
        there = Pose(jnp.eye(3, dtype=x.dtype), transform(back, x[:, None])[:, 0])
        return approach(tool, point, there).distance

    return jnp.maximum(jax.vmap(one)(points), 0)
