"""A table in a text: its header, and its rows by pandas in columns of numbers or of text.

The lines of the header are looked at one by one. Of the rows only those that are odd are: without
the right number of delimiters, with quotes or a comment. All others go to pandas as they are, which
makes a column of numbers where every cell is one; `cells.numbers` decides about the others.
"""

import csv
import importlib
import io
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.measurements.curve import Fault, ReadOptions
from jaxtrachea.measurements.readers.cells import may_be_grouped, numbers, seconds
from jaxtrachea.measurements.readers.column_roles import (
    WEIGHTS,
    name_and_unit,
    resolve_unit,
    time_column,
)
from jaxtrachea.measurements.roles import role_dimension
from jaxtrachea.units import convert, is_unit

#: Bytes and lines in which a header is looked for.
HEAD_BYTES, HEAD_LINES = 2**20, 2000
#: What spreadsheets write in place of a number; a line that starts so is no comment.
CELL_ERRORS = ("#N/A", "#NV", "#REF!", "#VALUE!", "#DIV/0!", "#NUM!", "#NAME?", "#NULL!")
#: Delimiters in the order in which they are tried.
DELIMITERS = "\t;,"
_SEPARATOR = re.compile(r'\s*"?sep=.?"?\s*', re.IGNORECASE)
_NUMBER = re.compile(r"[+\-\u2212]?(?:\d+(?:[.,]\d*)*|[.,]\d+)(?:[eE][+-]?\d+)?")


class Line(NamedTuple):
    """One line of a text file or row of a sheet, and its number, counted from 1."""

    number: int
    text: str


@dataclass(frozen=True)
class Text:
    """A text file, or a sheet whose rows are lines separated by tabs.

    Attributes:
        path: the file.
        data: in UTF-8 with Unix line ends, as `text_file.to_utf8` gives it.
        sheet: name of the sheet, None for a text file.
        trial: name of the trial where neither the table nor the name of the file says it.
    """

    path: Path
    data: bytes
    sheet: str | None = None
    trial: str = "1"

    @property
    def place(self) -> str:
        """The file, and the sheet if it has any, for messages."""
        return str(self.path) if self.sheet is None else f"{self.path} sheet {self.sheet!r}"

    @property
    def word(self) -> str:
        """What its lines are called."""
        return "line" if self.sheet is None else "row"

    @cached_property
    def head(self) -> list[Line]:
        """The first lines that hold something."""
        texts = self.data[:HEAD_BYTES].split(b"\n", HEAD_LINES)[:HEAD_LINES]
        lines = (Line(i, text.decode(errors="replace")) for i, text in enumerate(texts, 1))
        return [line for line in lines if line.text.strip()]

    @cached_property
    def lines(self) -> list[Line]:
        """The first lines that hold something and are no comments."""
        return [line for line in self.head if not is_comment(line.text)]

    def with_tabs(self, blanks: int) -> "Text":
        """Tabs in place of so many blanks or more; a unit in brackets stays at its name."""
        data = b"\n".join(line.strip(b" \t") for line in self.data.split(b"\n"))
        if blanks == 1:
            data = re.sub(rb"(?<![ \t])[ \t]+(?=[\[(])", b"", data)
        return Text(self.path, re.sub(rb"[ \t]{%d,}" % blanks, b"\t", data), self.sheet, self.trial)


class Header(NamedTuple):
    """The line with the names of the columns.

    Attributes:
        names: of the columns, without units.
        units: of the columns, None where the header gives none.
        line: its number; 0 if there is none and columns are numbered.
        delimiter: what separates cells.
        first: number of the line below it, and below a row of units.
    """

    names: list[str]
    units: list[str | None]
    line: int
    delimiter: str
    first: int


def is_comment(text: str) -> bool:
    """Whether a line is a ``#`` comment, or only ``sep=;``, which a spreadsheet puts above a table.

    ``#N/A`` and the like are its cells.
    """
    text = text.lstrip()
    if text.startswith("#"):
        return not text.upper().startswith(CELL_ERRORS)
    return _SEPARATOR.fullmatch(text) is not None


def is_number(cell: str) -> bool:
    """Whether a cell looks like a number, in whatever notation."""
    return _NUMBER.fullmatch(cell) is not None


