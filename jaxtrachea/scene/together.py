"""Several tools on one trachea, each of which feels the others: forces, skeleton and surface.

Every tool comes and touches as it would alone (`approach`); all of them press one ligament on the
midline (`mechanics.influence`, `mechanics.contacts`), and the surface follows one line of joints on
which every contact is a node, with the dents of all (`dents`).
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import full_precision, product_of_rows
from jaxtrachea.fusion import one_by_one
from jaxtrachea.mechanics.contacts import solve
from jaxtrachea.mechanics.influence import Influence, influence, level_influence
from jaxtrachea.mechanics.press import Contact, ligament_beam, local_law, respond
from jaxtrachea.scene import dents
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.instruments import scene_of
from jaxtrachea.scene.overlap import overlapping
from jaxtrachea.scene.ranges import contact_share, depth_share
from jaxtrachea.scene.refusals import mask_rows, refuse, status_of, without_negative_values
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.status import PressStatus
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.mesh import place


class Together(NamedTuple):
    """What the surface follows from; mm, rad. Contacts in the order of the tools.

    Attributes:
        s: places of the contacts; shape (m,).
        phi: their angles; (m,).
        skeleton: inward motion of every contact with the skeleton; (rows, m).
        depth: local indentation; (rows, m).
        joints: inward motion of every ring's joint; (rows, rings).
        slopes: rotation of the ligament at every joint; (rows, rings).
        turns: the same at every contact, see `Influence`; (rows, points).
        made: the way of each tool; None: presses.
        paths: of the tools, as read.
        hidden: rows that were refused; (rows,).
    """

    s: Float[Array, " m"]
    phi: Float[Array, " m"]
    skeleton: Float[Array, "rows m"]
    depth: Float[Array, "rows m"]
    joints: Float[Array, "rows rings"]
    slopes: Float[Array, "rows rings"]
    turns: Float[Array, "rows points"]
    made: list[Approach | None]
    paths: Sequence[Poses | Presses]
    hidden: Bool[Array, " rows"]


def views(scene: Scene) -> list[Scene]:
    """The scene as each tool sees it."""
    return [scene_of(scene, instrument) for instrument in scene.instruments]


@full_precision
def press_together(
    scene: Scene,
    material: Any,
    paths: Sequence[Poses | Presses],
    made: Sequence[Approach | None],
    present: Bool[Array, "rows m"] | None = None,
) -> tuple[dict[str, Any], Together]:
    """Fields of a `Simulation` but the surface, and what that follows from.

    A row in which one tool is refused has no numbers: what it does moves all others.

    Args:
        scene: of several instruments.
        material: -
        paths: of the tools, all of as many rows.
        made: the way of each; None: its path is of presses.
        present: tools that are there; None: all, and those that are glued from first touch on.
    """
    each = views(scene)
    safe, bad = without_negative_values(scene, material)
    given = [path if isinstance(path, Presses) else None for path in paths]
    found = [refuse(v, safe, p, m, bad) for v, p, m in zip(each, given, made, strict=True)]
    refused = {
        code: functools.reduce(jnp.logical_or, (r[code] for *_, r in found if code in r))
        for code in dict.fromkeys(code for *_, r in found for code in r)
    }
    hidden = functools.reduce(jnp.logical_or, refused.values())
    presses, used = [p for p, *_ in found], [u for _, u, *_ in found]
    D = jnp.stack([-p.displacement[:, 1] for p in presses], axis=1)
    D = jnp.where(hidden[:, None], 0, D)
    s, phi = jnp.stack([p.s[0] for p in used]), jnp.stack([p.phi[0] for p in used])
    unit = _influence(scene, safe, s)
    if present is None and scene.plan.options.contact == "bonded":
        present = _touched(made, D)
    depth, force, solved = _forces(scene, safe, s, unit, D, present)
    skeleton, joints, loads, slopes, turns = (
        product_of_rows(force, v)
        for v in (unit.compliance, unit.joints, unit.reactions, unit.slopes, unit.turns)
    )
    if scene.plan.options.coupling == "total":
        depth = jnp.where(force == 0, 0, D - skeleton)
    moved = Together(s, phi, skeleton, depth, joints, slopes, turns, list(made), paths, hidden)
    vectors = {"force": force, "depth": depth, "skeleton": skeleton}
    rings = {"joints": joints, "loads": loads, "end_U": joints, "end_V": joints}
    asked = {"joints": scene.plan.joints, "loads": scene.plan.joints}
    fields = mask_rows(hidden, {n: _anterior(-v) for n, v in (vectors | rings).items()})
    fields |= {n: None for n in rings if not asked.get(n, scene.plan.ring_ends)}
    share = [
        depth_share(v, fields["depth"][:, j], fields["skeleton"][:, j], found[j][2])
        for j, v in enumerate(each)
    ]
    status = [status_of(solved[:, j], share[j], made[j], refused) for j in range(len(each))]
    ways = [m for m in made if m is not None]

    def stack(values):
        return jnp.stack(values, axis=1) if values else None

    return fields | {
        "s": stack([p.s for p in presses]), "phi": stack([p.phi for p in presses]),
        "gap": stack([m.own.gap for m in ways]),
        "displacement": stack([p.displacement for p in presses]),
        "frame": stack([m.frame for m in ways if m.frame is not None]),
        "depth_share": stack(share),
        "contact_share": stack([contact_share(v, m.own) for v, m in zip(each, ways, strict=False)]),
        "status": _in_space(each, paths, stack(status)),
    }, moved  # fmt: skip


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


def _influence(scene: Scene, material: Material, s: Float[Array, " m"]) -> Influence:
    """What every contact moves, of points or of punches."""
    beam, half = ligament_beam(scene.geometry, material, scene.plan.options), _half(scene)
    return influence(beam, s) if half == 0 else level_influence(beam, s, half)


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


def _forces(scene: Scene, material: Material, s, unit: Influence, D, present):
    """Local indentations, forces and statuses of all contacts; shape (rows, m) each."""
    options = scene.plan.options
    law = jax.vmap(lambda at: local_law(scene.geometry, material, at, options))(s)
    if scene.plan.tools == "coupled":
        width = None
        if options.contact == "unilateral":
            width = jnp.asarray(options.onset_width, D.dtype)

        def row(D, present):
            return solve(D, unit.compliance, law, width=width, present=present)

        found = jax.vmap(row, (0, None if present is None else 0))(D, present)
        depth = found.depth if width is None else jnp.maximum(found.depth, 0)
        return depth, found.force, found.status
    D = D if present is None else jnp.where(present, D, 0)

    def alone(D, compliance, law):
        return respond(D, compliance, Contact(law, jnp.zeros_like(compliance)), options)

    found = jax.vmap(alone, (1, 0, 0), 1)(D, jnp.diag(unit.compliance), law)
    return found.depth, found.force, found.status


def _anterior(v):
    """Vectors with only a y component."""
    return jnp.stack([jnp.zeros_like(v), v, jnp.zeros_like(v)], -1)


@full_precision
def deform_together(scene: Scene, moved: Together) -> Float[Array, "rows vertices 3"] | None:
    """Deformed vertices, NaN in the rows that were refused; None: the plan has no surface."""
    plan, mesh, binding, half = scene.plan, scene.mesh, scene.binding, _half(scene)
    if plan.surface is None or plan.surface == "sections":
        return None
    if mesh is None or binding is None:
        raise ValueError("scene.mesh or scene.binding is None; the plan has a surface")
    method, straight, runs = plan.surface, mesh.straight, scene.runs
    places = moved.s if half == 0 else jnp.concatenate([moved.s - half, moved.s + half])
    order = jnp.argsort(places)
    share = regions.weigh(binding, jnp.zeros_like(moved.s[0]))
    laid = None
    if plan.dent:
        laid = dents.lay_out(views(scene), moved.s, moved.phi, moved.paths, moved.made)

    def one(row):
        skeleton, depth, joints, slopes, turns = row
        C = _anterior(-skeleton)
        C = C if half == 0 else jnp.concatenate([C, C])
        y = _anterior(-joints)

        def slope(v):
            return jnp.stack([-v, jnp.zeros_like(v)], -1)

        keys = regions.clamped(places[order], C[order], y, y, y, slope(slopes), slope(turns)[order])
        u = regions.interpolate(binding, share, keys, method=method)
        if laid is not None and runs is not None:
            for dent, s in zip(dents.fit(laid, depth), moved.s, strict=True):
                u = local.add_correction(u, dent, straight, runs, s)
        return place(mesh, u)

    rows = moved.skeleton, moved.depth, moved.joints, moved.slopes, moved.turns
    return mask_rows(moved.hidden, one_by_one(one, rows))
