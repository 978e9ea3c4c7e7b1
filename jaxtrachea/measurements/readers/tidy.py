"""Tidy CSV or TSV: one row per sample, one table for a whole study."""

import json
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxtrachea.files.table import unquoted
from jaxtrachea.measurements.checks import POSITION_TOLERANCE, bad, position
from jaxtrachea.measurements.columns import curve_of_columns
from jaxtrachea.measurements.curve import (
    BadCurve,
    DataError,
    Fault,
    RawCurve,
    ReadOptions,
)
from jaxtrachea.measurements.file_names import FileIdentity, identify_file, numbers_of
from jaxtrachea.measurements.readers.column_roles import (
    ALIASES,
    columns_of_tidy,
    find_roles,
    name_and_unit,
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
    blocks_of,
    guess_delimiter,
    header_at,
    header_cells,
    is_number,
    rows_below,
    split_cells,
    unit_of_role,
)
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role, role_dimension
from jaxtrachea.units import parse_quantity

NUMERIC = ("s", "phi", *SAMPLED)
#: How much a condition, such as a temperature, may vary within a curve, as a share of it.
STEADY_CONDITION = 0.05


def read(text: Text, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read a tidy table; see docs/measurements.md for the format.

    Returns:
        One record per (specimen, trial) in file order.

    Raises:
        DataError: the header, a unit or the shape of the table is wrong.
    """
    text = with_delimiters(text)
    try:
        state, lines = read_state(text)
        header = read_header(text, lines)
        table = rows_below(text, header)
        if not table.lines.size:
            raise DataError(
                f"no rows below the header in {text.word} {header.line}",
                cure="export it again",
            )
        roles = find_roles(header.names, options, header.units)
        require_roles(roles, header.names)
        units = {
            role: _unit(role, table, roles[role], options)
            for role in roles
            if role in NUMERIC or is_ring_role(role)
        }
        return _curves(table, roles, units, state, options)
    except Fault as fault:
        raise DataError(fault.message, place=text.place, cure=fault.cure) from None
    except DataError as error:
        raise DataError.like(error, place=error.place or text.place) from None


def with_delimiters(text: Text) -> Text:
    """The text as it is; with tabs where blanks alone separate the columns of its header."""
    at = 1 if text.lines and text.lines[0].text.lstrip().startswith("{") else 0
    two = text.lines[at : at + 2]
    if len(two) < 2 or any(d in two[0].text for d in DELIMITERS):
        return text
    # Words of a sentence are no columns: the row below must have as many numbers and names.
    begin = Text(text.path, "\n".join(line.text for line in two).encode()).with_tabs(1)
    names, row = (header_cells(line.text, "\t") for line in begin.lines)
    if len(names) != len(row) or sum(map(is_number, row)) < 2:
        return text
    return text.with_tabs(1)


def read_state(text: Text) -> tuple[dict, list[Line]]:
    """The optional JSON object on the first line: what holds for the whole table.

    Returns:
        What it says, in mm and rad, and the lines after it.

    Raises:
        DataError: it is no JSON object, or a value of it has another type or no unit.
    """
    lines = text.lines
    if not lines or not lines[0].text.lstrip().startswith("{"):
        return {}, lines
    place = f"{text.word} {lines[0].number}"
    try:
        state = json.loads(lines[0].text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{place}: not a JSON object ({error})", cure="correct it") from None
    known: dict = {key: str(state[key]) for key in ("specimen", "trial") if key in state}
    read = ("specimen", "trial", "s", "phi", "direction")
    known["conditions"] = numbers_of({k: v for k, v in state.items() if k not in read})
    for key in ("s", "phi"):
        if key in state:
            if not isinstance(state[key], str | int | float):
                raise DataError(
                    f'{place}: {key}: expected a quantity with its unit, as "17 mm"',
                )
            try:
                known[key] = parse_quantity(state[key], role_dimension(key))
            except (ValueError, TypeError) as error:
                raise DataError(f"{place}: {key}: {error}") from None
    if "direction" in state:
        known["direction"] = _two_numbers(state["direction"], place)
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


def read_header(text: Text, lines: Sequence[Line]) -> Header:
    """The names of the columns and their units, from the first line or a row of units below it.

    Raises:
        DataError: there is no line, or a column comes twice.
        Fault: quotes do not match.
    """
    expected = "expected a header with displacement and force"
    if not lines:
        raise DataError("is empty", cure=expected)
    delimiter = guess_delimiter(lines[0].text)
    split_cells(lines[0].text, delimiter)
    header = header_at(lines, 0, delimiter)
    if header is None:
        raise DataError(f"{text.word} {lines[0].number} names no column", cure=expected)
    repeated = {name for name in header.names if name and header.names.count(name) > 1}
    if repeated:
        raise DataError(
            f"{text.word} {lines[0].number}: column {min(repeated)!r} is there twice",
            cure="rename one",
        )
    return header


def _unit(role: str, table: Table, i: int, options: ReadOptions) -> str:
    """Unit of a role; of a position with the cure for a column that is none."""
    try:
        return unit_of_role(role, table, i, options, f"column {table.names[i]!r}")
    except Fault as fault:
        if role not in ("s", "phi"):
            raise
        cure = f'{fault.cure}; if it is no position, rename it, or set format = "machine"'
        raise Fault(fault.kind, fault.message, cure) from None


def _curves(
    table: Table, roles: dict[str, int], units: dict[str, str], state: dict, options: ReadOptions
) -> list[RawCurve | BadCurve]:
    """A record of each curve, in the order of the table."""
    twice = [key for key in state if key in roles]
    if twice:
        raise DataError(f"{twice[0]} stands in the first line and in a column", cure="remove one")
    names = table.names
    time = time_column(names, table.header.units, roles, options)
    texts = {roles[role] for role in ("specimen", "trial") if role in roles}
    numbers = {roles[role] for role in units} | ({time[0]} if time else set())
    unused_columns = [i for i, name in enumerate(names) if name and i not in texts | numbers]
    table.load({*numbers, *unused_columns}, texts)
    named = _named(table.text, {*roles, *state}, options)
    groups = _group(table, roles, state, named)
    starts = np.array([rows.start for rows in groups.values()])
    table.check_groups(numbers, starts)
    if time and time[1] is None and table.is_read(time[0]):  # numbers without a unit
        unused_columns.append(time[0])
    study = _Study(
        table=table, roles=roles, units=units, state=state, named=named,
        unused_columns=unused_columns, options=options,
    )  # fmt: skip
    return [_curve(study, key, rows) for key, rows in groups.items()]


class _Study(NamedTuple):
    """What all curves of a table have in common.

    Attributes:
        table: with its columns.
        roles: column of each role.
        units: unit of each role of numbers.
        state: from the first line.
        named: from the name of the file.
        unused_columns: columns without a role.
        options: columns, units and naming.
    """

    table: Table
    roles: dict[str, int]
    units: dict[str, str]
    state: dict
    named: FileIdentity | None
    unused_columns: list[int]
    options: ReadOptions


def _named(text: Text, told: set[str], options: ReadOptions) -> FileIdentity | None:
    """What the name of the file tells; None if all is told in it."""
    pattern = options.name_pattern
    more = pattern is not None and pattern.groupindex.keys() - {"specimen", "trial"}
    return identify_file(text.path, options) if more or "specimen" not in told else None


def _group(
    table: Table, roles: dict[str, int], state: dict, named: FileIdentity | None
) -> dict[tuple[str, str], slice]:
    """Rows of each (specimen, trial); a curve must be one block, or it is there twice."""
    name = None if "specimen" in {**roles, **state} else named
    fixed = {
        "specimen": name.specimen if name else "",
        "trial": (name and name.trial) or table.text.trial,
        **state,
    }
    columns = {r: table.names_of(roles[r]) for r in ("specimen", "trial") if r in roles}
    groups: dict[tuple[str, str], slice] = {}
    last = None
    word = table.text.word
    for i, stop in blocks_of([codes for codes, _ in columns.values()], len(table.lines)):
        specimen, trial = (
            unquoted(columns[role][1][columns[role][0][i]]) if role in columns else fixed[role]
            for role in ("specimen", "trial")
        )
        key = (specimen, trial)
        if key == last:  # written otherwise, as one that an apostrophe protects
            groups[key] = slice(groups[key].start, stop)
            continue
        if fault := _name_fault(table, "specimen", specimen) or _name_fault(table, "trial", trial):
            raise DataError(f"{word} {table.lines[i]}: {fault[0]}", cure=fault[1])
        if key in groups:
            first = table.lines[groups[key].start]
            raise DataError(
                f"specimen {key[0]!r} trial {key[1]!r} starts in {word} {first} "
                f"and again in {word} {table.lines[i]}",
                cure="keep the rows of a curve together, or rename it",
            )
        groups[key], last = slice(i, stop), key
    return groups


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


def _curve(study: _Study, key: tuple[str, str], picked: slice) -> RawCurve | BadCurve:
    table, state, named = study.table, study.state, study.named
    rows = table.lines[picked]
    source = f"{table.text.place}:{rows[0]}-{rows[-1]}"
    try:
        values = {
            role: table.values(role, study.roles[role], picked, unit)
            for role, unit in study.units.items()
        }
        return curve_of_columns(
            key,
            source,
            values,
            rows=rows,
            row_word=table.text.word,
            s=_agreed("s", _constant("s", values, state, table, rows), named),
            phi=_agreed("phi", _constant("phi", values, state, table, rows), named),
            time=table.time(study.roles, study.options, picked),
            direction=state.get("direction", (1.0, 0.0)),
            unused_columns=tuple(table.names[i] for i in study.unused_columns),
            notes=tuple(table.notes),
            conditions=(
                *state.get("conditions", ()),
                *(named.conditions if named else ()),
                *_conditions(table, study.unused_columns, picked),
            ),
        )
    except Fault as fault:
        return bad(*key, source, fault)


def _conditions(
    table: Table, unused_columns: Sequence[int], picked: slice
) -> Iterator[tuple[str, float]]:
    """Columns without a role that hold one number in a curve, but for a twentieth of it."""
    for i in unused_columns:
        try:
            values = np.array([*map(float, table.raw(i)[picked])])
        except ValueError:
            continue
        if values.size and np.ptp(values) <= STEADY_CONDITION * abs(float(values.mean())):
            unit = table.header.units[i]
            yield (f"{table.names[i]} [{unit}]" if unit else table.names[i]), float(values.mean())


def _agreed(role: str, own: float | None, named: FileIdentity | None) -> float | None:
    """Position of a curve by the table and by the name of its file."""
    of_name, unit = getattr(named, role, None), "mm" if role == "s" else "rad"
    return position(role, own, of_name, unit, ("table", "name of the file"))


def _constant(
    role: str, values: dict[str, np.ndarray], state: dict, table: Table, rows: np.ndarray
) -> float | None:
    """Position of a curve, which must be the same in all its rows; None if all are empty."""
    column = values.get(role)
    if column is None:
        return state.get(role)
    if np.isfinite(column[0]) and (column == column[0]).all():
        return float(column[0])
    if np.isnan(column).all():
        return None
    word, unknown = table.text.word, np.isnan(column)
    if unknown.any():
        line = rows[int(np.argmax(unknown))]
        raise Fault("position", f"{word} {line}: {role} is empty or NaN", "give it in every row")
    if not np.isfinite(column).all():
        line = rows[int(np.argmin(np.isfinite(column)))]
        raise Fault("position", f"{word} {line}: {role} is infinite", "correct it")
    if np.ptp(column) > POSITION_TOLERANCE[role]:
        raise Fault(
            "position",
            f"{role} varies from {np.nanmin(column):g} to {np.nanmax(column):g} within the curve",
            "give each position its own trial",
        )
    return float(column.mean())


def _is_tidy(text: Text, options: ReadOptions) -> bool:
    """Whether the first line is a JSON object, or names a column that machine files have not.

    That of specimens, beside another of two or more; or, beside displacement and force, that of
    trials or of positions.
    """
    if not text.lines:
        return False
    if text.lines[0].text.lstrip().startswith("{"):
        return True
    first = with_delimiters(Text(text.path, _beginning(text))).lines[0].text
    try:
        cells = split_cells(first, guess_delimiter(first))
    except Fault:
        return False
    names, units = zip(*map(name_and_unit, cells), strict=True)
    lower = {*map(str.lower, names)}
    pressed = lower & {*ALIASES["displacement"], *ALIASES["force"]}
    if lower & {*ALIASES["specimen"]} and (len(names) > 2 or pressed):
        return True
    try:
        roles = find_roles(names, options, units)
    except Fault:
        return False
    return {"displacement", "force"} <= roles.keys() and bool(columns_of_tidy(roles, units))


def _beginning(text: Text) -> bytes:
    return "\n".join(line.text for line in text.lines[:2]).encode()


TIDY = Reader("tidy", read_text=read, is_text=_is_tidy)
