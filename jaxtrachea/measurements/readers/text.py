"""What all tables share: cells, numbers, units, and which column plays which role."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from jaxtrachea.measurements.curve import DataError, Fault, ReadOptions
from jaxtrachea.measurements.readers.lines import Lines, Text
from jaxtrachea.measurements.roles import general_role, ring_role_of, role_dimension
from jaxtrachea.units import UnitError, column_unit, convert, is_unit, unit_factor

# Column names understood without `ReadOptions.columns`, in lower case.
ALIASES = {
    "specimen": ("specimen",),
    "trial": ("trial",),
    "s": ("s", "s_c"),
    "phi": ("phi", "phi_c"),
    "displacement": ("displacement", "compression", "indentation", "compressive displacement"),
    "force": ("force", "load", "compressive load", "compressive force"),
    "side_force": ("side_force", "side force"),
    "sigma": ("sigma", "force_sigma", "force_noise"),
}
# Roles that a tidy table gives in every row; of a machine file its name gives them, if at all.
OF_TIDY = ("specimen", "trial", "s", "phi")
# Columns of time, taken where they have a unit; they tell the duration of holds.
TIMES = ("time", "elapsed time", "total time", "test time", "running time")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_GROUPS = re.compile(r"[+-]?[1-9]\d{0,2}(?:\.(?:\d{3}\.)*|,(?:\d{3},)*)\d{3}")
_UNGROUPED = re.compile(r"[+-]?\d{1,3}")
_DATE = re.compile(r"\d{4}-\d\d-\d\d|\d\d:\d\d:\d\d")


def split_cells(text: str, delimiter: str) -> list[str]:
    """Cells of one line, stripped; quotes as in CSV.

    Raises:
        Fault: an unbalanced quote.
    """
    if '"' not in text:
        return [cell.strip() for cell in text.split(delimiter)]
    try:
        rows = list(csv.reader([text], delimiter=delimiter, strict=True, skipinitialspace=True))
    except csv.Error as error:
        raise Fault(
            "unparsable", f"quotes do not match ({error})", "close every quote on its line"
        ) from None
    return [cell.strip() for cell in rows[0]]


def guess_delimiter(header: str) -> str:
    """Tab, semicolon or comma, whichever comes first in that order."""
    return next((d for d in "\t;" if d in header), ",")


@dataclass(frozen=True)
class Table:
    """A header and rows of as many cells.

    Attributes:
        text: where it comes from.
        names: column names without units.
        units: column units, None where the header gives none.
        header_line: number of the header, in the file or sheet.
        lines: number of each row.
        columns: the cells of each column; numbers where `large` has read them, NaN where empty.
        delimiter: what separates them.
    """

    text: Text
    names: list[str]
    units: list[str | None]
    header_line: int
    lines: Sequence[int]
    columns: Sequence[list[str] | np.ndarray]
    delimiter: str


def read_columns(
    lines: Lines, width: int, delimiter: str, word: str = "line"
) -> tuple[Sequence[int], list[list[str]]]:
    """Cells of the columns of a table; empty cells beyond the header are dropped.

    Args:
        lines: below the header, without comments.
        width: columns of the header.
        delimiter: what separates cells.
        word: what the lines are called in messages.

    Returns:
        Number of each row, and the cells of each column.

    Raises:
        Fault: a row that has not `width` cells ("ragged"), or unbalanced quotes.
    """
    even = width > 1 and set(map(str.count, lines.texts, repeat(delimiter))) == {width - 1}
    together = delimiter.join(lines.texts) if even else '"'
    if '"' not in together:
        cells = together.split(delimiter)
        if together.split(None, 1) != [together]:
            cells = [*map(str.strip, cells)]
        columns = [cells[k::width] for k in range(width)]
        if all(columns[0]):  # else rows may be empty, and are left out
            return lines.numbers, columns
    numbers, rows = _read_rows(lines, width, delimiter, word)
    return numbers, [*map(list, zip(*rows, strict=True))] or [[] for _ in range(width)]


def _read_rows(
    lines: Lines, width: int, delimiter: str, word: str
) -> tuple[list[int], list[list[str]]]:
    """As `read_columns`, row by row: quotes, empty rows, empty cells at the end, messages."""
    numbers, rows = [], []
    for line in lines:
        try:
            cells = split_cells(line.text, delimiter)
        except Fault as fault:
            raise Fault(fault.kind, f"{word} {line.number}: {fault.message}", fault.cure) from None
        if not any(cells):
            continue
        while len(cells) > width and cells[-1] == "":
            cells.pop()
        if len(cells) != width:
            cure = "complete or remove the row"
            if word == "row" and len(cells) > width:
                cure = "clear the cells beside the table, or give their columns a header"
            elif delimiter == "," and len(cells) > width:
                cure += "; decimal commas need ; or tab between the columns"
            raise Fault(
                "ragged",
                f"{word} {line.number} has {len(cells)} cells, the header has {width}",
                cure,
            )
        numbers.append(line.number)
        rows.append(cells)
    return numbers, rows


def find_roles(names: Sequence[str], options: ReadOptions) -> dict[str, int]:
    """Which column plays which role: by `ReadOptions.columns`, else by the names in `ALIASES`.

    Args:
        names: column names without units.
        options: explicit names.

    Returns:
        Role -> column index, for the roles found.

    Raises:
        Fault: a named column is absent ("column_missing") or a role has several ("ambiguous").
    """
    lower = [name.lower() for name in names]
    found: dict[str, int] = {}
    for role in {**ALIASES, **options.columns}:
        wanted = options.columns.get(role)
        if wanted is None:
            hits = [i for i, name in enumerate(lower) if name in ALIASES[role]]
        else:
            full = {wanted.strip(), column_unit(wanted)[0]}
            hits = [i for i, name in enumerate(names) if name in full]
            if not hits:
                raise _no_column(wanted, role, names)
        if len(hits) > 1:
            several = ", ".join(repr(names[i]) for i in hits)
            raise Fault(
                "ambiguous",
                f"{several} can all be the {role}",
                f"name the one meant in columns.{role}",
            )
        if hits:
            found[role] = hits[0]
    for i, name in enumerate(lower):
        of_ring = ring_role_of(name)
        if of_ring is not None and i not in found.values():
            role, ring = of_ring
            if ring < 1 or role in found:
                raise Fault(
                    "ambiguous", f"column {names[i]!r}: ring below 1 or given twice", "count from 1"
                )
            found[role] = i
    return found


def _no_column(wanted: str, role: str, names: Sequence[str]) -> Fault:
    shown = [repr(name if len(name) <= 60 else f"{name[:56]} ...") for name in names[:30]]
    more = f" and {len(names) - 30} more" if len(names) > 30 else ""
    return Fault(
        "column_missing",
        f"no column {wanted!r} for the {role}; the columns are {', '.join(shown)}{more}",
        f"name it in columns.{role}",
    )


def require_roles(roles: dict[str, int], names: Sequence[str]) -> None:
    """Refuse a table without displacement or force."""
    for role in ("displacement", "force"):
        if role not in roles:
            raise _no_column(role, role, names)


def columns_of_tidy(roles: dict[str, int], units: Sequence[str | None]) -> list[str]:
    """Roles of which every row of a tidy table tells, and which a file of one trial has not.

    Without a column that has another role as well, as a way that its file calls `s`, and without
    one in the unit of something else, as a time.
    """
    others = {i for role, i in roles.items() if role not in OF_TIDY}
    return [
        role
        for role in OF_TIDY
        if role in roles and roles[role] not in others and _may_be(role, units[roles[role]])
    ]


def _may_be(role: str, unit: str | None) -> bool:
    """Whether a column in this unit may have the role; without a unit, and names, always."""
    if unit is None or role in ("specimen", "trial"):
        return True
    try:
        unit_factor(unit, role_dimension(role))
    except UnitError:
        return False
    return True


def units_row(
    lines: Lines, at: int, delimiter: str, units: list[str | None]
) -> tuple[int, list[str | None]]:
    """Some machines put the units in a row of their own below the names: ``(s),(mm),(N)``.

    Args:
        lines: without comments.
        at: place of the header.
        delimiter: what separates cells.
        units: that the header gives, None for each column without.

    Returns:
        Place of the last line of the header, and the units.

    Raises:
        Fault: quotes do not match.
    """
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


def resolve_unit(role: str, found: str | None, options: ReadOptions, place: str) -> str:
    """The unit of a role, from the file or from the options, which must not contradict.

    Args:
        role: e.g. ``"force"``, ``"joint_7"`` or ``"end_U_7_y"``.
        found: the unit the file gives, or None.
        options: units for files that give none.
        place: for messages, e.g. ``"column 'Load'"``.

    Raises:
        Fault: no unit ("unit_missing") or an unknown one ("unit_unknown").
        DataError: file and options contradict each other.
    """
    general = general_role(role)
    given = options.units.get(role, options.units.get(general))
    unit = given if found is None else found
    if unit is None:
        raise Fault(
            "unit_missing",
            f"{place} has no unit",
            f"write it in the header, as in 'force [N]', or give data.units.{general}",
        )
    try:
        factor = unit_factor(unit, role_dimension(role))
    except UnitError as error:
        raise Fault(
            "unit_unknown", f"{place}: {error}", "write one of the accepted units"
        ) from None
    if given is not None and unit_factor(given, role_dimension(role)) != factor:
        raise DataError(
            f"{place} is in {found} but units.{general} says {given}",
            cure="remove the wrong one",
        )
    return unit


def numbers(
    cells: Sequence[str], lines: Sequence[int], name: str, delimiter: str, word: str = "line"
) -> np.ndarray:
    """Numbers of one column; empty cells become NaN.

    A comma counts as the decimal sign where it does not separate the columns, unless another
    cell of the column has a point: then one of the two separates thousands, and both are refused.
    So is the one sign of a column that goes on after 900 with 1.000 (`grouped`).

    Raises:
        Fault: a cell is no number, or may be two ("unparsable").
    """
    if (i := grouped(cells)) is not None:
        raise Fault(
            "unparsable",
            f"{word} {lines[i]}: {name} {cells[i]!r}, among whole numbers of three digits, may be "
            "a thousand times as large",
            "write every number of the column with a decimal sign, or leave thousands separators "
            "out",
        )
    if "_" not in "".join(cells):
        try:
            return np.array([*map(float, cells)])
        except ValueError:
            pass
    values = np.full(len(cells), np.nan)
    pointed = delimiter == "," or any("." in cell for cell in cells)
    for i, cell in enumerate(cells):
        if not cell:
            continue
        if not pointed and _DECIMAL_COMMA.fullmatch(cell):
            cell = cell.replace(",", ".")
        try:
            # float() takes 1_000, which no instrument means.
            values[i] = float("_" if "_" in cell else cell)
        except ValueError:
            shown = cell if len(cell) <= 80 else f"{cell[:76]} ..."
            raise Fault(
                "unparsable",
                f"{word} {lines[i]}: {name} {shown!r} is not a number",
                _number_cure(cell),
            ) from None
    return values


def grouped(cells: Sequence[str]) -> int | None:
    """Place of the first number that may have a thousands separator, if all cells agree with that.

    They do where each is a whole number of at most three digits, some of them above 99, or groups
    of three digits after a sign that none begins with 0.
    """
    first, large = None, False
    for i, cell in enumerate(cells):
        if _GROUPS.fullmatch(cell):
            first = i if first is None else first
        elif not cell or _UNGROUPED.fullmatch(cell):
            large = large or len(cell.lstrip("+-")) == 3
        else:
            return None
    return first if large else None


def _number_cure(cell: str) -> str:
    """What to do about a cell that is no number."""
    if cell.startswith("="):
        return "open the file in a spreadsheet program and save it, so that formulas have values"
    if _DATE.match(cell):
        return "a spreadsheet took it for a date: set the column to numbers and write it anew"
    if "," in cell:
        return "use one decimal sign throughout and no thousands separator"
    return (
        "write numbers as 1.5 or 1.5e-3; leave a missing marker, ring end or side force empty, and "
        "remove a sample without displacement or force"
    )


def role_values(table: Table, role: str, index: int, picked: slice, unit: str) -> np.ndarray:
    """Numbers of some rows of a role's column, in internal units (mm, N, rad, s)."""
    values = table.columns[index][picked]
    if not isinstance(values, np.ndarray):
        lines, name = table.lines[picked], table.names[index]
        values = numbers(values, lines, name, table.delimiter, table.text.word)
    return convert(values, unit, role_dimension(role))


