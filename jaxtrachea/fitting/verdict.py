"""Verdicts in words: which parameters the data determine, and what they determine instead."""

import numpy as np

from jaxtrachea.status import ProfileEnd

#: Relative standard error up to which a parameter counts as identifiable, and as weakly so.
IDENTIFIABLE, WEAK = 0.1, 0.5
#: All verdicts on an estimate, best first.
VERDICTS = (
    "identifiable",
    "weak",
    "practically non-identifiable",
    "structurally non-identifiable",
    "at bound",
    "inconclusive",
    "inconclusive: the model misses the curve",
)


def verdict(
    relative_error: float,
    *,
    structural: bool = False,
    held: bool = False,
    ends: tuple[int, int] | None = None,
    unseen: bool = False,
    misses: bool = False,
) -> str:
    """One of `VERDICTS` for a parameter.

    Structurally non-identifiable: the model itself, at these contact points, does not let it be
    told, whatever the noise. Practically: it would, but with this noise the relative error exceeds
    50 %, or the interval is open on a side (terms of Raue et al. 2009,
    doi:10.1093/bioinformatics/btp358). Inconclusive: it could not be found out, or the residuals
    are those of another model.

    Args:
        relative_error: of the estimate: the longer side of its 95 % interval over that of one
            standard error, where there is more than the local one; inf where undetermined.
        structural: the structure leaves it open.
        held: the estimate is on its bound.
        ends: `ProfileEnd` of the interval's sides; None: the error is local.
        unseen: there was cause to look further than the local error, and it was not done.
        misses: the model misses the curve (`effective.Effective.misses`).
    """
    if structural:
        return VERDICTS[3]
    if misses:
        return VERDICTS[6]
    if held:
        return "at bound"
    if ends is not None and ProfileEnd.OPEN in ends:
        relative_error = np.inf
    if not relative_error <= WEAK:
        return VERDICTS[2]
    if unseen or (ends is not None and ProfileEnd.FAILED in ends):
        return "inconclusive"
    return "identifiable" if relative_error <= IDENTIFIABLE else "weak"
