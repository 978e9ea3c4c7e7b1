"""Which rows a finished plan serves: those that a plan made for them alone would solve alike.

What a row needs and the plan has not is a status, unless the user, or a tolerance, left it out
(`Plan.ignored`). Where nothing is asked, nothing is added to the program.
"""

import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxtrachea.contact.line import Centreline, point_at
from jaxtrachea.contact.patches import Touch
from jaxtrachea.scene.plan import Served
from jaxtrachea.scene.stage import COVERED, Poses, Presses, Scene
from jaxtrachea.surface import local
from jaxtrachea.trachea.material import Material

#: Largest inward motion of the wall, against the tube's radius. Ring and ligament are linear: a
#: ring pinched between two points (inextensible elastica) is softer than its linear theory says by
#: 15 % at a quarter of the radius, 25 % at a half and 35 % at the radius, where the wall has come
#: to the axis of the tube.
DEEPEST = 1.0

#: A contact on the face that closes a patch at an end of the tube: distance from the end over the
#: radius, and least part of the normal along the tube (that of a wall with relief is below 0.4).
RIM, ALONG = 0.08, 0.8

#: Values of the material that each effect reads: where they are given, a path may need it.
READ = {
    "rings": ("EI_C", "k_t"),
    "shear": ("GA_L",),
    "two_material": ("k_1_ring",),
    "axial": ("EA_L",),
}


def lacking(scene: Scene, material: Material) -> list[str]:
    """Effects that the material gives, but not the plan; the user did not leave them out."""
    plan = scene.plan
    there = {
        "rings": plan.rings != "mat", "shear": plan.options.shear, "axial": plan.axial,
        "two_material": plan.options.local == "two-material",
    }  # fmt: skip
    given = [e for e, names in READ.items() if all(getattr(material, n) is not None for n in names)]
    if plan.axial and plan.surface is not None and not plan.end_motion:
        there["end_motion"] = False
        given += ["end_motion"] * any(getattr(material, n) is not None for n in ("k_A", "k_B"))
    return [e for e in given if not there[e] and e not in plan.ignored]


def unserved(
    scene: Scene, material: Material, presses: Presses, pressing: Bool[Array, " rows"]
) -> Bool[Array, " rows"] | None:
    """Rows that press and need an effect that is off.

    Off the midline or oblique without vectors, along the tube without stretch, along the surface
    without friction, elsewhere or too far for one seat, near a surface without a dent; or anywhere
    with a material that bends, shears, lets the ends move or has rings of their own where the plan
    did not.

    Args:
        scene: -
        material: as given to `simulate`.
        presses: of every row.
        pressing: whether it does; shape (rows,). The others need nothing but their statuses.

    Returns:
        Per row; None where there is nothing to ask.
    """
    plan = scene.plan
    presses = jax.lax.stop_gradient(presses)
    D = presses.displacement
    less, found = lacking(scene, material), []
    given = not plan.contact
    if not plan.second_plane:
        found.append(_off_plane(presses))
    elif "axial" in less and (given or plan.seat == "first"):
        found.append(jnp.abs(D[:, 0]) > COVERED * _length(D) + COVERED)
    if plan.seat == "first":
        found += _seats(scene, presses) if given else _wandering(scene, presses)
        if _frictionless(scene):
            slides = pressing & (_along(presses) > COVERED * _length(D) + COVERED)
            found.append(jnp.cumsum(slides) > 0)  # what slid leaves its trace in later rows
    if plan.served is not None:
        found.append(_beyond(plan.served, presses))
    if set(less) - {"axial"}:
        found.append(jnp.ones_like(pressing))
    if plan.surface is not None and not plan.dent and "dent" not in plan.ignored:
        found.append(_near_surface(scene, presses))
    return pressing & functools.reduce(jnp.logical_or, found) if found else None


