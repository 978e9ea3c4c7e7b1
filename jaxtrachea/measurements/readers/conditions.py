"""Columns of a tidy table that nothing reads: which they are, and what holds for a whole curve."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxtrachea.measurements.curve import ReadOptions
from jaxtrachea.measurements.readers.text import Table, time_column

#: How much a condition, such as a temperature, may vary within a curve, as a share of it.
STEADY_CONDITION = 0.05


def unread_columns(table: Table, roles: dict[str, int], options: ReadOptions) -> list[int]:
    """The columns that have a name and no role."""
    time = None if "time" in roles else time_column(table.names, table.units, roles, options)
    read = {*roles.values()} if time is None else {*roles.values(), time[0]}
    return [i for i, name in enumerate(table.names) if name and i not in read]


def conditions_of(
    table: Table, unread: Sequence[int], picked: slice
) -> Iterator[tuple[str, float]]:
    """Columns without a role that hold one number in a curve, but for a twentieth of it."""
    for i in unread:
        cells = table.columns[i][picked]
        try:
            values = np.array([*map(float, cells)])
        except ValueError:
            continue
        if values.size and np.ptp(values) <= STEADY_CONDITION * abs(float(values.mean())):
            unit = table.units[i]
            yield (f"{table.names[i]} [{unit}]" if unit else table.names[i]), float(values.mean())
