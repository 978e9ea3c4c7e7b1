"""One fit from problem to result: starts, noise levels, best start, what may be believed."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxtrachea._arguments import check_record
from jaxtrachea.fit import descent
from jaxtrachea.fit import shared as joint
from jaxtrachea.fit.covariance import Information, Uncertainty, analyse, informations
from jaxtrachea.fit.criteria import Criteria, criteria
from jaxtrachea.fit.levenberg_marquardt import Solved, Tolerances, chunk_size, levenberg_marquardt
from jaxtrachea.fit.press_scale import relative_change
from jaxtrachea.fit.problem import Problem
from jaxtrachea.fit.starts import best, completed, draw_starts, of_unknowns
from jaxtrachea.fit.structure import Structure, null_spaces, reduced, structure_of, suspicious
from jaxtrachea.status import FitStatus

#: Lanes computed together where only a few are left.
FEW = 16
#: Condition number of the Jacobian up to which it proves that the structure leaves nothing open.
PROVEN = 1e5
#: Times that a better minimum found by the scrutiny takes the place of the estimate.
REPLACED = 3


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        method: `levenberg-marquardt`, or optax's `lbfgs` / `adam` on the same cost.
        starts: starts per lane; the first is the initial guess, the others are drawn around it.
        decades: starts are drawn up to this many decades from the guess (log scale; with linear
            scale up to this many times 10 steps), inside the bounds.
        seed: of the drawn starts.
        more_starts: added to lanes in doubt: no start converged, or one of several alone came
            lowest. With them infeasible starts are drawn anew. 0: neither.
        chunk: lanes computed together.
        tolerances: when a lane is done.
        float32: compute in single precision (results are float64 all the same).
        scrutiny: look for other minima and profile where an estimate gives cause; False: verdicts
            rest on structure and local standard errors alone (for refits of which no one reads
            the verdicts).
    """

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    starts: int = 4
    decades: float = 1.0
    seed: int = 0
    more_starts: int = 8
    chunk: int = 128
    tolerances: Tolerances = Tolerances()
    float32: bool = False
    scrutiny: bool = True

    def __post_init__(self):
        """Refuse words and numbers that mean nothing.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self, starts=1.0, decades=0.0, seed=0.0, more_starts=0.0, chunk=1.0)
        check_record(self.tolerances, cost=0.0, step=0.0, gradient=0.0, iterations=1.0)


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
        relative_se: standard error over the value (scale `log`: of the logarithm; onset and offset:
            over range and largest force of the press); (lanes, P).
        at_bound: (lanes, P).
        status: `FitStatus`; (lanes,).
        iterations: of the best start; (lanes,).
        cost: half the weighted sum of squares (or of rho); (lanes,).
        converged_starts: starts that ended in the best minimum; (lanes,).
        tried: starts in all; (lanes,).
        sigma: standard deviation of force (N) and markers (mm), given or estimated; (lanes, 2).
        rms: root mean square residual of force (N) and markers (mm); (lanes, 2).
        samples: observed entries; (lanes,).
        criteria: AIC, AICc, BIC of all lanes.
        uncertainty: `Uncertainty` of each lane.
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
    tried: np.ndarray
    sigma: np.ndarray
    rms: np.ndarray
    samples: np.ndarray
    criteria: Criteria
    uncertainty: tuple[Uncertainty, ...]
    undetermined: np.ndarray
    unexamined: np.ndarray
    evidence_low: np.ndarray
    evidence_high: np.ndarray
    evidence_end: np.ndarray
    minima: np.ndarray

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return len(self.status)

    @property
    def succeeded(self) -> np.ndarray:
        """Lanes that have an estimate; (lanes,)."""
        return self.status <= FitStatus.UNIDENTIFIABLE

    @property
    def whitened_sigma(self) -> np.ndarray:
        """`sigma` in units of the lanes' precision, as `evaluate` wants it; (lanes, 2)."""
        return self.sigma / precision_unit(self.problem)

    @property
    def relative(self) -> np.ndarray:
        """Change of each scaled coordinate that makes a relative change of 1; (lanes, P)."""
        return relative_change(self.problem, self.theta)


