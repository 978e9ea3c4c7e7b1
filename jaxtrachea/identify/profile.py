"""Profile likelihood: how far each unknown can go while all others follow, for all lanes at once.

Every point of every profile is a lane of the batched Levenberg-Marquardt with one unknown pinned.
The statistic is twice the rise of the cost over its dispersion (`Uncertainty.dispersion`): with
known sigma the likelihood ratio, to be compared with chi^2_1; with estimated sigma
(S - S_min) / s^2, to be compared with F(1, n - P) = t^2. The latter is n log(S / S_min) up to a
monotone function, and exact for a model linear in its parameters, where the profile interval is
then that of the covariance (Bates and Watts 1988, ch. 6). The ends are found by root refinement in
sqrt(statistic), which is linear along a quadratic profile.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.identify.fit import FitResult, Settings
from jaxtrachea.identify.solve import Solved, chunk_size, levenberg_marquardt
from jaxtrachea.status import FitStatus, ProfileEnd

#: Rounds of the search for the ends; each is one batched solve.
_ROUNDS = 40
#: Relative accuracy of sqrt(statistic) at an end.
_ACCURACY = 1e-6
#: Refits handed to the solver at a time; bounds the memory.
_AT_ONCE = 8192


@dataclasses.dataclass(frozen=True, eq=False)
class Profiles:
    """Profiles of K unknowns at G points each; 95 % intervals.

    Attributes:
        result: the fit they belong to.
        lane: (K,).
        unknown: index of the unknown in its lane; (K,).
        lower: end of the interval in the parameter's unit: -inf (scale `log`: 0) where open, NaN
            where it was not found; (K,).
        upper: inf where open; (K,).
        end: `ProfileEnd` of the lower and the upper side; (K, 2).
        threshold: of the statistic; (K,).
        theta: all unknowns of the lane at each point, scaled coordinates, ordered along the
            profiled one, the estimate in the middle; (K, G, P).
        statistic: NaN where the fit did not converge; (K, G).
    """

    result: FitResult
    lane: Int[np.ndarray, " K"]
    unknown: Int[np.ndarray, " K"]
    lower: Float[np.ndarray, " K"]
    upper: Float[np.ndarray, " K"]
    end: Int[np.ndarray, "K 2"]
    threshold: Float[np.ndarray, " K"]
    theta: Float[np.ndarray, "K G P"]
    statistic: Float[np.ndarray, "K G"]

    @property
    def relative_error(self) -> Float[np.ndarray, " K"]:
        """Half the width of the interval in relative coordinates, over the half width in errors."""
        parameters = [self.result.problem.unknowns[k][i][0] for k, i in self.pairs]
        log = np.array([p.scale == "log" for p in parameters], bool)
        step = np.array([p.step for p in parameters])
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.maximum(np.abs(self.result.theta[self.lane, self.unknown]), 1e-3)
            linear = (self.upper - self.lower) / (step * size)
            width = np.where(log, np.log(self.upper / self.lower), linear)
        return width / (2 * np.sqrt(self.threshold))

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Lane and unknown of every profile."""
        return list(zip(self.lane.tolist(), self.unknown.tolist(), strict=True))

    @property
    def improved(self) -> Bool[np.ndarray, " K"]:
        """Where a point lies clearly below the estimate: the fit had ended in a worse minimum."""
        return np.nanmin(self.statistic, axis=1) < -0.01

    def find(self, lane: int, unknown: int) -> int | None:
        """Position of the profile of an unknown; None if it has none."""
        found = np.flatnonzero((self.lane == lane) & (self.unknown == unknown))
        return int(found[0]) if len(found) else None

    @property
    def coordinate(self) -> Float[np.ndarray, "K G"]:
        """The profiled unknown in scaled coordinates."""
        return np.take_along_axis(self.theta, self.unknown[:, None, None], axis=2)[:, :, 0]


