"""Tidy CSV or TSV: one row per sample, one table for a whole study."""

import json
from collections.abc import Iterator
from itertools import compress, islice, pairwise
from operator import ne

import numpy as np

from jaxtrachea.files.tables import unquoted
from jaxtrachea.measurements.checks import STEADY, bad
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import (
    BadCurve,
    DataError,
    Fault,
    RawCurve,
    ReadOptions,
    identify_file,
)
from jaxtrachea.measurements.readers.lines import Lines, Text, is_comment
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.text import (
    ALIASES,
    Table,
    find_roles,
    guess_delimiter,
    read_columns,
    require_roles,
    resolve_unit,
    role_values,
    split_cells,
    time_values,
)
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role, role_dimension
from jaxtrachea.units import column_unit, parse_quantity

NUMERIC = ("s", "phi", *SAMPLED)


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
        state, lines = _state(lines, text.word)
        table = _table(text, lines)
        roles = find_roles(table.names, options)
        require_roles(roles, table.names)
        units = {
            role: resolve_unit(role, table.units[i], options, f"column {table.names[i]!r}")
            for role, i in roles.items()
            if role in NUMERIC or is_ring_role(role)
        }
    except Fault as fault:
        raise DataError(fault.message, place=place, cure=fault.cure) from None
    except DataError as error:
        raise DataError.like(error, place=error.place or place) from None
    twice = [key for key in state if key in roles]
    if twice:
        raise DataError(
            f"{twice[0]} stands in the first line and in a column",
            place=place,
            cure="remove one",
        )
    groups = _group(table, roles, state, options)
    return [
        _curve(table, roles, units, state, key, picked, options) for key, picked in groups.items()
    ]


def _state(lines: Lines, word: str) -> tuple[dict, Lines]:
    """The optional JSON object on the first line: what holds for the whole table."""
    if not lines or not lines[0].text.lstrip().startswith("{"):
        return {}, lines
    try:
        state = json.loads(lines[0].text)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{word} {lines[0].number}: not a JSON object ({error})",
            cure="correct it",
        ) from None
    known: dict = {key: str(state[key]) for key in ("specimen", "trial") if key in state}
    for key in ("s", "phi"):
        if key in state:
            if not isinstance(state[key], str | int | float):
                raise DataError(
                    f"{word} {lines[0].number}: {key}: expected a quantity with its unit, as "
                    '"17 mm"',
                )
            try:
                known[key] = parse_quantity(state[key], role_dimension(key))
            except (ValueError, TypeError) as error:
                raise DataError(
                    f"{word} {lines[0].number}: {key}: {error}",
                ) from None
    if "direction" in state:
        known["direction"] = _two_numbers(state["direction"], f"{word} {lines[0].number}")
    return known, lines[1:]


def _two_numbers(value: object, line: str) -> tuple[float, ...]:
    """The direction of the tool from the first line; its length is checked later."""
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 2 or any(type(v) not in (int, float) for v in numbers):
        raise DataError(
            f"{line}: direction is {json.dumps(value)[:80]}, expected two numbers, as [0.8, 0.6]",
            cure="give the components along the inward normal and along the circumference",
        )
    return tuple(map(float, numbers))


def _table(text: Text, lines: Lines) -> Table:
    if not lines:
        raise DataError(
            "is empty",
            place=text.place,
            cure="expected a header with displacement and force",
        )
    delimiter = guess_delimiter(lines[0].text)
    header = split_cells(lines[0].text, delimiter)
    while header and header[-1] == "":
        header.pop()
    names, units = zip(*map(column_unit, header), strict=True)
    repeated = {name for name in names if name and names.count(name) > 1}
    if repeated:
        raise DataError(
            f"{text.word} {lines[0].number}: column {min(repeated)!r} is there twice",
            place=text.place,
            cure="rename one",
        )
    numbers, columns = read_columns(lines[1:], len(header), delimiter, text.word)
    if not numbers:
        raise DataError(
            f"no rows below the header in {text.word} {lines[0].number}",
            place=text.place,
            cure="export it again",
        )
    return Table(
        text=text,
        names=list(names),
        units=list(units),
        header_line=lines[0].number,
        lines=numbers,
        columns=columns,
        delimiter=delimiter,
    )


def _group(
    table: Table, roles: dict[str, int], state: dict, options: ReadOptions
) -> dict[tuple[str, str], slice]:
    """Rows of each (specimen, trial); a curve must be one block, or it is there twice."""
    name = None if "specimen" in {**roles, **state} else identify_file(table.text.path, options)
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


def _blocks(columns: list[list[str]], count: int) -> Iterator[tuple[int, int]]:
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
    key: tuple[str, str],
    picked: slice,
    options: ReadOptions,
) -> RawCurve | BadCurve:
    rows = np.array(table.lines[picked])
    source = f"{table.text.place}:{rows[0]}-{rows[-1]}"
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
            s=_constant("s", values, state, table, picked),
            phi=_constant("phi", values, state, table, picked),
            time=time_values(table, roles, picked, options),
            direction=state.get("direction", (1.0, 0.0)),
        )
    except Fault as fault:
        return bad(*key, source, fault)


def _constant(
    role: str, values: dict[str, np.ndarray], state: dict, table: Table, picked: slice
) -> float | None:
    """Position of a curve, which must be the same in all its rows; None if all are empty."""
    column = values.get(role)
    if column is None:
        return state.get(role)
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
    return float(column[0] if np.ptp(column) == 0 else column.mean())


def _is_tidy(lines: Lines) -> bool:
    """Whether the first line is a JSON object, or names a column of specimens."""
    first = next((text for text in lines.texts if not is_comment(text)), None)
    if first is None:
        return False
    if first.lstrip().startswith("{"):
        return True
    try:
        cells = split_cells(first, guess_delimiter(first))
    except Fault:
        return False
    names = {column_unit(cell)[0].lower() for cell in cells}
    return bool(names & set(ALIASES["specimen"]))


TIDY = Reader("tidy", read_text=read, is_text=_is_tidy)
