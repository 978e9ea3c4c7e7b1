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

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import product
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import Place, slide_at
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


def rub(
    scene: Scene, material: Material, state: Any, last: Instant, here: Instant, first: Anchor, hit
) -> Grip:
    """Stick or slide on the place; arguments as for `grip`."""
    assert scene.friction is not None
    depth, most = -here.seen.gap[0], SPACING_SHARE * half_spacing(scene)
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
    mismatch = MAX_MISMATCH * jnp.where(hit, depth, jnp.inf)
    inward = jnp.clip(led[0], depth - mismatch, depth + mismatch)
    rolled = now.body - anchor.body
    share = 1 - limit(jnp.where(hit, depth, 0), length(rolled))
    inward = inward + share * (depth - inward)
    way = jnp.concatenate([inward[None], led[1:]])
    slip = pick(on, _behind(scene, state, followed), no_slip(way.dtype))
    slip = _within(slip, way[1:], most)
    place = place_of(scene, material, anchor)
    assert place is not None, "friction has a second plane"
    frame = local_frame(anchor.phi)
    coulomb = Coulomb(scene.friction)
    path, slid = slide_at(place, product(frame.T, way), coulomb, scene.plan.oblique)
    # The press before this step, on the place and with the depth that it has now.
    before = press_vector(scene, anchor, last.path) + way - led
    changed = on & (follows | (inward != led[0]))
    given_up = jnp.where(changed, _energy_lost(state.slip, place, product(frame.T, before)), 0)
    force, depth_C = path.press.force[0], path.press.depth[0]
    stored = _energy(place, force, depth_C)
    total = slip._replace(held=slip.held + slid, stored=stored, force=force, depth=depth_C)
    nothing = jnp.zeros(1, way.dtype)
    held = anchor._replace(body=anchor.body + share * rolled)

    def solve(presses: Presses) -> Moved:
        refused = jnp.isnan(jnp.sum(presses.displacement, axis=1))
        moved = moved_by(path.press, scene.plan)
        slip = product(total.held, frame[1:])[None]
        numbers = moved._replace(slip=slip, dissipated=path.dissipated + given_up, status=None)
        return mask_rows(refused, numbers)._replace(status=moved.status)

    return Grip(
        anchor=anchor,
        after=re_anchor(scene, held, way - jnp.concatenate([nothing, slid]), here.path),
        touching=hit,
        way=way + jnp.concatenate([nothing, slip.held]),
        solve=solve,
        slip=total,
        total=product(total.held + total.before, frame[1:]),
    )


def _energy(place: Place, force: Float[Array, "3"], depth: Float[Array, "3"]):
    """Elastic energy of a press, N mm: of the local law, and of the skeleton."""
    yielding = jnp.sum(force * product(place.unit.compliance, force))
    return place.law.energy(jnp.sum(depth * depth)) + yielding / 2


def _energy_lost(slip: Slip, place: Place, way: Float[Array, "3"]):
    """What the press stored in the step before, and does not on this place, N mm.

    W(d) + F . (D - d) - F . C F / 2 is stationary in F and d, where it is the energy: so those of
    the step before give that of this place up to the square of the change.
    """
    force, depth = slip.force, slip.depth
    yielding = jnp.sum(force * product(place.unit.compliance, force))
    there = _energy(place, force, depth) + jnp.sum(force * (way - depth)) - yielding
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
