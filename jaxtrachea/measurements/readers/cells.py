"""Numbers and times of day in the cells of a column: the notation is decided before a conversion.

A comma or a point may be the decimal sign or separate thousands. All cells of a curve's column are
looked at first; where they allow both, the column is refused.
"""

import re
from collections.abc import Sequence

import numpy as np

from jaxtrachea.measurements.curve import Fault

MINUS = "\u2212"
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_GROUPS = re.compile(r"[+-]?[1-9]\d{0,2}(?:\.(?:\d{3}\.)*|,(?:\d{3},)*)\d{3}")
_UNGROUPED = re.compile(r"[+-]?\d{1,3}")
_GROUPED_DECIMAL = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+\.\d*")
_GROUPED_WHOLE = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_DATE = re.compile(r"\d{4}-\d\d-\d\d|\d\d:\d\d:\d\d")
_CLOCK = re.compile(
    r"(?:\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[ T])?(\d{1,3}):([0-5]?\d):([0-5]?\d(?:[.,]\d*)?)"
)
_MINUTES = re.compile(r"()(\d{1,3}):([0-5]?\d[.,]\d+)")


def numbers(
    cells: Sequence[str],
    lines: Sequence[int] | np.ndarray,
    name: str,
    delimiter: str,
    word: str = "line",
) -> np.ndarray:
    """Numbers of one column; empty cells become NaN.

    - Without a point in the column a comma is the decimal sign; where it separates the columns,
      too, some cell must show that it separates no thousands.
    - Thousands may be separated by commas in quotes, where some cell has a point after them.
    - One sign alone in groups of three digits is refused: 1,234 may be 1.234 or 1234.

    Raises:
        Fault: a cell is no number, or may be two ("unparsable").
    """
    if any(MINUS in cell for cell in cells):
        cells = [cell.replace(MINUS, "-") for cell in cells]
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
    comma = _meaning_of_comma(cells, delimiter)
    for i, cell in enumerate(cells):
        if not cell:
            continue
        if comma == "decimal" and _DECIMAL_COMMA.fullmatch(cell):
            cell = cell.replace(",", ".")
        elif comma == "thousands" and (
            _GROUPED_DECIMAL.fullmatch(cell) or _GROUPED_WHOLE.fullmatch(cell)
        ):
            cell = cell.replace(",", "")
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


def _meaning_of_comma(cells: Sequence[str], delimiter: str) -> str:
    """What a comma stands for in a column: "decimal", "thousands" or "" (nobody knows)."""
    commas = [cell for cell in cells if "," in cell]
    if not any("." in cell for cell in cells):
        sure = delimiter != "," or not all(map(_GROUPED_WHOLE.fullmatch, commas))
        return "decimal" if sure else ""
    proven = any(map(_GROUPED_DECIMAL.fullmatch, commas))
    return "thousands" if delimiter == "," and proven else ""


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


def may_be_grouped(values: np.ndarray, starts: np.ndarray) -> bool:
    """Whether `grouped` may find thousands separators in the cells of some curve, by its numbers.

    Args:
        values: (N,) of a column, read with a decimal sign.
        starts: first row of each curve.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.abs(values)
        whole = size == np.floor(size)
        thousands = 1e3 * size
        group = (thousands >= 1e3) & (np.abs(thousands - np.round(thousands)) < 1e-6)
        fits = np.isnan(size) | ((size < 1000) & (whole | group))
        large = whole & (size >= 100)
    return bool(
        np.any(np.logical_and.reduceat(fits, starts) & np.logical_or.reduceat(large, starts))
    )


def seconds(cells: Sequence[str]) -> np.ndarray | None:
    """Times of day, ``10:15:30.5`` with or without a date, as seconds; None: some cell is none.

    Of two parts, ``15:30.5``, the last must have a fraction: 10:15 may be hours and minutes.
    """
    found = [_CLOCK.fullmatch(cell) or _MINUTES.fullmatch(cell) for cell in cells]
    if not found or not all(found):
        return None
    parts = [(m[1] or "0", m[2], m[3].replace(",", ".")) for m in found if m]
    return np.array([3600 * int(h) + 60 * int(m) + float(s) for h, m, s in parts])


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