def choose(result: FitResult, names: Sequence[str] | None) -> tuple[np.ndarray, np.ndarray]:
    """Lane and index of every unknown to profile: of succeeded lanes, of parameters in `names`.

    Raises:
        ValueError: a name is not among the free parameters.
    """
    free = [p.name for p in result.problem.free]
    for name in names or ():
        if name not in free:
            raise ValueError(f"{name!r} is not fitted, only {', '.join(free)} are")
    chosen = [
        (lane, i)
        for lane in range(result.lanes)
        if FitStatus(int(result.status[lane])).succeeded
        for i, (p, _, _) in enumerate(result.problem.unknowns[lane])
        if names is None or p.name in names
    ]
    pairs = np.array(chosen, int).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def profiles(
    result: FitResult,
    settings: Settings = Settings(),  # noqa: B008 (frozen)
    names: Sequence[str] | None = None,
    *,
    points: int = 10,
    progress: Callable[[int, int], None] | None = None,
) -> Profiles:
    """Profile every chosen unknown of every succeeded lane.

    Args:
        result: a fit with Levenberg-Marquardt or another method.
        settings: tolerances and chunk of the refits.
        names: parameters; None: all.
        points: grid points on each side of the estimate.
        progress: called with (refits done since the last call, 0 for unknown in all).

    Raises:
        ValueError: as `choose`.
    """
    lane, unknown = choose(result, names)
    sides = _Sides(result, settings, lane.repeat(2), unknown.repeat(2), progress)
    distance, end, path = _find_ends(sides)
    theta, statistic = _grid(sides, distance, end, path, points)
    best = np.take_along_axis(result.theta[lane], unknown[:, None], axis=1)[:, 0]
    reach = np.where(end == ProfileEnd.OPEN, np.inf, distance)
    reach = np.where(end == ProfileEnd.FAILED, np.nan, reach).reshape(-1, 2)
    parameters = [result.problem.unknowns[k][i][0] for k, i in zip(lane, unknown, strict=True)]
    log = np.array([p.scale == "log" for p in parameters], bool)
    step = np.array([p.step for p in parameters])
    with np.errstate(over="ignore"):
        unscale = lambda v: np.where(log, np.exp(v), v * step)  # noqa: E731
        lower, upper = unscale(best - reach[:, 0]), unscale(best + reach[:, 1])
    threshold = sides.target[::2] ** 2
    ends = end.reshape(-1, 2)
    return Profiles(result, lane, unknown, lower, upper, ends, threshold, theta, statistic)


