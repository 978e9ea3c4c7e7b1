"""The columns of a data file: their names, units and roles, before and beside the curves."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxtrachea.measurements.curve import Fault, ReadOptions
from jaxtrachea.measurements.observed import OBSERVED, RING_NUMBERS, RINGS
from jaxtrachea.measurements.readers import READERS
from jaxtrachea.measurements.readers.afmformats import AFMFORMATS, SI_UNITS, load
from jaxtrachea.measurements.readers.column_roles import find_roles, time_column
from jaxtrachea.measurements.readers.hdf5 import limits_of
from jaxtrachea.measurements.readers.hdf5_values import unit_of
from jaxtrachea.measurements.readers.machine_header import MAX_PREAMBLE, find_header
from jaxtrachea.measurements.readers.recognise import kind_of
from jaxtrachea.measurements.readers.safe_hdf5 import opened
from jaxtrachea.measurements.readers.table import Header, Line, Text, likely_header
from jaxtrachea.measurements.readers.text_file import GZIP, first_bytes, first_unpacked, to_utf8
from jaxtrachea.measurements.readers.workbook import read_sheets

#: Bytes of a text in which its header is looked for.
HEAD_BYTES = 2**18
#: Roles of datasets by their names in the project's own HDF5 files, where they differ.
_STORED = {
    "s_c": "s", "phi_c": "phi", **{q.name: q.role for q in OBSERVED},
    **{RING_NUMBERS[field]: of_rings[0].role for field, of_rings in RINGS.items()},
}  # fmt: skip
_OF_AFM = {"force": "force", "height (measured)": "displacement", "tip position": "displacement",
           "segment": "segment"}  # fmt: skip


class Column(NamedTuple):
    """A column of a table, or a dataset of an HDF5 file.

    Attributes:
        name: without its unit.
        unit: as the file writes it; None: the file gives none.
        role: what it is read as (`roles.ROLES`, or that of a ring); "": it is not read.
    """

    name: str
    unit: str | None
    role: str = ""


class Head(NamedTuple):
    """What a file says of its columns.

    Attributes:
        format: name of the reader, as `data.format` takes it.
        columns: in the order of the file; empty where no header was found.
        ambiguous: why no role is certain, in a sentence; "" if they are.
    """

    format: str
    columns: tuple[Column, ...]
    ambiguous: str = ""

    @property
    def is_table(self) -> bool:
        """Whether `data.columns` may name its columns freely."""
        return self.format in ("tidy", "machine")


def head_of(path: Path, options: ReadOptions) -> Head:
    """The columns of a file; its rows are not read.

    Raises:
        DataError: it cannot be read, is damaged, hostile, or no data file at all.
    """
    kind = "hdf5" if path.suffix.lower() in (".h5", ".hdf5") else kind_of(path)
    if kind == "hdf5":
        with opened(path, limits=limits_of) as file:
            return _stored(file)
    if kind == "afm":
        held = {name: SI_UNITS.get(name) or None for name in load(path)[0].columns}
        return Head(AFMFORMATS.name, _columns(held, _OF_AFM))
    if kind == "xlsx":
        text = read_sheets(path, options.sheet)[0][0]
    else:
        text = Text(path, to_utf8(path, _beginning(path)))
    if options.format == "auto":
        found = next(r for r in READERS if r.is_text(text, options)).name
    else:
        found = options.format
    if found == AFMFORMATS.name:
        return Head(found, tuple(_of_tab(text.head)))
    return _of_table(found, text, options)


def _beginning(path: Path) -> bytes:
    """The first whole lines of a text, packed or not."""
    packed = first_bytes(path, 2) == GZIP
    data = (first_unpacked if packed else first_bytes)(path, HEAD_BYTES)
    return data if len(data) < HEAD_BYTES else data[: data.rfind(b"\n") + 1]


def _of_table(found: str, text: Text, options: ReadOptions) -> Head:
    """The header that its reader finds; else the first line above a row of as many numbers."""
    try:
        header = find_header(text, options)[0].header
    except Fault:
        header = None
    header = header or _likely(text)
    return Head(found, ()) if header is None else _with_roles(found, header, options)


def _likely(text: Text) -> Header | None:
    """A header by its place; of a text whose columns blanks separate, too."""
    versions = (text, text.with_tabs(2), text.with_tabs(1))
    return next(filter(None, (likely_header(v.lines[:MAX_PREAMBLE]) for v in versions)), None)


def _with_roles(found: str, header: Header, options: ReadOptions) -> Head:
    names, units = header.names, header.units
    roles, ambiguous = {}, ""
    try:
        roles = find_roles(names, options, units)
        if "time" not in roles and (time := time_column(names, units, roles, options)):
            roles["time"] = time[0]
    except Fault as fault:
        ambiguous = f"{fault.message}; {fault.cure}"
    by_column = {i: role for role, i in roles.items()}
    columns = zip(names, units, strict=True)
    return Head(
        found, tuple(Column(n, u, by_column.get(i, "")) for i, (n, u) in enumerate(columns) if n),
        ambiguous,
    )  # fmt: skip


def _of_tab(lines: Sequence[Line]) -> Iterator[Column]:
    """Columns of a tab file of afmformats: the first comment below the metadata names them."""
    texts = [line.text.lstrip().removeprefix("#").strip() for line in lines]
    if "END METADATA" not in texts:
        return
    names = next(filter(None, texts[texts.index("END METADATA") + 1 :]), "").split("\t")
    for cell in names:
        # Version 0.13.3 hangs the first row on the last name.
        known = [name for name in SI_UNITS if cell.startswith(name)]
        name = max(known, key=len) if known else cell
        yield Column(name, SI_UNITS.get(name) or None, _OF_AFM.get(name, ""))
        if name != cell:
            return


def _stored(file: Any) -> Head:
    """Datasets of an HDF5 file, each name once."""
    if "schema" not in file.attrs:
        numbered = sorted(name for name in file if name.isdecimal())
        groups = [file[name] for name in numbered[:1]]
        columns = {name: _unit(g, name) for g in groups if hasattr(g, "items") for name in g}
        roles = _OF_AFM
        if "tip position" in columns:
            roles = {**_OF_AFM, "height (measured)": ""}
        return Head("afmformats", _columns(columns, roles))
    columns: dict[str, str | None] = {}
    for group in (file.get(name) for name in ("curves", "samples")):
        if hasattr(group, "items"):
            columns |= {name: _unit(group, name) for name in sorted(group)}
    return Head("hdf5", _columns(columns, {name: _STORED.get(name, name) for name in columns}))


def _unit(group: Any, name: str) -> str | None:
    """Unit of a dataset; None where its attribute is damaged, which reading tells."""
    try:
        return unit_of(group, name) or None
    except Fault:
        return None


def _columns(units: dict[str, str | None], roles: dict[str, str]) -> tuple[Column, ...]:
    return tuple(Column(name, unit, roles.get(name, "")) for name, unit in units.items())