def _beyond(served: Served, presses: Presses):
    """Rows outside of what the tolerance of the plan was measured for."""
    D, phi, s = presses.displacement, presses.phi, presses.s
    c, n = jnp.cos(phi), jnp.sin(phi)
    reach = (
        (jnp.abs(phi), served.angle), (jnp.abs(D[:, 0]), served.along),
        (jnp.abs(c * D[:, 2] - n * D[:, 1]), served.across),
        (-c * D[:, 1] - n * D[:, 2], served.inward), (s, served.s[1]), (-s, -served.s[0]),
    )  # fmt: skip
    beyond = [v > limit + COVERED * (1 + abs(limit)) for v, limit in reach]
    return functools.reduce(jnp.logical_or, beyond)


def _off_plane(presses: Presses):
    """Rows that are no normal presses on the midline."""
    D = jnp.abs(presses.displacement)
    oblique = jnp.maximum(D[:, 0], D[:, 2]) > COVERED * D[:, 1] + COVERED
    return ~(jnp.abs(presses.phi) <= COVERED) | oblique


def _seats(scene: Scene, presses: Presses):
    """Rows at another contact point than the first."""
    near = lambda v: jnp.abs(v - v[0]) <= COVERED  # noqa: E731
    return [~(near(presses.s) & near(presses.phi))]


def _near_surface(scene: Scene, presses: Presses):
    """Rows whose dent would reach a vertex."""
    if scene.mesh is None:
        raise ValueError("scene.mesh is None; the plan has a surface")
    y, z = scene.radius * jnp.cos(presses.phi), scene.radius * jnp.sin(presses.phi)
    at = jnp.stack([presses.s, y, z], axis=1)
    away = jnp.sum((scene.mesh.straight[None] - at[:, None]) ** 2, axis=2)
    return jnp.min(away, axis=1) < (local.REACH * scene.footprint) ** 2


def _wandering(scene: Scene, presses: Presses):
    """Rows of a tool that has left its seat: as `rules` has it, by half a ring spacing."""
    if "seat" in scene.plan.ignored or scene.plan.options.contact == "bonded":
        return []
    return [_along(presses) > half_spacing(scene)]


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


def _along(presses: Presses):
    """Way along the surface at the contact, mm."""
    c, s = jnp.cos(presses.phi), jnp.sin(presses.phi)
    D = presses.displacement
    return jnp.sqrt(D[:, 0] ** 2 + (c * D[:, 2] - s * D[:, 1]) ** 2)


def _length(D):
    return jnp.sqrt(jnp.sum(D * D, axis=-1))


def depth_share(scene: Scene, depth, skeleton, inward):
    """Inward motion of the wall at the contact (indentation and skeleton) over the tube's radius.

    Motion outwards counts as 0, motion along the surface as nothing.

    Args:
        scene: -
        depth: local indentation, mm; shape (..., 3).
        skeleton: displacement of C with the skeleton, mm; likewise.
        inward: inward normal of the tube at the contact; likewise.
    """
    way = jnp.sum((depth + skeleton) * inward, axis=-1)
    return jax.lax.stop_gradient(jnp.maximum(way, 0) / scene.radius)


def contact_share(scene: Scene, seen: Touch):
    """Penetration against what the search for a contact is sure of: radii of tool and patches."""
    if scene.tool is None or scene.tube is None:
        raise ValueError("scene.tool is None; contact needs a tool")
    sure = scene.tool.radius + jnp.min(scene.tube.shapes.radius)
    return jax.lax.stop_gradient(jnp.maximum(-seen.gap, 0) / jnp.where(sure > 0, sure, jnp.nan))


class Side(enum.IntEnum):
    """Where a tool is, as far as its way tells."""

    UNTOLD = 0
    BEFORE_AN_END = 1
    IN_LUMEN = 2
    OUTSIDE = 3


class Whereabouts(NamedTuple):
    """What a pose tells of it; shape (rows,) each.

    Attributes:
        known: the pose and its contact are finite.
        off: the contact lies beyond an end, or on a face that closes it.
        clear: the tool does not touch.
        within: all of it lies within the inner wall.
        centred: its middle lies within the middle of the wall.
    """

    known: Bool[Array, " rows"]
    off: Bool[Array, " rows"]
    clear: Bool[Array, " rows"]
    within: Bool[Array, " rows"]
    centred: Bool[Array, " rows"]


