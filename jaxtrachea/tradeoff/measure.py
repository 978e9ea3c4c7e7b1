"""Measure what every rung of a scene errs and costs."""

import datetime
import functools
import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.scene.simulation import Simulation, simulate
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.tradeoff.choice import Choice
from jaxtrachea.tradeoff.errors import Errors, compare, relative, spread
from jaxtrachea.tradeoff.ladders import Ladder, ladders
from jaxtrachea.tradeoff.levels import Full, Levels, program, solve
from jaxtrachea.tradeoff.time_model import processor

#: Turns in which the rungs of a ladder are called one after the other, so that all see the same
#: machine.
TURNS = 10

Report = Callable[[str], None]


class Solved(NamedTuple):
    """A program's path: its scene, what came out, derivatives of the force."""

    scene: Scene
    out: Simulation
    gradient: np.ndarray


class Compiled(NamedTuple):
    """Programs of one pose, ready to be called, and the seconds that the first took to compile."""

    call: Callable
    gradient: Callable | None
    lanes: Callable | None
    seconds: float


class Settings(NamedTuple):
    """How much is measured.

    Attributes:
        calls: timed calls of each program.
        lanes: poses of one batch; 0: batches are not timed.
        quick: the coarsest, the middle and the finest rung of each ladder only.
    """

    calls: int = 1000
    lanes: int = 64
    quick: bool = False


def measure(
    name: str, full: Full, settings: Settings = Settings(), report: Report = lambda text: None,
    curves: Sequence[Any] = (), radius: float = -1.0,
) -> list[dict[str, Any]]:  # fmt: skip
    """Errors and times of every rung, one dict each; then one for each ladder left out.

    Each ladder is measured against its finest rung in float64, all else at its finest level.

    Args:
        name: of the scene.
        full: the scene at its finest.
        settings: -
        report: called with what is done next.
        curves: measured curves of the scene's specimen; or none.
        radius: markers no further from the contact say nothing, mm; negative: all count.
    """
    if curves:
        check_curves(full.path, curves)
    found, left_out = ladders(full)
    solved: dict[Levels, Solved] = {}
    kept: dict[Levels, Compiled] = {}
    rows = []
    for ladder in found:
        programs, points = {}, []
        finest = ladder.levels(full, list(ladder.rungs)[-1])
        for rung in _picked(ladder, settings.quick):
            levels = ladder.levels(full, rung)
            report(f"{ladder.name} {rung}")
            for one in (finest, levels):
                if one not in solved:
                    solved[one] = _solved(full, one)
            programs[levels] = kept.get(levels) or compiled(full, levels, settings.lanes)
            errors = _errors(solved[levels], solved[finest])
            point = _point(name, ladder, rung, levels == finest, errors)
            if curves:
                point["data"] = against(full, solved[levels], curves, radius)
            points.append((levels, point))
        report(f"{ladder.name}: timing")
        times = timed(programs, settings)
        end = _environment(settings)
        rows += [point | {"times": times[levels]} | end for levels, point in points]
        # A system allows a process so many memory maps (Linux: 65,530), and a program takes
        # hundreds: what is not needed again goes.
        kept = {levels: made for levels, made in programs.items() if levels == full.levels} or kept
        del programs
        jax.clear_caches()
    return rows + [{"scene": name, "ladder": k, "left_out": v} for k, v in left_out.items()]


def check_curves(path, curves: Sequence[Any]) -> list[tuple[Any, float]]:
    """The curve of every row of a path of normal presses, and its depth, mm.

    Raises:
        ValueError: a motion of a tool, or a row that no curve covers.
    """
    if not isinstance(path, Presses):
        raise ValueError("the scene moves a tool; curves are compared with presses at given points")
    found = []
    for i, (s, D) in enumerate(zip(np.asarray(path.s), np.asarray(path.displacement), strict=True)):
        depth = -float(D[1])
        near = [
            c for c in curves if c.s_c is not None and abs(c.s_c - s) < 1e-6
            and c.displacement.min() <= depth <= c.displacement.max()
        ]  # fmt: skip
        if not near:
            raise ValueError(f"row {i + 1} (s = {s:g} mm, {depth:g} mm deep): no curve covers it")
        found.append((near[0], depth))
    return found


def against(full: Full, solved: Solved, curves: Sequence[Any], radius: float) -> dict[str, Any]:
    """Errors of force and joints against measured normal presses, relative to the largest.

    Raises:
        ValueError: as `check_curves`.
    """
    x, kept = (np.asarray(v.geometry.ring_positions) for v in (full.scene, solved.scene))
    moved = solved.out.joints
    if moved is not None:
        moved = spread(np.asarray(moved), kept, x, float(full.scene.geometry.length))
    force, joints = ([], []), ([], [])
    for i, (curve, depth) in enumerate(check_curves(full.path, curves)):

        def at(v, depth=depth, curve=curve):
            return [np.interp(depth, curve.displacement, v)]

        force[0].append([-float(solved.out.force[i, 1])])
        force[1].append(at(curve.force))
        if curve.joint_rings is None or moved is None:
            continue
        for column, ring in enumerate(curve.joint_rings):
            if abs(x[ring] - curve.s_c) > radius:
                joints[0].append([-float(moved[i, ring, 1])])
                joints[1].append(at(curve.joint_displacement[:, column]))
    both = {"force": force, "joints": joints}
    return {name: _number(relative(*v)) for name, v in both.items() if v[0]}


