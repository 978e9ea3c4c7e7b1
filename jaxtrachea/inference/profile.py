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

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.profile_search import Sides, find_ends, on_grid
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings, check_precision
from jaxtrachea.fitting.starts import unscaled
from jaxtrachea.status import FitStatus, ProfileEnd


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
        parameters = [self.result.study.unknowns[k][i][0] for k, i in self.pairs]
        log = np.array([p.scale == "log" for p in parameters], bool)
        step = np.array([p.step for p in parameters])
        with np.errstate(divide="ignore", invalid="ignore"):
            size = self.result.relative[self.lane, self.unknown]
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
    free = [p.name for p in result.study.free]
    for name in names or ():
        if name not in free:
            raise ValueError(f"{name!r} is not fitted, only {', '.join(free)} are")
    chosen = [
        (lane, i)
        for lane in range(result.lanes)
        if FitStatus(int(result.status[lane])).succeeded
        for i, (p, _, _) in enumerate(result.study.unknowns[lane])
        if names is None or p.name in names
    ]
    pairs = np.array(chosen, int).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def profiles(
    result: FitResult,
    settings: Settings = Settings(),
    names: Sequence[str] | None = None,
    *,
    points: int = 10,
    progress: Callable[[int, int], None] | None = None,
) -> Profiles:
    """Profile every chosen unknown of every succeeded lane.

    Args:
        result: a fit with Levenberg-Marquardt or another method.
        settings: tolerances and batch of the refits.
        names: parameters; None: all.
        points: grid points on each side of the estimate.
        progress: called with (refits done since the last call, 0 for unknown in all).

    Raises:
        ValueError: no `FitResult` or `Settings`, as `choose`, or a joint study.
    """
    check_word("result", result, FitResult)
    check_word("settings", settings, Settings)
    result.study.refuse_joint("a profile")
    check_precision(settings)
    lane, unknown = choose(result, names)
    sides = Sides(result, settings, lane.repeat(2), unknown.repeat(2), progress)
    distance, end, path = find_ends(sides)
    theta, statistic = on_grid(sides, distance, end, path, points)
    best = np.take_along_axis(result.theta[lane], unknown[:, None], axis=1)[:, 0]
    reach = np.where(end == ProfileEnd.OPEN, np.inf, distance)
    reach = np.where(end == ProfileEnd.FAILED, np.nan, reach).reshape(-1, 2)
    lower, upper = (
        unscaled(result.study, v, (lane, unknown)) for v in (best - reach[:, 0], best + reach[:, 1])
    )
    threshold = sides.target[::2] ** 2
    ends = end.reshape(-1, 2)
    return Profiles(result, lane, unknown, lower, upper, ends, threshold, theta, statistic)
