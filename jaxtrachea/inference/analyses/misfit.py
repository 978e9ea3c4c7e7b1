"""Residuals against the noise given, in tables and report. Done in every fit."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.fitting.glitches import GLITCH
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.residuals import glitches_of


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> FitResult:
    return findings.result


def _lane_cells(result: FitResult, lane: int) -> Cells:
    force, marker = map(float, result.misfit.ratio[lane])
    share = float(result.force_share[lane])
    return {
        "residual_over_noise": force,
        "marker_residual_over_noise": marker,
        "force_share": share,
    }


def _share(result: FitResult) -> list[str]:
    """That the noise of forces grows with the force."""
    lanes = np.flatnonzero(result.force_share > 0)
    if not len(lanes):
        return []
    share, sigma = np.median(result.force_share[lanes]), np.median(result.sigma[lanes, 0])
    median = f" in {len(lanes)} of {result.lanes} fits (medians)" if result.lanes > 1 else ""
    cause = (
        "found in the residuals: what the model misses grows with the force, and with one sigma "
        "for all depths the deep samples would outvote the shallow ones"
        if result.study.force_share == "estimate"
        else "as `noise.force_share` says"
    )
    return [
        f"The noise of a force sample is {sigma:.2g} N and {100 * share:.2g} % of the force"
        f"{median}, {cause}."
    ]


def _glitches(result: FitResult) -> list[str]:
    """That samples stand alone, where all samples count alike."""
    found = glitches_of(result) if result.study.model.loss == "linear" else []
    if not found:
        return []
    lanes, first = len({glitch.lane for glitch in found}), found[0]
    curve = result.study.curves[first.lane][first.trial]
    samples = "1 force sample stands" if len(found) == 1 else f"{len(found)} force samples stand"
    where = f" in {lanes} of {result.lanes} fits" if result.lanes > 1 else ""
    return [
        f"{samples} alone{where}, more than {GLITCH:g} times the noise from the model while both "
        f"neighbours are near it. The largest is {-first.residual:+.2g} N off, of {curve.specimen} "
        f"{curve.trial} at {curve.displacement[first.sample]:.3g} mm. If these are glitches of the "
        'load cell, `fit.loss = "huber"` counts them less.'
    ]


def _sentences(result: FitResult) -> list[str]:
    """The share of the force in the noise; glitches; residuals beyond the noise given, or below."""
    compared, every, said = result.misfit, result.lanes, _share(result) + _glitches(result)
    for k, (kind, key) in enumerate((("Force", "noise.force"), ("Marker", "noise.joints"))):
        ratio, flagged = compared.ratio[:, k], compared.flagged[:, k]
        for beyond, cause in (
            (ratio > 1, "the noise given is too small, or the model misses the curves: standard "
             "errors and intervals have grown"),
            (ratio < 1, "the noise given is too large: standard errors and intervals, which rest "
             "on it, are too large"),
        ):  # fmt: skip
            lanes = np.flatnonzero(flagged & beyond)
            if len(lanes):
                median = float(np.median(ratio[lanes]))
                where = f" in {len(lanes)} of {every} fits" if every > 1 else ""
                said.append(
                    f"{kind} residuals are {median:.2g} times the noise given (root of chi^2 / "
                    f"(n - P)){where}: {cause} by about this factor. Leave `{key}` out to take it "
                    "from the residuals."
                )
    return said


def _shown(result: FitResult) -> Iterator[str]:
    yield from (sentence.replace("`", "") for sentence in _sentences(result))


MISFIT = Analysis(
    name="misfit",
    after="effective",
    compute=_compute,
    asked=lambda request: True,
    lane_cells=_lane_cells,
    report_section="quality",
    section=_sentences,
    sentences=_shown,
)
