"""A scene's program as it is called: the whole path at once, or pose by pose; what that takes."""

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxtrachea._packed import Packing
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.scene.approach import approach
from jaxtrachea.scene.in_time import before_path
from jaxtrachea.scene.one_row import OneRow
from jaxtrachea.scene.session import Session
from jaxtrachea.scene.simulation import pressed, simulate
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.scene.step import check_scene

#: Turns in which calls are made one after the other, seconds of each in a turn, and of all turns
#: together after which there is no further one. Many short turns: a machine changes its speed.
TURNS, BURST, ENOUGH = 120, 0.002, 2.0
#: Turns there are at least: as many as a 95 % interval of their median needs.
FEWEST = 6

Arguments = tuple[Scene, AnyMaterial, Poses | Presses]
Call = Callable[[], object]
Path = TypeVar("Path", bound=Poses | Presses)


#: Time of a step of a force that relaxes, s.
STEP = 1e-3


def last_row(path: Path) -> Path:
    """A path of the last row alone."""
    return jax.tree.map(lambda v: v[-1:], path)


def whole_path(arguments: Arguments) -> Call:
    """The whole path in one call, as `jaxtrachea simulate` makes it; compiles it.

    Returns:
        A call that ends when all results are there.
    """
    # A function of its own: JAX keeps the programs of one that lives on.
    program = jax.jit(lambda *given: simulate(*given)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(program(*arguments))


def one_pose(arguments: Arguments) -> Call:
    """The last pose of the path, once more at each call; compiles the program.

    A step of a `Session` where one takes the scene. Else `simulate` of that row in the same form:
    numbers go in and out as one array each.
    """
    scene, material, path = arguments
    row = last_row(path)
    if scene.plan.friction:  # a step of it depends on the steps before
        return _alone(scene, material, row)
    try:
        check_scene(scene, material)
    except ValueError:
        return _alone(scene, material, row)
    assert isinstance(row, Poses)
    session = Session(scene, material)
    pose = np.asarray(row.rotation[0]), np.asarray(row.translation[0])
    return lambda: session.step(*pose, STEP)


def _alone(scene: Scene, material: AnyMaterial, row: Poses | Presses) -> Call:
    given = Packing((material, row))

    def setting(numbers):
        return scene, given.unpack(numbers)[0]

    def step(state, numbers):
        material, path = given.unpack(numbers)
        made = approach(scene, path) if isinstance(path, Poses) else None
        before = before_path(scene, material, path)
        result, press = pressed(scene, material, path, made, before=before)
        return state, jax.tree.map(lambda v: v[0], result), (path, press)

    numbers = jax.device_put(given.fill((material, row)))
    # A row knows nothing of the one before: its state is a number that is handed on.
    program = OneRow(scene, setting, step, jnp.zeros(1, given.dtype), numbers)
    return lambda: program(numbers)


def turn_medians(calls: Sequence[Call]) -> Float[np.ndarray, "calls turns"]:
    """Median seconds of each call in every turn; in a turn all see the same machine."""
    medians, begin = [], time.perf_counter()
    for turn in range(TURNS):
        if turn >= FEWEST and time.perf_counter() - begin > ENOUGH:
            break
        medians.append([_median(call) for call in calls])
    return np.array(medians).T


def _median(call: Call) -> float:
    """Seconds of a call, of those that begin within a turn; the one before them is not counted."""
    call()  # after another program: what it reads is out of the cache
    taken, start = [], time.perf_counter()
    end = start + BURST
    while start < end:
        call()
        stop = time.perf_counter()
        taken.append(stop - start)
        start = stop
    return float(np.median(taken))
