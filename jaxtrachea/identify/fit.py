"""One fit from problem to result: starts, noise levels, best start, what may be believed."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import numpy as np

from jaxtrachea.identify import descent, joint
from jaxtrachea.identify.parameters import Parameter
from jaxtrachea.identify.problem import Problem
from jaxtrachea.identify.solve import Solved, Tolerances, chunk_size, levenberg_marquardt
from jaxtrachea.identify.uncertainty import Information, Uncertainty, analyse, informations
from jaxtrachea.status import FitStatus


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        method: `levenberg-marquardt`, or optax's `lbfgs` / `adam` on the same cost.
        starts: starts per lane; the first is the initial guess, the others are drawn around it.
        decades: starts are drawn up to this many decades from the guess (log scale; with linear
            scale up to this many times 10 steps), inside the bounds.
        seed: of the drawn starts.
        chunk: lanes computed together.
        tolerances: when a lane is done.
        float32: compute in single precision (results are float64 all the same).
    """

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    starts: int = 4
    decades: float = 1.0
    seed: int = 0
    chunk: int = 128
    tolerances: Tolerances = Tolerances()
    float32: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class FitResult:
    """Estimates of every lane; leading axis = lanes of the problem, P unknowns each.

    Attributes:
        problem: what was fitted.
        theta: estimate in scaled coordinates; (lanes, P).
        value: estimate in the parameter's unit; (lanes, P).
        standard_error: in the parameter's unit (delta method); (lanes, P).
        lower: 95 % interval, transformed from scaled coordinates; (lanes, P).
        upper: (lanes, P).
        relative_se: standard error over the value (scale `log`: of the logarithm); (lanes, P).
        at_bound: (lanes, P).
        status: `FitStatus`; (lanes,).
        iterations: of the best start; (lanes,).
        cost: half the weighted sum of squares (or of rho); (lanes,).
        converged_starts: starts that ended in the best minimum; (lanes,).
        sigma: standard deviation of force (N) and markers (mm), given or estimated; (lanes, 2).
        rms: root mean square residual of force (N) and markers (mm); (lanes, 2).
        samples: observed entries; (lanes,).
        uncertainty: `Uncertainty` of each lane.
    """

    problem: Problem
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
    sigma: np.ndarray
    rms: np.ndarray
    samples: np.ndarray
    uncertainty: tuple[Uncertainty, ...]

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return len(self.status)

    @property
    def whitened_sigma(self) -> np.ndarray:
        """`sigma` in units of the lanes' precision, as `evaluate` wants it; (lanes, 2)."""
        return self.sigma / _precision_unit(self.problem)


def fit(
    problem: Problem,
    settings: Settings = Settings(),  # noqa: B008 (frozen)
    progress: Callable[[int, int], None] | None = None,
    starts: np.ndarray | None = None,
) -> FitResult:
    """Fit every lane from every start and keep the best; failed lanes are rows with a status.

    Args:
        problem: from `problem.build`.
        settings: how to solve.
        progress: called with (jobs finished since the last call, jobs in all).
        starts: where to start, scaled coordinates, (lanes * settings.starts, P); None: drawn.

    Returns:
        The `FitResult`. It never raises for a lane's sake.
    """
    sigma = first_sigma(problem)
    starts = draw_starts(problem, settings) if starts is None else starts
    solved, agree = _solve(problem, settings, starts, sigma, progress)
    for _ in range(_noise_rounds(problem)):
        _, pool, unknowns = _known(problem, solved, sigma)
        sigma = next_sigma(problem, pool, sigma, unknowns)
        again, _ = _solve(problem, settings, solved.theta, sigma, None, near=True)
        solved = again._replace(iterations=solved.iterations + again.iterations)
    info, pool, unknowns = _known(problem, solved, sigma)
    before, sigma = sigma, next_sigma(problem, pool, sigma, unknowns)
    if problem.loss == "linear" and problem.lanes.joints is None:
        ratio = before[:, 0] / sigma[:, 0]
        info, pool = info.rescaled(ratio), pool.rescaled(ratio)
    else:
        info, pool, unknowns = _known(problem, solved, sigma)
    return _conclude(problem, solved, (info, pool, unknowns), sigma, agree)


