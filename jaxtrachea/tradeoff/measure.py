"""Measure what every rung of a scene errs and costs."""

import datetime
import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtrachea._compiler import quick_options
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.tradeoff.errors import Errors, compare, relative, spread
from jaxtrachea.tradeoff.ladders import Ladder, ladders
from jaxtrachea.tradeoff.levels import Full, Levels, program, solve
from jaxtrachea.tradeoff.load import Load, processor
from jaxtrachea.tradeoff.parts import inputs, part_of
from jaxtrachea.tradeoff.timing import Compiled, Settings, compiled, timed, with_part

__all__ = ["Settings", "environment", "measure", "measure_ladders"]

DEFAULT = Settings()
Report = Callable[[str], None]


class Solved(NamedTuple):
    """A program's path: its scene, what came out, derivatives of the force."""

    scene: Scene
    out: Simulation
    gradient: np.ndarray


def measure(
    name: str, full: Full, settings: Settings = DEFAULT, report: Report = lambda text: None,
    curves: Sequence[Any] = (), radius: float = -1.0,
) -> list[dict[str, Any]]:  # fmt: skip
    """Errors and times of every rung of the scene's ladders; then a dict for each left out.

    Args:
        report: called with what is done next.
        curves: measured curves of the scene's specimen; or none.
        radius: markers no further from the contact say nothing, mm; negative: all count.
    """
    found, left_out = ladders(full)
    rows = measure_ladders(name, full, found, settings, report, curves, radius)
    return rows + [{"scene": name, "ladder": k, "left_out": v} for k, v in left_out.items()]


def measure_ladders(
    name: str, full: Full, measured: Sequence[Ladder], settings: Settings = DEFAULT,
    report: Report = lambda text: None, curves: Sequence[Any] = (), radius: float = -1.0,
) -> list[dict[str, Any]]:  # fmt: skip
    """Errors and times of every rung, one dict each.

    Each ladder is measured against its finest rung in float64, all else at its finest level.

    Args:
        measured: the ladders.
        report: called with what is done next.
        curves: as for `measure`.
        radius: likewise.
    """
    if curves:
        check_curves(full.path, curves)
    solved: dict[Levels, Solved] = {}
    kept: dict[Levels, Compiled] = {}
    rows, given = [], inputs(full)
    for ladder in measured:
        programs, points = {}, []
        finest, own = ladder.levels(full, list(ladder.rungs)[-1]), part_of(ladder.name)
        for rung in picked(ladder, settings.rungs):
            levels = ladder.levels(full, rung)
            report(f"{ladder.name} {rung}")
            for one in (finest, levels):
                if one not in solved:
                    solved[one] = _solved(full, one)
            made = kept.get(levels) or compiled(full, levels, settings)
            kept = {levels: made} if levels == full.levels else kept
            if own is not None:
                made = with_part(made, own, full, levels, given, settings.lanes)
            programs[levels] = made
            errors = _errors(solved[levels], solved[finest])
            point = _point(name, ladder, rung, levels == finest, errors)
            if curves:
                point["data"] = against(full, solved[levels], curves, radius)
            points.append((levels, point))
        report(f"{ladder.name}: timing")
        load = Load()
        times = timed(programs, settings)
        end = environment(settings, load)
        rows += [point | {"times": times[levels]} | end for levels, point in points]
        # A system allows a process so many memory maps (Linux: 65,530), and a program takes
        # hundreds: what is not needed again goes.
        del programs, made
        jax.clear_caches()
    return rows


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
    return {name: number(relative(*v)) for name, v in both.items() if v[0]}


def picked(ladder: Ladder, rungs: int) -> list[str]:
    """At most so many rungs, evenly, the coarsest and the finest among them; 0: all.

    All of whole plans: they are there to be compared with one another.
    """
    names = list(ladder.rungs)
    if not rungs or len(names) <= rungs or ladder.kind == "together":
        return names
    at = np.linspace(0, len(names) - 1, max(rungs, 2)).round().astype(int)
    return [names[i] for i in at]


def _solved(full: Full, levels: Levels) -> Solved:
    made = program(full, levels)
    out, gradient = jax.jit(solve, compiler_options=quick_options())(*made)
    return Solved(made[0], jax.tree.map(np.asarray, out), np.asarray(gradient))


def _errors(found: Solved, reference: Solved) -> Errors:
    both = (found.scene, reference.scene)
    return compare(found.out, reference.out, both, (found.gradient, reference.gradient))


def _point(name: str, ladder: Ladder, rung: str, finest: bool, errors: Errors) -> dict[str, Any]:
    short = {k: number(v) for k, v in errors._asdict().items()}
    return {"scene": name, "ladder": ladder.name, "level": rung, "kind": ladder.kind,
            "finest": finest, "errors": short}  # fmt: skip


def number(v: float | None) -> float | str | None:
    """Four digits; infinity as a word, since JSON has none."""
    if v is None:
        return None
    return float(f"{v:.4g}") if np.isfinite(v) else "inf"


def environment(settings: Settings, load: Load) -> dict[str, Any]:
    """Where and when something was timed, and how busy others kept the machine meanwhile."""
    names = ("jaxtrachea", "jax", "jaxlib", "numpy")
    return {
        "calls": settings.calls, "lanes": settings.lanes, "others": load.others(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "device": str(jax.devices()[0]), "processor": processor(),
        "versions": {"python": platform.python_version()} | {n: version(n) for n in names},
    }  # fmt: skip
