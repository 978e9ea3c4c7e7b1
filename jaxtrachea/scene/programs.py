"""Force and skeleton of presses: in one plane, or as vectors."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtrachea._numerics import scaled
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import (
    ObliquePress,
    Place,
    path_at,
    place_at,
    press_at,
)
from jaxtrachea.mechanics.press import (
    Contact,
    ligament_beam,
    local_law,
    respond,
    softening_of,
    unit_deflection,
)
from jaxtrachea.mechanics.press_history import (
    Samples,
    press_at_in_time,
    relax_forces,
    respond_in_time,
)
from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.plan import Plan
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.trachea.material import Material


class Moved(NamedTuple):
    """Force and skeleton, whichever program found them; fields as in `Simulation`.

    Slopes are those of the ligament at the contact and at the rings; these and the loads are None
    where there is no ligament. Of a tool with a width, `slope_C` is the mean of those at its edges,
    each weighed by its force, and `slope_edges` are they; else None. `clamps`: how the ends A and B
    move, None where they do not. `along`: modes of the sections that a surface asks for, and of
    that at the contact. `history`: what a force that relaxes remembers after the last row, or None.
    """

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
    slope_edges: Any = None
    clamps: Any = None
    along: Any = None
    history: Any = None


def moved_by(press: ObliquePress, plan: Plan) -> Moved:
    """The same of a press as vectors."""
    moved = Moved(**press._asdict())
    return moved if plan.end_motion else moved._replace(clamps=None)


def one_plane(
    scene: Scene, material: Material, presses: Presses, samples: Samples | None = None
) -> Moved:
    """Normal press on the midline: scalars, then spread to vectors.

    What moves with the skeleton follows the force, or the load under which a skeleton that softens
    would move as much if it were linear; what the rings bear follows the force (as in `press`).
    """
    plan, geometry = scene.plan, scene.geometry
    beam = ligament_beam(geometry, material, plan.options)
    softening = softening_of(material, plan.options)

    def at(s_c, inward):
        unit = unit_deflection(beam, s_c, plan.options)
        law = local_law(geometry, material, s_c, plan.options)
        contact = Contact(law, jnp.zeros_like(s_c), softening=softening)
        if samples is None:
            return unit, respond(inward, unit.w_C, contact, plan.options), None
        relaxed = respond_in_time(inward, unit.w_C, contact, plan.options, samples)
        return unit, relaxed.solved, relaxed

    inward, relaxed = -presses.displacement[:, 1], None
    if plan.contact_point == "fixed":
        unit, solved, relaxed = at(presses.s[0], inward)
        unit = jax.tree.map(lambda v: jnp.broadcast_to(v, (inward.shape[0], *v.shape)), unit)
    else:
        unit, solved, _ = jax.vmap(at)(presses.s, inward)
    F = -solved.force  # along y
    load = F if solved.load is None else -solved.load
    pairs = (load, unit.w), (F, unit.reaction)
    joints, bears = (_anterior(scaled(v[:, None], w)) for v, w in pairs)

    def slope(v):
        return jnp.stack([v, jnp.zeros_like(v)], -1)

    edges = None if unit.edges is None else slope(scaled(load[:, None], unit.edges))
    return Moved(
        force=_anterior(F), depth=_anterior(-solved.depth),
        skeleton=_anterior(scaled(load, unit.w_C)), slope_C=slope(scaled(load, unit.theta_C)),
        joints=joints, slopes=slope(scaled(load[:, None], unit.theta)),
        loads=bears, end_U=joints, end_V=joints, status=solved.status, slope_edges=edges,
        dissipated=None if relaxed is None else relaxed.dissipated,
        history=None if relaxed is None else relaxed.history,
    )  # fmt: skip


def _anterior(v):
    """Vectors with only a y component."""
    return jnp.stack([jnp.zeros_like(v), v, jnp.zeros_like(v)], -1)


def vectors(
    scene: Scene, material: Material, presses: Presses, samples: Samples | None = None
) -> Moved:
    """Presses in any direction, anywhere on the rings."""
    plan = scene.plan
    fixed = scene.geometry, material
    if plan.friction:
        if scene.friction is None:
            raise ValueError("scene.friction is None; the plan has friction")
        place = place_at(*fixed, presses.s[0], presses.phi[0], plan.oblique)
        path = path_at(place, presses.displacement, Coulomb(scene.friction), plan.oblique)
        return moved_by(path.press, plan)._replace(slip=path.slip, dissipated=path.dissipated)
    if plan.contact_point == "fixed":
        place = place_at(*fixed, presses.s[0], presses.phi[0], plan.oblique)
        if samples is not None:
            return moved_in_time(place, presses, plan, samples)
        return moved_by(press_at(place, presses.displacement, plan.oblique.press), plan)

    def one(s, phi, D):
        return press_at(place_at(*fixed, s, phi, plan.oblique), D, plan.oblique.press)

    return moved_by(jax.vmap(one)(presses.s, presses.phi, presses.displacement), plan)


def moved_in_time(place: Place, presses: Presses, plan: Plan, samples: Samples) -> Moved:
    """The same of a force that relaxes, at one place."""
    press, history, work = press_at_in_time(place, presses.displacement, plan.options, samples)
    return moved_by(press, plan)._replace(dissipated=work, history=history)


def move(scene: Scene, material: Any, presses: Presses, samples: Samples | None = None) -> Moved:
    """Force and skeleton by the program of the scene's plan; `samples`: of a force that relaxes."""
    if not scene.plan.mechanics.hangs_on_rings:
        moved = cross_sections(scene, material, presses)
        if samples is None:
            return moved
        force, status, history = relax_forces(moved.force, moved.status, samples)
        lost = jnp.isnan(force[:, 0])
        shape = jax.tree.map(
            lambda v: jnp.where(lost.reshape(-1, *[1] * (v.ndim - 1)), jnp.nan, v),
            moved._replace(force=None, status=None),
        )
        return shape._replace(force=force, status=status, history=history)
    solve = vectors if scene.plan.second_plane else one_plane
    if samples is not None:
        return solve(scene, material, presses, samples)
    return solve(scene, material, presses)


