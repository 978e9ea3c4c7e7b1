"""A finished fit read back from its results.h5, bit for bit.

Through the audited door for files that nobody vouches for (`readers.safe_hdf5`).
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.fitting.lane import Lane, Seen
from jaxtrachea.fitting.model import FitModel, columns_of, numbers_of
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.result import FitResult, Origin
from jaxtrachea.fitting.study import Shares, Study
from jaxtrachea.measurements.curve import Fault
from jaxtrachea.measurements.read import Curve, DataError
from jaxtrachea.measurements.readers.hdf5_values import attribute, numeric
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.mechanics.press import Options
from jaxtrachea.results.arrays import PLACES, result_of
from jaxtrachea.results.hdf5 import SCHEMA, VERSION
from jaxtrachea.results.store import BY_SAMPLE, GEOMETRY, HEADS, read_data, read_json
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

#: Groups and datasets that are read; nothing else of the file is.
READ = ("/model", "/study", "/data", *(f"/{place}" for place in PLACES.values()))


class NoResults(ValueError):
    """No finished results, or such that cannot be read; the message names the cure."""


def read_results(path: Path | str) -> FitResult:
    """Read a finished fit.

    Curves have what the fit has used of them, not how they were cut out of their records.

    Args:
        path: the folder of a finished `jaxtrachea fit`, or its results.h5.

    Raises:
        NoResults: no such folder or file, an unfinished run, a damaged file, one of another kind or
            of an earlier version; with the cure.
    """
    path = _file_of(Path(path))
    try:
        with opened(path, read=READ) as file:
            _check_schema(path, attribute(file, "schema"), attribute(file, "schema_version"))
            return _read(path, file)
    except DataError as error:
        raise NoResults(str(error)) from None
    except (
        Fault, KeyError, TypeError, ValueError, IndexError, AttributeError, MemoryError,
    ) as error:  # fmt: skip
        if isinstance(error, NoResults):
            raise
        reason = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise NoResults(
            f"{path}: damaged or not written by this program ({reason}); fit again"
        ) from None


def read_again(path: Path, study: Study) -> FitResult:
    """Read a finished fit of a study, whose curves know how they were cut out of their records.

    Raises:
        NoResults: as `read_results`, or it is of another study.
    """
    result = read_results(path)
    found = result.study
    names = [[(p.name, *of) for p, *of in lane] for lane in found.unknowns]
    if names != [[(p.name, *of) for p, *of in lane] for lane in study.unknowns]:
        raise NoResults(f"{path} is of another study; fit again")
    if found.parameters != study.parameters:
        raise NoResults(f"{path}: its parameters have other values, bounds or steps; fit again")
    return dataclasses.replace(result, study=dataclasses.replace(found, curves=study.curves))


def _file_of(path: Path) -> Path:
    """The results.h5 that is meant."""
    if path.is_dir():
        if (path / "results.h5").is_file():
            return path / "results.h5"
        if (path / ".run").is_dir():
            raise NoResults(
                f"{path}: this fit has not ended; go on with it: "
                f"jaxtrachea fit SPEC --out {path} --resume"
            )
        raise NoResults(
            f"{path}: no results.h5 in this folder; name the folder that a fit was written to"
        )
    if not path.exists():
        raise NoResults(
            f"{path}: no such folder or file; name the folder that a fit was written to"
        )
    return path


def _check_schema(path: Path, schema: object, version: object) -> None:
    if schema != SCHEMA:
        raise NoResults(
            f"{path}: schema is {schema!r}, expected {SCHEMA!r}; name the results of a fit "
            "(its folder, or results.h5 in it)"
        )
    if version in range(1, VERSION):
        raise NoResults(
            f"{path}: schema version {version} does not keep all of the fit; fit again with this "
            "version: jaxtrachea fit SPEC"
        )
    if version != VERSION:
        raise NoResults(
            f"{path}: schema version is {version}, this program reads {VERSION}; use the program "
            "that wrote it, or fit again"
        )


def _read(path: Path, file: Any) -> FitResult:
    model = read_json(file["model"])
    curves, lane, files = read_data(file["data"])
    trials = file["study/s_c"].shape[1]
    place = _Places(lane, np.array([len(c.force) for c in curves]), trials)
    study = _study(file, model, place, curves)
    arrays = {name: file[where][()] for name, where in PLACES.items()}
    arrays["status"] = arrays["status"].astype(int)
    if set(arrays["status"].tolist()) - {int(s) for s in FitStatus}:
        raise ValueError("statuses that there are not")
    result = result_of(study, arrays)
    return dataclasses.replace(
        result,
        study=study,
        origin=Origin(path, model["reading"], files),
        stored_residuals=_residuals(file["data"], place, study.lanes),
    )


class _Places:
    """Where the samples of all curves, end to end, lie in the arrays of lanes.

    Attributes:
        at: lane, trial and place of every sample.
        shape: lanes, trials and samples at most.
    """

    def __init__(self, lane: np.ndarray, samples: np.ndarray, trials: int):
        """From the lane of each curve and its samples, in the order of the file."""
        if not len(lane) or np.any(np.diff(lane) < 0) or lane[0] < 0 or np.any(samples < 1):
            raise ValueError("curves without samples, or of no lane")
        trial = np.arange(len(lane)) - np.searchsorted(lane, lane)
        ends = np.cumsum(samples)
        sample = np.arange(ends[-1]) - np.repeat(ends - samples, samples)
        self.at = np.repeat(lane, samples), np.repeat(trial, samples), sample
        self.lane = lane
        self.shape = int(lane[-1]) + 1, trials, int(samples.max())

    def spread(self, values: np.ndarray, blank: float = 0.0) -> np.ndarray:
        """The samples in the arrays of lanes; `blank` where a curve is shorter."""
        out = np.full((*self.shape, *values.shape[1:]), blank)
        out[self.at] = values
        return out


def _study(file: Any, model: dict[str, Any], place: _Places, curves: tuple[Curve, ...]) -> Study:
    """What was fitted, with its data."""
    parameters = tuple(Parameter(**row) for row in model["parameters"])
    geometry = Geometry(**{name: numeric(file["model"], name) for name in GEOMETRY})
    stored = {name: file["study"][name][()] for name in file["study"]}
    arrays = {n: place.spread(v) if n in BY_SAMPLE else v for n, v in stored.items()}
    shares = None
    if "shares_share" in arrays:
        sigma = arrays.pop("shares_sigma", None)
        shares = Shares(arrays.pop("shares_share"), sigma, arrays.pop("shares_plain"))
    seen = {name: arrays.pop(name, None) for name in ("change_points", "record_zeros")}
    groups: list[list[Curve]] = [[] for _ in range(place.shape[0])]
    for curve, lane in zip(curves, place.lane.tolist(), strict=True):
        groups[lane].append(curve)
    study = Study(
        model=FitModel(
            tube=numbers_of(geometry),
            options=Options(**model["options"]),
            columns=columns_of(parameters),
            loss=model["loss"],
            loss_scale=float(model["loss_scale"]),
            common=model["common"],
        ),
        parameters=parameters,
        lanes=_lanes(file["data"], place, arrays),
        curves=tuple(map(tuple, groups)),
        unknowns=tuple(
            tuple((parameters[j], specimen, trial) for j, specimen, trial in lane)
            for lane in model["unknowns"]
        ),
        noise_given=(bool(model["noise_given"][0]), bool(model["noise_given"][1])),
        marker_noise=_pair(model["marker_noise"]),
        joint=bool(model["joint"]),
        holdout_groups=tuple(map(tuple, model["together"])),
        balance=model["balance"],
        force_share=model["force_share"],
        shares=shares,
        **seen,
    )
    _check_shapes(study, place)
    return study


def _lanes(data: Any, place: _Places, arrays: dict[str, Any]) -> Lane:
    """The lanes out of what is stored of them, and of the curves."""
    others = {}
    for name, head in HEADS.items():
        if name != "force" and (weight := arrays.pop(f"{head}precision", None)) is not None:
            values = place.spread(numeric(data, name))
            others[name] = Seen(np.where(weight > 0, values, 0.0), weight)
    if "time" in arrays:  # padding repeats the last
        arrays["time"] = np.maximum.accumulate(arrays["time"], axis=-1)
    pressed = {name: place.spread(numeric(data, name)) for name in ("displacement", "force")}
    every: dict[str, Any] = {"blend": None} | arrays | pressed
    return Lane(others=others, **every)


def _residuals(data: Any, place: _Places, lanes: Lane) -> Prediction:
    """Model minus data, as the fit has left it."""
    return {
        name: place.spread(numeric(data, f"{HEADS[name]}residual"), np.nan)
        for name in ("force", *lanes.others)
    }


def _pair(found: Any) -> tuple[float, float] | None:
    """Two numbers, or none."""
    return None if found is None else (float(found[0]), float(found[1]))


def _check_shapes(study: Study, place: _Places) -> None:
    """Refuse arrays that do not belong together."""
    lanes, (L, T, N), J = study.lanes, place.shape, len(study.parameters)
    P = lanes.lower.shape[-1]
    if len(study.unknowns) != L or max(map(len, study.unknowns), default=0) > P:
        raise ValueError("unknowns and lanes that do not belong together")
    shapes = {"s_c": (L, T), "balance": (L, T), "blend": (L, T), "value": (L, T, J),
              "index": (L, T, J), "lower": (L, P), "upper": (L, P), "active": (L, P),
              "phi_c": (L, T), "direction": (L, T, 2), "precision": (L, T, N)}  # fmt: skip
    for name, shape in shapes.items():
        found = getattr(lanes, name)
        if found is not None and found.shape != shape:
            raise ValueError(f"{name} has shape {found.shape}, expected {shape}")
    if lanes.index.max(initial=-1) >= P:
        raise ValueError("unknowns that there are not")
