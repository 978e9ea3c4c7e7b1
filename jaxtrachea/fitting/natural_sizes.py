"""Size of a change of each unknown that matters to the curves."""

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.mechanics.force_law import coefficient, power


def natural_sizes(result: FitResult) -> Float[np.ndarray, "L P"]:
    """Change of each scaled coordinate that matters to the curves as a change of 100 % would.

    As `FitResult.relative`, but no smaller than the press itself for what may be zero: an onset
    against the deepest displacement from first touch, an offset against the largest force, a
    coefficient k_n of the local law against that force over the depth to the power n.
    """
    lanes, out = result.study.lanes, result.relative.copy()
    seen = lanes.precision > 0
    force = np.where(seen, np.abs(lanes.force), 0).max(axis=(1, 2))
    depth = np.abs(lanes.displacement - result.first_touch[..., None])
    depth = np.where(seen, depth, 0).max(axis=(1, 2))
    depth = np.where(depth > 0, depth, 1)
    sizes = {"onset": depth, "force_offset": force, "force_slope": force / depth}
    law = [p.name for p in result.study.free if coefficient(p.name)]
    sizes |= {name: force / depth ** power(name) for name in law if power(name) > 1}
    for column, p in enumerate(result.study.free):
        if p.scale == "linear" and p.name in sizes:
            lane, unknown = np.nonzero(result.study.unknown_columns == column)
            own = sizes[p.name][lane] / p.step
            before = out[lane, unknown]
            out[lane, unknown] = np.where(own > before, own, before)  # NaN takes no place
    return out
