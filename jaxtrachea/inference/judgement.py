"""What is known of one unknown of one lane: its verdict and its interval, decided in one place.

Terminal, report, tables, results.h5 and the population all ask here.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.verdict import verdict
from jaxtrachea.status import ProfileEnd

#: Verdicts on estimates that enter medians and populations.
DETERMINED = ("identifiable", "weak")


class Judgement(NamedTuple):
    """What is known of one unknown of one lane.

    Attributes:
        verdict: one of `VERDICTS`; "failed" without an estimate.
        low: 95 % interval in the parameter's unit, within its bounds: by profile and other minima
            where there is such evidence, else local; the bound where open.
        high: likewise.
        ends: `ProfileEnd` of the two; None where the interval is local.
        error: relative error that the verdict rests on: the longer side of the interval over that
            of one standard error, or the local one.
    """

    verdict: str
    low: float
    high: float
    ends: tuple[int, int] | None
    error: float


def judgement(result: FitResult, lane: int, i: int, profiles: Profiles | None = None) -> Judgement:
    """Verdict and interval of an unknown: the one place where both are decided.

    Args:
        result: the fit, with the evidence that it has gathered by itself.
        lane: of the result.
        i: unknown of the lane.
        profiles: further profiles, which come on top.
    """
    low, high, ends = _unbounded(result, lane, i, profiles)
    inside = within_bounds(result, lane, i, low, high)
    if not result.succeeded[lane]:
        return Judgement("failed", *inside, None, np.nan)
    p = result.study.unknowns[lane][i][0]
    structural, held = bool(result.undetermined[lane, i]), bool(result.at_bound[lane, i])
    if ends is None:
        word = verdict(
            float(result.relative_se[lane, i]), structural=structural, held=held,
            unseen=bool(result.unexamined[lane, i]),
        )  # fmt: skip
        return Judgement(word, *inside, None, float(result.relative_se[lane, i]))
    value, unit = float(result.value[lane, i]), float(result.uncertainty.half_width[lane])
    with np.errstate(divide="ignore", invalid="ignore"):
        if p.scale == "log":
            longer = max(np.log(high / value), np.log(value / low) if low > 0 else np.inf)
        else:
            longer = max(high - value, value - low) / (p.step * result.relative[lane, i])
    error = float(longer) / unit
    word = verdict(error, structural=structural, held=held, ends=ends)
    return Judgement(word, *inside, ends, error)


def interval95(
    result: FitResult, lane: int, i: int, profiles: Profiles | None = None
) -> tuple[float, float, tuple[int, int] | None]:
    """`low`, `high`, `ends` of `judgement` without its verdict, which asks for the whole fit."""
    low, high, ends = _unbounded(result, lane, i, profiles)
    return *within_bounds(result, lane, i, low, high), ends


def within_bounds(
    result: FitResult, lane: int, i: int, low: float, high: float
) -> tuple[float, float]:
    """An interval, in the parameter's unit, cut at the bounds of the fit; NaN stays.

    The bounds are those of the lane: an onset is looked for near its own curve.
    """
    p, lanes = result.study.unknowns[lane][i][0], result.study.lanes
    value = float(result.value[lane, i])
    ends = []
    for bound, theta in ((p.lower, lanes.lower[lane, i]), (p.upper, lanes.upper[lane, i])):
        ends.append(bound if p.to_scaled(bound) == theta else p.from_scaled(float(theta)))
    # An estimate on a bound may be off it by a rounding. NaN comes first, so that it stays.
    return max(low, min(ends[0], value)), min(high, max(ends[1], value))


def _unbounded(
    result: FitResult, lane: int, i: int, profiles: Profiles | None
) -> tuple[float, float, tuple[int, int] | None]:
    """Interval and `ProfileEnd` of its sides, None if local; -inf (scale `log`: 0), inf if open."""
    local = float(result.lower[lane, i]), float(result.upper[lane, i]), None
    if not result.succeeded[lane]:
        return local
    found = _evidence(result, lane, i, profiles)
    if not found and result.undetermined[lane, i]:
        log = result.study.unknowns[lane][i][0].scale == "log"
        return 0.0 if log else -np.inf, np.inf, (ProfileEnd.OPEN, ProfileEnd.OPEN)
    if not found:
        return local
    low_end, high_end = (_end([v[2][side] for v in found]) for side in (0, 1))
    return min(v[0] for v in found), max(v[1] for v in found), (low_end, high_end)


def _end(ends: list[int]) -> int:
    """How a side ends by all that is known: an end that was found comes before a lost one."""
    return max([end for end in ends if end != ProfileEnd.FAILED] or ends)


def _evidence(result: FitResult, lane: int, i: int, profiles: Profiles | None) -> list:
    """Intervals (low, high, ends) that rest on more than the local error."""
    found = []
    if result.evidence_end[lane, i, 0] >= 0:
        low, high = float(result.evidence_low[lane, i]), float(result.evidence_high[lane, i])
        found.append((low, high, tuple(map(int, result.evidence_end[lane, i]))))
    k = None if profiles is None else profiles.find(lane, i)
    if profiles is not None and k is not None:
        value = float(result.value[lane, i])
        low, high = (float(v) if np.isfinite(v) or np.isinf(v) else value
                     for v in (profiles.lower[k], profiles.upper[k]))  # fmt: skip
        found.append((low, high, tuple(map(int, profiles.end[k]))))
    return found


def verdict_of(result: FitResult, lane: int, i: int, profiles: Profiles | None = None) -> str:
    """The verdict of `judgement`."""
    return judgement(result, lane, i, profiles).verdict


def relative_errors(
    result: FitResult, profiles: Profiles | None = None
) -> Float[np.ndarray, "L P"]:
    """Relative error of what is determined: of identifiable and weak unknowns; NaN elsewhere."""
    out = np.full(result.theta.shape, np.nan)
    for lane, unknowns in enumerate(result.study.unknowns):
        for i in range(len(unknowns)):
            judged = judgement(result, lane, i, profiles)
            if judged.verdict in DETERMINED:
                out[lane, i] = judged.error
    return out
