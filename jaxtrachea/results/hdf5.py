"""results.h5: all numbers of a fit, written and read back bit for bit (docs/results.md)."""

import json
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from jaxtrachea.files.atomic import hdf5_file
from jaxtrachea.fitting.covariance import Uncertainty
from jaxtrachea.fitting.criteria import Criteria
from jaxtrachea.fitting.result import FitResult, judgement
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analysis import Findings
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.results import store
from jaxtrachea.results.arrays import FIELDS, STORED_AS, result_of
from jaxtrachea.results.stored import SCHEMA, VERSION, NoResults
from jaxtrachea.status import FitStatus

#: Schema versions that are read; 1 has no covariance, which then follows from the standard errors.
VERSIONS = (1, 2, VERSION)
#: Fields of `Uncertainty` in the group of that name; the others stand with lanes and unknowns.
MORE = (
    "se", "weakest_se", "structural_null_space", "half_width", "conditional_direction",
    "dispersion", "covariance", "null_space",
)  # fmt: skip


def write_hdf5(
    path: Path,
    findings: Findings,
    provenance: dict,
    reading: Mapping[str, object] | None = None,
) -> None:
    """Write all numbers of a fit; the schema is described in docs/results.md.

    Args:
        path: new file.
        findings: the fit, and what its analyses have found: a group each.
        provenance: stored as JSON in the root attribute of that name.
        reading: how the data were read (the [data] section), for `predict`.
    """
    result = findings.result
    with hdf5_file(path) as file:
        file.attrs["schema"], file.attrs["schema_version"] = SCHEMA, VERSION
        file.attrs["provenance"] = json.dumps(provenance)
        _write_lanes(file.create_group("lanes"), result)
        _write_unknowns(file.create_group("unknowns"), result, findings.profiles)
        store.write(file, result, provenance.get("inputs", {}), reading or {})
        group = file.create_group("uncertainty")
        for name in MORE:
            data = getattr(result.uncertainty, name)
            group.create_dataset(STORED_AS.get(name, name), data=data, compression="gzip")
        group["interval_growth"] = result.effective.growth
        for analysis, found in findings.found:
            if analysis.datasets is not None:
                analysis.datasets(file.create_group(analysis.name), found)


def _write_lanes(group: h5py.Group, result: FitResult) -> None:
    text = h5py.string_dtype()
    names = [result.study.lane_name(lane) for lane in range(result.lanes)]
    group.create_dataset("specimen", data=[n[0] for n in names], dtype=text)
    group.create_dataset("trial", data=[n[1] for n in names], dtype=text)
    codes = group.create_dataset("status", data=result.status.astype(np.int8))
    codes.attrs["meaning"] = json.dumps({int(s): s.message for s in FitStatus})
    for name in ("iterations", "cost", "converged_starts", "tried", "samples", "minima"):
        group.create_dataset(name, data=getattr(result, name))
    for name in ("unknowns", "deviance", "AIC", "AICc", "BIC"):
        group.create_dataset(name, data=getattr(result.criteria, name))
    for name in ("sigma", "rms"):
        group.create_dataset(name, data=getattr(result, name)).attrs["unit"] = "N, mm"
    group.create_dataset("force_share", data=result.force_share)
    group.create_dataset("condition", data=result.uncertainty.condition)


