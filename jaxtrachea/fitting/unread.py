"""What curves hold that a model of presses along the normal does not read: said, and left out."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.level import Level

#: Fields of a curve that only a model of presses in any direction reads, and what they are called.
VECTORS = {
    "side_force": "side force",
    "joint_side_displacement": "sideward motion of markers",
    "end_U": "ring ends U",
    "end_V": "ring ends V",
}

#: Changes that take the vectors off a curve.
LEFT_OUT: dict[str, None] = dict.fromkeys((*VECTORS, "end_rings"))


def as_read(curves: Sequence[Curve], level: Level) -> tuple[Sequence[Curve], str | None]:
    """Curves as a level reads them: without vectors where it presses along the normal alone.

    Args:
        curves: that the level admits.
        level: of the model.

    Returns:
        The curves without their vectors, and a sentence on what was left out; None: nothing was.
    """
    if level.off_midline:
        return curves, None
    counts = {name: sum(_holds(c, name) for c in curves) for name in VECTORS}
    counts = {name: count for name, count in counts.items() if count}
    plain = [
        dataclasses.replace(c, **LEFT_OUT)
        if any(getattr(c, name) is not None for name in LEFT_OUT)
        else c
        for c in curves
    ]
    if not counts:
        return plain, None
    listed = ", ".join(f"{VECTORS[name]} in {n}" for name, n in counts.items())
    return plain, (
        f"Measured and not read: {listed} of {len(curves)} curves; this model presses along the "
        "inward normal and knows only the force and the markers along it"
    )


def _holds(curve: Curve, name: str) -> bool:
    """Whether anything was observed of a field."""
    values = getattr(curve, name)
    return values is not None and bool(np.isfinite(values).any())
