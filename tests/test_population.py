"""Population of specimens: closed forms, SciPy on the same likelihood, coverage by simulation."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2, multivariate_normal, t

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.population import POPULATION
from jaxtrachea.inference.population import population
from jaxtrachea.inference.random_effects import Common, random_effects
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long


def draw(rng, m, tau, middle):
    """Truths, estimates and their covariances, of unequal size and correlated."""
    q = len(tau)
    A = 0.12 * rng.normal(size=(m, q, q))
    C = A @ np.swapaxes(A, 1, 2) + 0.003 * np.eye(q)
    theta = middle + tau * rng.normal(size=(m, q))
    error = np.einsum("mij,mj->mi", np.linalg.cholesky(C), rng.normal(size=(m, q)))
    return theta, theta + error, C


def test_balanced_one_way_layout():
    """Equal variances c: tau^2 = s^2 - c, and everything else in closed form (Searle, ch. 3)."""
    m, c = 9, 0.04
    y = np.random.default_rng(0).normal(1.0, 0.5, (m, 1))
    e = random_effects(y, np.full((m, 1, 1), c))
    s2, mean = y.var(ddof=1), y.mean()
    np.testing.assert_allclose(e.sd[0] ** 2, s2 - c, rtol=1e-9)
    np.testing.assert_allclose([e.mean[0], e.mean_se[0]], [mean, np.sqrt(s2 / m)], rtol=1e-9)
    np.testing.assert_allclose(e.dof, m - 1, rtol=1e-9)
    se = s2 * np.sqrt(2 / (m - 1)) / (2 * e.sd[0])
    np.testing.assert_allclose(e.sd_se[0], se, rtol=1e-9)
    ends = np.sqrt(s2 * (m - 1) / chi2.ppf([0.975, 0.025], m - 1) - c)
    np.testing.assert_allclose([e.sd_low[0], e.sd_high[0]], ends, rtol=1e-9)
    pull = (s2 - c) / s2
    np.testing.assert_allclose(e.shrunk, mean + pull * (y - mean), rtol=1e-9)
    sd = np.sqrt(pull * c + (1 - pull) ** 2 * s2 / m)
    np.testing.assert_allclose(e.shrunk_sd, sd, rtol=1e-9)


def test_unequal_and_correlated_errors_against_scipy():
    """The restricted likelihood written as a density of contrasts, maximised by SciPy."""
    _, y, C = draw(np.random.default_rng(1), 7, np.array([0.3, 0.15]), np.array([1.0, -2.0]))
    e = random_effects(y, C)
    contrasts = np.kron(np.linalg.qr(np.ones((7, 1)), mode="complete")[0][:, 1:].T, np.eye(2))

    def against(log_tau):
        V = np.zeros((14, 14))
        for i in range(7):
            V[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = C[i] + np.diag(np.exp(2 * log_tau))
        return -multivariate_normal.logpdf(contrasts @ y.ravel(), cov=contrasts @ V @ contrasts.T)

    ends = {"xatol": 1e-10, "fatol": 1e-13}
    best = minimize(against, np.log([0.2, 0.2]), method="Nelder-Mead", options=ends)
    np.testing.assert_allclose(e.sd, np.exp(best.x), rtol=1e-6)
    W = np.linalg.inv(C + np.diag(e.sd**2))
    mean = np.linalg.solve(W.sum(0), np.einsum("mij,mj->i", W, y))
    np.testing.assert_allclose(e.mean, mean, rtol=1e-9)


def test_an_estimate_that_does_not_exist_says_nothing():
    rng = np.random.default_rng(2)
    _, y, C = draw(rng, 8, np.array([0.3, 0.3]), np.zeros(2))
    C = C * np.eye(2)  # uncorrelated: each coordinate then stands by itself
    known = np.ones((8, 2), bool)
    known[3, 0] = False
    e = random_effects(y, C, known)
    alone = random_effects(np.delete(y[:, :1], 3, axis=0), np.delete(C[:, :1, :1], 3, axis=0))
    np.testing.assert_allclose([e.sd[0], e.mean[0]], [alone.sd[0], alone.mean[0]], rtol=1e-5)
    np.testing.assert_allclose(e.shrunk[3, 0], e.mean[0], rtol=1e-5)
    with pytest.raises(ValueError, match="needs 3 specimens, found 2"):
        random_effects(y, C, np.arange(8)[:, None] < [2, 8])


def test_no_spread_beyond_the_errors():
    """Estimates closer together than their errors: spread 0, everyone is the mean."""
    y = np.array([[1.0], [1.1], [0.9], [1.05]])
    e = random_effects(y, np.full((4, 1, 1), 0.25))
    assert e.sd[0] == 0
    assert np.isnan(e.sd_se[0])
    assert e.sd_low[0] == 0 < e.sd_high[0]
    np.testing.assert_allclose(e.shrunk, y.mean())
    exact = random_effects(y, np.zeros((4, 1, 1)))
    np.testing.assert_allclose(exact.sd[0], y.std(ddof=1))
    np.testing.assert_allclose(exact.shrunk, y)


def test_errors_that_all_have_in_common():
    """An error of 0.3 that every estimate follows: intervals hold all the same."""
    rng, rows, m, tau = np.random.default_rng(5), [], 12, 0.25
    for _ in range(200):
        follow = -(1 + 0.2 * rng.normal(size=(m, 1, 1)))
        se, theta = rng.uniform(0.02, 0.06, m), rng.normal(0, tau, m)
        y = theta + follow[:, 0, 0] * rng.normal(0, 0.3) + se * rng.normal(size=m)
        e = random_effects(
            y[:, None], (se**2)[:, None, None], None, Common(follow, np.array([[0.09]]))
        )
        mean = abs(e.mean[0]) < t.ppf(0.975, e.dof[0]) * e.mean_se[0]
        inside = np.mean(np.abs(e.shrunk[:, 0] - theta) < 1.96 * e.shrunk_sd[:, 0])
        rows.append([mean, e.sd_low[0] <= tau <= e.sd_high[0], inside])
    # 95 % of 200: standard error 1.5 %. As independent errors they leave 50 % for the mean.
    assert np.all(np.abs(np.mean(rows, axis=0) - 0.95) < 0.05)


def test_specimens_that_say_nothing_are_no_degrees_of_freedom():
    """With t of m - 1 intervals of the mean held 81 to 85 %, of the spread 78 to 85 %."""
    rng, rows = np.random.default_rng(7), []
    se = np.array([0.1] * 4 + [10.0] * 10)
    for _ in range(300):
        y = rng.normal(size=len(se)) + se * rng.normal(size=len(se))
        e = random_effects(y[:, None], (se**2)[:, None, None])
        mean = abs(e.mean[0]) < t.ppf(0.975, e.dof[0]) * e.mean_se[0]
        rows.append([mean, e.sd_low[0] <= 1 <= e.sd_high[0]])
    assert np.all(np.abs(np.mean(rows, axis=0) - 0.95) < 0.05)  # standard error 1.3 %


def coverage(count, m):
    """How often 95 % intervals hold: mean, spread, shrunk; bias of tau^2; squared errors ratio."""
    tau, middle = np.array([0.3, 0.15]), np.array([1.0, -2.0])
    rng, rows = np.random.default_rng(m), []
    for _ in range(count):
        theta, y, C = draw(rng, m, tau, middle)
        e = random_effects(y, C)
        mean = np.abs(e.mean - middle) < t.ppf(0.975, e.dof) * e.mean_se
        spread = (e.sd_low <= tau) & (tau <= e.sd_high)
        inside = np.mean(np.abs(e.shrunk - theta) < 1.96 * e.shrunk_sd, axis=0)
        gain = np.mean((e.shrunk - theta) ** 2, 0) / np.mean((y - theta) ** 2, 0)
        rows.append([mean, spread, inside, e.sd**2 / tau**2, gain])
    return np.mean(rows, axis=0)


@pytest.mark.slow
def test_coverage_of_mean_and_spread():
    mean, spread, inside, square, gain = coverage(200, 12)
    # 95 % of 200: standard error 1.5 %.
    assert np.all((mean > 0.89) & (mean < 0.995))
    assert np.all((spread > 0.89) & (spread < 0.995))
    # tau^2 is unbiased unless cut at zero; its standard error here is 4 %.
    assert np.all(np.abs(square - 1) < 0.12)
    assert np.all(inside > 0.82)
    assert np.all(gain < 1)


def without_growth(result):
    """The fit as it were if no residuals of its lanes were alike by chance."""
    ones, same = np.ones(result.lanes), dataclasses.replace(result)
    vars(same)["effective"] = result.effective._replace(factor=ones, growth=ones)
    return same


def test_what_the_data_hardly_determine_takes_part():
    """k_3 about 0.5 +- 0.2 with errors of 0.27: those beyond 50 % left out, the mean was 0.6."""
    rng, sigma = np.random.default_rng(5), 0.1
    D = np.linspace(0, 1.1, 16)
    truth = rng.normal(0.5, 0.2, 100)
    curves = [
        Curve(f"s{i:03d}", "1", 75.0, 0.0, D, D + k * D**3 + rng.normal(0, sigma, 16))
        for i, k in enumerate(truth)
    ]
    table = {"k_1": {"fixed": True, "value": 1.0}, "k_3": {"lower": -20.0, "upper": 100.0}}
    study = build_study(
        curves, table_1(), Options(coupling="total"), table, noise=Noise(force=sigma)
    )
    result = without_growth(fit(study, Settings(starts=1)))
    se = sigma / np.sqrt(np.sum(D**6))
    np.testing.assert_allclose(result.standard_error[:, 0], se, rtol=1e-6)
    found = population(result)
    (mean,), (error,), (sd,) = found.effects.mean, found.effects.mean_se, found.effects.sd
    step = found.parameters[0].step
    assert (found.known.sum(), found.left_out[0], found.at_bound[0]) == (100, 0, 0)
    # Errors are alike: the plain mean, and the variance of the estimates less that of the errors.
    np.testing.assert_allclose(mean * step, result.value[:, 0].mean(), rtol=1e-9)
    spread = np.sqrt(result.value[:, 0].var(ddof=1) - se**2)
    np.testing.assert_allclose(sd * step, spread, rtol=1e-4)
    assert abs(mean * step - truth.mean()) < 2.5 * error * step
    assert abs(spread - truth.std(ddof=1)) < 0.06


def test_logarithms_of_what_is_hardly_determined_are_told():
    """k_1 of 0.03 to 0.08 with errors of 0.026: 0.052 and less of them have errors above half."""
    rng, D = np.random.default_rng(2), np.linspace(0, 1.1, 16)
    sigma = 0.026 * np.sqrt(np.sum(D**2))
    curves = [
        Curve(f"s{i:02d}", "1", 75.0, 0.0, D, k * D + rng.normal(0, sigma, 16))
        for i, k in enumerate(np.linspace(0.03, 0.2, 40))
    ]
    table = {"k_1": {"scale": "log"}, "k_3": {"fixed": True, "value": 0.0}}
    options, noise = Options(coupling="total"), Noise(force=sigma)
    result = fit(build_study(curves, table_1(), options, table, noise=noise))
    found = population(without_growth(result))
    below = np.sum(found.known & (0.026 > 0.5 * found.result.value[:, :1]))
    assert (found.undetermined[0], below > 4) == (below, True)
    told = [text for text in POPULATION.warning(found) if "errors above half the value" in text]
    assert len(told) == 1


def test_estimates_on_a_bound_are_told():
    """Their likelihood has no width there: of ten values of 0.1 +- 0.2 those below 0 are at 0."""
    D = np.linspace(0, 1.1, 16)
    curves = [
        Curve(f"s{i}", "1", 75.0, 0.0, D, D + k * D**3)
        for i, k in enumerate(np.linspace(-0.35, 0.55, 10))
    ]
    table = {"k_1": {"fixed": True, "value": 1.0}, "k_3": {}}
    study = build_study(
        curves, table_1(), Options(coupling="total"), table, noise=Noise(force=0.001)
    )
    found = population(fit(study, Settings(starts=1)))
    assert (found.left_out[0], found.at_bound[0], found.known.sum()) == (4, 4, 6)
    (told,) = POPULATION.warning(found)
    assert "estimates on a bound took no part (k_3 4 of 10)" in told
