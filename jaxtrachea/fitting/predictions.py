"""The fitted model at the measured points, for plots, residual tables and cross-validation."""

import dataclasses
from typing import Any

import numpy as np

from jaxtrachea.fitting.lane import forces, markers
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.study import Study


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """Model minus data in units; NaN where nothing was observed, None where no lane observes it.

    Attributes:
        force: N; (lanes, trials, samples).
        joints: mm; (lanes, trials, samples, rings), or None.
        side_force: N, see `Curve`; (lanes, trials, samples), or None.
        joint_side: mm, along the circumference; as `joints`, or None.
        ends: mm, of ring ends U and V, y and z; (lanes, trials, samples, rings, 2, 2), or None.
    """

    force: np.ndarray
    joints: np.ndarray | None
    side_force: np.ndarray | None = None
    joint_side: np.ndarray | None = None
    ends: np.ndarray | None = None


def predictions(
    study: Study, theta: np.ndarray, batch: int = 256, *, like: int | None = None
) -> Prediction:
    """Residuals of all lanes at `theta` (lanes, P), in N and mm.

    Args:
        study: the study.
        theta: scaled coordinates; (lanes, P).
        batch: lanes computed together, at most.
        like: lanes of a study whose program serves; None: as many as these.
    """
    like = len(theta) if like is None else like
    batch, unoptimised = study.batch_size(like, batch), study.unoptimised(like)
    value = map_lanes(residual_value, study, theta, batch=batch, unoptimised=unoptimised)
    lanes, first = study.lanes, 0
    found: dict[str, Any] = {"joints": None}
    for kind in forces(lanes) + markers(lanes):
        after = first + lanes.force.shape[-1] * kind.places
        part, first = value[..., first:after].reshape(kind.data.shape), after
        residual = np.full(part.shape, np.nan)
        found[kind.name] = np.divide(part, kind.precision, out=residual, where=kind.precision > 0)
    return Prediction(**found)
