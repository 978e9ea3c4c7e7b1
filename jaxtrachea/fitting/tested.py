"""How deep a skeleton was tested: curves and predictions beyond it are told."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import TESTED, Options


def tested_depth(options: Options, radius: float) -> float:
    """Depth to which the model was tested, mm; inf without a skeleton (coupling `total`)."""
    # With what rounding takes.
    return np.inf if options.coupling == "total" else TESTED[options.skeleton] * radius * (1 + 1e-9)


def untested(options: Options, radius: float, depth: float) -> str:
    """Whether a press of `depth` goes deeper than the model was tested, in words; "" if not."""
    most = tested_depth(options, radius)
    return f"the model was tested to D = {most:.3g} mm" if depth > most else ""


def deeper_than_tested(curves: Sequence[Curve], options: Options, radius: float) -> str | None:
    """A sentence on curves that go deeper than the model was tested; None: there are none."""
    most = tested_depth(options, radius)
    deep = [d for c in curves if (d := max(c.displacement.max(), -c.displacement.min())) > most]
    if not deep:
        return None
    cure = "cut them off or leave them out where that matters"
    if options.skeleton == "linear":
        cure = "choose skeleton = 'softening' or 'sections'"
    return (
        f"{len(deep)} of {len(curves)} curves go to {max(deep):.3g} mm; skeleton = "
        f"{options.skeleton!r} was tested to {most:.3g} mm ({TESTED[options.skeleton]:g} of the "
        f"radius), beyond it the model may be off by more than its bands say; {cure}"
    )
