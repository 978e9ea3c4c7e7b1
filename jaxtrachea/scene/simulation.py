"""The whole chain for one scene: tool -> contact -> force and skeleton -> surface.

The program is put together from the scene's static `Plan`; what is off is not in it.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea._numerics import full_precision
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.scene.approach import Approach, approach
from jaxtrachea.scene.configurational import force_by_pose
from jaxtrachea.scene.deform import deform, deform_sections
from jaxtrachea.scene.programs import Moved, move
from jaxtrachea.scene.ranges import contact_share, depth_share
from jaxtrachea.scene.refusals import (
    hidden_rows,
    mask_rows,
    refuse,
    status_of,
    without_negative_values,
)
from jaxtrachea.scene.stage import Poses, Presses, Scene, check_kind, check_material, check_path
from jaxtrachea.status import PressStatus


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
        force: contact force on the tube. Of a tool with `contact_point` per_step it is the
            derivative of the stored energy by the tool's position: with a part along the surface
            where the wall is softer beside the contact (`scene.configurational`). Else it is what
            depth and skeleton answer to.
        moment: its moment about the tool's origin, N mm: the derivative of the energy by a turn;
            None: without contact or with a fixed contact point.
        depth: local indentation.
        skeleton: displacement of C with the skeleton.
        joints: displacement of each joint; shape (rows, rings, 3).
        loads: force of the ligament on each ring; x: axial force that passes. None of deforming
            cross-sections: a wall joins their rings, no line.
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
    moment: Float[Array, "rows 3"] | None
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


def simulate(scene: Scene, material: AnyMaterial, path: Poses | Presses) -> Simulation:
    """Follow a path through the program of `scene.plan`; pure, to be jitted and differentiated.

    The rows of a path with `contact_point` fixed belong together: the tool stays on the place that
    it touched first. A row that needs what the plan has not (`ranges.outside_plan`) is NaN with
    OFF_PLAN; one whose contact lies beyond an end of the tube or behind the ends of its rings with
    OFF_TUBE or BEHIND_GAP, one of a tool in the lumen with IN_LUMEN; a negative stiffness or
    coefficient of friction is NaN with BAD_MATERIAL in every row. What the user or a tolerance left
    out (`Plan.ignored`), and what the material does not give, is left out of any path.

    Args:
        scene: from `make_scene`, or put together by hand.
        material: as the plan needs it; a `SectionMaterial` for a skeleton `sections`.
        path: `Poses` if the plan has contact, else `Presses`.

    Raises:
        ValueError: the other kind of path, arrays of a wrong length, something missing that the
            plan needs, or (outside of `jit`) matrices of the path that are no rotations; no scene.
    """
    check_word("scene", scene, Scene)
    plan = scene.plan
    check_path(path)
    check_material(scene.geometry, material)
    check_kind(scene, material)
    if plan.contact != isinstance(path, Poses):
        kinds = ("Poses (the plan has contact)", "Presses (the plan has no contact)")
        raise ValueError(f"path is {type(path).__name__}; expected {kinds[not plan.contact]}")
    return _simulate(scene, material, path)


@functools.partial(jax.jit, inline=True)
def _simulate(scene: Scene, material: AnyMaterial, path: Poses | Presses) -> Simulation:
    """`simulate`, of arguments that are checked."""
    made = approach(scene, path) if isinstance(path, Poses) else None
    result, press = pressed(scene, material, path, made)
    return result._replace(vertices=surface(scene, path, press))


class Pressed(NamedTuple):
    """A path that was pressed: what the surface follows from.

    Attributes:
        presses: as computed.
        moved: what they do.
        made: the tool's way; its `pull` is left out.
        hidden: rows that were refused, see `refusals.hidden_rows`.
    """

    presses: Presses
    moved: Any
    made: Approach | None
    hidden: Bool[Array, " rows"] | None


@full_precision
def pressed(
    scene: Scene,
    material: AnyMaterial,
    path: Poses | Presses,
    made: Approach | None,
    solve: Callable[[Presses], Moved] | None = None,
) -> tuple[Simulation, Pressed]:
    """All of `simulate` but the surface, and what that follows from.

    Args:
        scene: -
        material: -
        path: as for `simulate`.
        made: the tool's way; None: the path is of presses.
        solve: what presses do, if their place is known already; None: the program of the plan.
    """
    plan = scene.plan
    safe, bad = without_negative_values(scene, material)
    given = path if isinstance(path, Presses) else None
    presses, used, inward, refused = refuse(scene, safe, given, made, bad)
    moved = move(scene, safe, used) if solve is None else solve(used)
    force, moment, solved = moved.force, None, moved.status
    of_joints = plan.mechanics.hangs_on_rings
    if made is not None and made.pull is not None and isinstance(path, Poses) and of_joints:
        force, moment = force_by_pose(scene, safe, path, used, moved, made)
        lost = (solved == PressStatus.OK) & ~jnp.isfinite(jnp.sum(force + moment, axis=1))
        solved = jnp.where(lost, PressStatus.NON_FINITE, solved)
    way = None if made is None else made._replace(pull=None)
    hidden = hidden_rows(scene, refused)
    press = Pressed(used, moved, way, hidden)
    moved, moment = mask_rows(hidden, (moved._replace(force=force, status=None), moment))
    share = depth_share(scene, moved.depth, moved.skeleton, inward)
    asked, ends = plan.joints, plan.ring_ends
    return Simulation(
        s=presses.s,
        phi=presses.phi,
        gap=None if made is None else made.own.gap,
        displacement=presses.displacement,
        force=moved.force,
        moment=moment,
        depth=moved.depth,
        skeleton=moved.skeleton,
        joints=moved.joints if asked else None,
        loads=moved.loads if asked else None,
        end_U=moved.end_U if ends else None,
        end_V=moved.end_V if ends else None,
        slip=moved.slip,
        dissipated=moved.dissipated,
        frame=None if made is None else made.frame,
        vertices=None,
        depth_share=share,
        contact_share=None if made is None else contact_share(scene, made.own),
        status=status_of(solved, share, made, refused),
    ), press


@full_precision
def surface(
    scene: Scene, path: Poses | Presses, press: Pressed
) -> Float[Array, "rows vertices 3"] | None:
    """Deformed vertices, NaN in the rows that were refused; None: the plan has no surface."""
    if scene.plan.surface is None:
        return None
    presses, moved, made, hidden = press
    lay = deform_sections if scene.plan.surface == "sections" else deform
    return mask_rows(hidden, lay(scene, presses, moved, path, made))
