"""Verdict and interval of every unknown of a fit.

Both are decided here and nowhere else (`assess`): terminal, report, tables, results.h5, the
population and designs all ask. The interval is that of as many samples as are independent
(`effective`); the one of independent residuals stands beside it. `result` is always a
`fitting.result.FitResult`, whose tables are made of this.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxtrachea.fitting.branch_times import unsampled_time
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.verdict import verdict
from jaxtrachea.status import ProfileEnd

#: Growth, at most, of the side of a profile that ends where another unknown is on its bound: 95 %
#: of chi^2 with two degrees of freedom for one. Near such a bound the statistic follows neither
#: (Self and Liang 1987, doi:10.1080/01621459.1987.10478472): of truths on it 5.7 % lay outside,
#: 8.6 % where the estimate was off it (tests/test_profile.py).
BY_ANOTHER_BOUND = (5.991464547107979 / 3.841458820694124) ** 0.5
#: Verdicts on estimates that enter medians and populations.
DETERMINED = ("identifiable", "weak")


@runtime_checkable
class Intervals(Protocol):
    """Intervals of some unknowns on top of what a fit says by itself (`inference.profile`)."""

    @property
    def lower(self) -> np.ndarray:
        """Lower ends in the parameters' units."""
        ...

    @property
    def upper(self) -> np.ndarray:
        """Upper ends."""
        ...

    @property
    def end(self) -> np.ndarray:
        """`ProfileEnd` of both sides."""
        ...

    def find(self, lane: int, unknown: int) -> int | None:
        """Row of an unknown; None if it has none."""
        ...


class Assessment(NamedTuple):
    """Verdict, interval and error of one unknown of one lane.

    Attributes:
        verdict: one of `VERDICTS`; "failed" without an estimate.
        low: 95 % interval in the parameter's unit, within its bounds: by profile and other minima
            where there is such evidence, else local, each side as many times as long on the scaled
            coordinate as correlated residuals make it (`Effective.growth`); the bound where open.
            Where an end is `FAILED`, the local one, if it reaches further than what is known. With
            that of a fit with hidden air, where there is one (`FitResult.with_air`).
        high: likewise.
        ends: `ProfileEnd` of the two; None where the interval is local.
        error: relative error that the verdict rests on: the longer side of the interval over that
            of one standard error, or the local one, with its growth; inf of a branch whose time the
            records do not show (`branch_times`).
        standard_error: in the parameter's unit, with its growth; NaN where the data do not
            determine the unknown: on a bound, open on a side, or where the model misses the curve.
        relative_se: likewise, relative as `FitResult.relative_se`.
        independent: low and high of independent residuals.
    """

    verdict: str
    low: float
    high: float
    ends: tuple[int, int] | None
    error: float
    standard_error: float
    relative_se: float
    independent: tuple[float, float]


def assess(result: Any, lane: int, i: int, profiles: Intervals | None = None) -> Assessment:
    """Verdict and interval of an unknown: the one place where both are decided."""
    if profiles is not None:
        return _assess(result, lane, i, profiles)
    if (lane, i) not in result.assessments:  # tables, files and report all ask
        result.assessments[lane, i] = _assess(result, lane, i, None)
    return result.assessments[lane, i]


