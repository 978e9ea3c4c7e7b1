"""Joint fit: unknowns of every specimen and unknowns that all share, linear in the specimens.

Each iteration is a Gauss-Newton step on the arrow matrix (`schur`) with one trust region, on the
shared unknowns: all others follow by substitution. A lane that this leaves well above its own
minimum is fitted anew with the shared unknowns pinned, by the solver of single lanes; near the
solution none is. Bounds by an active set. A lane that cannot be evaluated is left out and marked.

Starts: every lane is first fitted by itself from its draw, as if nothing were shared; the shared
unknowns begin at the median over the lanes. That is robust against specimens without information
and outliers, where the mean of the estimates is not.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import epsilon
from jaxtrachea.fitting.cost import LaneCost, evaluate, rounding_cost
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.levenberg_marquardt import Solved, levenberg_marquardt
from jaxtrachea.optimisation.schur import eliminate, trust_region_step
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.status import FitStatus

#: First radius of the trust region of the shared unknowns, scaled coordinates.
_FIRST_RADIUS = 2.0
#: A lane is fitted anew if it is above its own minimum by more than this share of its cost, or of
#: what it has moved through (a Gauss-Newton step that works leaves far less).
_NOT_MINIMISED, _LEFT = 0.01, 0.1
#: Iterations granted after the shared unknowns have come to rest, or when the cost falls no more.
_BUDGET = 10
#: Longest step of a lane's own unknowns, scaled coordinates (log: a factor of 5e8), once no step
#: lowers the cost or some lanes do not come to rest.
_LONGEST = 20.0


class Evaluated(NamedTuple):
    """All lanes evaluated at one point of the shared unknowns.

    Attributes:
        theta: (L, P).
        cost: inf where a lane cannot be evaluated; (L,).
        gradient: (L, P).
        hessian: (L, P, P).
    """

    theta: Float[np.ndarray, "L P"]
    cost: Float[np.ndarray, " L"]
    gradient: Float[np.ndarray, "L P"]
    hessian: Float[np.ndarray, "L P P"]

    @property
    def finite(self) -> Bool[np.ndarray, " L"]:
        """Which lanes could be evaluated."""
        return np.isfinite(self.cost)


@dataclasses.dataclass(frozen=True, eq=False)
class _Task:
    """What stays the same during a descent."""

    study: Study
    sigma: np.ndarray
    tolerances: Tolerances
    batch: int
    dtype: Any
    shared: Int[np.ndarray, "L k"]

    @property
    def tolerance(self) -> float:
        """Relative fall of the cost that does not count."""
        return max(self.tolerances.cost, 4 * epsilon(self.dtype))


def solve_jointly(
    study: Study,
    starts: Float[np.ndarray, "starts L P"],
    sigma: Float[np.ndarray, "L 2"],
    *,
    separately: bool,
    tolerances: Tolerances = Tolerances(),
    batch: int = 128,
    progress: Callable[[int], None] | None = None,
    dtype=np.float64,
) -> tuple[Solved, int]:
    """Fit all lanes together from every start and keep the best.

    Args:
        study: a joint one.
        starts: scaled coordinates.
        sigma: of each lane, as for `levenberg_marquardt`.
        separately: fit every lane by itself first; else a start is a point near the solution.
        tolerances: when all is done; the cost's is per lane.
        batch: lanes computed together, always as many.
        progress: as for `levenberg_marquardt`; also called with 0 in every joint iteration.
        dtype: of the computation; sums over lanes are float64.

    Returns:
        The best outcome, one row per lane, and how many starts ended in it.
    """
    task = _Task(study, sigma, tolerances, batch, dtype, study.shared)
    if separately:
        starts = _fit_separately(task, starts, progress)
    solved = [_descend(task, start, progress) for start in starts]
    there = [s.status <= FitStatus.STALLED for s in solved]
    # The cost of a start that lost a lane is not comparable: most lanes first.
    most = max(int(np.sum(t)) for t in there)
    cost = np.array([np.sum(s.cost[t]) for s, t in zip(solved, there, strict=True)])
    cost = np.where([np.sum(t) == most for t in there], cost, np.inf)
    well = np.array([np.any(s.status == FitStatus.CONVERGED) for s in solved])
    near = cost <= np.min(cost) * (1 + 1e-6) + 1e-300
    best = int(np.argmin(np.where(near & well, -1.0, cost)))
    return solved[best], int(np.sum(near & well))


def _fit_separately(task: _Task, starts, progress) -> np.ndarray:
    """Lanes fitted by themselves from every start, then the shared unknowns at their median."""
    count, lanes, P = starts.shape
    rows = np.tile(np.arange(lanes), count)
    found = _single(task, task.study, rows, starts.reshape(-1, P), progress)
    usable = (found.status <= FitStatus.STALLED).reshape(count, lanes)
    theta = np.where(usable[..., None], found.theta.reshape(starts.shape), starts)
    row = np.arange(lanes)[:, None]
    for of, good in zip(theta, usable, strict=True):
        values = of[row, task.shared]
        of[row, task.shared] = np.median(values[good] if good.any() else values, axis=0)
    return theta


def _single(task: _Task, study: Study, rows, starts, progress=None) -> Solved:
    """The solver of single lanes; always in batches of one size, so that it is compiled once."""
    total = len(rows)
    missing = max(0, task.batch - total)

    def pad(v):
        return np.concatenate([v, np.repeat(v[:1], missing, axis=0)])

    solved = levenberg_marquardt(
        LaneCost(study.model, study.lanes, task.sigma), pad(starts), pad(rows),
        tolerances=task.tolerances, batch=task.batch, progress=progress, dtype=task.dtype,
    )  # fmt: skip
    return Solved(*(v[:total] for v in solved))


def _descend(task: _Task, start: Float[np.ndarray, "L P"], progress) -> Solved:
    """One start: iterations until the shared unknowns and all lanes rest."""
    from scipy.linalg import norm  # of numbers whose squares overflow too

    lanes = task.study.lanes

    def clip(theta):
        return np.clip(theta, lanes.lower, lanes.upper)

    here = _evaluate_or_refit(task, clip(start), None, np.ones(len(start), bool))
    alive = here.finite
    radius, status, budget, n = _FIRST_RADIUS, FitStatus.MAX_ITERATIONS, _BUDGET, 0
    fall = longest = np.inf
    stuck, unconverged = False, np.zeros(len(alive), bool)
    while alive.any() and n < task.tolerances.iterations:
        n += 1
        if progress is not None:
            progress(0)
        reduced, moving, gradient, hessian = _reduce(task, here, alive, longest)
        step, shared = _shared_step(task, here, alive, radius, moving, gradient, hessian)
        resting, unconverged = _at_rest(task, here, alive, reduced, gradient, hessian, moving)
        budget -= resting or fall <= _floor(task, here, alive)
        if resting and not unconverged.any():
            status = FitStatus.CONVERGED
            break
        if stuck or budget == 0:
            if np.isfinite(longest) or not (stuck or unconverged.any()):
                status = FitStatus.STALLED if stuck else FitStatus.CONVERGED
                break
            # An unknown that is best at infinity may have promised what is not to be had.
            radius, budget, fall, longest, stuck = _FIRST_RADIUS, _BUDGET, np.inf, _LONGEST, False
            continue
        trial = clip(here.theta + reduced.step + reduced.sensitivity @ step)
        trial[np.arange(len(trial))[:, None], task.shared] = shared
        trial = np.where(alive[:, None], trial, here.theta)
        there = _evaluate_or_refit(task, trial, here, alive)
        finite = np.all(there.finite[alive])
        fall = np.sum(here.cost[alive] - there.cost[alive]) if finite else -np.inf
        promised = -(gradient @ step + 0.5 * step @ hessian @ step) + np.sum(
            reduced.predicted_decrease[alive]
        )
        length = norm(step)
        if fall < 0.25 * promised:
            radius = 0.25 * (min(radius, length) if length > 0 else radius)
        elif fall > 0.75 * promised:
            radius = max(radius, 2 * length)
        if fall > 0:
            here = there
        elif promised <= _rounding(task, here, alive):
            status = FitStatus.CONVERGED
            break
        else:
            stuck = bool(radius < task.tolerances.step)
    codes = np.where(unconverged & ~_nearly_flat(task, here), FitStatus.MAX_ITERATIONS, status)
    codes = np.where(alive, codes, FitStatus.INFEASIBLE_START)
    return Solved(here.theta, here.cost, codes, np.full(len(alive), n))


def _shared_step(task: _Task, here: Evaluated, alive, radius, moving, gradient, hessian):
    """Step of the shared unknowns within the radius, and where it leads; (k,) each.

    What the step would carry over a bound stops on it, and the others are minimal given that.
    """
    theta, box = _of_shared(task, here.theta, alive)
    step, stops = np.zeros(len(gradient)), np.zeros(len(gradient), bool)
    while True:
        free = moving & ~stops
        if free.any():
            pull = gradient[free] + hessian[np.ix_(free, stops)] @ step[stops]
            step[free] = trust_region_step(radius, pull, hessian[np.ix_(free, free)])
        ahead = theta + step
        crossing = free & ((ahead < box.lower) | (ahead > box.upper))
        if not crossing.any():
            # Not by the difference: theta + (bound - theta) may miss the bound by a rounding.
            bound = np.where(step > 0, box.upper, box.lower)
            return step, np.where(stops & (step != 0), bound, ahead)
        step[crossing] = np.clip(ahead, box.lower, box.upper)[crossing] - theta[crossing]
        stops |= crossing


def _of_shared(task: _Task, theta, alive):
    """The shared unknowns and their bounds."""
    row, lanes = int(np.argmax(alive)), task.study.lanes

    def at(v) -> Any:
        return v[row, task.shared[row]]

    return at(theta), Bounds(at(lanes.lower), at(lanes.upper))


def _reduce(task: _Task, here: Evaluated, alive, longest: float):
    """Elimination at a point: lanes reduced, which shared unknowns move, and their equations."""
    g = np.where(alive[:, None], here.gradient, 0)
    H = np.where(alive[:, None, None], here.hessian, 0)
    reduced = eliminate(g, H, task.shared, ~_active_set(here.theta, g, task.study.lanes), longest)
    gradient, hessian = reduced.gradient.sum(axis=0), reduced.hessian.sum(axis=0)
    theta, box = _of_shared(task, here.theta, alive)
    return reduced, ~_active_set(theta, gradient, box), gradient, hessian


class Bounds(NamedTuple):
    """Bounds of some unknowns."""

    lower: np.ndarray
    upper: np.ndarray


def _active_set(theta, gradient, box) -> np.ndarray:
    """Unknowns on a bound that the gradient pushes against."""
    return ((theta <= box.lower) & (gradient >= 0)) | ((theta >= box.upper) & (gradient <= 0))


def _at_rest(task: _Task, here: Evaluated, alive, reduced, gradient, hessian, moving):
    """Whether the shared unknowns have nothing left to gain, and which lanes have."""
    floor = _floor(task, here, alive)
    newton = np.linalg.lstsq(hessian[np.ix_(moving, moving)], gradient[moving], rcond=None)[0]
    resting = 0.5 * newton @ gradient[moving] <= floor
    return bool(resting), alive & (reduced.predicted_decrease > floor)


def _nearly_flat(task: _Task, here: Evaluated) -> np.ndarray:
    """Lanes whose residual is all but orthogonal to their Jacobian, as for single lanes; (L,)."""
    diagonal = np.diagonal(here.hessian, axis1=1, axis2=2)
    own = ~_active_set(here.theta, here.gradient, task.study.lanes) & (diagonal > 0)
    own[np.arange(len(own))[:, None], task.shared] = False
    cosine = np.abs(here.gradient) / np.sqrt(np.where(own, diagonal, 1)) * own
    tolerance = max(task.tolerances.gradient, 4 * epsilon(task.dtype))
    return np.max(cosine, axis=1) <= 1e3 * tolerance**0.5 * np.sqrt(2 * here.cost)


def _floor(task: _Task, here: Evaluated, alive) -> float:
    """Fall of the cost that is not worth a step, for the shared unknowns and for each lane.

    A share of the cost of one lane, or what rounding leaves where the data are exact: a share of
    the whole cost would let errors grow with the number of lanes.
    """
    alive = alive & here.finite
    if not alive.any():
        return 0.0
    study = task.study
    exact = rounding_cost(study.model, study.lanes, task.sigma, task.dtype)[alive]
    share = 0.01 * task.tolerance * np.sum(here.cost[alive])
    return (share + np.sum(exact)) / np.sum(alive)


def _rounding(task: _Task, here: Evaluated, alive) -> float:
    """Promise too small to be seen in the cost."""
    total = np.sum(here.cost[alive])
    return task.tolerance * total / np.sum(alive) + 100 * epsilon(task.dtype) * total


def _evaluate_or_refit(
    task: _Task, theta: np.ndarray, before: Evaluated | None, alive
) -> Evaluated:
    """Evaluate all lanes; those far above their own minimum are fitted with shared ones pinned.

    Args:
        task: the descent.
        theta: trial; (L, P).
        before: its own unknowns are a second start of such a fit.
        alive: lanes that count; (L,).
    """
    here = _evaluate(task, theta)
    if task.study.size == task.shared.shape[1]:
        return here
    lanes = task.study.lanes
    finite = here.finite
    g = np.where(finite[:, None], here.gradient, 0)
    H = np.where(finite[:, None, None], here.hessian, 0)
    gain = eliminate(g, H, task.shared, ~_active_set(theta, g, lanes)).predicted_decrease
    floor = _floor(task, here, alive)
    not_minimised = ~finite | (gain > _NOT_MINIMISED * here.cost)
    if before is not None:
        moved = theta - before.theta
        through = 0.5 * np.einsum("lp,lpq,lq->l", moved, before.hessian, moved)
        not_minimised |= (gain > _LEFT * through) & (gain > floor)
    not_minimised = np.flatnonzero(alive & not_minimised)
    if not len(not_minimised):
        return here
    row = np.arange(len(theta))[:, None]
    starts = [theta]
    if before is not None:
        starts.append(before.theta.copy())
        starts[1][row, task.shared] = theta[row, task.shared]
    lower, upper = lanes.lower.copy(), lanes.upper.copy()
    for side in (lower, upper):
        side[row, task.shared] = theta[row, task.shared]
    pinned = dataclasses.replace(task.study, lanes=lanes._replace(lower=lower, upper=upper))
    rows = np.tile(not_minimised, len(starts))
    found = _single(task, pinned, rows, np.concatenate([s[not_minimised] for s in starts]))
    cost = np.where(np.isfinite(found.cost), found.cost, np.inf).reshape(len(starts), -1)
    best = np.argmin(cost, axis=0)
    again = theta.copy()
    count = len(not_minimised)
    of_starts = found.theta.reshape(len(starts), count, -1)
    again[not_minimised] = of_starts[best, np.arange(count)]
    return _evaluate(task, again)


def _evaluate(task: _Task, theta: Float[np.ndarray, "L P"]) -> Evaluated:
    """Cost and normal equations of all lanes, a batch at a time."""
    batch = task.study.batch_size(len(theta), task.batch)
    cost, gradient, hessian = map_lanes(
        _normal_equations, task.study, theta, task.sigma, batch=batch, dtype=task.dtype
    )
    finite = np.isfinite(cost) & np.isfinite(hessian).all(axis=(1, 2))
    finite &= np.isfinite(gradient).all(axis=1)
    return Evaluated(theta, np.where(finite, cost, np.inf), gradient, hessian)


def _normal_equations(model: FitModel, theta: Array, lane: Lane, sigma: Array):
    """Cost, gradient and Gauss-Newton matrix of one lane."""
    point = evaluate(model, theta, lane, sigma)
    return point.cost, point.gradient, point.hessian
