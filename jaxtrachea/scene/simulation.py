"""The whole chain for one scene: tool -> contact -> force and skeleton -> surface.

The program is put together from the scene's static `Plan`; what is off is not in it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, shaped
from jaxtrachea.mechanics.admission import check_shapes, without_negative
from jaxtrachea.mechanics.oblique import Place, press_at, press_oblique, press_path
from jaxtrachea.mechanics.press import (
    ligament_beam,
    local_law,
    read_values,
    respond,
    unit_deflection,
)
from jaxtrachea.mechanics.ring import on_ring
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.mechanics.skeleton import read_values as skeleton_values
from jaxtrachea.scene.approach import Approach, approach
from jaxtrachea.scene.deform import deform
from jaxtrachea.scene.ranges import (
    DEEPEST,
    contact_share,
    depth_share,
    lacking,
    off_the_end,
    unserved,
)
from jaxtrachea.scene.stage import Poses, Presses, Scene, check_path
from jaxtrachea.status import ContactStatus, PressStatus
from jaxtrachea.trachea.material import Material


class Simulation(NamedTuple):
    """What happens along the path, mm and N. None: not asked for, or not modelled.

    Vectors are along x (to the larynx), y (anterior), z of the straight tube. On a bent mesh they
    are along the tangent, anterior and lateral direction of its centreline (at the contact; joints
    and ends at their rings): `frame` turns those at the contact into the frame of the mesh.

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
        frame: columns tangent, anterior, lateral at the contact; shape (rows, 3, 3). None: the tube
            is straight, or the contact points are given.
        vertices: deformed surface in the frame of the mesh; shape (rows, vertices, 3).
        depth_share: inward motion of the wall at the contact over the radius of the tube; beyond
            1 the status is TOO_DEEP (`ranges.DEEPEST` says why).
        contact_share: penetration against what the contact is sure for (tool's radius and rounding
            of the patches); NaN for sharp ones.
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
    frame: Float[Array, "rows 3 3"] | None
    vertices: Float[Array, "rows vertices 3"] | None
    depth_share: Float[Array, " rows"]
    contact_share: Float[Array, " rows"] | None
    status: Int[Array, " rows"]


class Sweep(NamedTuple):
    """Normal presses at many contact points.

    Attributes:
        force: normal contact force, N; shape (points,).
        indentation: local, along the normal, mm.
        compliance: of the skeleton along the normal, mm/N; NaN where nothing moves.
        depth_share: as in `Simulation`.
        status: a `PressStatus` each.
    """

    force: Float[Array, " points"]
    indentation: Float[Array, " points"]
    compliance: Float[Array, " points"]
    depth_share: Float[Array, " points"]
    status: Int[Array, " points"]


def simulate(scene: Scene, material: Material, path: Poses | Presses) -> Simulation:
    """Follow a path through the program of `scene.plan`; pure, to be jitted and differentiated.

    The rows of a path with `seat` first belong together: the tool stays on the place that it
    touched first. A row that needs what the plan has not (`ranges.unserved`) is NaN with OFF_PLAN;
    one whose contact lies beyond an end of the tube or behind the ends of its rings with OFF_TUBE
    or BEHIND_GAP, one of a tool in the lumen with IN_LUMEN; a negative stiffness or coefficient of
    friction is NaN with BAD_MATERIAL in every row. What the user or a tolerance left out
    (`Plan.ignored`), and what the material does not give, is left out of any path.

    Args:
        scene: from `make_scene`, or put together by hand.
        material: as the plan needs it.
        path: `Poses` if the plan has contact, else `Presses`.

    Raises:
        ValueError: the other kind of path, arrays of a wrong length, or something missing that the
            plan needs.
    """
    plan = scene.plan
    check_path(path)
    check_shapes(scene.geometry, material)
    if plan.contact != isinstance(path, Poses):
        kinds = ("Poses (the plan has contact)", "Presses (the plan has no contact)")
        raise ValueError(f"path is {type(path).__name__}; expected {kinds[not plan.contact]}")
    return follow(scene, material, path, approach(scene, path) if isinstance(path, Poses) else None)


