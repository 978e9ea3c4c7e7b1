"""Residuals against the noise given, in tables and report. Done in every fit."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.inference.analysis import Analysis, Cells, Findings, Progress, Request
from jaxtrachea.inference.misfit import Misfit, misfit


def _compute(request: Request, findings: Findings, progress: Progress) -> Misfit:
    return misfit(findings.result, findings.result.residuals)


def _lane_cells(compared: Misfit, lane: int) -> Cells:
    return {"residual_over_noise": float(compared.ratio[lane])}


def _sentences(compared: Misfit) -> list[str]:
    """Residuals larger than the noise given, and smaller ones."""
    every, said = compared.result.lanes, []
    for beyond, cause in (
        (compared.ratio > 1, "the noise given is too small, or the model misses the curves: "
         "standard errors and intervals, which rest on it, are too small"),
        (compared.ratio < 1, "the noise given is too large: standard errors and intervals, which "
         "rest on it, are too large"),
    ):  # fmt: skip
        lanes = np.flatnonzero(compared.told & beyond)
        if len(lanes):
            ratio = float(np.median(compared.ratio[lanes]))
            where = f" in {len(lanes)} of {every} lanes" if every > 1 else ""
            said.append(
                f"Force residuals are {ratio:.2g} times the noise given (root of chi^2 / (n - P))"
                f"{where}: {cause} by about this factor. Leave `noise.force` out to take it from "
                "the residuals."
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