def _assess(result: Any, lane: int, i: int, profiles: Intervals | None) -> Assessment:
    plain_low, plain_high, ends = _unbounded(result, lane, i, profiles)
    independent = within_bounds(result, lane, i, plain_low, plain_high)
    if not result.succeeded[lane]:
        return Assessment("failed", *independent, None, np.nan, np.nan, np.nan, independent)
    structural, held = bool(result.undetermined[lane, i]), bool(result.at_bound[lane, i])
    growth, misses = float(result.effective.growth[lane]), bool(result.effective.misses[lane])
    error = float(result.relative_se[lane, i])
    if ends is not None:
        error = _longer_side(result, lane, i, plain_low, plain_high)
        error /= float(result.uncertainty.half_width[lane])
    error *= growth
    low, high = _grown(result, lane, i, plain_low, plain_high, growth)
    with_air = result.with_air[lane, i]
    if not np.isnan(with_air).any():
        low, high = float(np.fmin(low, with_air[0])), float(np.fmax(high, with_air[1]))
        side = _longer_side(result, lane, i, low, high)
        error = max(error, side / float(result.uncertainty.half_width[lane]))
    if unsampled_time(result, lane, i):
        error = np.inf
    word = verdict(
        error, structural=structural, held=held, ends=ends, misses=misses,
        unseen=ends is None and bool(result.unexamined[lane, i]),
    )  # fmt: skip
    open_ = ends is not None and ProfileEnd.OPEN in ends
    factor = np.nan if structural or open_ or misses else float(result.effective.factor[lane])
    return Assessment(
        word, *within_bounds(result, lane, i, low, high), ends, error,
        _finite(factor * float(result.standard_error[lane, i])),
        _finite(factor * float(result.relative_se[lane, i])), independent,
    )  # fmt: skip


def _finite(value: float) -> float:
    return value if np.isfinite(value) else np.nan


def _longer_side(result: Any, lane: int, i: int, low: float, high: float) -> float:
    """The longer side of an interval as a relative change of the estimate."""
    p, value = result.study.unknowns[lane][i][0], float(result.value[lane, i])
    with np.errstate(divide="ignore", invalid="ignore"):
        if p.scale == "log":
            return float(max(np.log(high / value), np.log(value / low) if low > 0 else np.inf))
        return float(max(high - value, value - low) / (p.step * result.relative[lane, i]))


def _grown(
    result: Any, lane: int, i: int, low: float, high: float, growth: float
) -> tuple[float, float]:
    """An interval with both sides `growth` times as long on the scaled coordinate; NaN stays."""
    if growth == 1 or np.isnan(low):
        return low, high
    p, value = result.study.unknowns[lane][i][0], float(result.value[lane, i])
    log = p.scale == "log"
    if np.isinf(growth):  # a side of no length, of an estimate on its bound, has no limit either
        return 0.0 if log else -np.inf, np.inf
    with np.errstate(divide="ignore", over="ignore"):
        if log:
            grown = value * (np.array([low, high]) / value) ** growth
        else:
            grown = value + growth * (np.array([low, high]) - value)
    return min(low, float(grown[0])), max(high, float(grown[1]))


def limiting_bound(
    result: Any, lane: int, i: int, profiles: Intervals | None = None
) -> tuple[str, float] | None:
    """The bound, set by the user, that ends the 95 % interval of an unknown on one side.

    Of a profile that stays below its threshold up to the bound, or a local interval that is cut
    there, while the other side ends by itself. Such an interval is that of the bound: without it
    the same data may tell as much, or nothing.

    Returns:
        "lower" or "upper" and the bound, in the parameter's unit; None where there is none, the
        bound is the parameter's default one, or the estimate lies on it.
    """
    if not result.succeeded[lane] or result.undetermined[lane, i] or result.at_bound[lane, i]:
        return None
    if result.effective.misses[lane]:
        return None
    low, high, ends = _unbounded(result, lane, i, profiles)
    low, high = _grown(result, lane, i, low, high, float(result.effective.growth[lane]))
    low_cut, high_cut = within_bounds(result, lane, i, low, high)
    if ends is None:
        cut = (bool(low < low_cut), bool(high > high_cut))
        closed = (bool(low == low_cut), bool(high == high_cut))
    else:
        cut = tuple(end == ProfileEnd.OPEN for end in ends)
        closed = tuple(end in (ProfileEnd.CLOSED, ProfileEnd.BOUND) for end in ends)
    p, lanes = result.study.unknowns[lane][i][0], result.study.lanes
    usual = DEFAULTS.get(p.name)
    # An onset is looked for near its own curve: that end is no bound of the user.
    if cut[0] and closed[1] and p.to_scaled(p.lower) == lanes.lower[lane, i]:
        return None if usual is not None and p.lower == usual.lower else ("lower", p.lower)
    if cut[1] and closed[0] and p.to_scaled(p.upper) == lanes.upper[lane, i]:
        return None if usual is not None and p.upper == usual.upper else ("upper", p.upper)
    return None


