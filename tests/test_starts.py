"""More starts where they matter, against functions whose minima and forbidden regions are known."""

import dataclasses

import numpy as np
import pytest
import synthetic

from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import REDRAWS, add_starts, best, draw_starts
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.status import FitStatus

#: Lanes of the tests, and the cost of the deep and the shallow minimum.
LANES, DEEP, SHALLOW = 6, 1.0, 2.0


@pytest.fixture(scope="module")
def study():
    force, _ = synthetic.forces(synthetic.draw(1, LANES, 2.0))
    return synthetic.study(force)


@dataclasses.dataclass
class Wells:
    """A solver that walks downhill: one deep well per lane, a shallow one, and a forbidden side.

    Starts whose first coordinate lies within `width` of the lane's deep well end in it, those below
    `wall` are infeasible, all others end in the shallow well.
    """

    deep: np.ndarray
    width: np.ndarray
    wall: float = -np.inf
    calls: list = dataclasses.field(default_factory=list)

    def __call__(self, rows, starts):
        """Lane and start of each job to what it comes to."""
        self.calls.append((np.array(rows), np.array(starts)))
        x = starts[:, 0]
        inside = np.abs(x - self.deep[rows]) < self.width[rows]
        status = np.where(x < self.wall, FitStatus.INFEASIBLE_START, FitStatus.CONVERGED)
        cost = np.where(x < self.wall, np.inf, np.where(inside, DEEP, SHALLOW))
        return Solved(np.array(starts), cost, status.astype(int), np.ones(len(rows), int))


def run(study, wells, settings):
    lanes = len(study.curves)
    rows = np.repeat(np.arange(lanes), settings.starts)
    first = wells(rows, draw_starts(study, settings))
    rows, solved = add_starts(study, settings, rows, first, np.ones(lanes), wells)
    return (*best(rows, solved, lanes), rows, solved)


GUESS = np.log(synthetic.CHANGES["EI_L"]["value"])


def test_starts_are_a_latin_hypercube(study):
    """Each unknown has one start in each tenth of its range; ranks of two do not go together."""
    P, count = study.size, 11
    drawn = draw_starts(study, Settings(starts=count)).reshape(LANES, count, P)[:, 1:]
    every = draw_starts(study, Settings(starts=2001)).reshape(LANES, 2001, P)[:, 1:]
    low, high = every.min(axis=1, keepdims=True), every.max(axis=1, keepdims=True)
    tenth = np.clip(np.floor(10 * (drawn - low) / (high - low)), 0, 9).astype(int)
    np.testing.assert_array_equal(np.sort(tenth, axis=1), np.arange(10)[None, :, None] + 0 * tenth)
    pairs = [np.corrcoef(rows.T)[np.triu_indices(P, 1)] for rows in tenth]
    assert abs(np.mean(pairs)) < 0.25  # of 36 pairs: an error of 1 / sqrt(9 * 36) = 0.06


def one_well(wall=-np.inf):
    """The same minimum from everywhere that is allowed."""
    return Wells(np.full(LANES, GUESS), np.full(LANES, np.inf), wall)


def test_where_all_starts_agree_nothing_is_solved_again(study):
    wells = one_well()
    _, agree, rows, _ = run(study, wells, Settings(starts=4))
    assert len(wells.calls) == 1
    assert len(rows) == 4 * LANES
    np.testing.assert_array_equal(agree, 4)


def test_a_well_that_one_start_found_is_confirmed(study):
    """Only lanes with the narrow well are in doubt; more starts find it again."""
    settings = Settings(starts=4, more_starts=40)
    drawn = draw_starts(study, settings).reshape(LANES, 4, -1)[:, :, 0]
    wells = Wells(drawn[:, 2], np.where(np.arange(LANES) < 2, 0.2, 50.0))
    found, agree, rows, solved = run(study, wells, settings)
    assert set(wells.calls[1][0]) == {0, 1}
    np.testing.assert_array_equal(solved.cost[found], DEEP)
    assert np.all(agree[:2] >= 2)
    np.testing.assert_array_equal(np.bincount(rows), [44, 44, 4, 4, 4, 4])


def test_infeasible_starts_are_drawn_anew_together_and_not_for_ever(study):
    wells = one_well(GUESS + 0.5)
    settings = Settings(starts=1)
    found, _, rows, solved = run(study, wells, settings)
    np.testing.assert_array_equal(solved.status[found], FitStatus.CONVERGED)
    assert len(rows) == LANES
    assert 2 <= len(wells.calls) <= 1 + REDRAWS
    sizes = [len(rows) for rows, _ in wells.calls[1:]]
    assert sizes == sorted(sizes, reverse=True)
    nowhere = one_well(np.inf)
    found, agree, _, solved = run(study, nowhere, settings)
    assert len(nowhere.calls) == 2 * (1 + REDRAWS)
    np.testing.assert_array_equal(solved.status[found], FitStatus.INFEASIBLE_START)
    np.testing.assert_array_equal(agree, 0)


def test_draws_stay_in_the_bounds_and_belong_to_the_lane(study):
    """Alone, in another order or among others a lane draws the same; another seed, others."""
    settings = Settings(starts=2, more_starts=5)

    def draws(study, settings, lane):
        wells = one_well(np.inf)
        run(study, wells, settings)
        return np.concatenate([starts[rows == lane] for rows, starts in wells.calls[1:]])

    mine = draws(study, settings, 3)
    assert len(np.unique(mine, axis=0)) == len(mine) == 2 * REDRAWS + 5 * (1 + REDRAWS)
    np.testing.assert_array_equal(draws(study.take(np.array([5, 3, 0])), settings, 1), mine)
    other = draws(study, dataclasses.replace(settings, seed=1), 3)
    assert not np.any(np.isin(other, mine))
    assert np.all((mine >= study.lanes.lower[3]) & (mine <= study.lanes.upper[3]))


def test_none_asked_for(study):
    wells = one_well(np.inf)
    run(study, wells, Settings(starts=2, more_starts=0))
    assert len(wells.calls) == 1


def test_best_is_the_lowest_and_prefers_what_converged():
    status = np.array([FitStatus.STALLED, 0, 0, FitStatus.INFEASIBLE_START, 0])
    cost = np.array([1.0, 1.0 + 1e-7, 3.0, np.inf, 2.0])
    solved = Solved(np.zeros((5, 1)), cost, status, np.zeros(5, int))
    found, agree = best(np.array([0, 0, 0, 1, 1]), solved, 2)
    np.testing.assert_array_equal(found, [1, 4])
    np.testing.assert_array_equal(agree, [1, 1])
