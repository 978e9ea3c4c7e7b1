"""How deep a skeleton was tested: curves and predictions beyond it are told."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.line import VALIDATED_DEPTH
from jaxtrachea.mechanics.levels.options import Options


def tested_depth(options: Options, radius: float) -> float:
    """Depth to which the model was tested, mm; inf without a skeleton (coupling `total`)."""
    return level_of(options).tested * radius * (1 + 1e-9)  # with what rounding takes


def depths(
    displacement: Float[np.ndarray, "*n"], touch: float | np.ndarray, options: Options
) -> Float[np.ndarray, "*n"]:
    """How deep the tool presses, mm from first touch; before it a tool that only touches does not.

    Args:
        displacement: as recorded, mm.
        touch: that at first touch, mm.
        options: with `bonded` contact the tool pulls before it, a negative depth.
    """
    depth = displacement - touch
    return np.maximum(depth, 0) if options.contact == "unilateral" else depth


def untested(options: Options, radius: float, depth: float, counted: str = "") -> str:
    """Whether a press of `depth` goes deeper than the model was tested, in words; "" if not.

    `counted`: see `onset.counted_from`.
    """
    most = tested_depth(options, radius)
    return f"the model was tested to D = {most:.3g} mm{counted}" if depth > most else ""


def deeper_than_validated(
    curves: Sequence[Curve],
    options: Options,
    radius: float,
    touch: Sequence[float] | None = None,
    counted: str = "",
) -> str | None:
    """A sentence on curves that go deeper than the model was tested; None: there are none.

    Args:
        curves: as recorded.
        options: of the model.
        radius: of the tube, mm.
        touch: displacement of each curve at first touch, mm; None: 0.
        counted: see `onset.counted_from`.
    """
    most = tested_depth(options, radius)
    touch = [0.0] * len(curves) if touch is None else touch
    deepest = (
        float(np.max(np.abs(depths(c.displacement, at, options))))
        for c, at in zip(curves, touch, strict=True)
    )
    deep = [d for d in deepest if d > most]
    if not deep:
        return None
    cure = "cut them off or leave them out where that matters"
    if level_of(options).tested < VALIDATED_DEPTH["softening"]:
        cure = "choose skeleton = 'softening' or 'sections'"
    return (
        f"{len(deep)} of {len(curves)} curves go to {max(deep):.3g} mm{counted}; skeleton = "
        f"{options.skeleton!r} was tested to {most:.3g} mm ({level_of(options).tested:g} of the "
        f"radius), beyond it the model may be off by more than its bands say; {cure}"
    )
