r"""A step with Coulomb friction: the return map of `press_path` on the place that the tool holds.

Where the tool touches first, a way begins; what it has gone since is the slip and a press that the
wall answers to elastically. A step moves the press, and the return map takes from it what slides:
|F_t| <= mu F_n, with equality where it slides. On a path that `simulate` takes with one contact
point both give the same numbers. Beyond it the place follows the contact.

The normal part of the press goes with the way along the normal of the place. Where that differs
from the depth of the tool by more than half of it (round the tube), it gives way, so that the force
is 0 where the tool leaves the tube. The point of the tool that holds stays within the depth of the
contact: a tool that rolls or spins takes another one, pressed straight in. A step longer than the
tube's radius, or along the surface than the dent is wide, is no path: the tool touches anew,
straight in.

A place that follows or gives way stores more or less than before, at the same press. No hand does
this work, so it is told as dissipated: what of friction is left to the elastic wall (dE/ds, as in
`configurational`), and what a press that gives way loses.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import product
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import slide_at
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.anchor import (
    MAX_MISMATCH,
    SPACING_SHARE,
    Anchor,
    Instant,
    anchor_at,
    follow,
    has_left,
    length,
    limit,
    place_of,
    press_vector,
    re_anchor,
    step_length,
)
from jaxtrachea.scene.grip import Grip, Slip, pick
from jaxtrachea.scene.programs import Moved, moved_by
from jaxtrachea.scene.ranges import half_spacing
from jaxtrachea.scene.refusals import mask_rows
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.trachea.material import Material


def no_slip(dtype) -> Slip:
    """Before the first touch."""
    none = jnp.zeros(3, dtype)
    return Slip(none[:2], none[:2], none[0], none, none)


class Led(NamedTuple):
    """A tool on its place before what slides is known.

    Attributes:
        anchor: the place.
        held: the place with the point of the tool that the next step begins with.
        way: of the press since it last slid, see `anchor.press_vector`.
        before: that of the step before, on this place; as the press was then.
        on: it is on that of the step before.
        changed: the place is not that of the step before, or its press gives way.
        slip: what it has slid before this step.
        touching: -
    """

    anchor: Anchor
    held: Anchor
    way: Float[Array, "3"]
    before: Float[Array, "3"]
    on: Bool[Array, ""]
    changed: Bool[Array, ""]
    slip: Slip
    touching: Bool[Array, ""]


class Answer(NamedTuple):
    """What the wall answers to a tool that is led; vectors in the frame of the tube.

    Attributes:
        law: the local law at its place.
        force: N.
        depth: local indentation, mm.
        skeleton: what the forces move the place, mm.
        sunk: what the forces of the step before would, mm.
        slid: along and round the tube, mm.
        dissipated: by friction, N mm.
        began: where the slip of this step began, mm: not at 0 on a wall that others have dragged.
    """

    law: Law
    force: Float[Array, "3"]
    depth: Float[Array, "3"]
    skeleton: Float[Array, "3"]
    sunk: Float[Array, "3"]
    slid: Float[Array, "2"]
    dissipated: Float[Array, ""]
    began: Float[Array, "2"]


def rub(
    scene: Scene, material: Material, state: Any, last: Instant, here: Instant, first: Anchor, hit
) -> Grip:
    """Stick or slide on the place; arguments as for `grip`."""
    assert scene.friction is not None
    led = lead(scene, state, last, here, first, hit)
    place = place_of(scene, material, led.anchor)
    assert place is not None, "friction has a second plane"
    way = product(local_frame(led.anchor.phi).T, led.way)
    path, slid = slide_at(place, way, Coulomb(scene.friction), scene.plan.oblique)
    sunk = product(place.unit.compliance, led.slip.force)
    press = path.press
    answer = Answer(
        place.law, press.force[0], press.depth[0], press.skeleton[0], sunk, slid,
        path.dissipated[0], jnp.zeros_like(slid),
    )  # fmt: skip
    after, total, lost = let_go(scene, led, answer, here)
    along = local_frame(led.anchor.phi)[1:]

    def solve(presses: Presses) -> Moved:
        refused = jnp.isnan(jnp.sum(presses.displacement, axis=1))
        moved = moved_by(press, scene.plan)
        slip = product(total.held, along)[None]
        numbers = moved._replace(slip=slip, dissipated=lost[None], status=None)
        return mask_rows(refused, numbers)._replace(status=moved.status)

    return Grip(
        anchor=led.anchor,
        after=after,
        touching=hit,
        way=whole_way(led),
        solve=solve,
        slip=total,
        total=product(total.held + total.before, along),
    )


def lead(scene: Scene, state: Any, last: Instant, here: Instant, first: Anchor, hit) -> Led:
    """The place that the tool holds now, and its press; arguments as for `grip`."""
    depth, most = -here.seen.gap[0], SPACING_SHARE * half_spacing(scene)
    deep = jnp.maximum(depth, 0)  # not so where others raise the wall to a tool above it
    teleported = step_length(first, last, here) > scene.radius
    teleported = teleported | (state.touching & has_left(scene, state.anchor, last, here))
    on = state.touching & hit & ~teleported
    followed = follow(scene, state.anchor, here, most)
    # To the bit where it was, if it did not follow: a tool that sticks has no slip at all.
    follows = jnp.any(followed.point != state.anchor.point)
    followed = pick(follows, followed, state.anchor)
    now = anchor_at(scene, here)
    anchor = pick(teleported, now, pick(on, followed, first))
    led = press_vector(scene, anchor, here.path)
    mismatch = MAX_MISMATCH * jnp.where(hit, deep, jnp.inf)
    inward = jnp.clip(led[0], depth - mismatch, depth + mismatch)
    rolled = now.body - anchor.body
    share = 1 - limit(jnp.where(hit, deep, 0), length(rolled))
    inward = inward + share * (depth - inward)
    way = jnp.concatenate([inward[None], led[1:]])
    slip = pick(on, _behind(scene, state, followed), no_slip(way.dtype))
    return Led(
        anchor=anchor,
        held=anchor._replace(body=anchor.body + share * rolled),
        way=way,
        before=press_vector(scene, anchor, last.path) + way - led,
        on=on,
        changed=on & (follows | (inward != led[0])),
        slip=_within(slip, way[1:], most),
        touching=hit,
    )


def whole_way(led: Led) -> Float[Array, "3"]:
    """The way since the tool touched this place, with what it has slid before, mm."""
    return led.way + jnp.concatenate([jnp.zeros_like(led.way[:1]), led.slip.held])


def let_go(
    scene: Scene, led: Led, answer: Answer, here: Instant
) -> tuple[Anchor, Slip, Float[Array, ""]]:
    """What the next step begins with, the slip so far, and the work that is lost, N mm."""
    frame, none = local_frame(led.anchor.phi), jnp.zeros_like(led.way[:1])
    lost = _energy_lost(led.slip, answer, product(frame.T, led.before))
    stored = _energy(answer, answer.force, answer.depth, answer.skeleton)
    total = led.slip._replace(
        held=led.slip.held + answer.slid - answer.began, stored=stored, force=answer.force,
        depth=answer.depth,
    )  # fmt: skip
    way = led.way - jnp.concatenate([none, answer.slid])
    after = re_anchor(scene, led.held, way, here.path)
    return after, total, answer.dissipated + jnp.where(led.changed, lost, 0)


def _energy(answer: Answer, force, depth, moved):
    """Elastic energy of a press, N mm: of the local law, and of the skeleton that it moves."""
    return answer.law.energy(jnp.sum(depth * depth)) + jnp.sum(force * moved) / 2


def _energy_lost(slip: Slip, answer: Answer, way: Float[Array, "3"]):
    """What the press stored in the step before, and does not on this place, N mm.

    W(d) + F . (D - d) - F . C F / 2 is stationary in F and d, where it is the energy: so those of
    the step before give that of this place up to the square of the change.
    """
    force, depth, moved = slip.force, slip.depth, answer.sunk
    there = _energy(answer, force, depth, moved) + jnp.sum(force * (way - depth - moved))
    lost = slip.stored - there
    return jnp.where(jnp.isfinite(lost), lost, 0)


def _behind(scene: Scene, state: Any, followed: Anchor) -> Slip:
    """The slip once the place has followed the contact: what lies behind it is no longer held."""
    turn = followed.phi - state.anchor.phi
    turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    return _left(state.slip, jnp.stack([followed.s - state.anchor.s, scene.radius * turn]))


def _within(slip: Slip, way: Float[Array, "2"], most: Float[Array, ""]) -> Slip:
    """A slip that is held no further than one place serves (a tool may turn on the spot)."""
    gone = way + slip.held
    return _left(slip, (1 - limit(most, length(gone))) * gone)


def _left(slip: Slip, way: Float[Array, "2"]) -> Slip:
    return slip._replace(held=slip.held - way, before=slip.before + way)
