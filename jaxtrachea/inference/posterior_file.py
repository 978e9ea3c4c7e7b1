"""Posterior draws as a netCDF-4 file that ArviZ and xarray read: posterior.nc."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.files.atomic import hdf5_file
from jaxtrachea.fitting.assessment import unknown_label
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.posterior import Posterior


def write_posterior(posterior: Posterior, path: Path) -> None:
    """Write the draws; `arviz.from_netcdf` reads them.

    Group `posterior` has a variable for each unknown, in its unit, NaN where a specimen has no such
    unknown; `sample_stats` has `diverging`. Dimensions: chain, draw, specimen.

    Raises:
        OSError: the file cannot be written.
    """
    result, shape = posterior.result, posterior.theta.shape[:3]
    draws: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    for lane, unknowns in enumerate(result.study.unknowns):
        for i, (p, _, _) in enumerate(unknowns):
            name = unknown_label(result, lane, i)
            values = draws.setdefault(name, np.full(shape, np.nan))
            values[lane] = p.from_scaled(posterior.theta[lane, ..., i])
            units[name] = p.unit
    names = [lane_label(result, lane) for lane in range(result.lanes)]
    with hdf5_file(path) as file:
        group = _group(file, "posterior", shape, names)
        for name, values in draws.items():
            _add(group, name, np.moveaxis(values, 0, -1)).attrs["units"] = units[name]
        diverging = np.moveaxis(posterior.divergent, 0, -1).astype(np.int8)
        stats = _group(file, "sample_stats", shape, names)
        _add(stats, "diverging", diverging).attrs["dtype"] = "bool"


def _group(file: Any, name: str, shape: tuple[int, ...], names: list[str]) -> Any:
    """A group with its dimensions: dimension scales, as netCDF-4 keeps them."""
    import h5py  # only for files

    group = file.create_group(name)
    for axis, values in (
        ("chain", np.arange(shape[1])),
        ("draw", np.arange(shape[2])),
        ("specimen", np.array(names, dtype=h5py.string_dtype())),
    ):
        group.create_dataset(axis, data=values).make_scale(axis)
    return group


def _add(group: Any, name: str, values: np.ndarray) -> Any:
    data = group.create_dataset(name.replace("/", "_"), data=values, compression="gzip")
    for axis, dimension in enumerate(("chain", "draw", "specimen")):
        data.dims[axis].attach_scale(group[dimension])
    return data
