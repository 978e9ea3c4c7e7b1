"""What results.h5 keeps of a fit so that it predicts by itself: model, estimates, data as used.

Numbers and JSON (as bytes) only; read through the audited door (`readers.safe_hdf5`). Schema 2.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np

from jaxtrachea.identify.fit import FitResult
from jaxtrachea.identify.measurements import Curve, DataError
from jaxtrachea.identify.parameters import Parameter
from jaxtrachea.identify.predictions import predictions
from jaxtrachea.identify.problem import Lane, Problem
from jaxtrachea.identify.readers.records import Fault
from jaxtrachea.identify.readers.safe_hdf5 import attribute, numeric, opened
from jaxtrachea.model import Options
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

SCHEMA = "jaxtrachea-results"
VERSION = 2
#: Groups and datasets that are read; nothing else of the file is.
READ = (
    "/model", "/data", "/lanes/status", "/lanes/sigma", "/unknowns/theta", "/unknowns/at_bound",
    "/uncertainty/covariance", "/uncertainty/blind", "/uncertainty/half_width",
)  # fmt: skip
#: 97.5 % quantile of the normal distribution, as `uncertainty.analyse` uses it.
NORMAL = 1.959963984540054
_GEOMETRY = tuple(f.name for f in dataclasses.fields(Geometry))


class NoResults(ValueError):
    """No finished results, or such that cannot predict; the message names the cure."""


@dataclasses.dataclass(frozen=True, eq=False)
class StoredFit:
    """A finished fit as read back from its results.h5.

    L lanes of up to P unknowns; scaled coordinates as in `Parameter`.

    Attributes:
        path: the file.
        problem: geometry, options, parameters and unknowns; no data.
        reading: how the data were read, as in the [data] section.
        lane_names: specimen and trial of each lane, "(all)" where it spans several.
        theta: estimates; (L, P).
        covariance: of the estimates; 0 for what is held, without the blind directions; (L, P, P).
        blind: rows: directions that change no residual, scaled coordinates; (L, P, P).
        at_bound: (L, P).
        status: `FitStatus`; (L,).
        sigma: standard deviation of force, N, and markers, mm, given or estimated; (L, 2).
        half_width: of a 95 % interval in standard errors; inf where the noise could not be
            estimated; (L,).
        curves: the data as used; `source` is the file's name and the place in it.
        curve_lane: lane of each curve; (curves,).
        files: SHA-256 by file name.
    """

    path: Path
    problem: Problem
    reading: Mapping[str, Any]
    lane_names: tuple[tuple[str, str], ...]
    theta: np.ndarray
    covariance: np.ndarray
    blind: np.ndarray
    at_bound: np.ndarray
    status: np.ndarray
    sigma: np.ndarray
    half_width: np.ndarray
    curves: tuple[Curve, ...]
    curve_lane: np.ndarray
    files: Mapping[str, str]

    @property
    def specimens(self) -> tuple[str, ...]:
        """Names of the fitted specimens, in the order of the data."""
        return tuple(dict.fromkeys(c.specimen for c in self.curves))

    @functools.cached_property
    def spans(self) -> np.ndarray:
        """Range of displacement and of contact position of the data of each lane, mm; (L, 4)."""
        out = np.tile([np.inf, -np.inf] * 2, (len(self.status), 1))
        for curve, lane in zip(self.curves, self.curve_lane, strict=True):
            D, s = curve.displacement, np.nan if curve.s_c is None else curve.s_c
            ends = [np.min(D), -np.max(D), s, -s]
            out[lane] = np.fmin(out[lane] * [1, -1, 1, -1], ends) * [1, -1, 1, -1]
        return out

    @property
    def tool_radius(self) -> float | None:
        """Distance from the contact within which markers are held by the tool, mm."""
        return self.reading.get("tool_radius")

    def __repr__(self) -> str:
        """One line: what was fitted to what."""
        free = ", ".join(p.name for p in self.problem.free) or "nothing"
        return (
            f"StoredFit({str(self.path)!r}: {free} fitted to {len(self.curves)} curves of "
            f"{len(self.specimens)} specimen(s))"
        )


def write(
    file: h5py.File, result: FitResult, files: Mapping[str, str], reading: Mapping[str, Any]
) -> None:
    """Add the groups `model` and `data` to results.h5.

    Args:
        file: open for writing.
        result: the fit.
        files: SHA-256 by file name.
        reading: the [data] section.
    """
    problem = result.problem
    place = {p.name: j for j, p in enumerate(problem.parameters)}
    unknowns = [[[place[p.name], *names] for p, *names in lane] for lane in problem.unknowns]
    group = file.create_group("model")
    _write_json(
        group,
        {
            "options": dataclasses.asdict(problem.options),
            "parameters": [dataclasses.asdict(p) for p in problem.parameters],
            "unknowns": unknowns,
            "lanes": [problem.lane_name(lane) for lane in range(result.lanes)],
            "loss": problem.loss,
            "loss_scale": problem.loss_scale,
            "noise_given": problem.noise_given,
            "joint": problem.joint,
            "reading": dict(reading),
            "units": {"length": "mm", "force": "N", "angle": "rad"},
        },
    )
    for name in _GEOMETRY:
        group.create_dataset(name, data=np.asarray(getattr(problem.geometry, name), np.float64))
    _write_data(file.create_group("data"), result, files)


def _write_data(group: h5py.Group, result: FitResult, files: Mapping[str, str]) -> None:
    """Every curve as it was used, with the model's answer at the estimate; samples end to end."""
    problem = result.problem
    placed = [(k, t, c) for k, lane in enumerate(problem.curves) for t, c in enumerate(lane)]
    curves = [c for _, _, c in placed]
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
    group["lane"] = np.array([k for k, _, _ in placed], np.int32)
    group["samples"] = np.array([len(c.force) for c in curves], np.int64)
    group["s_c"] = np.array([np.nan if c.s_c is None else c.s_c for c in curves])
    group["phi_c"] = np.array([c.phi_c for c in curves])
    seen = predictions(problem, result.theta)
    residual = [seen.force[k, t, : len(c.force)] for k, t, c in placed]
    columns = {
        "displacement": [c.displacement for c in curves],
        "force": [c.force for c in curves],
        "sigma": [np.full(len(c.force), np.nan) if c.sigma is None else c.sigma for c in curves],
        "residual": residual,
        "predicted": [c.force + r for c, r in zip(curves, residual, strict=True)],
    }
    if seen.joints is not None and problem.lanes.joints is not None:
        found = [seen.joints[k, t, : len(c.force)] for k, t, c in placed]
        columns["joint_residual"] = found
        columns["joints"] = [_on_rings(c, problem.geometry.rings) for c in curves]
    for name, parts in columns.items():
        group.create_dataset(name, data=np.concatenate(parts), compression="gzip")


