"""Rows of summary.csv and parameters.csv (docs/results.md)."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from jaxtrachea.fitting.assessment import assess, estimate_rows, estimated, unknown_label
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.labels import NOTHING_FITTED
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.residuals import rms
from jaxtrachea.inference.rows import row_places, samples_of, trials_of
from jaxtrachea.measurements.read import BadCurve
from jaxtrachea.measurements.usage_tables import lane_cells
from jaxtrachea.status import FitStatus


def lane_rows(result: FitResult, profiles: Profiles | None = None) -> Iterator[dict[str, object]]:
    """Rows of summary.csv, see `row_places`.

    What a specimen has several of (unknowns of single trials) is left to parameters.csv, and named
    in the column `more`. Of a lane of several specimens, everything but the unknowns, `samples` and
    `rms_over_peak`'s peak is that of the lane.
    """
    for lane, one in row_places(result):
        status = FitStatus(int(result.status[lane]))
        trials = trials_of(result, lane, one)
        curves = [result.study.curves[lane][t] for t in trials]
        peak = max(float(np.max(np.abs(c.force))) for c in curves)
        specimen, trial = result.study.lane_name(lane)
        if one:
            specimen, trial = one, curves[0].trial if len(curves) == 1 else "(all)"
        row: dict[str, object] = {
            "specimen": specimen,
            "trial": trial,
            "status": status.name.lower(),
            "message": status.message if result.study.free else NOTHING_FITTED,
            "iterations": int(result.iterations[lane]),
            "starts_agreeing": int(result.converged_starts[lane]),
            "starts": int(result.tried[lane]),
            "samples": samples_of(result, lane, trials) if one else int(result.samples[lane]),
            **lane_cells(curves),
            "cost": float(result.cost[lane]),
            "rms_force_N": float(result.rms[lane, 0]),
            "rms_over_peak": float(result.rms[lane, 0]) / peak if peak > 0 else float("nan"),
            "sigma_force_N": float(result.sigma[lane, 0]),
            "rms_joints_mm": float(result.rms[lane, 1]),
            "condition": float(result.uncertainty.condition[lane]),
            "unknowns": int(result.criteria.unknowns[lane]),
            "AIC": float(result.criteria.AIC[lane]),
            "AICc": float(result.criteria.AICc[lane]),
            "BIC": float(result.criteria.BIC[lane]),
        }
        yield row | _unknown_cells(result, lane, one, profiles)


def _unknown_cells(
    result: FitResult, lane: int, specimen: str, profiles: Profiles | None
) -> dict[str, object]:
    """What a row of summary.csv says of the unknowns of its specimen."""
    unknowns = result.study.unknowns[lane]
    own = [i for i, u in enumerate(unknowns) if not specimen or u[1] in ("", specimen)]
    cells: dict[str, object] = {}
    more = []
    for i in own:
        p = unknowns[i][0]
        if sum(unknowns[k][0].name == p.name for k in own) > 1:
            more.append(unknown_label(result, lane, i))
            continue
        assessed = assess(result, lane, i, profiles)
        cells |= {
            f"{p.name} [{p.unit}]": float(result.value[lane, i]),
            f"{p.name} se": assessed.standard_error,
            f"{p.name} low95": assessed.low,
            f"{p.name} high95": assessed.high,
            f"{p.name} verdict": assessed.verdict,
        }
    said = f"{', '.join(more)}: see parameters.csv" if more else ""
    return cells | ({"more": said} if more else {})


def summary_rows(
    findings: AnalysisResults, bad: Sequence[BadCurve] = ()
) -> Iterator[dict[str, object]]:
    """All rows of summary.csv: those of the lanes, then curves that could not be used."""
    rows = lane_rows(findings.result, findings.profiles)
    rows = with_residuals(findings.result, rows, findings.result.residuals)
    for (lane, _), row in zip(row_places(findings.result), rows, strict=True):
        for analysis, found in findings.found:
            row.update(analysis.lane_cells(found, lane))
        yield row
    yield from map(bad_row, bad)


def bad_row(bad: BadCurve) -> dict[str, object]:
    """Row of summary.csv for a curve that could not be used."""
    return {
        "specimen": bad.specimen,
        "trial": bad.trial,
        "status": FitStatus.BAD_DATA.name.lower(),
        "message": bad.reason,
    }


def parameter_rows(findings: AnalysisResults) -> Iterator[dict[str, object]]:
    """One row per lane and unknown for parameters.csv, with what the analyses have to add.

    What the lanes of a joint fit share has one row, that of the first lane which succeeded.
    """
    result, profiles = findings.result, findings.profiles
    places = estimated(result)
    for (lane, i), row in zip(places, estimate_rows(result, profiles), strict=True):
        for analysis, found in findings.found:
            row |= analysis.parameter_cells(found, lane, i)
        yield row


def with_residuals(
    result: FitResult, rows: Iterable[dict[str, object]], seen: Prediction
) -> Iterator[dict[str, object]]:
    """Rows of `lane_rows`; that of one specimen among several of a lane has its own residuals."""
    for (lane, specimen), row in zip(row_places(result), rows, strict=True):
        cells: dict[str, object] = {}
        if specimen:
            trials = trials_of(result, lane, specimen)
            own = float(rms(seen["force"][lane, trials].ravel()))
            curves = [result.study.curves[lane][t] for t in trials]
            peak = max(float(np.max(np.abs(c.force))) for c in curves)
            cells = {"rms_force_N": own, "rms_over_peak": own / peak if peak > 0 else np.nan}
            if "joints" in seen:
                cells["rms_joints_mm"] = float(rms(seen["joints"][lane, trials].ravel()))
        yield row | cells
