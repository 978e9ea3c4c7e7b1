"""Search along profiles: refits at points of many one-sided profiles at once, and their ends."""

import dataclasses

import numpy as np

from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.structure import leaving_alone, pins
from jaxtrachea.optimisation.batching import copied_at_once
from jaxtrachea.optimisation.levenberg_marquardt import Solved, levenberg_marquardt
from jaxtrachea.status import FitStatus, ProfileEnd

#: Rounds of the search for the ends; each is one batched solve.
_ROUNDS = 40
#: Failed refits and false brackets after which a side is given up.
_FAILURES = 6
#: Relative accuracy of sqrt(statistic) at an end.
_ACCURACY = 1e-6


class Sides:
    """S one-sided profiles, downwards and upwards in turn, and how to refit at points of them."""

    def __init__(
        self, result: FitResult, settings: Settings, lane, unknown, progress, *,
        origin: np.ndarray | None = None, accuracy: float = _ACCURACY, rounds: int = _ROUNDS,
    ):  # fmt: skip
        """`lane` and `unknown` of each side; all that is constant along a side is gathered here.

        `origin`: where the sides begin if not at the estimates, (S, P); the cost that counts is
        that of the estimates all the same. `accuracy`: of sqrt(statistic) at an end, relative;
        `rounds`: of the search for ends, each one batched solve.
        """
        self.accuracy, self.rounds, self.strict = accuracy, rounds, False
        self.result, self.settings, self.progress = result, settings, progress
        self.lane, self.unknown = lane, unknown
        self.sign = np.tile([-1.0, 1.0], len(lane) // 2)
        self.best = result.theta[lane] if origin is None else origin
        u = result.uncertainty
        self.dispersion = u.dispersion[lane, unknown]
        self.direction = u.conditional_direction[lane, unknown] * self.sign[:, None]
        if origin is not None:
            self.direction = np.zeros_like(self.direction)
        self.pinned = self._pinned()
        self.target = u.half_width[lane]
        lanes = result.study.lanes
        bound = np.where(self.sign < 0, lanes.lower[lane, unknown], lanes.upper[lane, unknown])
        here = self.best[np.arange(len(lane)), unknown]
        self.limit = np.maximum(self.sign * (bound - here), 0)
        self.first = np.clip(self.target * u.se[lane, unknown], 1e-9 * (1 + np.abs(here)), None)
        self.first = np.where(np.isfinite(self.first), self.first, 1.0)
        starts = result.lanes * settings.starts
        self.batch = result.study.batch_size(max(starts, 2), settings.batch)
        self.unoptimised = result.study.unoptimised(starts)
        self.sigma = result.whitened_sigma
        self.cost = self._costs_at_estimate()

    def _pinned(self) -> np.ndarray:
        """The profiled unknown, and those held so that the structure leaves nothing open; (S, P).

        Whatever they are held at, the others can make up for it.
        """
        pinned = np.arange(self.best.shape[1])[None] == self.unknown[:, None]
        for s in np.flatnonzero(self.result.undetermined[self.lane].any(axis=1)):
            lane, i = int(self.lane[s]), int(self.unknown[s])
            rows = self.result.uncertainty.structural_null_space[lane]
            rest = leaving_alone(rows[rows.any(axis=1)], i)
            names = [p.name for p, _, _ in self.result.study.unknowns[lane]]
            pinned[s] |= pins(names, rest)
        return pinned

    def costs(self, lanes, theta) -> np.ndarray:
        """Cost of `lanes` at `theta`, (n, P): a fit with everything pinned."""
        everything = np.ones(theta.shape[1], bool)
        return self._solve(lanes, theta, everything).cost

    def solve(self, lanes, theta, pinned) -> tuple[np.ndarray, np.ndarray]:
        """Where fits of `lanes` from `theta` end, and their costs; `pinned` (n, P) is held."""
        solved = self._solve(lanes, theta, pinned)
        return solved.theta, solved.cost

    def _costs_at_estimate(self) -> np.ndarray:
        """Cost of every lane with the final sigma: a fit with everything pinned."""
        lanes = np.unique(self.lane)
        cost = np.full(self.result.lanes, np.nan)
        if len(lanes):
            cost[lanes] = self.costs(lanes, self.result.theta[lanes])
        return cost[self.lane]

    def _solve(self, lanes, start, pinned):
        """Fit `lanes` from `start` with the unknowns `pinned` (n, P) staying there."""
        study = self.result.study
        # Never fewer starts than slots: every call then runs the one compiled program.
        fill = max(self.batch - len(lanes), 0)

        def pad(v):
            return np.concatenate([v, v[-1:].repeat(fill, axis=0)])

        chosen = study.take(pad(lanes))
        pinned = pad(np.broadcast_to(pinned, start.shape))
        start = np.clip(pad(start), chosen.lanes.lower, chosen.lanes.upper)
        active = np.where(pinned, 0, chosen.lanes.active)
        chosen = dataclasses.replace(chosen, lanes=chosen.lanes._replace(active=active))
        objective = LaneCost(chosen.model, chosen.lanes, self.sigma[pad(lanes)])
        solved = levenberg_marquardt(
            objective, start, tolerances=self.settings.tolerances, batch=self.batch,
            unoptimised=self.unoptimised,
        )  # fmt: skip
        return Solved(*(v[: len(lanes)] for v in solved))

    def refit(self, side, distance, start):
        """Points at `distance` from the estimate on each of `side`, from `start` (n, P).

        A fit that has not converged shows that the profile is no higher than where it stands, and
        counts (unless `self.strict`) if that is below the threshold.

        Returns:
            theta (n, P), statistic (n,), NaN where the fit did not converge.
        """
        thetas, statistics = [np.zeros((0, start.shape[1]))], [np.zeros(0)]
        copied = copied_at_once(self.result.study.bytes_per_lane)
        for first in range(0, len(side), copied):
            part = slice(first, first + copied)
            s, d = side[part], distance[part]
            here = self.best[s] + (self.sign[s] * d)[:, None]
            own = np.arange(start.shape[1])[None] == self.unknown[s][:, None]
            solved = self._solve(self.lane[s], np.where(own, here, start[part]), self.pinned[s])
            rise = 2 * (solved.cost - self.cost[s]) / self.dispersion[s]
            below = (not self.strict) & (rise <= self.target[s] ** 2)
            good = ((solved.status == FitStatus.CONVERGED) | below) & np.isfinite(rise)
            thetas.append(solved.theta)
            statistics.append(np.where(good, rise, np.nan))
            if self.progress is not None:
                self.progress(len(s), 0)
        return np.concatenate(thetas), np.concatenate(statistics)

    def others_on_bound(self, theta) -> np.ndarray:
        """Sides where, at `theta` (S, P), an unknown is on its bound that was not at the estimate.

        The profiled unknown does not count.
        """
        lanes = self.result.study.lanes
        on = (theta <= lanes.lower[self.lane]) | (theta >= lanes.upper[self.lane])
        on &= (lanes.active[self.lane] > 0) & ~self.result.at_bound[self.lane]
        on[np.arange(len(on)), self.unknown] = False
        return on.any(axis=1)


class Path:
    """Points found so far that belong to the profile: where to start the next fit from."""

    def __init__(self, sides: Sides):
        """With the estimate and its tangent, which is followed where nothing is known."""
        self.sides = sides
        self.side = [np.arange(len(sides.lane))]
        self.distance = [np.zeros(len(sides.lane))]
        self.theta = [sides.best]

    def add(self, side, distance, theta) -> None:
        """Remember points."""
        self.side.append(side)
        self.distance.append(distance)
        self.theta.append(theta)

    def start(self, side, distance) -> np.ndarray:
        """Unknowns at `distance`: between two known points, or beyond the last one.

        Beyond, the others follow at most one scaled unit: a start far off in a corner of the box
        leads into other minima.
        """
        sides, distances = np.concatenate(self.side), np.concatenate(self.distance)
        thetas = np.concatenate(self.theta)
        order = np.lexsort((distances, sides))
        sides, distances, thetas = sides[order], distances[order], thetas[order]
        pairs = [self._frame(sides, distances, s, d) for s, d in zip(side, distance, strict=True)]
        left, right = np.array(pairs, int).reshape(-1, 2).T
        gap = distances[right] - distances[left]
        alone = gap <= 0
        slope = (thetas[right] - thetas[left]) / np.where(alone, 1, gap)[:, None]
        slope = np.where(alone[:, None], self.sides.direction[side], slope)
        beyond = distance > distances[right]
        base = np.where(beyond, right, left)
        move = slope * (distance - distances[base])[:, None]
        move = np.where(beyond[:, None], np.clip(move, -1, 1), move)
        return thetas[base] + move

    @staticmethod
    def _frame(sides, distances, side, distance) -> tuple[int, int]:
        """The two known points around a distance, or the last one and another well before it."""
        first, end = (int(np.searchsorted(sides, side, at)) for at in ("left", "right"))
        own = distances[first:end]
        if distance <= own[-1]:
            right = max(int(np.searchsorted(own, distance)), 1 if len(own) > 1 else 0)
            return first + max(right - 1, 0), first + right
        before = int(np.searchsorted(own, 0.75 * own[-1], "right")) - 1
        return first + min(max(before, 0), len(own) - 1), end - 1


class _Bracket:
    """Where each side lies below and above its threshold, by sqrt(statistic) - target.

    A bracketed secant (Illinois): where the same end moves twice, the other one counts half.
    """

    def __init__(self, target: np.ndarray):
        """From the estimate outwards, nothing above yet."""
        self.target = target
        self.inner, self.below = np.zeros(len(target)), -target
        self.outer, self.above = np.full((2, len(target)), [[np.inf], [np.nan]])
        self.weight_inner, self.weight_outer = np.ones((2, len(target)))
        self.moved = np.zeros(len(target), int)

    def add(self, side, distance, excess) -> None:
        """Move an end of each of `side`."""
        up, down = side[excess > 0], side[excess <= 0]
        self.weight_inner[up] *= np.where(self.moved[up] > 0, 0.5, 1)
        self.weight_outer[down] *= np.where(self.moved[down] < 0, 0.5, 1)
        self.moved[up], self.moved[down] = np.where(np.isfinite(self.outer[up]), 1, 0), -1
        self.outer[up], self.above[up] = distance[excess > 0], excess[excess > 0]
        self.inner[down], self.below[down] = distance[excess <= 0], excess[excess <= 0]
        self.weight_outer[up] = self.weight_inner[down] = 1

    def forget_jumps(self) -> np.ndarray:
        """Sides with a jump between neighbours; their upper end, in a worse minimum, is dropped."""
        near = self.outer - self.inner < 0.01 * self.outer
        jump = near & (self.above - self.below > 0.1 * self.target)
        self.outer[jump], self.above[jump], self.moved[jump] = np.inf, np.nan, 0
        self.weight_inner[jump] = 1
        return jump

    def next(self) -> np.ndarray:
        """Next distance: outwards by the parabola until the threshold is passed, then secant."""
        below, above = self.below * self.weight_inner, self.above * self.weight_outer
        share = 1 + self.below / self.target
        with np.errstate(invalid="ignore", divide="ignore"):
            secant = self.inner - below * (self.outer - self.inner) / (above - below)
            growth = np.where(share > 0.1, np.clip(1.1 / share, 1.2, 4), 4)
        return np.where(np.isfinite(self.outer), secant, self.inner * growth)


def find_ends(sides: Sides):
    """Where every side crosses its threshold: outwards until it is passed, then a bracketed secant.

    A point above the threshold may lie in a worse minimum than the profile's. It shows by a jump
    between it and its neighbour below, is forgotten then, and the search goes on outwards.

    Returns:
        Distance from the estimate, `ProfileEnd` (both (S,)), and the `Path` of all points.
    """
    path, bracket = Path(sides), _Bracket(sides.target)
    where = np.minimum(sides.first, sides.limit)
    end = np.full(len(where), -1)
    end[sides.limit <= 0] = ProfileEnd.OPEN
    end[~(sides.dispersion > 0)] = ProfileEnd.FAILED
    theta, failures = sides.best.copy(), np.zeros(len(where), int)
    for _ in range(sides.rounds):
        rows = np.flatnonzero(end < 0)
        if len(rows) == 0:
            break
        d = where[rows]
        found, statistic = sides.refit(rows, d, path.start(rows, d))
        good = np.isfinite(statistic)
        excess = np.sqrt(np.maximum(statistic, 0)) - sides.target[rows]
        close = good & (np.abs(excess) <= sides.accuracy * sides.target[rows])
        down = good & (excess <= 0)
        path.add(rows[down | close], d[down | close], found[down | close])
        theta[rows[down | close]] = found[down | close]
        bracket.add(rows[good], d[good], excess[good])
        end[rows[close]] = ProfileEnd.CLOSED
        end[rows[down & ~close & (d >= sides.limit[rows])]] = ProfileEnd.OPEN
        failures[rows[~good]] += 1
        failures += bracket.forget_jumps() & (end < 0)
        end[(failures > _FAILURES) & (end < 0)] = ProfileEnd.FAILED
        # After a refit that failed: halfway back.
        following = np.where(good, bracket.next()[rows], (bracket.inner[rows] + d) / 2)
        where[rows] = np.where(end[rows] < 0, np.minimum(following, sides.limit[rows]), d)
    near = (end < 0) & (bracket.outer - bracket.inner <= 10 * sides.accuracy * bracket.outer)
    where[near], end[near] = bracket.outer[near], ProfileEnd.CLOSED
    end[end < 0] = ProfileEnd.FAILED
    end[(end == ProfileEnd.CLOSED) & sides.others_on_bound(theta)] = ProfileEnd.BOUND
    return np.where(end == ProfileEnd.FAILED, bracket.inner, where), end, path


def on_grid(sides: Sides, distance, end, path: Path, points: int):
    """Profiles on an even grid of each side, the estimate in the middle."""
    S, P = sides.best.shape
    far = np.where(end <= ProfileEnd.BOUND, np.minimum(1.25 * distance, sides.limit), distance)
    grid = far[:, None] * np.arange(1, points + 1)[None] / points
    side = np.arange(S).repeat(points)
    start, sides.strict = path.start(side, grid.ravel()), True
    theta, statistic = sides.refit(side, grid.ravel(), start)
    theta = theta.reshape(S // 2, 2, points, P)
    statistic = statistic.reshape(S // 2, 2, points)
    down, up = theta[:, 0, ::-1], theta[:, 1]
    middle = sides.best[::2, None]
    values = statistic[:, 0, ::-1], np.zeros((S // 2, 1)), statistic[:, 1]
    return np.concatenate([down, middle, up], axis=1), np.concatenate(values, axis=1)
