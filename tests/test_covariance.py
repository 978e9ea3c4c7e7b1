"""Standard errors of robust fits, and the noise that they are taken from: closed forms."""

import numpy as np
import pytest
import synthetic
from scipy.stats import median_abs_deviation

from jaxtrachea.fitting.covariance import analyse
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.lanes import Weighting
from jaxtrachea.fitting.noise import first_sigma, next_sigma

N, UNKNOWNS, BEND = 40, 2, 1.345


def told(z):
    """Information of a line through N points with residuals z, by Huber's psi."""
    X = np.stack([np.ones(N), np.linspace(0, 3, N)], 1)
    gram, zero = (X.T @ X)[None], np.zeros((1, 2))
    of_forces = np.array([[1.0, 0.0]])
    return X, Information(
        bread=gram, meat=gram, gradient=zero, squares=np.sum(z**2) * of_forces,
        weighted=np.sum(z**2) * of_forces, plain=np.sum(z**2) * of_forces, counts=N * of_forces,
        spread=np.median(np.abs(z)) * of_forces,
        psi2=np.array([np.mean(np.clip(z, -BEND, BEND) ** 2)]),
        dpsi=np.array([np.mean(np.abs(z) < BEND)]),
    )  # fmt: skip


def test_covariance_of_a_robust_fit():
    """Huber (1981), sec. 7.6: n / (n - p) mean(psi^2) / mean(psi')^2 (X^T X)^-1."""
    z = np.random.default_rng(5).standard_t(3, N)
    X, info = told(z)
    found = analyse(info, np.ones((1, 2)), np.zeros((1, 2), bool), noise_given=False)
    psi, slope = np.clip(z, -BEND, BEND), np.abs(z) < BEND
    assert 0.5 < np.mean(slope) < 0.95
    factor = N / (N - UNKNOWNS) * np.mean(psi**2) / np.mean(slope) ** 2
    want = factor * np.linalg.inv(X.T @ X)
    np.testing.assert_allclose(found.covariance[0], want, rtol=1e-9)
    np.testing.assert_allclose(found.se[0], np.sqrt(np.diag(want)), rtol=1e-9)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_noise_of_a_robust_fit_is_that_of_normal_residuals(loss):
    """Median absolute residual over that of a standard normal variable (scipy)."""
    study = synthetic.study(
        np.ones((1, len(synthetic.S_C), len(synthetic.DEPTHS))), weighting=Weighting(loss=loss)
    )
    z = np.random.default_rng(6).normal(size=N)
    found = next_sigma(study, told(z)[1], first_sigma(study))
    want = median_abs_deviation(np.concatenate([z, -z]), scale="normal")  # about 0
    np.testing.assert_allclose(found[0, 0], want, rtol=1e-5)