class _Sides:
    """S one-sided profiles, downwards and upwards in turn, and how to refit at points of them."""

    def __init__(self, result: FitResult, settings: Settings, lane, unknown, progress):
        """`lane` and `unknown` of each side; all that is constant along a side is gathered here."""
        self.result, self.settings, self.progress = result, settings, progress
        self.lane, self.unknown = lane, unknown
        self.sign = np.tile([-1.0, 1.0], len(lane) // 2)
        self.best = result.theta[lane]
        u = result.uncertainty
        pick = lambda rows: np.array([rows[k][i] for k, i in zip(lane, unknown, strict=True)])  # noqa: E731
        self.dispersion = pick([v.dispersion for v in u])
        size = result.theta.shape[1]
        self.along = pick([v.along for v in u]).reshape(-1, size) * self.sign[:, None]
        self.target = np.array([float(u[k].half_width) for k in lane])
        lanes = result.problem.lanes
        bound = np.where(self.sign < 0, lanes.lower[lane, unknown], lanes.upper[lane, unknown])
        here = self.best[np.arange(len(lane)), unknown]
        self.limit = np.maximum(self.sign * (bound - here), 0)
        self.first = np.clip(self.target * pick([v.se for v in u]), 1e-9 * (1 + np.abs(here)), None)
        self.first = np.where(np.isfinite(self.first), self.first, 1.0)
        starts = result.lanes * settings.starts
        self.chunk = chunk_size(max(starts, 16), settings.chunk)
        self.sigma = result.whitened_sigma
        self.cost = self._costs_at_estimate()

    def _costs_at_estimate(self) -> np.ndarray:
        """Cost of every lane with the final sigma: a fit with everything pinned."""
        lanes = np.unique(self.lane)
        cost = np.full(self.result.lanes, np.nan)
        if len(lanes):
            everything = np.ones(self.result.theta.shape[1], bool)
            cost[lanes] = self._solve(lanes, self.result.theta[lanes], everything).cost
        return cost[self.lane]

    def _solve(self, lanes, start, pinned):
        """Fit `lanes` from `start` with the unknowns `pinned` (n, P) staying there."""
        problem = self.result.problem
        # Never fewer jobs than places: every call then runs the one compiled program.
        fill = max(self.chunk - len(lanes), 0)
        pad = lambda v: np.concatenate([v, v[-1:].repeat(fill, axis=0)])  # noqa: E731
        chosen = problem.take(pad(lanes))
        pinned = pad(np.broadcast_to(pinned, start.shape))
        start = np.clip(pad(start), chosen.lanes.lower, chosen.lanes.upper)
        active = np.where(pinned, 0, chosen.lanes.active)
        chosen = dataclasses.replace(chosen, lanes=chosen.lanes._replace(active=active))
        solved = levenberg_marquardt(
            chosen, np.arange(len(start)), start, self.sigma[pad(lanes)],
            tolerances=self.settings.tolerances, chunk=self.chunk,
        )  # fmt: skip
        return Solved(*(v[: len(lanes)] for v in solved))

    def refit(self, side, distance, start):
        """Points at `distance` from the estimate on each of `side`, from `start` (n, P).

        Returns:
            theta (n, P), statistic (n,), NaN where the fit did not converge.
        """
        thetas, statistics = [np.zeros((0, start.shape[1]))], [np.zeros(0)]
        for first in range(0, len(side), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            s, d = side[part], distance[part]
            pinned = np.arange(start.shape[1])[None] == self.unknown[s][:, None]
            here = self.best[s] + (self.sign[s] * d)[:, None]
            solved = self._solve(self.lane[s], np.where(pinned, here, start[part]), pinned)
            rise = 2 * (solved.cost - self.cost[s]) / self.dispersion[s]
            good = (solved.status == FitStatus.CONVERGED) & np.isfinite(rise)
            thetas.append(solved.theta)
            statistics.append(np.where(good, rise, np.nan))
            if self.progress is not None:
                self.progress(len(s), 0)
        return np.concatenate(thetas), np.concatenate(statistics)

    def others_on_bound(self, theta) -> np.ndarray:
        """Sides where, at `theta` (S, P), an unknown is on its bound that was not at the estimate.

        The profiled unknown does not count.
        """
        lanes = self.result.problem.lanes
        on = (theta <= lanes.lower[self.lane]) | (theta >= lanes.upper[self.lane])
        on &= (lanes.active[self.lane] > 0) & ~self.result.at_bound[self.lane]
        on[np.arange(len(on)), self.unknown] = False
        return on.any(axis=1)


class _Path:
    """Points found so far that belong to the profile: where to start the next fit from."""

    def __init__(self, sides: _Sides):
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
        slope = np.where(alone[:, None], self.sides.along[side], slope)
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


def _find_ends(sides: _Sides):
    """Where every side crosses its threshold: outwards until it is passed, then a bracketed secant.

    A point above the threshold may lie in a worse minimum than the profile's. It shows by a jump
    between it and its neighbour below, is forgotten then, and the search goes on outwards.

    Returns:
        Distance from the estimate, `ProfileEnd` (both (S,)), and the `_Path` of all points.
    """
    S = len(sides.lane)
    path, target = _Path(sides), sides.target
    # Ends of the bracket; excess of sqrt(statistic) there, and as the secant weighs it (Illinois).
    inner, below_by, at_inner = np.zeros(S), target.copy(), -target
    outer, above_by, at_outer = np.full(S, np.inf), np.full(S, np.nan), np.full(S, np.nan)
    where = np.minimum(sides.first, sides.limit)
    end = np.full(S, -1)
    end[sides.limit <= 0] = ProfileEnd.OPEN
    end[~(sides.dispersion > 0)] = ProfileEnd.FAILED
    theta, failures, moved = sides.best.copy(), np.zeros(S, int), np.zeros(S, int)
    for _ in range(_ROUNDS):
        rows = np.flatnonzero(end < 0)
        if len(rows) == 0:
            break
        d = where[rows]
        found, statistic = sides.refit(rows, d, path.start(rows, d))
        good = np.isfinite(statistic)
        excess = np.sqrt(np.maximum(statistic, 0)) - target[rows]
        close = good & (np.abs(excess) <= _ACCURACY * target[rows])
        up, down = good & (excess > 0), good & (excess <= 0)
        keep = down | close
        path.add(rows[keep], d[keep], found[keep])
        theta[rows[keep]] = found[keep]
        above, below = rows[up], rows[down]
        at_inner[above] *= np.where(moved[above] > 0, 0.5, 1)
        at_outer[below] *= np.where(moved[below] < 0, 0.5, 1)
        moved[above], moved[below] = np.where(np.isfinite(outer[above]), 1, 0), -1
        outer[above], above_by[above], at_outer[above] = d[up], excess[up], excess[up]
        inner[below], below_by[below], at_inner[below] = d[down], -excess[down], excess[down]
        failures[rows[~good]] += 1
        end[rows[close]] = ProfileEnd.CLOSED
        end[rows[down & ~close & (d >= sides.limit[rows])]] = ProfileEnd.OPEN
        jump = (outer - inner < 0.01 * outer) & (above_by + below_by > 0.1 * target) & (end < 0)
        outer[jump], above_by[jump], at_outer[jump], moved[jump] = np.inf, np.nan, np.nan, 0
        at_inner[jump] = -below_by[jump]
        where[jump] = inner[jump]
        failures[jump] += 1
        following = _next(rows, good, inner, at_inner, outer, at_outer, where, target)
        where[rows] = np.where(end[rows] < 0, np.minimum(following, sides.limit[rows]), d)
        end[(failures > 6) & (end < 0)] = ProfileEnd.FAILED
    end[end < 0] = ProfileEnd.FAILED
    end[(end == ProfileEnd.CLOSED) & sides.others_on_bound(theta)] = ProfileEnd.BOUND
    return np.where(end == ProfileEnd.FAILED, inner, where), end, path


def _next(rows, good, inner, at_inner, outer, at_outer, where, target):
    """Next distance: back where a fit failed, outwards before the threshold, then the secant."""
    a, fa, b, fb = inner[rows], at_inner[rows], outer[rows], at_outer[rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        secant = a - fa * (b - a) / (fb - fa)
        share = (target[rows] + fa) / target[rows]
        growth = np.where(share > 0.1, np.clip(1.1 / share, 1.2, 4), 4)
    step = np.where(np.isfinite(b), secant, a * growth)
    return np.where(good, step, (a + where[rows]) / 2)


def _grid(sides: _Sides, distance, end, path: _Path, points: int):
    """Profiles on an even grid of each side, the estimate in the middle."""
    S, P = sides.best.shape
    far = np.where(end <= ProfileEnd.BOUND, np.minimum(1.25 * distance, sides.limit), distance)
    grid = far[:, None] * np.arange(1, points + 1)[None] / points
    side = np.arange(S).repeat(points)
    theta, statistic = sides.refit(side, grid.ravel(), path.start(side, grid.ravel()))
    theta = theta.reshape(S // 2, 2, points, P)
    statistic = statistic.reshape(S // 2, 2, points)
    down, up = theta[:, 0, ::-1], theta[:, 1]
    middle = sides.best[::2, None]
    values = statistic[:, 0, ::-1], np.zeros((S // 2, 1)), statistic[:, 1]
    return np.concatenate([down, middle, up], axis=1), np.concatenate(values, axis=1)
