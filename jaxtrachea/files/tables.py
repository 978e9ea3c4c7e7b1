"""Tables: CSV files, Markdown, and numbers for people.

A cell of a CSV file that a spreadsheet would run as a formula is written behind an apostrophe, as
OWASP recommends ("CSV injection", https://owasp.org/www-community/attacks/CSV_Injection);
`unquoted` takes it away again.
"""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

#: What spreadsheets take for the start of a formula, full-width forms included.
FORMULA = "=+-@\t\r\n＝＋－＠"
_STARTS = re.compile(f"'*[{re.escape(FORMULA)}]")
_QUOTED = re.compile(f"'+[{re.escape(FORMULA)}]")


def quoted(cell: object) -> object:
    """The cell, behind an apostrophe if it is text that starts a formula; numbers as they are.

    Apostrophes before such a character count as part of it, so that `unquoted` undoes this always.
    """
    return f"'{cell}" if isinstance(cell, str) and _STARTS.match(cell) else cell


def unquoted(text: str) -> str:
    """The text that `quoted` was given."""
    return text[1:] if _QUOTED.match(text) else text


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows that may have different keys; missing cells are empty, formulas are quoted."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([quoted(name) for name in columns])
        writer.writerows([[quoted(row.get(name, "")) for name in columns] for row in rows])


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    path.write_text(text, encoding="utf-8")


def number(value: float, digits: int = 4) -> str:
    """A number for people: `digits` significant ones, a dash for NaN."""
    return "–" if math.isnan(value) else f"{value:.{digits}g}"


def interval(low: float, high: float, *, log: bool) -> str:
    """An interval for people; open sides are left out."""
    open_low, open_high = low == (0 if log else -math.inf), high == math.inf
    if open_low and open_high:
        return "anything"
    if open_low or open_high:
        return f"up to {number(high)}" if open_low else f"from {number(low)}"
    return "–" if math.isnan(low) and math.isnan(high) else f"{number(low)} … {number(high)}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""

    def line(cells):
        plain = (" ".join(str(cell).split()).replace("|", "\\|") for cell in cells)
        return f"| {' | '.join(plain)} |"

    return "\n".join([line(head), line(["---"] * len(head)), *map(line, rows)])
