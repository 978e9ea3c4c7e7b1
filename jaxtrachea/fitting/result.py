"""What a fit gives: estimates, errors, and of every unknown its verdict and its interval.

Verdict and interval are decided here and nowhere else (`assess`): terminal, report, tables,
results.h5, the population and designs all ask. The interval is that of as many samples as are
independent (`effective`); the one of independent residuals stands beside it.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxtrachea.files.table import Table
from jaxtrachea.fitting.branch_times import unsampled_time
from jaxtrachea.fitting.covariance import NORMAL, Uncertainty
from jaxtrachea.fitting.criteria import Criteria
from jaxtrachea.fitting.effective import Effective, effective
from jaxtrachea.fitting.misfit import Misfit, Residuals, misfit
from jaxtrachea.fitting.noise import precision_unit
from jaxtrachea.fitting.onset import first_touches
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.predictions import Prediction, predictions
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.verdict import verdict
from jaxtrachea.status import FitStatus, ProfileEnd

if TYPE_CHECKING:
    import xarray


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


class Origin(NamedTuple):
    """Where a fit was read from; empty for one of this process.

    Attributes:
        path: of its results.h5.
        reading: how the data were read, as in the [data] section.
        files: SHA-256 by name of the files of data.
    """

    path: Path = Path()
    reading: Mapping[str, Any] = {}
    files: Mapping[str, str] = {}


@dataclasses.dataclass(frozen=True, eq=False)
class FitResult:
    """Estimates of every lane; leading axis = lanes of the study, P unknowns each.

    Attributes:
        study: what was fitted.
        theta: estimate in scaled coordinates; (lanes, P).
        value: estimate in the parameter's unit; (lanes, P).
        standard_error: of independent residuals, in the parameter's unit (delta method); times
            `effective.factor` it is that of the tables; (lanes, P).
        lower: 95 % interval of independent residuals, transformed from scaled coordinates;
            (lanes, P).
        upper: (lanes, P).
        relative_se: `standard_error` over the value (scale `log`: of the logarithm; onset and
            offset: over range and largest force of the press); (lanes, P).
        at_bound: (lanes, P).
        status: `FitStatus`; (lanes,).
        iterations: of the best start; (lanes,).
        cost: half the weighted sum of squares (or of rho); (lanes,).
        converged_starts: starts that ended in the best minimum; of many long curves (`few_samples`)
            those that came together on a few samples went there as one; (lanes,).
        tried: starts in all; (lanes,).
        start_costs: the 24 lowest costs that starts of a lane ended at, with the noise that fits
            begin with, lowest first; NaN where there are no more; (lanes, 24).
        sigma: standard deviation of force (N) and markers (mm), given (the median of the lane's
            samples) or estimated; (lanes, 2).
        rms: root mean square residual of force (N) and markers (mm); (lanes, 2).
        samples: observed entries; (lanes,).
        criteria: AIC, AICc, BIC of all lanes.
        uncertainty: local one of all lanes.
        undetermined: unknowns that the structure leaves open (`structure`); (lanes, P).
        unexamined: unknowns that gave cause to look further than the local error, and nobody did:
            in a joint fit, or without scrutiny; (lanes, P).
        evidence_low: 95 % interval by profile and other minima, in the parameter's unit: -inf
            (scale `log`: 0) where open, NaN where there was no cause to look; where an end is
            `FAILED`, as far as the cost is known to stay below the threshold; (lanes, P).
        evidence_high: (lanes, P).
        evidence_end: `ProfileEnd` of its lower and upper end, -1 where there is none;
            (lanes, P, 2).
        minima: minima that fit within the likelihood's threshold, the best one included; those
            that differ from it in an unknown that the structure does not leave open; (lanes,).
        origin: where it was read from.
        stored_residuals: of a fit that was read, so that the model is not evaluated again.
    """

    study: Study
    theta: np.ndarray
    value: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    relative_se: np.ndarray
    at_bound: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray
    converged_starts: np.ndarray
    tried: np.ndarray
    start_costs: np.ndarray
    sigma: np.ndarray
    rms: np.ndarray
    samples: np.ndarray
    criteria: Criteria
    uncertainty: Uncertainty
    undetermined: np.ndarray
    unexamined: np.ndarray
    evidence_low: np.ndarray
    evidence_high: np.ndarray
    evidence_end: np.ndarray
    minima: np.ndarray
    origin: Origin = Origin()
    stored_residuals: Prediction | None = None

    def __repr__(self) -> str:
        """One line: what was fitted to what."""
        free = ", ".join(p.name for p in self.study.free) or "nothing"
        curves = [c for lane in self.study.curves for c in lane]
        read = f"{str(self.origin.path)!r}: " if self.origin.path != Path() else ""
        return (
            f"FitResult({read}{free} fitted to {len(curves)} curves of "
            f"{len({c.specimen for c in curves})} specimen(s))"
        )

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return len(self.status)

    @functools.cached_property
    def succeeded(self) -> np.ndarray:
        """Lanes that have an estimate; (lanes,)."""
        return self.status <= FitStatus.UNIDENTIFIABLE

    @property
    def force_share(self) -> np.ndarray:
        """Share of the force that its noise has beside `sigma`, see `Noise`; (lanes,)."""
        shares = self.study.shares
        return np.zeros(self.lanes) if shares is None else shares.share

    @property
    def whitened_sigma(self) -> np.ndarray:
        """`sigma` in units of the lanes' precision, as `evaluate` wants it; (lanes, 2)."""
        return self.sigma / precision_unit(self.study)

    @property
    def observed_sigma(self) -> np.ndarray:
        """`sigma`; NaN where a lane has no samples of the kind, such as no markers; (lanes, 2)."""
        return np.where(np.isnan(self.rms), np.nan, self.sigma)

    @property
    def half_width(self) -> np.ndarray:
        """Half of a 95 % interval in standard errors, for predictions; (lanes,).

        Infinite where noise is to be estimated and no sample is left to do it from: the normal
        quantile stands there (`covariance.analyse`), which Student's t never reaches.
        """
        half = self.uncertainty.half_width
        return np.where((half == NORMAL) & (not self.study.noise_given[0]), np.inf, half)

    @functools.cached_property
    def relative(self) -> np.ndarray:
        """Change of each scaled coordinate that makes a relative change of 1; (lanes, P)."""
        return relative_change(self.study, self.theta)

    @functools.cached_property
    def first_touch(self) -> np.ndarray:
        """Displacement at first touch of every trial, mm, estimated or held; (lanes, T)."""
        return first_touches(self.study.lanes, self.study.parameters, self.value)

    @functools.cached_property
    def residuals(self) -> Prediction:
        """Model minus data at the estimates; as large as the data."""
        if self.stored_residuals is not None:
            return self.stored_residuals
        return predictions(self.study, self.theta)

    @functools.cached_property
    def effective(self) -> Effective:
        """Independent samples that those of each lane are worth, and what intervals grow by."""
        return effective(self._counted, self.uncertainty.half_width)

    @functools.cached_property
    def misfit(self) -> Misfit:
        """Residuals of each lane against the noise that was given."""
        return misfit(self._counted)

    @property
    def _counted(self) -> Residuals:
        """The residuals with what they are counted by."""
        return Residuals(self.study, self.residuals, self.samples, self.at_bound, self.succeeded)

    @functools.cached_property
    def assessments(self) -> "dict[tuple[int, int], Assessment]":
        """Kept by `assess`: those without further profiles, by lane and unknown."""
        return {}

    def table(self, profiles: Intervals | None = None) -> Table:
        """One row per unknown: estimate, standard error, 95 % interval and verdict, with units.

        Args:
            profiles: further intervals (`jaxtrachea.profiles`), which come on top.

        Returns:
            A `Table`: prints as text, shows as HTML in a notebook, `rows` are dictionaries. What
            the lanes of a joint fit share has one row.
        """
        return Table(estimate_rows(self, profiles))

    def to_dataset(self, profiles: Intervals | None = None) -> "xarray.Dataset":
        """The estimates with dimensions `lane` and `unknown`, as an xarray Dataset.

        `parameter` and `unit` say what each unknown is; statuses and verdicts are words. Lanes with
        fewer unknowns than others are filled up with NaN and "". Where an unknown lies on its bound
        (`at_bound`) its standard error is NaN, and so is its interval without a profile. Errors and
        intervals are those of the tables (`assess`).

        Args:
            profiles: further intervals, as for `table`.

        Raises:
            ImportError: xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise ImportError(
                "xarray is not installed; install it with pip install 'jaxtrachea[dataset]'"
            ) from None
        study, names = self.study, [self.study.lane_name(k) for k in range(self.lanes)]
        size = self.theta.shape[1]
        labels = [[unknown_label(self, k, i) if i < len(study.unknowns[k]) else ""
                   for i in range(size)] for k in range(self.lanes)]  # fmt: skip
        assessed = [[assess(self, k, i, profiles) if i < len(study.unknowns[k]) else None
                   for i in range(size)] for k in range(self.lanes)]  # fmt: skip
        both, per_lane = ("lane", "unknown"), ("lane",)

        def word(j):
            return "" if j is None else j.verdict

        def end(j, side):
            return np.nan if j is None else getattr(j, side)

        units = [
            [p.unit for p, _, _ in lane] + [""] * (size - len(lane)) for lane in study.unknowns
        ]
        data = {
            "parameter": (both, labels),
            "unit": (both, units),
            "value": (both, self.value),
            "standard_error": (both, [[end(j, "standard_error") for j in row] for row in assessed]),
            "low95": (both, [[end(j, "low") for j in row] for row in assessed]),
            "high95": (both, [[end(j, "high") for j in row] for row in assessed]),
            "verdict": (both, [[word(j) for j in row] for row in assessed]),
            "at_bound": (both, self.at_bound),
            "status": (per_lane, [FitStatus(int(v)).name.lower() for v in self.status]),
            "iterations": (per_lane, self.iterations),
            "cost": (per_lane, self.cost),
            "samples": (per_lane, self.samples),
            "rms": (("lane", "kind"), self.rms, {"unit": "N, mm"}),
            "sigma": (("lane", "kind"), self.observed_sigma, {"unit": "N, mm"}),
        }
        same = all(row == labels[0] for row in labels)
        coords = {
            "specimen": (per_lane, [name for name, _ in names]),
            "trial": (per_lane, [trial for _, trial in names]),
            "kind": ["force", "joints"],
            "unknown": labels[0] if same and labels else np.arange(size),
        }
        return xarray.Dataset(data, coords)


#: Growth, at most, of the side of a profile that ends where another unknown is on its bound: 95 %
#: of chi^2 with two degrees of freedom for one. Near such a bound the statistic follows neither
#: (Self and Liang 1987, doi:10.1080/01621459.1987.10478472): of truths on it 5.7 % lay outside,
#: 8.6 % where the estimate was off it (tests/test_profile.py).
BY_ANOTHER_BOUND = (5.991464547107979 / 3.841458820694124) ** 0.5
#: Verdicts on estimates that enter medians and populations.
DETERMINED = ("identifiable", "weak")


class Assessment(NamedTuple):
    """Verdict, interval and error of one unknown of one lane.

    Attributes:
        verdict: one of `VERDICTS`; "failed" without an estimate.
        low: 95 % interval in the parameter's unit, within its bounds: by profile and other minima
            where there is such evidence, else local, each side as many times as long on the scaled
            coordinate as correlated residuals make it (`Effective.growth`); the bound where open.
            Where an end is `FAILED`, the local one, if it reaches further than what is known.
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


