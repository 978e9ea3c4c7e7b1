"""Residuals against the noise given, in tables and report. Done in every fit."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.fitting.misfit import Misfit
from jaxtrachea.inference.analysis import Analysis, Cells, Findings, Progress, Request


def _compute(request: Request, findings: Findings, progress: Progress) -> Misfit:
    return findings.result.misfit


def _lane_cells(compared: Misfit, lane: int) -> Cells:
    force, marker = map(float, compared.ratio[lane])
    return {"residual_over_noise": force, "marker_residual_over_noise": marker}


def _sentences(compared: Misfit) -> list[str]:
    """Residuals larger than the noise given, and smaller ones."""
    every, said = len(compared.ratio), []
    for k, (kind, key) in enumerate((("Force", "noise.force"), ("Marker", "noise.joints"))):
        ratio, told = compared.ratio[:, k], compared.told[:, k]
        for beyond, cause in (
            (ratio > 1, "the noise given is too small, or the model misses the curves: standard "
             "errors and intervals, which rest on it, are too small"),
            (ratio < 1, "the noise given is too large: standard errors and intervals, which rest "
             "on it, are too large"),
        ):  # fmt: skip
            lanes = np.flatnonzero(told & beyond)
            if len(lanes):
                median = float(np.median(ratio[lanes]))
                where = f" in {len(lanes)} of {every} lanes" if every > 1 else ""
                said.append(
                    f"{kind} residuals are {median:.2g} times the noise given (root of chi^2 / "
                    f"(n - P)){where}: {cause} by about this factor. Leave `{key}` out to take it "
                    "from the residuals."
                )
    return said


def _shown(compared: Misfit, lanes: list[int]) -> Iterator[str]:
    yield from (sentence.replace("`", "") for sentence in _sentences(compared))


MISFIT = Analysis(
    name="misfit",
    after="effective",
    compute=_compute,
    asked=lambda request: True,
    lane_cells=_lane_cells,
    place="quality",
    section=_sentences,
    shown=_shown,
)
