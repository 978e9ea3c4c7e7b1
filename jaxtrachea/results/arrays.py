"""A fit as named arrays with a leading axis of lanes, and back."""

import dataclasses

import numpy as np

from jaxtrachea.fitting.covariance import Uncertainty
from jaxtrachea.fitting.criteria import Criteria
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study

_APART = ("study", "criteria", "uncertainty")
#: Names on file of fields of `Uncertainty` that are called otherwise there.
STORED_AS = {
    "weakest_direction": "flat", "weakest_se": "flat_se", "structural_null_space": "blind",
    "conditional_direction": "along", "null_space": "silent",
}  # fmt: skip
#: Fields of a result that are arrays with the leading axis of lanes.
FIELDS = tuple(f.name for f in dataclasses.fields(FitResult) if f.name not in _APART)


def arrays_of(result: FitResult) -> dict[str, np.ndarray]:
    """Everything of a result but its study, by name; of criteria and uncertainty `PART.NAME`."""
    arrays = {name: np.asarray(getattr(result, name)) for name in FIELDS}
    arrays |= {f"criteria.{name}": v for name, v in result.criteria._asdict().items()}
    local = {STORED_AS.get(name, name): v for name, v in result.uncertainty._asdict().items()}
    return arrays | {f"uncertainty.{name}": v for name, v in local.items()}


def result_of(study: Study, arrays: dict[str, np.ndarray]) -> FitResult:
    """The result that `arrays_of` took apart.

    Raises:
        KeyError: an array is missing.
        ValueError: an array does not fit the study.
    """
    lanes = study.lanes.lower.shape[0]
    for name, array in arrays.items():
        if array.shape[:1] != (lanes,):
            raise ValueError(f"{name} has shape {array.shape}; expected {lanes} lanes")
    if arrays["theta"].shape != (lanes, study.size):
        raise ValueError(f"theta has shape {arrays['theta'].shape}")
    keys = (STORED_AS.get(name, name) for name in Uncertainty._fields)
    local = Uncertainty(*(arrays[f"uncertainty.{key}"] for key in keys))
    said = Criteria(*(arrays[f"criteria.{name}"] for name in Criteria._fields))
    fields = {name: arrays[name] for name in FIELDS}
    return FitResult(study=study, criteria=said, uncertainty=local, **fields)
