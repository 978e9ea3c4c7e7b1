"""Force-distance curves of atomic force microscopes.

What afmformats exports (HDF5 or tab, layout of version 0.13) is read here: its own loaders drop the
first sample of a tab file and refuse an HDF5 file whose only curve is number 1. The files of the
instruments (JPK, Igor) are read by the library itself (extra `afm`).

A cantilever pushes with its free end: while its base advances by the fall of the height, its
bending takes back F/k. The displacement of the tip, counted from the first sample, is

    D_i = (h_0 - h_i) - (F_i - F_0) / k,

h: "height (measured)", which falls on approach; F: force, positive when repelled; k: the metadata
"spring constant". Where the file holds "tip position" p, D_i = p_0 - p_i. Approach before contact
counts into D, and force offsets stay: finding the contact point is not the reader's business. Only
segment 0 (approach) is kept, unless all of it is asked for with ``loading = "all"`` or
``"record"``.
"""

import importlib
import json
import logging
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.curve import (
    BadCurve,
    DataError,
    Fault,
    RawCurve,
    ReadOptions,
)
from jaxtrachea.measurements.file_names import FileIdentity, identify_file
from jaxtrachea.measurements.readers.cells import numbers
from jaxtrachea.measurements.readers.column_roles import resolve_unit
from jaxtrachea.measurements.readers.hdf5_values import attribute, numeric, unit_of
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.recognise import AFM, HDF5
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.measurements.readers.table import Header, Text, rows_below
from jaxtrachea.measurements.readers.text_file import first_bytes, read_bytes, to_utf8
from jaxtrachea.units import convert

# afmformats fixes the unit of each column to SI; its tab files do not repeat it.
SI_UNITS = {
    "force": "N",
    "height (measured)": "m",
    "height (piezo)": "m",
    "tip position": "m",
    "time": "s",
    "segment": "",
    "index": "",
}


class _Stored(NamedTuple):
    """A curve as its file has it.

    Attributes:
        columns: by name, in file units.
        units: of the columns.
        metadata: with the spring constant, if it is known.
        rows: numbers of the samples; None: counted from 1.
    """

    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str | None]
    metadata: Mapping[str, Any]
    rows: np.ndarray | None = None


#: Number of a curve, where it stands, and what reads it.
_Found = Iterator[tuple[str, str, Callable[[], _Stored]]]


