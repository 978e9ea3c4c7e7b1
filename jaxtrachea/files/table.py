"""One table for files and people: rows of typed cells, and columns that say how people see them.

A cell is a number, a word, a flag, a pair of ends or an `Interval`; what is not there is None or
NaN. CSV and HDF5 have all cells of the rows, exactly; Markdown, text, HTML and terminal
(`cli.terminal_table`) have the columns, with unit, digits and the text for what is not there.

A cell of a CSV file that a spreadsheet would run as a formula is written behind an apostrophe, as
OWASP recommends ("CSV injection", https://owasp.org/www-community/attacks/CSV_Injection);
`unquoted` takes it away again.
"""

import csv
import dataclasses
import html
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

#: Cells by name.
Row = Mapping[str, object]
#: What spreadsheets take for the start of a formula, full-width forms included.
FORMULA = "=+-@\t\r\n＝＋－＠"
_STARTS = re.compile(f"'*[{re.escape(FORMULA)}]")
_QUOTED = re.compile(f"'+[{re.escape(FORMULA)}]")


class Interval(NamedTuple):
    """A cell with two ends, of which the open ones are left out.

    Attributes:
        low: lower end; open at -inf, of a positive number (scale `log`) at 0.
        high: upper end; open at inf.
        log: whether the number is positive.
    """

    low: float
    high: float
    log: bool = False


@dataclasses.dataclass(frozen=True)
class Column:
    """How people see one cell of each row.

    Attributes:
        head: of the column.
        cell: name of the cell, or what makes it of the row; None: the cell called as the head.
        unit: after a number; "%": in per cent.
        digits: significant ones of a number that is no count.
        decimals: digits after the point, in the place of `digits`.
        null: for what is not there.
        left: set to the left on the terminal, as the first column is.
    """

    head: str
    cell: str | Callable[[Row], object] | None = None
    unit: str = ""
    digits: int = 4
    decimals: int | None = None
    null: str = "–"
    left: bool = False

    def of(self, row: Row) -> object:
        """The cell of a row."""
        return self.cell(row) if callable(self.cell) else row.get(self.cell or self.head)

    def text(self, row: Row) -> str:
        """The cell of a row for people."""
        cell: Any = self.of(row)
        if isinstance(cell, Interval):
            return self._interval(cell)
        if isinstance(cell, tuple):
            return " … ".join(map(self._number, cell))
        if isinstance(cell, float):
            text = self._number(cell)
            return f"{text} {self.unit}" if self.unit and text != self.null else text
        return self.null if cell is None else str(cell)

    def _number(self, value: float) -> str:
        if math.isnan(value):
            return self.null
        value = 100 * value if self.unit == "%" else value
        return f"{value:.{self.digits}g}" if self.decimals is None else f"{value:.{self.decimals}f}"

    def _interval(self, ends: Interval) -> str:
        open_low, open_high = ends.low == (0 if ends.log else -math.inf), ends.high == math.inf
        if open_low and open_high:
            return "anything"
        if open_low or open_high:
            end = self._number(ends.high if open_low else ends.low)
            return f"up to {end}" if open_low else f"from {end}"
        if math.isnan(ends.low) and math.isnan(ends.high):
            return self.null
        return f"{self._number(ends.low)} … {self._number(ends.high)}"


