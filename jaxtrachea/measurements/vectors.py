"""Checks of what a curve holds beside force and displacement: vectors, markers, ends of rings."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxtrachea.measurements.curve import Curve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.observed import OBSERVED, RING_NUMBERS, RINGS, VECTORS, Quantity

#: A direction whose length differs from 1 by less is taken, and made of length 1.
UNIT_LENGTH = 1e-3
#: Below this difference a length is 1 but for rounding, and its direction left as it is.
_ROUNDING = 1e-12


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
    for field, quantities in RINGS.items():
        _check_rings(raw, field, [q for q in quantities if getattr(raw, q.name) is not None])
    for q in OBSERVED:
        values = getattr(raw, q.name)
        if values is None or not q.gaps:
            continue
        if q.requires is not None and getattr(raw, q.requires) is None:
            raise Fault(
                "shape",
                f"{q.name} needs {q.requires}",
                "store it, NaN where it was not seen",
            )
        rings = None if q.rings is None else getattr(raw, q.rings)
        expected = q.shape(raw.displacement.size, 0 if rings is None else rings.size)
        if values.shape != expected:
            axes = "samples", "rings", f"components {' and '.join(q.components)}"
            raise Fault(
                "shape",
                f"{q.name} has shape {values.shape}, expected {expected}"
                f" ({', '.join(axes[: len(expected)])})",
                "store a value for all of these, NaN where it was not seen",
            )


def _check_rings(raw: RawCurve, field: str, given: Sequence[Quantity]) -> None:
    """Refuse ring numbers without what they number, and the reverse."""
    rings, names = getattr(raw, field), " and ".join(q.name for q in given)
    number = RING_NUMBERS[field]
    if rings is None and given:
        raise Fault("shape", f"{names} without {number}", "number the rings, from 1")
    if rings is None:
        return
    if not given:
        every = " and ".join(q.name for q in RINGS[field] if q.requires is None)
        raise Fault("shape", f"{number} without {every}", "store it, or remove the numbers")
    if rings.ndim != 1 or (rings.size and (rings.min() < 0 or np.unique(rings).size != rings.size)):
        raise Fault(
            "shape",
            f"a number in {number} is repeated or below 1",
            "give each ring once, counted from 1",
        )


def check_vector_sizes(raw: RawCurve, options: ReadOptions) -> None:
    """Refuse infinite values, and sizes that no press reaches; NaN stands for not observed.

    Raises:
        Fault: "non_finite" or "absurd_scale".
    """
    for q in OBSERVED:
        values = getattr(raw, q.name)
        if values is None or not q.gaps:
            continue
        limit = np.inf if q.largest is None else getattr(options, q.largest)
        size = np.abs(values).reshape(len(values), -1)
        if np.isinf(size).any():
            rows = raw.rows[np.isinf(size).any(axis=1)]
            raise Fault(
                "non_finite",
                f"{q.words} is infinite in {listed(rows, raw.row_word)}",
                "leave what was not seen empty or NaN",
            )
        rows = (size > limit).any(axis=1)
        if rows.any():
            raise Fault(
                "absurd_scale",
                f"{q.words} is more than {limit:g} {q.unit} in"
                f" {listed(raw.rows[rows], raw.row_word)}",
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


def vectors_of(raw: RawCurve, keep: np.ndarray, options: ReadOptions) -> dict[str, Any]:
    """Fields of a curve for markers, ends and side force: the samples kept, as float64.

    Args:
        raw: the curve as read, checked.
        keep: (N,) samples of the curve.
        options: `force_sign` turns the side force too; markers and ends keep their axes.
    """
    fields = {}
    for q in OBSERVED:
        values = getattr(raw, q.name)
        if values is not None and q.gaps:
            sign = options.force_sign if q.turns else 1
            fields[q.name] = np.ascontiguousarray(sign * values[keep], dtype=np.float64)
    for name in RINGS:
        rings = getattr(raw, name)
        if rings is not None:
            fields[name] = rings.astype(np.int64)
    return fields


def tilt_of(direction: Sequence[float]) -> float:
    """Angle of a tool's direction to the inward normal, rad, positive towards growing phi."""
    return math.atan2(direction[1], direction[0])


def vector_words(curve: Curve) -> str:
    """What a curve holds beside forces and markers along the normal, for a table; may be empty."""
    words = [words for name, words in VECTORS.items() if observed(curve, name)]
    if tuple(curve.direction) != (1.0, 0.0):
        words.append(f"tool {np.degrees(tilt_of(curve.direction)):.3g}° off the normal")
    return ", ".join(words)


def observed(curve: Curve, name: str) -> bool:
    """Whether anything was observed of a field."""
    values = getattr(curve, name)
    return values is not None and bool(np.isfinite(values).any())
