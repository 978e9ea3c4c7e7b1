"""The whole chain for one scene: tool -> contact -> force and skeleton -> surface.

The program is put together from the scene's static `Plan`; what is off is not in it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.contact.distance import signed_distance
from jaxtrachea.contact.patches import Touch
from jaxtrachea.contact.pose import Pose, inverse, transform
from jaxtrachea.contact.shapes import Shape, sphere
from jaxtrachea.model import ligament_beam, local_law, respond, unit_deflection
from jaxtrachea.oblique import press_oblique, press_path
from jaxtrachea.scene import Plan
from jaxtrachea.skeleton import local_frame
from jaxtrachea.stage import Poses, Presses, Scene, touch_tube
from jaxtrachea.status import PressStatus
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.mesh import place

#: What a program without a second plane takes for a normal press on the midline: rad; share.
COVERED = 1e-5


class Simulation(NamedTuple):
    """What happens along the path, mm and N. None: not asked for, or not modelled.

    Vectors are along x (to the larynx), y (anterior), z of the straight tube, `vertices` in the
    frame of the mesh.

    Attributes:
        s: contact position; shape (rows,).
        phi: contact angle, rad.
        gap: signed distance of tool and undeformed tube.
        displacement: of the tool from first touch; shape (rows, 3).
        force: contact force on the tube.
        depth: local indentation.
        skeleton: displacement of C with the skeleton.
        joints: displacement of each joint; shape (rows, rings, 3).
        loads: force of the ligament on each ring; x: axial force that passes.
        end_U: displacement of the rings' ends at -alpha.
        end_V: at +alpha.
        slip: way the tool has slid over the surface (friction).
        dissipated: work lost to friction in each row, N mm.
        vertices: deformed surface; shape (rows, vertices, 3).
        status: a `PressStatus` per row.
    """

    s: Float[Array, " rows"]
    phi: Float[Array, " rows"]
    gap: Float[Array, " rows"] | None
    displacement: Float[Array, "rows 3"]
    force: Float[Array, "rows 3"]
    depth: Float[Array, "rows 3"]
    skeleton: Float[Array, "rows 3"]
    joints: Float[Array, "rows rings 3"] | None
    loads: Float[Array, "rows rings 3"] | None
    end_U: Float[Array, "rows rings 3"] | None
    end_V: Float[Array, "rows rings 3"] | None
    slip: Float[Array, "rows 3"] | None
    dissipated: Float[Array, " rows"] | None
    vertices: Float[Array, "rows vertices 3"] | None
    status: Int[Array, " rows"]


class Sweep(NamedTuple):
    """Normal presses at many contact points.

    Attributes:
        force: normal contact force, N; shape (points,).
        indentation: local, along the normal, mm.
        compliance: of the skeleton along the normal, mm/N; NaN where nothing moves.
        status: a `PressStatus` each.
    """

    force: Float[Array, " points"]
    indentation: Float[Array, " points"]
    compliance: Float[Array, " points"]
    status: Int[Array, " points"]


def simulate(scene: Scene, material: Material, path: Poses | Presses) -> Simulation:
    """Follow a path through the program of `scene.plan`; pure, to be jitted and differentiated.

    The rows of a path with `seat` first belong together: the tool stays on the place that it
    touched first. A row that the plan does not cover (off the midline in a program of one plane)
    is NaN with OFF_PLAN; one whose contact lies beyond an end of the tube with OFF_TUBE.

    Args:
        scene: from `make_scene`, or put together by hand.
        material: as the plan needs it.
        path: `Poses` if the plan has contact, else `Presses`.

    Raises:
        ValueError: the other kind of path, or something missing that the plan needs.
    """
    plan = scene.plan
    if plan.contact != isinstance(path, Poses):
        kinds = ("Poses (the plan has contact)", "Presses (the plan has no contact)")
        raise ValueError(f"path is {type(path).__name__}; expected {kinds[not plan.contact]}")
    seen, first = None, None
    if isinstance(path, Poses):
        seen = touch_tube(scene, path)
        presses, first = _from_touch(plan, path, seen)
    else:
        presses = path
    presses = _on_tube(scene, presses)
    moved = (_vectors if plan.second_plane else _one_plane)(scene, material, presses)
    vertices = None
    if plan.surface is not None:
        vertices = _surface(scene, material, presses, moved, path, seen, first)
    status = moved.status
    length = scene.geometry.length
    status = jnp.where(
        ~((presses.s >= 0) & (presses.s <= length)) & (status > 0), PressStatus.OFF_TUBE, status
    ) if plan.contact else status  # fmt: skip
    if not plan.second_plane:
        status = jnp.where(_covered(presses), status, PressStatus.OFF_PLAN)
    optional = lambda wanted, value: value if wanted else None  # noqa: E731
    return Simulation(
        presses.s, presses.phi, None if seen is None else seen.gap, presses.displacement,
        moved.force, moved.depth, moved.skeleton,
        optional(plan.joints, moved.joints), optional(plan.joints, moved.loads),
        optional(plan.ring_ends, moved.end_U), optional(plan.ring_ends, moved.end_V),
        moved.slip, moved.dissipated, vertices, status.astype(jnp.int8),
    )  # fmt: skip


def sweep(
    scene: Scene,
    material: Material,
    s: Float[Array, " points"],
    phi: Float[Array, " points"],
    depth: Float[Array, " points"],
    *,
    chunk: int = 256,
) -> Sweep:
    """Press along the normal at many contact points, `chunk` of them at a time.

    Args:
        scene: its geometry and the level of rings, shear and laws of its plan are used.
        material: -
        s: mm.
        phi: rad, within the half-angle of the rings.
        depth: of the tool along the inward normal, mm.
        chunk: points computed together.
    """

    def one(at):
        s_c, phi_c, d = at
        inward = local_frame(phi_c)[0]
        press = press_oblique(
            scene.geometry, material, s_c, phi_c, d * inward, scene.plan.options,
            rings=scene.plan.rings, axial=False,
        )  # fmt: skip
        force, way = press.force @ inward, press.skeleton @ inward
        free = ~(force != 0)
        softness = jnp.where(free, jnp.nan, way / jnp.where(free, 1, force))
        return Sweep(force, press.depth @ inward, softness, press.status)

    return jax.lax.map(one, (s, phi, depth), batch_size=chunk)


class _Moved(NamedTuple):
    """Force and skeleton, whichever program found them; fields as in `Simulation`."""

    force: Any
    depth: Any
    skeleton: Any
    slope_C: Any
    joints: Any
    slopes: Any
    loads: Any
    end_U: Any
    end_V: Any
    status: Any
    slip: Any = None
    dissipated: Any = None


def _from_touch(plan: Plan, path: Poses, seen: Touch) -> tuple[Presses, Array | None]:
    """The presses of a tool that touches, and the row of first touch."""
    inward = jax.vmap(lambda phi: local_frame(phi)[0])(seen.phi)
    if plan.seat == "each":
        return Presses(seen.s, seen.phi, -seen.gap[:, None] * inward), None
    rows = seen.gap.shape[0]
    touching = seen.gap < 0
    first = jnp.where(jnp.any(touching), jnp.argmax(touching), jnp.argmin(seen.gap))
    before = jnp.maximum(first - 1, 0)
    at = lambda v, row: jax.lax.dynamic_index_in_dim(v, row, keepdims=False)  # noqa: E731
    pose = Pose(at(path.rotation, first), at(path.translation, first))
    gap, normal = at(seen.gap, first), at(inward, first)
    # The tool's material point that touches first, followed through the path.
    body = transform(inverse(pose), at(seen.tool_point, first)[:, None])[:, 0]
    points = jax.vmap(lambda R, T: R @ body + T)(path.rotation, path.translation)
    onto = at(points, first)
    closing = at(seen.gap, before) - gap
    left = jnp.where(closing > 0, -gap / jnp.where(closing > 0, closing, 1), 0)
    step = onto - at(points, before)
    step = step - jnp.dot(step, normal) * normal
    D = points - onto + left * step - gap * normal
    if plan.options.contact == "bonded":
        D = jnp.where((jnp.arange(rows) >= first)[:, None], D, 0)
    spread = lambda v: jnp.broadcast_to(at(v, first), (rows,))  # noqa: E731
    return Presses(spread(seen.s), spread(seen.phi), D), first


def _on_tube(scene: Scene, presses: Presses) -> Presses:
    """NaN for what is pressed beyond the ends or, in one plane, off the plan."""
    D = presses.displacement
    if scene.plan.contact:
        inside = (presses.s >= 0) & (presses.s <= scene.geometry.length)
        idle = jnp.sum(D * jax.vmap(lambda phi: local_frame(phi)[0])(presses.phi), axis=1) <= 0
        D = jnp.where((inside | idle)[:, None], D, jnp.nan)
    if not scene.plan.second_plane:
        D = jnp.where(_covered(presses)[:, None], D, jnp.nan)
    return Presses(presses.s, presses.phi, D)


def _covered(presses: Presses):
    """Rows that are normal presses on the midline."""
    D = jnp.abs(presses.displacement)
    return (jnp.abs(presses.phi) <= COVERED) & ~(
        jnp.maximum(D[:, 0], D[:, 2]) > COVERED * D[:, 1] + COVERED
    )


def _one_plane(scene: Scene, material: Material, presses: Presses) -> _Moved:
    """Normal press on the midline: scalars, then spread to vectors."""
    plan, geometry = scene.plan, scene.geometry
    beam = ligament_beam(geometry, material, plan.options)

    def at(s_c, inward):
        unit = unit_deflection(beam, s_c, plan.options)
        law = local_law(geometry, material, s_c, plan.options)
        return unit, respond(inward, jnp.zeros_like(s_c), unit.w_C, law, plan.options)

    inward = -presses.displacement[:, 1]
    if plan.seat == "first":
        unit, solved = at(presses.s[0], inward)
        unit = jax.tree.map(lambda v: jnp.broadcast_to(v, (inward.shape[0], *v.shape)), unit)
    else:
        unit, solved = jax.vmap(at)(presses.s, inward)
    F = solved.force
    per_ring = lambda v: _anterior(-F[:, None] * v)  # noqa: E731
    joints = per_ring(unit.w)
    slope = lambda v: jnp.stack([v, jnp.zeros_like(v)], -1)  # noqa: E731
    return _Moved(
        _anterior(-F), _anterior(-solved.depth), _anterior(-F * unit.w_C),
        slope(-F * unit.theta_C), joints, slope(-F[:, None] * unit.theta),
        per_ring(unit.reaction), joints, joints, solved.status,
    )  # fmt: skip


def _anterior(v):
    """Vectors with only a y component."""
    return jnp.stack([jnp.zeros_like(v), v, jnp.zeros_like(v)], -1)


def _vectors(scene: Scene, material: Material, presses: Presses) -> _Moved:
    plan = scene.plan
    how = {"rings": plan.rings, "axial": plan.axial}
    fixed = scene.geometry, material
    if plan.friction:
        if scene.friction is None:
            raise ValueError("scene.friction is None; the plan has friction")
        path = press_path(
            *fixed, presses.s[0], presses.phi[0], presses.displacement, scene.friction,
            plan.options, **how,
        )  # fmt: skip
        return _Moved(*path.press, slip=path.slip, dissipated=path.dissipated)
    if plan.seat == "first":
        at = presses.s[0], presses.phi[0], presses.displacement
        return _Moved(*press_oblique(*fixed, *at, plan.options, **how))
    one = lambda s, phi, D: press_oblique(*fixed, s, phi, D, plan.options, **how)  # noqa: E731
    return _Moved(*jax.vmap(one)(presses.s, presses.phi, presses.displacement))


def _surface(scene: Scene, material: Material, presses: Presses, moved: _Moved, path, seen, first):
    """Deformed vertices, row by row."""
    plan, mesh, binding = scene.plan, scene.mesh, scene.binding
    if mesh is None or binding is None or plan.surface is None:
        raise ValueError("scene.mesh or scene.binding is None; the plan has a surface")
    method = plan.surface
    together = plan.seat == "first"
    weights = regions.weigh(binding, presses.phi[0]) if together else None
    straight = mesh.straight if plan.dent else None

    def one(s_c, phi_c, moved, pose):
        ends = _ends(scene, material, s_c, moved) if plan.end_motion else (None, None)
        keys = regions.clamped(
            s_c, moved.skeleton, moved.joints, moved.end_U, moved.end_V, moved.slopes,
            moved.slope_C, end_A=ends[0], end_B=ends[1],
        )  # fmt: skip
        share = regions.weigh(binding, phi_c) if weights is None else weights
        u = regions.interpolate(binding, share, keys, method=method)
        if straight is not None:
            u = u + local.correction(_dent(scene, s_c, phi_c, moved.depth, pose), straight)
        return place(mesh, u)

    at = None
    if plan.dent > 8:
        at = _backed_out(path, presses, seen, first)
    moved = moved._replace(slip=None, dissipated=None, status=None, force=moved.force)
    return jax.vmap(one)(presses.s, presses.phi, moved, at)


def _ends(scene: Scene, material: Material, s_c, moved: _Moved):
    """Motion of both clamps on their axial springs."""
    passed, F = moved.loads[:, 0], moved.force[0]
    A = jnp.where(scene.geometry.ring_positions[0] <= s_c, passed[0], F - passed[-1])
    along = lambda f, k: (  # noqa: E731
        None if k is None else jnp.zeros_like(moved.force).at[0].set(f / k)
    )
    return along(A, material.k_A), along(F - A, material.k_B)


def _backed_out(path: Poses, presses: Presses, seen: Touch, first) -> Poses:
    """Where the tool stands when it just touches, before it presses."""
    if first is None:
        inward = jax.vmap(lambda phi: local_frame(phi)[0])(presses.phi)
        return Poses(path.rotation, path.translation + seen.gap[:, None] * inward)
    rotation, translation = (
        jnp.broadcast_to(v[first], v.shape) for v in (path.rotation, path.translation)
    )
    inward = local_frame(presses.phi[0])[0]
    return Poses(rotation, translation + seen.gap[first] * inward)


def _dent(scene: Scene, s_c, phi_c, depth, pose: Poses | None) -> local.Dent:
    """The local correction for one row."""
    count, spacing = scene.plan.dent, scene.footprint
    where = local.centres(s_c, phi_c, scene.radius, spacing, count)
    sag = jnp.zeros_like(where[:, 0])
    if pose is not None and scene.tool is not None:
        sag = _sag(scene.tool, pose, where)
    return local.fit(where, local.targets(depth, sag), 3 * spacing)


def _sag(tool: Shape, pose: Poses, points):
    """Distance of the tool, just touching, from points of the rest surface, mm."""
    if tool.vertices.shape[1] == 1:
        centre = pose.rotation @ tool.vertices[:, 0] + pose.translation
        off = points - centre
        return jnp.maximum(jnp.sqrt(jnp.sum(off * off, axis=1)) - tool.radius, 0)
    point = sphere(jnp.zeros_like(tool.radius))

    def one(x):
        back = inverse(Pose(pose.rotation, pose.translation))
        seen = transform(back, x[:, None])[:, 0]
        return signed_distance(tool, point, Pose(jnp.eye(3, dtype=x.dtype), seen)).distance

    return jnp.maximum(jax.vmap(one)(points), 0)
