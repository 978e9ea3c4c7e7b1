"""What the residuals add to the rows of summary.csv and parameters.csv, and left_out.csv."""

import numpy as np

from jaxtrachea.fit.predictions import Prediction, rms
from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.cross_validation import LeftOut
from jaxtrachea.inference.effective import Effective
from jaxtrachea.inference.results import said_before
from jaxtrachea.inference.rows import row_places, trials_of


def with_residuals(
    result: FitResult, rows: list[dict[str, object]], seen: Prediction, wide: Effective
) -> list[dict[str, object]]:
    """Rows of `lane_rows`; that of one specimen among several of a lane has its own residuals."""
    out = []
    for (lane, specimen), row in zip(row_places(result), rows, strict=True):
        cells: dict[str, object] = {}
        if specimen:
            trials = trials_of(result, lane, specimen)
            own = float(rms(seen.force[lane, trials].ravel()))
            curves = [result.study.curves[lane][t] for t in trials]
            peak = max(float(np.max(np.abs(c.force))) for c in curves)
            cells = {"rms_force_N": own, "rms_over_peak": own / peak if peak > 0 else np.nan}
            if seen.joints is not None:
                cells["rms_joints_mm"] = float(rms(seen.joints[lane, trials].ravel()))
        cells |= {
            "residual_correlation": float(wide.correlation[lane]),
            "effective_samples": float(wide.samples[lane]),
        }
        out.append(row | cells)
    return out


def widened_rows(
    result: FitResult, rows: list[dict[str, object]], wide: Effective
) -> list[dict[str, object]]:
    """Rows of `parameter_rows` with the intervals for correlated residuals."""
    every, out = range(result.lanes), iter(rows)
    return [
        next(out)
        | {
            "low95_widened": float(wide.lower[lane, i]),
            "high95_widened": float(wide.upper[lane, i]),
        }
        for lane in every
        for i in range(len(result.study.unknowns[lane]))
        if not said_before(result, every, lane, i)
    ]


def left_out_cells(result: FitResult, left_out: LeftOut) -> list[dict[str, object]]:
    """Rows of left_out.csv: a curve left out and its errors each."""
    errors = (left_out.ratio, left_out.force, left_out.joints)
    rows = []
    columns = (left_out.lane, left_out.trial, left_out.converged.tolist(), *errors)
    for k, t, converged, *values in zip(*columns, strict=True):
        curve = result.study.curves[k][t]
        names = ("force_over_model", "rms_over_peak", "rms_joints_over_displacement")
        row: dict[str, object] = {"specimen": curve.specimen, "trial": curve.trial}
        out = zip(names, values, strict=True)
        rows.append(row | {name: float(v) for name, v in out} | {"converged": converged})
    return rows