class Table(Sequence):
    """Rows with cells by name, and the columns that people see.

    Attributes:
        rows: mappings, one a row; they need not have the same cells.
        columns: for people.
        title: above it.
        more: what is said below it of rows that it does not have; "" if it has all.
    """

    def __init__(
        self,
        rows: Iterable[Row],
        columns: Sequence[Column] | None = None,
        *,
        title: str = "",
        more: str = "",
    ):
        """Rows as they are shown, in order; without columns each cell is one."""
        self.rows = list(rows)
        self._columns = None if columns is None else list(columns)
        self.title, self.more = title, more

    @property
    def names(self) -> list[str]:
        """Names of the cells of all rows in the order in which they first come."""
        return list(dict.fromkeys(name for row in self.rows for name in row))

    @property
    def columns(self) -> list[Column]:
        """For people."""
        return [Column(name) for name in self.names] if self._columns is None else self._columns

    @property
    def head(self) -> list[str]:
        """Heads for people."""
        return [column.head for column in self.columns]

    @property
    def cells(self) -> list[list[str]]:
        """Text of every cell for people, row by row."""
        columns = self.columns
        return [[column.text(row) for column in columns] for row in self.rows]

    def column(self, name: str) -> list[object]:
        """One cell of every row; None where a row has none of this name.

        Raises:
            KeyError: no row has it; the names are given.
        """
        if name not in self.names:
            raise KeyError(f"no column {name!r}; expected one of {', '.join(self.names)}")
        return [row.get(name) for row in self.rows]

    def first(self, count: int, more: str = "and {} more") -> "Table":
        """The first rows, and how many are left out."""
        left = len(self.rows) - count
        more = more.format(left) if left > 0 else self.more
        return Table(self.rows[:count], self._columns, title=self.title, more=more)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def __getitem__(self, index):
        """A row, or a table of several."""
        if isinstance(index, slice):
            return Table(self.rows[index], self._columns, title=self.title)
        return self.rows[index]

    def __iter__(self) -> Iterator[Row]:
        """The rows."""
        return iter(self.rows)

    def __repr__(self) -> str:
        """Aligned text: numbers to the right, words to the left."""
        head, body = self.head, self.cells
        if not body:
            return "(no rows)"
        width = [max(map(len, column)) for column in zip(head, *body, strict=True)]
        right = [all(_is_number(c.of(row)) for row in self.rows) for c in self.columns]
        lines = [
            "  ".join(
                cell.rjust(w) if r else cell.ljust(w)
                for cell, w, r in zip(line, width, right, strict=True)
            ).rstrip()
            for line in (head, *body)
        ]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The same for a notebook, escaped."""
        line = "<tr>{}</tr>".format
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.head)
        rows = ("".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in self.cells)
        body = "".join(map(line, rows))
        return f"<table><thead>{line(head)}</thead><tbody>{body}</tbody></table>"

    def markdown(self) -> str:
        """As a Markdown table."""

        def line(cells):
            plain = (" ".join(str(cell).split()).replace("|", "\\|") for cell in cells)
            return f"| {' | '.join(plain)} |"

        return "\n".join([line(self.head), line(["---"] * len(self.head)), *map(line, self.cells)])

    def paragraphs(self) -> list[str]:
        """Of a report: as a Markdown table, and what it does not have."""
        return [self.markdown(), *([f"{self.more}."] if self.more else [])]

    def write_csv(self, path: Path) -> None:
        """As `write_csv`."""
        write_csv(path, self.rows)

    def write_hdf5(self, group: Any) -> None:
        """Write each cell as a dataset of an h5py group; words as text, None of a number as NaN."""
        import h5py

        for name in self.names:
            cells = self.column(name)
            if any(isinstance(cell, str) for cell in cells):
                words = ["" if cell is None else str(cell) for cell in cells]
                group.create_dataset(name, data=words, dtype=h5py.string_dtype())
            else:
                group[name] = [math.nan if cell is None else cell for cell in cells]


class _Lines(list[str]):
    """Lines, as a file that they are written to."""

    write = list.append


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Write all cells; what is not there is empty, NaN of a number `nan`, formulas quoted.

    A row is kept as its line: names that come later stand behind those that are known.

    Args:
        path: of the file.
        rows: asked for one after the other.
    """
    names: dict[str, None] = {}
    lines, known = _Lines(), []
    writer = csv.writer(lines)
    for row in rows:
        names |= dict.fromkeys(row)
        known.append(len(names))
        writer.writerow(quoted(row.get(name)) for name in names)
    writer.writerow(map(quoted, names))
    head = lines.pop()
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.write(head)
        for n, line in zip(known, lines, strict=True):
            more = len(names) - max(n, 1)
            stream.write(line[:-2] + "," * more + line[-2:])


def ends(low: str, high: str) -> Callable[[Row], object]:
    """Cell of a `Column`: two cells of its row; None where the first is not there."""

    def of(row: Row) -> object:
        pair: Any = row[low], row[high]
        return None if None in pair or all(map(math.isnan, pair)) else pair

    return of


def words(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], left=()) -> Table:
    """A table for people alone, of text."""
    columns = [Column(name, str(i), left=name in left) for i, name in enumerate(head)]
    return Table(({str(i): v for i, v in enumerate(row)} for row in rows), columns, title=title)


def number(value: float, digits: int = 4) -> str:
    """A number in a sentence: `digits` significant ones, a dash for NaN."""
    return Column("", "", digits=digits).text({"": float(value)})


def quoted(cell: object) -> object:
    """The cell, behind an apostrophe if it is text that starts a formula; numbers as they are.

    Apostrophes before such a character count as part of it, so that `unquoted` undoes this always.
    """
    return f"'{cell}" if isinstance(cell, str) and _STARTS.match(cell) else cell


def unquoted(text: str) -> str:
    """The text that `quoted` was given."""
    return text[1:] if _QUOTED.match(text) else text


def _is_number(cell: object) -> bool:
    return isinstance(cell, (int, float)) and not isinstance(cell, bool)