def compiled(full: Full, levels: Levels, lanes: int, *, slopes: bool = True) -> Compiled:
    """The program of one pose: material and path in, everything out; and those beside it."""
    scene, material, path = program(full, levels)
    row = jax.tree.map(lambda v: v[-1:], path)
    start = time.perf_counter()
    call = jax.jit(lambda m, p: simulate(scene, m, p)).lower(material, row).compile()
    seconds = time.perf_counter() - start

    def derivatives(m, p):
        out, change = solve(scene, m, p)
        return out.force, change

    many = gradient = None
    if slopes:
        both = jax.jit(derivatives).lower(material, row).compile()
        gradient = functools.partial(both, material, row)

    if lanes:
        wide = jax.tree.map(lambda v: jnp.stack([v] * lanes), (material, row))
        batch = jax.jit(jax.vmap(lambda m, p: simulate(scene, m, p))).lower(*wide).compile()
        many = functools.partial(batch, *wide)

    return Compiled(lambda: call(material, row), gradient, many, seconds)


def timed(programs: dict[Levels, Compiled], settings: Settings) -> dict[Levels, dict]:
    """Seconds: median and 99 % of single calls, median per lane of batches, compilation."""
    samples = {levels: {"call": [], "gradient": [], "lane": []} for levels in programs}
    block = max(settings.calls // TURNS, 1)
    for _ in range(TURNS):
        for levels, made in programs.items():
            seen = samples[levels]
            seen["call"] += sampled(made.call, block)
            if made.gradient is not None:
                seen["gradient"] += sampled(made.gradient, block)
            if made.lanes is not None:
                batches = sampled(made.lanes, max(block // settings.lanes, 2))
                seen["lane"] += [v / settings.lanes for v in batches]

    def short(v):
        return float(f"{v:.4g}")

    found = {}
    for levels, seen in samples.items():
        found[levels] = {
            name: {"median": short(np.median(v)), "p99": short(np.quantile(v, 0.99))}
            for name, v in seen.items() if v
        } | {"compile": short(programs[levels].seconds)}  # fmt: skip
    return found


def choice_row(
    name: str, full: Full, choice: Choice, times: dict[Levels, dict], settings: Settings
) -> dict[str, Any]:
    """A choice as a line of JSON, with the times of its program and of the full one."""

    def said(rungs):
        return [
            {"ladder": r.ladder, "level": r.level, "error": _number(r.errors.worst)} for r in rungs
        ]

    def call(levels):
        return times[levels]["call"]["median"]

    return {
        "scene": name, "tolerance": choice.tolerance, "dropped": said(choice.dropped),
        "refused": said(choice.refused), "returned": said(choice.returned),
        "errors": {k: _number(v) for k, v in choice.errors._asdict().items()},
        "cost": round(choice.cost[1] / choice.cost[0], 4),
        "times": {"chosen": call(choice.levels), "full": call(full.levels)},
    } | _environment(settings)  # fmt: skip


def sampled(call: Callable, calls: int) -> list[float]:
    """Seconds of single calls, each waited for; one before them is not counted."""
    jax.block_until_ready(call())
    taken = []
    for _ in range(calls):
        start = time.perf_counter()
        jax.block_until_ready(call())
        taken.append(time.perf_counter() - start)
    return taken


def _picked(ladder: Ladder, quick: bool) -> list[str]:
    names = list(ladder.rungs)
    if not quick or len(names) <= 3:
        return names
    return [names[0], names[len(names) // 2], names[-1]]


def _solved(full: Full, levels: Levels) -> Solved:
    made = program(full, levels)
    out, gradient = jax.jit(solve)(*made)
    return Solved(made[0], jax.tree.map(np.asarray, out), np.asarray(gradient))


def _errors(found: Solved, reference: Solved) -> Errors:
    both = (found.scene, reference.scene)
    return compare(found.out, reference.out, both, (found.gradient, reference.gradient))


def _point(name: str, ladder: Ladder, rung: str, finest: bool, errors: Errors) -> dict[str, Any]:
    short = {k: _number(v) for k, v in errors._asdict().items()}
    return {"scene": name, "ladder": ladder.name, "level": rung, "kind": ladder.kind,
            "finest": finest, "errors": short}  # fmt: skip


def _number(v: float | None) -> float | str | None:
    """Four digits; infinity as a word, since JSON has none."""
    if v is None:
        return None
    return float(f"{v:.4g}") if np.isfinite(v) else "inf"


def _environment(settings: Settings) -> dict[str, Any]:
    names = ("jaxtrachea", "jax", "jaxlib", "numpy")
    return {
        "calls": settings.calls, "lanes": settings.lanes, "load": round(os.getloadavg()[0], 2),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "device": str(jax.devices()[0]), "processor": processor(),
        "versions": {"python": platform.python_version()} | {n: version(n) for n in names},
    }  # fmt: skip
