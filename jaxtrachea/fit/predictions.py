"""The fitted model at the measured points, for plots, residual tables and cross-validation."""

import dataclasses

import numpy as np

from jaxtrachea.fit.map_lanes import batch_size, map_lanes
from jaxtrachea.fit.residual import residual_value
from jaxtrachea.fit.result import FitResult
from jaxtrachea.fit.study import Study


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """Model minus data in units; NaN where nothing was observed.

    Attributes:
        force: N; (lanes, trials, samples).
        joints: mm; (lanes, trials, samples, rings), or None.
    """

    force: np.ndarray
    joints: np.ndarray | None

    def worst(self, result: FitResult) -> str:
        """The largest force residual in words."""
        size = np.where(np.isfinite(self.force), np.abs(self.force), -1)
        lane, trial, sample = np.unravel_index(np.argmax(size), size.shape)
        curves = result.study.curves[lane]
        if size[lane, trial, sample] < 0:
            return "none, no finite prediction"
        curve = curves[trial]
        value = self.force[lane, trial, sample]
        return (
            f"{value:+.3g} N at {curve.displacement[sample]:.3g} mm in {curve.specimen} "
            f"{curve.trial}, where {curve.force[sample]:.4g} N were measured"
        )


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


def predictions(study: Study, theta: np.ndarray, batch: int = 256) -> Prediction:
    """Residuals of all lanes at `theta` (lanes, P), in N and mm."""
    value = map_lanes(residual_value, study, theta, batch=batch_size(len(theta), batch))
    lanes = study.lanes
    samples = lanes.force.shape[-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        force = np.where(lanes.precision > 0, value[..., :samples] / lanes.precision, np.nan)
        joints = None
        if lanes.joints is not None and lanes.joint_precision is not None:
            markers = value[..., samples:].reshape(lanes.joints.shape) / lanes.joint_precision
            joints = np.where(lanes.joint_precision > 0, markers, np.nan)
    return Prediction(force, joints)


def rms(values: np.ndarray) -> np.ndarray | np.floating:
    """Root mean square along the last axis over what is not NaN; NaN if nothing is left."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(known, values**2, 0).sum(axis=-1) / known.sum(axis=-1))
