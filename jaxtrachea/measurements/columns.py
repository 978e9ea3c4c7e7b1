"""From the columns of a table, by role, to a curve."""

from collections.abc import Mapping

import numpy as np

from jaxtrachea.measurements.curve import Fault, RawCurve


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
        Fault: a marker has a sideward column and no other ("column_missing").
    """
    return RawCurve(
        *key,
        source,
        values["displacement"],
        values["force"],
        sigma=values.get("sigma"),
        side_force=values.get("side_force"),
        **_markers(values),
        **_ends(values),
        **fields,
    )


def _markers(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fields of the markers; NaN where a marker has no sideward column."""
    roles = [role for role in values if role.startswith("joint_")]
    normal = [role for role in roles if not role.endswith("_side")]
    sides = [role for role in roles if role.endswith("_side")]
    for role in sides:
        if role.removesuffix("_side") not in normal:
            raise Fault(
                "column_missing",
                f"there is a column for {role} and none for {role.removesuffix('_side')}",
                "add it, along the inward normal; empty where it was not seen",
            )
    if not normal:
        return {}
    found = {
        "joint_rings": np.array([int(role.split("_")[1]) - 1 for role in normal]),
        "joint_displacement": np.stack([values[role] for role in normal], axis=1),
    }
    if sides:
        unseen = np.full(len(values["displacement"]), np.nan)
        columns = [values.get(f"{role}_side", unseen) for role in normal]
        found["joint_side_displacement"] = np.stack(columns, axis=1)
    return found


def _ends(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fields of the ends of the rings; NaN where an end or a component has no column."""
    roles = [role.split("_") for role in values if role.startswith("end_")]
    if not roles:
        return {}
    rings = list(dict.fromkeys(int(ring) for _, _, ring, _ in roles))
    found = {"end_rings": np.array(rings) - 1}
    for end in dict.fromkeys(end for _, end, _, _ in roles):
        moved = np.full((len(values["displacement"]), len(rings), 2), np.nan)
        for k, ring in enumerate(rings):
            for c, axis in enumerate("yz"):
                moved[:, k, c] = values.get(f"end_{end}_{ring}_{axis}", np.nan)
        found[f"end_{end}"] = moved
    return found
