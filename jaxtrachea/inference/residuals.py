"""What residuals say as a whole: their size, their largest, and whether neighbours are alike."""

import numpy as np

from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.result import FitResult


def rms(values: np.ndarray) -> np.ndarray | np.floating:
    """Root mean square along the last axis over what is not NaN; NaN if nothing is left."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(known, values**2, 0).sum(axis=-1) / known.sum(axis=-1))


def lag_correlation(prediction: Prediction) -> np.ndarray:
    """Correlation of neighbouring force residuals along the curves of each lane; (lanes,).

    About 0 for independent noise, near 1 where the model misses the shape of the curves; NaN with
    fewer than 10 pairs. Not centred: a residual of one sign is correlated, too.
    """
    r = np.nan_to_num(prediction.force)
    pair = np.isfinite(prediction.force[..., 1:]) & np.isfinite(prediction.force[..., :-1])
    both = np.sum(r[..., 1:] * r[..., :-1] * pair, axis=(1, 2))
    ends = 0.5 * np.sum((r[..., 1:] ** 2 + r[..., :-1] ** 2) * pair, axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.sum(pair, axis=(1, 2)) >= 10, both / ends, np.nan)


def worst(prediction: Prediction, result: FitResult) -> str:
    """The largest force residual in words."""
    size = np.where(np.isfinite(prediction.force), np.abs(prediction.force), -1)
    lane, trial, sample = np.unravel_index(np.argmax(size), size.shape)
    curves = result.study.curves[lane]
    if size[lane, trial, sample] < 0:
        return "none, no finite prediction"
    curve = curves[trial]
    value = prediction.force[lane, trial, sample]
    return (
        f"{value:+.3g} N at {curve.displacement[sample]:.3g} mm in {curve.specimen} "
        f"{curve.trial}, where {curve.force[sample]:.4g} N were measured"
    )
