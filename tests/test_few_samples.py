"""Many starts on a few samples of long curves, against SciPy on all of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from scipy.optimize import least_squares

from jaxtrachea.fitting import few_samples, minima
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.few_samples import same_ends, serves
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.read import Curve
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.status import FitStatus

LANES, SIGMA = 20, 0.002
#: Curves of unequal length; the last has fewer samples than are kept.
LENGTHS = (40, 33, 24, 7)


@pytest.fixture(autouse=True)
def short_curves_are_long(monkeypatch):
    """Twelve of twenty-four samples instead of 24 of 96, of few starts."""
    for name, value in {"KEPT": 12, "LONG": 24, "MOST_WHOLE": 64}.items():
        monkeypatch.setattr(few_samples, name, value)


def curves(lanes=LANES, seed=5):
    """Presses of known truths with noise, the samples of each in depths of its own."""
    truth, rng, out = synthetic.draw(seed, lanes, 1.6), np.random.default_rng(seed), []
    for j, n in enumerate(LENGTHS):
        depth = np.linspace(0.1, 6.0, n)
        force, _ = synthetic.forces(truth, synthetic.S_C[j : j + 1], depth)
        noisy = force[:, 0] + rng.normal(0, SIGMA, (lanes, n))
        out += [
            Curve(f"s{i:02d}", f"t{j}", float(synthetic.S_C[j]), 0.0, depth, noisy[i])
            for i in range(lanes)
        ]
    return truth, out


def study_of(curves, noise=Noise(force=SIGMA), **more):
    table = synthetic.parameters()
    return build_study(curves, synthetic.GEOMETRY, synthetic.OPTIONS, table, noise=noise, **more)


@pytest.fixture(scope="module")
def study():
    return study_of(curves()[1])


def scipy_minimum(study, lane, start):
    """SciPy's minimum of one lane on all samples, and half the sum of squares there."""
    model, data = study.model, jax.tree.map(lambda v: jnp.asarray(v[lane]), study.lanes)
    value = jax.jit(lambda theta: residual_value(model, theta, data) * data.balance[:, None])
    found = least_squares(
        lambda theta: np.asarray(value(theta)).ravel(), start, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    return found.x, found.cost


@pytest.fixture
def seen(monkeypatch):
    """Starts and samples of a curve of every solve."""
    seen, solve = [], minima._solve

    def watched(study, settings, rows, *more, **named):
        seen.append((len(rows), study.lanes.force.shape[-1]))
        return solve(study, settings, rows, *more, **named)

    monkeypatch.setattr(minima, "_solve", watched)
    return seen


@pytest.mark.slow
def test_estimates_are_of_all_samples(study, seen):
    """Of eighty starts by twelve samples each; the four of a lane go on as one."""
    result = fit(study, Settings())
    assert seen[:2] == [(4 * LANES, 12), (LANES, max(LENGTHS))]
    assert (result.converged_starts == 4).all()
    assert (result.tried == 4).all()
    for lane in (0, 7, 19):
        theta, cost = scipy_minimum(study, lane, result.theta[lane])
        np.testing.assert_allclose(result.cost[lane], cost, rtol=1e-10)
        assert np.all(np.abs(result.theta[lane] - theta) < 1e-3 * result.uncertainty.se[lane])


@pytest.mark.slow
def test_given_starts_are_of_all_samples(study, seen):
    """A refit from an estimate takes the minimum near it."""
    many = study.take(np.tile(np.arange(LANES), 4))
    starts = np.tile(np.log(curves()[0]), (4, 1))
    fit(many, Settings(starts=1), starts=starts)
    assert {samples for _, samples in seen} == {max(LENGTHS)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "more"),
    [
        ({"verify": False}, {}),
        ({"float32": True}, {}),
        ({"method": "lbfgs"}, {}),
        ({"starts": 3}, {}),  # sixty in all
        ({}, {"weighting": Weighting(loss="huber")}),
        ({}, {"joint": True}),
    ],
)
def test_where_they_do_not_serve(study, changes, more, monkeypatch):
    every = curves()[1]
    if "joint" in more:
        table = synthetic.parameters(k_1={"scope": "shared"})
        study = build_study(every, synthetic.GEOMETRY, synthetic.OPTIONS, table, joint=True)
    elif more:
        study = study_of(every, **more)
    settings = Settings(**changes)
    assert serves(study_of(every), Settings(), 4 * LANES)
    assert not serves(study, settings, settings.starts * LANES)
    monkeypatch.setattr(few_samples, "LONG", 41)  # of 40 samples
    assert not serves(study_of(every), Settings(), 4 * LANES)


