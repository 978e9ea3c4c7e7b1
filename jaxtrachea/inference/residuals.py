"""Residuals as a whole: their size, their largest, and where along a press the model misses."""

from typing import NamedTuple

import numpy as np

from jaxtrachea.fitting.glitches import glitches
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.result import FitResult


def rms(values: np.ndarray) -> np.ndarray | np.floating:
    """Root mean square along the last axis over what is not NaN; NaN if nothing is left."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(known, values**2, 0).sum(axis=-1) / known.sum(axis=-1))


def worst(prediction: Prediction, result: FitResult) -> str:
    """The largest force residual in words."""
    largest = [np.max(np.abs(r), where=np.isfinite(r), initial=-1) for r in prediction["force"]]
    lane = int(np.argmax(largest))
    if largest[lane] < 0:
        return "none, no finite prediction"
    force = prediction["force"][lane]
    trial, sample = np.argwhere(np.abs(force) == largest[lane])[0]
    curve, value = result.study.curves[lane][trial], force[trial, sample]
    return (
        f"{value:+.3g} N at {curve.displacement[sample]:.3g} mm in {curve.specimen} "
        f"{curve.trial}, where {curve.force[sample]:.4g} N were measured"
    )


#: Neighbouring residuals whose mean decides on which side of the record the model runs.
_WINDOW = 5


def where_missed(result: FitResult, lane: int) -> str:
    """The curve that the model misses most, and from where to where along the press.

    The stretch is the one of residuals of one sign with the largest sum.
    """
    residual, curves = result.residuals["force"][lane], result.study.curves[lane]
    curve, row = max(zip(curves, residual, strict=False), key=lambda pair: float(rms(pair[1])))
    known = np.flatnonzero(np.isfinite(row))
    order = known
    if curve.rise is None:  # else as it went
        order = known[np.argsort(curve.displacement[known], kind="stable")]
    depth, r = curve.displacement[order], row[order]
    width = min(_WINDOW, len(r))
    smooth = np.convolve(r, np.full(width, 1 / width), "same")
    edges = np.flatnonzero(np.diff(np.sign(smooth))) + 1
    runs = np.split(np.arange(len(r)), edges)
    run = max(runs, key=lambda places: abs(float(np.sum(smooth[places]))))
    largest = run[np.argmax(np.abs(r[run]))]
    peak = float(np.max(np.abs(curve.force)))
    side = "above" if smooth[run].sum() > 0 else "below"
    return (
        f"{curve.specimen} {curve.trial} from {depth[run[0]]:.3g} to {depth[run[-1]]:.3g} mm, "
        f"where the model runs {side} the record by up to {abs(r[largest]):.2g} N "
        f"({100 * abs(r[largest]) / peak:.2g} % of the peak)"
    )


class Glitch(NamedTuple):
    """A force sample that stands alone (`fitting.glitches`): where, and its residual, N."""

    lane: int
    trial: int
    sample: int
    residual: float


def glitches_of(result: FitResult) -> list[Glitch]:
    """Glitches of the lanes that have an estimate, the largest first."""
    residual, lanes = result.residuals["force"], result.study.lanes
    found = glitches(residual, np.asarray(lanes.force), np.asarray(lanes.precision))
    places = np.argwhere(found & result.succeeded[:, None, None]).tolist()
    each = [Glitch(k, t, i, float(residual[k, t, i])) for k, t, i in places]
    return sorted(each, key=lambda glitch: -abs(glitch.residual))
