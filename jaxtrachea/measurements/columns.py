"""From the columns of a table, by role, to a curve."""

import functools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxtrachea.measurements.curve import Fault, RawCurve
from jaxtrachea.measurements.observed import OBSERVED, RINGS, Quantity
from jaxtrachea.measurements.roles import ring_role_of


def curve_of_columns(
    key: tuple[str, str], source: str, values: Mapping[str, np.ndarray], **fields
) -> RawCurve:
    """The curve of a table's columns.

    Args:
        key: specimen and trial.
        source: file and place.
        values: columns by role, in mm and N, (N,) each.
        fields: the other fields of the curve.

    Raises:
        Fault: a column is there without the one that belongs to it ("column_missing").
    """
    sampled = {q.name: values[q.role] for q in OBSERVED if q.rings is None and q.role in values}
    for layout in _layouts(tuple(values)):
        sampled |= _of_rings(layout, values)
    both = values["displacement"], values["force"]
    return RawCurve(*key, source, *both, **sampled, **fields)


class _Layout(NamedTuple):
    """Where a table has what is measured of rings: numbering field, rings, quantities."""

    field: str
    rings: tuple[int, ...]
    quantities: tuple[Quantity, ...]


@functools.lru_cache(maxsize=256)
def _layouts(names: tuple[str, ...]) -> tuple[_Layout, ...]:
    """What is measured of rings, by the roles of a table: once for all curves of a header."""
    found = []
    of_ring = [of[1] for name in names if (of := ring_role_of(name.lower()))]
    for field, quantities in RINGS.items():
        own = {q.name: [r for r in of_ring if {*q.columns(r)} & {*names}] for q in quantities}
        for q in quantities:
            for ring in own[q.name]:
                if q.requires is not None and ring not in own[q.requires]:
                    (other,) = next(o for o in quantities if o.name == q.requires).columns(ring)
                    raise Fault(
                        "column_missing",
                        f"there is a column for {q.columns(ring)[0]} and none for {other}",
                        "add it, along the inward normal; empty where it was not seen",
                    )
        rings = tuple(
            dict.fromkeys(r for q in quantities if q.requires is None for r in own[q.name])
        )
        if rings:
            found.append(_Layout(field, rings, tuple(q for q in quantities if own[q.name])))
    return tuple(found)


def _of_rings(layout: _Layout, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fields of what is measured of rings; NaN where a ring or a component has no column."""
    unseen = np.full(len(values["displacement"]), np.nan)
    fields = {layout.field: np.array(layout.rings) - 1}
    for q in layout.quantities:
        columns = [values.get(role, unseen) for ring in layout.rings for role in q.columns(ring)]
        shape = q.shape(len(unseen), len(layout.rings))
        fields[q.name] = np.stack(columns, axis=1).reshape(shape)
    return fields
