"""Size of a change of each unknown that matters to the curves."""

import numpy as np
from jaxtyping import Float

from jaxtrachea.fit.result import FitResult


def natural_sizes(result: FitResult) -> Float[np.ndarray, "L P"]:
    """Change of each scaled coordinate that matters to the curves as a change of 100 % would.

    As `FitResult.relative`, but no smaller than the press itself for what may be zero: an onset
    against the deepest displacement, an offset against the largest force, k_3 against the secant
    stiffness over the depth squared.
    """
    lanes, out = result.study.lanes, result.relative.copy()
    seen = lanes.precision > 0
    force = np.where(seen, np.abs(lanes.force), 0).max(axis=(1, 2))
    depth = np.where(seen, np.abs(lanes.displacement), 0).max(axis=(1, 2))
    depth = np.where(depth > 0, depth, 1)
    sizes = {"onset": depth, "force_offset": force, "k_3": force / depth**3}
    sizes["k_3_ring"] = sizes["k_3"]
    for lane, unknowns in enumerate(result.study.unknowns):
        for i, (p, _, _) in enumerate(unknowns):
            if p.scale == "linear" and p.name in sizes:
                out[lane, i] = max(out[lane, i], sizes[p.name][lane] / p.step)
    return out
