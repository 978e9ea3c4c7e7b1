"""A finished fit read back from its results.h5 (schema 3), so that it predicts by itself.

Through the audited door for files that nobody vouches for (`readers.safe_hdf5`).
"""

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.model import FitModel, columns_of, numbers_of
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.tested import depths
from jaxtrachea.measurements.curve import Fault
from jaxtrachea.measurements.read import Curve, DataError
from jaxtrachea.measurements.readers.hdf5_values import attribute, numeric
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.measurements.vectors import tilt_of
from jaxtrachea.mechanics.press import Options
from jaxtrachea.results.arrays import STORED_AS
from jaxtrachea.results.store import GEOMETRY
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

SCHEMA = "jaxtrachea-results"
VERSION = 3
#: Groups and datasets that are read; nothing else of the file is.
READ = (
    "/model", "/data", "/lanes/status", "/lanes/sigma", "/lanes/rms", "/lanes/force_share",
    "/unknowns/theta",
    "/unknowns/at_bound",
    "/uncertainty/covariance", "/uncertainty/silent", "/uncertainty/half_width",
    "/uncertainty/interval_growth",
)  # fmt: skip
#: 97.5 % quantile of the normal distribution, as `covariance.analyse` uses it.
NORMAL = 1.959963984540054


class NoResults(ValueError):
    """No finished results, or such that cannot predict; the message names the cure."""