class Minima(NamedTuple):
    """The best of all starts of every lane, and where the others ended.

    Attributes:
        solved: best outcome of each lane.
        agree: starts that ended in it; (lanes,).
        tried: starts in all; (lanes,).
        sigma: standard deviations that it was found with; (lanes, 2).
        job: lane of every start; (jobs,).
        end: where it ended; (jobs, P).
        cost: that it ended at, with the noise that fits begin with; (jobs,).
    """

    solved: Solved
    agree: np.ndarray
    tried: np.ndarray
    sigma: np.ndarray
    job: np.ndarray
    end: np.ndarray
    cost: np.ndarray

    def replaced(self, lanes: np.ndarray, by: "Minima") -> "Minima":
        """With the rows `lanes` from `by`; where their own starts ended is not forgotten."""
        rows = [np.array(v) for v in (*self.solved, self.agree, self.tried, self.sigma)]
        for old, new in zip(rows, (*by.solved, by.agree, by.tried, by.sigma), strict=True):
            old[lanes] = new
        ends = (self.job, self.end, self.cost), (lanes[by.job], by.end, by.cost)
        joined = (np.concatenate(pair) for pair in zip(*ends, strict=True))
        return Minima(Solved(*rows[:4]), rows[4], rows[5], rows[6], *joined)


def fit(
    problem: Problem,
    settings: Settings = Settings(),  # noqa: B008 (frozen)
    progress: Callable[[int, int], None] | None = None,
    starts: np.ndarray | None = None,
) -> FitResult:
    """Fit every lane from every start, keep the best, and find out what may be believed.

    Failed lanes are rows with a status. Where the structure leaves a combination of unknowns open
    (`structure`), one of them is held, so that there is no valley to follow; where an estimate
    gives cause for doubt, other minima are looked for and unknowns are profiled (`scrutiny`). A
    lane that gives no cause costs nothing more.

    Args:
        problem: from `problem.build`.
        settings: how to solve.
        progress: called with (jobs finished since the last call, jobs in all).
        starts: where to start, scaled coordinates, (lanes * settings.starts, P); None: drawn.

    Returns:
        The `FitResult`. It never raises for a lane's sake. Without unknowns (every parameter is
        fixed) nothing is solved: the model is evaluated.
    """
    if problem.size == 0:
        from jaxtrachea.fit.evaluate import evaluated

        return evaluated(problem)
    known = structure_of(problem, suspicious(problem))
    minima = _minima(problem, settings, starts, progress, known)
    result = _conclude(problem, minima, known)
    late = _unproven(result, known)
    if late.any():
        more = structure_of(problem, late)
        known = more if problem.joint else Structure(*map(np.maximum, known, more))
        rows = np.flatnonzero(late & (known.nullity > 0))
        if len(rows) and not problem.joint and starts is None:
            part = problem.take(rows)
            again = _minima(part, settings, None, progress, known.take(rows))
            minima = minima.replaced(rows, again)
        if len(rows):
            result = _conclude(problem, minima, known)
    if not settings.scrutiny or problem.joint:
        from jaxtrachea.fit.scrutiny import left_in_doubt

        return dataclasses.replace(result, unexamined=left_in_doubt(result, minima))
    return _scrutinised(result, minima, known, settings, progress)


def _unproven(result: FitResult, known: Structure) -> np.ndarray:
    """Lanes not looked at whose Jacobian at the estimate does not prove that nothing is open."""
    condition = np.array([u.condition for u in result.uncertainty])
    examined = suspicious(result.problem)
    if result.problem.joint and examined.any():
        examined[:] = True
    return ~examined & ~(condition < PROVEN) & (known.nullity == 0)


