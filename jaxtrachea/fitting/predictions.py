"""The fitted model at the measured points, for plots, residual tables and cross-validation."""

from typing import Any

import numpy as np

from jaxtrachea.fitting.lane import forces, markers
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.study import Study

#: Model minus data by name of what is observed, `force` and those of `Lane.others`, N and mm;
#: (lanes, trials, samples, what a sample has); NaN where nothing was observed.
Prediction = dict[str, Any]


def predictions(
    study: Study, theta: np.ndarray, batch: int = 256, *, like: int | None = None
) -> Prediction:
    """Residuals of all lanes at `theta` (lanes, P), in N and mm.

    Args:
        theta: scaled coordinates; (lanes, P).
        batch: lanes computed together, at most.
        like: lanes of a study whose program serves; None: as many as these.
    """
    like = len(theta) if like is None else like
    batch, unoptimised = study.batch_size(like, batch), study.evaluates_few(like)
    value = map_lanes(residual_value, study, theta, batch=batch, unoptimised=unoptimised)
    lanes, first = study.lanes, 0
    found: Prediction = {}
    for kind in forces(lanes) + markers(lanes):
        after = first + lanes.force.shape[-1] * kind.places
        part, first = value[..., first:after].reshape(kind.data.shape), after
        weighed = kind.precision > 0
        np.divide(part, kind.precision, out=part, where=weighed)
        np.copyto(part, np.nan, where=~weighed)
        found[kind.name] = part
    return found
