"""The lowest minimum of every lane from all of its starts, with the noise that goes with it."""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.descent import Descent, descend
from jaxtrachea.fitting.few_samples import few_samples, same_ends, serves
from jaxtrachea.fitting.information import Information, informations, pooled, unknown_count
from jaxtrachea.fitting.lane import data_weight
from jaxtrachea.fitting.noise import first_sigma, next_sigma, noise_rounds
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.shared import solve_jointly
from jaxtrachea.fitting.starts import add_starts, best, draw_starts
from jaxtrachea.fitting.structure import Structure, reduced
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.batching import NEXT
from jaxtrachea.optimisation.levenberg_marquardt import Solved, levenberg_marquardt
from jaxtrachea.status import FitStatus

#: Costs of starts that a result keeps of a lane.
KEPT = 24


class Minima(NamedTuple):
    """The best of all starts of every lane, and where the others ended.

    Attributes:
        solved: best outcome of each lane.
        agree: starts that ended in it, or came together on a few samples and went on as one from
            there; (lanes,).
        tried: starts in all; (lanes,).
        sigma: standard deviations that it was found with; (lanes, 2).
        lane: of every start; (starts,).
        end: where it ended; (starts, P).
        cost: that it ended at, with the noise that fits begin with; (starts,).
    """

    solved: Solved
    agree: np.ndarray
    tried: np.ndarray
    sigma: np.ndarray
    lane: np.ndarray
    end: np.ndarray
    cost: np.ndarray

    def start_costs(self) -> Float[np.ndarray, "lanes KEPT"]:
        """The lowest costs that starts of each lane ended at, lowest first; NaN where no more."""
        out = np.full((len(self.agree), KEPT), np.nan)
        order = np.lexsort((self.cost, self.lane))
        lane = self.lane[order]
        rank = np.arange(len(lane)) - np.searchsorted(lane, lane)
        kept = rank < KEPT
        out[lane[kept], rank[kept]] = self.cost[order][kept]
        return np.where(np.isfinite(out), out, np.nan)

    def without_ends(self, lanes: np.ndarray) -> "Minima":
        """Without where starts of these lanes ended, which is worth nothing with another noise."""
        kept = ~np.isin(self.lane, lanes)
        return self._replace(lane=self.lane[kept], end=self.end[kept], cost=self.cost[kept])

    def replaced(self, lanes: np.ndarray, by: "Minima") -> "Minima":
        """With the rows `lanes` from `by`; where their own starts ended is not forgotten."""
        rows = [np.array(v) for v in (*self.solved, self.agree, self.tried, self.sigma)]
        for old, new in zip(rows, (*by.solved, by.agree, by.tried, by.sigma), strict=True):
            old[lanes] = new
        ends = (self.lane, self.end, self.cost), (lanes[by.lane], by.end, by.cost)
        joined = (np.concatenate(pair) for pair in zip(*ends, strict=True))
        return Minima(Solved(*rows[:4]), rows[4], rows[5], rows[6], *joined)


def lowest_minima(
    study: Study, settings: Settings, starts, progress, known: Structure, beside=None
) -> Minima:
    """The best of all starts of every lane, with the noise that goes with it."""
    # Given starts are refits from an estimate: there the directions left open may be followed.
    held = study if study.joint or starts is not None else reduced(study, known.pinned)
    sigma = first_sigma(study)
    solved, agree, tried, *ends = _from_starts(held, settings, starts, sigma, progress, beside)
    if held is not study:
        solved = _released(study, held, settings, solved, sigma)
    solved, sigma = refit_with_noise(held, settings, solved, sigma)
    return Minima(solved, agree, tried, sigma, *ends)


def _released(study: Study, held: Study, settings: Settings, solved: Solved, sigma) -> Solved:
    """Lanes whose best lies on a bound because of what is held: fitted on with all free, once."""
    lanes = held.lanes
    on = (solved.theta <= lanes.lower) | (solved.theta >= lanes.upper)
    pinned = (study.lanes.active > 0) & (lanes.active == 0)
    rows = np.flatnonzero((on & (lanes.active > 0)).any(axis=1) & pinned.any(axis=1))
    if not len(rows):
        return solved
    free = _solve_more(study, settings, sigma, None, rows, solved.theta[rows])
    again = _solve_more(held, settings, sigma, None, rows, free.theta)
    out = Solved(*map(np.array, solved))
    better = again.cost < out.cost[rows]
    for old, new in zip(out, again, strict=True):
        old[rows[better]] = new[better]
    return out


