"""Tidy CSV or TSV: one row per sample, one table for a whole study."""

import json
from pathlib import Path

import numpy as np

from jaxtrachea.identify.readers.checks import bad
from jaxtrachea.identify.readers.records import (
    BadCurve,
    DataError,
    Fault,
    RawCurve,
    ReadOptions,
    identify_file,
    role_dimension,
)
from jaxtrachea.identify.readers.text import (
    Line,
    Table,
    find_roles,
    guess_delimiter,
    is_comment,
    read_lines,
    read_rows,
    require_roles,
    resolve_unit,
    role_values,
    split_cells,
)
from jaxtrachea.units import column_unit, parse_quantity

NUMERIC = ("s", "phi", "displacement", "force", "sigma")


def read(path: Path, options: ReadOptions) -> list[RawCurve | BadCurve]:
    """Read a tidy table; see docs/measurements.md for the format.

    Args:
        path: the file.
        options: columns, units and naming.

    Returns:
        One record per (specimen, trial) in file order.

    Raises:
        DataError: the header, a unit or the shape of the table is wrong.
    """
    lines = [line for line in read_lines(path) if not is_comment(line)]
    try:
        state, lines = _state(lines)
        table = _table(path, lines)
        roles = find_roles(table.names, options)
        require_roles(roles, table.names)
        units = {
            role: resolve_unit(role, table.units[i], options, f"column {table.names[i]!r}")
            for role, i in roles.items()
            if role in NUMERIC or role.startswith("joint_")
        }
    except Fault as fault:
        raise DataError(f"{path}: {fault}") from None
    except DataError as error:
        raise DataError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    twice = [key for key in state if key in roles]
    if twice:
        raise DataError(f"{path}: {twice[0]} stands in the first line and in a column; remove one")
    groups = _group(table, roles, state, options)
    return [_curve(table, roles, units, state, key, picked) for key, picked in groups.items()]


def _state(lines: list[Line]) -> tuple[dict, list[Line]]:
    """The optional JSON object on the first line: what holds for the whole table."""
    if not lines or not lines[0].text.lstrip().startswith("{"):
        return {}, lines
    try:
        state = json.loads(lines[0].text)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"line {lines[0].number}: not a JSON object ({error}); correct it"
        ) from None
    known: dict = {key: str(state[key]) for key in ("specimen", "trial") if key in state}
    for key in ("s", "phi"):
        if key in state:
            if not isinstance(state[key], str | int | float):
                raise DataError(
                    f'line {lines[0].number}: {key}: expected a quantity with its unit, as "17 mm"'
                )
            try:
                known[key] = parse_quantity(state[key], role_dimension(key))
            except (ValueError, TypeError) as error:
                raise DataError(f"line {lines[0].number}: {key}: {error}") from None
    return known, lines[1:]


def _table(path: Path, lines: list[Line]) -> Table:
    if not lines:
        raise DataError(f"{path}: is empty; expected a header with displacement and force")
    delimiter = guess_delimiter(lines[0].text)
    header = split_cells(lines[0].text, delimiter)
    while header and header[-1] == "":
        header.pop()
    names, units = zip(*map(column_unit, header), strict=True)
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise DataError(
            f"{path}: line {lines[0].number}: column {min(repeated)!r} is there twice; rename one"
        )
    numbers, rows = read_rows(lines[1:], len(header), delimiter)
    if not rows:
        raise DataError(
            f"{path}: no rows below the header in line {lines[0].number}; export it again"
        )
    return Table(path, list(names), list(units), lines[0].number, numbers, rows, delimiter)


def _group(
    table: Table, roles: dict[str, int], state: dict, options: ReadOptions
) -> dict[tuple[str, str], list[int]]:
    """Row indices of each (specimen, trial); a curve must be one block, or it is there twice."""
    name = None if "specimen" in {**roles, **state} else identify_file(table.path, options)
    fixed = {
        "specimen": name.specimen if name else "",
        "trial": (name and name.trial) or "1",
        **state,
    }
    groups: dict[tuple[str, str], list[int]] = {}
    last = None
    for i, row in enumerate(table.rows):
        specimen, trial = (
            row[roles[role]] if role in roles else fixed[role] for role in ("specimen", "trial")
        )
        key = (specimen, trial)
        if not specimen or not trial or not (specimen + trial).isprintable():
            raise DataError(
                f"{table.path}: line {table.lines[i]}: specimen or trial is empty or"
                " unprintable; name both"
            )
        if key != last and key in groups:
            first = table.lines[groups[key][0]]
            raise DataError(
                f"{table.path}: specimen {key[0]!r} trial {key[1]!r} starts in line {first} and"
                f" again in line {table.lines[i]}; keep the rows of a curve together, or rename it"
            )
        groups.setdefault(key, []).append(i)
        last = key
    return groups


def _curve(
    table: Table,
    roles: dict[str, int],
    units: dict[str, str],
    state: dict,
    key: tuple[str, str],
    picked: list[int],
) -> RawCurve | BadCurve:
    rows = np.array([table.lines[i] for i in picked])
    source = f"{table.path}:{rows[0]}-{rows[-1]}"
    try:
        values = {
            role: role_values(table, role, roles[role], picked, unit)
            for role, unit in units.items()
        }
        joints = [role for role in values if role.startswith("joint_")]
        return RawCurve(
            *key,
            source,
            values["displacement"],
            values["force"],
            rows,
            s=_constant("s", values, state, table, picked),
            phi=_constant("phi", values, state, table, picked),
            sigma=values.get("sigma"),
            joint_rings=np.array([int(r[6:]) - 1 for r in joints]) if joints else None,
            joint_displacement=np.stack([values[r] for r in joints], axis=1) if joints else None,
        )
    except Fault as fault:
        return bad(*key, source, fault)


def _constant(
    role: str, values: dict[str, np.ndarray], state: dict, table: Table, picked: list[int]
) -> float | None:
    """Position of a curve, which must be the same in all its rows; None if all are empty."""
    column = values.get(role)
    if column is None:
        return state.get(role)
    if np.isnan(column).all():
        return None
    unknown = np.isnan(column)
    if unknown.any():
        line = table.lines[picked[int(np.argmax(unknown))]]
        raise Fault("position", f"line {line}: {role} is empty or NaN", "give it in every row")
    if not np.allclose(column, column[0], rtol=1e-9, atol=1e-12):
        raise Fault(
            "position",
            f"{role} varies from {np.nanmin(column):g} to {np.nanmax(column):g} within the curve",
            "give each position its own trial",
        )
    return float(column[0])
