"""Correlated residuals: what they cost, in tables and report. Done in every fit."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.inference.analysis import Analysis, Cells, Findings, Progress, Request
from jaxtrachea.inference.effective import CORRELATED, Effective, effective


def _compute(request: Request, findings: Findings, progress: Progress) -> Effective:
    return effective(findings.result, findings.result.residuals, findings.profiles)


def _lane_cells(wide: Effective, lane: int) -> Cells:
    return {
        "residual_correlation": float(wide.correlation[lane]),
        "effective_samples": float(wide.samples[lane]),
    }


def _cells(wide: Effective, lane: int, i: int) -> Cells:
    """The interval as it is with the samples that correlated ones are worth."""
    return {
        "low95_widened": float(wide.lower[lane, i]),
        "high95_widened": float(wide.upper[lane, i]),
    }


def _section(wide: Effective) -> list[str]:
    """What correlation of neighbours says against the standard errors."""
    lanes, every = np.flatnonzero(wide.correlation > CORRELATED), wide.result.lanes
    if not len(lanes):
        return []
    if not wide.result.study.free:
        return [
            f"Neighbouring force residuals are correlated in {len(lanes)} of {every} lanes: "
            "the model misses the shape of these curves, or the noise is not independent from "
            "sample to sample."
        ]
    r = float(np.median(wide.correlation[lanes]))
    worth = float(np.median(wide.samples[lanes] / np.maximum(wide.result.samples[lanes], 1)))
    few = int(np.sum(np.isinf(wide.factor[lanes])))
    factor = float(np.median(wide.factor[lanes]))
    return [
        f"Neighbouring force residuals are correlated in {len(lanes)} of {every} lanes "
        f"(median correlation {r:.2f}): the model misses the shape of these curves, or the "
        "noise is not independent from sample to sample. The standard errors assume that it "
        f"is; there 100 samples are worth {100 * worth:.2g} independent ones, and they are too "
        + (f"small, by a factor of about {factor:.2g} if it is noise" if np.isfinite(factor)
           else "small by a factor that these samples do not tell")
        + ". Intervals for so many samples: `95 % widened`, and `low95_widened`, "
        "`high95_widened` in `parameters.csv` (docs/uncertainty.md)."
        + (f" {few} lanes have no more independent samples than unknowns, and no limits."
           if few else "")
    ]  # fmt: skip


def _shown(wide: Effective, lanes: list[int]) -> Iterator[str]:
    doubted = int(np.sum(wide.correlation > CORRELATED))
    if doubted and wide.result.study.free:
        yield (
            f"Neighbouring residuals are correlated in {doubted} of {wide.result.lanes} lanes: "
            "standard errors are too small there; wider intervals: low95_widened, high95_widened "
            "in parameters.csv"
        )


EFFECTIVE = Analysis(
    name="effective",
    after="influence",
    compute=_compute,
    asked=lambda request: True,
    lane_cells=_lane_cells,
    parameter_cells=_cells,
    place="quality",
    section=_section,
    shown=_shown,
)
