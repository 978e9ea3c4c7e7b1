"""Residuals against the noise given: against chi^2 of a straight line fitted by numpy."""

import numpy as np
import pytest

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.misfit import MISFIT
from jaxtrachea.inference.residuals import glitches_of
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

SIGMA, D = 0.003, np.linspace(0.1, 2, 60)
QUICK = Settings(starts=1, verify=False)


def lines(count, seed=0):
    """Forces of 2 N/mm with noise; (count, samples)."""
    return 2 * D + SIGMA * np.random.default_rng(seed).normal(size=(count, len(D)))


def compared(force, sigma, joint=False, **weighting):
    curves = [Curve(f"s{i}", "t", 75.0, 0.0, D, row) for i, row in enumerate(force)]
    changes = {"k_3": {"fixed": True, "value": 0.0}}
    changes |= {"k_1": {"scope": "shared"}} if joint else {}
    study = build_study(
        curves, table_1(), Options(coupling="total", onset_width=0.0), changes,
        noise=Noise(force=sigma), weighting=Weighting(**weighting),
    )  # fmt: skip
    return fit(study, QUICK)


@pytest.mark.parametrize("sigma", [SIGMA, SIGMA / 10])
def test_ratio_is_the_root_of_chi_squared_over_its_freedom(sigma):
    force = lines(3)
    result = compared(force, sigma)
    found = result.misfit
    left = [row - D * (D @ row) / (D @ D) for row in force]
    known = np.sqrt(np.sum(np.square(left), axis=1) / (len(D) - 1)) / sigma
    np.testing.assert_allclose(found.ratio[:, 0], known, rtol=1e-6)
    wrong = sigma == SIGMA / 10
    assert found.flagged.tolist() == [[wrong, False]] * 3
    sentences = MISFIT.section(result)
    assert len(sentences) == wrong
    if wrong:
        assert f"{np.median(known):.2g} times the noise given" in sentences[0]
        assert "in 3 of 3 fits" in sentences[0]
        assert ("errors and intervals have grown" in sentences[0]) == (sigma < SIGMA)


def test_few_samples_may_do_so_by_chance():
    """One of a thousand fits is told of, not one of ten; see scipy's chi^2 of 3 - 1 samples."""
    rng = np.random.default_rng(1)
    few = np.array([0.5, 1.0, 2.0])
    force = 2 * few + SIGMA * rng.normal(size=(300, 3))
    curves = [Curve(f"s{i}", "t", 75.0, 0.0, few, row) for i, row in enumerate(force)]
    study = build_study(
        curves, table_1(), Options(coupling="total", onset_width=0.0),
        {"k_3": {"fixed": True, "value": 0.0}}, noise=Noise(force=SIGMA),
    )  # fmt: skip
    result = fit(study, QUICK)
    found = result.misfit
    assert np.mean((found.ratio[:, 0] > 1.5) | (found.ratio[:, 0] < 1 / 1.5)) > 0.3
    assert np.sum(found.flagged) <= 2


def test_eleven_samples_are_told_by_chi_squared():
    """Of 10 degrees of freedom chi^2 is above 25.6 once in 233 times, above 36.1 once in 12,000."""
    D = np.linspace(0.1, 2, 11)
    left = np.random.default_rng(3).normal(size=11)
    left -= D * (D @ left) / (D @ D)
    left *= SIGMA * np.sqrt(10 / (left @ left))
    curves = [Curve(f"s{i}", "t", 75.0, 0.0, D, 2 * D + r * left) for i, r in enumerate([1.6, 1.9])]
    study = build_study(
        curves, table_1(), Options(coupling="total", onset_width=0.0),
        {"k_3": {"fixed": True, "value": 0.0}}, noise=Noise(force=SIGMA),
    )  # fmt: skip
    found = fit(study, QUICK).misfit
    np.testing.assert_allclose(found.ratio[:, 0], [1.6, 1.9], rtol=1e-6)
    assert found.flagged[:, 0].tolist() == [False, True]


@pytest.mark.slow
def test_outliers_do_not_count_with_a_robust_loss():
    force = lines(2)
    force[:, ::10] += 100 * SIGMA
    assert compared(force, SIGMA).misfit.flagged[:, 0].all()
    found = compared(force, SIGMA, loss="huber").misfit
    assert np.all(np.abs(np.log(found.ratio[:, 0])) < np.log(1.4))
    assert not found.flagged.any()
    assert compared(force, SIGMA / 10, loss="huber").misfit.flagged[:, 0].all()


def test_lanes_of_a_joint_fit_count_together():
    force = lines(3)
    found = compared(force, SIGMA / 3, joint=True).misfit
    k = np.sum(force @ D) / (3 * D @ D)
    known = np.sqrt(np.sum((force - k * D) ** 2) / (3 * len(D) - 1)) / (SIGMA / 3)
    np.testing.assert_allclose(found.ratio[:, 0], known, rtol=1e-6)
    assert found.flagged[:, 0].all()


def test_estimated_noise_is_not_compared():
    result = compared(lines(2), None)
    found = result.misfit
    assert np.isnan(found.ratio).all()
    assert MISFIT.section(result) == []
    assert list(MISFIT.sentences(result)) == []


def test_glitches_are_those_put_in():
    """Single samples; no stretch that is missed, no wide noise, and nothing under a robust loss."""
    force, put = lines(3), [(0, 0, 0), (0, 0, 40), (2, 0, 21)]
    for k, (lane, _, sample) in enumerate(put):
        force[lane, sample] += (30 + 10 * k) * SIGMA
    result = compared(force, None)
    found = glitches_of(result)
    assert sorted(glitch[:3] for glitch in found) == put
    assert found[0][:3] == put[2]  # the largest
    sentence = MISFIT.section(result)[0]
    assert sentence.startswith("3 force samples stand alone in 2 of 3 fits")
    assert f"+{50 * SIGMA:.2g} N off, of s2 t at {D[21]:.3g} mm" in sentence
    assert MISFIT.section(compared(force, None, loss="huber")) == []
    stretch = lines(3)
    stretch[:, 20:25] += 40 * SIGMA
    assert glitches_of(compared(stretch, None)) == []
    wide = 2 * D + SIGMA * np.random.default_rng(4).standard_t(5, size=(3, len(D)))
    assert glitches_of(compared(wide, None)) == []


def test_glitches_are_no_noise_that_grows_with_the_force():
    """Large ones at large forces looked like a share of the force in 14 of 40 specimens."""
    force = 4 * lines(4, seed=3)
    for lane, sample in enumerate((44, 50, 53, 57)):
        force[lane, [sample, sample - 9]] += np.array([80, -80]) * SIGMA
    curves = [Curve(f"s{i}", "t", 75.0, 0.0, 2 * D, row) for i, row in enumerate(force)]
    study = build_study(
        curves, table_1(), Options(coupling="total", onset_width=0.0),
        {"k_3": {"fixed": True, "value": 0.0}}, noise=Noise(force_share="estimate"),
    )  # fmt: skip
    assert np.all(fit(study, QUICK).force_share == 0)