def whereabouts(scene: Scene, path: Poses, seen: Touch) -> Whereabouts:
    """Look at the place of the tool.

    Its corners' distance from the centreline, not the gap, says what is within: patches of a mesh
    are closed, and deep in one of them the nearest way out may be the one along the tube. The wall
    of an imported mesh has no thickness here.
    """
    if scene.tool is None or scene.tube is None:
        raise ValueError("scene.tool is None; contact needs a tool")
    gap = jax.lax.stop_gradient(seen.gap)
    wall = 2 * jnp.maximum(scene.radius - scene.geometry.radius, 0)
    room = scene.radius - wall - scene.tool.radius
    corners = path.rotation @ scene.tool.vertices + path.translation[:, :, None]
    line = scene.tube.line if scene.plan.curved else None
    off_axis = jax.vmap(functools.partial(_off_axis, line))
    square = jax.vmap(off_axis, 2, 1)(corners)
    return Whereabouts(
        known=jnp.isfinite(jnp.sum(corners, axis=(1, 2)) + gap),
        off=off_the_end(scene, seen),
        clear=gap >= 0,
        within=(jnp.max(square, axis=1) < room * room) & (room > 0),
        centred=off_axis(jnp.mean(corners, axis=2)) < (scene.radius - wall / 2) ** 2,
    )


def next_side(side: Int[Array, ""], at: Whereabouts) -> Int[Array, ""]:
    """The side after one more pose (fields of `at` without rows).

    A tool that does not touch the tube beside its ends is outside; one that touches stays on its
    side. A way that begins wholly within the inner wall begins in the lumen; a tool that comes
    over an end is in the lumen if its middle is.
    """
    begins = jnp.where(side == Side.UNTOLD, at.within, at.centred)
    inside = jnp.where(side <= Side.BEFORE_AN_END, begins, side == Side.IN_LUMEN)
    touching = jnp.where(inside, Side.IN_LUMEN, Side.OUTSIDE)
    beside = ~at.off | (at.within & ~at.clear)
    new = jnp.where(at.clear, Side.OUTSIDE, touching)
    return jnp.where(at.known, jnp.where(beside, new, Side.BEFORE_AN_END), side)


def _off_axis(line: Centreline | None, point):
    """Square of the distance from the centreline (by its nearest sample), mm^2."""
    if line is None:
        return jnp.sum(point[1:] ** 2)
    away = point[None] - line.points
    square = jnp.sum(away * away, axis=1)
    nearest = jnp.argmin(square)
    return square[nearest] - jnp.sum(away[nearest] * line.tangents[nearest]) ** 2


def off_the_end(scene: Scene, seen: Touch) -> Bool[Array, " rows"]:
    """Rows whose contact lies beyond an end of the tube, or on the face that closes it.

    Patches of a mesh are closed, the tube is not: at its ends there is no wall across.
    """
    s, length = seen.s, scene.geometry.length
    beyond = (s < 0) | (s > length)
    if scene.tube is None:
        return beyond
    if scene.plan.curved:
        line = scene.tube.line
        tangent = jax.vmap(lambda v: point_at(line, v)[1])(s)
        along = jnp.sum(seen.normal * tangent, axis=1)
    else:
        along = seen.normal[:, 0]
    rim = RIM * scene.radius
    return beyond | ((s < rim) & (along < -ALONG)) | ((s > length - rim) & (along > ALONG))


def in_lumen(scene: Scene, path: Poses, seen: Touch) -> Bool[Array, " rows"]:
    """Rows of a tool in the lumen, by its way so far (`next_side`)."""
    at = whereabouts(scene, path, seen)

    def step(side, at):
        side = next_side(side, at)
        return side, (side == Side.IN_LUMEN) & at.known

    return jax.lax.scan(step, jnp.asarray(Side.UNTOLD), at)[1]