@dataclasses.dataclass(frozen=True, eq=False)
class StoredFit:
    """A finished fit, read back. L lanes of up to P unknowns; scaled coordinates as in `Parameter`.

    Attributes:
        path: the file.
        study: geometry, options, parameters and unknowns; no data.
        reading: how the data were read, as in the [data] section.
        lane_names: specimen and trial of each lane, "(all)" where it spans several.
        theta: estimates; (L, P).
        covariance: of the estimates, of independent residuals; 0 for what is held, without the null
            space; (L, P, P).
        null_space: rows: directions that change no residual, scaled coordinates; (L, P, P).
        at_bound: (L, P).
        status: `FitStatus`; (L,).
        sigma: standard deviation of force, N, and markers, mm, given or estimated; NaN without
            samples of the kind; (L, 2).
        force_share: share of the force that its noise has beside `sigma`, see `Noise`; (L,).
        half_width: of a 95 % interval in standard errors; inf where the noise could not be
            estimated; (L,).
        growth: of intervals for correlated residuals, inf where the model misses the curves, see
            `Effective`; (L,).
        curves: the data as used; `source` is the file's name and the place in it.
        curve_lane: lane of each curve; (curves,).
        blend: rounded corner at the onset of each curve, mm, see `Lane`; NaN where no onset was
            fitted; (curves,).
        files: SHA-256 by file name.
    """

    path: Path
    study: Study
    reading: Mapping[str, Any]
    lane_names: tuple[tuple[str, str], ...]
    theta: np.ndarray
    covariance: np.ndarray
    null_space: np.ndarray
    at_bound: np.ndarray
    status: np.ndarray
    sigma: np.ndarray
    force_share: np.ndarray
    half_width: np.ndarray
    growth: np.ndarray
    curves: tuple[Curve, ...]
    curve_lane: np.ndarray
    blend: np.ndarray
    files: Mapping[str, str]

    @property
    def specimens(self) -> tuple[str, ...]:
        """Names of the fitted specimens, in the order of the data."""
        return tuple(dict.fromkeys(c.specimen for c in self.curves))

    @functools.cached_property
    def first_touch(self) -> np.ndarray:
        """Displacement of each curve at first touch, mm: held, or estimated; (curves,)."""
        return self._of_curves("onset")

    @functools.cached_property
    def _places(self) -> dict[tuple[str, str], int]:
        return {(c.specimen, c.trial): i for i, c in enumerate(self.curves)}

    @functools.cached_property
    def force_offset(self) -> np.ndarray:
        """Force that each curve shows without contact, N: held, or estimated; (curves,)."""
        return self._of_curves("force_offset")

    def _of_curves(self, name: str) -> np.ndarray:
        """A parameter as each curve has it: held, or estimated; (curves,)."""
        named = next(p for p in self.study.parameters if p.name == name)
        if named.fixed:
            return np.full(len(self.curves), named.value)
        places = [
            {(s, t): i for i, (p, s, t) in enumerate(lane) if p.name == name}
            for lane in self.study.unknowns
        ]

        def value(curve: Curve, lane: int) -> float:
            specimen = "" if named.scope == "shared" else curve.specimen
            i = places[lane].get((specimen, curve.trial if named.scope == "trial" else ""))
            held = named.value if named.auto else np.nan
            return held if i is None else named.from_scaled(float(self.theta[lane, i]))

        rows = zip(self.curves, self.curve_lane.tolist(), strict=True)
        return np.array([value(*row) for row in rows])

    @functools.cached_property
    def found(self) -> dict[int, Any]:
        """What predictions have found out of lanes, kept for the next."""
        return {}

    def above_touch(self, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
        """Depth of a curve of the fit from first touch, mm, and its force without offset, N."""
        i = self._places[curve.specimen, curve.trial]
        depth = depths(curve.displacement, self.first_touch[i], self.study.model.options)
        return depth, np.asarray(curve.force) - self.force_offset[i]

    @functools.cached_property
    def spans(self) -> np.ndarray:
        """Range of depth from first touch and of contact position of each lane, mm; (L, 4)."""
        out = np.tile([np.inf, -np.inf] * 2, (len(self.status), 1))
        options = self.study.model.options
        rows = zip(self.curves, self.curve_lane, self.first_touch.tolist(), strict=True)
        for curve, lane, touch in rows:
            D = depths(curve.displacement, touch, options)
            s = np.nan if curve.s_c is None else curve.s_c
            ends = [np.min(D), -np.max(D), s, -s]
            out[lane] = np.fmin(out[lane] * [1, -1, 1, -1], ends) * [1, -1, 1, -1]
        return out

    @functools.cached_property
    def angles(self) -> np.ndarray:
        """Range of contact angle of the data of each lane, rad; (L, 2)."""
        return self._range([c.phi_c for c in self.curves])

    @functools.cached_property
    def tilts(self) -> np.ndarray:
        """Range of the tool's angle to the normal of the data of each lane, rad; (L, 2)."""
        return self._range([tilt_of(c.direction) for c in self.curves])

    def _range(self, values: list[float]) -> np.ndarray:
        """Least and largest of the values of the curves of each lane; (L, 2)."""
        out = np.tile([np.inf, -np.inf], (len(self.status), 1))
        for value, lane in zip(values, self.curve_lane, strict=True):
            out[lane] = min(out[lane][0], value), max(out[lane][1], value)
        return out

    @property
    def tool_radius(self) -> float | None:
        """Distance from the contact within which markers are held by the tool, mm."""
        return self.reading.get("tool_radius")

    def __repr__(self) -> str:
        """One line: what was fitted to what."""
        free = ", ".join(p.name for p in self.study.free) or "nothing"
        return (
            f"StoredFit({str(self.path)!r}: {free} fitted to {len(self.curves)} curves of "
            f"{len(self.specimens)} specimen(s))"
        )


def from_result(result: FitResult) -> StoredFit:
    """A fit of this process as one that was read back: what predictions need."""
    study, u = result.study, result.uncertainty
    placed = [(k, t, c) for k, lane in enumerate(study.curves) for t, c in enumerate(lane)]
    blend = study.lanes.blend
    return StoredFit(
        path=Path(),
        study=study,
        reading={},
        lane_names=tuple(study.lane_name(lane) for lane in range(result.lanes)),
        theta=result.theta,
        covariance=u.covariance,
        null_space=u.null_space,
        at_bound=result.at_bound,
        status=result.status,
        sigma=np.where(np.isnan(result.rms), np.nan, result.sigma),
        force_share=result.force_share,
        half_width=_known_half_width(study, u.half_width),
        growth=result.effective.growth,
        curves=tuple(c for _, _, c in placed),
        curve_lane=np.array([k for k, _, _ in placed]),
        blend=np.array([np.nan if blend is None else blend[k, t] for k, t, _ in placed]),
        files={},
    )


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
    if version in (1, 2):
        lost = "model, covariance and data" if version == 1 else "what correlated residuals cost"
        raise NoResults(
            f"{path}: schema version {version} does not keep {lost}; fit again with "
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
    geometry = Geometry(**{name: numeric(file["model"], name) for name in GEOMETRY})
    unknowns = tuple(
        tuple((parameters[j], specimen, trial) for j, specimen, trial in lane)
        for lane in model["unknowns"]
    )
    empty: dict[str, Any] = dict.fromkeys(Lane._fields, np.zeros((0, 0)))
    study = Study(
        model=FitModel(
            tube=numbers_of(geometry),
            options=Options(**model["options"]),
            columns=columns_of(parameters),
            loss=model["loss"],
            loss_scale=float(model["loss_scale"]),
        ),
        parameters=parameters,
        lanes=Lane(**empty),
        curves=(),
        unknowns=unknowns,
        noise_given=(bool(model["noise_given"][0]), bool(model["noise_given"][1])),
        marker_noise=_marker_noise(model.get("marker_noise")),
        joint=bool(model["joint"]),
        balance="sample" if model.get("balance") == "sample" else "curve",  # before: not stored
    )
    theta = numeric(file["unknowns"], "theta")
    curves, lane, files = _read_data(file["data"])
    stored = StoredFit(
        path=path,
        study=study,
        reading=model["reading"],
        lane_names=tuple((s, t) for s, t in model["lanes"]),
        theta=theta,
        covariance=numeric(file["uncertainty"], "covariance"),
        null_space=numeric(file["uncertainty"], STORED_AS["null_space"]),
        at_bound=numeric(file["unknowns"], "at_bound") > 0,
        status=numeric(file["lanes"], "status").astype(int),
        sigma=_sigma(file["lanes"]),
        force_share=_force_share(file["lanes"]),
        half_width=_known_half_width(study, numeric(file["uncertainty"], "half_width")),
        growth=numeric(file["uncertainty"], "interval_growth"),
        curves=curves,
        curve_lane=lane,
        blend=numeric(file["data"], "blend"),
        files=files,
    )
    _check_shapes(stored)
    return stored


def _marker_noise(found: Any) -> tuple[float, float] | None:
    """As `Study.marker_noise`; files of before had none, and no share."""
    if found is None:
        return None
    joints, share = found
    return float(joints), float(share)


def _known_half_width(study: Study, half: np.ndarray) -> np.ndarray:
    """The half width; infinite where noise is to be estimated and no sample is left to do it from.

    `covariance.analyse` puts the normal quantile there, which Student's t never reaches.
    """
    return np.where((half == NORMAL) & ~np.array(study.noise_given[0]), np.inf, half)


def _sigma(lanes: Any) -> np.ndarray:
    """Noise of each kind; NaN where a lane has no samples of it (a fit without markers, say)."""
    sigma = numeric(lanes, "sigma")
    rms = numeric(lanes, "rms")
    return np.where(np.isnan(rms), np.nan, sigma) if rms.shape == sigma.shape else sigma


def _force_share(lanes: Any) -> np.ndarray:
    """As `FitResult.force_share`; files of before had none."""
    if "force_share" in lanes:
        return numeric(lanes, "force_share")
    return np.zeros(len(numeric(lanes, "status")))


def _json(group: Any) -> Any:
    """The JSON text of a group.

    Raises:
        ValueError: no such text.
    """
    return json.loads(numeric(group, "description").astype(np.uint8).tobytes().decode())


def _read_data(group: Any) -> tuple[tuple[Curve, ...], np.ndarray, dict[str, str]]:
    """Curves with what of them the fit has used, the lane of each, and SHA-256 by file name."""
    names = _json(group)
    samples = numeric(group, "samples").astype(int)
    ends = np.cumsum(samples)
    column = {c: numeric(group, c) for c in ("displacement", "force", "sigma", "s_c", "phi_c")}
    known = "direction" in group
    direction = numeric(group, "direction") if known else np.tile([1.0, 0.0], (len(samples), 1))
    observed = _observed(group)
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
                **{name: v if v.ndim == 1 else v[part] for name, v in observed.items()},
            )
        )
    return tuple(curves), numeric(group, "lane").astype(int), names["files"]