def split_cells(text: str, delimiter: str) -> list[str]:
    """Cells of one line, stripped; quotes as in CSV.

    Raises:
        Fault: an unbalanced quote.
    """
    if '"' not in text:
        return [cell.strip() for cell in text.split(delimiter)]
    try:
        rows = list(csv.reader([text], delimiter=delimiter, strict=True, skipinitialspace=True))
    except csv.Error as error:
        raise Fault(
            "unparsable", f"quotes do not match ({error})", "close every quote on its line"
        ) from None
    return [cell.strip() for cell in rows[0]]


def header_cells(text: str, delimiter: str) -> list[str]:
    """Cells of a line without empty ones at its end; none where quotes do not match."""
    try:
        cells = split_cells(text, delimiter)
    except Fault:
        return []
    while cells and not cells[-1]:
        cells.pop()
    return cells


def guess_delimiter(header: str) -> str:
    """Tab, semicolon or comma, whichever comes first in that order."""
    return next((d for d in "\t;" if d in header), ",")


def header_at(lines: Sequence[Line], at: int, delimiter: str) -> Header | None:
    """The header in a line, with a row of units below it; None: no cells, or odd quotes."""
    cells = header_cells(lines[at].text, delimiter)
    if not cells:
        return None
    names, units = map(list, zip(*map(name_and_unit, cells), strict=True))
    last, units = _units_below(lines, at, delimiter, units)
    return Header(names, units, lines[at].number, delimiter, lines[last].number + 1)


def _units_below(
    lines: Sequence[Line], at: int, delimiter: str, units: list[str | None]
) -> tuple[int, list[str | None]]:
    """Some machines put units in a row of their own below the names, ``(s),(mm),(N)``.

    It is known by cells that are units, in brackets or not, and by none that is a number.
    """
    cells = header_cells(lines[at + 1].text, delimiter) if at + 1 < len(lines) else []
    if not cells or len(cells) > len(units) or any(map(is_number, cells)):
        return at, units
    bare = [cell.strip("()[] ") for cell in cells] + [""] * (len(units) - len(cells))
    known = [is_unit(b) for b in bare]
    telling = any(k and b not in ("-", "%") for k, b in zip(known, bare, strict=True))
    bracketed = all(cell[:1] in ("(", "[") for cell in cells if cell)
    # One cell that is a unit by chance, as a specimen "h", does not make a row of units.
    if not bracketed and not (telling and 2 * sum(known) >= sum(map(bool, bare))):
        return at, units
    below = [b if k or bracketed else None for b, k in zip(bare, known, strict=True)]
    return at + 1, [unit or under or None for unit, under in zip(units, below, strict=True)]


def likely_header(lines: Sequence[Line]) -> Header | None:
    """The first line above a row of numbers of as many cells, whatever its names say."""
    for at in range(len(lines)):
        for delimiter in DELIMITERS:
            cells = header_cells(lines[at].text, delimiter) if delimiter in lines[at].text else []
            if len(cells) < 2 or any(map(is_number, cells)):
                continue
            found = header_at(lines, at, delimiter)
            first = found.first if found else 0
            below = next((line for line in lines[at + 1 :] if line.number >= first), None)
            row = header_cells(below.text, delimiter) if below else []
            if sum(map(is_number, row)) >= 2 and len(row) <= len(cells):
                return found
    return None


def numbered_columns(lines: Sequence[Line]) -> Header | None:
    """Columns 1, 2, ... of a table that begins without a header: two rows of as many numbers."""
    for at, line in enumerate(lines[:-1]):
        for delimiter in DELIMITERS:
            rows = [header_cells(other.text, delimiter) for other in lines[at : at + 2]]
            width = len(rows[0])
            if (
                width > 1
                and len(rows[1]) == width
                and all(all(map(is_number, row)) for row in rows)
            ):
                names = [str(i + 1) for i in range(width)]
                return Header(names, [None] * width, 0, delimiter, line.number)
    return None