def follow(
    scene: Scene,
    material: Material,
    path: Poses | Presses,
    made: Approach | None,
    place: Place | None = None,
) -> Simulation:
    """What follows from the presses of `path`, or of the tool's way `made` of it.

    `place`: where all rows press, if it is known already (a step of a session).
    """
    plan = scene.plan
    material, bad = _without_negative(scene, material)
    given = path if isinstance(path, Presses) else None
    presses, used, inward, refused = _refuse(scene, material, given, made, bad)
    if place is not None:
        moved = _Moved(*press_at(place, used.displacement, plan.options))
    else:
        moved = (_vectors if plan.second_plane else _one_plane)(scene, material, used)
    vertices = None
    if plan.surface is not None:
        vertices = deform(scene, material, used, moved, path, made)
    share = depth_share(scene, moved.depth, moved.skeleton, inward)
    optional = lambda wanted, value: value if wanted else None  # noqa: E731
    return Simulation(
        presses.s, presses.phi, None if made is None else made.own.gap, presses.displacement,
        moved.force, moved.depth, moved.skeleton,
        optional(plan.joints, moved.joints), optional(plan.joints, moved.loads),
        optional(plan.ring_ends, moved.end_U), optional(plan.ring_ends, moved.end_V),
        moved.slip, moved.dissipated, None if made is None else made.frame, vertices,
        share, None if made is None else contact_share(scene, made.own),
        _status(moved.status, share, made, refused),
    )  # fmt: skip


def _without_negative(scene: Scene, material: Material):
    """The material with 1 in place of negative values that the plan reads, and whether it had any.

    A negative coefficient of friction counts as well (`press_path` puts 0 in its place).
    """
    plan = scene.plan
    shear = plan.options.shear
    skeleton = skeleton_values(plan.rings, axial=plan.axial, shear=shear)
    used = (*read_values(plan.options), *(skeleton if plan.second_plane else ()))
    material, bad = without_negative(material, dict.fromkeys(used))
    if plan.friction and scene.friction is not None:
        bad = bad | (scene.friction < 0)
    return material, bad


def _refuse(scene: Scene, material: Material, path: Presses | None, made: Approach | None, bad):
    """The presses, NaN where refused; the same as computed; inward normals; refusals by status.

    A row that does not press needs nothing of the plan, the rings and the tube: off the plan or
    behind the ends of the rings it is computed as no motion, on the midline; off the tube at its
    end. (What presses there is NaN by then.)
    """
    presses = path if made is None else made.presses
    assert presses is not None
    D, phi, geometry = presses.displacement, presses.phi, scene.geometry
    inward = jax.vmap(local_frame)(phi)[:, 0] if made is None else made.inward
    pressing = ~(jnp.sum(D * inward, axis=1) <= 0)
    acting = pressing
    if scene.plan.options.contact == "bonded":
        acting = ~jnp.all(D == 0, axis=1)
    outside = ~((presses.s >= 0) & (presses.s <= geometry.length))
    if made is not None:
        outside = pressing & (outside | off_the_end(scene, made.own))
    refused = {PressStatus.OFF_TUBE: outside}
    unlike = unserved(scene, material, presses, acting)
    if unlike is not None:
        refused[PressStatus.OFF_PLAN] = unlike
    s, mid, behind = on_the_tube(scene, presses.s, phi)
    refused[PressStatus.BEHIND_GAP] = behind & acting
    if made is not None:
        refused[PressStatus.IN_LUMEN] = made.inside
    refused[PressStatus.NON_FINITE] = jnp.isnan(jnp.sum(D, axis=1))
    refused[PressStatus.BAD_MATERIAL] = jnp.broadcast_to(bad, presses.s.shape)
    for rows in refused.values():
        D = jnp.where(rows[:, None], jnp.nan, D)
    idle = (behind if scene.plan.second_plane else True) & ~acting
    used = Presses(s, mid, jnp.where(idle[:, None], jnp.zeros_like(D), D))
    return Presses(presses.s, phi, D), used, inward, refused


