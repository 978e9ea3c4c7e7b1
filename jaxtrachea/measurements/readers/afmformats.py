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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
from jaxtrachea.measurements.readers.recognise import AFM
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.measurements.readers.table import Header, Text, rows_below
from jaxtrachea.measurements.readers.text_file import read_bytes, to_utf8
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


def read(path: Path, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read the curves of an afmformats file; `columns.displacement` may name another height column.

    Args:
        path: the file: of an instrument by its name, else HDF5 or tab by content.
        options: naming, loading rule, columns.

    Returns:
        One record per curve, in the order of their numbers.

    Raises:
        DataError: damaged or hostile file, or one without curves.
    """
    who = identify_file(path, options)
    if path.suffix.lower() in AFM:
        return _read_instrument(path, who, options)
    with path.open("rb") as stream:
        is_hdf5 = stream.read(8) == b"\x89HDF\r\n\x1a\n"
    return _read_hdf5(path, who, options) if is_hdf5 else [_read_tab(path, who, options)]


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


def _read_instrument(
    path: Path, who: FileIdentity, options: ReadOptions
) -> list[RawCurve | BadCurve]:
    """The curves of a file that afmformats reads; it gives SI units."""
    found: list[RawCurve | BadCurve] = []
    curves = load(path)
    for number, curve in enumerate(curves):
        own = str(number)
        trial = own if who.trial is None else f"{who.trial}-{own}" if len(curves) > 1 else who.trial
        source = f"{path}:{number}"
        held = [name for name in curve.columns if name in _wanted(options)]
        columns = {name: np.asarray(curve[name], np.float64) for name in held}
        units = {name: SI_UNITS.get(name) for name in columns}
        metadata = {"spring constant": curve.metadata.get("spring constant")}
        rows = np.arange(1, columns["force"].size + 1) if "force" in columns else np.zeros(0)
        try:
            place = (who, trial, source)
            found.append(_curve(columns, units, metadata, rows, "sample", place, options))
        except Fault as fault:
            found.append(bad(who.specimen, trial, source, fault))
    return found


def _read_hdf5(path: Path, who: FileIdentity, options: ReadOptions) -> list[RawCurve | BadCurve]:
    found: list[RawCurve | BadCurve] = []
    with opened(path) as file:
        names = sorted((name for name in file if re.fullmatch(r"\d{1,9}", name)), key=int)
        for name in names:
            source = f"{path}:/{name}"
            trial = (
                name
                if who.trial is None
                else who.trial
                if len(names) == 1
                else f"{who.trial}-{name}"
            )
            group = file[name]
            try:
                if not hasattr(group, "items"):
                    raise Fault("shape", "is a dataset, expected a group", "export the file again")
                columns = {key: numeric(group, key) for key in group if key in _wanted(options)}
                units = {key: unit_of(group, key) for key in columns}
                metadata = {"spring constant": attribute(group, "spring constant")}
                rows = (
                    np.arange(1, columns["force"].size + 1) if "force" in columns else np.zeros(0)
                )
                found.append(
                    _curve(
                        columns,
                        units,
                        metadata,
                        rows,
                        "sample",
                        (who, trial, source),
                        options,
                    )
                )
            except Fault as fault:
                found.append(bad(who.specimen, trial, source, fault))
    if not found:
        raise DataError(
            "no groups 0, 1, ... as afmformats writes them",
            place=str(path),
            cure="export the file again",
        )
    return found


def _read_tab(path: Path, who: FileIdentity, options: ReadOptions) -> RawCurve | BadCurve:
    trial = who.trial or "0"
    source = str(path)
    try:
        header, metadata, text = _tab_head(path)
        table = rows_below(text, header)
        wanted = [i for i, name in enumerate(header.names) if name in _wanted(options)]
        table.load(wanted)
        columns = {}
        for i in wanted:
            values = table.raw(i)
            if not isinstance(values, np.ndarray):
                cells = [*map(_truth, values)]
                values = numbers(cells, table.lines, header.names[i], ",")
            columns[header.names[i]] = values
        units = {name: SI_UNITS.get(name) for name in columns}
        place = (who, trial, source)
        return _curve(columns, units, metadata, table.lines, "line", place, options)
    except Fault as fault:
        return bad(who.specimen, trial, source, fault)


def _wanted(options: ReadOptions) -> set[str]:
    chosen = {options.columns[r] for r in ("displacement", "force") if r in options.columns}
    timed = {"time"} if options.loading == "record" else set()
    return {"force", "height (measured)", "tip position", "segment"} | chosen | timed


def _truth(cell: str) -> str:
    return {"True": "1", "False": "0"}.get(cell, cell)


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
    columns: Mapping[str, np.ndarray],
    units: Mapping[str, str | None],
    metadata: Mapping[str, Any],
    rows: np.ndarray,
    row_word: str,
    place: tuple[FileIdentity, str, str],
    options: ReadOptions,
) -> RawCurve:
    """Force and tip displacement of one curve, from its columns in file units."""
    who, trial, source = place
    force = _column(options.columns.get("force", "force"), "force", columns, units, source, options)
    position = _tip_position(force, columns, units, metadata, source, options)
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
        time = np.atleast_1d(convert(columns[name], units[name] or "s", "time"))
    return RawCurve(
        who.specimen, trial, source, displacement, force, rows, row_word, s=who.s, phi=who.phi,
        time=time,
    )  # fmt: skip


def _tip_position(
    force: np.ndarray,
    columns: Mapping[str, np.ndarray],
    units: Mapping[str, str | None],
    metadata: Mapping[str, Any],
    source: str,
    options: ReadOptions,
) -> np.ndarray:
    """Position of the tip, mm, falling towards the sample: h + F/k, or as the file gives it."""
    default = "tip position" if "tip position" in columns else "height (measured)"
    name = options.columns.get("displacement", default)
    length = _column(name, "displacement", columns, units, source, options)
    if length.shape != force.shape:
        raise Fault(
            "shape", f"force {force.shape} and {name} {length.shape} differ", "export again"
        )
    if "height" not in name:
        return length
    spring = metadata.get("spring constant")
    if not isinstance(spring, (int, float, np.number)) or not 0 < spring < 1e9:
        raise Fault(
            "metadata_missing",
            f"spring constant is {spring!r}; the bending cannot be taken out of the height",
            'export with metadata "spring constant" (N/m), or with a column "tip position"',
        )
    return length + force / convert(float(spring), "N/m", "stiffness")


def _column(
    name: str,
    role: str,
    columns: Mapping[str, np.ndarray],
    units: Mapping[str, str | None],
    source: str,
    options: ReadOptions,
) -> np.ndarray:
    if name not in columns:
        raise Fault(
            "column_missing",
            f"no column {name!r}; there are {sorted(columns)}",
            "export it as well",
        )
    unit = resolve_unit(role, units[name], options, f"{source}/{name}")
    return np.atleast_1d(convert(columns[name], unit, "force" if role == "force" else "length"))


AFMFORMATS = Reader(
    "afmformats",
    read=read,
    is_text=lambda text, options: any("BEGIN METADATA" in line.text for line in text.head[:10]),
    is_hdf5=lambda file: "schema" not in file.attrs and any(name.isdecimal() for name in file),
    layout="groups 0, 1, ... of afmformats",
)