def _scrutinised(result, minima: Minima, known: Structure, settings, progress) -> FitResult:
    """With the evidence of `scrutiny`; a better minimum found takes the estimate's place."""
    from jaxtrachea.fit.scrutiny import doubtful, scrutinise

    for turns_left in range(REPLACED, -1, -1):
        doubts = doubtful(result, minima)
        if not doubts.any():
            break
        evidence, better = scrutinise(
            result, minima, doubts, settings, known, progress, last=not turns_left
        )
        rows = np.flatnonzero(np.isfinite(better).all(axis=1))
        if not turns_left or not len(rows):
            return dataclasses.replace(result, **evidence._asdict())
        # As many as the fit computes together: the same program.
        chunk = chunk_size(max(result.lanes * settings.starts, 16), settings.chunk)
        full = rows[np.arange(max(len(rows), chunk)) % len(rows)]
        part = reduced(result.problem.take(full), known.pinned[full])
        solved, sigma = _with_noise(part, settings, None, minima.sigma[full], better[full])
        solved = Solved(*(v[: len(rows)] for v in solved))
        sigma = sigma[: len(rows)]
        one, none = np.ones(len(rows), int), np.zeros(0, int)
        moved = Minima(
            solved, one, minima.tried[rows], sigma, none, np.zeros((0, part.size)), np.zeros(0)
        )
        minima = minima.replaced(rows, moved)
        result = _conclude(result.problem, minima, known)
    return result


def _minima(problem: Problem, settings: Settings, starts, progress, known: Structure) -> Minima:
    """The best of all starts of every lane, with the noise that goes with it."""
    # Given starts are refits from an estimate: there the directions left open may be followed.
    held = problem if problem.joint or starts is not None else reduced(problem, known.pinned)
    sigma = first_sigma(problem)
    solved, agree, tried, *ends = _from_starts(held, settings, starts, sigma, progress)
    if held is not problem:
        solved = _released(problem, held, settings, solved, sigma)
    solved, sigma = _with_noise(held, settings, solved, sigma)
    return Minima(solved, agree, tried, sigma, *ends)


def _released(problem: Problem, held: Problem, settings: Settings, solved: Solved, sigma) -> Solved:
    """Lanes whose best lies on a bound because of what is held: fitted on with all free, once."""
    lanes = held.lanes
    on = (solved.theta <= lanes.lower) | (solved.theta >= lanes.upper)
    pinned = (problem.lanes.active > 0) & (lanes.active == 0)
    rows = np.flatnonzero((on & (lanes.active > 0)).any(axis=1) & pinned.any(axis=1))
    if not len(rows):
        return solved
    free = _solve_more(problem, settings, sigma, None, rows, solved.theta[rows])
    again = _solve_more(held, settings, sigma, None, rows, free.theta)
    out = Solved(*map(np.array, solved))
    better = again.cost < out.cost[rows]
    for old, new in zip(out, again, strict=True):
        old[rows[better]] = new[better]
    return out


def _with_noise(problem: Problem, settings: Settings, solved, sigma, theta=None):
    """Fits and noise brought to agree; from `theta` where nothing is solved yet."""
    if solved is None:
        solved = _from_there(problem, settings, theta, sigma)
    for _ in range(_noise_rounds(problem)):
        _, pool, unknowns = _known(problem, solved, sigma)
        sigma = next_sigma(problem, pool, sigma, unknowns)
        again = _from_there(problem, settings, solved.theta, sigma)
        solved = again._replace(iterations=solved.iterations + again.iterations)
    return solved, sigma


