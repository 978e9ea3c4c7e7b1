"""What curves hold that a model of presses along the normal does not read: said, and left out."""

import dataclasses
from collections.abc import Sequence

from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.observed import VECTORS, WITHOUT_VECTORS
from jaxtrachea.measurements.vectors import observed
from jaxtrachea.mechanics.levels.level import Level


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
    counts = {name: sum(observed(c, name) for c in curves) for name in VECTORS}
    counts = {name: count for name, count in counts.items() if count}
    plain = [
        dataclasses.replace(c, **WITHOUT_VECTORS)
        if any(getattr(c, name) is not None for name in WITHOUT_VECTORS)
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
