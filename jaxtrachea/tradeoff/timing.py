"""Compiled programs of one pose, of batches and of a part, and what a call of each takes."""

import time
from collections.abc import Callable, Hashable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._arguments import check_word
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.tradeoff.calls import last_row, one_pose
from jaxtrachea.tradeoff.levels import Full, Levels, program, solve
from jaxtrachea.tradeoff.parts import Inputs, Part, part

#: Turns in which the rungs of a ladder are called one after the other, so that all see the same
#: machine.
TURNS = 10


class Settings(NamedTuple):
    """How much is measured.

    Attributes:
        calls: timed calls of each program.
        lanes: poses of one batch; 0: batches are not timed.
        rungs: of each ladder at most so many, the coarsest and the finest among them; 0: all.
        slopes: derivatives are timed as well.
    """

    calls: int = 1000
    lanes: int = 256
    rungs: int = 0
    slopes: bool = True


class Compiled(NamedTuple):
    """Programs ready to be called, by what is timed, and the seconds that `call` took to compile.

    `call`: one pose, see `calls.one_pose`; `gradient`: force and its derivatives; `lane`: a batch;
    `part` and `part_lane`: the part that a ladder changes.
    """

    calls: dict[str, Callable]
    seconds: float


def compiled(full: Full, levels: Levels, settings: Settings) -> Compiled:
    """The program of one pose, and those beside it."""
    scene, material, whole = program(full, levels)
    row = last_row(whole)
    start = time.perf_counter()
    calls: dict[str, Callable] = {"call": one_pose((scene, material, whole))}
    seconds = time.perf_counter() - start

    def derivatives(m, p):
        out, change = solve(scene, m, p)
        return out.force, change

    if settings.slopes:
        calls["gradient"] = _ready(derivatives, (material, row))
    if settings.lanes:
        calls["lane"] = _batch(lambda m, p: simulate(scene, m, p), (material, row), settings.lanes)
    return Compiled(calls, seconds)


def with_part(
    made: Compiled, name: Part, full: Full, levels: Levels, given: Inputs, lanes: int
) -> Compiled:
    """The same with the part that a ladder changes, where the scene has it.

    Raises:
        ValueError: another word than those of `Part`.
    """
    check_word("name", name, Part)
    found = part(name, full, levels, given)
    if found is None:
        return made
    more = {"part": _ready(*found)}
    if lanes:
        more["part_lane"] = _batch(*found, lanes)
    return made._replace(calls=made.calls | more)


def _ready(function: Callable, arguments: tuple) -> Callable:
    made = jax.jit(function).lower(*arguments).compile()
    return lambda: jax.block_until_ready(made(*arguments))


def _batch(function: Callable, arguments: tuple, lanes: int) -> Callable:
    wide = jax.tree.map(lambda v: jnp.stack([v] * lanes), arguments)
    return _ready(jax.vmap(function), wide)


def timed(programs: Mapping[Hashable, Compiled], settings: Settings) -> dict[Hashable, dict]:
    """Seconds: median and 99 % of single calls, median per lane of batches, compilation."""
    samples = {key: {name: [] for name in made.calls} for key, made in programs.items()}
    block = max(settings.calls // TURNS, 1)
    for _ in range(TURNS):
        for key, made in programs.items():
            for name, call in made.calls.items():
                many = settings.lanes if name.endswith("lane") else 1
                taken = sampled(call, max(block // many, 2))
                samples[key][name] += [v / many for v in taken]

    def short(v):
        return float(f"{v:.4g}")

    return {
        key: {
            name: {"median": short(np.median(v)), "p99": short(np.quantile(v, 0.99))}
            for name, v in seen.items()
        } | {"compile": short(programs[key].seconds)}
        for key, seen in samples.items()
    }  # fmt: skip


def sampled(call: Callable, calls: int) -> list[float]:
    """Seconds of single calls, each waited for; one before them is not counted."""
    call()
    taken = []
    for _ in range(calls):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return taken
