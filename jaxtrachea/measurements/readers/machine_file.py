"""Files of testing machines: some lines about the test, then one table or several, a trial each."""

import dataclasses
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import BadCurve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.file_names import FileIdentity, identify_file
from jaxtrachea.measurements.readers.column_roles import (
    candidates,
    columns_of_tidy,
    find_roles,
    listed,
    require_roles,
    time_column,
)
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.table import (
    DELIMITERS,
    Header,
    Line,
    Table,
    Text,
    header_at,
    header_cells,
    is_comment,
    is_number,
    likely_header,
    numbered_columns,
    rows_below,
    unit_of_role,
)
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role

# A header further down than this is no header.
MAX_PREAMBLE = 500
_NUMBERED = re.compile(r"(.*?)[ _.#-]*\d+")
_WORD = re.compile(r"[^\W\d_](?:\D*|[\w ]*)")
BOTH = ("displacement", "force")


class Part(NamedTuple):
    """The columns of one trial of a table.

    Attributes:
        trial: its name, where a table holds several.
        roles: column of each role.
    """

    trial: str
    roles: dict[str, int]


def read(text: Text, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read the curves of a machine file; whatever is wrong with it costs this file only.

    Repeated rows and initial offsets are left as they are.

    Args:
        text: of the file.
        options: columns, units and naming.

    Returns:
        One record for each block of rows, and for each pair of columns side by side.

    Raises:
        DataError: the name of the file does not fit the pattern, or its units contradict the
            options.
    """
    who = identify_file(text.path, options)
    try:
        header, parts = find_header(text, options)
        text = header.text
        tables = _tables(text, header.header, parts[0].roles)
    except Fault as fault:
        return [bad(who.specimen, who.trial or text.trial, text.place, fault)]
    several = len(tables) * len(parts) > 1
    records: list[RawCurve | BadCurve] = []
    for table in tables:
        for part in parts:
            trial = who.trial or text.trial
            if several:
                own = part.trial if len(tables) == 1 else str(len(records) + 1)
                trial = own if who.trial is None and trial == "1" else f"{trial}-{own}"
            records.append(_curve(table, part.roles, who, trial, options, len(parts) > 1))
    return records


def _curve(
    table: Table,
    roles: dict[str, int],
    who: FileIdentity,
    trial: str,
    options: ReadOptions,
    beside: bool,
) -> RawCurve | BadCurve:
    """One trial of a table.

    Args:
        table: with its rows.
        roles: column of each role.
        who: the name of the file tells.
        trial: name of the trial.
        options: columns, units and naming.
        beside: other trials stand beside it, which may have more rows.
    """
    source = table.text.place
    if table.lines.size:
        source = f"{source}:{table.lines[0]}-{table.lines[-1]}"
    try:
        units = {
            role: unit_of_role(
                role, table, i, options, f"{table.text.place}: column {table.names[i]!r}"
            )
            for role, i in roles.items()
            if role in SAMPLED or is_ring_role(role)
        }
        time = time_column(table.names, table.header.units, roles, options)
        table.load({*(roles[role] for role in units), *({time[0]} if time else ())})
        rows = slice(0, _length(table, roles) if beside else len(table.lines))
        table.check_groups([roles[role] for role in units], np.array([0]))
        values = {role: table.values(role, roles[role], rows, u) for role, u in units.items()}
        place: dict[str, Any] = {"rows": table.lines[rows], "row_word": table.text.word}
        place |= {"s": who.s, "phi": who.phi, "conditions": who.conditions}
        place |= {"time": table.time(roles, options, rows), "notes": tuple(table.notes)}
        return curve_of_columns((who.specimen, trial), source, values, **place)
    except Fault as fault:
        return bad(who.specimen, trial, source, fault)


def _length(table: Table, roles: dict[str, int]) -> int:
    """Rows down to the last in which a trial that is shorter than those beside it has a number."""
    filled = np.zeros(len(table.lines), bool)
    for role in BOTH:
        cells = table.raw(roles[role])
        filled |= (
            ~np.isnan(cells) if isinstance(cells, np.ndarray) else np.array([*map(bool, cells)])
        )
    return int(np.flatnonzero(filled)[-1]) + 1 if filled.any() else 0


class Found(NamedTuple):
    """A header, in the text that has the delimiter of its table."""

    text: Text
    header: Header


def find_header(text: Text, options: ReadOptions) -> tuple[Found, list[Part]]:
    """The header: the first line, by any delimiter, that names displacement and force.

    Returns:
        The header, and the trials that stand side by side below it.

    Raises:
        Fault: there is none, or it names a role twice.
    """
    if not text.lines:
        raise Fault("empty", "the file is empty", "export it again")
    for blanks in (0, 2, 1):  # as it is, then with columns that two blanks or more separate, or one
        made = text.with_tabs(blanks) if blanks else text
        for lines in (made.lines, _uncommented(made)):
            found = _search(made, lines, options, sentences=blanks > 0)
            if found is not None:
                return found
    return _numbered(text, options)


def _is_above_numbers(header: Header, lines: Sequence[Line]) -> bool:
    """Whether the row below a header has as many cells, two numbers among them."""
    row = next((line.text for line in lines if line.number >= header.first), "")
    cells = header_cells(row, header.delimiter)
    return len(cells) == len(header.names) and sum(map(is_number, cells)) >= 2


def _uncommented(text: Text) -> list[Line]:
    """All lines, the last comment above the first row without its sign."""
    for at, line in enumerate(text.head[:-1]):
        below = text.head[at + 1].text
        if line.text.lstrip().startswith("#") and not is_comment(below):
            return [Line(line.number, line.text.strip().lstrip("#").strip()), *text.head[at + 1 :]]
    return []


def _search(
    text: Text, lines: Sequence[Line], options: ReadOptions, *, sentences: bool
) -> tuple[Found, list[Part]] | None:
    """The first of the lines that is a header; None if none is.

    Args:
        text: with the lines.
        lines: without comments.
        options: columns that are named.
        sentences: words may look like columns: a row of as many numbers must follow.

    Raises:
        Fault: a line is one, and names a role twice or not at all.
    """
    reason: Fault | None = None
    for at, line in enumerate(lines[:MAX_PREAMBLE]):
        for delimiter in DELIMITERS:
            header = header_at(lines, at, delimiter) if delimiter in line.text else None
            if header is None or all(map(is_number, header.names)):
                continue
            if sentences and not _is_above_numbers(header, lines[at + 1 :]):
                continue
            try:
                parts = _parts(header.names, options, lines[at - 1] if at else None, delimiter)
            except Fault as fault:
                # An ambiguous header is still the header, and so is one without a column that the
                # options name; any other line is part of the preamble.
                if fault.kind == "ambiguous" or _names_both(header.names, options):
                    reason = fault
                continue
            if _is_labview(text):
                header = _with_labels(header, lines[:at])
            found = columns_of_tidy(parts[0].roles, header.units)
            quoted = {role: repr(header.names[parts[0].roles[role]]) for role in found}
            _refuse_columns_of_tidy(f"{text.word} {line.number}", quoted, options)
            return Found(text, header), parts
    if reason is not None:
        raise reason
    return None


def _parts(
    names: list[str], options: ReadOptions, above: Line | None, delimiter: str
) -> list[Part]:
    """The columns of each trial: of all names, or of names that come again and again.

    A name that stands once, as the time, is that of all trials. ``Load 1`` and ``Load 2``
    are one name.

    Raises:
        Fault: a role is not there, or twice.
    """
    try:
        roles = find_roles(names, options)
        require_roles(roles, names)
        return [Part("1", roles)]
    except Fault as fault:
        first = fault
    for plain in (names, [(m := _NUMBERED.fullmatch(n)) and m[1] or n for n in names]):
        counts = Counter(filter(None, plain))
        most = max(counts.values(), default=0)
        if most < 2:
            continue
        parts = []
        for k in range(most):
            seen: Counter[str] = Counter()
            own: list[str] = []
            for name in plain:
                seen[name] += 1
                mine = counts[name] != most or seen[name] == k + 1
                own.append(name if mine else "")
            try:
                roles = find_roles(own, options)
                require_roles(roles, own)
            except Fault:
                break
            if any(counts[plain[roles[role]]] != most for role in BOTH):
                break
            parts.append(Part(str(k + 1), roles))
        if len(parts) == most:
            return _titled(parts, above, delimiter)
    raise first


def _titled(parts: list[Part], above: Line | None, delimiter: str) -> list[Part]:
    """Trials with the names that stand in the line above, where it has one for each."""
    titles = [cell for cell in header_cells(above.text, delimiter) if cell] if above else []
    if len({*titles}) != len(parts) or not all(title.isprintable() for title in titles):
        return parts
    return [Part(title, part.roles) for title, part in zip(titles, parts, strict=True)]


def _numbered(text: Text, options: ReadOptions) -> tuple[Found, list[Part]]:
    """Columns by number where there is no header.

    Raises:
        Fault: there is a header, or nobody says which columns are displacement and force.
    """
    named = likely_header(text.lines[:MAX_PREAMBLE])
    for version in (text, text.with_tabs(1)):
        header = numbered_columns(version.lines[:MAX_PREAMBLE])
        if named is not None or header is None:
            continue
        if {options.columns.get(role, "") for role in BOTH} <= {*header.names}:
            roles = find_roles(header.names, options)
            return Found(version, header), [Part("1", roles)]
        raise Fault(
            "column_missing",
            f"no header line names {options.columns.get('displacement', 'displacement')!r} and "
            f"{options.columns.get('force', 'force')!r}: the table begins with numbers in "
            f"{text.word} {header.first}, in columns 1 to {len(header.names)}",
            "name the columns in columns.displacement and columns.force by their numbers, as in "
            'columns = { displacement = "1", force = "2" }, and give units = { displacement = '
            '"mm", force = "N" }',
        )
    raise _no_header(text, named, options)


def _no_header(text: Text, named: Header | None, options: ReadOptions) -> Fault:
    """What is there instead, and what to write."""
    what = (
        f"no header line names {options.columns.get('displacement', 'displacement')!r}"
        f" and {options.columns.get('force', 'force')!r} in the first {MAX_PREAMBLE} {text.word}s"
    )
    cure = "name the columns in columns.displacement and columns.force"
    if named is None:
        return Fault("column_missing", f"{what}, and none stands above numbers", cure)
    what += f"; the columns of {text.word} {named.line} are {listed(named.names)}"
    columns = [(n, u) for n, u in zip(named.names, named.units, strict=True) if n]
    try:
        roles = find_roles(named.names, options)
    except Fault:
        roles = {}
    missing = [role for role in BOTH if role not in roles]
    likely = {role: candidates(role, columns) for role in missing}
    if all(len(names) == 1 for names in likely.values()):
        written = ", ".join(f'{role} = "{names[0]}"' for role, names in likely.items())
        cure += f", as in columns = {{ {written} }}"
    return Fault("column_missing", what, cure)


def _names_both(names: list[str], options: ReadOptions) -> bool:
    """Whether columns are those of displacement and force, whatever else the options name."""
    columns = {role: name for role, name in options.columns.items() if role in BOTH}
    try:
        return {*BOTH} <= find_roles(names, dataclasses.replace(options, columns=columns)).keys()
    except Fault:
        return False


def _refuse_columns_of_tidy(line: str, quoted: dict[str, str], options: ReadOptions) -> None:
    """Refuse columns that a machine file is not read for: specimen, trial or position of rows.

    With `format = "machine"` those that the options name; else all: other lines stand above, by
    which the file is no tidy table.

    Args:
        line: of the header.
        quoted: their names, by role.
        options: as the file is read.

    Raises:
        Fault: there is one.
    """
    asked = options.format == "machine"
    found = {role: name for role, name in quoted.items() if not asked or role in options.columns}
    if not found:
        return
    shown = ", ".join(f"{name} ({role})" for role, name in found.items())
    if asked:
        cure = f"leave out columns.{next(iter(found))}: the name of the file tells it"
        raise Fault(
            "ambiguous",
            f"{line} has {shown}, which a machine file is not read for",
            f'set format = "tidy", or {cure}',
        )
    raise Fault(
        "ambiguous",
        f"{line} is the header of a table with {shown}, but other lines stand above it",
        'remove them or begin them with #, or set format = "machine": one curve, of which the name '
        "of the file tells specimen, trial and position",
    )


# --- blocks of rows, and lines below them -------------------------------------------------------


def _tables(text: Text, header: Header, roles: dict[str, int]) -> list[Table]:
    """The blocks of rows below a header and below its repetitions.

    Raises:
        Fault: a line among the rows is none of them, and no new header.
    """
    try:
        table = rows_below(text, header)
        named = next(filter(None, header.names)).encode() in table.body and header.line > 0
        if not named and not _ends_in_text(table, roles):
            return [table]
        first = Fault("ragged", "", "")
    except Fault as fault:
        first = fault
    lines = [
        Line(i, line.decode(errors="replace"))
        for i, line in enumerate(text.data.split(b"\n"), 1)
        if i >= header.first and line.strip()
    ]
    lines = [line for line in lines if not is_comment(line.text)]
    first_row = next((c for line in lines if (c := header_cells(line.text, header.delimiter))
                      and is_number(c[0])), [""])  # fmt: skip
    kinds = [_kind(line, header, roles, first_row) for line in lines]
    tables: list[Table] = []
    at = 0
    while at < len(lines):
        rows = next((k for k in range(at, len(lines)) if kinds[k] == "row"), None)
        if rows is None:
            break
        end = next((k for k in range(rows, len(lines)) if kinds[k] != "row"), len(lines))
        again = next((k for k in range(end, len(lines)) if kinds[k] != "text"), len(lines))
        part = Text(text.path, _cut(text.data, lines, end), text.sheet, text.trial)
        table = rows_below(part, header._replace(first=lines[rows].number))
        if again < len(lines) and kinds[again] == "header":
            _check_units(header_at(lines, again, header.delimiter), header, roles, text)
            at = again + 1
        elif again == len(lines):
            at = again
            if end < again:
                table.notes.append(_left_out(text, lines[end:]))
        else:
            raise (
                first
                if first.message
                else Fault(
                    "unparsable",
                    f"{text.word} {lines[end].number} is no row, and rows go on below it",
                    "remove it, or begin it with #",
                )
            )
        tables.append(table)
    if not tables:
        if first.message:
            raise first
        return [rows_below(text, header)]
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
    same = again and all(again.names[i : i + 1] == [header.names[i]] for i in roles.values())
    return "header" if same else "text"


def _check_units(again: Header | None, header: Header, roles: dict[str, int], text: Text) -> None:
    """Refuse a block of rows in other units than the first."""
    for i in roles.values():
        unit = again.units[i] if again else None
        if again and unit is not None and unit != header.units[i]:
            raise Fault(
                "ambiguous",
                f"{text.word} {again.line}: {header.names[i]} is in {unit}, and in "
                f"{header.units[i]} in {text.word} {header.line}",
                "split the file there",
            )


def _cut(data: bytes, lines: Sequence[Line], end: int) -> bytes:
    """The text up to a line."""
    if end == len(lines):
        return data
    return b"\n".join(data.split(b"\n", lines[end].number - 1)[: lines[end].number - 1])


def _left_out(text: Text, lines: Sequence[Line]) -> str:
    """That lines below a table are no rows of it."""
    first, last = lines[0].number, lines[-1].number
    which = f"{text.word} {first}" if first == last else f"{text.word}s {first} to {last}"
    shown = lines[0].text.strip()[:60]
    return f"{text.place}: {which} below the table are not read ({shown!r})"


# --- LabVIEW ------------------------------------------------------------------------------------


def _is_labview(text: Text) -> bool:
    return bool(text.head) and text.head[0].text.startswith("LabVIEW Measurement")


def _with_labels(header: Header, above: Sequence[Line]) -> Header:
    """The header of an lvm file: units stand in lines above it, and its rows have no comment.

    ``X_Value`` is a time, if ``X_Dimension`` says nothing else.
    """
    labels = {}
    for line in above:
        key, *cells = [cell.strip() for cell in line.text.split(header.delimiter)]
        labels[key] = cells
    names, units = [*header.names], [*header.units]
    if names[-1] == "Comment":
        del names[-1], units[-1]
    timed = {cell for cell in labels.get("X_Dimension", ()) if cell} <= {"Time"}
    for i, name in enumerate(names):
        if name == "X_Value" and timed:
            names[i], units[i] = "time", units[i] or "s"
    channels = [i for i, name in enumerate(names) if name != "time" and name != "X_Value"]
    for i, unit in zip(channels, filter(None, labels.get("Y_Unit_Label", ())), strict=False):
        units[i] = units[i] or unit
    return Header(names, units, header.line, header.delimiter, header.first)


MACHINE = Reader("machine", read_text=read, is_text=lambda text, options: True)
