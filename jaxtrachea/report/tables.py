"""Tables of estimates and of the quality of a fit, for report and terminal."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.files.table import Column, Interval, Table
from jaxtrachea.fitting.assessment import (
    DETERMINED,
    already_reported,
    assess,
    is_own,
    unknown_label,
)
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.labels import lane_label, peak_force, succeeded
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.rows import and_more
from jaxtrachea.status import FitStatus

ESTIMATES = (
    *map(Column, ("specimen", "parameter", "value")),
    Column("std. error", digits=2),
    *map(Column, ("95 % interval", "verdict")),
)
SPREAD = (
    *map(Column, ("parameter", "determined", "median", "quartiles", "error")),
    Column("identifiable", unit="%", decimals=0),
)
QUALITY = (
    *map(Column, ("specimen", "outcome", "iter", "n")),
    Column("rms F", unit="N", digits=3),
    Column("of peak", unit="%", digits=2),
    Column("rms joints", unit="mm", digits=3),
    Column("cond", digits=2),
    Column("AICc", digits=5),
)


def estimate_table(
    result: FitResult,
    lanes: Sequence[int],
    profiles: Profiles | None = None,
) -> Table:
    """Value, standard error, 95 % interval and verdict of every unknown of some lanes."""
    rows = []
    for lane in lanes:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            if already_reported(result, lanes, lane, i):
                continue
            assessed = assess(result, lane, i, profiles)
            rows.append(
                {
                    "specimen": lane_label(result, lane) if is_own(result, lane, i) else "(all)",
                    "parameter": f"{unknown_label(result, lane, i)} [{p.unit}]",
                    "value": float(result.value[lane, i]),
                    "std. error": assessed.standard_error,
                    "95 % interval": Interval(assessed.low, assessed.high, p.scale == "log"),
                    "verdict": assessed.verdict,
                }
            )
    more = and_more(result.lanes, len(lanes), "parameters.csv")
    return Table(rows, ESTIMATES, title="Estimates", more=more)


def spread_table(result: FitResult, profiles: Profiles | None = None) -> Table:
    """Parameter, estimates determined of all, their median, quartiles and median error, and share.

    Determined: identifiable or weak; a median of others would say nothing.
    """
    columns: dict[str, list[tuple[float, float, str]]] = {}
    units: dict[str, str] = {}
    good = [k for k in range(result.lanes) if succeeded(result, k)]
    for lane in good:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            if already_reported(result, good, lane, i):
                continue
            assessed = assess(result, lane, i, profiles)
            press = p.name in OF_THE_PRESS and p.scale == "linear"
            error = assessed.standard_error if press else assessed.relative_se
            if press:
                units[f"{p.name} [{p.unit}]"] = p.unit
            entry = (float(result.value[lane, i]), error, assessed.verdict)
            columns.setdefault(f"{p.name} [{p.unit}]", []).append(entry)
    rows = []
    for name, entries in columns.items():
        determined = np.array([e[:2] for e in entries if e[2] in DETERMINED]).reshape(-1, 2)
        row: dict[str, object] = {
            "parameter": name,
            "determined": f"{len(determined)} of {len(entries)}",
        }
        row["identifiable"] = float(np.mean([e[2] == "identifiable" for e in entries]))
        if len(determined):
            low, mid, high = map(float, np.quantile(determined[:, 0], [0.25, 0.5, 0.75]))
            middle, unit = float(np.median(determined[:, 1])), units.get(name)
            row |= {"median": mid, "quartiles": (low, high)}
            row["error"] = f"{middle:.2g} {unit}" if unit else f"{100 * middle:.2g} %"
        rows.append(row)
    return Table(rows, SPREAD, title="Estimates over fits")


def quality_table(result: FitResult, lanes: Sequence[int]) -> Table:
    """Status, iterations, samples, rms residuals, condition number of some lanes."""
    rows = []
    for lane in lanes:
        peak = peak_force(result, lane)
        status = FitStatus(int(result.status[lane]))
        force, joints = map(float, result.rms[lane])
        rows.append(
            {
                "specimen": lane_label(result, lane),
                "outcome": status.name.lower().replace("_", " "),
                "iter": int(result.iterations[lane]),
                "n": int(result.samples[lane]),
                "rms F": force,
                "of peak": force / peak if peak > 0 else None,
                "rms joints": joints if np.isfinite(joints) else None,
                "cond": float(result.uncertainty.condition[lane]),
                "AICc": float(result.criteria.AICc[lane]),
            }
        )
    more = and_more(result.lanes, len(lanes), "summary.csv")
    return Table(rows, QUALITY, title="Quality", more=more)