def _observed(group: Any) -> dict[str, Any]:
    """Fields of curves beside the force, samples end to end; NaN where the fit has not used them.

    Rings are numbered, with no axis of samples.
    """
    out: dict[str, Any] = {}
    if "joints" in group:
        used = np.isfinite(numeric(group, "joint_residual"))
        out["joint_displacement"] = np.where(used, numeric(group, "joints"), np.nan)
    if "side_force" in group:
        out["side_force"] = numeric(group, "side_force")
    if "joint_side" in group:
        out["joint_side_displacement"] = numeric(group, "joint_side")
        out.setdefault("joint_displacement", np.full_like(out["joint_side_displacement"], np.nan))
    if "joint_displacement" in out:
        out["joint_rings"] = np.arange(out["joint_displacement"].shape[1])
    if "ends" in group:
        ends = numeric(group, "ends")
        out["end_U"], out["end_V"] = ends[:, :, 0], ends[:, :, 1]
        out["end_rings"] = np.arange(ends.shape[1])
    return out


def _check_shapes(stored: StoredFit) -> None:
    """Refuse arrays that do not belong together.

    Raises:
        ValueError: naming the array.
    """
    L, P = len(stored.study.unknowns), stored.theta.shape[-1]
    shapes = {
        "theta": (L, P), "covariance": (L, P, P), "null_space": (L, P, P), "at_bound": (L, P),
        "status": (L,), "sigma": (L, 2), "force_share": (L,), "half_width": (L,),
        "growth": (L,), "curve_lane": (len(stored.curves),), "blend": (len(stored.curves),),
    }  # fmt: skip
    for name, shape in shapes.items():
        if getattr(stored, name).shape != shape:
            raise ValueError(f"{name} has shape {getattr(stored, name).shape}, expected {shape}")
    known = {int(s) for s in FitStatus}
    if max(map(len, stored.study.unknowns), default=0) > P or set(stored.status) - known:
        raise ValueError("unknowns or statuses that do not belong together")
    lanes = set(stored.curve_lane.tolist())
    if not stored.curves or not lanes <= set(range(L)):
        raise ValueError("curves that belong to no lane")
    if any(not len(c.force) or len(c.force) != len(c.displacement) for c in stored.curves):
        raise ValueError("curves without samples")
