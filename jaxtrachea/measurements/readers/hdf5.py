"""The project's own HDF5 schema; see docs/measurements.md.

Version 1, in this file, keeps ``specimens/<name>/<trial>``; version 2 is in `ragged`.
"""

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from jaxtrachea.files.atomic import write_whole
from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.curve import BadCurve, Curve, DataError, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.readers.column_roles import resolve_unit
from jaxtrachea.measurements.readers.hdf5_values import (
    attribute,
    measured,
    names_in,
    number_attribute,
    numeric,
    text_attribute,
    unit_of,
)
from jaxtrachea.measurements.readers.ragged import limits_of, read_curves
from jaxtrachea.measurements.readers.ragged_writer import write_ragged
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.measurements.roles import role_dimension
from jaxtrachea.units import convert

SCHEMA = "jaxtrachea-measurements"
VERSIONS = (1, 2)
#: Datasets that a trial may have beside those of a normal press, with the unit they are written in.
OPTIONAL = {
    "time": "s",
    "side_force": "N",
    "joint_side_displacement": "mm",
    "end_U": "mm",
    "end_V": "mm",
}
# Below this a chunk's overhead outweighs compression.
COMPRESS_FROM = 512


def read(path: Path, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read every trial; a fault within one costs this trial only.

    Args:
        path: the file, of version 1 or 2.
        options: units for datasets that have none.

    Returns:
        One record per trial, in the order of the file.

    Raises:
        DataError: damaged or hostile file, another schema or version, or no trial in it.
    """
    with opened(path, limits=limits_of) as file:
        if _checked_version(path, file) == 2:
            return read_curves(path, file, options)
        return _trials(path, file, options)


def _trials(path: Path, file: Any, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """All trials of version 1."""
    found: list[RawCurve | BadCurve] = []
    for specimen, group in file["specimens"].items():
        if not hasattr(group, "items") or len(group) == 0:
            fault = Fault("empty", "the specimen has no trials", "add one group per trial")
            found.append(bad(unquote(specimen), "-", f"{path}:/specimens/{specimen}", fault))
            continue
        for trial, item in group.items():
            source = f"{path}:/specimens/{specimen}/{trial}"
            key = (unquote(specimen), unquote(trial))
            try:
                found.append(_trial(item, key, source, options))
            except Fault as fault:
                found.append(bad(*key, source, fault))
    if not found:
        raise DataError(
            "/specimens is empty",
            place=str(path),
            cure="add one group per specimen and trial",
        )
    return found


def _checked_version(path: Path, file: Any) -> int:
    """Version of the schema, one of `VERSIONS`."""
    try:
        schema = text_attribute(file, "schema")
        version = attribute(file, "schema_version")
    except Fault as fault:
        raise DataError(fault.message, place=str(path), cure=fault.cure) from None
    if schema != SCHEMA:
        raise DataError(
            f"root attribute schema is {schema!r}, expected {SCHEMA!r}",
            place=str(path),
            cure="see docs/measurements.md",
        )
    if not isinstance(version, (int, np.integer)) or version not in VERSIONS:
        raise DataError(
            f"schema_version is {version}, this program reads {' and '.join(map(str, VERSIONS))}",
            place=str(path),
            cure="update the program or the file",
        )
    if version == 1 and not hasattr(file.get("specimens"), "items"):
        raise DataError(
            "no group /specimens",
            place=str(path),
            cure="expected specimens/<name>/<trial>",
        )
    return int(version)


def _trial(group: Any, key: tuple[str, str], source: str, options: ReadOptions) -> RawCurve:
    if not hasattr(group, "items"):
        raise Fault(
            "shape", "is a dataset, expected a group for the trial", "store a group per trial"
        )
    names = names_in(group)
    displacement = _quantity(group, "displacement", "displacement", source, options)
    return RawCurve(
        *key,
        source,
        displacement,
        _quantity(group, "force", "force", source, options),
        np.arange(1, displacement.size + 1),
        "sample",
        s=_position(group, "s", source, options),
        phi=_position(group, "phi", source, options),
        sigma=_quantity(group, "sigma", "sigma", source, options) if "sigma" in names else None,
        time=_time(group, source, options) if "time" in names else None,
        direction=_direction(group),
        **_markers(group, names, source, options),
        **_vectors(group, names, source, options),
    )


def _markers(
    group: Any, stored: frozenset[str], source: str, options: ReadOptions
) -> dict[str, Any]:
    """Markers on the rings; what is stored without its ring numbers is missing them."""
    names = ("joint_displacement", "joint_side_displacement")
    if stored.isdisjoint((*names, "joint_ring_number")):
        return {}
    found = {"joint_rings": _ring_indices(group, "joint_ring_number")}
    for name in names:
        if name == "joint_displacement" or name in stored:
            found[name] = _quantity(group, name, "joint", source, options)
    return found


def _vectors(
    group: Any, stored: frozenset[str], source: str, options: ReadOptions
) -> dict[str, Any]:
    """Side force, and the ends of the rings with their numbers."""
    found = {}
    if "side_force" in stored:
        found["side_force"] = _quantity(group, "side_force", "side_force", source, options)
    ends = [name for name in ("end_U", "end_V") if name in stored]
    if ends or "end_ring_number" in stored:
        found["end_rings"] = _ring_indices(group, "end_ring_number")
    for name in ends:
        found[name] = _quantity(group, name, "end", source, options)
    return found


def _ring_indices(group: Any, name: str) -> np.ndarray:
    """Rings counted from 0, of a dataset that counts from 1."""
    rings = numeric(group, name)
    if not (np.isfinite(rings).all() and (rings == np.round(rings)).all()):
        raise Fault("shape", f"{name} is not whole", "number rings 1, 2, ...")
    return rings.astype(np.int64) - 1


def _direction(group: Any) -> tuple[float, ...]:
    """Attribute ``direction`` of a trial; its length is checked later."""
    value = attribute(group, "direction")
    if value is None:
        return (1.0, 0.0)
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "iuf" or numbers.shape != (2,):
        raise Fault(
            "direction",
            f"attribute direction is {value!r}, expected two numbers",
            "store its components along the inward normal and along the circumference",
        )
    return tuple(map(float, numbers))


def _time(group: Any, source: str, options: ReadOptions) -> np.ndarray | None:
    """Time of a trial, s, where it is stored with a unit."""
    if (unit_of(group, "time") or options.units.get("time")) is None:
        return None
    return _quantity(group, "time", "time", source, options)


def _quantity(group: Any, name: str, role: str, source: str, options: ReadOptions) -> np.ndarray:
    values, unit = measured(group, name)
    unit = resolve_unit(role, unit, options, f"{source}/{name}")
    return np.atleast_1d(convert(values, unit, role_dimension(role)))


def _position(group: Any, role: str, source: str, options: ReadOptions) -> float | None:
    """Attribute ``s_c`` or ``phi_c`` of a trial; its unit is in ``s_c_unit``, ``phi_c_unit``."""
    name = f"{role}_c"
    value = number_attribute(group, name)
    if value is None:
        return None
    if np.ndim(value) != 0 or not isinstance(value, (int, float, np.number)):
        raise Fault("position", f"attribute {name} is {value!r}", "store one number")
    unit = resolve_unit(role, text_attribute(group, f"{name}_unit"), options, f"{source}@{name}")
    return float(convert(float(value), unit, "length" if role == "s" else "angle"))


def write(
    path: Path,
    curves: Iterable[Curve],
    attrs: Mapping[str, str | int | float],
    overwrite: bool,
    version: int,
) -> None:
    """Write curves in the schema; the file appears complete or not at all.

    Args:
        path: the file to write, in an existing folder.
        curves: what to write, in this order.
        attrs: further root attributes (licence, source, ...).
        overwrite: replace an existing file.
        version: of the schema, 1 or 2.

    Raises:
        FileExistsError: `path` exists and `overwrite` is False.
        ValueError: `attrs` touches schema or schema_version, there is no such version, a name
            cannot be written, or a (specimen, trial) comes twice.
    """
    import h5py

    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; choose another name or pass overwrite=True")
    if {"schema", "schema_version"} & set(attrs):
        raise ValueError("attrs must not set schema or schema_version; they are fixed")
    if version not in VERSIONS:
        raise ValueError(f"schema_version must be 1 or 2, got {version!r}")
    image = io.BytesIO()  # as files.atomic says why
    with h5py.File(image, "w") as file:
        file.attrs.update({**attrs, "schema": SCHEMA, "schema_version": version})
        if version == 2:
            write_ragged(file, tuple(curves))
        else:
            specimens = file.create_group("specimens", track_order=True)
            for curve in curves:
                _write_curve(specimens, curve)
    write_whole(path, image.getvalue())


def _group_name(name: str) -> str:
    """A name as an HDF5 link: ``/`` would nest and ``.`` means the group itself."""
    if not name:
        raise ValueError("specimen and trial must have names")
    quoted = name.replace("%", "%25").replace("/", "%2F").replace("\0", "%00")
    return quoted.replace(".", "%2E") if set(quoted) == {"."} else quoted


def _write_curve(specimens: Any, curve: Curve) -> None:
    specimen, trial = _group_name(curve.specimen), _group_name(curve.trial)
    if specimen not in specimens:
        specimens.create_group(specimen, track_order=True)
    if trial in specimens[specimen]:
        raise ValueError(
            f"specimen {curve.specimen!r} trial {curve.trial!r} comes twice; rename one"
        )
    group = specimens[specimen].create_group(trial)
    if curve.s_c is not None:
        group.attrs.update({"s_c": float(curve.s_c), "s_c_unit": "mm"})
    group.attrs.update({"phi_c": float(curve.phi_c), "phi_c_unit": "rad", "source": curve.source})
    _write_dataset(group, "displacement", curve.displacement, "mm")
    _write_dataset(group, "force", curve.force, "N")
    if curve.sigma is not None:
        _write_dataset(group, "sigma", curve.sigma, "N")
    if curve.joint_rings is not None and curve.joint_displacement is not None:
        _write_dataset(group, "joint_displacement", curve.joint_displacement, "mm")
        _write_dataset(group, "joint_ring_number", np.asarray(curve.joint_rings) + 1, None)
    if tuple(curve.direction) != (1.0, 0.0):
        group.attrs["direction"] = np.array(curve.direction, dtype=np.float64)
    for name, unit in OPTIONAL.items():
        if (values := getattr(curve, name)) is not None:
            _write_dataset(group, name, values, unit)
    if curve.end_rings is not None:
        _write_dataset(group, "end_ring_number", np.asarray(curve.end_rings) + 1, None)


def _write_dataset(group: Any, name: str, values: np.ndarray, unit: str | None) -> None:
    packed = {"compression": "gzip", "shuffle": True, "fletcher32": True}
    dataset = group.create_dataset(
        name, data=values, **(packed if values.size >= COMPRESS_FROM else {})
    )
    if unit:
        dataset.attrs["unit"] = unit


HDF5 = Reader(
    "hdf5",
    read=read,
    is_hdf5=lambda file: "schema" in file.attrs,
    layout=f'root attribute schema = "{SCHEMA}"',
)
