"""Which rows a finished plan serves: those that a plan made for them alone would solve alike.

What a row needs and the plan has not is a status, unless the user, or a tolerance, left it out
(`Plan.ignored`). Where nothing is asked, nothing is added to the program.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxtrachea.contact.patches import Touch
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.scene.depth import SHALLOW, departure
from jaxtrachea.scene.effects import EFFECTS, given_values
from jaxtrachea.scene.needs import (
    COVERED,
    Motion,
    axial,
    drags,
    elsewhere,
    lateral,
    motion_of,
    off_midline,
    rubs,
)
from jaxtrachea.scene.plan import ValidRange
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.surface import local

#: Largest inward motion of the wall, against the tube's radius. Ring and ligament are linear: a
#: ring pinched between two points (inextensible elastica) is softer than its linear theory says by
#: 15 % at a quarter of the radius, 25 % at a half and 35 % at the radius, where the wall has come
#: to the axis of the tube.
DEEPEST = 1.0


def lacking(scene: Scene, material: AnyMaterial) -> list[str]:
    """Effects that the material gives, but not the plan; the user did not leave them out."""
    plan, known = scene.plan, given_values(material)
    return [
        e.name for e in EFFECTS.values()
        if e.given(known) and not plan.has(e.name) and all(map(plan.has, e.requires))
        and e.name not in plan.ignored
    ]  # fmt: skip


def outside_plan(
    scene: Scene, material: AnyMaterial, presses: Presses, pressing: Bool[Array, " rows"]
) -> Bool[Array, " rows"] | None:
    """Rows that press and need an effect that is off.

    Off the midline or oblique without vectors, along the tube without stretch (of several tools
    without friction: dragging the wall along), along the surface without friction, deep without a
    skeleton that softens, elsewhere or too far for one contact point, near a surface without a
    dent; or anywhere with a material that bends, shears, lets the ends move or has rings of their
    own where the plan did not.

    Args:
        material: as given to `simulate`.
        presses: of every row.
        pressing: whether it does; shape (rows,). The others need nothing but their statuses.

    Returns:
        Per row; None where there is nothing to ask.
    """
    plan = scene.plan
    presses = jax.lax.stop_gradient(presses)
    motion = motion_of(presses.s, presses.phi, presses.displacement)
    less, found = lacking(scene, material), []
    given = not plan.contact
    if not plan.second_plane:
        found.append(off_midline(presses.phi) | axial(motion) | lateral(motion))
    elif plan.tools != "one" and not plan.friction:
        found.append(drags(motion))
    elif not plan.mechanics.follows_axial:
        found.append(axial(motion))
    elif "axial" in less and (given or plan.contact_point == "fixed"):
        found.append(axial(motion))
    if plan.contact_point == "fixed":
        found += [elsewhere(motion)] if given else _wandering(scene, motion)
        if _frictionless(scene):
            # What slid leaves its trace in later rows.
            found.append(jnp.cumsum(pressing & rubs(motion)) > 0)
    if plan.valid_range is not None:
        found.append(_beyond(plan.valid_range, presses))
    if "skeleton" in less:
        found.append(deep(scene, material, _inward(presses)))
    if set(less) - {"axial", "skeleton"}:
        found.append(jnp.ones_like(pressing))
    if plan.surface is not None and not plan.dent and "dent" not in plan.ignored:
        found.append(_near_surface(scene, presses))
    return pressing & functools.reduce(jnp.logical_or, found) if found else None


def _beyond(valid_range: ValidRange, presses: Presses):
    """Rows outside of what the tolerance of the plan was measured for."""
    D, phi, s = presses.displacement, presses.phi, presses.s
    c, n = jnp.cos(phi), jnp.sin(phi)
    reach = (
        (jnp.abs(phi), valid_range.angle), (jnp.abs(D[:, 0]), valid_range.along),
        (jnp.abs(c * D[:, 2] - n * D[:, 1]), valid_range.across),
        (_inward(presses), valid_range.inward), (s, valid_range.s[1]), (-s, -valid_range.s[0]),
    )  # fmt: skip
    beyond = [v > limit + COVERED * (1 + abs(limit)) for v, limit in reach]
    return functools.reduce(jnp.logical_or, beyond)


def deep(scene: Scene, material, inward):
    """Where the wall is moved so far that a skeleton which can soften does: as `depth` has it."""
    if scene.plan.options.contact == "bonded":
        inward = jnp.abs(inward)
    error = departure((material.e_1, material.e_2), jnp.maximum(inward, 0))
    return error > SHALLOW + COVERED


def _inward(presses: Presses):
    """Way along the inward normal, mm."""
    D, phi = presses.displacement, presses.phi
    return -jnp.cos(phi) * D[:, 1] - jnp.sin(phi) * D[:, 2]


def _near_surface(scene: Scene, presses: Presses):
    """Rows whose dent would reach a vertex."""
    if scene.mesh is None:
        raise ValueError("scene.mesh is None; the plan has a surface")
    y, z = scene.radius * jnp.cos(presses.phi), scene.radius * jnp.sin(presses.phi)
    at = jnp.stack([presses.s, y, z], axis=1)
    away = jnp.sum((scene.mesh.straight[None] - at[:, None]) ** 2, axis=2)
    return jnp.any(away < (local.REACH * scene.footprint) ** 2, axis=1)


def _wandering(scene: Scene, motion: Motion):
    """Rows of a tool that has left its contact point: as `rules` has it, by half a ring spacing."""
    if "contact_point" in scene.plan.ignored or scene.plan.options.contact == "bonded":
        return []
    return [motion.slip > half_spacing(scene) + COVERED]


def half_spacing(scene: Scene):
    """Half of the least distance of two rings, mm: as far one place serves."""
    x = scene.geometry.ring_positions
    spacing = jnp.min(x[1:] - x[:-1]) if x.shape[0] > 1 else scene.geometry.length
    return spacing / 2


def _frictionless(scene: Scene) -> bool:
    """Whether there is a coefficient of friction that the plan does not use, but could."""
    plan = scene.plan
    fits = plan.options.contact == "unilateral" and plan.options.coupling == "series"
    left_out = scene.friction is not None and not plan.friction
    return left_out and fits and "friction" not in plan.ignored


def depth_share(scene: Scene, depth, skeleton, inward):
    """Inward motion of the wall at the contact (indentation and skeleton) over the tube's radius.

    By the radius of the level (`wall_radius`). Motion outwards counts as 0,
    motion along the surface as nothing.

    Args:
        depth: local indentation, mm; shape (..., 3).
        skeleton: displacement of C with the skeleton, mm; likewise.
        inward: inward normal of the tube at the contact; likewise.
    """
    way = jnp.sum((depth + skeleton) * inward, axis=-1)
    radius = scene.plan.mechanics.wall_radius(scene.geometry, scene.radius)
    return jax.lax.stop_gradient(jnp.maximum(way, 0) / radius)


def contact_share(scene: Scene, seen: Touch):
    """Penetration against what the search for a contact is sure of: radii of tool and patches."""
    if scene.tool is None or scene.tube is None:
        raise ValueError("scene.tool is None; contact needs a tool")
    own = scene.tool.radius if seen.part is None else scene.tool.radius[seen.part]
    sure = own + jnp.min(scene.tube.shapes.radius)
    return jax.lax.stop_gradient(jnp.maximum(-seen.gap, 0) / jnp.where(sure > 0, sure, jnp.nan))
