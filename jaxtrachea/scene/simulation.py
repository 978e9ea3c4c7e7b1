"""The whole chain for one scene: tool -> contact -> force and skeleton -> surface.

The program is put together from the scene's static `Plan`; what is off is not in it.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea._numerics import full_precision
from jaxtrachea.fusion import one_by_one
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.press_history import History
from jaxtrachea.scene.approach import Approach, approach, approach_together
from jaxtrachea.scene.configurational import force_by_pose
from jaxtrachea.scene.deform import deform, deform_sections
from jaxtrachea.scene.deform_together import deform_together
from jaxtrachea.scene.in_time import Before, before_path, samples_of
from jaxtrachea.scene.instruments import paths_in_order, scene_of
from jaxtrachea.scene.programs import Moved, move
from jaxtrachea.scene.ranges import contact_share, depth_share
from jaxtrachea.scene.refusals import (
    hidden_rows,
    mask_rows,
    refuse,
    status_of,
    without_negative_values,
)
from jaxtrachea.scene.stage import (
    Poses,
    Presses,
    Scene,
    check_kind,
    check_material,
    check_path,
)
from jaxtrachea.scene.together import press_together
from jaxtrachea.status import PressStatus

#: Fields of a `Simulation` that there is one of for each tool.
OF_TOOLS = ("s", "phi", "gap", "displacement", "force", "moment", "depth", "skeleton", "slip",
            "dissipated", "frame", "depth_share", "contact_share", "status")  # fmt: skip


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
        joints: displacement of each joint; shape (rows, rings, 3). Of several tools off the
            midline the joints of each, on its meridian; (rows, tools, rings, 3). So of `loads`.
        loads: force of the ligament on each ring; x: axial force that passes. None of deforming
            cross-sections: a wall joins their rings, no line.
        end_U: displacement of the rings' ends at -alpha.
        end_V: at +alpha.
        slip: way the tool has slid over the surface (friction).
        dissipated: work lost in each row, N mm: to friction (of a session also by its place, which
            follows or gives way and may give a little back), or in `simulate` to what relaxes (None
            of several tools, a skeleton that softens or deforming cross-sections: not derived).
        frame: columns tangent, anterior, lateral at the contact; shape (rows, 3, 3). None: the tube
            is straight, or the contact points are given.
        vertices: deformed surface in the frame of the mesh; shape (rows, vertices, 3).
        depth_share: inward motion of the wall at the contact over the radius of the tube; beyond
            1 the status is TOO_DEEP (`ranges.DEEPEST` says why).
        contact_share: penetration against what the contact is sure for (tool's radius and rounding
            of the patches); NaN for sharp ones.
        status: a `PressStatus` per row.
        time: of the path, s; None: it has none (or a step was told how long it took).
        stiffness: of the contact in each row, N/mm: derivative of the force by the tool's position,
            both in the frame of the poses; shape (rows, 3, 3). Of `step` alone, on request.
    """

    s: Float[Array, " rows *tools"]
    phi: Float[Array, " rows *tools"]
    gap: Float[Array, " rows *tools"] | None
    displacement: Float[Array, "rows *tools 3"]
    force: Float[Array, "rows *tools 3"]
    moment: Float[Array, "rows *tools 3"] | None
    depth: Float[Array, "rows *tools 3"]
    skeleton: Float[Array, "rows *tools 3"]
    joints: Float[Array, "rows *tools rings 3"] | None
    loads: Float[Array, "rows *tools rings 3"] | None
    end_U: Float[Array, "rows rings 3"] | None
    end_V: Float[Array, "rows rings 3"] | None
    slip: Float[Array, "rows *tools 3"] | None
    dissipated: Float[Array, " rows *tools"] | None
    frame: Float[Array, "rows *tools 3 3"] | None
    vertices: Float[Array, "rows vertices 3"] | None
    depth_share: Float[Array, " rows *tools"]
    contact_share: Float[Array, " rows *tools"] | None
    status: Int[Array, " rows *tools"]
    time: Float[Array, " rows"] | None = None
    stiffness: Float[Array, "rows 3 3"] | None = None


