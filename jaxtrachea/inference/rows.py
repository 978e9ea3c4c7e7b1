"""Which rows the tables of a fit have, and in which order."""

import numpy as np

from jaxtrachea.fitting.lane import forces, markers, peaks
from jaxtrachea.fitting.result import FitResult

#: Lanes that are listed and drawn one by one; of more, the worst.
ONE_BY_ONE = 12
#: Lanes that have a line of their own in a picture of all; of more, the worst.
LINES = 200


def row_places(result: FitResult) -> list[tuple[int, str]]:
    """Lane and specimen of every row of summary.csv: a lane of several specimens has one for each.

    The specimen is "" where the lane has but one.
    """
    places = []
    for lane, curves in enumerate(result.study.curves):
        names = list(dict.fromkeys(c.specimen for c in curves))
        places += [(lane, name) for name in (names if len(names) > 1 else [""])]
    return places


def trials_of(result: FitResult, lane: int, specimen: str) -> list[int]:
    """Which trials of a lane belong to a specimen; "": all."""
    curves = result.study.curves[lane]
    return [t for t, c in enumerate(curves) if specimen in ("", c.specimen)]


def samples_of(result: FitResult, lane: int, trials: list[int]) -> int:
    """Observed forces and markers of some trials of a lane."""
    lanes = result.study.lanes
    kinds = forces(lanes) + markers(lanes)
    return sum(int(np.sum(kind.precision[lane, trials] > 0)) for kind in kinds)


def over_peak(result: FitResult) -> np.ndarray:
    """Root mean square force residual over the largest force of each lane; (lanes,)."""
    peak = peaks(forces(result.study.lanes)[:1])
    return np.where(peak > 0, result.rms[:, 0], np.nan) / np.where(peak > 0, peak, 1)


def worst_first(result: FitResult) -> list[int]:
    """All lanes: those without an estimate, then by the residual over the peak, largest first."""
    size = np.nan_to_num(over_peak(result), nan=np.inf)
    return [int(k) for k in np.lexsort((np.arange(result.lanes), -size, result.succeeded))]


def listed(result: FitResult, most: int = ONE_BY_ONE) -> list[int]:
    """Lanes of a table: all of few, in their order; of many the worst, worst first."""
    lanes = list(range(result.lanes))
    return lanes if result.lanes <= most else worst_first(result)[:most]


def and_more(total: int, shown: int, file: str) -> str:
    """What follows a table that does not hold all; "" where it does."""
    return "" if total <= shown else f"Worst first; and {total - shown} more, see {file}"