def within_bounds(result: Any, lane: int, i: int, low: float, high: float) -> tuple[float, float]:
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
    result: Any, lane: int, i: int, profiles: Intervals | None
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
    low, high = min(v[0] for v in found), max(v[1] for v in found)
    # A profile that the bound of another unknown cuts short is as long as the local interval.
    far_low, far_high = _grown(result, lane, i, low, high, BY_ANOTHER_BOUND)
    if low_end == ProfileEnd.BOUND:
        low = max(float(np.fmin(low, local[0])), far_low)
    if high_end == ProfileEnd.BOUND:
        high = min(float(np.fmax(high, local[1])), far_high)
    # Of a side whose end was not found nothing is known but the local error.
    if low_end == ProfileEnd.FAILED:
        low = float(np.fmin(low, local[0]))
    if high_end == ProfileEnd.FAILED:
        high = float(np.fmax(high, local[1]))
    return low, high, (low_end, high_end)


def _end(ends: list[int]) -> int:
    """How a side ends by all that is known: an end that was found comes before a lost one."""
    return max([end for end in ends if end != ProfileEnd.FAILED] or ends)


def _evidence(result: Any, lane: int, i: int, profiles: Intervals | None) -> list:
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


def unknown_label(result: Any, lane: int, i: int) -> str:
    """Name of an unknown: k_M, or onset[t03], or k_M[T01] where a lane holds several of them."""
    unknowns = result.study.unknowns[lane]
    p, specimen, trial = unknowns[i]
    same = [u for u in unknowns if u[0].name == p.name]
    if len(same) == 1:
        return p.name
    several = len({u[1] for u in same}) > 1
    where = "/".join(filter(None, (specimen if several else "", trial)))
    return f"{p.name}[{where}]"


def is_own(result: Any, lane: int, i: int) -> bool:
    """Whether an unknown belongs to its lane alone, not to all lanes of a joint fit."""
    return not (result.study.joint and result.study.unknowns[lane][i][0].scope == "shared")


def already_reported(result: Any, lanes: Sequence[int], lane: int, i: int) -> bool:
    """Whether an unknown that all lanes share is listed with another of `lanes`, the first good."""
    first = next((k for k in lanes if result.succeeded[k]), lanes[0])
    return not is_own(result, lane, i) and lane != first


def estimated(result: Any) -> list[tuple[int, int]]:
    """Lane and unknown of every estimate that is listed.

    What the lanes of a joint fit share is listed once, with the first lane which succeeded.
    """
    every = range(result.lanes)
    return [
        (lane, i)
        for lane in every
        for i in range(len(result.study.unknowns[lane]))
        if not already_reported(result, every, lane, i)
    ]


def estimate_rows(result: Any, profiles: Intervals | None = None) -> Iterator[dict[str, object]]:
    """Estimate, standard error, interval and verdict of every unknown of `estimated`."""
    for lane, i in estimated(result):
        lane_specimen, _ = result.study.lane_name(lane)
        p, specimen, trial = result.study.unknowns[lane][i]
        assessed = assess(result, lane, i, profiles)
        yield {
            "specimen": (specimen or lane_specimen) if is_own(result, lane, i) else "(all)",
            "trial": trial or "(all)",
            "parameter": p.name,
            "unit": p.unit,
            "value": float(result.value[lane, i]),
            "se": assessed.standard_error,
            "low95": assessed.low,
            "high95": assessed.high,
            "relative_se": assessed.relative_se,
            "verdict": assessed.verdict,
        }
