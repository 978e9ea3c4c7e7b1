"""Correlated residuals: what intervals grow by, in tables and report. Done in every fit."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.effective import CORRELATED
from jaxtrachea.fitting.rounding import GROWTH
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.labels import determined_unknowns, lane_label
from jaxtrachea.inference.residuals import where_missed
from jaxtrachea.inference.rows import worst_first

#: Lanes whose missed stretch is named in report and terminal.
NAMED = 5


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> AnalysisResults:
    """The fit with the profiles that its intervals rest on; the numbers are the result's own."""
    return findings


def _lane_cells(found: AnalysisResults, lane: int) -> Cells:
    result, wide = found.result, found.result.effective
    misses = bool(wide.misses[lane]) and bool(result.succeeded[lane])
    free = bool(result.study.free)
    return {
        "residual_correlation": float(wide.correlation[lane]),
        "effective_samples": float(wide.samples[lane]),
        "interval_growth": float(wide.growth[lane]),
        "determined": determined_unknowns(result, lane, found.profiles) if free else None,
        "missed": where_missed(result, lane) if misses else "",
    }


def _cells(found: AnalysisResults, lane: int, i: int) -> Cells:
    """Error and interval as they would be with independent residuals."""
    low, high = assess(found.result, lane, i, found.profiles).independent
    return {
        "se_independent": float(found.result.standard_error[lane, i]),
        "low95_independent": low,
        "high95_independent": high,
    }


def _sentences(found: AnalysisResults) -> Iterator[str]:
    """Lanes whose intervals grow, and those of which nothing can be said."""
    result = found.result
    wide, every = result.effective, result.lanes
    missed = wide.misses if result.study.free else False
    lanes = np.flatnonzero((wide.correlation > CORRELATED) & np.logical_not(missed))
    if len(lanes):
        said = (
            f"Neighbouring force residuals are correlated in {len(lanes)} of {every} fits (median "
            f"correlation {np.median(wide.correlation[lanes]):.2f}): the noise changes slowly, or "
            "the model misses the shape of these curves"
        )
        if result.study.free:
            said += (
                f". There 100 samples are worth {100 * np.median(wide.share[lanes]):.2g} "
                "independent ones, and the "
                f"intervals are {np.median(wide.growth[lanes]):.2g} times as long for it"
            )
        yield said
    lanes = np.flatnonzero(result.succeeded & np.isfinite(wide.rounding))
    if len(lanes):
        yield (
            f"Forces are rounded to {np.median(wide.rounding[lanes]):.2g} N in {len(lanes)} of "
            f"{every} fits, more coarsely than their noise: curves repeat each other's errors, and "
            f"intervals are {GROWTH:g} times as long for it. Record, or export, more digits"
        )
    missed = [k for k in worst_first(result) if wide.misses[k] and result.succeeded[k]]
    if missed and result.study.free:
        named = "; ".join(f"{lane_label(result, k)}: {where_missed(result, k)}"
                          if every > 1 else where_missed(result, k)
                          for k in missed[:NAMED])  # fmt: skip
        more = f"; and {len(missed) - NAMED} more, see summary.csv" if len(missed) > NAMED else ""
        yield (
            f"The model misses the curves in {len(missed)} of {every} fits: their samples are "
            "worth less than one independent sample beyond the unknowns, and no verdict is given. "
            f"Most missed: {named}{more}"
        )


def _section(found: AnalysisResults) -> list[str]:
    said = [f"{sentence}." for sentence in _sentences(found)]
    if said and found.result.study.free:
        said[-1] += (
            " Errors and intervals of independent residuals: `se_independent`, "
            "`low95_independent`, `high95_independent` in `parameters.csv` (docs/read_a_fit.md)."
        )
    return [" ".join(said)] if said else []


EFFECTIVE = Analysis(
    name="effective",
    after="influence",
    compute=_compute,
    asked=lambda request: True,
    lane_cells=_lane_cells,
    parameter_cells=_cells,
    report_section="quality",
    section=_section,
    sentences=_sentences,
)
