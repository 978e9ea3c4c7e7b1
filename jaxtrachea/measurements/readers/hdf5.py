"""The project's own HDF5 schema: one dataset per quantity, all curves end to end.

``curves/<name>`` are tables with one row per curve; ``samples/<quantity>`` holds the values of all
curves, those of curve i from ``offsets/<quantity>[i]`` up to ``offsets/<quantity>[i + 1]``. See
docs/measurements.md.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.curve import BadCurve, DataError, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.observed import OBSERVED, RING_NUMBERS, RINGS
from jaxtrachea.measurements.readers.column_roles import resolve_unit
from jaxtrachea.measurements.readers.hdf5_values import (
    attribute,
    measured,
    numeric,
    text_attribute,
    unit_of,
)
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.safe_hdf5 import Limits, opened
from jaxtrachea.measurements.roles import role_dimension
from jaxtrachea.units import convert

SCHEMA, VERSION = "jaxtrachea-measurements", 2
GROUPS = ("curves", "offsets", "samples")
NAMES = ("specimen", "trial")
#: More numbers than in other files: the datasets are few, and checked as a whole.
LIMITS = Limits(
    elements=100_000_000,
    total=400_000_000,
    texts=("/curves/specimen", "/curves/trial", "/curves/source"),
)
#: Fields of a curve that are called otherwise in the file.
FIELDS = {number: field for field, number in RING_NUMBERS.items()}
#: Quantities: role of the unit (None: ring numbers) and the unit that is written.
QUANTITIES: dict[str, tuple[str | None, str | None]] = {
    "displacement": ("displacement", "mm"),
    "force": ("force", "N"),
    **{q.name: (q.role, q.unit) for q in OBSERVED},
    **dict.fromkeys(FIELDS, (None, None)),
}
#: Quantities of rings, and the dataset of the numbers of these.
SEVERAL = {q.name: (number, q) for number, field in FIELDS.items() for q in RINGS[field]}


def read(path: Path, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read every curve; a fault in the values of one costs this curve only.

    Args:
        options: units for datasets that have none.

    Returns:
        One record per row of the tables, in their order; quantities in mm, N, rad and s.

    Raises:
        DataError: damaged or hostile file; another schema or version; a table or dataset is
            missing, damaged, without unit, or of another length than the others; offsets that are
            none; a name that is no text, empty or unprintable.
    """
    with opened(path, limits=limits_of) as file:
        _check_version(path, file)
        return _curves(path, file, options)


def limits_of(file: Any) -> Limits:
    """What a file may hold, by the names in it: only this schema has texts and large datasets."""
    return LIMITS if "curves" in file else Limits()


def _check_version(path: Path, file: Any) -> None:
    """Refuse other schemas and versions."""
    try:
        schema, version = text_attribute(file, "schema"), attribute(file, "schema_version")
    except Fault as fault:
        raise DataError(fault.message, place=str(path), cure=fault.cure) from None
    if schema != SCHEMA:
        raise DataError(
            f"root attribute schema is {schema!r}, expected {SCHEMA!r}",
            place=str(path),
            cure="see docs/measurements.md",
        )
    if not isinstance(version, (int, np.integer)) or version != VERSION:
        old = "convert it with jaxtrachea 0.1 (jaxtrachea convert OLD.h5 NEW.h5)"
        raise DataError(
            f"schema_version is {version}, this program reads {VERSION}",
            place=str(path),
            cure=old if np.array_equal(version, 1) else "update the program or the file",
        )


