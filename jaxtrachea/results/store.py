"""The groups of results.h5 that hold the study of a fit: model, lanes, data as used.

Numbers and JSON (as bytes) only; `read` makes the study of them again.
"""

import dataclasses
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import h5py
import numpy as np

from jaxtrachea.fitting.lane import forces, markers
from jaxtrachea.fitting.lanes import measured
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.observed import FITTED, FITTED_NUMBERS, RINGS
from jaxtrachea.measurements.read import Curve
from jaxtrachea.measurements.readers.hdf5_values import numeric
from jaxtrachea.trachea.geometry import Geometry

#: Arrays of the tube.
GEOMETRY = tuple(f.name for f in dataclasses.fields(Geometry))
#: Begin of the names of precisions and residuals of what is observed.
HEADS = {"force": ""} | {name: f"{parts[0].short}_" for name, parts in FITTED.items()}
#: Arrays of the study that have a row for each sample.
BY_SAMPLE = (*(f"{head}precision" for head in HEADS.values()), "shares_plain", "time", "rising")
#: Pieces of a column that are tried, rows of each, and the part that gzip must leave at most.
PIECES, ROWS, WORTH = 16, 1024, 0.7


def write(
    file: h5py.File, result: FitResult, files: Mapping[str, str], reading: Mapping[str, Any]
) -> None:
    """Add the groups `model`, `study` and `data` to results.h5.

    Args:
        file: open for writing.
        files: SHA-256 by file name.
        reading: the [data] section.
    """
    study = result.study
    place = {p.name: j for j, p in enumerate(study.parameters)}
    unknowns = [[[place[p.name], *names] for p, *names in lane] for lane in study.unknowns]
    group = file.create_group("model")
    _write_json(
        group,
        {
            "options": dataclasses.asdict(study.model.options),
            "parameters": [dataclasses.asdict(p) for p in study.parameters],
            "unknowns": unknowns,
            "lanes": [study.lane_name(lane) for lane in range(result.lanes)],
            "loss": study.model.loss,
            "loss_scale": study.model.loss_scale,
            "common": study.model.common,
            "noise_given": study.noise_given,
            "balance": study.balance,
            "marker_noise": study.marker_noise,
            "joint": study.joint,
            "together": study.holdout_groups,
            "force_share": study.force_share,
            "reading": dict(reading),
            "units": {"length": "mm", "force": "N", "angle": "rad"},
        },
    )
    for name in GEOMETRY:
        group.create_dataset(name, data=np.asarray(getattr(study.model.geometry, name), np.float64))
    _write_lanes(file.create_group("study"), study)
    _write_data(file.create_group("data"), result, files)


def _write_lanes(group: h5py.Group, study: Study) -> None:
    """What of the lanes does not follow from the curves; samples end to end."""
    others = study.lanes.others.items()
    arrays = study.lanes._asdict() | {f"{HEADS[name]}precision": v.precision for name, v in others}
    arrays |= {
        "change_points": study.change_points,
        "record_zeros": study.record_zeros,
    }
    if study.shares is not None:
        arrays |= {f"shares_{name}": v for name, v in study.shares._asdict().items()}
    rows = placed(study)
    for name, values in arrays.items():
        if values is None or name in ("displacement", "force", "others"):
            continue
        values = np.asarray(values)
        _put(group, name, _end_to_end(values, rows) if name in BY_SAMPLE else values)


def _end_to_end(values: np.ndarray, rows: list[tuple[int, int, Curve]]) -> np.ndarray:
    """Samples of the curves, without those that fill up shorter ones."""
    return np.concatenate([values[k, t, : len(c.force)] for k, t, c in rows])


def _put(group: h5py.Group, name: str, values: np.ndarray) -> None:
    group.create_dataset(name, data=values, **_packing(values))


def placed(study: Study) -> list[tuple[int, int, Curve]]:
    """Lane, trial and curve, in the order in which the file has them."""
    return [(k, t, c) for k, lane in enumerate(study.curves) for t, c in enumerate(lane)]


def _write_data(group: h5py.Group, result: FitResult, files: Mapping[str, str]) -> None:
    """Every curve as it was used, with the model's answer at the estimate; samples end to end."""
    study = result.study
    rows = placed(study)
    curves = [c for _, _, c in rows]
    names = sorted(files, key=len, reverse=True)
    _write_json(
        group,
        {
            "specimen": [c.specimen for c in curves],
            "trial": [c.trial for c in curves],
            "source": [_short_source(c.source, names) for c in curves],
            "files": dict(files),
        },
    )
    group["lane"] = np.array([k for k, _, _ in rows], np.int32)
    group["samples"] = np.array([len(c.force) for c in curves], np.int64)
    group["s_c"] = np.array([np.nan if c.s_c is None else c.s_c for c in curves])
    group["phi_c"] = np.array([c.phi_c for c in curves])
    group["direction"] = np.array([c.direction for c in curves], np.float64)
    blend = study.lanes.blend
    group["blend"] = np.array([np.nan if blend is None else blend[k, t] for k, t, _ in rows])
    if study.model.relaxes:
        group["rise"] = np.array([c.rise or (0, len(c.force)) for c in curves], np.int64)
    for name, column in _columns(result, rows).items():
        _put(group, name, column())


