"""A step of a tool that holds the place it touched: the next state, and what is pressed there."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxtrachea.mechanics.press_history import History
from jaxtrachea.scene.anchor import Anchor, Instant, anchor_at, as_approach, first_contact
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.grip import Grip, grip, pick
from jaxtrachea.scene.memory import recall
from jaxtrachea.scene.rub import rub
from jaxtrachea.scene.stage import Poses, Scene
from jaxtrachea.trachea.material import Material


def hold(
    scene: Scene,
    material: Material,
    state: Any,
    here: Instant,
    inside: Bool[Array, "1"],
    at_rest: History | None = None,
) -> tuple[Any, Poses, Approach, Grip]:
    """The next state but for the side; pose and way of the tool on its place; its grip."""
    last, first, hit = touched(scene, state, here, inside)
    held = (rub if scene.plan.friction else grip)(scene, material, state, last, here, first, hit)
    rest, made = as_approach(scene, held.anchor, held.way, here, inside)
    after = dataclasses.replace(
        state, started=jnp.asarray(True), touching=held.touching, last=here, anchor=held.after,
        slip=held.slip,
    )  # fmt: skip
    if state.memory is not None and at_rest is not None:
        depth = -here.seen.gap[0]
        kept = recall(scene, state.memory, at_rest, held.anchor, depth, held.touching)
        after = dataclasses.replace(after, memory=kept)
    return after, rest, made, held


def touched(
    scene: Scene, state: Any, here: Instant, inside: Bool[Array, "1"]
) -> tuple[Instant, Anchor, Bool[Array, ""]]:
    """The step before, the place of a first touch, and whether the tool touches from outside."""
    hit = (here.seen.gap[0] < 0) & ~inside[0]
    last = pick(state.started, state.last, here)
    return last, pick(hit, first_contact(scene, last, here), anchor_at(scene, here)), hit