def assess(result: FitResult, lane: int, i: int, profiles: Intervals | None = None) -> Assessment:
    """Verdict and interval of an unknown: the one place where both are decided.

    Args:
        result: the fit, with the evidence that it has gathered by itself.
        lane: of the result.
        i: unknown of the lane.
        profiles: further profiles, which come on top.
    """
    if profiles is not None:
        return _assess(result, lane, i, profiles)
    if (lane, i) not in result.assessments:  # tables, files and report all ask
        result.assessments[lane, i] = _assess(result, lane, i, None)
    return result.assessments[lane, i]


def _assess(result: FitResult, lane: int, i: int, profiles: Intervals | None) -> Assessment:
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
    if unsampled_time(result, lane, i):
        error = np.inf
    word = verdict(
        error, structural=structural, held=held, ends=ends, misses=misses,
        unseen=ends is None and bool(result.unexamined[lane, i]),
    )  # fmt: skip
    low, high = _grown(result, lane, i, plain_low, plain_high, growth)
    open_ = ends is not None and ProfileEnd.OPEN in ends
    factor = np.nan if structural or open_ or misses else float(result.effective.factor[lane])
    return Assessment(
        word, *within_bounds(result, lane, i, low, high), ends, error,
        _finite(factor * float(result.standard_error[lane, i])),
        _finite(factor * float(result.relative_se[lane, i])), independent,
    )  # fmt: skip