def _curves(path: Path, file: Any, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """All curves of an audited file."""
    store = _Store(path, file, options)
    specimens, trials = store.names()
    size = len(specimens)
    if size == 0:
        raise store.error("curves/specimen", "there are no curves", "add a row per curve")
    s, phi = store.position("s", size), store.position("phi", size)
    directions = store.directions(size)
    samples = {
        name: pieces
        for name in QUANTITIES
        if (pieces := store.pieces(name, size, needed=name in ("displacement", "force")))
    }
    records: list[RawCurve | BadCurve] = []
    for i, key in enumerate(zip(specimens, trials, strict=True)):
        source = f"{path}:/curves[{i}]"
        try:
            fields: dict[str, Any] = dict(_fields(samples, i))
        except Fault as fault:
            records.append(bad(*key, source, fault))
            continue
        rows = np.arange(1, fields["displacement"].size + 1)
        record = RawCurve(
            *key,
            source,
            rows=rows,
            row_word="sample",
            s=s[i],
            phi=phi[i],
            direction=directions[i],
            **fields,
        )
        records.append(record)
    return records


class _Pieces:
    """The values of one quantity, curve by curve."""

    def __init__(self, values: np.ndarray, offsets: np.ndarray) -> None:
        self.values, self.offsets = values, offsets.tolist()

    def __getitem__(self, i: int) -> np.ndarray:
        return self.values[self.offsets[i] : self.offsets[i + 1]]


def _fields(samples: dict[str, _Pieces], i: int) -> Iterator[tuple[str, np.ndarray]]:
    """Fields of one curve; a quantity without values is not there."""
    count = samples["displacement"][i].size
    for name, pieces in samples.items():
        values = pieces[i]
        if values.size == 0 and name not in ("displacement", "force"):
            continue
        if name in SEVERAL:
            number, quantity = SEVERAL[name]
            rings = samples[number][i].size if number in samples else 0
            shape = quantity.shape(count, rings)
            if values.size != np.prod(shape):
                raise Fault(
                    "shape",
                    f"{name} has {values.size} values, expected {' x '.join(map(str, shape))}"
                    f" (samples, rings of {number}"
                    f"{', y and z)' if len(shape) == 3 else ')'}",
                    "store one of every ring for every sample, NaN where it was not seen",
                )
            values = values.reshape(shape)
        yield FIELDS.get(name, name), values


class _Store:
    """Datasets of one file; whatever is wrong is said with the place of the dataset."""

    def __init__(self, path: Path, file: Any, options: ReadOptions) -> None:
        self.path, self.file, self.options = path, file, options
        for name in GROUPS:
            if not hasattr(file.get(name), "items"):
                raise self.error(name, "no such group", "store the tables and datasets in it")

    def error(self, name: str, what: str, cure: str) -> DataError:
        return DataError(what, place=f"{self.path}:/{name}", cure=cure)

    def names(self) -> tuple[list[str], list[str]]:
        specimens, trials = (self.texts(f"curves/{name}") for name in NAMES)
        if len(specimens) != len(trials):
            raise self.wrong_length("curves/trial", len(trials), len(specimens))
        return specimens, trials

    def wrong_length(self, name: str, found: int, curves: int) -> DataError:
        what = f"has {found} rows, expected {curves}, one per row of curves/specimen"
        return self.error(name, what, "store one row per curve")

    def texts(self, name: str) -> list[str]:
        """A table of names."""
        values = self.raw(name)
        if values.dtype.kind != "S" or values.ndim != 1:
            found = f"holds {values.dtype} of shape {values.shape}, expected a list of texts"
            raise self.error(name, found, "store text of fixed length, in UTF-8")
        try:
            found = [value.decode() for value in values.tolist()]
        except UnicodeDecodeError:
            raise self.error(name, "is not text in UTF-8", "write the names in UTF-8") from None
        for i, text in enumerate(found):
            if not text or not text.isprintable():
                what = f"row {i}: {text!a} is empty or holds unprintable characters"
                raise self.error(name, what, "give every curve a name")
        return found

    def raw(self, name: str) -> np.ndarray:
        """Values as they are stored."""
        group, _, last = name.partition("/")
        dataset = self.file[group].get(last)
        if dataset is None or hasattr(dataset, "items") or dataset.shape is None:
            raise self.error(name, "no such dataset", "store it, as docs/measurements.md shows")
        try:
            return np.asarray(dataset[()])
        except (OSError, RuntimeError, ValueError, TypeError) as error:
            what = f"is damaged ({error})"
            raise self.error(name, " ".join(what.split()), "copy the file again") from None

    def quantity(self, name: str, role: str | None) -> np.ndarray:
        """Numbers in mm, N, rad or s; without a role as they are."""
        group, _, last = name.partition("/")
        try:
            if role is None:
                return numeric(self.file[group], last)
            values, unit = measured(self.file[group], last)
            unit = resolve_unit(role, unit, self.options, last)
        except Fault as fault:
            raise self.error(name, fault.message, fault.cure) from None
        except DataError as error:
            raise DataError.like(error, place=f"{self.path}:/{name}") from None
        return np.asarray(convert(values, unit, role_dimension(role)))

    def position(self, role: str, size: int) -> list[float | None]:
        """A table of positions, None where it says NaN."""
        name = f"curves/{role}_c"
        if f"{role}_c" not in self.file["curves"]:
            return [None] * size
        values = self.quantity(name, role)
        if values.shape != (size,):
            raise self.wrong_length(name, len(np.atleast_1d(values)), size)
        return [None if math.isnan(value) else value for value in values.tolist()]

    def directions(self, size: int) -> list[tuple[float, ...]]:
        """A table of directions; the normal where there is none."""
        if "direction" not in self.file["curves"]:
            return [(1.0, 0.0)] * size
        values = self.quantity("curves/direction", None)
        if values.shape != (size, 2):
            found = f"has the shape {values.shape}, expected {(size, 2)}"
            cure = "store the components along the inward normal and along the circumference"
            raise self.error("curves/direction", found, cure)
        return [(a, b) for a, b in values.tolist()]

    def pieces(self, name: str, size: int, *, needed: bool) -> _Pieces | None:
        """Values of a quantity with its offsets; None if the file does not have it."""
        place, table = f"samples/{name}", f"offsets/{name}"
        stored = name in self.file["samples"], name in self.file["offsets"]
        if not any(stored) and not needed:
            return None
        offsets = self.offsets(table, size)
        role = QUANTITIES[name][0]
        if name == "time" and stored[0] and self.untimed():
            return None
        values = self.quantity(place, role)
        if values.ndim != 1:
            found = f"has the shape {values.shape}, expected the values of all curves end to end"
            raise self.error(place, found, "store a list of numbers")
        if offsets[-1] != values.size:
            what = f"ends at {offsets[-1]}, but {place} has {values.size} values"
            raise self.error(table, what, "store where each curve begins and the last one ends")
        if role is None:
            if not (np.isfinite(values).all() and (values == np.round(values)).all()):
                raise self.error(place, "is not whole", "number rings 1, 2, ...")
            values = values.astype(np.int64) - 1
        return _Pieces(values, offsets)

    def untimed(self) -> bool:
        """Whether the time has no unit, and so is left alone."""
        try:
            found = unit_of(self.file["samples"], "time")
        except Fault as fault:
            raise self.error("samples/time", fault.message, fault.cure) from None
        return (found or self.options.units.get("time")) is None

    def offsets(self, name: str, size: int) -> np.ndarray:
        """Where each curve begins, and the last one ends."""
        values = self.raw(name)
        if values.dtype.kind not in "iu" or values.ndim != 1:
            found = f"holds {values.dtype} of shape {values.shape}, expected a list of integers"
            raise self.error(name, found, "store integers")
        if values.size != size + 1:
            what = f"has {values.size} rows, expected {size + 1}, one more than there are curves"
            raise self.error(name, what, "store where each curve begins and the last one ends")
        if values[0] != 0:
            raise self.error(name, f"begins at {values[0]}", "the first curve must begin at 0")
        falls = values[1:] < values[:-1]
        if falls.any():
            i = int(np.argmax(falls))
            what = f"falls from {values[i]} to {values[i + 1]} after row {i}"
            raise self.error(name, what, "store where each curve begins, in their order")
        return values


HDF5 = Reader(
    "hdf5",
    read=read,
    is_hdf5=lambda file: "schema" in file.attrs,
    layout=f'root attribute schema = "{SCHEMA}"',
)
