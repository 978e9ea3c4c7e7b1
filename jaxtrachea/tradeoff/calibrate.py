"""Times of a few small programs of the package, which the model of time is fitted to."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxtrachea.scene.build import stage
from jaxtrachea.scene.session import check_scene
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.tradeoff.levels import BUILT_IN, cast
from jaxtrachea.tradeoff.load import Load
from jaxtrachea.tradeoff.price import single, started, work_of
from jaxtrachea.tradeoff.time_model import TimeModel, Work, device, fitted

#: Turns in which the programs are called one after the other, and seconds of each in a turn.
TURNS, BURST = 12, 0.01
_BARE = {"surface": False, "joints": True, "ring_ends": False}
_PRESS = {"s": "73 mm", "displacement": ["0 mm", "-3 mm", "0 mm"]}
_MATERIAL = {
    k: v for k, v in BUILT_IN["material"].items() if k not in ("EI_C", "k_t", "EA_L", "k_A", "k_B")
}
_FEW = {"length": "160 mm", "rings": {"count": 3, "first": "60 mm", "last": "100 mm"}}
_BOTH = ("float64", "float32")
#: Few and many small kernels, many operations without a surface, a surface, a contact: as scenes,
#: with the dtypes of each.
SCENES = {
    "few rings": ({"trachea": _FEW, "path": _PRESS | {"steps": 1}, "output": _BARE}, _BOTH[:1]),
    "press": ({"path": _PRESS | {"steps": 1}, "output": _BARE}, _BOTH),
    "presses": ({"path": _PRESS | {"steps": 400}, "output": _BARE}, _BOTH[:1]),
    "surface": ({"path": _PRESS | {"steps": 1}}, _BOTH),
    "surfaces": ({"path": _PRESS | {"steps": 4}}, _BOTH),
    "contact": ({"tool": BUILT_IN["tool"], "path": [
        {"start": ["73 mm", "16 mm", "0 mm"], "end": ["73 mm", "15 mm", "0 mm"], "steps": 2}
    ], "output": _BARE}, _BOTH[:1]),
}  # fmt: skip


class Timed(NamedTuple):
    """A compiled program: what it does and the call that does it."""

    work: Work
    call: Callable[[], object]


def calibrate(report: Callable[[str], None] = lambda text: None) -> TimeModel:
    """Measure this machine; takes seconds, and some more the first time.

    Args:
        report: called with what is done next; may raise to stop.

    Raises:
        Uncalibrated: the device is no CPU, its times make no sense, or kernels are not known.
    """
    device()
    programs = []
    for name, (_, dtypes) in SCENES.items():
        for dtype in dtypes:
            report(f"time model: {name}, {dtype}")
            programs.append(_compiled(name, dtype))
    report("time model: timing")
    load = Load()
    seconds = quickest([p.call for p in programs])
    others = load.others()
    return fitted([p.work for p in programs], seconds)._replace(others=others)


class Predicted(NamedTuple):
    """One call of a program: s, and the kernels that it starts."""

    seconds: float
    kernels: int


def predicted(model: TimeModel, arguments: tuple) -> tuple[Predicted, Predicted | None]:
    """The whole path in one call, and its last pose alone: None where no `Session` is possible.

    Compiles both programs; `simulate` finds that of the path.

    Args:
        model: of this machine.
        arguments: scene, material and path.

    Raises:
        Uncalibrated: the kernels of a program are not known.
    """
    whole = _call(model, arguments)
    try:
        check_scene(*arguments[:2])
    except ValueError:
        return whole, None
    return whole, _call(model, single(arguments))


def _call(model: TimeModel, arguments: tuple) -> Predicted:
    kernels = started(jax.jit(simulate).lower(*arguments).compile())
    return Predicted(model.seconds(work_of(arguments, kernels)), kernels)


def quickest(calls: list[Callable[[], object]]) -> list[float]:
    """Least seconds of each call, in turns, so that all see the same machine."""
    best = [np.inf] * len(calls)
    for _ in range(TURNS):
        for i, call in enumerate(calls):
            jax.block_until_ready(call())
            end = time.perf_counter() + BURST
            while (start := time.perf_counter()) < end:
                jax.block_until_ready(call())
                best[i] = min(best[i], time.perf_counter() - start)
    return best


def _compiled(name: str, dtype: str) -> Timed:
    spec = SceneSpec.model_validate({"material": _MATERIAL} | SCENES[name][0])
    staged = stage(spec, Path())
    arguments = cast((staged.scene, staged.material, staged.path), dtype)
    scene, *given = arguments
    # As in a `Session`: the scene is a constant of the program.
    made = jax.jit(lambda material, path: simulate(scene, material, path)).lower(*given).compile()
    return Timed(work_of(arguments, started(made)), lambda: made(*given))
