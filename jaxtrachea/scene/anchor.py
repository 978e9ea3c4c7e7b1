r"""The place of the tube that a tool holds from step to step, and how that place gives way.

While the gap of the undeformed tube is negative the tool is on the tube, pressed in by
delta = -gap. It holds the place that it touched first: the way that its body point there has gone
since is the press e of that place, as in `simulate`. The anchor gives way where

    |e_t| > delta               it went further along the surface than in (`MAX_SLIDE`),
    |e_n - delta| > delta / 2   turned or led off, it presses elsewhere (`MAX_MISMATCH`), or
    F_n < 0.1 F_n0              the place would have to be pulled (`LEAST_FORCE_SHARE`),

by sliding: e moves straight towards the press delta n that goes straight in (of force F_0), as far
as to the border of these. The place follows the tool's contact at a distance of at most delta. Both
close in at delta = 0: so force is continuous in the pose, and 0 where the tool leaves the tube; the
same pose again changes nothing. Sliding takes energy out as long as the deformed wall is inclined
by less than 45 degrees at the contact, and a place pushed inwards would go less far aside than in:
then the work over closed loops of the tool is not negative.

`MAX_SLIDE` limits the way along the surface, not the force. It is no law of friction: the
tangential force is what the skeleton answers to that way, in 5,000 poses 0.69 of the normal force
in the median, 2.4 at most (`tests/bench/jumps.py`). With contact point `per_step` there is no way
along the surface; `scene.configurational` has its force.

A tool that goes further along the tube in one step than its dent is wide has left its anchor: it
grasps anew where it is. A glued tool (`bonded`) holds its first place whatever it does.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import product, solve_spd
from jaxtrachea.contact.patches import Touch
from jaxtrachea.contact.pose import Pose, inverse, nearest_rotation, transform
from jaxtrachea.mechanics.oblique import Place, place_at
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.landing import Landing, axes_at, landing
from jaxtrachea.scene.needs import DRAGS, PLANNED
from jaxtrachea.scene.ranges import half_spacing
from jaxtrachea.scene.refusals import on_the_tube
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.trachea.material import Material

#: Way along the surface that an anchor holds, over the depth; and that of several tools off the
#: midline, which slide on the wall: half of what a plan without friction takes (`needs.drags`).
MAX_SLIDE, MAX_DRAG = 1.0, DRAGS * PLANNED
#: Largest difference of the anchor's press and the tool's depth, over the depth.
MAX_MISMATCH = 0.5
#: Least normal force, over that of a press straight in.
LEAST_FORCE_SHARE = 0.1
#: Share of half a ring spacing that an anchor holds at most: beyond it one place does not serve.
SPACING_SHARE = 0.99
#: Length of the press over the depth, at most: with it the local law is at its stiffest.
STRETCHED = 3.0


class Instant(NamedTuple):
    """Where the tool was, and what it touched; leading axis 1."""

    path: Poses
    seen: Touch


class Anchor(NamedTuple):
    """The place that the tool holds, in the frame of the mesh.

    Attributes:
        s: its position, mm.
        phi: its angle, rad.
        point: of the tube at rest, mm; shape (3,).
        body: point of the tool that holds it, in the tool's frame, mm; shape (3,).
        unpressed: where that point would be without a press, mm; shape (3,).
        rotation: of the tool as it would stand there; shape (3, 3).
        translation: likewise, mm; shape (3,).
        status: `ContactStatus` of the contact it comes from.
    """

    s: Float[Array, ""]
    phi: Float[Array, ""]
    point: Float[Array, "3"]
    body: Float[Array, "3"]
    unpressed: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    status: Int[Array, ""]


def anchor_at(scene: Scene, here: Instant) -> Anchor:
    """The anchor of a tool that stands on its contact, pressed straight in."""
    path, seen = jax.tree.map(lambda v: v[0], tuple(here))
    pose = Pose(path.rotation, path.translation)
    body = transform(inverse(pose), seen.tool_point[:, None])[:, 0]
    lift = seen.gap * _to_mesh(scene, seen.s, local_frame(seen.phi)[0])
    return Anchor(
        s=seen.s,
        phi=seen.phi,
        point=seen.point,
        body=body,
        unpressed=_at(path, body) + lift,
        rotation=path.rotation,
        translation=path.translation + lift,
        status=seen.status,
    )


def first_contact(scene: Scene, before: Instant, here: Instant) -> Anchor:
    """The anchor of a first touch: the way along the surface since then counts."""

    def join(v, w):
        return jnp.concatenate([v, w])

    path = jax.tree.map(join, before.path, here.path)
    seen = jax.tree.map(join, before.seen, here.seen)
    place = landing(scene, path, seen, jnp.asarray(1))
    anchor = Anchor(
        s=place.s, phi=place.phi, point=place.point, body=place.body, unpressed=place.point,
        rotation=place.rotation, translation=place.translation, status=here.seen.status[0],
    )  # fmt: skip
    return re_anchor(scene, anchor, _times(local_frame(anchor.phi), place.way[1]), here.path)


def has_left(scene: Scene, anchor: Anchor, before: Instant, here: Instant) -> Bool[Array, ""]:
    """Whether the tool went further along the tube in this step than its dent is wide."""
    way = press_vector(scene, anchor, here.path) - press_vector(scene, anchor, before.path)
    return length(way[1:]) > scene.footprint + jnp.maximum(-here.seen.gap[0], 0)


def step_length(anchor: Anchor, before: Instant, here: Instant) -> Float[Array, ""]:
    """Way of the body point in this step, mm."""
    return length(_at(_one(here.path), anchor.body) - _at(_one(before.path), anchor.body))


def follow(scene: Scene, anchor: Anchor, here: Instant, most: Float[Array, ""]) -> Anchor:
    """The anchor after its place has followed the tool's contact; its press is the same vector.

    Args:
        here: the tool now.
        most: distance at which the place follows, mm.
    """
    now = anchor_at(scene, here)
    turn = now.phi - anchor.phi
    turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    lag = jnp.stack([now.s - anchor.s, scene.radius * turn])
    share = 1 - limit(most, length(lag))

    def mix(old, new):
        return old + share * (new - old)

    body = mix(anchor.body, now.body)
    path = _one(here.path)
    phi = anchor.phi + share * turn
    return Anchor(
        s=mix(anchor.s, now.s),
        phi=jnp.arctan2(jnp.sin(phi), jnp.cos(phi)),
        point=mix(anchor.point, now.point),
        body=body,
        unpressed=anchor.unpressed + _at(path, body) - _at(path, anchor.body),
        rotation=nearest_rotation(mix(anchor.rotation, now.rotation), now.rotation),
        translation=mix(anchor.translation, now.translation),
        status=jnp.where(share > 0, now.status, anchor.status),
    )


def place_of(scene: Scene, material: Material, anchor: Anchor) -> Place | None:
    """What the skeleton does at the anchor; None if the plan has a single plane."""
    plan = scene.plan
    if not plan.second_plane:
        return None
    s, phi, _ = on_the_tube(scene, anchor.s, anchor.phi)
    return place_at(scene.geometry, material, s, phi, plan.oblique)


def press_vector(scene: Scene, anchor: Anchor, path: Poses) -> Float[Array, "3"]:
    """How far the tool has pressed its anchor, mm: along (inward, tangent, round the tube)."""
    way = _at(_one(path), anchor.body) - anchor.unpressed
    axes = axes_at(scene, anchor.s)
    return _times(local_frame(anchor.phi), way if axes is None else _times(axes.T, way))


def yielded(
    scene: Scene, way: Float[Array, "3"], depth: Float[Array, ""], place: Place | None
) -> Float[Array, "3"]:
    """What is left of a press after the anchor has given way: no more than the borders allow.

    Args:
        way: of the press, see `press_vector`.
        depth: -gap of the tool, mm; positive.
        place: the skeleton at the anchor.
    """
    off = way - depth * jnp.eye(3, dtype=way.dtype)[0]
    share = limit(largest_slide(scene, depth), length(off[1:]))
    share = jnp.minimum(share, limit(MAX_MISMATCH * depth, jnp.abs(off[0])))
    row = _stiffness(scene, depth, place)
    if row is not None:
        share = jnp.minimum(
            share, limit((1 - LEAST_FORCE_SHARE) * depth * row[0], -jnp.sum(row * off))
        )
    return way - (1 - share) * off


def _stiffness(scene: Scene, depth, place: Place | None) -> Float[Array, "3"] | None:
    """Normal force per press along (inward, tangent, round the tube), N/mm.

    None where a press along the surface makes none: only rings as arches in two planes couple them.
    The local law is taken at its stiffest, where they are coupled most.
    """
    plan = scene.plan
    if place is None or plan.rings != "arch2" or plan.options.coupling != "series":
        return None
    frame = local_frame(place.phi_c)
    stretched = STRETCHED * depth
    local = place.law.stiffest(stretched * stretched)
    C = product(frame, product(place.unit.compliance, frame.T))
    one = jnp.eye(3, dtype=C.dtype)
    known = jnp.isfinite(jnp.sum(C) + local) & (local > 0)
    return solve_spd(jnp.where(known, C + one / jnp.where(known, local, 1), one), one[0])


def as_approach(
    scene: Scene, anchor: Anchor, way: Float[Array, "3"], here: Instant, inside: Bool[Array, "1"]
) -> tuple[Poses, Approach]:
    """One row for `simulation.pressed`: the tool as it stands on its anchor, and what it does."""
    frame, axes = local_frame(anchor.phi), axes_at(scene, anchor.s)
    now = jax.tree.map(lambda v: v[0], here.seen)
    seen = dataclasses.replace(
        now, gap=jnp.zeros_like(now.gap), point=anchor.point, s=anchor.s, phi=anchor.phi,
        status=anchor.status,
    )  # fmt: skip
    presses = Presses(anchor.s[None], anchor.phi[None], _times(frame.T, way)[None])
    made = Approach(
        seen=jax.tree.map(lambda v: v[None], seen),
        presses=presses,
        inward=frame[:1],
        first=jnp.asarray(0),
        landing=Landing(
            s=anchor.s,
            phi=anchor.phi,
            point=anchor.point,
            body=anchor.body,
            rotation=anchor.rotation,
            translation=anchor.translation,
            frame=axes,
            way=presses.displacement,
        ),
        frame=None if axes is None else axes[None],
        own=here.seen,
        inside=inside,
    )
    return Poses(anchor.rotation[None], anchor.translation[None]), made


def re_anchor(scene: Scene, anchor: Anchor, way: Float[Array, "3"], path: Poses) -> Anchor:
    """The anchor that this way presses, with the tool where it is."""
    press = _to_mesh(scene, anchor.s, _times(local_frame(anchor.phi).T, way))
    return anchor._replace(unpressed=_at(_one(path), anchor.body) - press)


def largest_slide(scene: Scene, depth):
    """Way along the surface that an anchor holds at this depth, mm."""
    several = scene.plan.tools != "one" and scene.plan.second_plane
    most = MAX_DRAG if several else MAX_SLIDE
    return jnp.minimum(most * depth, SPACING_SHARE * half_spacing(scene))


def _to_mesh(scene: Scene, s, vector):
    axes = axes_at(scene, s)
    return vector if axes is None else _times(axes, vector)


def _times(matrix, vector):
    """Their product; for 3 numbers a sum is quicker than a call of a library."""
    return jnp.sum(matrix * vector[None], axis=1)


def _one(path: Poses) -> Poses:
    return jax.tree.map(lambda v: v[0], path)


def _at(pose: Poses, body):
    return _times(pose.rotation, body) + pose.translation


def limit(most, value):
    """Share of `value` that is `most`; 1 where it is less, 0 where nothing is allowed."""
    over = value > most
    return jnp.where(over, jnp.maximum(most, 0) / jnp.where(over, value, 1), 1)


@jax.custom_jvp
def length(v: Float[Array, " n"]) -> Float[Array, ""]:
    """Norm, with derivative 0 at 0 (forwards without a guard: that takes a step longer)."""
    return jnp.sqrt(jnp.sum(v * v))


@length.defjvp
def _length_jvp(primals, tangents):
    (v,), (dv,) = primals, tangents
    norm = length(v)
    return norm, jnp.sum(v * dv) / jnp.where(norm > 0, norm, 1)
