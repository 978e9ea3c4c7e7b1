"""The fitted model at the measured points, for plots, residual tables and cross-validation."""

import dataclasses

import numpy as np

from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.programs import batch_size


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """Model minus data in units; NaN where nothing was observed.

    Attributes:
        force: N; (lanes, trials, samples).
        joints: mm; (lanes, trials, samples, rings), or None.
    """

    force: np.ndarray
    joints: np.ndarray | None


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
