"""Rows that print as a table, on a terminal and in a notebook."""

import html
import math
from collections.abc import Iterator, Sequence


class Table(Sequence):
    """Rows with the same keys, shown as an aligned table.

    Attributes:
        rows: dictionaries, one a row.
    """

    def __init__(self, rows: Sequence[dict[str, object]]):
        """Rows as they are shown, in order."""
        self.rows = list(rows)

    @property
    def columns(self) -> list[str]:
        """Keys of all rows in the order in which they first come."""
        return list(dict.fromkeys(key for row in self.rows for key in row))

    def column(self, name: str) -> list[object]:
        """One column; None where a row has no such cell.

        Raises:
            KeyError: no row has it; the columns are named.
        """
        if name not in self.columns:
            raise KeyError(f"no column {name!r}; expected one of {', '.join(self.columns)}")
        return [row.get(name) for row in self.rows]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def __getitem__(self, index):
        """A row, or a table of several."""
        return Table(self.rows[index]) if isinstance(index, slice) else self.rows[index]

    def __iter__(self) -> Iterator[dict[str, object]]:
        """The rows."""
        return iter(self.rows)

    def __repr__(self) -> str:
        """Aligned text: numbers to the right, words to the left."""
        head, body = self.columns, self._cells()
        if not body:
            return "(no rows)"
        width = [max(map(len, column)) for column in zip(head, *body, strict=True)]
        right = [all(_is_number(row.get(name)) for row in self.rows) for name in head]
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
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        body = (
            line("".join(f"<td>{html.escape(cell)}</td>" for cell in row)) for row in self._cells()
        )
        return f"<table><thead>{line(head)}</thead><tbody>{''.join(body)}</tbody></table>"

    def _cells(self) -> list[list[str]]:
        """Text of every cell."""
        return [[_text(row.get(name)) for name in self.columns] for row in self.rows]


def _is_number(cell: object) -> bool:
    return isinstance(cell, (int, float)) and not isinstance(cell, bool)


def _text(cell: object) -> str:
    """A cell for people: four significant digits, a dash for what is not there."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "–"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