@dataclass(frozen=True)
class Table:
    """A header and its rows.

    Attributes:
        text: where it comes from.
        header: of it.
        lines: (N,) number of each row.
        body: the rows as text, one a line, which pandas reads.
        notes: what a user should know of how it is read.
    """

    text: Text
    header: Header
    lines: np.ndarray
    body: bytes
    notes: list[str] = field(default_factory=list)
    _columns: dict = field(default_factory=dict)
    _texts: dict = field(default_factory=dict)
    _whole: set = field(default_factory=set)

    @property
    def names(self) -> list[str]:
        """Of the columns, without units."""
        return self.header.names

    def load(self, numbers: Collection[int], texts: Collection[int] = ()) -> None:
        """Read columns, by their places: those of numbers, and those of names."""
        decimal = "."
        if self.header.delimiter != "," and b"," in self.body and b"." not in self.body:
            decimal = ","
        frame = self._frame(numbers, texts, decimal)
        for i in texts:
            codes, distinct = importlib.import_module("pandas").factorize(frame[i].to_numpy())
            self._texts[i] = codes, [text.strip() for text in distinct]
        for i in numbers:
            kind = frame[i].dtype.kind
            if i in texts:
                codes, distinct = self._texts[i]
                self._columns[i] = [distinct[k] for k in codes]
            elif kind in "fiu":
                self._columns[i] = frame[i].to_numpy(np.float64)
                self._whole.update({i} if kind in "iu" else ())
            else:
                cells = frame[i].astype(object)
                self._columns[i] = [*map(str.strip, map(str, cells.where(cells.notna(), "")))]

    def _frame(self, numbers: Collection[int], texts: Collection[int], decimal: str) -> Any:
        pandas = importlib.import_module("pandas")
        wanted = sorted({*numbers, *texts})
        if not self.body or not wanted:
            return pandas.DataFrame(
                {i: np.zeros(0, object if i in texts else float) for i in wanted}
            )
        return pandas.read_csv(
            io.BytesIO(self.body),
            sep=self.header.delimiter,
            header=None,
            names=range(len(self.header.names)),
            usecols=wanted,
            dtype=dict.fromkeys(texts, object),  # "category" makes 1 of 01
            na_values=dict.fromkeys({*numbers} - {*texts}, [""]),
            keep_default_na=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
            decimal=decimal,
            quoting=csv.QUOTE_MINIMAL if b'"' in self.body else csv.QUOTE_NONE,
        )

    def names_of(self, i: int) -> tuple[np.ndarray, list[str]]:
        """A column of names: the place of each row's name, and the names."""
        return self._texts[i]

    def is_read(self, i: int) -> bool:
        """Whether all cells of a column are numbers."""
        return isinstance(self._columns[i], np.ndarray)

    def raw(self, i: int) -> np.ndarray | list[str]:
        """A column as it was read: numbers, or text where some cell is none."""
        return self._columns[i]

    def cells(self, i: int) -> list[str]:
        """A column as text."""
        found = self._columns[i]
        if not isinstance(found, list):
            found = [*map(str.strip, self._frame((), (i,), ".")[i])]
        return found

    def check_groups(self, places: Collection[int], starts: np.ndarray) -> None:
        """Read columns as text in which some curve may have thousands separators."""
        for i in {*places} - self._whole:
            if self.is_read(i) and self.lines.size and may_be_grouped(self._columns[i], starts):
                self._columns[i] = self.cells(i)

    def values(self, role: str, i: int, rows: slice, unit: str) -> np.ndarray:
        """Numbers of some rows of a role's column, in internal units (mm, N, rad, s).

        Raises:
            Fault: a cell is no number.
        """
        found = self._columns[i]
        if isinstance(found, np.ndarray):
            key = (i, unit)
            if key not in self._columns:
                self._columns[key] = convert(found, unit, role_dimension(role))
            return self._columns[key][rows]
        header = self.header
        where = self.lines[rows]
        read = numbers(found[rows], where, header.names[i], header.delimiter, self.text.word)
        return convert(read, unit, role_dimension(role))

    def time(self, roles: dict[str, int], options: ReadOptions, rows: slice) -> np.ndarray | None:
        """Time of some rows, s: of `columns.time`, else of the only column named so, if usable.

        Raises:
            Fault: the column named in the options, or the one that a whole record needs, has no
                unit or holds text.
        """
        column = time_column(self.names, self.header.units, roles, options)
        if column is None:
            return None
        i, unit = column
        if not self.is_read(i) and (clock := seconds(self.cells(i)[rows])) is not None:
            return clock - clock[0]
        if "time" in roles or options.loading == "record":
            unit = resolve_unit("time", unit, options, f"column {self.names[i]!r}")
            return self.values("time", i, rows, unit)
        if unit is None:
            return None
        try:
            values = self.values("time", i, rows, unit)
        except Fault:
            return None
        return values if np.isfinite(values).all() else None


