"""Glitches: force samples far from the model while their neighbours are near it."""

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea._memory import in_blocks

#: A glitch is as many times the noise, and as large a share of the lane's peak. Lanes whose largest
#: residual is less than `SEARCHED` times the mean have none.
GLITCH, OF_PEAK, SEARCHED = 8.0, 1e-3, 5.0
#: Shares of the residuals, and of the differences from neighbours, that are taken for noise, with
#: the normal quantile of each: a glitch makes three differences large.
_QUIET, _OF_DIFFERENCES = (0.9, 1.645), (0.7, 1.036)


def glitches(
    residual: Float[np.ndarray, "lanes T N"],
    force: Float[np.ndarray, "lanes T N"],
    precision: Float[np.ndarray, "lanes T N"],
) -> Bool[np.ndarray, "lanes T N"]:
    """Which samples are glitches.

    Far is `GLITCH` times the noise, both from zero and from the mean of the neighbours (of the one
    at an end). The noise is taken from quantiles of the residuals of the lane, and of these
    differences, so that up to a tenth may be glitches. Where a model misses a stretch,
    neighbours are missed alike.

    Args:
        residual: model minus data, N; NaN where nothing was measured.
        force: measured, N.
        precision: what residuals are compared by, 1 / N or in any unit.
    """
    return in_blocks(_glitches, residual, force, precision)


def _glitches(residual, force, precision) -> np.ndarray:
    found = np.zeros(residual.shape, bool)
    known = np.isfinite(residual)
    size = np.where(known, np.abs(residual), 0.0)
    mean = size.sum(axis=(1, 2)) / np.maximum(known.sum(axis=(1, 2)), 1)
    for lane in np.flatnonzero(size.max(axis=(1, 2), initial=0) > SEARCHED * mean).tolist():
        z, seen = residual[lane] * precision[lane], known[lane]
        beside = np.stack(
            [np.pad(z, [(0, 0), (1, 0)], constant_values=np.nan)[:, :-1],
             np.pad(z, [(0, 0), (0, 1)], constant_values=np.nan)[:, 1:]]
        )  # fmt: skip
        there = np.isfinite(beside)
        mean_beside = np.sum(np.where(there, beside, 0), axis=0) / np.maximum(there.sum(axis=0), 1)
        alone = np.where(seen & there.any(axis=0), np.abs(z - mean_beside), 0.0)
        noise, differs = (
            np.quantile(values[seen], share) / normal
            for values, (share, normal) in ((np.abs(z), _QUIET), (alone, _OF_DIFFERENCES))
        )
        least = GLITCH * max(noise, differs)
        higher = np.pad(alone, [(0, 0), (1, 1)])
        found[lane] = (
            seen & (alone > least) & (np.abs(z) > GLITCH * noise)
            & (alone >= np.maximum(higher[:, :-2], higher[:, 2:]))
            & (size[lane] > OF_PEAK * np.max(np.abs(force[lane])))
        )  # fmt: skip
    return found
