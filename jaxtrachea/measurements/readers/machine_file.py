"""Files of testing machines: some lines about the test, then one table or several, a trial each."""

from typing import Any

import numpy as np

from jaxtrachea.measurements.checks import bad
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import BadCurve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.file_names import FileIdentity, identify_file
from jaxtrachea.measurements.readers.column_roles import time_column
from jaxtrachea.measurements.readers.machine_blocks import blocks_below
from jaxtrachea.measurements.readers.machine_header import BOTH, find_header
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.table import Table, Text, unit_of_role
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role


def read(text: Text, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read the curves of a machine file; whatever is wrong with it costs this file only.

    Repeated rows and initial offsets are left as they are.

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
        tables = blocks_below(text, header.header, parts[0].roles)
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


MACHINE = Reader("machine", read_text=read, is_text=lambda text, options: True)