def unit_of_role(role: str, table: Table, i: int, options: ReadOptions, place: str) -> str:
    """`column_roles.resolve_unit` of a column; grams are a force where a force is wanted.

    Raises:
        Fault: as there.
        DataError: as there.
    """
    found = table.header.units[i]
    if found in WEIGHTS and role_dimension(role) == "force":
        table.notes.append(
            f"column {table.names[i]!r} is in {found}: it is read as {WEIGHTS[found]}, the weight "
            f"of so many {found} (1 gf = 9.80665 mN)"
        )
        found = WEIGHTS[found]
    return resolve_unit(role, found, options, place)


def rows_below(text: Text, header: Header) -> Table:
    """The rows of a table; comments and empty lines are left out.

    Raises:
        Fault: a row has not as many cells as the header ("ragged"), or quotes do not match.
    """
    body = text.data[_start_of_line(text.data, header.first) :].rstrip(b"\n")
    if not body:
        return Table(text, header, np.zeros(0, np.int64), b"")
    data = np.frombuffer(body + b"\n", np.uint8)
    ends = np.flatnonzero(data == ord("\n"))
    starts = np.concatenate([[0], ends[:-1] + 1])
    kept = ends > starts
    odd = _is_odd(data, starts, ends, header, [c for c in '"#' if c.encode() in body])
    for i in np.flatnonzero(odd & kept).tolist():
        line = Line(header.first + i, body[starts[i] : ends[i]].decode(errors="replace"))
        kept[i] = _is_row(line, header, text.word)
    if not kept.all():
        body = data[np.repeat(kept, ends - starts + 1)].tobytes()
    return Table(text, header, header.first + np.flatnonzero(kept), body)


def _start_of_line(data: bytes, number: int) -> int:
    at = 0
    for _ in range(number - 1):
        at = data.find(b"\n", at) + 1
        if at == 0:
            return len(data)
    return at


def _is_odd(
    data: np.ndarray, starts: np.ndarray, ends: np.ndarray, header: Header, signs: Sequence[str]
) -> np.ndarray:
    """Lines that may be no rows: other numbers of cells, blanks before them, one of `signs`."""

    def count(character: str) -> np.ndarray:
        return np.diff(np.searchsorted(np.flatnonzero(data == ord(character)), ends), prepend=0)

    odd = count(header.delimiter) != len(header.names) - 1
    for sign in signs:
        odd |= count(sign) > 0
    first = data[starts]
    return odd | (first == ord(header.delimiter)) | (first == ord(" ")) | (first == ord("\t"))


def _is_row(line: Line, header: Header, word: str) -> bool:
    """Whether a line is a row, and no comment or empty."""
    if is_comment(line.text):
        return False
    try:
        cells = split_cells(line.text, header.delimiter)
    except Fault as fault:
        raise Fault(fault.kind, f"{word} {line.number}: {fault.message}", fault.cure) from None
    if not any(cells):
        return False
    width = len(header.names)
    while len(cells) > width and cells[-1] == "":
        cells.pop()
    if len(cells) == width:
        return True
    cure = "complete or remove the row"
    if word == "row" and len(cells) > width:
        cure = "clear the cells beside the table, or give their columns a header"
    elif header.delimiter == "," and len(cells) > width:
        cure += "; decimal commas need ; or tab between the columns"
    raise Fault(
        "ragged", f"{word} {line.number} has {len(cells)} cells, the header has {width}", cure
    )


def blocks_of(codes: Sequence[np.ndarray], count: int) -> Iterator[tuple[int, int]]:
    """First row, and that after the last, of rows that have the same codes in all columns."""
    changes = np.zeros(max(count - 1, 0), bool)
    for column in codes:
        changes |= column[1:] != column[:-1]
    edges = [0, *(np.flatnonzero(changes) + 1).tolist(), count]
    yield from zip(edges[:-1], edges[1:], strict=True)
