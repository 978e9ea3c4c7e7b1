"""Machine CSV: some lines about the test, then a table; one trial per file, named by the file."""

import numpy as np

from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import BadCurve, Fault, RawCurve, ReadOptions, identify_file
from jaxtrachea.measurements.readers.lines import Lines, Text
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.text import (
    Table,
    columns_of_tidy,
    find_roles,
    read_columns,
    require_roles,
    resolve_unit,
    role_values,
    split_cells,
    time_values,
)
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role
from jaxtrachea.units import column_unit, is_unit

# A header further down than this is no header.
MAX_PREAMBLE = 500


def read(text: Text, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read the one curve of a machine file; whatever is wrong with it costs this curve only.

    Repeated rows and initial offsets are left as they are.

    Args:
        text: the lines of the file.
        options: columns, units and naming.

    Returns:
        One record.

    Raises:
        DataError: the name of the file does not fit the pattern, or its units contradict the
            options.
    """
    who = identify_file(text.path, options)
    trial = who.trial or "1"
    source = text.place
    try:
        table, roles = _table(text, options)
        rows = np.array(table.lines, dtype=np.int64)
        if rows.size:
            source = f"{text.place}:{rows[0]}-{rows[-1]}"
        values = _values(table, roles, options)
        time = time_values(table, roles, slice(None), options)
        place = {"rows": rows, "row_word": text.word, "s": who.s, "phi": who.phi}
        return [curve_of_columns((who.specimen, trial), source, values, time=time, **place)]
    except Fault as fault:
        return [bad(who.specimen, trial, source, fault)]


def _values(table: Table, roles: dict[str, int], options: ReadOptions) -> dict[str, np.ndarray]:
    """Columns by role in mm and N; position columns are not looked for in a machine file."""
    values = {}
    for role, i in roles.items():
        if role in SAMPLED or is_ring_role(role):
            place = f"{table.text.place}: column {table.names[i]!r}"
            unit = resolve_unit(role, table.units[i], options, place)
            values[role] = role_values(table, role, i, slice(None), unit)
    return values


def _table(text: Text, options: ReadOptions) -> tuple[Table, dict[str, int]]:
    """Find the header: the first line, by any delimiter, that names displacement and force."""
    lines = text.lines.without_comments()
    if not lines:
        raise Fault("empty", "the file is empty", "export it again")
    reason: Fault | None = None
    for at, line in enumerate(lines[:MAX_PREAMBLE]):
        for delimiter in "\t;,":
            if delimiter not in line.text:
                continue
            try:
                cells = split_cells(line.text, delimiter)
                while cells and cells[-1] == "":
                    cells.pop()
                names, units = (
                    map(list, zip(*map(column_unit, cells), strict=True)) if cells else ([], [])
                )
                roles = find_roles(names, options)
                require_roles(roles, names)
            except Fault as fault:
                # An ambiguous header is still the header; any other line is part of the preamble.
                reason = fault if fault.kind == "ambiguous" else reason
                continue
            _refuse_columns_of_tidy(f"{text.word} {line.number}", roles, names, options)
            at, units = _units_row(lines, at, delimiter, units)
            numbers, columns = read_columns(lines[at + 1 :], len(names), delimiter, text.word)
            table = Table(
                text=text,
                names=names,
                units=units,
                header_line=line.number,
                lines=numbers,
                columns=columns,
                delimiter=delimiter,
            )
            return table, roles
    if reason is not None:
        raise reason
    raise Fault(
        "column_missing",
        f"no header line names {options.columns.get('displacement', 'displacement')!r}"
        f" and {options.columns.get('force', 'force')!r} in the first {MAX_PREAMBLE} {text.word}s",
        "name the columns in columns.displacement and columns.force",
    )


def _refuse_columns_of_tidy(
    line: str, roles: dict[str, int], names: list[str], options: ReadOptions
) -> None:
    """Refuse a column that a machine file is not read for: specimen, trial or position of rows.

    Raises:
        Fault: there is one, and nobody has said that it does not count: not by the format, or by
            naming the column in spite of it.
    """
    found = columns_of_tidy(roles)
    if options.format == "machine":
        found = [role for role in found if role in options.columns]
    if not found:
        return
    quoted = ", ".join(f"{names[roles[role]]!r} ({role})" for role in found)
    if options.format == "machine":
        raise Fault(
            "ambiguous",
            f"{line} has {quoted}, which a machine file is not read for",
            f'set format = "tidy", or leave out columns.{found[0]}: the name of the file tells it',
        )
    raise Fault(
        "ambiguous",
        f"{line} is the header of a table with {quoted}, but other lines stand above it",
        'remove them or begin them with #, or set format = "machine": one curve, of which the name '
        "of the file tells specimen, trial and position",
    )


def _units_row(
    lines: Lines, at: int, delimiter: str, units: list[str | None]
) -> tuple[int, list[str | None]]:
    """Some machines put the units in a row of their own below the names: ``(s),(mm),(N)``."""
    if at + 1 >= len(lines) or any(units):
        return at, units
    cells = split_cells(lines[at + 1].text, delimiter)
    bare = [cell.strip("()[] ") for cell in cells]
    if len(cells) != len(units) or not any(bare):
        return at, units
    bracketed = all(cell[:1] in ("(", "[") for cell in cells if cell)
    # A number is no units row, although "1" alone would pass for a dimensionless unit.
    if not bracketed and not all(not b or (is_unit(b) and not b[0].isdigit()) for b in bare):
        return at, units
    return at + 1, [b or None for b in bare]


MACHINE = Reader("machine", read_text=read, is_text=lambda lines, options: True)
