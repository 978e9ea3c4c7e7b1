"""Tables on the terminal: what is too wide goes below, and nothing is cut without an ellipsis."""

import dataclasses
from collections.abc import Iterator, Sequence

from rich import box
from rich.cells import cell_len, set_cell_size
from rich.console import Console, ConsoleOptions
from rich.table import Table
from rich.text import Text

from jaxtrachea.files import table as typed

#: Columns that say what a row is; repeated where a table goes on below.
KEYS = ("specimen", "trial", "curve", "parameter", "model", "row", "level", "effect")


#: Characters of a line from which on more than one column is repeated.
_NARROW = 40


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
        keys, room = self._keys(options.max_width), options.max_width
        # Columns that are repeated leave the others half of the line.
        short = max(4, room // (2 * len(keys)) - 1)
        rest = room - _frame(len(keys) + 1) - sum(self._least(i, short) for i in keys)
        widest = [short if i in keys else max(4, rest) for i in range(len(self.head))]
        part, first = list(keys), True
        for i in range(len(self.head)):
            if i in keys:
                continue
            if not self._fits([*part, i], widest, room) and len(part) > len(keys):
                yield self._part(part, widest, room, first)
                part, first = list(keys), False
            part.append(i)
        yield self._part(part, widest, room, first)

    def _keys(self, room: int) -> list[int]:
        """Columns that are repeated; the first alone where the terminal is very narrow."""
        found = []
        for i, name in enumerate(self.head):
            if name not in KEYS:
                break
            found.append(i)
        return (found if room >= _NARROW else found[:1]) or [0]

    def _cells(self, i: int, widest: int) -> list[str]:
        return [_short(text, widest) for text in (self.head[i], *(row[i] for row in self.rows))]

    def _least(self, i: int, widest: int) -> int:
        """Width of the longest word of a column."""
        return max(cell_len(word) for word in " ".join(self._cells(i, widest)).split() or [""])

    def _fits(self, columns: Sequence[int], widest: Sequence[int], room: int) -> bool:
        return sum(self._least(i, widest[i]) for i in columns) + _frame(len(columns)) <= room

    def _part(self, columns: Sequence[int], widest: Sequence[int], room: int, first: bool) -> Table:
        title = self.title if first else f"{self.title} (continued)"
        table = Table(
            title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
        )
        cells = [self._cells(i, widest[i]) for i in columns]
        least = [self._least(i, widest[i]) for i in columns]
        width = [max(map(cell_len, column)) for column in cells]
        over = sum(width) + _frame(len(columns)) - room
        while over > 0 and width != least:  # the column that can spare most goes first
            k = max(range(len(width)), key=lambda k: width[k] - least[k])
            width[k] -= 1
            over -= 1
        for i, column, wide in zip(columns, cells, width, strict=True):
            side = "left" if i == 0 or self.head[i] in self.text else "right"
            table.add_column(Text(column[0]), justify=side, width=wide, overflow="ellipsis")
        for row in zip(*(column[1:] for column in cells), strict=True):
            table.add_row(*map(Text, row))
        return table


def _frame(columns: int) -> int:
    """What edges, padding and lines between columns take."""
    return 2 * columns + 1


def _short(cell: str, widest: int) -> str:
    """The words of a cell, none wider than `widest`."""
    words = ("".join(c if c.isprintable() else " " for c in cell)).split()
    return " ".join(
        w if cell_len(w) <= widest else f"{set_cell_size(w, widest - 1).rstrip()}…" for w in words
    )


def wide_table(table: typed.Table) -> WideTable:
    """A table; an only specimen's name goes into the title."""
    title, head, rows = table.title, table.head, table.cells
    left = tuple(column.head for column in table.columns if column.left)
    if head[0] == "specimen" and len(rows) > 0 and len({row[0] for row in rows}) == 1:
        name = _short(rows[0][0], 60)
        title, head, rows = f"{title}: {name}", head[1:], [row[1:] for row in rows]
    return WideTable(title, tuple(head), tuple(tuple(row) for row in rows), left)
