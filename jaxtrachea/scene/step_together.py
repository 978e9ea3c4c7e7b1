"""A step of several tools that feel each other: the next state of each, and what all of them do."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import full_precision
from jaxtrachea.contact.patches import Touch
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.mechanics.press_history import History
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.approach import Approach, on_its_own
from jaxtrachea.scene.grip import pick
from jaxtrachea.scene.hold import hold
from jaxtrachea.scene.in_time import Before, resting
from jaxtrachea.scene.instruments import glued, touch_and_pull, touch_together, views
from jaxtrachea.scene.memory import Memory
from jaxtrachea.scene.rows import enter, gather
from jaxtrachea.scene.rub_together import rub_step
from jaxtrachea.scene.simulation import Simulation, as_simulation
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.scene.together import Together, press_together
from jaxtrachea.status import PressStatus


def placed(
    names: list[str], stands: tuple, poses: Any, translation: Any, present: Any,
    check: Callable[[Any, Any, str], tuple],
) -> tuple[list, list, list]:  # fmt: skip
    """Rotations and translations of several tools, and which of them are there.

    Args:
        names: of the tools.
        stands: the same of the step before.
        poses: mapping of names to (rotation, translation).
        translation: None.
        present: which of them are there from now on; one that is given a pose is.
        check: from a rotation, a translation and what they are of, as in errors, to both as arrays.

    Raises:
        ValueError: see `Session.step`.
    """
    if not names:
        raise ValueError(
            "poses by name, and the scene has one tool without a name; expected rotation and "
            "translation, or a scene made with a mapping of paths"
        )
    if isinstance(poses, Mapping) and translation is not None:
        raise ValueError("poses by name and a second value; give dt by its name, as in dt=0.001")
    if not isinstance(poses, Mapping):
        raise ValueError(
            f"one pose, and the scene has the tools {', '.join(map(repr, names))}; expected a "
            "mapping of names to (rotation, translation)"
        )
    if not isinstance(present, Mapping):
        raise ValueError(f"present is {present!r}; expected a mapping of names to True or False")
    if unknown := [name for name in (*poses, *present) if name not in names]:
        raise ValueError(f"there is no tool {unknown[0]!r}; expected {', '.join(map(repr, names))}")
    turns, places, there = map(list, stands)
    for name, pose in poses.items():
        if not isinstance(pose, tuple | list) or len(pose) != 2:
            raise ValueError(f"pose of {name!r}: expected (rotation, translation)")
        i, (turn, place) = names.index(name), pose
        (turns[i], places[i]), there[i] = check(turn, place, f"{name!r}: "), True
    for name, is_there in present.items():
        if not isinstance(is_there, bool) and str(getattr(is_there, "dtype", "")) != "bool":
            raise ValueError(f"present of {name!r} is {is_there!r}; expected True or False")
        there[names.index(name)] = is_there
    return turns, places, there


@full_precision
def move_tools(
    scene: Scene,
    material: AnyMaterial,
    state: Any,
    rotation: Float[Array, "m 3 3"],
    translation: Float[Array, "m 3"],
    present: Bool[Array, " m"],
    dt: Float[Array, ""] | None = None,
) -> tuple[Any, Simulation, tuple[Together]]:
    """As `step.move_tool`, of all instruments; a tool that is not present is lifted off the wall.

    A pose that is no number takes the numbers of this step from all, and leaves its own state.
    """
    rest, back = resting(scene, material), jnp.asarray(False)
    if dt is not None:
        back = ~((dt >= 0) & jnp.isfinite(dt))
        dt, translation = jnp.where(back, 0, dt), jnp.where(back, jnp.nan, translation)
    paths = [Poses(R[None], T[None]) for R, T in zip(rotation, translation, strict=True)]
    if scene.plan.contact_point == "per_step":
        seen, pull = touch_and_pull(scene, paths)
    else:
        seen, pull = touch_together(scene, paths), None
    rubbed, total = None, None
    if scene.plan.friction:
        rows = gather(scene, state, paths, seen, present)
        after, made, rubbed, total = rub_step(scene, long_run(material), rows, present)
        touching, known = after.touching, rows.at.known
    else:
        after, made, touching, known = _hold(scene, material, state, paths, seen, present, rest)
    held = glued(scene)
    there = present & (touching | ~held) if state.memory is not None else present
    stuck = held & present & state.touching
    ways = [jax.tree.map(lambda v, k=k: v[k], made)._replace(own=own) for k, own in enumerate(seen)]
    memory, before = after.memory, None
    if memory is not None:
        # A history that is unknown for one is so for all.
        lost = memory.press.lost
        before = Before(memory.press._replace(lost=jnp.max(lost)), dt=dt)
    each = list(zip(paths, ways, strict=True))
    found, moved, history = press_together(
        scene, material, each, there[None], before, pull, rubbed, stuck
    )
    if held.any() and memory is None:
        meets = jnp.any(jnp.nan_to_num(found["force"][0]) != 0, axis=1)
        after = dataclasses.replace(
            after, touching=jnp.where(held, present & (state.touching | meets), touching)
        )
    if memory is not None:
        assert history is not None
        kept = history._replace(lost=jnp.broadcast_to(history.lost, lost.shape))
        after = dataclasses.replace(after, memory=memory._replace(press=kept))
    result = jax.tree.map(lambda v: v[0], as_simulation(found))
    if total is not None:
        result = result._replace(slip=jnp.where(jnp.isnan(result.slip), jnp.nan, total))
    why = jnp.where(back, PressStatus.BACK_IN_TIME, PressStatus.NON_FINITE)
    status = jnp.where(jnp.all(known), result.status, why.astype(result.status.dtype))
    after = dataclasses.replace(after, present=jnp.where(back, state.present, present))
    return after, result._replace(status=status), (moved,)


def _hold(
    scene: Scene, material: AnyMaterial, state: Any, paths: list[Poses], seen: list[Touch],
    present, rest: History | None,
) -> tuple[Any, Approach, Bool[Array, " m"], Bool[Array, " m"]]:  # fmt: skip
    """All tools on their places: next states, ways, who is on its place, whose pose is known.

    One that is not present counts as clear of the wall. How a tool holds its place does not depend
    on its shape: one program serves all that are glued, one all others.
    """
    each, rows = views(scene), gather(scene, state, paths, seen, present)

    def one(first, row):
        view, here, side, inside = enter(first, row)
        old, (path, touch), at = row.state, here, row.at
        if view.plan.contact_point == "per_step":
            made = on_its_own(view, path, touch)._replace(inside=inside)
            new = pick(at.known, dataclasses.replace(old, side=side), old)
            return new, made, (touch.gap[0] < 0) & ~inside[0], at.known
        new, _, made, held = hold(view, long_run(material), old, here, inside, rest)
        if new.memory is not None:
            made = _where_pressed(made, new.memory, held.touching)
        elif view.plan.options.contact == "bonded":
            made = _over_the_wall(made, held.touching)
        new = pick(at.known, dataclasses.replace(new, side=side), old)
        return new, made, held.touching, at.known

    def of_kind(which):
        if len(which) == len(each):
            return jax.lax.map(functools.partial(one, each[0]), rows)
        some = jax.tree.map(lambda v: v[which], rows)
        return jax.lax.map(functools.partial(one, each[which[0]]), some)

    held = glued(scene)
    kinds = [which for which in (np.flatnonzero(~held), np.flatnonzero(held)) if len(which)]
    parts = [of_kind(which) for which in kinds]
    if len(parts) == 1:
        return parts[0]
    back = np.argsort(np.concatenate(kinds))
    return jax.tree.map(lambda *v: jnp.concatenate(v)[back], *parts)


def _over_the_wall(made: Approach, touching: Bool[Array, ""]) -> Approach:
    """The way of a tool that has not touched yet: how far it is from the wall at rest."""
    D = jnp.where(touching, made.presses.displacement, -made.own.gap[:, None] * made.inward)
    return made._replace(presses=dataclasses.replace(made.presses, displacement=D))


def _where_pressed(made: Approach, memory: Memory, touching: Bool[Array, ""]) -> Approach:
    """The way of a tool that has let go on the place it pressed, where the wall recovers.

    Under the tool in the air the wall would move others from elsewhere.
    """
    left = ~touching & (memory.press.local.elastic != 0)
    inward, presses = local_frame(memory.phi)[:1], made.presses
    D = -jnp.maximum(made.own.gap, 0)[:, None] * inward
    there = Presses(memory.s[None], memory.phi[None], D)
    return made._replace(
        presses=pick(left, there, presses), inward=jnp.where(left, inward, made.inward)
    )