def on_the_tube(scene: Scene, s: Float[Array, "*n"], phi: Float[Array, "*n"]):
    """Contact positions to compute with (an end, the midline in place of none); who is behind."""
    geometry = scene.geometry
    behind = ~on_ring(geometry.half_angle, phi)[0] & ~jnp.isnan(phi)
    s = jnp.where(s < 0, 0, jnp.where(s > geometry.length, geometry.length, s))
    return s, jnp.where(behind, 0, phi), behind


def _status(status, share, made: Approach | None, refused: dict[PressStatus, Array]):
    """That of the press; of depth and contact where they are in doubt; of the rows refused."""
    status = jnp.where((status == PressStatus.OK) & (share > DEEPEST), PressStatus.TOO_DEEP, status)
    if made is not None:
        seen = made.own.status
        if made.first is not None:
            seen = jnp.maximum(seen, made.seen.status[made.first])
        unsure = (seen > ContactStatus.FLAT) & (status == PressStatus.OK)
        status = jnp.where(unsure, PressStatus.UNSURE, status)
    for code, rows in refused.items():
        status = jnp.where(rows, code, status)
    return status.astype(jnp.int8)


def sweep(
    scene: Scene,
    material: Material,
    s: ArrayLike,
    phi: ArrayLike,
    depth: ArrayLike,
    *,
    chunk: int = 256,
) -> Sweep:
    """Press along the normal at many contact points, `chunk` of them at a time.

    Args:
        scene: its geometry and the level of rings, shear and laws of its plan are used; OFF_PLAN
            where a point presses and the material gives more than the plan has (as in `simulate`).
        material: -
        s: mm.
        phi: rad, within the half-angle of the rings; else BEHIND_GAP where it presses.
        depth: of the tool along the inward normal, mm; 0 and less: NO_CONTACT (see `Options`).
        chunk: points computed together.

    Raises:
        ValueError: arrays of different lengths, or no numbers.
    """
    dtype = scene.geometry.length.dtype
    s = shaped("s", s, ("points",), dtype=dtype)
    phi, depth = (
        shaped(name, value, s.shape, dtype=dtype, why=" (as s has)")
        for name, value in (("phi", phi), ("depth", depth))
    )

    unlike = set(lacking(scene, material)) - {"axial"}  # every press is along the normal

    def one(at):
        s_c, phi_c, d = at
        acting = d != 0 if scene.plan.options.contact == "bonded" else ~(d <= 0)
        behind = on_the_tube(scene, s_c, phi_c)[2] & ~acting
        phi_c, d = (jnp.where(behind, 0, v) for v in (phi_c, d))  # needs nothing of the rings
        inward = local_frame(phi_c)[0]
        press = press_oblique(
            scene.geometry, material, s_c, phi_c, d * inward, scene.plan.options,
            rings=scene.plan.rings, axial=False,
        )  # fmt: skip
        force, way, depth = (v @ inward for v in (press.force, press.skeleton, press.depth))
        free = ~(force != 0)
        softness = jnp.where(free, jnp.nan, way / jnp.where(free, 1, force))
        share = depth_share(scene, press.depth, press.skeleton, inward)
        status = _status(press.status, share, None, {PressStatus.OFF_PLAN: acting & bool(unlike)})
        if unlike:
            force, depth, softness = (
                jnp.where(acting, jnp.nan, v) for v in (force, depth, softness)
            )
        return Sweep(force, depth, softness, share, status)

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
    F = -solved.force  # along y
    per_ring = lambda v: _anterior(F[:, None] * v)  # noqa: E731
    joints = per_ring(unit.w)
    slope = lambda v: jnp.stack([v, jnp.zeros_like(v)], -1)  # noqa: E731
    return _Moved(
        _anterior(F), _anterior(-solved.depth), _anterior(F * unit.w_C),
        slope(F * unit.theta_C), joints, slope(F[:, None] * unit.theta),
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
