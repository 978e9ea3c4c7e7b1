"""Tables on the terminal: what is too wide goes below, and nothing is cut without an ellipsis."""

import dataclasses
from collections.abc import Iterator, Sequence

from rich import box
from rich.console import Console, ConsoleOptions
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

#: Columns that say what a row is; repeated where a table goes on below.
KEYS = ("specimen", "trial", "curve", "parameter", "model", "row", "level", "effect")


@dataclasses.dataclass(frozen=True)
class WideTable:
    """A table that breaks lines between words only, and breaks off between columns.

    Where the terminal is too narrow for all columns, the table is shown in parts, one below the
    other, each with the first columns that are among `KEYS`. A word that is wider than a column may
    become ends with an ellipsis.

    Attributes:
        title: above it.
        head: names of the columns.
        rows: plain text; line breaks count as spaces.
        text: names of columns set to the left, besides the first.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text: tuple[str, ...] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        """The parts that fit."""
        keys = self._keys()
        # Each column that stands before others leaves them half of the line, but a word of 8.
        widest = max(8, (options.max_width - 2) // (len(keys) + 1) - 1)
        rest = [i for i in range(len(self.head)) if i not in keys]
        part, first = list(keys), True
        for i in rest:
            grown = self._part([*part, i], widest, first)
            wide = Measurement.get(console, options.update(width=10_000), grown).minimum
            if wide > options.max_width and len(part) > len(keys):
                yield self._part(part, widest, first)
                part, first = list(keys), False
            part.append(i)
        yield self._part(part, widest, first)

    def _keys(self) -> list[int]:
        found = []
        for i, name in enumerate(self.head):
            if name not in KEYS:
                break
            found.append(i)
        return found or [0]

    def _part(self, columns: Sequence[int], widest: int, first: bool) -> Table:
        title = self.title if first else f"{self.title} (continued)"
        table = Table(
            title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
        )
        cells = [[_short(row[i], widest) for i in columns] for row in self.rows]
        for k, i in enumerate(columns):
            name = self.head[i]
            words = " ".join([name, *(row[k] for row in cells)]).split()
            side = "left" if i == 0 or name in self.text else "right"
            table.add_column(
                Text(name), justify=side, min_width=max(map(len, words)), overflow="ellipsis"
            )
        for row in cells:
            table.add_row(*map(Text, row))
        return table


def _short(cell: str, widest: int) -> str:
    """The words of a cell, none wider than `widest`."""
    words = ("".join(c if c.isprintable() else " " for c in cell)).split()
    return " ".join(w if len(w) <= widest else f"{w[: widest - 1]}…" for w in words)


def wide_table(title: str, head, rows, text: tuple[str, ...] = ()) -> WideTable:
    """A table; an only specimen's name goes into the title.

    Args:
        title: above it.
        head: names of the columns.
        rows: of text.
        text: columns set to the left, besides the first.
    """
    if head[0] == "specimen" and len(rows) > 0 and len({row[0] for row in rows}) == 1:
        name = _short(rows[0][0], 60)
        title, head, rows = f"{title}: {name}", head[1:], [row[1:] for row in rows]
    return WideTable(title, tuple(head), tuple(tuple(row) for row in rows), text)
