"""Where a fit starts, and what is done where starts fail: drawn anew, or more of them.

What is drawn for a lane beyond its first starts depends on the seed and the lane's name alone, not
on the lanes beside it.
"""

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.press_scale import around_touch
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.status import FitStatus

#: Times that an infeasible start is drawn again, each time from twice the box.
REDRAWS = 4
#: Share of the data's own weight below which a cost is rounding, and says nothing of a minimum.
EXACT = 1e-18


class Box(NamedTuple):
    """Where starts are drawn, in scaled coordinates; (lanes, P) each."""

    guess: Float[np.ndarray, "lanes P"]
    low: Float[np.ndarray, "lanes P"]
    high: Float[np.ndarray, "lanes P"]


def box(study: Study, decades: float) -> Box:
    """The guess of every lane and the box around it, inside the bounds.

    Args:
        decades: half the width of the box (scale `linear`: times 10 steps; onset and offset: times
            a tenth of the press, around the change point of the curve).
    """
    guess = study.of_unknowns(lambda p: p.to_scaled(p.value), 0.0)

    def decade(p):
        return np.log(10) if p.scale == "log" else 10.0

    reach = decades * study.of_unknowns(decade, 0.0)
    low = np.maximum(study.lanes.lower, guess - reach)
    high = np.minimum(study.lanes.upper, guess + reach)
    return Box(*around_touch(study, guess, low, high, decades))


def draw_starts(study: Study, settings) -> np.ndarray:
    """Starts of every lane: the guess, then a Latin hypercube around it, the same for all lanes.

    Returns:
        (lanes * starts, P), lane by lane, in scaled coordinates.
    """
    rng = np.random.default_rng(settings.seed)
    P, others = study.size, settings.starts - 1
    guess, low, high = box(study, settings.decades)
    strata = (
        rng.permuted(np.tile(np.arange(others), (P, 1)), axis=1).T if others else np.zeros((0, P))
    )
    unit = (strata + rng.uniform(size=(others, P))) / max(others, 1)
    drawn = low[:, None] + unit[None] * (high - low)[:, None]
    return np.concatenate([guess[:, None], drawn], axis=1).reshape(-1, P)


Solve = Callable[[np.ndarray, np.ndarray], Solved]


def add_starts(
    study: Study, settings, rows: Int[np.ndarray, " starts"], solved: Solved, weight, solve: Solve
) -> tuple[Int[np.ndarray, " more"], Solved]:
    """First starts with infeasible ones drawn anew, and more starts for lanes in doubt.

    Costs nothing where all starts are feasible and agree.

    Args:
        settings: of the fit; `more_starts` 0: all stays as it is.
        rows: lane of each start.
        solved: what they came to.
        weight: half the weighted sum of squares of the data; (lanes,).
        solve: fits (lanes, starts).

    Returns:
        Lane and outcome of every start, the first ones first.
    """
    if not settings.more_starts:
        return rows, solved
    numbers = np.arange(len(rows)) % settings.starts
    solved = _redrawn(study, settings, rows, numbers, solved, solve)
    doubt = np.flatnonzero(needs_more_starts(rows, solved, weight))
    if not len(doubt):
        return rows, solved
    more = np.repeat(doubt, settings.more_starts)
    numbers = settings.starts + np.tile(np.arange(settings.more_starts), len(doubt))
    added = solve(more, _drawn(study, settings, more, numbers, 0))
    added = _redrawn(study, settings, more, numbers, added, solve)
    both = (np.concatenate(pair) for pair in zip(solved, added, strict=True))
    return np.concatenate([rows, more]), Solved(*both)


def best(rows: np.ndarray, solved: Solved, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Start with the lowest cost of each lane (converged ones first), and how many agree.

    Args:
        rows: lane of each start; every lane has one.
        solved: what they came to.
        lanes: number of lanes.
    """
    cost = np.where(np.isfinite(solved.cost), solved.cost, np.inf)
    low = np.full(lanes, np.inf)
    np.minimum.at(low, rows, cost)
    agree = (cost <= low[rows] * (1 + 1e-6) + 1e-300) & (solved.status == FitStatus.CONVERGED)
    order = np.lexsort((np.arange(len(rows)), np.where(agree, -1.0, cost), rows))
    _, first = np.unique(rows[order], return_index=True)
    return order[first], np.bincount(rows, agree, lanes).astype(int)


def needs_more_starts(
    rows: np.ndarray, solved: Solved, weight: np.ndarray
) -> Bool[np.ndarray, " lanes"]:
    """Lanes without a converged start, or with several starts of which one alone came lowest."""
    lanes = len(weight)
    found, agree = best(rows, solved, lanes)
    exact = solved.cost[found] <= EXACT * weight
    alone = (agree == 1) & (np.bincount(rows, minlength=lanes) > 1) & ~exact
    return (agree == 0) | alone


def _redrawn(study, settings, rows, numbers, solved: Solved, solve: Solve) -> Solved:
    """`solved` with infeasible starts drawn anew, all together, a few times."""
    solved = Solved(*map(np.array, solved))
    for turn in range(1, REDRAWS + 1):
        failed = np.flatnonzero(solved.status == FitStatus.INFEASIBLE_START)
        if not len(failed):
            break
        starts = _drawn(study, settings, rows[failed], numbers[failed], turn)
        for old, new in zip(solved, solve(rows[failed], starts), strict=True):
            old[failed] = new
    return solved


def _drawn(study: Study, settings, rows, numbers, turn: int) -> Float[np.ndarray, "starts P"]:
    """A start of each lane of `rows`, from the lane's own numbers.

    Uniform in a box 2^turn times as wide.
    """
    _, low, high = box(study, settings.decades * 2**turn)
    unit = np.stack(
        [
            np.random.default_rng(
                [settings.seed, _number(study.lane_name(lane)), number, turn]
            ).uniform(size=study.size)
            for lane, number in zip(rows.tolist(), numbers.tolist(), strict=True)
        ]
    )
    return low[rows] + unit * (high - low)[rows]


def _number(name: tuple[str, str]) -> int:
    """A number that stands for a lane's name."""
    return int.from_bytes(hashlib.sha256("\0".join(name).encode()).digest()[:8], "little")


def scales(study: Study) -> tuple[np.ndarray, np.ndarray]:
    """Which unknowns have a logarithmic scale, and the step of the others; (lanes, P) each."""
    log = study.of_unknowns(lambda p: p.scale == "log", False)
    return log, study.of_unknowns(lambda p: p.step, 1.0)


def unscaled(study: Study, theta: np.ndarray, at: Any = ...) -> np.ndarray:
    """`Parameter.from_scaled` of coordinates of the unknowns `at`, an index of (lanes, P)."""
    log, step = (v[at] for v in scales(study))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(log, np.exp(theta), theta * step)