def refit_with_noise(study: Study, settings: Settings, solved, sigma, theta=None):
    """Fits and noise brought to agree; from `theta` where nothing is solved yet."""
    if solved is None:
        solved = refit_with_sigma(study, settings, theta, sigma)
    for _ in range(noise_rounds(study)):
        _, pool, unknowns = information_per_lane(study, solved, sigma)
        sigma = next_sigma(study, pool, sigma, unknowns)
        again = refit_with_sigma(study, settings, solved.theta, sigma)
        solved = again._replace(iterations=solved.iterations + again.iterations)
    return solved, sigma


def _from_starts(study: Study, settings: Settings, starts, sigma, progress, beside):
    """The best of all starts of every lane, how many agree, how many there were; all ends."""
    drawn = starts is None
    starts = draw_starts(study, settings) if drawn else starts
    if beside is not None:
        starts, settings = _with_one_more(starts, beside, settings)
    lanes = study.lanes.lower.shape[0]
    if study.joint:
        solved, agree = _solve_jointly(study, settings, starts, sigma, progress)
        tried = np.full(lanes, len(starts) // lanes)
        return solved, np.full(lanes, agree), tried, np.arange(lanes), solved.theta, solved.cost
    if drawn:
        starts = _beside_records(study, settings, starts, sigma)
    rows = np.repeat(np.arange(lanes), settings.starts)
    solve = _by_few_samples if drawn and serves(study, settings, len(rows)) else _solve
    solved = solve(study, settings, rows, starts, sigma, progress)
    if drawn:
        again = functools.partial(_solve_more, study, settings, sigma, progress)
        weight = data_weight(study.lanes, sigma)
        rows, solved = add_starts(study, settings, rows, solved, weight, again)
    lowest, agree = best(rows, solved, lanes)
    tried = np.bincount(rows, minlength=lanes)
    chosen = Solved(*(v[lowest] for v in solved))
    return chosen, agree, tried, rows, solved.theta, solved.cost


def _beside_records(study: Study, settings: Settings, starts, sigma):
    """Starts; of lanes with lines below the force after a fit with their presses held.

    Onset, offset and line of a press are known from its record. Beside a stiffness that is far off
    they would go astray together.
    """
    of_presses = study.of_unknowns(lambda p: float(p.name in OF_THE_PRESS), 0.0) > 0
    lines = study.of_unknowns(lambda p: float(p.name == "force_slope"), 0.0) > 0
    lanes = np.flatnonzero(lines.any(axis=1))
    if not len(lanes):
        return starts
    each = starts.reshape(len(lines), settings.starts, -1).copy()
    each = np.where(of_presses[:, None], each[:, :1], each)
    rows = np.repeat(lanes, settings.starts)
    first = each[lanes].reshape(len(rows), -1)
    found = _solve_more(reduced(study, of_presses), settings, sigma, None, rows, first)
    good = np.isfinite(found.cost)[:, None]
    each[lanes] = np.where(good, found.theta, first).reshape(len(lanes), settings.starts, -1)
    return each.reshape(starts.shape)


def _with_one_more(
    starts: Float[np.ndarray, "starts P"], beside: Float[np.ndarray, "lanes P"], settings: Settings
) -> tuple[Float[np.ndarray, "more P"], Settings]:
    """Starts of every lane after one more, `beside`; where it is NaN, the lane's first again.

    Returns:
        The starts, lane by lane, and settings that say how many there are of each.
    """
    each = starts.reshape(len(beside), settings.starts, -1)
    first = np.where(np.isfinite(beside), beside, each[:, 0])[:, None]
    more = np.concatenate([first, each], axis=1).reshape(-1, starts.shape[1])
    return more, dataclasses.replace(settings, starts=settings.starts + 1)


def refit_with_sigma(study: Study, settings: Settings, theta, sigma) -> Solved:
    """Solved anew from near the minimum, with other noise."""
    if study.joint:
        return _solve_jointly(study, settings, theta, sigma, None, near=True)[0]
    # In the program of the first solve: one of another size takes longer to compile than to run.
    together, lanes = len(theta) * settings.starts, np.arange(len(theta))
    return _solve(study, settings, lanes, theta, sigma, None, together=together)


def _by_few_samples(study: Study, settings: Settings, rows, starts, sigma, progress) -> Solved:
    """Every start of lane `rows`, first on a few samples of its curves.

    Those of a lane that come to the same point there go on from it as one, on all samples. A start
    that does not converge on the few begins anew, and so does one that ends on the few where all
    cannot be evaluated.
    """
    led = _solve(few_samples(study), settings, rows, starts, sigma, progress)
    first, of = same_ends(rows, led)
    at = np.where((led.status == FitStatus.CONVERGED)[:, None], led.theta, starts)[first]
    alive = _only_alive(progress)
    ends = _solve(study, settings, rows[first], at, sigma, alive, together=len(rows))
    ends = Solved(*(v[of] for v in ends))
    lost = np.flatnonzero(
        (ends.status == FitStatus.INFEASIBLE_START) & (led.status == FitStatus.CONVERGED)
    )
    if len(lost):
        anew = _solve(study, settings, rows[lost], starts[lost], sigma, alive, together=len(rows))
        for all_, new in zip(ends, anew, strict=True):
            all_[lost] = new
    return ends._replace(iterations=ends.iterations + led.iterations)


def _solve_more(study, settings, sigma, progress, rows, starts) -> Solved:
    """Further starts of a few lanes; their batch does not depend on how many there are."""
    first = study.batch_size(len(study.curves) * settings.starts, settings.batch)
    settings = dataclasses.replace(settings, batch=min(first, NEXT))
    together = max(len(rows), settings.batch)
    return _solve(study, settings, rows, starts, sigma, _only_alive(progress), together=together)


def _only_alive(progress):
    """Told that the work goes on, and of no start that is done."""
    return None if progress is None else lambda done, of: progress(0, of)


def _solve(
    study: Study, settings: Settings, rows, starts, sigma, progress, *, together: int | None = None
) -> Solved:
    """Every start of lane `rows`; sigma of each lane; `together`: starts that the batch is for."""
    together = len(rows) if together is None else together
    common = _common(study, settings, together, progress, len(rows))
    if settings.method == "levenberg-marquardt":
        return levenberg_marquardt(
            LaneCost(study.model, study.lanes, sigma), starts, rows,
            tolerances=settings.tolerances, unoptimised=study.unoptimised(together), **common,
        )  # fmt: skip
    descent = Descent(settings.method, settings.tolerances)
    return descend(study, rows, starts, sigma, descent, **common)


def _solve_jointly(
    study: Study, settings: Settings, starts, sigma, progress, *, near=False
) -> tuple[Solved, int]:
    """The best of the starts of the whole study, and how many agree; `near`: only one start."""
    if settings.method != "levenberg-marquardt":
        raise ValueError(f"a joint study needs levenberg-marquardt, not {settings.method}")
    lanes = study.lanes.lower.shape[0]
    # One size for all calls, so that it is compiled once.
    common = _common(study, settings, lanes * settings.starts, progress, len(starts))
    of_starts = np.swapaxes(starts.reshape(lanes, len(starts) // lanes, -1), 0, 1)
    return solve_jointly(
        study, of_starts, sigma, separately=not near, tolerances=settings.tolerances, **common
    )


def _common(
    study: Study, settings: Settings, together: int, progress, starts: int
) -> dict[str, Any]:
    """What all solvers are told; `together`: starts that the batch is for, of `starts`."""
    report = None if progress is None else lambda done: progress(done, starts)
    dtype = np.float32 if settings.float32 else np.float64
    batch = study.batch_size(together, settings.batch)
    return {"batch": batch, "progress": report, "dtype": dtype}


def information_per_lane(
    study: Study, solved: Solved, sigma
) -> tuple[Information, Information, int | None]:
    """What each lane knows, what is known of the noise, and the unknowns that this is shared by.

    By itself a lane knows its own noise; the lanes of a joint study have it in common.
    """
    every = np.arange(len(solved.theta))
    info = informations(study, every, solved.theta, sigma)
    if not study.joint:
        return info, info, None
    alive = solved.status <= FitStatus.STALLED
    pool = pooled(study, info, solved.theta, alive)
    return info, pool, unknown_count(study, alive)