def _columns(
    result: FitResult, rows: list[tuple[int, int, Curve]]
) -> dict[str, Callable[[], np.ndarray]]:
    """What makes each column of samples end to end: two at once take as much as the study."""
    study, seen = result.study, result.residuals
    rings, curves = study.model.geometry.rings, [c for _, _, c in rows]
    unknown = np.full(max(len(c.force) for c in curves), np.nan)

    def of(curve: Curve, name: str) -> np.ndarray:
        own = name in ("displacement", "force")
        return getattr(curve, name) if own else measured(curve, name, rings)

    def given(name: str) -> np.ndarray:
        return np.concatenate([of(c, name) for c in curves])

    def predicted(name: str) -> np.ndarray:
        values, end = np.asarray(_end_to_end(seen[name], rows), np.float64), 0
        for curve in curves:
            start, end = end, end + len(curve.force)
            values[start:end] += of(curve, name)
        return values

    def sigma() -> np.ndarray:
        known = (unknown[: len(c.force)] if c.sigma is None else c.sigma for c in curves)
        return np.concatenate([*known])

    columns: dict[str, Callable[[], np.ndarray]]
    columns = {"displacement": partial(given, "displacement"), "sigma": sigma}
    for kind in forces(study.lanes) + markers(study.lanes):
        name, head = kind.name, HEADS[kind.name]
        columns[name] = partial(given, name)
        columns[f"{head}residual"] = partial(_end_to_end, seen[name], rows)
        if name == "force" or name in FITTED_NUMBERS:
            columns[f"{head}predicted"] = partial(predicted, name)
    if study.model.relaxes:
        columns["time"] = lambda: np.concatenate([c.time for c in curves if c.time is not None])
    return columns


def _packing(values: np.ndarray) -> dict[str, Any]:
    """How a column is stored: by gzip where pieces all along it get much smaller by it.

    Of noise every bit is new; 30 million measured numbers took 5 s to get smaller by a fifth.
    """
    begins = np.linspace(0, max(len(values) - ROWS, 0), PIECES).astype(int)
    tried = [values[i : i + ROWS].tobytes() for i in np.unique(begins)]
    shuffled = [np.frombuffer(b, np.uint8).reshape(-1, values.itemsize).T.tobytes() for b in tried]
    if sum(len(zlib.compress(b, 1)) for b in shuffled) > WORTH * sum(map(len, tried)):
        return {}
    return {"compression": "gzip", "compression_opts": 1, "shuffle": True}


def _short_source(source: str, names: Sequence[str]) -> str:
    """A source without the folders before the file's name."""
    found = next((name for name in names if name in source), None)
    return source.rpartition("/")[2] if found is None else source[source.index(found) :]


def _write_json(group: h5py.Group, content: object) -> None:
    data = np.frombuffer(json.dumps(content).encode(), np.uint8)
    group.create_dataset("description", data=data, compression="gzip")


def read_json(group: Any) -> Any:
    """The JSON text of a group.

    Raises:
        ValueError: no such text.
    """
    return json.loads(numeric(group, "description").astype(np.uint8).tobytes().decode())


def read_data(group: Any) -> tuple[tuple[Curve, ...], np.ndarray, dict[str, str]]:
    """Curves with what of them the fit has used, the lane of each, and SHA-256 by file name."""
    names = read_json(group)
    samples = numeric(group, "samples").astype(int)
    ends = np.cumsum(samples)
    column = {c: numeric(group, c) for c in ("displacement", "force", "sigma", "s_c", "phi_c")}
    direction = numeric(group, "direction")
    observed = _observed(group)
    rise = numeric(group, "rise").astype(int).tolist() if "rise" in group else None
    curves = []
    texts = zip(names["specimen"], names["trial"], names["source"], strict=True)
    for i, (specimen, trial, source) in enumerate(texts):
        part = slice(ends[i] - samples[i], ends[i])
        sigma = column["sigma"][part]
        curves.append(
            Curve(
                specimen=specimen,
                trial=trial,
                s_c=None if np.isnan(column["s_c"][i]) else float(column["s_c"][i]),
                phi_c=float(column["phi_c"][i]),
                displacement=column["displacement"][part],
                force=column["force"][part],
                sigma=None if np.isnan(sigma).all() else sigma,
                source=source,
                direction=(float(direction[i][0]), float(direction[i][1])),
                rise=None if rise is None else (rise[i][0], rise[i][1]),
                **{name: v if name in RINGS else v[part] for name, v in observed.items()},
            )
        )
    return tuple(curves), numeric(group, "lane").astype(int), names["files"]


def _observed(group: Any) -> dict[str, Any]:
    """Fields of curves beside the force, samples end to end; NaN where the fit has not used them.

    Rings are numbered, with no axis of samples.
    """
    out: dict[str, Any] = {"time": numeric(group, "time")} if "time" in group else {}
    for name, parts in FITTED.items():
        if name not in group:
            continue
        values = numeric(group, name)
        if parts[0].rings is not None:
            used = np.isfinite(numeric(group, f"{HEADS[name]}residual"))
            values, out[parts[0].rings] = np.where(used, values, np.nan), np.arange(used.shape[1])
        for k, q in enumerate(parts):
            out[q.name] = values[:, :, k] if len(parts) > 1 else values
    return out