def _solve(
    problem: Problem, settings: Settings, starts, sigma, progress, *, near=False
) -> tuple[Solved, np.ndarray]:
    """The best of the starts of every lane, and how many of them agree; `near`: only one start."""
    lanes = problem.lanes.lower.shape[0]
    report = None if progress is None else lambda done: progress(done, len(starts))
    common = {"tolerances": settings.tolerances, "chunk": settings.chunk, "progress": report}
    common["dtype"] = np.float32 if settings.float32 else np.float64
    count = len(starts) // lanes
    if problem.joint:
        if settings.method != "levenberg-marquardt":
            raise ValueError(f"a joint problem needs levenberg-marquardt, not {settings.method}")
        # One size for all calls, so that it is compiled once.
        common["chunk"] = chunk_size(lanes * settings.starts, settings.chunk)
        of_starts = np.swapaxes(starts.reshape(lanes, count, -1), 0, 1)
        solved, agree = joint.solve_jointly(problem, of_starts, sigma, alone=not near, **common)
        return solved, np.full(lanes, agree)
    jobs = np.repeat(np.arange(lanes), count)
    if settings.method == "levenberg-marquardt":
        solved = levenberg_marquardt(problem, jobs, starts, sigma[jobs], **common)
    else:
        method = settings.method
        solved = descent.descend(problem, jobs, starts, sigma[jobs], method=method, **common)
    if near:
        return solved, np.ones(lanes, int)
    best, agree = _best(solved, lanes, count)
    return Solved(*(v[best] for v in solved)), agree


def _known(problem: Problem, solved: Solved, sigma) -> tuple[Information, Information, int | None]:
    """What each lane knows, what is known of the noise, and the unknowns that this is shared by.

    By itself a lane knows its own noise; the lanes of a joint problem have it in common.
    """
    every = np.arange(len(solved.theta))
    info = informations(problem, every, solved.theta, sigma)
    if not problem.joint:
        return info, info, None
    alive = solved.status <= FitStatus.STALLED
    pool = joint.pooled(problem, info, solved.theta, alive)
    return info, pool, joint.unknown_count(problem, alive)


def _noise_rounds(problem: Problem) -> int:
    """Re-weightings: needed where an estimated sigma changes the estimate, not only its error."""
    both = problem.lanes.joints is not None
    estimated = not (problem.noise_given[0] and (problem.noise_given[1] or not both))
    return 4 if estimated and (both or problem.loss != "linear") else 0


def first_sigma(problem: Problem) -> np.ndarray:
    """Standard deviations to begin with: 1 where given, else 2 % of the peak; (lanes, 2).

    Of the lane's peak, or that of the study if it is fitted jointly.
    """
    lanes = problem.lanes

    def peak(v):
        of_lane = np.maximum(np.abs(v).reshape(len(v), -1).max(axis=1), 1e-300)
        return (
            np.full(len(v), np.max(np.nan_to_num(of_lane, nan=1e-300)))
            if problem.joint
            else of_lane
        )

    force = np.ones(len(lanes.s_c)) if problem.noise_given[0] else 0.02 * peak(lanes.force)
    joints = np.ones(len(lanes.s_c))
    if lanes.joints is not None and not problem.noise_given[1]:
        joints = 0.02 * peak(lanes.joints)
    return np.stack([force, joints], axis=1)


def next_sigma(
    problem: Problem, info: Information, sigma: np.ndarray, unknowns: int | None = None
) -> np.ndarray:
    """Standard deviations from the residuals, where they are not given.

    Mean square, less the share of the unknowns (`unknowns`, or those of each lane); with a robust
    loss 1.4826 times the median.
    """
    total = info.counts.sum(axis=1, keepdims=True)
    own = problem.lanes.active.sum(axis=1)[:, None] if unknowns is None else unknowns
    share = np.maximum(1 - own / np.maximum(total, 1), 0.05)
    with np.errstate(invalid="ignore", divide="ignore"):
        estimate = np.sqrt(info.squares / (info.counts * share))
        if problem.loss != "linear":
            estimate = 1.4826 * info.spread
    keep = np.array(problem.noise_given)[None] | ~np.isfinite(estimate) | (info.counts == 0)
    floor = 1e-9 * first_sigma(problem)
    return np.where(keep, sigma, np.maximum(estimate, floor))


def draw_starts(problem: Problem, settings: Settings) -> np.ndarray:
    """Starts of every lane in scaled coordinates: the guess, then a Latin hypercube around it.

    Returns:
        (lanes * starts, P), lane by lane.
    """
    rng = np.random.default_rng(settings.seed)
    lanes, P = problem.lanes.lower.shape
    guess = _of_unknowns(problem, lambda p: p.to_scaled(p.value), 0.0)
    decade = lambda p: np.log(10) if p.scale == "log" else 10.0  # noqa: E731
    reach = settings.decades * _of_unknowns(problem, decade, 0.0)
    low = np.maximum(problem.lanes.lower, guess - reach)
    high = np.minimum(problem.lanes.upper, guess + reach)
    others = settings.starts - 1
    strata = (
        rng.permuted(np.tile(np.arange(others), (P, 1)), axis=1).T if others else np.zeros((0, P))
    )
    unit = (strata + rng.uniform(size=(others, P))) / max(others, 1)
    drawn = low[:, None] + unit[None] * (high - low)[:, None]
    return np.concatenate([guess[:, None], drawn], axis=1).reshape(-1, P)