def _on_rings(curve: Curve, rings: int) -> np.ndarray:
    """Marker displacements in the columns of their rings, NaN elsewhere; (N, rings)."""
    table = np.full((len(curve.force), rings), np.nan)
    if curve.joint_displacement is not None and curve.joint_rings is not None:
        table[:, curve.joint_rings] = curve.joint_displacement
    return table


def _short_source(source: str, names: Sequence[str]) -> str:
    """A source without the folders before the file's name."""
    found = next((name for name in names if name in source), None)
    return source.rpartition("/")[2] if found is None else source[source.index(found) :]


def _write_json(group: h5py.Group, content: object) -> None:
    data = np.frombuffer(json.dumps(content).encode(), np.uint8)
    group.create_dataset("description", data=data, compression="gzip")


def read_results(path: Path | str) -> StoredFit:
    """Read a finished fit for prediction.

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
    except (Fault, KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        if isinstance(error, NoResults):
            raise
        reason = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise NoResults(
            f"{path}: damaged or not written by this program ({reason}); fit again"
        ) from None


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
    if version == 1:
        raise NoResults(
            f"{path}: schema version 1 does not keep model, covariance and data; fit again with "
            "this version: jaxtrachea fit SPEC"
        )
    if version != VERSION:
        raise NoResults(
            f"{path}: schema version is {version}, this program reads {VERSION}; use the program "
            "that wrote it, or fit again"
        )


def _read(path: Path, file: Any) -> StoredFit:
    model = _json(file["model"])
    parameters = tuple(Parameter(**row) for row in model["parameters"])
    geometry = Geometry(**{name: numeric(file["model"], name) for name in _GEOMETRY})
    unknowns = tuple(
        tuple((parameters[j], specimen, trial) for j, specimen, trial in lane)
        for lane in model["unknowns"]
    )
    empty: dict[str, Any] = dict.fromkeys(Lane._fields, np.zeros((0, 0)))
    problem = Problem(
        geometry=jax.tree.map(lambda v: np.asarray(v, np.float64), geometry),
        options=Options(**model["options"]),
        parameters=parameters,
        lanes=Lane(**empty),
        curves=(),
        unknowns=unknowns,
        loss=model["loss"],
        loss_scale=model["loss_scale"],
        noise_given=(bool(model["noise_given"][0]), bool(model["noise_given"][1])),
        common="nothing",
        joint=bool(model["joint"]),
    )
    theta = numeric(file["unknowns"], "theta")
    blind = numeric(file["uncertainty"], "blind")
    curves, lane, files = _read_data(file["data"])
    stored = StoredFit(
        path=path,
        problem=problem,
        reading=model["reading"],
        lane_names=tuple((s, t) for s, t in model["lanes"]),
        theta=theta,
        covariance=numeric(file["uncertainty"], "covariance"),
        blind=blind * _relative(unknowns, theta)[:, None],
        at_bound=numeric(file["unknowns"], "at_bound") > 0,
        status=numeric(file["lanes"], "status").astype(int),
        sigma=numeric(file["lanes"], "sigma"),
        half_width=_known_half_width(problem, numeric(file["uncertainty"], "half_width")),
        curves=curves,
        curve_lane=lane,
        files=files,
    )
    _check_shapes(stored)
    return stored


def _known_half_width(problem: Problem, half: np.ndarray) -> np.ndarray:
    """Infinite where noise that should be estimated has no sample left to be estimated from.

    `uncertainty.analyse` puts the normal quantile there, which Student's t never reaches.
    """
    return np.where((half == NORMAL) & ~np.array(problem.noise_given[0]), np.inf, half)


def _json(group: Any) -> Any:
    """The JSON text of a group.

    Raises:
        ValueError: no such text.
    """
    return json.loads(numeric(group, "description").astype(np.uint8).tobytes().decode())


def _relative(unknowns, theta: np.ndarray) -> np.ndarray:
    """Change of each scaled coordinate that makes a relative change of 1; (L, P)."""
    unit = np.ones_like(theta)
    for k, lane in enumerate(unknowns):
        for i, (p, _, _) in enumerate(lane):
            if p.scale != "log":
                unit[k, i] = max(abs(theta[k, i]), 1e-3)
    return unit


def _read_data(group: Any) -> tuple[tuple[Curve, ...], np.ndarray, dict[str, str]]:
    """Curves without markers, the lane of each, and SHA-256 by file name."""
    names = _json(group)
    samples = numeric(group, "samples").astype(int)
    ends = np.cumsum(samples)
    column = {c: numeric(group, c) for c in ("displacement", "force", "sigma", "s_c", "phi_c")}
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
            )
        )
    return tuple(curves), numeric(group, "lane").astype(int), names["files"]


def _check_shapes(stored: StoredFit) -> None:
    """Refuse arrays that do not belong together.

    Raises:
        ValueError: naming the array.
    """
    L, P = len(stored.problem.unknowns), stored.theta.shape[-1]
    shapes = {
        "theta": (L, P), "covariance": (L, P, P), "blind": (L, P, P), "at_bound": (L, P),
        "status": (L,), "sigma": (L, 2), "half_width": (L,), "curve_lane": (len(stored.curves),),
    }  # fmt: skip
    for name, shape in shapes.items():
        if getattr(stored, name).shape != shape:
            raise ValueError(f"{name} has shape {getattr(stored, name).shape}, expected {shape}")
    known = {int(s) for s in FitStatus}
    if max(map(len, stored.problem.unknowns), default=0) > P or set(stored.status) - known:
        raise ValueError("unknowns or statuses that do not belong together")
    lanes = set(stored.curve_lane.tolist())
    if not stored.curves or not lanes <= set(range(L)):
        raise ValueError("curves that belong to no lane")
    if any(not len(c.force) or len(c.force) != len(c.displacement) for c in stored.curves):
        raise ValueError("curves without samples")
