"""Blocks of rows in a machine file, each below the same header, and words below the last."""

import re
from collections.abc import Sequence

from jaxtrachea.measurements.curve import Fault
from jaxtrachea.measurements.readers.machine_header import BOTH
from jaxtrachea.measurements.readers.table import (
    Header,
    Line,
    Table,
    Text,
    header_at,
    header_cells,
    is_comment,
    is_number,
    rows_below,
)

_WORD = re.compile(r"[^\W\d_](?:\D*|[\w ]*)")


def blocks_below(text: Text, header: Header, roles: dict[str, int]) -> list[Table]:
    """The blocks of rows below a header and below its repetitions.

    Raises:
        Fault: a line among the rows is none of them, and no new header.
    """
    reason = None
    try:
        table = rows_below(text, header)
        named = header.line > 0 and next(filter(None, header.names)).encode() in table.body
        if not named and not _ends_in_text(table, roles):
            return [table]
    except Fault as fault:
        reason = fault
    found = _blocks(text, header, roles, reason)
    if not found and reason is not None:
        raise reason
    return found or [rows_below(text, header)]


def _blocks(text: Text, header: Header, roles: dict[str, int], reason: Fault | None) -> list[Table]:
    """The blocks, found line by line.

    Raises:
        Fault: `reason`, or what is wrong with a line among the rows.
    """
    texts = enumerate(text.data.split(b"\n")[header.first - 1 :], header.first)
    decoded = (Line(i, line.decode(errors="replace")) for i, line in texts)
    lines = [line for line in decoded if line.text.strip() and not is_comment(line.text)]
    split = (header_cells(line.text, header.delimiter) for line in lines)
    first_row = next((cells for cells in split if cells and is_number(cells[0])), [""])
    kinds = [_kind(line, header, roles, first_row) for line in lines]
    tables: list[Table] = []
    at = 0
    while "row" in kinds[at:]:
        start = kinds.index("row", at)
        end = next((k for k in range(start, len(lines)) if kinds[k] != "row"), len(lines))
        after = next((k for k in range(end, len(lines)) if kinds[k] != "text"), len(lines))
        if "numbers" in kinds[at:start]:
            break
        part = Text(text.path, _cut(text.data, lines, end), text.sheet, text.trial)
        tables.append(rows_below(part, header._replace(first=lines[start].number)))
        _check_columns(lines, range(end, min(after + 1, len(lines))), header, roles, text)
        if after < len(lines) and kinds[after] != "header":
            what = f"{text.word} {lines[end].number} is no row, and rows go on below it"
            raise reason or Fault("unparsable", what, "remove it, or begin it with #")
        at = after + 1
        if after == len(lines) and end < after:
            tables[-1].notes.append(_left_out(text, lines[end:]))
    if "numbers" in kinds[at:]:
        what = f"{text.word} {lines[kinds.index('numbers', at)].number} is no row of the table"
        raise reason or Fault("ragged", what, "complete or remove it")
    return tables


def _ends_in_text(table: Table, roles: dict[str, int]) -> bool:
    """Whether the last row, of as many cells as the header, is a line of text below the table."""
    if table.lines.size < 2:
        return False
    ends = (table.body.partition(b"\n")[0], table.body.rstrip(b"\n").rpartition(b"\n")[2])
    first, last = (header_cells(e.decode(errors="replace"), table.header.delimiter) for e in ends)
    cells = [last[roles[role]] if roles[role] < len(last) else "" for role in BOTH]
    words = [cell for cell in cells if cell]
    return bool(last) and ((bool(words) and all(map(_is_word, words))) or _is_labelled(last, first))


def _is_labelled(cells: list[str], first: list[str]) -> bool:
    """Whether a line begins with text, as "Mean", and the first row with a number."""
    return _is_word(cells[0]) and is_number(first[0])


def _is_word(cell: str) -> bool:
    """Whether a cell is text, and no number that was spoilt or is none by intention."""
    return _WORD.fullmatch(cell) is not None and cell.lower() not in ("nan", "inf", "infinity")


def _kind(line: Line, header: Header, roles: dict[str, int], first: list[str]) -> str:
    """What a line below a header is: "row", the same "header" again, or other "text"."""
    cells = header_cells(line.text, header.delimiter)
    wanted = [cells[roles[role]] if roles[role] < len(cells) else "" for role in BOTH]
    numeric = [cell for cell in cells if is_number(cell)]
    labelled = bool(cells) and _is_labelled(cells, first)
    if len(cells) <= len(header.names) and any(map(is_number, wanted)) and not labelled:
        return "row"
    if numeric and len(numeric) == len([cell for cell in cells if cell]):
        return "numbers"
    again = header_at([line], 0, header.delimiter)
    return "header" if again and _is_same(again, header, roles) else "text"


def _check_columns(
    lines: Sequence[Line], places: range, header: Header, roles: dict[str, int], text: Text
) -> None:
    """Refuse a second table whose columns or units are not those of the first."""
    for k in places:
        other = header_at(lines, k, header.delimiter)
        if other is None or not {header.names[roles[role]] for role in BOTH} <= {*other.names}:
            continue
        line = f"{text.word} {other.line}"
        if other.names[: len(header.names)] != header.names and not _is_same(other, header, roles):
            raise Fault(
                "ambiguous",
                f"{line} is the header of another table than {text.word} {header.line}",
                "keep one table in the file",
            )
        for i in roles.values():
            if other.units[i] is not None and other.units[i] != header.units[i]:
                raise Fault(
                    "ambiguous",
                    f"{line}: {header.names[i]} is in {other.units[i]}, and in {header.units[i]} "
                    f"in {text.word} {header.line}",
                    "split the file there",
                )


def _is_same(other: Header, header: Header, roles: dict[str, int]) -> bool:
    """Whether all columns that are read have the same places."""
    return all(other.names[i : i + 1] == [header.names[i]] for i in roles.values())


def _cut(data: bytes, lines: Sequence[Line], end: int) -> bytes:
    """The text up to a line."""
    if end == len(lines):
        return data
    return b"\n".join(data.split(b"\n", lines[end].number - 1)[: lines[end].number - 1])


def _left_out(text: Text, lines: Sequence[Line]) -> str:
    """That lines below a table are no rows of it."""
    first, last = lines[0].number, lines[-1].number
    which = f"{text.word} {first} below the table is"
    if first < last:
        which = f"{text.word}s {first} to {last} below the table are"
    return f"{text.place}: {which} not read ({lines[0].text.strip()[:60]!r})"