def time_column(
    names: Sequence[str], units: Sequence[str | None], roles: dict[str, int], options: ReadOptions
) -> tuple[int, str] | None:
    """The column of time and its unit: of `columns.time`, else the only one named so.

    Args:
        names: of the columns, without units.
        units: of the columns, None where the header gives none.
        roles: columns by role.
        options: units for columns that have none.

    Returns:
        None if there is no such column, or it has no unit.

    Raises:
        Fault: the column named in the options has no unit.
    """
    if "time" in roles:
        i = roles["time"]
        return i, resolve_unit("time", units[i], options, f"column {names[i]!r}")
    hits = [i for i, name in enumerate(names) if name.lower() in TIMES]
    if len(hits) != 1:
        return None
    try:
        return hits[0], resolve_unit("time", units[hits[0]], options, "column of time")
    except Fault:
        return None


def time_values(
    table: Table, roles: dict[str, int], picked: slice, options: ReadOptions
) -> np.ndarray | None:
    """Time of some rows, s: of `columns.time`, else of the only column named so, if usable.

    Returns:
        The values, or None: there is no such column, it has no unit, or holds no numbers.

    Raises:
        Fault: the column named in the options has no unit or holds text.
    """
    found = time_column(table.names, table.units, roles, options)
    if found is None:
        return None
    index, unit = found
    if "time" in roles:
        return role_values(table, "time", index, picked, unit)
    try:
        values = role_values(table, "time", index, picked, unit)
    except Fault:
        return None
    return values if np.isfinite(values).all() else None
