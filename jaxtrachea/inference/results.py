"""What a fit found, as rows and files: HDF5, CSV, provenance (docs/results.md)."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from jaxtrachea.files.atomic import hdf5_file
from jaxtrachea.files.tables import write_csv as write_csv
from jaxtrachea.fit.evaluate import NOTHING_FITTED
from jaxtrachea.fit.parameters import OF_THE_PRESS
from jaxtrachea.fit.press_scale import sizes_of_press
from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference import store
from jaxtrachea.inference.bootstrap import Bootstrap
from jaxtrachea.inference.judgement import judgement, verdict_of
from jaxtrachea.inference.population import Population
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.rows import row_places, samples_of, trials_of
from jaxtrachea.inference.verdict import VERDICTS, describe_flat
from jaxtrachea.measurements.read import BadCurve
from jaxtrachea.measurements.usage_tables import lane_cells
from jaxtrachea.status import FitStatus, ProfileEnd

SCHEMA = "jaxtrachea-results"
SCHEMA_VERSION = 2
#: Fields of `Uncertainty` in the group of that name; the others stand with lanes and unknowns.
MORE = ("se", "flat_se", "blind", "half_width", "along", "dispersion", "covariance", "silent")


def unknown_label(result: FitResult, lane: int, i: int) -> str:
    """Name of an unknown: k_M, or onset[t03], or k_M[T01] where a lane holds several of them."""
    unknowns = result.study.unknowns[lane]
    p, specimen, trial = unknowns[i]
    same = [u for u in unknowns if u[0].name == p.name]
    if len(same) == 1:
        return p.name
    several = len({u[1] for u in same}) > 1
    where = "/".join(filter(None, (specimen if several else "", trial)))
    return f"{p.name}[{where}]"


def lane_label(result: FitResult, lane: int) -> str:
    """Specimen of a lane, and its trial if it holds a single one."""
    specimen, trial = result.study.lane_name(lane)
    return specimen if trial == "(all)" else f"{specimen} {trial}"


def succeeded(result: FitResult, lane: int) -> bool:
    """Whether a lane has an estimate."""
    return bool(result.succeeded[lane])


def peak_force(result: FitResult, lane: int) -> float:
    """Largest measured force of a lane, N."""
    return max(float(np.max(np.abs(c.force))) for c in result.study.curves[lane])


def flat_sentence(result: FitResult, lane: int) -> str:
    """The least determined combination of a lane in words."""
    if not succeeded(result, lane):
        return "no estimate"
    if not result.study.free:
        return NOTHING_FITTED
    names = [unknown_label(result, lane, i) for i in range(len(result.study.unknowns[lane]))]
    u = result.uncertainty
    return describe_flat(
        names, u.flat[lane], float(u.flat_se[lane]), u.blind[lane], result.undetermined[lane],
        press_sizes(result, lane),
    )  # fmt: skip


def press_sizes(result: FitResult, lane: int) -> dict[int, tuple[float, str]]:
    """Size of the press in the unit of each onset and offset of a lane, by place of the unknown."""
    unknowns = result.study.unknowns[lane]
    places = [i for i, (p, _, _) in enumerate(unknowns) if p.name in OF_THE_PRESS]
    places = [i for i in places if unknowns[i][0].scale == "linear"]
    if not places:
        return {}
    sizes = sizes_of_press(result.study.take(np.array([lane])))[0]
    found = {i: (float(sizes[i]) * unknowns[i][0].step, unknowns[i][0].unit) for i in places}
    return {i: v for i, v in found.items() if np.isfinite(v[0])}


def verdict_sentence(result: FitResult, lane: int, profiles: Profiles | None = None) -> str:
    """Which unknowns of a lane have which verdict, and what is least determined."""
    if not succeeded(result, lane):
        return "no estimate"
    if not result.study.free:
        return NOTHING_FITTED
    groups: dict[str, list[str]] = {}
    for i in range(len(result.study.unknowns[lane])):
        word = verdict_of(result, lane, i, profiles)
        groups.setdefault(word, []).append(unknown_label(result, lane, i))
    said = [f"{word}: {', '.join(groups[word])}" for word in VERDICTS if word in groups]
    said.append(flat_sentence(result, lane))
    if result.study.joint and result.unexamined[lane].any():
        said.append("not shown: only the local error was looked at; --profile looks further")
    if result.minima[lane] > 1:
        said.append("fits that end elsewhere are as good within the noise")
    return "; ".join(said)


def lane_rows(result: FitResult, profiles: Profiles | None = None) -> Iterator[dict[str, object]]:
    """Rows of summary.csv, see `row_places`.

    What a specimen has several of (unknowns of single trials) is left to parameters.csv, and named
    in the column `more`. Of a lane of several specimens, everything but the unknowns, `samples` and
    `rms_over_peak`'s peak is that of the lane.
    """
    for lane, one in row_places(result):
        status = FitStatus(int(result.status[lane]))
        trials = trials_of(result, lane, one)
        curves = [result.study.curves[lane][t] for t in trials]
        peak = max(float(np.max(np.abs(c.force))) for c in curves)
        specimen, trial = result.study.lane_name(lane)
        if one:
            specimen, trial = one, curves[0].trial if len(curves) == 1 else "(all)"
        row: dict[str, object] = {
            "specimen": specimen,
            "trial": trial,
            "status": status.name.lower(),
            "message": status.message if result.study.free else NOTHING_FITTED,
            "iterations": int(result.iterations[lane]),
            "starts_agreeing": int(result.converged_starts[lane]),
            "starts": int(result.tried[lane]),
            "samples": samples_of(result, lane, trials) if one else int(result.samples[lane]),
            **lane_cells(curves),
            "cost": float(result.cost[lane]),
            "rms_force_N": float(result.rms[lane, 0]),
            "rms_over_peak": float(result.rms[lane, 0]) / peak if peak > 0 else float("nan"),
            "sigma_force_N": float(result.sigma[lane, 0]),
            "rms_joints_mm": float(result.rms[lane, 1]),
            "condition": float(result.uncertainty.condition[lane]),
            "unknowns": int(result.criteria.unknowns[lane]),
            "AIC": float(result.criteria.AIC[lane]),
            "AICc": float(result.criteria.AICc[lane]),
            "BIC": float(result.criteria.BIC[lane]),
        }
        yield row | _unknown_cells(result, lane, one, profiles)


def _unknown_cells(
    result: FitResult, lane: int, specimen: str, profiles: Profiles | None
) -> dict[str, object]:
    """What a row of summary.csv says of the unknowns of its specimen."""
    unknowns = result.study.unknowns[lane]
    own = [i for i, u in enumerate(unknowns) if not specimen or u[1] in ("", specimen)]
    cells: dict[str, object] = {}
    more = []
    for i in own:
        p = unknowns[i][0]
        if sum(unknowns[k][0].name == p.name for k in own) > 1:
            more.append(unknown_label(result, lane, i))
            continue
        judged = judgement(result, lane, i, profiles)
        cells |= {
            f"{p.name} [{p.unit}]": float(result.value[lane, i]),
            f"{p.name} se": float(result.standard_error[lane, i]),
            f"{p.name} low95": judged.low,
            f"{p.name} high95": judged.high,
            f"{p.name} verdict": judged.verdict,
        }
    said = f"{', '.join(more)}: see parameters.csv" if more else ""
    return cells | ({"more": said} if more else {})


def bad_row(bad: BadCurve) -> dict[str, object]:
    """Row of summary.csv for a curve that could not be used."""
    return {
        "specimen": bad.specimen,
        "trial": bad.trial,
        "status": FitStatus.BAD_DATA.name.lower(),
        "message": bad.reason,
    }


def is_own(result: FitResult, lane: int, i: int) -> bool:
    """Whether an unknown belongs to its lane alone, not to all lanes of a joint fit."""
    return not (result.study.joint and result.study.unknowns[lane][i][0].scope == "shared")


def said_before(result: FitResult, lanes: Sequence[int], lane: int, i: int) -> bool:
    """Whether an unknown that all lanes share is listed with another of `lanes`, the first good."""
    first = next((k for k in lanes if succeeded(result, k)), lanes[0])
    return not is_own(result, lane, i) and lane != first


def parameter_rows(
    result: FitResult,
    profiles: Profiles | None = None,
    resampled: Bootstrap | None = None,
    population: Population | None = None,
) -> Iterator[dict[str, object]]:
    """One row per lane and unknown for parameters.csv; more columns where there is more to say.

    What the lanes of a joint fit share has one row, that of the first lane which succeeded.
    """
    every = range(result.lanes)
    for lane in range(result.lanes):
        lane_specimen, _ = result.study.lane_name(lane)
        for i, (p, specimen, trial) in enumerate(result.study.unknowns[lane]):
            if said_before(result, every, lane, i):
                continue
            judged = judgement(result, lane, i, profiles)
            row = {
                "specimen": (specimen or lane_specimen) if is_own(result, lane, i) else "(all)",
                "trial": trial or "(all)",
                "parameter": p.name,
                "unit": p.unit,
                "value": float(result.value[lane, i]),
                "se": float(result.standard_error[lane, i]),
                "low95": judged.low,
                "high95": judged.high,
                "relative_se": float(result.relative_se[lane, i]),
                "verdict": judged.verdict,
            }
            row |= _profile_cells(profiles, lane, i) | _bootstrap_cells(resampled, lane, i)
            yield row if population is None else row | population.shrunk_cells(lane, i)


def _profile_cells(profiles: Profiles | None, lane: int, i: int) -> dict[str, object]:
    """Interval by profile likelihood, and how it ends."""
    k = None if profiles is None else profiles.find(lane, i)
    if profiles is None or k is None:
        return {}
    low, high = (ProfileEnd(int(v)).name.lower() for v in profiles.end[k])
    return {
        "profile_low95": float(profiles.lower[k]),
        "profile_high95": float(profiles.upper[k]),
        "profile_low_end": low,
        "profile_high_end": high,
    }


def _bootstrap_cells(resampled: Bootstrap | None, lane: int, i: int) -> dict[str, object]:
    """Standard error and percentile interval of the replicates."""
    if resampled is None:
        return {}
    return {
        "bootstrap_se": float(resampled.standard_error[lane, i]),
        "bootstrap_low95": float(resampled.lower[lane, i]),
        "bootstrap_high95": float(resampled.upper[lane, i]),
    }


def profile_rows(profiles: Profiles) -> Iterator[dict[str, object]]:
    """One row per point of each profile for profiles.csv."""
    result = profiles.result
    for k, (lane, i) in enumerate(profiles.pairs):
        lane_specimen, _ = result.study.lane_name(lane)
        p, specimen, trial = result.study.unknowns[lane][i]
        for theta, statistic in zip(profiles.coordinate[k], profiles.statistic[k], strict=True):
            yield {
                "specimen": specimen or lane_specimen,
                "trial": trial or "(all)",
                "parameter": p.name,
                "unit": p.unit,
                "at": p.from_scaled(float(theta)),
                "statistic": float(statistic),
                "threshold": float(profiles.threshold[k]),
            }


def write_hdf5(
    path: Path,
    result: FitResult,
    provenance: dict,
    profiles: Profiles | None = None,
    resampled: Bootstrap | None = None,
    reading: Mapping[str, object] | None = None,
) -> None:
    """Write all numbers of a fit; the schema is described in docs/results.md.

    Args:
        path: new file.
        result: the fit.
        provenance: stored as JSON in the root attribute of that name.
        profiles: makes the group `profiles`.
        resampled: makes the group `bootstrap`.
        reading: how the data were read (the [data] section), for `predict`.
    """
    with hdf5_file(path) as file:
        file.attrs["schema"], file.attrs["schema_version"] = SCHEMA, SCHEMA_VERSION
        file.attrs["provenance"] = json.dumps(provenance)
        _write_lanes(file.create_group("lanes"), result)
        _write_unknowns(file.create_group("unknowns"), result, profiles)
        store.write(file, result, provenance.get("inputs", {}), reading or {})
        group = file.create_group("uncertainty")
        for name in MORE:
            data = getattr(result.uncertainty, name)
            group.create_dataset(name, data=data, compression="gzip")
        if profiles is not None:
            _write_profiles(file.create_group("profiles"), profiles)
        if resampled is not None:
            group = file.create_group("bootstrap")
            group.attrs["kind"], group.attrs["block"] = resampled.kind, resampled.block
            for name in ("theta", "usable", "lower", "upper", "standard_error"):
                group.create_dataset(name, data=getattr(resampled, name), compression="gzip")


def _write_profiles(group: h5py.Group, profiles: Profiles) -> None:
    for name in ("lane", "unknown", "lower", "upper", "threshold", "theta", "statistic"):
        group.create_dataset(name, data=getattr(profiles, name))
    codes = group.create_dataset("end", data=profiles.end.astype(np.int8))
    codes.attrs["meaning"] = json.dumps({int(e): e.message for e in ProfileEnd})


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
    arrays |= {name: getattr(result.uncertainty, name) for name in ("correlation", "flat")}
    for name, data in arrays.items():
        group.create_dataset(name, data=data, compression="gzip")
    group.attrs["units"] = json.dumps({p.name: p.unit for p in study.parameters})
    fixed = {p.name: p.value for p in study.parameters if p.fixed}
    group.attrs["fixed"] = json.dumps(fixed)


def _cell(unknowns, i: int, pick: int) -> str:
    if i >= len(unknowns):
        return ""
    return unknowns[i][0].name if pick == 0 else unknowns[i][pick]
