"""A fit read back from its results.h5, with the journal of its run."""

import json
from pathlib import Path

import h5py
import numpy as np

from jaxtrachea.fit.covariance import Uncertainty
from jaxtrachea.fit.criteria import Criteria
from jaxtrachea.fit.result import FitResult
from jaxtrachea.fit.starts import of_unknowns
from jaxtrachea.fit.study import Study
from jaxtrachea.inference.results import MORE, SCHEMA, SCHEMA_VERSION
from jaxtrachea.runs import journal as journals
from jaxtrachea.runs.chunks import FIELDS, result_of
from jaxtrachea.runs.folder import NoRun
from jaxtrachea.status import FitStatus

#: Schema versions that are read; 1 has no covariance, which then follows from the standard errors.
VERSIONS = (1, SCHEMA_VERSION)


def read_hdf5(path: Path, study: Study) -> FitResult:
    """Read the fit back from results.h5, bit for bit.

    Args:
        path: written by `results.write_hdf5`.
        study: what was fitted.

    Raises:
        NoRun: the file is no such file, or of another study.
    """
    try:
        with h5py.File(path) as file:
            if file.attrs["schema"] != SCHEMA or file.attrs["schema_version"] not in VERSIONS:
                raise ValueError("another schema")
            found: dict[str, np.ndarray] = {}
            file.visititems(lambda name, item: _keep(found, name, item))
    except (OSError, KeyError, ValueError) as error:
        raise NoRun(f"{path} cannot be read back ({error})") from None
    try:
        if "uncertainty/covariance" not in found:
            found["uncertainty/covariance"] = _covariance(found)
        arrays = {name: found[_place(found, name)] for name in FIELDS}
        arrays |= {f"criteria.{name}": found[f"lanes/{name}"] for name in Criteria._fields}
        for name in Uncertainty._fields:
            place = f"uncertainty/{name}" if name in MORE else _place(found, name)
            arrays[f"uncertainty.{name}"] = found[place]
        arrays["status"] = arrays["status"].astype(int)
        return _same_steps(result_of(study, arrays))
    except (KeyError, ValueError) as error:
        raise NoRun(f"{path} is of another study or version ({error})") from None


def _same_steps(result: FitResult) -> FitResult:
    """The result, if its scaled coordinates mean its values.

    Raises:
        ValueError: they were written by a version that took other steps.
    """
    log = of_unknowns(result.study, lambda p: p.scale == "log", 0.0) > 0
    step = of_unknowns(result.study, lambda p: p.step, 1.0)
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
    """Of the estimates from standard errors and correlation; NaN along blind directions."""
    se = found["uncertainty/se"]
    with np.errstate(invalid="ignore"):
        product = found["unknowns/correlation"] * se[:, :, None] * se[:, None]
    held = np.isnan(se)
    return np.where(held[:, :, None] | held[:, None], 0.0, product)


def _place(found: dict[str, np.ndarray], name: str) -> str:
    """Where an array of the fit lies."""
    return f"lanes/{name}" if f"lanes/{name}" in found else f"unknowns/{name}"


def read_journal(path: Path) -> journals.Journal:
    """The journal of the run that wrote a results.h5.

    Raises:
        NoRun: there is none.
    """
    try:
        with h5py.File(path) as file:
            return journals.from_dict(json.loads(str(file.attrs["provenance"]))["run"])
    except (OSError, KeyError, ValueError) as error:
        raise NoRun(f"{path} tells nothing of its run ({error})") from None


def failed_lanes(result: FitResult) -> list[int]:
    """Lanes that the solver failed at: where other starts may help."""
    hopeless = (FitStatus.BAD_DATA, FitStatus.TOO_FEW_DATA)
    statuses = [FitStatus(int(status)) for status in result.status]
    return [k for k, s in enumerate(statuses) if not s.succeeded and s not in hopeless]