def _finite(value: float) -> float:
    return value if np.isfinite(value) else np.nan


def _longer_side(result: FitResult, lane: int, i: int, low: float, high: float) -> float:
    """The longer side of an interval as a relative change of the estimate."""
    p, value = result.study.unknowns[lane][i][0], float(result.value[lane, i])
    with np.errstate(divide="ignore", invalid="ignore"):
        if p.scale == "log":
            return float(max(np.log(high / value), np.log(value / low) if low > 0 else np.inf))
        return float(max(high - value, value - low) / (p.step * result.relative[lane, i]))


def _grown(
    result: FitResult, lane: int, i: int, low: float, high: float, growth: float
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
    result: FitResult, lane: int, i: int, profiles: Intervals | None = None
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
    result: FitResult, lane: int, i: int, profiles: Intervals | None
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


def _evidence(result: FitResult, lane: int, i: int, profiles: Intervals | None) -> list:
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


def verdict_of(result: FitResult, lane: int, i: int, profiles: Intervals | None = None) -> str:
    """The verdict of `assess`."""
    return assess(result, lane, i, profiles).verdict


def unknown_label(result: FitResult, lane: int, i: int) -> str:
    """Name of an unknown: k_M, or onset[t03], or k_M[T01] where a lane holds several of them."""
    unknowns = result.study.unknowns[lane]
    p, specimen, trial = unknowns[i]
    same = [u for u in unknowns if u[0].name == p.name]
    if len(same) == 1:
        return p.name
    several = len({u[1] for u in same}) > 1
    where = "/".join(filter(None, (specimen if several else "", trial)))
    return f"{p.name}[{where}]"


def is_own(result: FitResult, lane: int, i: int) -> bool:
    """Whether an unknown belongs to its lane alone, not to all lanes of a joint fit."""
    return not (result.study.joint and result.study.unknowns[lane][i][0].scope == "shared")


def already_reported(result: FitResult, lanes: Sequence[int], lane: int, i: int) -> bool:
    """Whether an unknown that all lanes share is listed with another of `lanes`, the first good."""
    first = next((k for k in lanes if result.succeeded[k]), lanes[0])
    return not is_own(result, lane, i) and lane != first


def estimated(result: FitResult) -> list[tuple[int, int]]:
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


def estimate_rows(
    result: FitResult, profiles: Intervals | None = None
) -> Iterator[dict[str, object]]:
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
