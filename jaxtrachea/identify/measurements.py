"""Measured force-displacement curves: the data model and the one door through which files come in.

Everything past this door is in mm, N, rad, float64 on the host. One bad curve costs only itself: it
comes back as a `BadCurve` with its reason, and only what spoils a whole file or study raises
`DataError`. The formats are described in docs/measurements.md.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtrachea.identify.readers import afmformats, csv, hdf5, machine_csv
from jaxtrachea.identify.readers.checks import finish
from jaxtrachea.identify.readers.records import (
    BadCurve,
    Curve,
    DataError,
    Fault,
    ReadOptions,
)
from jaxtrachea.identify.readers.safe_hdf5 import opened
from jaxtrachea.identify.readers.text import (
    ALIASES,
    guess_delimiter,
    is_comment,
    read_lines,
    split_cells,
)
from jaxtrachea.units import column_unit

__all__ = [
    "BadCurve",
    "Curve",
    "DataError",
    "Measurements",
    "ReadOptions",
    "read_measurements",
    "write_hdf5",
]

_READERS = {
    "tidy": csv.read,
    "machine": machine_csv.read,
    "hdf5": hdf5.read,
    "afmformats": afmformats.read,
}


@dataclass(frozen=True, eq=False)
class Measurements:
    """The curves of a study.

    Attributes:
        curves: usable curves, in the order of the files and within them.
        bad: what could not be used, in the same order.
        files: the files read.
    """

    curves: tuple[Curve, ...]
    bad: tuple[BadCurve, ...]
    files: tuple[Path, ...]

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
    paths: Sequence[Path | str], options: ReadOptions | None = None
) -> Measurements:
    """Read measured curves from files of one study.

    Args:
        paths: the files, at least one.
        options: how to read them; by default by content.

    Returns:
        Usable curves and bad ones, in mm, N, rad.

    Raises:
        DataError: a file is missing, unreadable, hostile or of no known format, its table is
            malformed, or a (specimen, trial) comes twice.
    """
    options = options or ReadOptions()
    if isinstance(paths, (str, bytes)) or not paths:
        raise DataError(f"paths is {paths!r}; expected a list of at least one file")
    files = tuple(Path(path) for path in paths)
    curves: list[Curve] = []
    bad: list[BadCurve] = []
    seen: dict[tuple[str, str], str] = {}
    for path in files:
        kind = options.format if options.format != "auto" else None
        _check_file(path)
        for record in _READERS[kind or _sniff(path)](path, options):
            key = (record.specimen, record.trial)
            if key in seen:
                raise DataError(
                    f"{record.source}: specimen {key[0]!r} trial {key[1]!r} was already in"
                    f" {seen[key]}; rename one, or give a specimen pattern that tells files apart"
                )
            seen[key] = record.source
            done = record if isinstance(record, BadCurve) else finish(record, options)
            if isinstance(done, BadCurve):
                bad.append(done)
            else:
                curves.append(done)
    return Measurements(tuple(curves), tuple(bad), files)


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
        path: the file to write.
        measurements: the curves.
        attrs: further root attributes, such as licence and source.
        overwrite: replace an existing file.

    Raises:
        FileExistsError: `path` exists and `overwrite` is False.
        ValueError: `attrs` sets the schema, or a (specimen, trial) comes twice.
    """
    hdf5.write(Path(path), measurements.curves, dict(attrs or {}), overwrite)


def _check_file(path: Path) -> None:
    if not path.exists():
        raise DataError(f"{path}: no such file; check the path")
    if not path.is_file():
        raise DataError(f"{path}: is no file; list the files in it instead")


def _sniff(path: Path) -> str:
    """Format of a file by its content."""
    with path.open("rb") as stream:
        magic = stream.read(8)
    if magic == b"\x89HDF\r\n\x1a\n" or path.suffix.lower() in (".h5", ".hdf5"):
        return _sniff_hdf5(path)
    lines = read_lines(path)
    if any("BEGIN METADATA" in line.text for line in lines[:10]):
        return "afmformats"
    content = [line.text for line in lines if not is_comment(line)]
    if not content:
        return "machine"
    if content[0].lstrip().startswith("{"):
        return "tidy"
    try:
        cells = split_cells(content[0], guess_delimiter(content[0]))
    except Fault:
        return "machine"
    names = {column_unit(cell)[0].lower() for cell in cells}
    return "tidy" if names & set(ALIASES["specimen"]) else "machine"


def _sniff_hdf5(path: Path) -> str:
    with opened(path, audit=False) as file:
        if "schema" in file.attrs:
            return "hdf5"
        if any(name.isdecimal() for name in file):
            return "afmformats"
    raise DataError(
        f"{path}: HDF5 of no known layout; expected root attribute schema ="
        f' "{hdf5.SCHEMA}", or groups 0, 1, ... of afmformats'
    )
