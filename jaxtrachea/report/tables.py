"""Tables of estimates and of the quality of a fit, for report and terminal."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.files.tables import interval, number
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.result import (
    DETERMINED,
    FitResult,
    is_own,
    judgement,
    said_before,
    unknown_label,
)
from jaxtrachea.inference.labels import lane_label, peak_force, succeeded
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.status import FitStatus

ESTIMATE_HEAD = ["specimen", "parameter", "value", "std. error", "95 % interval", "verdict"]
SPREAD_HEAD = ["parameter", "determined", "median", "quartiles", "error", "identifiable"]
QUALITY_HEAD = [
    "specimen",
    "outcome",
    "iter",
    "n",
    "rms F",
    "of peak",
    "rms joints",
    "cond",
    "AICc",
]


def estimate_rows(
    result: FitResult,
    lanes: Sequence[int],
    profiles: Profiles | None = None,
) -> list[list[str]]:
    """Lane, parameter, value, standard error, 95 % interval, verdict."""
    rows = []
    for lane in lanes:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            if said_before(result, lanes, lane, i):
                continue
            judged = judgement(result, lane, i, profiles)
            rows.append(
                [
                    lane_label(result, lane) if is_own(result, lane, i) else "(all)",
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    number(result.value[lane, i]),
                    number(judged.standard_error, 2),
                    interval(judged.low, judged.high, log=p.scale == "log"),
                    judged.verdict,
                ]
            )
    return rows


def spread_rows(result: FitResult, profiles: Profiles | None = None) -> list[list[str]]:
    """Parameter, estimates determined of all, their median, quartiles and median error, and share.

    Determined: identifiable or weak; a median of others would say nothing.
    """
    columns: dict[str, list[tuple[float, float, str]]] = {}
    units: dict[str, str] = {}
    good = [k for k in range(result.lanes) if succeeded(result, k)]
    for lane in good:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            if said_before(result, good, lane, i):
                continue
            judged = judgement(result, lane, i, profiles)
            press = p.name in OF_THE_PRESS and p.scale == "linear"
            error = judged.standard_error if press else judged.relative_se
            if press:
                units[f"{p.name} [{p.unit}]"] = p.unit
            entry = (float(result.value[lane, i]), error, judged.verdict)
            columns.setdefault(f"{p.name} [{p.unit}]", []).append(entry)
    rows = []
    for name, entries in columns.items():
        told = np.array([e[:2] for e in entries if e[2] in DETERMINED]).reshape(-1, 2)
        count = f"{len(told)} of {len(entries)}"
        if not len(told):
            rows.append([name, count, "–", "–", "–", "0 %"])
            continue
        low, mid, high = np.quantile(told[:, 0], [0.25, 0.5, 0.75])
        middle, unit = float(np.median(told[:, 1])), units.get(name)
        error = f"{middle:.2g} {unit}" if unit else f"{100 * middle:.2g} %"
        share = f"{100 * np.mean([e[2] == 'identifiable' for e in entries]):.0f} %"
        rows.append([name, count, number(mid), f"{number(low)} … {number(high)}", error, share])
    return rows


def quality_rows(result: FitResult, lanes: Sequence[int]) -> list[list[str]]:
    """Lane, status, iterations, samples, rms residuals, condition number."""
    rows = []
    for lane in lanes:
        peak = peak_force(result, lane)
        status = FitStatus(int(result.status[lane]))
        rows.append(
            [
                lane_label(result, lane),
                status.name.lower().replace("_", " "),
                str(int(result.iterations[lane])),
                str(int(result.samples[lane])),
                f"{number(result.rms[lane, 0], 3)} N",
                f"{100 * result.rms[lane, 0] / peak:.2g} %" if peak > 0 else "–",
                f"{number(result.rms[lane, 1], 3)} mm" if np.isfinite(result.rms[lane, 1]) else "–",
                number(float(result.uncertainty.condition[lane]), 2),
                number(float(result.criteria.AICc[lane]), 5),
            ]
        )
    return rows
