"""Whole fits: what was put in comes out, intervals cover, a batch is its lanes one by one."""

import dataclasses
import re

import numpy as np
import pytest
import synthetic
from scipy.optimize import brentq, least_squares

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.descent import Descent, descend
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.weakest_direction import describe_weakest
from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.mechanics.press import press
from jaxtrachea.optimisation.levenberg_marquardt import levenberg_marquardt
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.material import Material

#: No one reads verdicts here.
ONE = Settings(starts=1, verify=False)
#: Truths that four curves with 1 % noise identify: a soft contact that hardens early.
CLEAR = np.array([300.0, 1.0, 0.5, 0.2])


@pytest.fixture(scope="module")
def noisy():
    truth = synthetic.draw(7, 20, 1.3, CLEAR)
    force, _ = synthetic.forces(truth)
    rng = np.random.default_rng(8)
    sigma = 0.01 * np.abs(force).max((1, 2), keepdims=True)
    return truth, force + sigma * rng.normal(size=force.shape), sigma


@pytest.mark.compiling
def test_noise_free_data_give_back_the_parameters():
    """Draws from two decades in each parameter, noise-free.

    A lane counts as recoverable if it reports success, a condition number up to 1e6 (its error is
    then rounding, 1e-15 of the data, times the condition and a margin) and residuals that are
    rounding: some lanes have a second minimum, and its residual tells.
    """
    draws = 20
    truth = synthetic.draw(1, draws, 10.0)
    force, _ = synthetic.forces(truth)
    result = fit(synthetic.study(force), dataclasses.replace(ONE, starts=4))
    error = np.abs(result.value / truth - 1).max(1)
    condition = result.uncertainty.condition
    peak = np.abs(force).max((1, 2))
    succeeded = result.status <= FitStatus.UNIDENTIFIABLE
    fitted = result.rms[:, 0] <= 1e-12 * peak
    should = succeeded & (condition <= 1e6) & fitted
    assert error[should].max() <= 1e-6
    assert should.sum() >= 0.97 * draws
    second = succeeded & (condition <= 1e6) & ~fitted
    assert second.sum() <= 0.005 * draws
    # Of the others nearly all have an estimate.
    assert (~succeeded).sum() <= 0.01 * draws


@pytest.mark.slow
@pytest.mark.compiling
def test_a_batch_is_its_lanes_one_by_one(noisy):
    """The same lane alone, in a batch, elsewhere in the batch and among others: to 1e-8."""
    loss = "linear"
    _, force, _ = noisy
    study = synthetic.study(force, weighting=Weighting(loss=loss))
    starts = np.tile([p.to_scaled(p.value) for p, _, _ in study.unknowns[0]], (20, 1))
    sigma = first_sigma(study)
    objective = LaneCost(study.model, study.lanes, sigma)

    def fitted(rows):
        return levenberg_marquardt(
            objective, starts[rows], rows, tolerances=Tolerances(iterations=60)
        )

    batch = fitted(np.arange(20))
    order = np.random.default_rng(0).permutation(20)
    np.testing.assert_array_equal(fitted(order).theta, batch.theta[order])
    one = fitted(np.array([13]))
    np.testing.assert_allclose(one.theta[0], batch.theta[13], rtol=0, atol=1e-8)
    assert one.status[0] == batch.status[13]


def _put(v, i, x):
    v[i] = x
    return v


_SPOIL = {
    1: lambda d, f: (d, _put(f, 7, np.nan)),
    2: lambda d, f: (d[:1], f[:1]),
    3: lambda d, f: (d[::-1], f[::-1]),
    4: lambda d, f: (d, 0 * f),
    5: lambda d, f: (d, 1e9 * f),
}


