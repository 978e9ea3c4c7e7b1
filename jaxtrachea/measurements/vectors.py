"""Checks of what a curve holds beside force and displacement: vectors, markers, ends of rings."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from jaxtrachea.measurements.curve import Curve, Fault, RawCurve, ReadOptions

#: A direction whose length differs from 1 by less is taken, and made of length 1.
UNIT_LENGTH = 1e-3
#: Below this difference a length is 1 but for rounding, and its direction left as it is.
_ROUNDING = 1e-12
#: Fields that a curve of force and displacement alone does not have.
FURTHER_FIELDS = (
    "side_force", "joint_rings", "joint_displacement", "joint_side_displacement", "end_rings",
    "end_U", "end_V",
)  # fmt: skip


def listed(rows: Iterable, word: str) -> str:
    """``lines 3, 4, 9 and 12 more``."""
    rows = [int(row) for row in rows]
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return f"{word}{'s' if len(rows) > 1 else ''} {', '.join(map(str, rows[:5]))}{more}"


def check_vector_shapes(raw: RawCurve) -> None:
    """Refuse arrays of markers, ends and side force that do not go with the samples.

    Raises:
        Fault: a shape, a ring number, or one of two that must come together ("shape").
    """
    n = raw.displacement.size
    if raw.side_force is not None and raw.side_force.shape != (n,):
        raise Fault(
            "shape",
            f"side_force has shape {raw.side_force.shape}, expected {(n,)}",
            "store one value per sample, NaN where it was not measured",
        )
    _check_markers(raw, n)
    _check_ends(raw, n)


def _check_markers(raw: RawCurve, n: int) -> None:
    rings, joints, sides = raw.joint_rings, raw.joint_displacement, raw.joint_side_displacement
    if (rings is None) != (joints is None):
        raise Fault(
            "shape", "joint displacements and ring numbers must come together", "store both"
        )
    if rings is None:
        if sides is not None:
            raise Fault(
                "shape",
                "joint_side_displacement needs joint_displacement and joint_ring_number",
                "store them, NaN where the inward part was not seen",
            )
        return
    for name, values in (("joint", joints), ("sideward joint", sides)):
        if values is not None and (rings.ndim != 1 or values.shape != (n, rings.size)):
            raise Fault(
                "shape",
                f"{name} displacements have shape {values.shape},"
                f" expected {(n, rings.size)} (samples, markers)",
                "store one row per sample and one column per ring",
            )
    _check_rings(rings, "a ring number")


def _check_ends(raw: RawCurve, n: int) -> None:
    rings, ends = raw.end_rings, {"end_U": raw.end_U, "end_V": raw.end_V}
    seen = {name: values for name, values in ends.items() if values is not None}
    if rings is None:
        if seen:
            raise Fault(
                "shape", f"{' and '.join(seen)} without end_ring_number", "number the rings, from 1"
            )
        return
    if not seen:
        raise Fault(
            "shape", "end_ring_number without end_U and end_V", "store them, or remove the numbers"
        )
    for name, values in seen.items():
        if rings.ndim != 1 or values.shape != (n, rings.size, 2):
            raise Fault(
                "shape",
                f"{name} has shape {values.shape}, expected {(n, rings.size, 2)}"
                " (samples, rings, components y and z)",
                "store y and z of every ring and sample, NaN where they were not seen",
            )
    _check_rings(rings, "a number in end_ring_number")


def _check_rings(rings: np.ndarray, what: str) -> None:
    if rings.size and (rings.min() < 0 or np.unique(rings).size != rings.size):
        raise Fault(
            "shape", f"{what} is repeated or below 1", "give each ring once, counted from 1"
        )


def check_vector_sizes(raw: RawCurve, options: ReadOptions) -> None:
    """Refuse infinite values, and sizes that no press reaches; NaN stands for not observed.

    Raises:
        Fault: "non_finite" or "absurd_scale".
    """
    length, force = (options.max_displacement, "mm"), (options.max_force, "N")
    quantities = (
        # The scale of the inward part of markers has never been bounded.
        ("a joint displacement", raw.joint_displacement, np.inf, "mm"),
        ("a sideward joint displacement", raw.joint_side_displacement, *length),
        ("the motion of an end U", raw.end_U, *length),
        ("the motion of an end V", raw.end_V, *length),
        ("side_force", raw.side_force, *force),
    )
    for name, values, limit, unit in quantities:
        if values is None:
            continue
        size = np.abs(values).reshape(len(values), -1)
        if np.isinf(size).any():
            rows = raw.rows[np.isinf(size).any(axis=1)]
            what = "what" if name == "side_force" else "a marker that"
            raise Fault(
                "non_finite",
                f"{name} is infinite in {listed(rows, raw.row_word)}",
                f"leave {what} was not seen empty or NaN",
            )
        rows = (size > limit).any(axis=1)
        if rows.any():
            raise Fault(
                "absurd_scale",
                f"{name} is more than {limit:g} {unit} in {listed(raw.rows[rows], raw.row_word)}",
                "check its unit",
            )


def unit_direction(raw: RawCurve) -> tuple[float, float]:
    """Direction of the tool's displacement with length 1.

    Raises:
        Fault: not two finite numbers, not of length 1, or outward ("direction").
    """
    found = np.asarray(raw.direction, dtype=np.float64)
    shown = "(" + ", ".join(f"{v:g}" for v in np.ravel(found)[:5]) + ")"
    if found.shape != (2,) or not np.isfinite(found).all():
        raise Fault(
            "direction",
            f"direction is {shown}, expected two finite numbers",
            "give its components along the inward normal and along the circumference",
        )
    length = float(np.hypot(*found))
    if not abs(length - 1) <= UNIT_LENGTH:
        raise Fault(
            "direction",
            f"direction {shown} has the length {length:.4g}, expected 1",
            "divide it by its length, and give the displacement along it",
        )
    if found[0] < -_ROUNDING:
        raise Fault(
            "direction",
            f"direction {shown} points outward; displacement counts positive inward",
            "turn it round, and the signs of displacement, force and side force with it",
        )
    unit = found if abs(length - 1) <= _ROUNDING else found / length
    return float(unit[0]), float(unit[1])


def vectors_of(raw: RawCurve, keep: np.ndarray, options: ReadOptions) -> dict[str, np.ndarray]:
    """Fields of a curve for markers, ends and side force: the samples kept, as float64.

    Args:
        raw: the curve as read, checked.
        keep: (N,) samples of the curve.
        options: `force_sign` turns the side force too; markers and ends keep their axes.
    """
    turned = None if raw.side_force is None else options.force_sign * raw.side_force
    sampled = {
        "joint_displacement": raw.joint_displacement,
        "joint_side_displacement": raw.joint_side_displacement,
        "end_U": raw.end_U,
        "end_V": raw.end_V,
        "side_force": turned,
    }
    fields = {
        name: np.ascontiguousarray(values[keep], dtype=np.float64)
        for name, values in sampled.items()
        if values is not None
    }
    for name in ("joint_rings", "end_rings"):
        rings = getattr(raw, name)
        if rings is not None:
            fields[name] = rings.astype(np.int64)
    return fields


def tilt_of(direction: Sequence[float]) -> float:
    """Angle of a tool's direction to the inward normal, rad, positive towards growing phi."""
    return math.atan2(direction[1], direction[0])


def vector_words(curve: Curve) -> str:
    """What a curve holds beside forces and markers along the normal, for a table; may be empty."""

    def observed(name: str) -> bool:
        values = getattr(curve, name)
        return values is not None and bool(np.isfinite(values).any())

    ends = [name[-1] for name in ("end_U", "end_V") if observed(name)]
    rings = 0 if curve.end_rings is None else curve.end_rings.size
    angle = np.degrees(tilt_of(curve.direction))
    words = {
        "side force": observed("side_force"),
        "markers aside": observed("joint_side_displacement"),
        f"ends {' and '.join(ends)} of {rings} rings": bool(ends),
        f"tool {angle:.3g}° off the normal": tuple(curve.direction) != (1.0, 0.0),
    }
    return ", ".join(word for word, held in words.items() if held)