@pytest.mark.long
def test_nor_for_a_fitted_onset():
    every = curves()[1]
    table = synthetic.parameters(onset={"value": 0.0})
    study = build_study(every, synthetic.GEOMETRY, synthetic.OPTIONS, table)
    assert study.lanes.blend is not None
    assert not serves(study, Settings(), 4 * LANES)


def test_the_few_are_observed_samples_in_equal_steps():
    """Of a curve with gaps, from the first observed to the last; its weight stays."""
    study = study_of(curves(3)[1], noise=Noise())
    lanes = study.lanes
    precision = np.array(lanes.precision)
    precision[1, 0, [0, 5, 6, 39]] = 0
    precision[2, 1] = 0
    gaps = dataclasses.replace(study, lanes=lanes._replace(precision=precision))
    few = few_samples.few_samples(gaps).lanes
    assert few.force.shape == (3, len(LENGTHS), 12)
    for lane in range(3):
        for t in range(len(LENGTHS)):
            there = np.flatnonzero(precision[lane, t] > 0)
            kept = np.flatnonzero(few.precision[lane, t] > 0)
            count = min(12, len(there))
            np.testing.assert_array_equal(kept, np.arange(count))
            at = [
                int(np.flatnonzero(lanes.displacement[lane, t] == d)[0])
                for d in few.displacement[lane, t, kept]
            ]
            exact = there[np.linspace(0, len(there) - 1, count).astype(int)] if count else []
            assert np.all(np.abs(np.searchsorted(there, at) - np.searchsorted(there, exact)) <= 1)
            if count:
                assert at[0] == there[0]
                assert at[-1] == there[-1]
                assert len(set(at)) == count
                np.testing.assert_array_equal(few.force[lane, t, kept], lanes.force[lane, t, at])
            weight = few.balance[lane, t] ** 2 * count
            np.testing.assert_allclose(weight, lanes.balance[lane, t] ** 2 * len(there))


def test_nor_with_markers():
    """They may be seen in a few samples alone."""
    depth = np.linspace(0.1, 6.0, 40)
    force, joints = synthetic.forces(synthetic.draw(1, LANES, 1.5), synthetic.S_C, depth)
    rings = np.array([2, 5, 9])
    bare = synthetic.curves(force, displacement=depth)
    places = list(np.ndindex(LANES, 4))
    marked = [
        dataclasses.replace(c, joint_displacement=joints[at][:, rings], joint_rings=rings)
        for at, c in zip(places, bare, strict=True)
    ]
    assert serves(study_of(bare), Settings(), 4 * LANES)
    assert not serves(study_of(marked), Settings(), 4 * LANES)


def test_starts_that_ended_apart_stay_apart():
    """By lane and by place; what did not converge shares its end with none."""
    rows = np.array([0, 0, 0, 1, 1, 1])
    theta = np.array([[1.0, 2], [1 + 1e-5, 2], [1.1, 2], [1, 2], [1, 2], [1, 2]])
    status = np.zeros(6, int)
    status[5] = FitStatus.MAX_ITERATIONS
    first, of = same_ends(rows, Solved(theta, np.ones(6), status, np.ones(6, int)))
    assert len(first) == 4
    assert of[0] == of[1]
    assert of[3] == of[4]
    assert len({of[0], of[2], of[3], of[5]}) == 4
    np.testing.assert_array_equal(rows[first[of]], rows)


@pytest.mark.slow
def test_infeasible_starts_stay_what_they_are(study):
    """A lane whose curves nothing explains fails, and no other; it is not fitted to a part."""
    displacement = np.array(study.lanes.displacement)
    displacement[2] = np.nan
    broken = dataclasses.replace(study, lanes=study.lanes._replace(displacement=displacement))
    result = fit(broken, Settings(more_starts=0))
    assert result.status[2] == FitStatus.INFEASIBLE_START
    assert (result.status[np.arange(LANES) != 2] == FitStatus.CONVERGED).all()


@pytest.mark.slow
def test_an_end_that_all_samples_do_not_have_is_left(study, seen, monkeypatch):
    """Such a start begins anew, on all samples from where it was drawn."""
    solve = minima._solve

    def lost(study, settings, rows, starts, *more, **named):
        out = solve(study, settings, rows, starts, *more, **named)
        if len(rows) == LANES:  # the ends of all lanes
            out.status[rows == 5] = FitStatus.INFEASIBLE_START
        return out

    monkeypatch.setattr(minima, "_solve", lost)
    result = fit(study, Settings())
    assert (4, max(LENGTHS)) in seen
    assert result.status[5] == FitStatus.CONVERGED
    _, cost = scipy_minimum(study, 5, result.theta[5])
    np.testing.assert_allclose(result.cost[5], cost, rtol=1e-10)