@pytest.mark.long
def test_bad_specimens_cost_only_themselves(tmp_path):
    """27 specimens, 7 of them bad in 7 ways: the other 20 come out as without them."""
    force, _ = synthetic.forces(synthetic.draw(5, 27, 1.3, CLEAR))
    lines = ["specimen,trial,s [mm],displacement [mm],force [N]"]
    good = [lines[0]]
    for i in range(27):
        for j in range(4):
            d, f = synthetic.DEPTHS.copy(), force[i, j].copy()
            if i in _SPOIL:
                d, f = _SPOIL[i](d, f)
            if i in (6, 7):
                continue
            rows = [
                f"s{i:03d},t{j},{float(synthetic.S_C[j])!r},{a!r},{b!r}"
                for a, b in zip(d.tolist(), f.tolist(), strict=True)
            ]
            lines += rows
            good += rows if i not in _SPOIL else []
    (tmp_path / "all.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "good.csv").write_text("\n".join(good) + "\n")
    (tmp_path / "s006.csv").write_text("displacement,force\n0.1,0.2\n0.3,0.4\n")
    (tmp_path / "s007.csv").write_text("")
    read = read_measurements([tmp_path / n for n in ("all.csv", "s006.csv", "s007.csv")])
    assert {b.specimen for b in read.bad} == {f"s{i:03d}" for i in range(1, 8)}
    assert {b.kind for b in read.bad} >= {"non_finite", "too_few_points", "non_monotone", "empty"}

    def study(curves):
        return build_study(curves, synthetic.GEOMETRY, synthetic.OPTIONS, synthetic.parameters())

    with_bad = fit(study(read.curves), Settings(starts=1))
    without = fit(study(read_measurements([tmp_path / "good.csv"]).curves), Settings(starts=1))
    assert with_bad.lanes == without.lanes == 20
    for name in ("theta", "standard_error", "cost", "status", "lower", "upper", "iterations"):
        np.testing.assert_array_equal(getattr(with_bad, name), getattr(without, name))


@pytest.mark.slow
@pytest.mark.compiling
def test_an_infeasible_start_is_a_status_and_disturbs_nobody(noisy):
    """Softening so strong that the start lies past the fold for one specimen's deep curves."""
    truth, force, _ = noisy
    changes = {"k_3": {"value": -0.05, "lower": -1.0, "upper": 1.0, "scale": "linear"}}
    table = synthetic.parameters(**changes)
    shallow = 0.1 * synthetic.DEPTHS
    near, _ = synthetic.forces(synthetic.draw(2, 3, 1.1), displacement=shallow)
    deep = synthetic.curves(force[:1])
    rest = [
        dataclasses.replace(c, specimen="x" + c.specimen)
        for c in synthetic.curves(near, displacement=shallow)
    ]

    def make(data):
        return build_study(data, synthetic.GEOMETRY, synthetic.OPTIONS, table)

    together = fit(make([*rest[:4], *deep, *rest[4:]]), dataclasses.replace(ONE, more_starts=0))
    alone = fit(make(rest), ONE)
    assert together.status[1] == FitStatus.INFEASIBLE_START
    assert np.all(alone.status <= FitStatus.UNIDENTIFIABLE)
    np.testing.assert_allclose(together.theta[[0, 2, 3]], alone.theta, rtol=0, atol=1e-8)
    # Drawn anew it starts where the model exists, and ends at the truth within its errors; the
    # others keep every bit, and it has the same bits alone.
    again = fit(make([*rest[:4], *deep, *rest[4:]]), ONE)
    assert again.status[1] == FitStatus.CONVERGED
    assert np.all(np.abs(again.value[1] - truth[0]) < 4 * again.standard_error[1])
    assert again.tried[1] == 1
    np.testing.assert_array_equal(again.tried[[0, 2, 3]], together.tried[[0, 2, 3]])
    np.testing.assert_array_equal(again.theta[[0, 2, 3]], together.theta[[0, 2, 3]])
    rescued = fit(again.study.take(np.array([2, 1])), ONE)
    np.testing.assert_allclose(rescued.theta[1], again.theta[1], rtol=0, atol=1e-8)


def test_same_optimum_and_errors_as_scipy(noisy):
    """20 lanes against MINPACK's lmder with the same residual."""
    _, force, _ = noisy
    study = synthetic.study(force)
    result = fit(study, ONE)

    def scipy(i):
        def residual(theta):
            values = np.exp(theta)[None]
            return (synthetic.forces(values)[0][0] - force[i]).ravel() / result.sigma[i, 0]

        def jacobian(theta):
            h = 1e-3

            def five(e):
                near = residual(theta + h * e) - residual(theta - h * e)
                return (8 * near - residual(theta + 2 * h * e) + residual(theta - 2 * h * e)) / (
                    12 * h
                )

            return np.stack([five(e) for e in np.eye(4)], axis=1)

        return least_squares(
            residual, result.theta[i] + 0.05, jacobian, method="lm", xtol=1e-14, ftol=1e-14,
            gtol=1e-14,
        )  # fmt: skip

    for i in range(20):
        found = scipy(i)
        # A relative change of the cost of 1e-10 is sqrt(2e-10 * 98) = 1.4e-4 standard errors.
        error = result.standard_error[i] / result.value[i]
        assert np.all(np.abs(result.theta[i] - found.x) <= 2e-4 * error)
        covariance = np.linalg.inv(found.jac.T @ found.jac) * 2 * found.cost / 196
        np.testing.assert_allclose(error, np.sqrt(np.diag(covariance)), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.compiling
def test_one_position_leaves_skeleton_undetermined():
    """As on an elastic foundation (c ~ EI^-1/4 k_M^-3/4) only EI k_M^3 is seen from one place."""
    force, _ = synthetic.forces(np.array([[100.0, 1.0, 2.0, 0.2]]), s_c=np.array([75.0]))
    data = synthetic.curves(force, s_c=np.array([75.0]))
    study = build_study(data, synthetic.GEOMETRY, synthetic.OPTIONS, synthetic.parameters())
    result = fit(study, dataclasses.replace(ONE, starts=2))
    assert result.status[0] == FitStatus.UNIDENTIFIABLE
    flat = result.uncertainty.weakest_direction[0]
    ratio = flat[0] / flat[1]
    # Beam on discrete rings, not on a continuum: the exponents are near 1 and 3.
    assert -4.5 < ratio < -2.0
    assert np.all(np.isinf(result.standard_error[0, :2]))
    assert np.all(np.isfinite(result.standard_error[0, 2:]))
    names = [p.name for p, _, _ in study.unknowns[0]]
    words = describe_weakest(names, flat, np.inf, result.uncertainty.structural_null_space[0])
    said = "of EI_L and k_M only one combination is known, near this estimate "
    shape = re.fullmatch(re.escape(said) + r"EI_L k_M\^([\d.]+)", words)
    assert shape is not None
    assert float(shape[1]) == pytest.approx(-ratio, rel=1e-2)

    # What the curve tells is the compliance; the product is its tangent at this estimate, by
    # central differences (h^2 = 1e-6 of the derivatives; three digits of the exponent are told).
    def log_compliance(log_EI, log_k):
        material = Material(np.exp(log_EI), np.exp(log_k), 1.0, 0.1)
        pressed = press(synthetic.GEOMETRY, material, 75.0, 1.0, synthetic.OPTIONS)
        return float(np.log(pressed.compliance))

    def exponent(x, y, h=1e-3):
        by_EI = log_compliance(x + h, y) - log_compliance(x - h, y)
        return (log_compliance(x, y + h) - log_compliance(x, y - h)) / by_EI

    x, y = np.log(result.value[0, :2])
    assert log_compliance(x, y) == pytest.approx(log_compliance(np.log(100.0), 0.0), abs=1e-3)
    assert float(shape[1]) == pytest.approx(exponent(x, y), rel=5e-3)
    # A tenth of k_M on the same valley: another product, so that none is known everywhere.
    level, far = log_compliance(x, y), y - np.log(10.0)
    other = brentq(lambda v: log_compliance(v, far) - level, x, x + 20)
    assert abs(exponent(other, far) / float(shape[1]) - 1) > 0.2


def test_a_bound_is_hit_and_said(noisy):
    """k_1 cannot reach its optimum: estimate on the bound, flagged, without a standard error."""
    truth, force, _ = noisy
    upper = 0.8 * truth[:, 2].min()
    study = synthetic.study(force, changes={"k_1": {"value": 0.2, "lower": 0.1, "upper": upper}})
    result = fit(study, ONE)
    assert np.all(result.status == FitStatus.AT_BOUND)
    np.testing.assert_allclose(result.value[:, 2], upper, rtol=1e-12)
    assert result.at_bound[:, 2].all()
    assert np.isnan(result.standard_error[:, 2]).all()
    assert np.isfinite(result.standard_error[:, 3]).all()


def test_more_starts_never_cost_more(noisy):
    _, force, _ = noisy
    one = fit(synthetic.study(force), ONE)
    four = fit(synthetic.study(force), dataclasses.replace(ONE, starts=4))
    assert np.all(four.cost <= one.cost * (1 + 1e-6))
    assert np.all((four.converged_starts >= 1) & (four.converged_starts <= 4))
    np.testing.assert_allclose(four.value, one.value, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.compiling
def test_markers_with_both_noise_levels_estimated():
    """Forces with 2 % and ring deflections with 0.02 mm noise: both levels are found."""
    force, joints = synthetic.forces(synthetic.draw(13, 10, 1.2, CLEAR))
    rng = np.random.default_rng(2)
    level = 0.02 * np.abs(force).max()
    force = force + level * rng.normal(size=force.shape)
    rings = np.array([3, 8, 10])
    seen = joints[..., rings] + 0.02 * rng.normal(size=(*force.shape, 3))
    data = [
        dataclasses.replace(c, joint_rings=rings, joint_displacement=seen[i // 4, i % 4])
        for i, c in enumerate(synthetic.curves(force))
    ]
    study = build_study(
        data, synthetic.GEOMETRY, synthetic.OPTIONS, synthetic.parameters(joints=True)
    )
    result = fit(study, ONE)
    # 200 and 600 samples: sd of an estimated level 5 % and 3 %; four of them.
    np.testing.assert_allclose(result.sigma[:, 0], level, rtol=0.2)
    np.testing.assert_allclose(result.sigma[:, 1], 0.02, rtol=0.12)
    force_only = fit(synthetic.study(force), ONE)
    assert np.all(result.standard_error[:, 1] < force_only.standard_error[:, 1])


@pytest.mark.slow
@pytest.mark.compiling
def test_robust_loss_as_scipy(noisy):
    """Outliers in one lane; the same loss, scale and sigma in scipy give the same estimate."""
    _, force, sigma = noisy
    force, level = force[:1].copy(), float(sigma[0, 0, 0])
    force[0, :, ::9] += 20 * level
    study = synthetic.study(force, weighting=Weighting(loss="cauchy"), noise=Noise(force=level))
    result = fit(study, ONE)
    assert result.status[0] == FitStatus.CONVERGED

    def residual(theta):
        return (synthetic.forces(np.exp(theta)[None])[0][0] - force[0]).ravel() / level

    other = least_squares(
        residual, result.theta[0] + 0.02, "3-point", loss="cauchy", f_scale=1.345, xtol=1e-12,
        ftol=1e-14, gtol=1e-10, x_scale="jac", max_nfev=500,
    )  # fmt: skip
    assert result.cost[0] <= other.cost * (1 + 1e-8)
    np.testing.assert_allclose(result.theta[0], other.x, rtol=0, atol=1e-3)
    plain = fit(synthetic.study(force, noise=Noise(force=level)), ONE)
    truth = noisy[0][0]

    def stray(r):
        return np.abs(np.log(r.value[0] / truth)).max()

    assert stray(result) < stray(plain)


@pytest.mark.slow
@pytest.mark.compiling
def test_descent_reaches_the_same_minimum(noisy):
    method, blocks = "lbfgs", 60
    _, force, _ = noisy
    study = synthetic.study(force)
    sigma = first_sigma(study)[:2]
    truth = np.log(noisy[0][:2])
    two = study.take(np.arange(2))
    best = levenberg_marquardt(LaneCost(study.model, two.lanes, sigma), truth)
    other = descend(
        study, np.arange(2), truth, sigma, Descent(method, Tolerances(iterations=blocks))
    )
    assert np.all(other.cost <= best.cost * (1 + 1e-3))
    assert np.all(other.cost >= best.cost * (1 - 1e-9))
