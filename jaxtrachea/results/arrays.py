"""A fit as named arrays with a leading axis of lanes, and back; where each lies in results.h5."""

import dataclasses
from typing import Any

import numpy as np

from jaxtrachea.fitting.covariance import Uncertainty
from jaxtrachea.fitting.criteria import Criteria
from jaxtrachea.fitting.force_share import as_weighed, with_shares
from jaxtrachea.fitting.result import OF_UNKNOWNS, FitResult
from jaxtrachea.fitting.study import Shares, Study

_APART = ("study", "criteria", "uncertainty", "origin", "stored_residuals")
#: Names on file of fields of `Uncertainty` that are called otherwise there.
STORED_AS = {
    "weakest_direction": "flat", "weakest_se": "flat_se", "structural_null_space": "blind",
    "conditional_direction": "along", "null_space": "silent",
}  # fmt: skip
#: Fields of a result that are arrays with the leading axis of lanes.
FIELDS = tuple(f.name for f in dataclasses.fields(FitResult) if f.name not in _APART)


def _places() -> dict[str, str]:
    """Fields of single unknowns lie in a group of their own."""
    found = {n: f"unknowns/{n}" if n in OF_UNKNOWNS else f"lanes/{n}" for n in FIELDS}
    found |= {f"criteria.{name}": f"lanes/{name}" for name in Criteria._fields}
    local = {STORED_AS.get(name, name) for name in Uncertainty._fields}
    found |= {f"uncertainty.{name}": f"uncertainty/{name}" for name in local}
    moved = {"condition": "lanes", "correlation": "unknowns", "flat": "unknowns"}
    return found | {f"uncertainty.{name}": f"{group}/{name}" for name, group in moved.items()}


#: Dataset of results.h5 that holds each array of a result, but for those of `Shares`.
PLACES = _places()


def arrays_of(result: FitResult, *, weighed: bool = False) -> dict[str, np.ndarray]:
    """Everything of a result but its study, by name; of criteria and uncertainty `PART.NAME`.

    Of the study what the fit has found of the noise: `shares.NAME`, where there is any, or if
    `weighed`.
    """
    arrays = {name: np.asarray(getattr(result, name)) for name in FIELDS}
    arrays |= {f"criteria.{name}": v for name, v in result.criteria._asdict().items()}
    local = {STORED_AS.get(name, name): v for name, v in result.uncertainty._asdict().items()}
    arrays |= {f"uncertainty.{name}": v for name, v in local.items()}
    if weighed or result.study.shares is not None:
        study = as_weighed(result.study)
        assert study.shares is not None
        found = study.shares._asdict() | {"precision": np.asarray(study.lanes.precision)}
        del found["plain"]  # the study has it
        arrays |= {f"shares.{name}": v for name, v in found.items() if v is not None}
    return arrays


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
    fields: dict[str, Any] = {name: arrays[name] for name in FIELDS}
    study = _with_noise_found(study, arrays)
    return FitResult(study=study, criteria=said, uncertainty=local, **fields)


def _with_noise_found(study: Study, arrays: dict[str, np.ndarray]) -> Study:
    """The study as a fit leaves it: no refit looks for shares of the force once more."""
    if "shares.share" not in arrays:
        return study if study.shares else dataclasses.replace(study, force_share=None)
    sigma = arrays.get("shares.sigma")
    plain = np.asarray(study.lanes.precision) if study.shares is None else study.shares.plain
    shares = Shares(arrays["shares.share"], sigma, plain)
    precision = arrays["shares.precision"]
    if precision.shape != study.lanes.precision.shape:
        raise ValueError(f"shares.precision has shape {precision.shape}")
    return with_shares(study, shares, precision)
