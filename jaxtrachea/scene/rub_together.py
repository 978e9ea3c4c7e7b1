"""Friction of several tools: what each drags along, with the forces of all others."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import product_of_rows
from jaxtrachea.mechanics.contacts_friction import (
    Stand,
    moved_by_others,
    slide_paths,
    slide_together,
)
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb, Slide
from jaxtrachea.mechanics.influence_vector import (
    VectorInfluence,
    by_all,
    influence_vector,
    own_contacts,
)
from jaxtrachea.mechanics.press import local_law
from jaxtrachea.mechanics.press_contacts_path import smooth_touch
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.anchor import as_approach
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.grip import pick
from jaxtrachea.scene.hold import touched
from jaxtrachea.scene.instruments import views
from jaxtrachea.scene.refusals import on_the_tube
from jaxtrachea.scene.rows import Rows, enter
from jaxtrachea.scene.rub import Answer, Led, lead, let_go, whole_way
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.trachea.material import Material


class Rubbed(NamedTuple):
    """What tools that rub do to the wall.

    Attributes:
        unit: what unit forces in all directions of all contacts move.
        slid: of each tool in each row, in (inward, along, round the tube) of its contact; slip less
            `began` is that since it touched first.
    """

    unit: VectorInfluence
    slid: Slide


def influence_of(
    scene: Scene, material: Material, s: Float[Array, " m"], phi: Float[Array, " m"]
) -> VectorInfluence:
    """What contacts off the midline move: by inward forces, or with friction by all."""
    plan = scene.plan
    return influence_vector(
        scene.geometry, material, s, phi, rings=plan.rings, shear=plan.options.shear,
        tangential=plan.friction, axial=plan.axial,
    )  # fmt: skip


def rub_paths(
    scene: Scene,
    material: Material,
    s: Float[Array, " m"],
    phi: Float[Array, " m"],
    presses: Sequence[Presses],
    hidden: Bool[Array, " rows"],
    made: Sequence[Approach | None],
) -> Rubbed:
    """Follow all tools side by side.

    Args:
        scene: of several instruments with friction.
        material: values that are not negative.
        s: places of the contacts, mm.
        phi: their angles, rad.
        presses: of each tool.
        hidden: rows that are passed over.
        made: their ways; None: presses.
    """
    unit, row, lands = influence_of(scene, material, s, phi), jnp.arange(len(hidden)), None
    firsts = [
        jnp.where(m.seen.gap[m.first] < 0, m.first, -1)  # none: it never touches the wall at rest
        for m in made if m is not None and m.first is not None
    ]  # fmt: skip
    if firsts:
        lands = row[:, None] == jnp.stack(firsts)[None]
    D = jnp.stack([_in_its_frame(p, hidden) for p in presses], axis=1)
    D = jnp.where(hidden[:, None, None], jnp.nan, smooth_touch(D, scene.plan.options))
    law, mu = law_of(scene, material, s), mu_of(scene)
    return Rubbed(unit, slide_paths(D, felt(scene, unit), law, mu, lands))


def _stand(scene: Scene, unit: VectorInfluence, led: Led, before: Float[Array, "m 3"]) -> Stand:
    """Where each tool stands at the beginning of a step, against the wall as the others hold it.

    One that comes to the wall at rest stands above the wall that others press, and over the place
    of it that they have dragged there: no way of theirs stretches what it touches.

    Args:
        scene: -
        unit: what contacts move.
        led: the tools.
        before: forces before the step, in the directions of the contacts.
    """
    moved = moved_by_others(felt(scene, unit), jnp.where(jnp.isfinite(before), before, 0))
    # Its way counts from the wall at rest, but where others have raised that: it came to it before.
    lands = led.touching & ~led.on
    met = lands & (moved[:, 0] < 0) & _goes_on(scene, led)
    above = jnp.maximum(moved[:, 0] - jnp.where(lands & ~met, 0, led.before[:, 0]), 0)
    clear = ~(led.on & (before[:, 0] > 0))
    came = jnp.where(met[:, None], led.before[:, 1:], 0)
    slip = jnp.where(led.on[:, None], 0, came - moved[:, 1:])
    return Stand(slip, jnp.where(clear, above, 0), jnp.zeros_like(before))


def _with_ways_in_the_air(scene: Scene, led: Led, present: Bool[Array, " m"]) -> Led:
    """The tools, those that do not touch the wall at rest with their way along it in this step.

    Others may raise the wall to them within the step. A jump is no way.
    """
    waits = ~led.touching & present & _goes_on(scene, led)
    way = jnp.concatenate([led.way[:, :1], -led.before[:, 1:]], axis=1)
    return led._replace(way=jnp.where(waits[:, None], way, led.way))


def _goes_on(scene: Scene, led: Led) -> Bool[Array, " m"]:
    """Whether the tools did not jump in this step."""
    way = led.way - led.before
    return jnp.sum(way * way, axis=1) <= scene.radius**2


def rub_step(
    scene: Scene, material: Material, rows: Rows, present: Bool[Array, " m"]
) -> tuple[Any, Approach, Rubbed, Float[Array, "m 3"]]:
    """One step of all tools on the places that they hold.

    A pose that is no number leaves the state of all.

    Args:
        scene: of several instruments with friction.
        material: -
        rows: the tools.
        present: which of them are there.

    Returns:
        The next states, the ways on the places, what they do, and the slip of each since it
        touched, mm.
    """
    first, known = views(scene)[0], jnp.all(rows.at.known)

    def take(row):
        view, here, _, inside = enter(first, row)
        last, place, hit = touched(view, row.state, here, inside)
        hit = hit | (row.state.touching & ~inside[0])
        return lead(view, row.state, last, here, place, hit)

    led = jax.lax.map(take, rows)
    shown = jax.vmap(whole_way)(led)
    led = _with_ways_in_the_air(scene, led, rows.state.present)
    places = jax.vmap(lambda s, phi: on_the_tube(scene, s, phi)[:2])(led.anchor.s, led.anchor.phi)
    frames = jax.vmap(local_frame)(led.anchor.phi)
    unit, law = influence_of(scene, material, *places), law_of(scene, material, places[0])
    way = jnp.where(known, led.way, jnp.nan)
    # A tool in the lumen presses nothing, however deep it is in the wall.
    there = present & (led.touching | ~(led.way[:, 0] > 0))
    stand = _stand(scene, unit, led, jnp.einsum("mx,mkx->mk", rows.state.slip.force, frames))
    away = jnp.array([-1.0, 0.0, 0.0], way.dtype)
    D = jnp.where(there[:, None], smooth_touch(way, scene.plan.options), away)
    both = there[:, None, None, None] & there[None, None, :, None]
    C = jnp.where(both, felt(scene, unit), 0)
    slid = slide_together(D, C, law, mu_of(scene), stand)[1]
    # In the frame of the tube, where the places have turned since the step before.
    force, depth = (jnp.einsum("mk,mkx->mx", v, frames) for v in (slid.force, slid.depth))
    earlier = jnp.einsum("mx,mkx->mk", led.slip.force, frames)
    skeleton, sunk = (
        by_all(v.reshape(1, -1), own_contacts(unit))[0] for v in (slid.force, earlier)
    )
    began = jnp.where(led.on[:, None], 0, slid.began)
    answers = Answer(law, force, depth, skeleton, sunk, slid.slip, slid.dissipated, began)

    def leave(row):
        row, led, shown, answer = row
        view, here, side, inside = enter(first, row)
        after, total, lost = let_go(view, led, answer, here)
        _, made = as_approach(view, led.anchor, shown, here, inside)
        # On its place, too, where it does not touch the wall at rest, but one that others raise.
        bears = jnp.sum(local_frame(led.anchor.phi)[0] * answer.force) > 0
        on = bears | (row.seen.gap[0] < 0) & ~inside[0]
        new = dataclasses.replace(
            row.state, started=jnp.asarray(True), touching=on, last=here, anchor=after, slip=total,
            side=side,
        )  # fmt: skip
        return pick(known, new, row.state), made, total, lost

    after, made, total, lost = jax.lax.map(leave, (rows, led, shown, answers))
    slid = slid._replace(slip=total.held, dissipated=lost, began=jnp.zeros_like(total.held))
    whole = jnp.einsum("mk,mkx->mx", total.held + total.before, frames[:, 1:])
    return after, made, Rubbed(unit, jax.tree.map(lambda v: v[None], slid)), whole


def _in_its_frame(presses: Presses, hidden) -> Float[Array, "rows 3"]:
    """Displacements inwards, along and round the tube where the tool is, behind it or not."""
    D = jnp.where(hidden[:, None], 0, presses.displacement)
    phi = presses.phi[0]
    return product_of_rows(D, local_frame(jnp.where(jnp.isnan(phi), 0, phi)).T)


def law_of(scene: Scene, material: Material, s: Float[Array, " m"]) -> Law:
    """The local law at every contact."""
    options = scene.plan.options
    return jax.vmap(lambda at: local_law(scene.geometry, material, at, options))(s)


def felt(scene: Scene, unit: VectorInfluence) -> Float[Array, "m 3 m 3"]:
    """The compliance that contacts feel, of themselves and of each other."""
    m = len(scene.instruments)
    C = unit.compliance.reshape(m, 3, m, 3)
    if scene.plan.tools == "coupled":
        return C
    return C * jnp.eye(m, dtype=C.dtype)[:, None, :, None]


def mu_of(scene: Scene) -> Coulomb:
    """Friction of every tool (a negative coefficient is refused row by row)."""
    given = [v.friction for v in scene.instruments if v.friction is not None]
    return Coulomb(jnp.maximum(jnp.stack(given), 0))