def _from_starts(problem: Problem, settings: Settings, starts, sigma, progress):
    """The best of all starts of every lane, how many agree, how many there were; all ends."""
    drawn = starts is None
    starts = draw_starts(problem, settings) if drawn else starts
    lanes = problem.lanes.lower.shape[0]
    if problem.joint:
        solved, agree = _solve_jointly(problem, settings, starts, sigma, progress)
        tried = np.full(lanes, len(starts) // lanes)
        return solved, np.full(lanes, agree), tried, np.arange(lanes), solved.theta, solved.cost
    jobs = np.repeat(np.arange(lanes), settings.starts)
    solved = _solve(problem, settings, jobs, starts, sigma[jobs], progress)
    if drawn:
        again = functools.partial(_solve_more, problem, settings, sigma, progress)
        jobs, solved = completed(
            problem, settings, jobs, solved, data_weight(problem, sigma), again
        )
    found, agree = best(jobs, solved, lanes)
    tried = np.bincount(jobs, minlength=lanes)
    chosen = Solved(*(v[found] for v in solved))
    return chosen, agree, tried, jobs, solved.theta, solved.cost


def _from_there(problem: Problem, settings: Settings, theta, sigma) -> Solved:
    """Solved anew from near the minimum, with other noise."""
    if problem.joint:
        return _solve_jointly(problem, settings, theta, sigma, None, near=True)[0]
    return _solve(problem, settings, np.arange(len(theta)), theta, sigma, None)


def _solve_more(problem, settings, sigma, progress, jobs, starts) -> Solved:
    """Further starts of a few lanes; their chunk does not depend on how many there are."""
    settings = dataclasses.replace(settings, chunk=min(settings.chunk, FEW))
    rows = np.arange(max(len(jobs), 2)) % len(jobs)  # one alone would be another program
    alive = None if progress is None else lambda done, of: progress(0, of)
    solved = _solve(problem, settings, jobs[rows], starts[rows], sigma[jobs[rows]], alive)
    return Solved(*(v[: len(jobs)] for v in solved))


def data_weight(problem: Problem, sigma: np.ndarray) -> np.ndarray:
    """Half the weighted sum of squares of the measured forces; (lanes,)."""
    lanes = problem.lanes
    z = lanes.force * lanes.precision * lanes.balance[:, :, None] / sigma[:, :1, None]
    return 0.5 * np.sum(z * z, axis=(1, 2))


def _solve(problem: Problem, settings: Settings, jobs, starts, sigma, progress) -> Solved:
    common = _common(settings, len(jobs), progress)
    if settings.method == "levenberg-marquardt":
        return levenberg_marquardt(problem, jobs, starts, sigma, **common)
    return descent.descend(problem, jobs, starts, sigma, method=settings.method, **common)


def _solve_jointly(
    problem: Problem, settings: Settings, starts, sigma, progress, *, near=False
) -> tuple[Solved, int]:
    """The best of the starts of the whole study, and how many agree; `near`: only one start."""
    if settings.method != "levenberg-marquardt":
        raise ValueError(f"a joint problem needs levenberg-marquardt, not {settings.method}")
    lanes = problem.lanes.lower.shape[0]
    common = _common(settings, len(starts), progress)
    # One size for all calls, so that it is compiled once.
    common["chunk"] = chunk_size(lanes * settings.starts, settings.chunk)
    of_starts = np.swapaxes(starts.reshape(lanes, len(starts) // lanes, -1), 0, 1)
    return joint.solve_jointly(problem, of_starts, sigma, alone=not near, **common)


def _common(settings: Settings, jobs: int, progress) -> dict[str, Any]:
    """What all solvers are told."""
    report = None if progress is None else lambda done: progress(done, jobs)
    common = {"tolerances": settings.tolerances, "chunk": settings.chunk, "progress": report}
    return common | {"dtype": np.float32 if settings.float32 else np.float64}


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


def _conclude(problem: Problem, minima: Minima, structure: Structure) -> FitResult:
    """Standard errors, intervals and final statuses of all lanes."""
    solved, agree, tried, sigma = minima[:4]
    info, pool, unknowns = _known(problem, solved, sigma)
    before, sigma = sigma, next_sigma(problem, pool, sigma, unknowns)
    if problem.loss == "linear" and problem.lanes.joints is None:
        ratio = before[:, 0] / sigma[:, 0]
        info, pool = info.rescaled(ratio), pool.rescaled(ratio)
    else:
        info, pool, unknowns = _known(problem, solved, sigma)
    lanes, theta = problem.lanes, solved.theta
    alive = solved.status <= FitStatus.STALLED
    gradient = joint.summed_gradient(problem, info, alive) if problem.joint else info.gradient
    log, step = scales(problem)
    both = lanes.joints is None or problem.noise_given[1]
    at_bound = (theta <= lanes.lower) & (gradient > 0)
    at_bound |= (theta >= lanes.upper) & (gradient < 0)
    present = lanes.active > 0
    at_bound &= present
    held = at_bound | ~present
    relative = relative_change(problem, theta)
    if problem.joint:
        pool = joint.marginal(problem, pool, held, alive)
        unknowns = (unknowns or 0) - joint.held_count(problem, held, alive)
    noise_given = problem.noise_given[0] and both
    blind = _open_directions(problem, theta, structure)
    u = analyse(pool, relative, held, noise_given=noise_given, unknowns=unknowns, structural=blind)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        unscale = lambda v: np.where(present, np.where(log, np.exp(v), v * step), np.nan)  # noqa: E731
        value = unscale(theta)
        half = u.half_width[:, None] * u.se
        rms = np.sqrt(info.squares / info.counts)
        standard_error = u.se * np.where(log, value, step)
        lower, upper = unscale(theta - half), unscale(theta + half)
    unit = precision_unit(problem)
    samples = np.sum(info.counts, axis=1)
    left = np.sum(pool.counts, axis=1) - (np.sum(~held, axis=1) if unknowns is None else unknowns)
    status = _final_status(solved.status, u, at_bound, left)
    return FitResult(
        problem=problem, theta=theta, value=value, standard_error=standard_error,
        lower=lower, upper=upper, relative_se=u.se / relative,
        at_bound=at_bound, status=status, iterations=solved.iterations, cost=solved.cost,
        converged_starts=agree, tried=tried, sigma=sigma * unit, rms=rms * unit, samples=samples,
        criteria=criteria(problem, info, alive),
        uncertainty=tuple(Uncertainty(*row) for row in zip(*u, strict=True)),
        undetermined=structure.undetermined,
        unexamined=np.zeros(theta.shape, bool), evidence_low=np.full(theta.shape, np.nan),
        evidence_high=np.full(theta.shape, np.nan),
        evidence_end=np.full((*theta.shape, 2), -1), minima=np.ones(len(theta), int),
    )  # fmt: skip


def _open_directions(problem: Problem, theta, structure: Structure) -> np.ndarray:
    """Directions that the structure leaves open, at the estimates; rows, the others 0."""
    out = np.zeros((*theta.shape, theta.shape[1]))
    lanes = np.arange(len(theta)) if problem.joint else np.flatnonzero(structure.nullity)
    if not structure.nullity.any():
        return out
    theta = np.where(np.isfinite(theta), theta, 0)[lanes]
    rows = null_spaces(problem, lanes, theta, structure.nullity[lanes])
    for lane, directions in zip(lanes, rows, strict=True):
        out[lane, : len(directions)] = directions
    return out


def scales(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Which unknowns have a logarithmic scale, and the step of the others; (lanes, P) each."""
    log = of_unknowns(problem, lambda p: p.scale == "log", 0.0) > 0
    return log, of_unknowns(problem, lambda p: p.step, 1.0)


def _final_status(status, u: Uncertainty, at_bound, dof) -> np.ndarray:
    """What the solver said, and for what it solved: too few data, undetermined, on a bound."""
    solved = status <= FitStatus.UNIDENTIFIABLE
    fine = np.where(np.any(at_bound, axis=1), FitStatus.AT_BOUND, FitStatus.CONVERGED)
    fine = np.where(np.isfinite(u.condition), fine, FitStatus.UNIDENTIFIABLE)
    return np.where(solved, np.where(dof < 0, FitStatus.TOO_FEW_DATA, fine), status).astype(int)


def precision_unit(problem: Problem) -> np.ndarray:
    """Given sigma that one unit of whitened residual stands for (median); (lanes, 2)."""

    def typical(precision, given):
        if precision is None or not given:
            return np.ones(len(problem.lanes.s_c))
        flat = precision.reshape(len(precision), -1)
        return np.array([1 / np.median(row[row > 0]) if np.any(row > 0) else 1.0 for row in flat])

    lanes, (force, joints) = problem.lanes, problem.noise_given
    return np.stack([typical(lanes.precision, force), typical(lanes.joint_precision, joints)], 1)