def cross_sections(scene: Scene, material: SectionMaterial, presses: Presses) -> Moved:
    """Presses across the tube on deforming cross-sections, anywhere on the rings.

    Every row is a press of its own, straight from rest to its displacement: what is stored does not
    depend on the way. With one plane the program is that of the midline.
    """
    flat, points = not scene.plan.second_plane, None
    if scene.plan.surface is not None:
        if scene.points is None:
            raise ValueError("scene.points is None; the plan has a surface of cross-sections")
        points = scene.points.s

    def one(s, phi, D):
        inward, _, across = local_frame(phi)
        way = jnp.stack([jnp.sum(D * inward), jnp.sum(D * across)])
        if flat:
            size, direction = way[0], jnp.asarray([1.0, 0.0], D.dtype)
        else:
            still = jnp.all(way == 0)
            size = jnp.where(still, 0, jnp.sqrt(jnp.sum(jnp.where(still, 1, way * way))))
            rest = jnp.asarray([1.0, 0.0], D.dtype)
            direction = jnp.where(still, rest, way / jnp.where(still, 1, size))
        places = None if points is None else jnp.append(points, s)
        found = press_sections(
            scene.geometry, material, s, jnp.zeros_like(phi) if flat else phi, size[None],
            direction, options=SectionOptions(flat, scene.plan.options.half_width), places=places,
        )  # fmt: skip
        return jax.tree.map(lambda v: v[0], found)

    found = jax.vmap(one)(presses.s, presses.phi, presses.displacement)
    return Moved(
        force=found.force, depth=found.depth, skeleton=found.skeleton, slope_C=None,
        joints=found.joints, slopes=None, loads=None, end_U=found.end_U, end_V=found.end_V,
        status=found.status, along=found.along,
    )  # fmt: skip
