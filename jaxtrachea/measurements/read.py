"""Measured force-displacement curves: the data model and the one door through which files come in.

Everything past this door is in mm, N, rad, float64 on the host. One bad curve costs only itself: it
comes back as a `BadCurve` with its reason, and only what spoils a whole file or study raises
`DataError`. The formats are described in docs/measurements.md.
"""

import dataclasses
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtrachea.measurements.batch_checks import finish_all
from jaxtrachea.measurements.curve import (
    BadCurve,
    Curve,
    DataError,
    RawCurve,
    ReadOptions,
)
from jaxtrachea.measurements.hdf5_writer import write_curves
from jaxtrachea.measurements.machine import check_machine_files
from jaxtrachea.measurements.readers import READERS, reader_of
from jaxtrachea.measurements.readers.afmformats import AFMFORMATS
from jaxtrachea.measurements.readers.reader import Reader, Records
from jaxtrachea.measurements.readers.recognise import HEAD, kind_of
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.measurements.readers.table import Text
from jaxtrachea.measurements.readers.text_file import first_bytes, read_bytes, to_utf8
from jaxtrachea.measurements.readers.workbook import listed, read_sheets

__all__ = [
    "BadCurve",
    "Curve",
    "DataError",
    "Measurements",
    "ReadOptions",
    "read_measurements",
    "write_hdf5",
]

#: Trial of the row that stands for a file of which nothing can be read.
WHOLE_FILE = "(all)"
#: What another sheet of the same workbook may mend.
_OF_THE_SHEET = ("empty", "column_missing")
#: Names of columns in a sentence.
_COLUMNS = 10


@dataclass(frozen=True, eq=False)
class Measurements:
    """The curves of a study.

    Attributes:
        curves: usable curves, in the order of the files and within them.
        bad: what could not be used, in the same order.
        files: the files read.
        notes: what a user should know of how they were read, in a line each.
    """

    curves: tuple[Curve, ...]
    bad: tuple[BadCurve, ...]
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    def sha256(self) -> dict[str, str]:
        """SHA-256 of each file as it is now, in hexadecimal, by its path as given.

        Raises:
            OSError: a file has gone.
        """
        digests = {}
        for path in self.files:
            with path.open("rb") as stream:
                digests[str(path)] = hashlib.file_digest(stream, "sha256").hexdigest()
        return digests


def read_measurements(
    paths: Path | str | Sequence[Path | str], options: ReadOptions | None = None
) -> Measurements:
    """Read measured curves from files of one study.

    Args:
        paths: the files, at least one; or one file.
        options: how to read them; by default by content.

    Returns:
        Usable curves and bad ones, in mm, N, rad.

    Raises:
        DataError: a file is missing, unreadable, hostile or of no known format, its table is
            malformed, or a (specimen, trial) comes twice; `options.machine_compliance` leaves out a
            file, or names one that is not there.
        InputError: `options.format` names no format.
    """
    options = options or ReadOptions()
    reader_of(options.format)
    paths = [paths] if paths and isinstance(paths, (str, Path)) else paths
    if isinstance(paths, (str, bytes)) or not paths:
        raise DataError(
            f"paths is {paths!r}",
            cure="expected at least one file, by itself or in a list",
        )
    files = [Path(path) for path in paths]
    check_machine_files(files, options)
    return joined([_read(path, options) for path in files])


def _read(path: Path, options: ReadOptions) -> Measurements:
    """One file."""
    _check_file(path)
    records, said = _read_file(path, options)
    done = finish_all(records, options.of_file(path))
    curves = tuple(c for c in done if isinstance(c, Curve))
    bad = tuple(c for c in done if isinstance(c, BadCurve))
    return Measurements(curves, bad, (path,), (*said, *_notes(records)))


def joined(parts: Sequence[Measurements]) -> Measurements:
    """The curves of several files; what is said of several is said once.

    Raises:
        DataError: a (specimen, trial) comes twice.
    """
    seen: dict[tuple[str, str], str] = {}
    for part in parts:
        for curve in (*part.curves, *(b for b in part.bad if b.trial != WHOLE_FILE)):
            key = (curve.specimen, curve.trial)
            if key in seen:
                raise DataError(
                    f"specimen {key[0]!r} trial {key[1]!r} was already in {seen[key]}",
                    place=curve.source,
                    cure="rename one, or give a specimen pattern that tells files apart",
                )
            seen[key] = curve.source
    curves, bad, files, notes = (
        tuple(itertools.chain.from_iterable(getattr(part, name) for part in parts))
        for name in ("curves", "bad", "files", "notes")
    )
    return Measurements(curves, bad, files, tuple(dict.fromkeys(notes)))


