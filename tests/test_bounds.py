"""Bounded problems: lanes end where the KKT conditions hold, and SciPy finds nothing lower."""

import functools

import bounded
import numpy as np
import pytest
import synthetic

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.descent import Descent, descend
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.profile import profiles
from jaxtrachea.optimisation.levenberg_marquardt import levenberg_marquardt
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.status import FitStatus, ProfileEnd


def promise_allowed(dtype):
    """Largest KKT residual of a lane that counts as converged.

    The solver stops where neither a step nor any unknown alone lowers the cost by more than 100
    times its tolerance, relative: 0.5 r^2 <= 100 tol / 2 in units of the residual's norm. The
    tolerance is 1e-10, or four roundings of the cost.
    """
    return np.sqrt(200 * max(1e-10, 4 * float(np.finfo(dtype).eps)))


def parted_from_bounds(study, theta):
    """Unknowns that are next to a bound, by less than a part in 1e9, and not on it."""
    lanes = study.lanes
    gap = np.minimum(theta - lanes.lower, lanes.upper - theta)
    return (gap != 0) & (gap < 1e-9 * (1 + np.abs(theta)))


@pytest.mark.slow
@pytest.mark.compiling
def test_random_bounds_against_scipy():
    """Most lanes end on a bound; `trf` from where they end finds nothing lower that matters.

    The difference is twice the log-likelihood ratio of 100 samples: 1e-4 standard errors.
    """
    study, start = bounded.random_study(11, 60)
    sigma, lanes = first_sigma(study), study.lanes
    solved = levenberg_marquardt(LaneCost(study.model, lanes, sigma), start)
    assert np.all(solved.status == FitStatus.CONVERGED), np.bincount(solved.status)
    assert np.max(bounded.kkt_residual(study, solved.theta, sigma)) <= promise_allowed(np.float64)
    assert not np.any(parted_from_bounds(study, solved.theta))
    assert np.mean(np.any((solved.theta == lanes.lower) | (solved.theta == lanes.upper), 1)) > 0.7
    cost = bounded.costs(study, solved.theta, sigma)
    assert np.all(cost / bounded.scipy_costs(study, solved.theta, sigma) - 1 <= 1e-10)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_start_next_to_a_bound():
    """The free optimum lies beyond: the others must not stay where it has them."""
    study, _ = bounded.random_study(11, 60)
    wide = study.lanes._replace(lower=np.full((60, 4), -12.0), upper=np.full((60, 4), 12.0))
    sigma = first_sigma(study)
    guess = np.tile(np.log(bounded.CLEAR), (60, 1))
    best = levenberg_marquardt(LaneCost(study.model, wide, sigma), guess)
    upper = wide.upper.copy()
    upper[:, 2] = best.theta[:, 2] - 0.3
    tight = bounded.with_lanes(study, wide._replace(upper=upper))
    start = best.theta.copy()
    start[:, 2] = upper[:, 2] - 5e-14
    solved = levenberg_marquardt(LaneCost(tight.model, tight.lanes, sigma), start)
    assert np.all(solved.status == FitStatus.CONVERGED)
    assert np.all(solved.theta[:, 2] == upper[:, 2])
    assert np.max(bounded.kkt_residual(tight, solved.theta, sigma)) <= promise_allowed(np.float64)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_first_order_method_respects_bounds():
    study, start = bounded.random_study(11, 8)
    sigma, rows = first_sigma(study), np.arange(8)
    descent = Descent("adam", Tolerances(iterations=300))
    solved = descend(study, rows, start, sigma, descent)
    assert np.all(solved.status == FitStatus.CONVERGED)
    # Their tolerance is on the cost over a block of steps, no better than its square root.
    assert np.max(bounded.kkt_residual(study, solved.theta, sigma)) <= 1e-3


def joint_study(seed, specimens=3):
    """Specimens that share EI_L and k_3, bounds that cut off about half of the optima."""
    rng = np.random.default_rng(seed)
    depths = synthetic.DEPTHS[::2]
    truth = synthetic.draw(seed, specimens, 1.5, bounded.CLEAR)
    truth[:, [0, 3]] = truth[0, [0, 3]]
    force, _ = synthetic.forces(truth, displacement=depths)
    level = float(0.01 * np.abs(force).max())
    force = force + level * rng.normal(size=force.shape)
    changes = {}
    for i, name in enumerate(synthetic.NAMES):
        side, factor = rng.choice([-1, 0, 1], p=[0.3, 0.4, 0.3]), np.exp(rng.uniform(0.05, 0.7))
        lower, upper = truth[:, i].min() / 50, truth[:, i].max() * 50
        lower = truth[:, i].mean() * factor if side > 0 else lower
        upper = truth[:, i].mean() / factor if side < 0 else upper
        changes[name] = {
            "value": float(np.sqrt(lower * upper)),
            "lower": float(lower),
            "upper": float(upper),
            "scope": "shared" if name in ("EI_L", "k_3") else "specimen",
            "scale": "log",
        }
    return functools.partial(
        build_study,
        synthetic.curves(force, displacement=depths),
        synthetic.GEOMETRY,
        synthetic.OPTIONS,
        synthetic.parameters(**changes),
        noise=Noise(force=level),
    )


@pytest.mark.slow
@pytest.mark.compiling
def test_joint_fits_with_bounds():
    """The dense study's KKT conditions hold at the joint estimate; SciPy finds nothing lower."""
    seeds = range(100, 108)
    for seed in seeds:
        study = joint_study(seed)
        joint, dense = study(joint=True), study()
        result = fit(joint, Settings(starts=1, more_starts=0, verify=False))
        assert np.all(result.status <= FitStatus.AT_BOUND)
        theta = bounded.dense_theta(joint, dense, result.theta)
        known = np.ones((1, 2))
        kkt = bounded.kkt_residual(dense, theta, known)
        assert kkt[0] <= promise_allowed(np.float64)
        below = bounded.scipy_costs(dense, theta, known)[0]
        assert result.cost.sum() <= below * (1 + 1e-8)


@pytest.fixture(scope="module")
def fitted():
    study, start = bounded.random_study(5, 40)
    result = fit(study, Settings(starts=1, more_starts=0, verify=False), starts=start)
    assert np.all(result.succeeded)
    return result


@pytest.mark.slow
@pytest.mark.compiling
def test_profiles_with_bounds(fitted):
    """Given the profiled unknown, all others satisfy the KKT conditions at every point."""
    cornered = fitted.at_bound.all(axis=1)
    assert cornered.any()
    assert np.all(fitted.status[cornered] == FitStatus.AT_BOUND)
    curves = profiles(fitted, Settings(starts=1, verify=False), points=2)
    good = np.isfinite(curves.statistic)
    assert np.mean(good) > 0.99
    assert np.mean(curves.end == ProfileEnd.FAILED) < 0.01
    k, at = np.nonzero(good)
    chosen = fitted.study.take(curves.lane[k])
    active = chosen.lanes.active.copy()
    active[np.arange(len(k)), curves.unknown[k]] = 0
    pinned = bounded.with_lanes(chosen, chosen.lanes._replace(active=active))
    sigma = fitted.whitened_sigma[curves.lane[k]]
    kkt = bounded.kkt_residual(pinned, curves.theta[k, at], sigma)
    assert np.max(kkt) <= promise_allowed(np.float64)
