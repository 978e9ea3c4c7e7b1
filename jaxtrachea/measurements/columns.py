"""From the columns of a table, by role, to a curve."""

from collections.abc import Mapping

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
    for field, quantities in RINGS.items():
        sampled |= _of_rings(field, quantities, values)
    both = values["displacement"], values["force"]
    return RawCurve(*key, source, *both, **sampled, **fields)


def _of_rings(
    field: str, quantities: tuple[Quantity, ...], values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Fields of what is measured of rings; NaN where a ring or a component has no column."""
    found = {name: ring_role_of(name.lower()) for name in values}
    own = {q.name: [r for _, r in filter(None, found.values()) if {*q.columns(r)} & {*values}]
           for q in quantities}  # fmt: skip
    for q in quantities:
        for ring in own[q.name]:
            if q.beside is not None and ring not in own[q.beside]:
                (other,) = next(o for o in quantities if o.name == q.beside).columns(ring)
                raise Fault(
                    "column_missing",
                    f"there is a column for {q.columns(ring)[0]} and none for {other}",
                    "add it, along the inward normal; empty where it was not seen",
                )
    rings = [*dict.fromkeys(r for q in quantities if q.beside is None for r in own[q.name])]
    if not rings:
        return {}
    unseen = np.full(len(values["displacement"]), np.nan)
    fields = {field: np.array(rings) - 1}
    for q in quantities:
        if own[q.name]:
            columns = [values.get(role, unseen) for ring in rings for role in q.columns(ring)]
            shape = q.shape(len(unseen), len(rings))
            fields[q.name] = np.stack(columns, axis=1).reshape(shape)
    return fields
