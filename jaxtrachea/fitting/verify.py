"""Doubts about estimates, and what is done about them: other minima, valleys, profiles.

A local standard error says nothing of a second minimum, nor of a valley that bends away. A lane
that gives cause for doubt (`doubt`) is fitted again from starts that make the local law the soft
part, then the skeleton, and from where the cost passes the likelihood's threshold along the least
determined direction; then its unknowns are profiled. Every point whose cost lies within the
threshold belongs to the confidence region, whatever way it was found: the interval of an unknown
reaches at least as far (likelihood region; Raue et al. 2009, doi:10.1093/bioinformatics/btp358).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.information import informations
from jaxtrachea.fitting.lane import data_weight
from jaxtrachea.fitting.minima import Minima
from jaxtrachea.fitting.needs_review import APART, natural_sizes
from jaxtrachea.fitting.other_starts import soft_starts, twins
from jaxtrachea.fitting.profile_search import Sides, find_ends
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import EXACT, unscaled
from jaxtrachea.fitting.structure import Structure
from jaxtrachea.status import FitStatus, ProfileEnd

#: Where the cost is looked up along the least determined direction, in half widths of its interval.
WALK = np.geomspace(0.5, 64, 15)
#: Longest walk, in relative coordinates (log: seven decades).
FAR = 16.0
#: Relative accuracy of sqrt(statistic) at the ends of profiles, and rounds to find them.
ACCURACY, ROUNDS = 3e-3, 20
#: Fall of the statistic below the estimate's from which a point is a better minimum.
BETTER = 1e-2


class Evidence(NamedTuple):
    """Fields of `FitResult` that rest on more than the local standard error."""

    status: np.ndarray
    evidence_low: np.ndarray
    evidence_high: np.ndarray
    evidence_end: np.ndarray
    minima: np.ndarray


class _Region:
    """Points within the likelihood's threshold of each lane, whatever way they were found."""

    def __init__(self, sides: Sides, lanes: Int[np.ndarray, " n"]):
        """Nothing but the estimates of `lanes`."""
        result = self.result = sides.result
        self.sides = sides
        self.cost = np.full(result.lanes, np.nan)
        self.cost[lanes] = sides.costs(lanes, result.theta[lanes])
        self.dispersion = result.uncertainty.dispersion
        self.threshold = result.uncertainty.half_width**2
        self.floor = EXACT * data_weight(result.study.lanes, result.whitened_sigma)
        self.low, self.high = result.theta.copy(), result.theta.copy()
        self.at_low = np.repeat(result.theta[:, None], result.theta.shape[1], axis=1)
        self.at_high = self.at_low.copy()
        self.better = np.full(result.theta.shape, np.nan)
        self.lowest = self.cost.copy()

    def add(self, lane, theta, cost) -> Bool[np.ndarray, " n"]:
        """Take in points (n, P) that lie within; whether each does for any unknown.

        One that lies clearly below the estimate is remembered as the better minimum; of a fit that
        has not converged, one that lies below it at all.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            rise = 2 * (cost - self.cost[lane])[:, None] / self.dispersion[lane]
        within = (rise <= self.threshold[lane][:, None]) & np.isfinite(theta)
        for n in np.flatnonzero(within.any(axis=1)):
            k, w = lane[n], within[n]
            lower, upper = w & (theta[n] < self.low[k]), w & (theta[n] > self.high[k])
            self.low[k][lower], self.high[k][upper] = theta[n][lower], theta[n][upper]
            self.at_low[k][lower], self.at_high[k][upper] = theta[n], theta[n]
            fall = self.cost[k] - cost[n]
            least = 0.5 * BETTER * np.nanmin(self.dispersion[k]) * self.result.succeeded[k]
            if fall > max(least, self.floor[k]) and cost[n] < self.lowest[k]:
                self.lowest[k], self.better[k] = cost[n], theta[n]
        return within.any(axis=1)


def verify_minimum(
    result: FitResult,
    minima: Minima,
    doubts: Bool[np.ndarray, "lanes P"],
    settings: Settings,
    known: Structure,
    progress: Callable[[int, int], None] | None = None,
    *,
    last: bool = False,
) -> tuple[Evidence, Float[np.ndarray, "lanes P"]]:
    """Look for other minima of the lanes in doubt and profile their unknowns.

    Args:
        minima: where all starts ended.
        doubts: as `doubtful` gives them.
        known: structure of the lanes.
        progress: called with (0, 0) as the work goes on.
        last: no better minimum will be followed: gather all evidence in any case.

    Returns:
        The evidence, and a better minimum of each lane where one was found, NaN elsewhere: then
        the evidence of this lane is not about the right estimate, and may be missing.
    """
    lanes = np.flatnonzero(doubts.any(axis=1))
    alive = None if progress is None else lambda *_: progress(0, 0)
    region = _Region(_sides(result, settings, doubts, alive), lanes)
    of_lanes = np.isin(minima.lane, lanes)
    lane, end = minima.lane[of_lanes], minima.end[of_lanes]
    region.add(lane, end, region.sides.costs(lane, end))
    several = _other_minima(region, lanes, known)
    evidence = no_evidence(result)
    evidence.minima[lanes] = several
    present = (result.study.lanes.active > 0) & ~result.undetermined
    doubts = doubts | (present & (evidence.minima > 1)[:, None])
    if not last:  # a lane with a better minimum is looked at again
        doubts = doubts & np.isnan(region.better).all(axis=1, keepdims=True)
        if not doubts.any():
            return evidence, region.better
    region.sides = _sides(result, settings, doubts, alive)
    _profiled(region, evidence)
    _settle(result, evidence, np.flatnonzero(~result.succeeded & doubts.any(axis=1)))
    return evidence, region.better


def _settle(result: FitResult, evidence: Evidence, lanes: Int[np.ndarray, " n"]) -> None:
    """Statuses of lanes that have not converged, but have next to nothing to gain.

    That is what a Gauss-Newton step promises. They crawl along a valley, whose profile is open, or
    rounding hides the last steps. A fit that ran out of iterations elsewhere has open profiles,
    too: its residuals are large.
    """
    if not len(lanes):
        return
    info = informations(result.study, lanes, result.theta[lanes], result.whitened_sigma[lanes])
    moves = (result.study.lanes.active[lanes] > 0) & ~result.at_bound[lanes]
    gradient = np.where(moves, info.gradient, 0)
    size = np.sqrt(np.maximum(np.diagonal(info.bread, axis1=1, axis2=2), np.finfo(float).tiny))
    scaled = info.bread / size[:, :, None] / size[:, None] * (moves[:, :, None] & moves[:, None])
    slope = gradient / size
    gain = np.einsum("ni,nij,nj->n", slope, np.linalg.pinv(scaled, hermitian=True), slope)
    opened = (evidence.evidence_end[lanes] == ProfileEnd.OPEN).any(axis=(1, 2))
    # Along a valley less than what ends an interval: such fits have 0.001 to 2.4, others 19 to 155.
    limit = np.where(opened, result.uncertainty.half_width[lanes] ** 2, BETTER)
    limit = limit * np.nanmin(result.uncertainty.dispersion[lanes], axis=1)
    held = result.at_bound[lanes].any(axis=1)
    solved = np.where(held, FitStatus.AT_BOUND, FitStatus.CONVERGED)
    status = np.where(opened, FitStatus.UNIDENTIFIABLE, solved)
    evidence.status[lanes] = np.where(gain <= limit, status, evidence.status[lanes])


def _sides(result: FitResult, settings: Settings, doubts, progress) -> Sides:
    """Both sides of the profile of every unknown in doubt."""
    lane, unknown = (v.repeat(2) for v in np.nonzero(doubts))
    return Sides(result, settings, lane, unknown, progress, accuracy=ACCURACY, rounds=ROUNDS)


def no_evidence(result: FitResult) -> Evidence:
    """No evidence yet: the statuses of the fit, one minimum of each lane."""
    none = np.full(result.theta.shape, np.nan)
    end = np.full((*none.shape, 2), -1)
    return Evidence(result.status.copy(), none, none.copy(), end, np.ones(result.lanes, int))


def _other_minima(region: _Region, lanes, known: Structure) -> Int[np.ndarray, " n"]:
    """Fits from further starts, added to the region; minima within the threshold, by lane."""
    starts = [
        *soft_starts(region.result, lanes),
        *_walks(region, lanes),
        *twins(region.result, lanes),
        region.result.theta[lanes],
    ]
    theta, cost = region.sides.solve(
        np.tile(lanes, len(starts)),
        np.concatenate(starts),
        np.tile(known.pinned[lanes], (len(starts), 1)),
    )
    within = region.add(np.tile(lanes, len(starts)), theta, cost).reshape(len(starts), -1)
    theta = theta.reshape(len(starts), len(lanes), -1)
    result = region.result
    natural = natural_sizes(result.study, result.relative, result.first_touch)
    ends = (theta[within[:, n], n] for n in range(len(lanes)))
    return np.array(
        [
            _distinct(region.result, int(k), of_lane, natural[k])
            for k, of_lane in zip(lanes, ends, strict=True)
        ],
        int,
    )


def _distinct(
    result: FitResult, lane: int, ends: Float[np.ndarray, "n P"], natural: Float[np.ndarray, " P"]
) -> int:
    """Distinct minima among the estimate and `ends`, in unknowns that can be told."""
    own = (result.study.lanes.active[lane] > 0) & ~result.undetermined[lane]
    relative = natural[own]
    kept = [result.theta[lane][own]]
    for end in ends[:, own]:
        if min(np.max(np.abs(end - other) / relative) for other in kept) > APART:
            kept.append(end)
    return len(kept)


def _walks(region: _Region, lanes) -> list[Float[np.ndarray, "n P"]]:
    """From where the cost passes the threshold along the least determined direction, both ways.

    On the way every point within the threshold is added to the region.
    """
    result, sides = region.result, region.sides
    u = result.uncertainty
    weakest = u.weakest_direction[lanes] * result.relative[lanes]
    half = (u.half_width * u.weakest_se)[lanes]
    half = np.where(np.isfinite(half), half, 1.0)
    steps = np.minimum(half[:, None] * WALK, FAR)
    data, out = result.study.lanes, []
    for sign in (-1.0, 1.0):
        theta = result.theta[lanes][:, None] + sign * steps[..., None] * weakest[:, None]
        theta = np.clip(theta, data.lower[lanes][:, None], data.upper[lanes][:, None])
        lane = np.repeat(lanes, len(WALK))
        cost = sides.costs(lane, theta.reshape(len(lane), -1))
        within = region.add(lane, theta.reshape(len(lane), -1), cost).reshape(len(lanes), -1)
        first = np.argmax(~within, axis=1)
        first = np.where(within.all(axis=1), len(WALK) - 1, first)
        out.append(theta[np.arange(len(lanes)), first])
    return out


def _profiled(region: _Region, evidence: Evidence) -> None:
    """Profile all sides, and on from where the region reaches further than the profile."""
    result, sides = region.result, region.sides
    lane, unknown = sides.lane[::2], sides.unknown[::2]
    distance, end, path = find_ends(sides)
    _add_path(region, sides, path)
    distance, end = distance.reshape(-1, 2), end.reshape(-1, 2)
    best = result.theta[lane, unknown]
    low, high = best - distance[:, 0], best + distance[:, 1]
    low, high = _further(region, lane, unknown, low, high, end)
    low, high = (
        np.minimum(low, region.low[lane, unknown]),
        np.maximum(high, region.high[lane, unknown]),
    )
    open_ = end == ProfileEnd.OPEN
    low, high = np.where(open_[:, 0], -np.inf, low), np.where(open_[:, 1], np.inf, high)
    at = lane, unknown
    evidence.evidence_low[at] = unscaled(result.study, low, at)
    evidence.evidence_high[at] = unscaled(result.study, high, at)
    evidence.evidence_end[lane, unknown] = end


def _add_path(region: _Region, sides: Sides, path) -> None:
    """Add the points of profiles."""
    side, theta = np.concatenate(path.side), np.concatenate(path.theta)
    region.add(sides.lane[side], theta, sides.costs(sides.lane[side], theta))


def _further(region: _Region, lane, unknown, low, high, end):
    """Ends searched anew from the outermost points of the region, where they lie outside.

    Changes `end` where it does.
    """
    tolerance = 1e-3 * (high - low)
    beyond = np.stack(
        [
            region.low[lane, unknown] < low - tolerance,
            region.high[lane, unknown] > high + tolerance,
        ],
        axis=1,
    ) & (end != ProfileEnd.OPEN)
    rows = np.flatnonzero(beyond.any(axis=1))
    if not len(rows):
        return low, high
    pick = lane[rows], unknown[rows]
    origin = np.stack([region.at_low[pick], region.at_high[pick]], axis=1)
    origin = origin.reshape(2 * len(rows), -1)
    sides = Sides(
        region.result, region.sides.settings, lane[rows].repeat(2), unknown[rows].repeat(2),
        region.sides.progress, origin=origin, accuracy=ACCURACY, rounds=ROUNDS,
    )  # fmt: skip
    distance, ends, path = find_ends(sides)
    _add_path(region, sides, path)
    reach = origin[np.arange(len(origin)), sides.unknown] + sides.sign * distance
    for side, found in enumerate((low, high)):
        moved = rows[beyond[rows, side]]
        found[moved] = reach.reshape(-1, 2)[beyond[rows, side], side]
        end[moved, side] = ends.reshape(-1, 2)[beyond[rows, side], side]
    return low, high