def read(path: Path, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read the curves of an afmformats file; `columns.displacement` may name another height column.

    The file is one of an instrument by its name, else HDF5 or tab by content.

    Returns:
        One record per curve, in the order of their numbers.

    Raises:
        DataError: damaged or hostile file, or one without curves.
    """
    who = identify_file(path, options)
    if path.suffix.lower() in AFM:
        return _records(_of_instrument(path, options), who, options)
    if first_bytes(path, len(HDF5)) != HDF5:
        tab = iter([("0", str(path), partial(_of_tab, path, options))])
        return _records(tab, who, options)
    with opened(path) as file:
        if found := _records(_of_hdf5(path, file, options), who, options):
            return found
    raise DataError(
        "no groups 0, 1, ... as afmformats writes them",
        place=str(path),
        cure="export the file again",
    )


def _records(found: _Found, who: FileIdentity, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """A record of each curve; the trial of the file's name, with the number of one of several."""
    records: list[RawCurve | BadCurve] = []
    curves = list(found)
    for number, source, stored in curves:
        trial = who.trial or number
        if who.trial and len(curves) > 1:
            trial = f"{who.trial}-{number}"
        try:
            records.append(_curve(stored(), who, trial, source, options))
        except Fault as fault:
            records.append(bad(who.specimen, trial, source, fault))
    return records


def load(path: Path) -> list[Any]:
    """The curves of an instrument's file, as afmformats gives them.

    Raises:
        DataError: the library is missing, or cannot read the file.
    """
    try:
        library = importlib.import_module("afmformats")
    except ImportError:
        raise DataError(
            "is a file of an atomic force microscope, and afmformats, which reads it, is not "
            "installed",
            place=str(path),
            cure="run pip install 'jaxtrachea[afm]', or export the curve as HDF5 or CSV",
        ) from None
    logger = logging.getLogger("afmformats")
    silent, logger.disabled = logger.disabled, True  # it prints what it raises
    try:
        curves = library.load_data(path)
    # Errors of the library itself are no Exceptions, but BaseExceptions.
    except (Exception, library.errors.AFMFileFormatError, library.errors.MissingMetaDataError) as e:
        raise DataError(
            f"afmformats cannot read it ({' '.join(str(e).split())[:80] or type(e).__name__})",
            place=str(path),
            cure="export the curve as HDF5 or CSV, with its spring constant",
        ) from None
    finally:
        logger.disabled = silent
    if not curves:
        raise DataError("holds no curves", place=str(path), cure="export it again")
    return curves


def _of_instrument(path: Path, options: ReadOptions) -> _Found:
    """The curves of a file that afmformats reads; it gives SI units."""

    def stored(curve: Any) -> _Stored:
        names = [name for name in curve.columns if name in _wanted(options)]
        columns = {name: np.asarray(curve[name], np.float64) for name in names}
        metadata = {"spring constant": curve.metadata.get("spring constant")}
        return _Stored(columns, {name: SI_UNITS.get(name) for name in columns}, metadata)

    for number, curve in enumerate(load(path)):
        yield str(number), f"{path}:{number}", partial(stored, curve)


def _of_hdf5(path: Path, file: Any, options: ReadOptions) -> _Found:
    """The numbered groups of an open file."""

    def stored(group: Any) -> _Stored:
        if not hasattr(group, "items"):
            raise Fault("shape", "is a dataset, expected a group", "export the file again")
        columns = {key: numeric(group, key) for key in group if key in _wanted(options)}
        units = {key: unit_of(group, key) for key in columns}
        return _Stored(columns, units, {"spring constant": attribute(group, "spring constant")})

    for name in sorted((name for name in file if re.fullmatch(r"\d{1,9}", name)), key=int):
        yield name, f"{path}:/{name}", partial(stored, file[name])


def _of_tab(path: Path, options: ReadOptions) -> _Stored:
    """The only curve of a tab file."""
    header, metadata, text = _tab_head(path)
    table = rows_below(text, header)
    wanted = [i for i, name in enumerate(header.names) if name in _wanted(options)]
    table.load(wanted)
    columns = {}
    for i in wanted:
        values = table.raw(i)
        if not isinstance(values, np.ndarray):
            cells = [{"True": "1", "False": "0"}.get(cell, cell) for cell in values]
            values = numbers(cells, table.lines, header.names[i], ",")
        columns[header.names[i]] = values
    units = {name: SI_UNITS.get(name) for name in columns}
    return _Stored(columns, units, metadata, table.lines)


def _wanted(options: ReadOptions) -> set[str]:
    chosen = {options.columns[r] for r in ("displacement", "force") if r in options.columns}
    timed = {"time"} if options.loading == "record" else set()
    return {"force", "height (measured)", "tip position", "segment"} | chosen | timed


def _tab_head(path: Path) -> tuple[Header, Mapping[str, Any], Text]:
    """Column names and metadata, both in comments, and the text in which the rows stand."""
    text = Text(path, to_utf8(path, read_bytes(path)))
    lines = text.head
    texts = [line.text.strip().removeprefix("#").strip() for line in lines]
    if "BEGIN METADATA" not in texts or "END METADATA" not in texts:
        raise Fault(
            "metadata_missing", "no BEGIN METADATA ... END METADATA", "export the file again"
        )
    begin, end = texts.index("BEGIN METADATA"), texts.index("END METADATA")
    try:
        metadata = json.loads("\n".join(texts[begin + 1 : end]))
    except (ValueError, RecursionError) as error:
        raise Fault(
            "metadata_missing", f"the metadata are no JSON ({error})", "export the file again"
        ) from None
    if not isinstance(metadata, dict):
        raise Fault("metadata_missing", "the metadata are no JSON object", "export the file again")
    for i in range(end + 1, len(lines)):
        if lines[i].text.startswith("#") and texts[i]:
            names, row = _split_glued(texts[i].split("\t"))
            number = lines[i].number
            header = Header(names, [None] * len(names), number, "\t", number if row else number + 1)
            if row:  # the first row takes the place of the line of the names
                data = text.data.split(b"\n")
                data[number - 1] = row.encode()
                text = Text(path, b"\n".join(data))
            return header, metadata, text
    raise DataError(
        "no line with column names after the metadata",
        place=str(path),
        cure="export the file again",
    )


def _split_glued(cells: list[str]) -> tuple[list[str], str]:
    """Names, and the first row if it hangs on the header, as version 0.13.3 leaves it."""
    for i, cell in enumerate(cells):
        for name in SI_UNITS:
            if cell.startswith(name) and re.fullmatch(
                r"[-+.\deE]+|True|False|nan", cell[len(name) :]
            ):
                if len(cells) == 2 * i + 1:
                    return [*cells[:i], name], "\t".join([cell[len(name) :], *cells[i + 1 :]])
    return cells, ""


def _curve(
    stored: _Stored, who: FileIdentity, trial: str, source: str, options: ReadOptions
) -> RawCurve:
    """Force and tip displacement of one curve."""
    columns = stored.columns
    force = _column(options.columns.get("force", "force"), "force", stored, source, options)
    position = _tip_position(force, stored, source, options)
    word, rows = "line", stored.rows
    if rows is None:
        word, rows = "sample", np.arange(1, force.size + 1)
    keep = np.ones(force.shape, dtype=bool)
    if "segment" in columns and options.loading not in ("all", "record"):
        if columns["segment"].shape != force.shape:
            raise Fault("shape", "segment and force differ in length", "export again")
        keep = columns["segment"] == 0
    position, force, rows = position[keep], force[keep], rows[keep]
    displacement = position[:1] - position if position.size else position
    time = None
    if options.loading == "record" and "time" in columns:
        name = options.columns.get("time", "time")
        time = np.atleast_1d(convert(columns[name], stored.units[name] or "s", "time"))
    return RawCurve(
        who.specimen, trial, source, displacement, force, rows, word, s=who.s, phi=who.phi,
        time=time,
    )  # fmt: skip


def _tip_position(
    force: np.ndarray, stored: _Stored, source: str, options: ReadOptions
) -> np.ndarray:
    """Position of the tip, mm, falling towards the sample: h + F/k, or as the file gives it."""
    default = "tip position" if "tip position" in stored.columns else "height (measured)"
    name = options.columns.get("displacement", default)
    length = _column(name, "displacement", stored, source, options)
    if length.shape != force.shape:
        raise Fault(
            "shape", f"force {force.shape} and {name} {length.shape} differ", "export again"
        )
    if "height" not in name:
        return length
    spring = stored.metadata.get("spring constant")
    if not isinstance(spring, (int, float, np.number)) or not 0 < spring < 1e9:
        raise Fault(
            "metadata_missing",
            f"spring constant is {spring!r}; the bending cannot be taken out of the height",
            'export with metadata "spring constant" (N/m), or with a column "tip position"',
        )
    return length + force / convert(float(spring), "N/m", "stiffness")


def _column(name: str, role: str, stored: _Stored, source: str, options: ReadOptions) -> np.ndarray:
    if name not in stored.columns:
        raise Fault(
            "column_missing",
            f"no column {name!r}; there are {sorted(stored.columns)}",
            "export it as well",
        )
    unit = resolve_unit(role, stored.units[name], options, f"{source}/{name}")
    return np.atleast_1d(
        convert(stored.columns[name], unit, "force" if role == "force" else "length")
    )


AFMFORMATS = Reader(
    "afmformats",
    read=read,
    is_text=lambda text, options: any("BEGIN METADATA" in line.text for line in text.head[:10]),
    is_hdf5=lambda file: "schema" not in file.attrs and any(name.isdecimal() for name in file),
    layout="groups 0, 1, ... of afmformats",
)
