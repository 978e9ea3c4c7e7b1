"""Forces that are rounded more coarsely than their noise.

Noise of a third of the step makes rounding errors as good as independent. With less of it they are
a function of the force alone, so that all curves of a specimen repeat them where they pass through
the same forces: most of all near first touch, where the local law is read.
"""

import numpy as np
from jaxtyping import Float

from jaxtrachea._memory import in_blocks

#: Root mean square of the residuals over the step, if they are those of rounding: 0.289 without
#: noise, more with it. Less is no rounding: an even row of forces without noise has steps, too.
OF_STEP = (0.2, 0.345)
#: What standard errors grow by; chosen on presses of five places (docs/evidence/measured.md).
GROWTH = 1.6
#: Samples of a curve at least; how near to whole numbers its differences over the step are.
FEWEST, NEAR = 10, 0.02


def rounding(
    force: Float[np.ndarray, "lanes T N"], residual: Float[np.ndarray, "lanes T N"]
) -> Float[np.ndarray, " lanes"]:
    """Step of the forces, N, where rounding to it is most of what a fit leaves; NaN elsewhere.

    Args:
        force: measured, N.
        residual: model minus data, N; NaN where nothing was measured.
    """
    return in_blocks(_rounding, force, residual)


def _rounding(force, residual) -> np.ndarray:
    known = np.isfinite(residual)
    left = np.sqrt(np.sum(residual**2, axis=(1, 2), where=known) / np.maximum(known.sum((1, 2)), 1))
    gaps = np.diff(np.sort(np.where(known, force, np.nan), axis=2), axis=2)
    gaps = np.where(gaps > 1e-9 * np.max(np.abs(force), axis=(1, 2), keepdims=True), gaps, np.nan)
    step = np.min(np.where(np.isnan(gaps), np.inf, gaps), axis=2, initial=np.inf)
    low, high = (share * step for share in OF_STEP)
    may = (low < left[:, None]) & (left[:, None] < high) & (known.sum(axis=2) >= FEWEST)
    found = np.full(len(force), np.nan)
    for lane in np.flatnonzero(may.any(axis=1)).tolist():
        times = gaps[lane] / step[lane][:, None]
        even = np.all(np.isnan(times) | (np.abs(times - np.round(times)) < NEAR), axis=1)
        steps = step[lane][even & may[lane]]
        if 2 * len(steps) > np.sum(known[lane].any(axis=1)):  # of most curves
            found[lane] = np.median(steps)
    return found
