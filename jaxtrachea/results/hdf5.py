"""results.h5: all numbers of a fit, as `read` reads them back bit for bit (docs/results.md)."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from jaxtrachea.files.atomic import hdf5_file
from jaxtrachea.files.table import Table
from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analysis import Analysis, AnalysisResults
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.results import store
from jaxtrachea.results.arrays import PLACES, arrays_of
from jaxtrachea.status import FitStatus

SCHEMA = "jaxtrachea-results"
VERSION = 6


def write_hdf5(
    path: Path,
    findings: AnalysisResults,
    provenance: dict,
    reading: Mapping[str, object] | None = None,
) -> None:
    """Write all numbers of a fit; the schema is described in docs/results.md.

    Args:
        findings: the fit, and what its analyses have found: a group each.
        provenance: stored as JSON in the root attribute of that name.
        reading: how the data were read (the [data] section), for `predict`.
    """
    result = findings.result
    with hdf5_file(path) as file:
        file.attrs["schema"], file.attrs["schema_version"] = SCHEMA, VERSION
        file.attrs["provenance"] = json.dumps(provenance)
        for name, data in arrays_of(result).items():
            if name in PLACES:
                packing = {} if PLACES[name].startswith("lanes/") else {"compression": "gzip"}
                file.create_dataset(PLACES[name], data=_small(name, data), **packing)
        _add_names(file["lanes"], result)
        _add_verdicts(file["unknowns"], result, findings.profiles)
        store.write(file, result, provenance.get("inputs", {}), reading or {})
        file["uncertainty/interval_growth"] = result.effective.growth
        for analysis, found in findings.found:
            if analysis.datasets:
                _write_analysis(file.create_group(analysis.name), analysis, found)


def _write_analysis(group: h5py.Group, analysis: Analysis, found: Any) -> None:
    """The arrays of what an analysis has found."""
    for name in analysis.datasets:
        data, meaning = getattr(found, name), analysis.meanings.get(name)
        if meaning is None:
            group.create_dataset(name, data=data, compression="gzip")
        else:
            codes = group.create_dataset(name, data=data.astype(np.int8))
            codes.attrs["meaning"] = json.dumps({int(e): e.message for e in meaning})
    for name in analysis.attributes:
        group.attrs[name] = getattr(found, name)


def _small(name: str, data: np.ndarray) -> np.ndarray:
    """Statuses as bytes."""
    return data.astype(np.int8) if name == "status" else data


def _add_names(group: h5py.Group, result: FitResult) -> None:
    """Names of the lanes, units, and what codes mean."""
    names = map(result.study.lane_name, range(result.lanes))
    Table({"specimen": s, "trial": t} for s, t in names).write_hdf5(group)
    group["status"].attrs["meaning"] = json.dumps({int(s): s.message for s in FitStatus})
    for name in ("sigma", "rms"):
        group[name].attrs["unit"] = "N, mm"
    group.create_dataset("force_share", data=result.force_share)


def _add_verdicts(group: h5py.Group, result: FitResult, profiles: Profiles | None) -> None:
    """Names of the unknowns, their verdicts and their intervals."""
    text, study = h5py.string_dtype(), result.study
    for field, pick in (("parameter", 0), ("specimen", 1), ("trial", 2)):
        cells = [[_cell(study.unknowns[lane], i, pick) for i in range(study.size)]
                 for lane in range(result.lanes)]  # fmt: skip
        group.create_dataset(field, data=cells, dtype=text)
    assessed = [[assess(result, k, i, profiles) for i in range(len(study.unknowns[k]))]
              for k in range(result.lanes)]  # fmt: skip
    words = [[j.verdict for j in row] + [""] * (study.size - len(row)) for row in assessed]
    for name in ("low", "high"):
        absent = [np.nan] * study.size
        ends = [([getattr(j, name) for j in row] + absent)[: study.size] for row in assessed]
        group.create_dataset(f"{name}95", data=ends, compression="gzip")
    group.create_dataset("verdict", data=words, dtype=text)
    group.attrs["units"] = json.dumps({p.name: p.unit for p in study.parameters})
    fixed = {p.name: p.value for p in study.parameters if p.fixed}
    group.attrs["fixed"] = json.dumps(fixed)


def _cell(unknowns, i: int, pick: int) -> str:
    if i >= len(unknowns):
        return ""
    return unknowns[i][0].name if pick == 0 else unknowns[i][pick]
