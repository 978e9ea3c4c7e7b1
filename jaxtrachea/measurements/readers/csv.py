"""Tidy CSV or TSV: one row per sample, one table for a whole study."""

from collections.abc import Iterator, Sequence
from itertools import compress, islice, pairwise
from operator import ne
from pathlib import Path

import numpy as np

from jaxtrachea.files.tables import unquoted
from jaxtrachea.measurements.checks import STEADY, bad, position
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import (
    BadCurve,
    DataError,
    Fault,
    RawCurve,
    ReadOptions,
)
from jaxtrachea.measurements.file_names import FileIdentity, identify_file
from jaxtrachea.measurements.readers import large
from jaxtrachea.measurements.readers.conditions import conditions_of, unread_columns
from jaxtrachea.measurements.readers.lines import Lines, Text, is_comment
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.text import (
    ALIASES,
    Table,
    columns_of_tidy,
    find_roles,
    guess_delimiter,
    read_columns,
    role_values,
    split_cells,
    time_column,
    time_values,
)
from jaxtrachea.measurements.readers.tidy_head import (
    Header,
    read_header,
    read_state,
    roles_and_units,
)
from jaxtrachea.units import column_unit


def read(text: Text, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read a tidy table; see docs/measurements.md for the format.

    Args:
        text: the lines of the file.
        options: columns, units and naming.

    Returns:
        One record per (specimen, trial) in file order.

    Raises:
        DataError: the header, a unit or the shape of the table is wrong.
    """
    place, lines = text.place, text.lines.without_comments()
    try:
        state, lines = read_state(lines, text.word)
        header = read_header(text, lines)
        table = _table(text, lines, header)
        roles, units = roles_and_units(header, options)
    except Fault as fault:
        raise DataError(fault.message, place=place, cure=fault.cure) from None
    except DataError as error:
        raise DataError.like(error, place=error.place or place) from None
    return _curves(table, roles, units, state, options)


def read_large(path: Path, data: bytes, options: ReadOptions) -> list[RawCurve | BadCurve] | None:
    """Read a large tidy table in which no row is odd; see `large`.

    Args:
        path: the file.
        data: the text.
        options: columns, units and naming.

    Returns:
        The records of `read`; None if `read` must say what is odd, or read it.
    """
    found = large.opened(data)
    if found is None:
        return None
    text = Text(path, found.lines)
    try:
        state, lines = read_state(found.lines, text.word)
        header = read_header(text, lines)
        roles, units = roles_and_units(header, options)
        time = time_column(header.names, header.units, roles, options)
        names = {roles[role] for role in ("specimen", "trial") if role in roles}
        numbers = {roles[role] for role in units} | ({time[0]} if time else set())
        width = len(header.names)
        if names & numbers or header.below > 1:
            return None
        cells = large.read_cells(found, width, header.delimiter, [*names], [*numbers])
        if cells is None:
            return None
        numbers_of_rows, columns = cells
        for i in {*range(width)} - names - numbers:
            if (values := large.read_optional(found, width, header.delimiter, i)) is not None:
                columns[i] = values
        table = _filled(text, header, numbers_of_rows, columns)
        return _curves(table, roles, units, state, options)
    except (Fault, DataError):
        return None


def _curves(
    table: Table, roles: dict[str, int], units: dict[str, str], state: dict, options: ReadOptions
) -> list[RawCurve | BadCurve]:
    """A record of each curve, in the order of the table."""
    twice = [key for key in state if key in roles]
    if twice:
        raise DataError(
            f"{twice[0]} stands in the first line and in a column",
            place=table.text.place,
            cure="remove one",
        )
    named = _named(table.text, {*roles, *state}, options)
    groups = _group(table, roles, state, named)
    return [
        _curve(table, roles, units, state, named, key, picked, options)
        for key, picked in groups.items()
    ]


def _named(text: Text, told: set[str], options: ReadOptions) -> FileIdentity | None:
    """What the name of the file tells; None if all is told in it."""
    pattern = options.name_pattern
    more = pattern is not None and pattern.groupindex.keys() - {"specimen", "trial"}
    return identify_file(text.path, options) if more or "specimen" not in told else None


def _table(text: Text, lines: Lines, header: Header) -> Table:
    width = len(header.names)
    numbers, columns = read_columns(lines[header.below :], width, header.delimiter, text.word)
    if not numbers:
        raise DataError(
            f"no rows below the header in {text.word} {header.line}",
            place=text.place,
            cure="export it again",
        )
    return _filled(text, header, numbers, columns)


def _filled(
    text: Text,
    header: Header,
    lines: Sequence[int],
    columns: Sequence[list[str] | np.ndarray],
) -> Table:
    return Table(
        text=text,
        names=header.names,
        units=header.units,
        header_line=header.line,
        lines=lines,
        columns=columns,
        delimiter=header.delimiter,
    )


def _group(
    table: Table, roles: dict[str, int], state: dict, named: FileIdentity | None
) -> dict[tuple[str, str], slice]:
    """Rows of each (specimen, trial); a curve must be one block, or it is there twice."""
    name = None if "specimen" in {**roles, **state} else named
    fixed = {
        "specimen": name.specimen if name else "",
        "trial": (name and name.trial) or "1",
        **state,
    }
    groups: dict[tuple[str, str], slice] = {}
    last = None
    names = [table.columns[roles[role]] for role in ("specimen", "trial") if role in roles]
    for i, stop in _blocks(names, len(table.lines)):
        specimen, trial = (
            unquoted(table.columns[roles[role]][i]) if role in roles else fixed[role]
            for role in ("specimen", "trial")
        )
        key = (specimen, trial)
        if key == last:  # written otherwise, as one that an apostrophe protects
            groups[key] = slice(groups[key].start, stop)
            continue
        if fault := _name_fault(table, "specimen", specimen) or _name_fault(table, "trial", trial):
            raise DataError(
                f"{table.text.word} {table.lines[i]}: {fault[0]}",
                place=table.text.place,
                cure=fault[1],
            )
        if key in groups:
            first = table.lines[groups[key].start]
            raise DataError(
                f"specimen {key[0]!r} trial {key[1]!r} starts in {table.text.word} {first} "
                f"and again in {table.text.word} {table.lines[i]}",
                place=table.text.place,
                cure="keep the rows of a curve together, or rename it",
            )
        groups[key], last = slice(i, stop), key
    return groups


def _blocks(columns: Sequence[Sequence[str] | np.ndarray], count: int) -> Iterator[tuple[int, int]]:
    """First row, and that after the last, of rows that have the same cells in these columns."""
    ends: set[int] = set()
    for cells in columns:
        ends.update(compress(range(1, count), map(ne, cells, islice(cells, 1, None))))
    return pairwise([0, *sorted(ends), count])


def _name_fault(table: Table, role: str, name: str) -> tuple[str, str] | None:
    """What is wrong with a name and its cure; None if nothing is."""
    if not name:
        cure = "name it in every row"
        if table.text.sheet is not None:
            cure += " (merged cells hold their value in the first alone: unmerge and fill down)"
        return f"{role} is empty", cure
    if name.startswith("=") and table.text.sheet is not None:
        return (
            f"{role} {name!r} is a formula without a stored value",
            "open the file in a spreadsheet program and save it, or write the name itself",
        )
    hidden = [c for c in name if not c.isprintable()]
    if hidden:
        found = f"{role} {name!a} holds the unprintable character U+{ord(hidden[0]):04X}"
        return found, "rename it"
    return None


def _curve(
    table: Table,
    roles: dict[str, int],
    units: dict[str, str],
    state: dict,
    named: FileIdentity | None,
    key: tuple[str, str],
    picked: slice,
    options: ReadOptions,
) -> RawCurve | BadCurve:
    lines = table.lines[picked]
    rows = np.arange(lines.start, lines.stop) if isinstance(lines, range) else np.array(lines)
    source = f"{table.text.place}:{rows[0]}-{rows[-1]}"
    unread = unread_columns(table, roles, options)
    try:
        values = {
            role: role_values(table, role, roles[role], picked, unit)
            for role, unit in units.items()
        }
        return curve_of_columns(
            key,
            source,
            values,
            rows=rows,
            row_word=table.text.word,
            s=_agreed("s", _constant("s", values, state, table, picked), named),
            phi=_agreed("phi", _constant("phi", values, state, table, picked), named),
            time=time_values(table, roles, picked, options),
            direction=state.get("direction", (1.0, 0.0)),
            unread=tuple(table.names[i] for i in unread),
            conditions=(
                *state.get("conditions", ()),
                *(named.conditions if named else ()),
                *conditions_of(table, unread, picked),
            ),
        )
    except Fault as fault:
        return bad(*key, source, fault)


def _agreed(role: str, own: float | None, named: FileIdentity | None) -> float | None:
    """Position of a curve by the table and by the name of its file."""
    of_name, unit = getattr(named, role, None), "mm" if role == "s" else "rad"
    return position(role, own, of_name, unit, ("table", "name of the file"))


def _constant(
    role: str, values: dict[str, np.ndarray], state: dict, table: Table, picked: slice
) -> float | None:
    """Position of a curve, which must be the same in all its rows; None if all are empty."""
    column = values.get(role)
    if column is None:
        return state.get(role)
    if np.isfinite(column[0]) and (column == column[0]).all():
        return float(column[0])
    if np.isnan(column).all():
        return None
    unknown = np.isnan(column)
    if unknown.any():
        line = table.lines[picked][int(np.argmax(unknown))]
        raise Fault(
            "position", f"{table.text.word} {line}: {role} is empty or NaN", "give it in every row"
        )
    if not np.isfinite(column).all():
        line = table.lines[picked][int(np.argmin(np.isfinite(column)))]
        raise Fault("position", f"{table.text.word} {line}: {role} is infinite", "correct it")
    if np.ptp(column) > STEADY[role]:
        raise Fault(
            "position",
            f"{role} varies from {np.nanmin(column):g} to {np.nanmax(column):g} within the curve",
            "give each position its own trial",
        )
    return float(column.mean())


def _is_tidy(lines: Lines, options: ReadOptions) -> bool:
    """Whether the first line is a JSON object, or names a column that machine files have not.

    That of specimens; or, beside displacement and force, that of trials or of positions.
    """
    first = next((text for text in lines.texts if not is_comment(text)), None)
    if first is None:
        return False
    if first.lstrip().startswith("{"):
        return True
    try:
        cells = split_cells(first, guess_delimiter(first))
    except Fault:
        return False
    names, units = zip(*map(column_unit, cells), strict=True)
    if {*map(str.lower, names)} & {*ALIASES["specimen"]}:
        return True
    try:
        roles = find_roles(names, options)
    except Fault:
        return False
    return {"displacement", "force"} <= roles.keys() and bool(columns_of_tidy(roles, units))


TIDY = Reader("tidy", read_text=read, read_large=read_large, is_text=_is_tidy)
