"""Residuals as a whole: their size, their largest, and where along a press the model misses."""

from typing import NamedTuple

import numpy as np

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


#: A glitch is as many times the noise, and as large a share of the lane's peak. Lanes whose largest
#: residual is less than `SEARCHED` times the mean have none.
GLITCH, OF_PEAK, SEARCHED = 8.0, 1e-3, 5.0
#: Share of the residuals that are taken for noise, and the normal quantile of it.
_QUIET, _NORMAL = 0.9, 1.645


class Glitch(NamedTuple):
    """A force sample that stands alone: its lane, trial and number, and its residual, N."""

    lane: int
    trial: int
    sample: int
    residual: float


def glitches(result: FitResult) -> list[Glitch]:
    """Force samples far from the model while both neighbours are near it; the largest first.

    Far is `GLITCH` times the noise, which is taken from the residuals of the lane and from what
    they differ from the mean of their neighbours (90 % quantiles: up to a tenth may be glitches).
    Where a model misses a stretch, neighbours are missed alike. Ends of a record have no neighbour
    on one side, and are not looked at.
    """
    found = []
    for lane in np.flatnonzero(result.succeeded).tolist():
        residual = result.residuals["force"][lane]
        size = np.abs(residual[np.isfinite(residual)])
        if not size.size or not size.max() > SEARCHED * size.mean():
            continue
        z = residual * np.asarray(result.study.lanes.precision[lane])
        alone = np.zeros_like(z)
        alone[:, 1:-1] = z[:, 1:-1] - (z[:, :-2] + z[:, 2:]) / 2
        alone = np.where(np.isfinite(alone), alone, 0.0)
        known = np.isfinite(z)
        noise = np.quantile(np.abs(z[known]), _QUIET) / _NORMAL
        differs = np.quantile(np.abs(alone[known]), _QUIET) / _NORMAL
        height = np.abs(alone)
        least = (height > GLITCH * max(noise, differs)) & (np.abs(z) > GLITCH * noise)
        least[:, 1:-1] &= height[:, 1:-1] > np.maximum(height[:, :-2], height[:, 2:])
        peak = np.max(np.abs(result.study.lanes.force[lane]))
        least &= np.abs(residual) > OF_PEAK * peak
        found += [Glitch(lane, t, i, float(residual[t, i])) for t, i in np.argwhere(least).tolist()]
    return sorted(found, key=lambda glitch: -abs(glitch.residual))
