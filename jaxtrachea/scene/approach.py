"""From the tool's positions to presses at contact points: where it touches, and how far it goes."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import full_precision, product_of_rows
from jaxtrachea.contact.patches import Touch
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.curve import frame_at
from jaxtrachea.scene.instruments import Pull, scene_of, touch_and_pull, touch_together
from jaxtrachea.scene.landing import Landing, landing
from jaxtrachea.scene.lumen import in_lumen
from jaxtrachea.scene.stage import Poses, Presses, Scene, touch_tube


class Approach(NamedTuple):
    """A path of the tool as presses.

    Attributes:
        seen: contact of every row with the tube at rest.
        presses: displacements along (tangent, anterior, lateral) at the contact.
        inward: normal of the straight tube at the contact; shape (rows, 3).
        first: row of first touch; None: every row is a press of its own.
        frame: those directions as columns in the frame of the mesh; None: straight tube, identity.
        own: contact of every row of `presses`: `seen`, but in a step of a session.
        inside: whether the tool is in the lumen; shape (rows,).
        pull: from derivatives by the presses to those by the poses of the path; None: the contact
            point is fixed.
        landing: the first touch, where the tool stays; None: every row is a press of its own.
    """

    seen: Touch
    presses: Presses
    inward: Float[Array, "rows 3"]
    first: Int[Array, ""] | None
    frame: Float[Array, "rows 3 3"] | None
    own: Touch
    inside: Bool[Array, " rows"]
    pull: Callable[[Presses], tuple[Poses]] | None = None
    landing: Landing | None = None


@full_precision
def approach(scene: Scene, path: Poses) -> Approach:
    """Let the tool touch the tube at rest, and say what it does to the place it touches."""
    if scene.plan.contact_point == "per_step":
        return _with_pull(scene, path)
    return _on_first_touch(scene, path, touch_tube(scene, path))


@full_precision
def approach_together(
    scene: Scene, paths: Sequence[Poses]
) -> tuple[list[Approach | None], Pull | None]:
    """As `approach`, of all instruments of a scene, with one `pull` for all."""
    if scene.plan.contact_point == "per_step":
        made, (seen, pull) = on_its_own, touch_and_pull(scene, paths)
    else:
        made, seen, pull = _on_first_touch, touch_together(scene, paths), None
    views = [scene_of(scene, instrument) for instrument in scene.instruments]
    return [made(*one) for one in zip(views, paths, seen, strict=True)], pull


def _on_first_touch(scene: Scene, path: Poses, seen: Touch) -> Approach:
    """The path as presses on the place that the tool touches first."""
    inside = in_lumen(scene, path, seen)
    return on_one_point(scene, path, seen, first_touch(seen, inside)[1], inside)


def _with_pull(scene: Scene, path: Poses) -> Approach:
    """Every row as a press along the normal where it touches."""

    def pressed(path):
        made = on_its_own(scene, path, touch_tube(scene, path))
        return made.presses, made

    _, pull, made = jax.vjp(pressed, path, has_aux=True)
    return made._replace(pull=pull)


def on_its_own(scene: Scene, path: Poses, seen: Touch) -> Approach:
    """Every row as a press along the normal where it touches; without `pull`."""
    inward, frame = _directions(scene, seen)
    return Approach(
        seen=seen, presses=Presses(seen.s, seen.phi, -seen.gap[:, None] * inward), inward=inward,
        first=None, frame=frame, own=seen, inside=in_lumen(scene, path, seen),
    )  # fmt: skip


def first_touch(
    seen: Touch, inside: Bool[Array, " rows"]
) -> tuple[Bool[Array, " rows"], Int[Array, ""]]:
    """Rows that touch the tube from outside, and the first of them; without any the nearest row."""
    touching = (seen.gap < 0) & ~inside
    nearest = jnp.argmin(jnp.where(inside | jnp.isnan(seen.gap), jnp.inf, seen.gap))
    return touching, jnp.where(jnp.any(touching), jnp.argmax(touching), nearest)


def on_one_point(
    scene: Scene, path: Poses, seen: Touch, first: Int[Array, ""], inside: Bool[Array, " rows"]
) -> Approach:
    """The path as presses on the place that the tool touches first, at or before row `first`."""
    rows, place = seen.gap.shape[0], landing(scene, path, seen, first)
    D, inward = place.way, local_frame(place.phi)[0]
    if scene.plan.options.contact != "bonded":
        # A round wall falls away from the tangent plane at its first place: what is clear of it
        # does not press, though its way may lead below that plane.
        below = jnp.maximum(product_of_rows(D, inward) + seen.gap, 0)
        D = D - jnp.where(seen.gap > 0, below, 0)[:, None] * inward[None]
    if scene.plan.friction or scene.plan.options.contact == "bonded":
        # What goes on from row to row begins at first touch, where the way is 0. A pose that is no
        # number stays none.
        waits = 0
        if scene.plan.tools != "one":  # others may lift the wall to it
            waits = -jnp.maximum(seen.gap, 0)[:, None] * inward[None]
            if scene.plan.friction:
                waits = waits + D - product_of_rows(D, inward)[:, None] * inward[None]
        D = jnp.where((jnp.arange(rows) >= first)[:, None] | jnp.isnan(D), D, waits)

    def spread(v):
        return jnp.broadcast_to(v, (rows, *v.shape))

    return Approach(
        seen=seen, presses=Presses(spread(place.s), spread(place.phi), D),
        inward=spread(inward), first=first,
        frame=None if place.frame is None else spread(place.frame), own=seen, inside=inside,
        landing=place,
    )  # fmt: skip


def _directions(scene: Scene, seen: Touch):
    """Inward normal of the straight tube at every contact, and the frame of the centreline."""
    inward = jax.vmap(lambda phi: local_frame(phi)[0])(seen.phi)
    if not scene.plan.curved or scene.tube is None:
        return inward, None
    line = scene.tube.line
    return inward, jax.vmap(lambda s: frame_at(line, s))(seen.s)


def backed_out(path: Poses, made: Approach) -> Poses:
    """Where the tool stands when it just touches, before it presses."""
    rows = path.translation.shape[0]
    if made.landing is not None:
        rotation, translation = made.landing.rotation, made.landing.translation
        return Poses(*(jnp.broadcast_to(v, (rows, *v.shape)) for v in (rotation, translation)))
    inward = made.inward
    if made.frame is not None:
        inward = jnp.einsum("rij,rj->ri", made.frame, inward)
    return Poses(path.rotation, path.translation + made.seen.gap[:, None] * inward)
