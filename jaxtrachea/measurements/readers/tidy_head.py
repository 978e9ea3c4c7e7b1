"""The head of a tidy table: what holds for all of it, its columns and their roles."""

import json
from typing import NamedTuple

from jaxtrachea.measurements.curve import DataError, Fault, ReadOptions
from jaxtrachea.measurements.file_names import numbers_of
from jaxtrachea.measurements.readers.lines import Lines, Text
from jaxtrachea.measurements.readers.text import (
    find_roles,
    guess_delimiter,
    require_roles,
    resolve_unit,
    split_cells,
    units_row,
)
from jaxtrachea.measurements.roles import SAMPLED, is_ring_role, role_dimension
from jaxtrachea.units import column_unit, parse_quantity

NUMERIC = ("s", "phi", *SAMPLED)


class Header(NamedTuple):
    """The line with the names of the columns.

    Attributes:
        names: of the columns, without units.
        units: of the columns, None where the header gives none.
        line: its number.
        delimiter: what separates cells.
        below: place of the first row of the table.
    """

    names: list[str]
    units: list[str | None]
    line: int
    delimiter: str
    below: int


def read_state(lines: Lines, word: str) -> tuple[dict, Lines]:
    """The optional JSON object on the first line: what holds for the whole table.

    Args:
        lines: without comments.
        word: what the lines are called in messages.

    Returns:
        What it says, in mm and rad, and the lines after it.

    Raises:
        DataError: it is no JSON object, or a value of it has another type or no unit.
    """
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
    read = ("specimen", "trial", "s", "phi", "direction")
    known["conditions"] = numbers_of({k: v for k, v in state.items() if k not in read})
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


def read_header(text: Text, lines: Lines) -> Header:
    """The names of the columns and their units, from the first line or a row of units below it.

    Raises:
        DataError: there is no line, or a column comes twice.
        Fault: quotes do not match.
    """
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
    if not header:
        raise DataError(
            f"{text.word} {lines[0].number} names no column",
            place=text.place,
            cure="expected a header with displacement and force",
        )
    names, units = zip(*map(column_unit, header), strict=True)
    repeated = {name for name in names if name and names.count(name) > 1}
    if repeated:
        raise DataError(
            f"{text.word} {lines[0].number}: column {min(repeated)!r} is there twice",
            place=text.place,
            cure="rename one",
        )
    last, units = units_row(lines, 0, delimiter, list(units))
    return Header(list(names), units, lines[0].number, delimiter, last + 1)


def roles_and_units(header: Header, options: ReadOptions) -> tuple[dict[str, int], dict[str, str]]:
    """Column of each role, and the unit of each role of numbers.

    Raises:
        Fault: as `find_roles`, `require_roles` and `resolve_unit`.
        DataError: as `resolve_unit`.
    """
    roles = find_roles(header.names, options)
    require_roles(roles, header.names)
    units = {
        role: _unit(role, header.units[i], options, f"column {header.names[i]!r}")
        for role, i in roles.items()
        if role in NUMERIC or is_ring_role(role)
    }
    return roles, units


def _unit(role: str, found: str | None, options: ReadOptions, place: str) -> str:
    """`resolve_unit`; of a position with the cure for a column that is none."""
    try:
        return resolve_unit(role, found, options, place)
    except Fault as fault:
        if role not in ("s", "phi"):
            raise
        cure = f'{fault.cure}; if it is no position, rename it, or set format = "machine"'
        raise Fault(fault.kind, fault.message, cure) from None
