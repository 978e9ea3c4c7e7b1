"""Several tools on one trachea, each of which feels the others: forces and skeleton.

Every tool comes and touches as it would alone (`approach`); all of them press one ligament on the
midline (`mechanics.influence`), or each the ligament of its own meridian (`influence_vector`), in
one equilibrium (`mechanics.contacts`), or stick and slide in one (`rub_together`).
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import full_precision, product_of_rows, scaled
from jaxtrachea.mechanics.contacts import solve, stick
from jaxtrachea.mechanics.contacts_in_time import solve_in_time
from jaxtrachea.mechanics.friction import Slide, without_steps
from jaxtrachea.mechanics.influence import Influence, influence, level_influence
from jaxtrachea.mechanics.influence_vector import VectorInfluence
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.press import Contact, ligament_beam, local_law, respond
from jaxtrachea.mechanics.press_history import History, Samples
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene import lines
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.configurational import Contacts, forces_by_poses
from jaxtrachea.scene.in_time import Before, samples_of
from jaxtrachea.scene.instruments import Pull, glued, views
from jaxtrachea.scene.overlap import overlapping
from jaxtrachea.scene.ranges import contact_share, depth_share
from jaxtrachea.scene.refusals import (
    beyond,
    mask_rows,
    on_the_tube,
    refuse,
    status_of,
    without_negative_values,
)
from jaxtrachea.scene.rub_together import Rubbed, influence_of, rub_paths
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.material import Material


class Together(NamedTuple):
    """What the surface follows from; mm, rad. Contacts in the order of the tools.

    Attributes:
        s: places of the contacts; shape (m,).
        phi: their angles; (m,).
        depth: local indentation; (rows, m).
        inward: its direction, of all rows, or with friction row by row; None: on the midline.
        slip: way each tool has slid; None: no friction.
        lines: motion of the lines of joints.
        made: the way of each tool; None: presses.
        paths: of the tools, as read.
        hidden: rows that were refused, or have no solution; (rows,).
    """

    s: Float[Array, " m"]
    phi: Float[Array, " m"]
    depth: Float[Array, "rows m"]
    inward: Float[Array, "*rows m 3"] | None
    slip: Float[Array, "rows m 3"] | None
    lines: lines.Lines
    made: list[Approach | None]
    paths: Sequence[Poses | Presses]
    hidden: Bool[Array, " rows"]


class _Solved(NamedTuple):
    """Contacts in balance, in the directions of each: inwards, or (inward, along, round the tube).

    Attributes:
        unit: what unit forces in these directions move.
        depth: local indentation, mm.
        force: N.
        load: elastic force, which the shape follows.
        status: a `PressStatus`.
        history: what a force that relaxes remembers after the last row.
    """

    unit: Influence | VectorInfluence
    depth: Float[Array, "rows m *k"]
    force: Float[Array, "rows m *k"]
    load: Float[Array, "rows m *k"]
    status: Int[Array, "rows m"]
    history: History | None = None


@full_precision
def press_together(
    scene: Scene,
    material: Any,
    ways: Sequence[tuple[Poses | Presses, Approach | None]],
    present: Bool[Array, "rows m"] | None = None,
    before: Before | None = None,
    pull: Pull | None = None,
    rubbed: Rubbed | None = None,
    stuck: Bool[Array, " m"] | None = None,
) -> tuple[dict[str, Any], Together, History | None]:
    """Fields of a `Simulation` but the surface, what that follows from, and what is remembered.

    A row in which one tool is refused has no numbers: what it does moves all others.

    Args:
        scene: of several instruments.
        ways: path of each tool, all of as many rows, and how it comes; None: a path of presses.
        present: tools that are there; None: all, and those that are glued from first touch on.
        before: of a force that relaxes; else None.
        pull: of a single row of tools that wander, see `configurational.forces_by_poses`.
        rubbed: what tools with friction do, if it is known; else they follow their paths.
        stuck: glued tools that hold the wall before the first row; None: those of presses.
    """
    each, (paths, made) = views(scene), zip(*ways, strict=True)
    checked = [without_negative_values(view, long_run(material)) for view in each]
    safe, bad = checked[0][0], functools.reduce(jnp.logical_or, (bad for _, bad in checked))
    given = [path if isinstance(path, Presses) else None for path in paths]
    found = [refuse(v, safe, p, m, bad) for v, p, m in zip(each, given, made, strict=True)]
    refused = {
        code: functools.reduce(jnp.logical_or, (r[code] for *_, r in found if code in r))
        for code in dict.fromkeys(code for *_, r in found for code in r)
    }
    samples = None
    if before is not None and isinstance(material, RelaxingMaterial):
        together = jnp.concatenate([p.displacement for p, *_ in found], axis=1)
        samples, back = samples_of(material.relaxation, before, together, refused)
        refused[PressStatus.BACK_IN_TIME] = back
    hidden = functools.reduce(jnp.logical_or, refused.values())
    used = [u for _, u, *_ in found]
    s, phi = jnp.stack([p.s[0] for p in used]), jnp.stack([p.phi[0] for p in used])
    if scene.plan.friction:
        if rubbed is None:
            rubbed = rub_paths(scene, safe, s, phi, [p for p, *_ in found], hidden, made)
        lost = jnp.isnan(jnp.sum(rubbed.slid.force, axis=(1, 2)))
        slid, hidden = without_steps(rubbed.slid, lost), hidden | lost
        solved = _Solved(rubbed.unit, slid.depth, slid.force, slid.force, slid.status)
    else:
        # Along their own normals: a tool that waits behind the tube is computed as one in front.
        D = jnp.stack([jnp.sum(p.displacement * n, axis=1) for p, _, n, _ in found], axis=1)
        D = jnp.where(hidden[:, None], 0, D)
        if samples is not None and present is None and glued(scene).any():
            present = _touched(made, D)
        if stuck is None:
            stuck = jnp.array([m is None for m in made]) & glued(scene)
        slid, solved = None, _forces(scene, safe, s, phi, D, present, samples, stuck)
    for code, rows in _reached_beyond(each, safe, found, made, solved).items():
        refused[code], hidden = refused.get(code, False) | rows, hidden | rows
    vectors, rings, followed = _motion(scene, s, phi, solved, slid)
    moved = Together(s, phi, *followed, made=list(made), paths=paths, hidden=hidden)
    status = solved.status
    if pull is not None:
        row = Contacts(s, phi, solved.force, solved.depth)
        vectors |= _by_poses(scene, safe, row, ways, pull)
        lost = ~jnp.isfinite(jnp.sum(vectors["force"] + vectors["moment"], axis=2))
        status = jnp.where((status == PressStatus.OK) & lost, PressStatus.NON_FINITE, status)
    fields = mask_rows(hidden, vectors | rings)
    fields |= _of_each(each, paths, made, found, fields, status, refused)
    return fields, moved, solved.history


def _of_each(
    each: list[Scene], paths: Sequence[Poses | Presses], made: Sequence[Approach | None],
    found: list, fields: dict[str, Any], status: Int[Array, "rows m"], refused: dict,
) -> dict[str, Any]:  # fmt: skip
    """Fields of a `Simulation` that each tool has for itself, and the statuses."""
    presses, comes = [p for p, *_ in found], [m for m in made if m is not None]
    touches = [m.own for m in comes]
    share = [
        depth_share(v, fields["depth"][:, j], fields["skeleton"][:, j], found[j][2])
        for j, v in enumerate(each)
    ]
    word = [status_of(status[:, j], share[j], made[j], refused) for j in range(len(each))]

    def stack(values):
        return jnp.stack(values, axis=1) if values else None

    return {
        "s": stack([p.s for p in presses]), "phi": stack([p.phi for p in presses]),
        "gap": stack([touch.gap for touch in touches]),
        "displacement": stack([p.displacement for p in presses]),
        "frame": stack([m.frame for m in comes if m.frame is not None]),
        "depth_share": stack(share),
        "contact_share": stack([contact_share(*v) for v in zip(each, touches, strict=False)]),
        "status": _in_space(each, paths, stack(word)),
    }  # fmt: skip


def _reached_beyond(
    each: list[Scene], material: Material, found: list, made: Sequence[Approach | None],
    solved: _Solved,
) -> dict[PressStatus, Bool[Array, " rows"]]:  # fmt: skip
    """Rows in which others raise the wall to a tool where it may not press: see `beyond`."""
    force = solved.force if solved.force.ndim == 2 else solved.force[..., 0]
    refused: dict[PressStatus, Any] = {}
    for j, (view, (presses, _, inward, _), way) in enumerate(zip(each, found, made, strict=True)):
        if way is None:
            continue
        reached = (jnp.abs(force[:, j]) > 0) & (jnp.sum(presses.displacement * inward, axis=1) <= 0)
        behind = on_the_tube(view, presses.s, presses.phi)[2]
        for code, rows in beyond(view, material, presses, way, behind, reached, reached).items():
            refused[code] = refused.get(code, False) | rows
    return refused


def _in_space(each: list[Scene], paths: Sequence[Poses | Presses], status):
    """The statuses, with a word for solved rows of tools that overlap one another."""
    poses = [path for path in paths if isinstance(path, Poses)]
    tools = [view.tool for view in each if view.tool is not None]
    if len(poses) < len(each) or len(tools) < len(each):  # presses at points
        return status
    plain = functools.reduce(
        jnp.logical_or,
        [status == s for s in (PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.LIFTED)],
    )
    word = jnp.asarray(PressStatus.TOOLS_OVERLAP, status.dtype)
    return jnp.where(plain & overlapping(tools, poses), word, status)


def _motion(
    scene: Scene, s, phi, solved: _Solved, slid: Slide | None
) -> tuple[dict[str, Any], dict[str, Any], tuple]:
    """What contacts do: vectors of each, what the skeleton does, and what the surface follows.

    The shape follows the elastic force, what rings bear the force.

    Returns:
        Two mappings of fields of a `Simulation`, and those of `Together` from `depth` to `lines`.
    """
    unit, depth, inward, slip, slipped = solved.unit, solved.depth, None, None, None
    if isinstance(unit, Influence):
        does, bears = (lines.on_midline(unit, v, _half(scene)) for v in (solved.load, solved.force))
        force, vector = (lines.anterior(-v) for v in (solved.force, depth))
    else:
        ends = scene.plan.end_motion
        does = lines.round_the_tube(unit, solved.load, end_motion=ends)
        bears = lines.round_the_tube(unit, solved.force)
        frames = jax.vmap(local_frame)(phi)
        inward = frames[:, 0]
        if slid is None:
            force, vector = (scaled(v[..., None], inward[None]) for v in (solved.force, depth))
        else:
            force, vector, slip, slipped = (
                jnp.einsum("rmk,mkx->rmx", v, frames[:, -v.shape[2] :])
                for v in (solved.force, depth, slid.slip, slid.slip - slid.began)
            )
            square = jnp.sum(depth * depth, axis=-1)
            depth = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
            deep = depth[..., None]
            inward = jnp.where(deep > 0, vector / jnp.where(deep > 0, deep, 1), inward[None])
    vectors = {"force": force, "depth": vector, "skeleton": does.skeleton}
    if slid is not None:
        vectors |= {"slip": slipped, "dissipated": slid.dissipated}
    rings = {"joints": does.joints, "loads": bears.loads} if scene.plan.joints else {}
    if scene.plan.ring_ends:
        rings |= {"end_U": does.lines.U, "end_V": does.lines.V}
    return vectors, rings, (depth, inward, slip, does.lines)


def _influence(
    scene: Scene, material: Material, s: Float[Array, " m"], phi: Float[Array, " m"]
) -> Influence | VectorInfluence:
    """What every contact moves, of points or of punches."""
    if scene.plan.second_plane:
        return influence_of(scene, material, s, phi)
    beam, half = ligament_beam(scene.geometry, material, scene.plan.options), _half(scene)
    return influence(beam, s) if half == 0 else level_influence(beam, s, half)


def _by_poses(scene: Scene, material: Material, solved: Contacts, ways, pull: Pull):
    """Force and moment of tools that wander, by what they feel of each other."""

    def compliance(s, phi):
        return _felt(scene, _influence(scene, material, s, phi).compliance)

    return forces_by_poses(scene, material, solved, compliance, ways, pull)


def _half(scene: Scene) -> float:
    return scene.plan.options.half_width


def _touched(made: Sequence[Approach | None], D) -> Bool[Array, "rows m"]:
    """Rows since the first touch of each tool: before it one that is glued holds nothing."""
    row = jnp.arange(D.shape[0])
    return jnp.stack([
        jnp.ones_like(row, bool) if m is None or m.first is None
        else (row >= m.first) & jnp.any(m.seen.gap < 0)
        for m in made
    ], axis=1)  # fmt: skip


def _forces(scene: Scene, material: Material, s, phi, D, present, samples: Samples | None, stuck):
    """All contacts in balance, without friction."""
    options, held = scene.plan.options, glued(scene)
    unit = _influence(scene, material, s, phi)
    law = jax.vmap(lambda at: local_law(scene.geometry, material, at, options))(s)
    width, C = None, unit.compliance
    if options.contact == "unilateral":
        width = jnp.asarray(options.onset_width, D.dtype)
    if samples is not None:
        found = solve_in_time(D, _felt(scene, C), law, samples, width=width, present=present)
        depth, force, load = found.depth, found.force, found.elastic
        solved = _Solved(unit, depth, force, load, found.status, found.history)
    elif held.any():
        width = jnp.asarray(options.onset_width, D.dtype)
        found = stick(D, _felt(scene, C), law, width, jnp.asarray(held), stuck, present)
        holds = held[None] & (found.force != 0)
        depth = jnp.where(holds, found.depth, jnp.maximum(found.depth, 0))
        solved = _Solved(unit, depth, found.force, found.force, found.status)
    elif scene.plan.tools == "coupled":

        def row(D, present):
            return solve(D, C, law, width=width, present=present)

        found = jax.vmap(row, (0, None if present is None else 0))(D, present)
        depth = jnp.maximum(found.depth, 0)
        solved = _Solved(unit, depth, found.force, found.force, found.status)
    else:
        there = D if present is None else jnp.where(present, D, 0)

        def alone(D, compliance, law):
            return respond(D, compliance, Contact(law, jnp.zeros_like(compliance)), options)

        found = jax.vmap(alone, (1, 0, 0), 1)(there, jnp.diag(C), law)
        solved = _Solved(unit, found.depth, found.force, found.force, found.status)
    if options.coupling == "total":
        rest = 0 if samples is None else solved.depth
        depth = jnp.where(solved.force == 0, rest, D - product_of_rows(solved.load, C))
        solved = solved._replace(depth=depth)
    return solved


def _felt(scene: Scene, C: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The part of the compliance that contacts feel."""
    if scene.plan.tools == "coupled":
        return C
    return jnp.diag(jnp.diag(C)) if scene.plan.options.coupling == "series" else jnp.zeros_like(C)