def simulate(
    scene: Scene, material: AnyMaterial, path: Poses | Presses | Mapping[str, Poses | Presses]
) -> Simulation:
    """Follow a path through the program of `scene.plan`; pure, to be jitted and differentiated.

    The rows of a path with `contact_point` fixed belong together: the tool stays on the place that
    it touched first. A row that needs what the plan has not (`ranges.outside_plan`) is NaN with
    OFF_PLAN; one whose contact lies beyond an end of the tube or behind the ends of its rings with
    OFF_TUBE or BEHIND_GAP, one of a tool in the lumen with IN_LUMEN; a negative stiffness or
    coefficient of friction is NaN with BAD_MATERIAL in every row. What the user or a tolerance left
    out (`Plan.ignored`), and what the material does not give, is left out of any path.

    A force that relaxes (docs/model.md) is at rest before the first row. A row before an earlier
    one, or at no time, is NaN with BACK_IN_TIME, and all others are as if it were not there; so it
    is with a pose that is no number. After a row without a solution, or one that was refused, the
    history is unknown: all later ones are NaN with its status. Where the tool has left, the shape
    is that of the surface, which recovers by itself.

    Args:
        scene: from `make_scene`, or put together by hand.
        material: as the plan needs it; a `SectionMaterial` for a skeleton `sections`, and a
            `RelaxingMaterial` for a force that relaxes.
        path: `Poses` if the plan has contact, else `Presses`; of a scene that was made with a
            mapping a mapping of the same tools. They move side by side; a shorter path rests at its
            last row. A row in which one tool is refused has no numbers for any.

    Raises:
        ValueError: the other kind of path, arrays of a wrong length, something missing that the
            plan needs, or (outside of `jit`) matrices of the path that are no rotations; no scene;
            other tools than the scene has, or times of theirs that do not agree.
    """
    check_word("scene", scene, Scene)
    named = isinstance(path, Mapping)
    if named != bool(scene.instruments):
        names = ", ".join(map(repr, scene.names))
        expected = f"a mapping of the tools {names}" if names else "Poses or Presses"
        raise ValueError(f"path is {type(path).__name__}; expected {expected}, as the scene has")
    if isinstance(path, Mapping):
        paths = paths_in_order(scene.names, path)
    else:
        check_path(path)
        paths = (path,)
    check_material(scene.geometry, material)
    check_kind(scene, material)
    if scene.plan.contact != isinstance(paths[0], Poses):
        kinds = ("Poses (the plan has contact)", "Presses (the plan has no contact)")
        found, expected = type(paths[0]).__name__, kinds[not scene.plan.contact]
        raise ValueError(f"path is {found}; expected {expected}")
    return _of_tools(scene, material, paths) if named else _simulate(scene, material, paths[0])


@functools.partial(jax.jit, inline=True)
def _of_tools(scene: Scene, material: AnyMaterial, paths: Sequence[Poses | Presses]) -> Simulation:
    """`simulate`, of arguments that are checked, for the tools of a mapping."""
    if scene.plan.tools == "one":
        alone = _simulate(scene_of(scene, scene.instruments[0]), material, paths[0])
        return with_axis(alone)
    if scene.plan.contact_point == "per_step":  # each row is by itself

        def row(paths):
            alone = _together(scene, material, jax.tree.map(lambda v: v[None], paths))
            return jax.tree.map(lambda v: v[0], alone)

        return one_by_one(row, paths)
    return _together(scene, material, paths)


def _together(scene: Scene, material: AnyMaterial, paths: Sequence[Poses | Presses]) -> Simulation:
    """Several tools, each on one place."""
    made, pull = [None] * len(paths), None
    if poses := [path for path in paths if isinstance(path, Poses)]:
        made, pull = approach_together(scene, poses)
    before = before_path(scene, material, paths[0])
    ways = list(zip(paths, made, strict=True))
    found, moved, _ = press_together(scene, material, ways, before=before, pull=pull)
    vertices = deform_together(scene, moved)
    return as_simulation(found)._replace(vertices=vertices, time=paths[0].time)


