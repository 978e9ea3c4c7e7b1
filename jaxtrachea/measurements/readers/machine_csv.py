"""Machine CSV: some lines about the test, then a table; one trial per file, named by the file."""

import dataclasses
from typing import Any

import numpy as np

from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import BadCurve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.file_names import identify_file
from jaxtrachea.measurements.readers.lines import Text
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
    units_row,
)
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role
from jaxtrachea.units import column_unit

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
        place: dict[str, Any] = {"rows": rows, "row_word": text.word, "s": who.s, "phi": who.phi}
        place |= {"time": time, "conditions": who.conditions}
        return [curve_of_columns((who.specimen, trial), source, values, **place)]
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
            names: list[str] = []
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
                # An ambiguous header is still the header, and so is one without a column that the
                # options name; any other line is part of the preamble.
                if fault.kind == "ambiguous" or _names_both(names, options):
                    reason = fault
                continue
            at, units = units_row(lines, at, delimiter, units)
            found = columns_of_tidy(roles, units)
            quoted = {role: repr(names[roles[role]]) for role in found}
            _refuse_columns_of_tidy(f"{text.word} {line.number}", quoted, options)
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


def _names_both(names: list[str], options: ReadOptions) -> bool:
    """Whether columns are those of displacement and force, whatever else the options name."""
    both = ("displacement", "force")
    columns = {role: name for role, name in options.columns.items() if role in both}
    try:
        return {*both} <= find_roles(names, dataclasses.replace(options, columns=columns)).keys()
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


MACHINE = Reader("machine", read_text=read, is_text=lambda lines, options: True)