def _best(solved: Solved, lanes: int, starts: int) -> tuple[np.ndarray, np.ndarray]:
    """Job with the lowest cost of each lane (converged ones first), and how many starts agree."""
    cost = solved.cost.reshape(lanes, starts)
    converged = (solved.status == FitStatus.CONVERGED).reshape(lanes, starts)
    low = np.nanmin(np.where(np.isfinite(cost), cost, np.inf), axis=1, keepdims=True)
    near = cost <= low * (1 + 1e-6) + 1e-300
    rank = np.where(near & converged, -1.0, np.where(np.isfinite(cost), cost, np.inf))
    best = np.argmin(rank, axis=1)
    return np.arange(lanes) * starts + best, np.sum(near & converged, axis=1)


def _conclude(problem: Problem, solved: Solved, known, sigma, agree) -> FitResult:
    """Standard errors, intervals and final statuses of all lanes; `known`: see `_known`."""
    lanes, theta = problem.lanes, solved.theta
    info, pool, unknowns = known
    alive = solved.status <= FitStatus.STALLED
    gradient = joint.summed_gradient(problem, info, alive) if problem.joint else info.gradient
    log, step = _scales(problem)
    both = lanes.joints is None or problem.noise_given[1]
    at_bound = (theta <= lanes.lower) & (gradient > 0)
    at_bound |= (theta >= lanes.upper) & (gradient < 0)
    present = lanes.active > 0
    at_bound &= present
    held = at_bound | ~present
    relative = np.where(log, 1.0, np.maximum(np.abs(theta), 1e-3))
    if problem.joint:
        pool = joint.marginal(problem, pool, held, alive)
        unknowns -= joint.held_count(problem, held, alive)
    noise_given = problem.noise_given[0] and both
    u = analyse(pool, relative, held, noise_given=noise_given, unknowns=unknowns)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        unscale = lambda v: np.where(present, np.where(log, np.exp(v), v * step), np.nan)  # noqa: E731
        value = unscale(theta)
        half = u.half_width[:, None] * u.se
        rms = np.sqrt(info.squares / info.counts)
        standard_error = u.se * np.where(log, value, step)
        lower, upper = unscale(theta - half), unscale(theta + half)
    unit = _precision_unit(problem)
    samples = np.sum(info.counts, axis=1)
    left = np.sum(pool.counts, axis=1) - (np.sum(~held, axis=1) if unknowns is None else unknowns)
    status = _final_status(solved.status, u, at_bound, left)
    return FitResult(
        problem=problem, theta=theta, value=value, standard_error=standard_error,
        lower=lower, upper=upper, relative_se=u.se / relative,
        at_bound=at_bound, status=status, iterations=solved.iterations, cost=solved.cost,
        converged_starts=agree, sigma=sigma * unit, rms=rms * unit, samples=samples,
        uncertainty=tuple(Uncertainty(*row) for row in zip(*u, strict=True)),
    )  # fmt: skip


def _scales(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Which unknowns have a logarithmic scale, and the step of the others; (lanes, P) each."""
    log = _of_unknowns(problem, lambda p: p.scale == "log", 0.0) > 0
    return log, _of_unknowns(problem, lambda p: p.step, 1.0)


def _of_unknowns(problem: Problem, number: Callable[[Parameter], float], padding: float):
    """A number of each unknown's parameter, `padding` where a lane has fewer; (lanes, P)."""
    known = {p.name: float(number(p)) for p in problem.free}
    rows = np.full(problem.lanes.lower.shape, padding)
    for row, unknowns in zip(rows, problem.unknowns, strict=True):
        row[: len(unknowns)] = [known[p.name] for p, _, _ in unknowns]
    return rows


def _final_status(status, u: Uncertainty, at_bound, dof) -> np.ndarray:
    """What the solver said, and for what it solved: too few data, undetermined, on a bound."""
    solved = status <= FitStatus.UNIDENTIFIABLE
    fine = np.where(np.any(at_bound, axis=1), FitStatus.AT_BOUND, FitStatus.CONVERGED)
    fine = np.where(np.isfinite(u.condition), fine, FitStatus.UNIDENTIFIABLE)
    return np.where(solved, np.where(dof < 0, FitStatus.TOO_FEW_DATA, fine), status).astype(int)


def _precision_unit(problem: Problem) -> np.ndarray:
    """Given sigma that one unit of whitened residual stands for (median); (lanes, 2)."""

    def typical(precision, given):
        if precision is None or not given:
            return np.ones(len(problem.lanes.s_c))
        flat = precision.reshape(len(precision), -1)
        return np.array([1 / np.median(row[row > 0]) if np.any(row > 0) else 1.0 for row in flat])

    lanes, (force, joints) = problem.lanes, problem.noise_given
    return np.stack([typical(lanes.precision, force), typical(lanes.joint_precision, joints)], 1)
