"""The header of a machine file, and the trials that stand side by side below it."""

import dataclasses
import string
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from jaxtrachea.measurements.curve import Fault, ReadOptions
from jaxtrachea.measurements.readers.column_roles import (
    candidates,
    columns_of_tidy,
    find_roles,
    listed,
    require_roles,
)
from jaxtrachea.measurements.readers.table import (
    DELIMITERS,
    Header,
    Line,
    Text,
    header_at,
    header_cells,
    is_comment,
    is_number,
    likely_header,
    numbered_columns,
)

# A header further down than this is no header.
MAX_PREAMBLE = 500
BOTH = ("displacement", "force")


class Part(NamedTuple):
    """The columns of one trial of a table.

    Attributes:
        trial: its name, where a table holds several.
        roles: column of each role.
    """

    trial: str
    roles: dict[str, int]


class Found(NamedTuple):
    """A header, in the text that has the delimiter of its table."""

    text: Text
    header: Header


def find_header(text: Text, options: ReadOptions) -> tuple[Found, list[Part]]:
    """The header: the first line, by any delimiter, that names displacement and force.

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
                parts = _parts(header, options, lines[at - 1] if at else None)
            except Fault as fault:
                # An ambiguous header is still the header, and so is one without a column that the
                # options name; any other line is part of the preamble.
                if fault.kind == "ambiguous" or _names_both(header, options):
                    reason = fault
                continue
            if text.head[0].text.startswith("LabVIEW Measurement"):
                header = _with_labels(header, lines[:at])
            found = columns_of_tidy(parts[0].roles, header.units)
            quoted = {role: repr(header.names[parts[0].roles[role]]) for role in found}
            commented = line not in text.lines
            _refuse_columns_of_tidy(f"{text.word} {line.number}", quoted, options, commented)
            return Found(text, header), parts
    if reason is not None:
        raise reason
    return None


def _parts(header: Header, options: ReadOptions, above: Line | None) -> list[Part]:
    """The columns of each trial: of all names, or of names that come again and again.

    A name that stands once, as the time, is that of all trials. ``Load 1`` and ``Load 2``
    are one name.

    Raises:
        Fault: a role is not there, or twice.
    """
    names = header.names
    try:
        roles = find_roles(names, options, header.units)
        require_roles(roles, names)
        return [Part("1", roles)]
    except Fault as fault:
        first = fault
    unnumbered = [name.rstrip(string.digits).rstrip(" _.#-") or name for name in names]
    for plain in (names, unnumbered):
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
                roles = find_roles(own, options, header.units)
                require_roles(roles, own)
            except Fault:
                break
            if any(counts[plain[roles[role]]] != most for role in BOTH):
                break
            parts.append(Part(str(k + 1), roles))
        if len(parts) == most:
            return _titled(parts, above, header.delimiter)
    raise first


def _titled(parts: list[Part], above: Line | None, delimiter: str) -> list[Part]:
    """Trials with the names that stand in the line above, where it has one for each."""
    titles = [cell for cell in header_cells(above.text, delimiter) if cell] if above else []
    if len({*titles}) != len(parts) or not all(title.isprintable() for title in titles):
        return parts
    return [Part(title, part.roles) for title, part in zip(titles, parts, strict=True)]


def _numbered(text: Text, options: ReadOptions) -> tuple[Found, list[Part]]:
    """Columns by number where there is no header."""
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
        roles = find_roles(named.names, options, named.units)
    except Fault:
        roles = {}
    missing = [role for role in BOTH if role not in roles]
    likely = {role: candidates(role, columns) for role in missing}
    if all(len(names) == 1 for names in likely.values()):
        written = ", ".join(f'{role} = "{names[0]}"' for role, names in likely.items())
        cure += f", as in columns = {{ {written} }}"
    return Fault("column_missing", what, cure)


def _names_both(header: Header, options: ReadOptions) -> bool:
    """Whether columns are those of displacement and force, whatever else the options name."""
    columns = {role: name for role, name in options.columns.items() if role in BOTH}
    try:
        own = dataclasses.replace(options, columns=columns)
        return {*BOTH} <= find_roles(header.names, own, header.units).keys()
    except Fault:
        return False


def _refuse_columns_of_tidy(
    line: str, quoted: dict[str, str], options: ReadOptions, commented: bool
) -> None:
    """Refuse columns that a machine file is not read for: specimen, trial or position of rows.

    With `format = "machine"` those that the options name; else all: other lines stand above, by
    which the file is no tidy table.
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
    what, cure = "but other lines stand above it", "remove them or begin them with #"
    if commented:
        what, cure = "but is a comment", "remove the # before it"
    raise Fault(
        "ambiguous",
        f"{line} is the header of a table with {shown}, {what}",
        f'{cure}, or set format = "machine": one curve, of which the name of the file tells '
        "specimen, trial and position",
    )


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