def _write_unknowns(group: h5py.Group, result: FitResult, profiles: Profiles | None = None) -> None:
    text, study = h5py.string_dtype(), result.study
    for field, pick in (("parameter", 0), ("specimen", 1), ("trial", 2)):
        cells = [[_cell(study.unknowns[lane], i, pick) for i in range(study.size)]
                 for lane in range(result.lanes)]  # fmt: skip
        group.create_dataset(field, data=cells, dtype=text)
    judged = [[judgement(result, k, i, profiles) for i in range(len(study.unknowns[k]))]
              for k in range(result.lanes)]  # fmt: skip
    words = [[j.verdict for j in row] + [""] * (study.size - len(row)) for row in judged]
    for name in ("low", "high"):
        absent = [np.nan] * study.size
        ends = [([getattr(j, name) for j in row] + absent)[: study.size] for row in judged]
        group.create_dataset(f"{name}95", data=ends, compression="gzip")
    group.create_dataset("verdict", data=words, dtype=text)
    arrays = {
        name: getattr(result, name)
        for name in ("value", "standard_error", "lower", "upper", "relative_se", "theta",
                     "at_bound", "undetermined", "unexamined", "evidence_low", "evidence_high",
                     "evidence_end")
    }  # fmt: skip
    arrays |= {
        name: getattr(result.uncertainty, name) for name in ("correlation", "weakest_direction")
    }
    for name, data in arrays.items():
        group.create_dataset(STORED_AS.get(name, name), data=data, compression="gzip")
    group.attrs["units"] = json.dumps({p.name: p.unit for p in study.parameters})
    fixed = {p.name: p.value for p in study.parameters if p.fixed}
    group.attrs["fixed"] = json.dumps(fixed)


def _cell(unknowns, i: int, pick: int) -> str:
    if i >= len(unknowns):
        return ""
    return unknowns[i][0].name if pick == 0 else unknowns[i][pick]


def read_hdf5(path: Path, study: Study) -> FitResult:
    """Read the fit back from results.h5, bit for bit.

    Args:
        path: written by `write_hdf5`.
        study: what was fitted.

    Raises:
        NoResults: the file is no such file, or of another study.
    """
    try:
        with h5py.File(path) as file:
            if file.attrs["schema"] != SCHEMA or file.attrs["schema_version"] not in VERSIONS:
                raise ValueError("another schema")
            found: dict[str, np.ndarray] = {}
            file.visititems(lambda name, item: _keep(found, name, item))
    except (OSError, KeyError, ValueError) as error:
        raise NoResults(f"{path} cannot be read back ({error})") from None
    try:
        if "uncertainty/covariance" not in found:
            found["uncertainty/covariance"] = _covariance(found)
        arrays = {name: found[_place(found, name)] for name in FIELDS}
        arrays |= {f"criteria.{name}": found[f"lanes/{name}"] for name in Criteria._fields}
        for name in Uncertainty._fields:
            key = STORED_AS.get(name, name)
            place = f"uncertainty/{key}" if name in MORE else _place(found, key)
            arrays[f"uncertainty.{key}"] = found[place]
        arrays["status"] = arrays["status"].astype(int)
        return _same_steps(result_of(study, arrays))
    except (KeyError, ValueError) as error:
        raise NoResults(f"{path} is of another study or version ({error})") from None


def _same_steps(result: FitResult) -> FitResult:
    """The result, if its scaled coordinates mean its values.

    Raises:
        ValueError: they were written by a version that took other steps.
    """
    log = result.study.of_unknowns(lambda p: p.scale == "log", False)
    step = result.study.of_unknowns(lambda p: p.step, 1.0)
    meant = np.where(log, np.exp(np.where(log, result.theta, 0.0)), result.theta * step)
    known = np.isfinite(meant) & np.isfinite(result.value) & (result.study.lanes.active > 0)
    known &= result.succeeded[:, None]
    if not np.allclose(meant[known], result.value[known], rtol=1e-9, atol=0):
        raise ValueError("its scaled coordinates have other steps; fit again")
    return result


def _keep(found: dict[str, np.ndarray], name: str, item: object) -> None:
    if isinstance(item, h5py.Dataset):
        found[name] = item[()]


def _covariance(found: dict[str, np.ndarray]) -> np.ndarray:
    """Of the estimates from standard errors and correlation; NaN along the null space."""
    se = found["uncertainty/se"]
    with np.errstate(invalid="ignore"):
        product = found["unknowns/correlation"] * se[:, :, None] * se[:, None]
    held = np.isnan(se)
    return np.where(held[:, :, None] | held[:, None], 0.0, product)


def _place(found: dict[str, np.ndarray], name: str) -> str:
    """Where an array of the fit lies."""
    return f"lanes/{name}" if f"lanes/{name}" in found else f"unknowns/{name}"