def write_hdf5(
    path: Path | str,
    measurements: Measurements,
    *,
    attrs: Mapping[str, str | int | float] | None = None,
    overwrite: bool = False,
) -> None:
    """Write the usable curves in the project's own HDF5 schema; bad ones are not written.

    The file is written beside its place and then moved there, so it is complete or absent.

    Args:
        attrs: further root attributes, such as licence and source.
        overwrite: replace an existing file.

    Raises:
        FileExistsError: `path` exists and `overwrite` is False.
        ValueError: `attrs` sets the schema; a name is empty, unprintable or longer than 1024 bytes;
            a (specimen, trial) comes twice; there are more numbers than are read back.
    """
    write_curves(Path(path), measurements.curves, dict(attrs or {}), overwrite)


def _notes(records: Records) -> list[str]:
    """How tables were read, and which columns were not, without the file: said once of many."""
    said = [*dict.fromkeys(n for r in records if isinstance(r, RawCurve) for n in r.notes)]
    names = dict.fromkeys(n for r in records if isinstance(r, RawCurve) for n in r.unused_columns)
    if not names:
        return said
    shown = ", ".join(repr(name) for name in [*names][:_COLUMNS])
    more = f" and {len(names) - _COLUMNS} more" if len(names) > _COLUMNS else ""
    return [
        *said,
        f"columns without a role are not read: {shown}{more}; data.columns gives them one",
    ]


def _check_file(path: Path) -> None:
    if not path.exists():
        raise DataError(
            "no such file",
            place=str(path),
            cure="check the path",
        )
    if not path.is_file():
        what = "a folder, so is no file" if path.is_dir() else "a device or a pipe, so is no file"
        raise DataError(
            f"is {what}",
            place=str(path),
            cure="list files with curves instead",
        )


def _read_file(path: Path, options: ReadOptions) -> tuple[Records, list[str]]:
    """What one file holds, and what should be said of it."""
    asked = reader_of(options.format)
    head = first_bytes(path, HEAD)
    for reader in READERS if asked is None else (asked,):
        if reader.read is not None and reader.is_file(head):
            return reader.read(path, options), []
    named_hdf5 = path.suffix.lower() in (".h5", ".hdf5")
    found = "hdf5" if named_hdf5 and asked is None else kind_of(path)
    if found == "hdf5" and asked is None:
        asked = _recognise_hdf5(path)
    if found == "afm" and asked is None:
        asked = AFMFORMATS
    if found != "xlsx" and asked is not None and asked.read is not None:
        return asked.read(path, options), []
    if found == "xlsx" and (asked is None or asked.read_text is not None):
        return _read_workbook(path, asked, options)
    if found != "text":
        kinds = {"hdf5": "HDF5", "afm": "a file of an atomic force microscope"}
        what = kinds.get(found, "a workbook (xlsx)")
        raise DataError(
            f"is {what}, but data.format is {options.format!r}",
            place=str(path),
            cure="remove data.format",
        )
    text = Text(path, to_utf8(path, read_bytes(path)))
    reader = asked or _recognise(text, READERS, options)
    if reader.read_text is not None:
        return reader.read_text(text, options), []
    assert reader.read is not None
    return reader.read(path, options), []


def _read_workbook(
    path: Path, asked: Reader | None, options: ReadOptions
) -> tuple[Records, list[str]]:
    """The curves of the sheets that are meant, and which sheet was read if nobody chose several."""
    texts, sheets = read_sheets(path, options.sheet)
    others = listed([name for name in sheets if name not in {text.sheet for text in texts}])
    hint = f", or choose another sheet with data.sheet ({others})" if others else ""
    of_text = [r for r in READERS if r.read_text is not None]
    records: Records = []
    for text in texts:
        reader = asked or _recognise(text, of_text, options)
        assert reader.read_text is not None
        try:
            found = reader.read_text(text, options)
        except DataError as error:
            raise DataError.like(error, cure=error.cure + hint) from None
        records += [
            dataclasses.replace(r, cure=r.cure + hint)
            if isinstance(r, BadCurve) and r.kind in _OF_THE_SHEET
            else r
            for r in found
        ]
    if options.sheet is not None and len(texts) > 1:
        others = ""
    read = ", ".join(repr(text.sheet) for text in texts)
    note = f"{path}: sheet {read} was read, not {others}; data.sheet chooses another"
    return records, [note] if others else []


def _recognise(text: Text, readers: Sequence[Reader], options: ReadOptions) -> Reader:
    """Format of a text by its lines; the last reader takes any."""
    return next(reader for reader in readers if reader.is_text(text, options))


def _recognise_hdf5(path: Path) -> Reader:
    with opened(path, audit=False) as file:
        for reader in READERS:
            if reader.is_hdf5(file):
                return reader
    layouts = sorted((r.layout for r in READERS if r.layout), reverse=True)
    raise DataError(
        "HDF5 of no known layout",
        place=str(path),
        cure=f"expected {', or '.join(layouts)}",
    )