def as_simulation(found: dict[str, Any]) -> Simulation:
    """The result of `press_together`; None what is not in it."""
    none: dict[str, Any] = dict.fromkeys(Simulation._fields)
    return Simulation(**none | found)


def of_tool(result: Simulation, tool: int) -> Simulation:
    """Of a result for several tools that of one, without their axis."""
    own = (*OF_TOOLS, *(n for n in ("joints", "loads") if np.ndim(getattr(result, n)) == 4))
    fields = {name: getattr(result, name) for name in own}
    return result._replace(**{n: v[:, tool] for n, v in fields.items() if v is not None})


def with_axis(alone: Simulation) -> Simulation:
    """The result for one tool, with an axis of tools behind that of rows."""
    fields = {name: getattr(alone, name) for name in OF_TOOLS}
    return alone._replace(**{n: v[:, None] for n, v in fields.items() if v is not None})


@functools.partial(jax.jit, inline=True)
def _simulate(scene: Scene, material: AnyMaterial, path: Poses | Presses) -> Simulation:
    """`simulate`, of arguments that are checked."""
    made = approach(scene, path) if isinstance(path, Poses) else None
    result, press = pressed(scene, material, path, made, before=before_path(scene, material, path))
    return result._replace(vertices=surface(scene, path, press), time=path.time)


class Pressed(NamedTuple):
    """A path that was pressed: what the surface follows from.

    Attributes:
        presses: as computed.
        moved: what they do.
        made: the tool's way; its `pull` is left out.
        hidden: rows that were refused, see `refusals.hidden_rows`.
        history: what a force that relaxes remembers after the last row; else None.
    """

    presses: Presses
    moved: Any
    made: Approach | None
    hidden: Bool[Array, " rows"] | None
    history: History | None = None


@full_precision
def pressed(
    scene: Scene,
    material: AnyMaterial,
    path: Poses | Presses,
    made: Approach | None,
    solve: Callable[..., Moved] | None = None,
    before: Before | None = None,
) -> tuple[Simulation, Pressed]:
    """All of `simulate` but the surface, and what that follows from.

    Args:
        material: -
        path: as for `simulate`.
        made: the tool's way; None: the path is of presses.
        solve: what presses do, if their place is known already; None: the program of the plan.
        before: of a force that relaxes; else None.
    """
    plan = scene.plan
    safe, bad = without_negative_values(scene, long_run(material))
    given = path if isinstance(path, Presses) else None
    presses, used, inward, refused = refuse(scene, safe, given, made, bad)
    timed = ()
    if before is not None and isinstance(material, RelaxingMaterial):
        samples, back = samples_of(material.relaxation, before, presses.displacement, refused)
        refused = refused | {PressStatus.BACK_IN_TIME: back}
        D = jnp.where(back[:, None], jnp.nan, presses.displacement)
        presses, timed = Presses(presses.s, presses.phi, D), (samples,)
    moved = move(scene, safe, used, *timed) if solve is None else solve(used, *timed)
    moved, history = moved._replace(history=None), moved.history
    force, moment, solved = moved.force, None, moved.status
    of_joints = plan.mechanics.hangs_on_rings
    if made is not None and made.pull is not None and isinstance(path, Poses) and of_joints:
        force, moment = force_by_pose(scene, safe, path, used, moved, made)
        lost = (solved == PressStatus.OK) & ~jnp.isfinite(jnp.sum(force + moment, axis=1))
        solved = jnp.where(lost, PressStatus.NON_FINITE, solved)
    way = None if made is None else made._replace(pull=None)
    hidden = hidden_rows(scene, refused)
    press = Pressed(used, moved, way, hidden, history)
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
    presses, moved, made, hidden, _ = press
    lay = deform_sections if scene.plan.surface == "sections" else deform
    return mask_rows(hidden, lay(scene, presses, moved, path, made))
