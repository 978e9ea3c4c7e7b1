"""Standard errors of robust fits, and the noise that they are taken from: closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from scipy.stats import median_abs_deviation

from jaxtrachea.fitting.cost import robust
from jaxtrachea.fitting.covariance import analyse, half_widths
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.lanes import Weighting
from jaxtrachea.fitting.noise import first_sigma, next_sigma, normal_psi2

N, UNKNOWNS, BEND = 40, 2, 1.345
ESTIMATED = {"noise_given": (False, False), "noise_known": np.zeros(1, bool)}
GIVEN = {"noise_given": (True, False), "noise_known": np.ones(1, bool)}


def told(z):
    """Information of a line through N points with residuals z, by Huber's psi."""
    X = np.stack([np.ones(N), np.linspace(0, 3, N)], 1)
    gram, zero = (X.T @ X)[None], np.zeros((1, 2))
    of_forces = np.array([[1.0, 0.0]])
    return X, Information(
        bread=gram, meat=gram, gradient=zero, squares=np.sum(z**2) * of_forces,
        plain=np.sum(z**2) * of_forces, counts=N * of_forces,
        spread=np.median(np.abs(z)) * of_forces,
        psi2=np.mean(np.clip(z, -BEND, BEND) ** 2) * of_forces,
        dpsi=np.array([np.mean(np.abs(z) < BEND)]),
    )  # fmt: skip


def test_covariance_of_a_robust_fit():
    """Huber (1981), sec. 7.6: n / (n - p) mean(psi^2) / mean(psi')^2 (X^T X)^-1."""
    z = np.random.default_rng(5).standard_t(3, N)
    X, info = told(z)
    found = analyse(info, np.ones((1, 2)), np.zeros((1, 2), bool), **ESTIMATED)
    psi, slope = np.clip(z, -BEND, BEND), np.abs(z) < BEND
    assert 0.5 < np.mean(slope) < 0.95
    factor = N / (N - UNKNOWNS) * np.mean(psi**2) / np.mean(slope) ** 2
    want = factor * np.linalg.inv(X.T @ X)
    np.testing.assert_allclose(found.covariance[0], want, rtol=1e-9)
    np.testing.assert_allclose(found.se[0], np.sqrt(np.diag(want)), rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_given_noise_of_a_robust_fit(loss):
    """Errors are the spread of estimates: 4,000 lines with normal noise of the sigma given, scipy.

    The sandwich without mean psi^2 was too wide: by 15 % with huber, by 67 % with cauchy.
    """
    X, info = told(np.zeros(N))
    z = np.random.default_rng(7).normal(size=(4_000, N))
    theta = np.zeros((len(z), UNKNOWNS))
    kept = normal_psi2(loss, BEND)
    for _ in range(60):  # iteratively re-weighted least squares
        r = z - theta @ X.T
        w = np.asarray(robust(loss, jnp.asarray(r**2), BEND)[1])
        step = np.linalg.solve(np.einsum("ni,sn,nj->sij", X, w, X), ((w * r) @ X)[..., None])
        theta = theta + step[..., 0]
    spread = np.std(theta, axis=0)
    psi = r * w
    dpsi = (
        np.asarray(robust(loss, jnp.asarray((r + 1e-6) ** 2), BEND)[1]) * (r + 1e-6) - psi
    ) / 1e-6
    info = info._replace(psi2=np.array([[np.mean(psi**2), 0.0]]), dpsi=np.mean(dpsi)[None])
    found = analyse(info, np.ones((1, 2)), np.zeros((1, 2), bool), **GIVEN, least=kept)
    np.testing.assert_allclose(found.se[0], spread, rtol=0.05)
    few = info._replace(psi2=np.zeros((1, 2)))  # as many unknowns as samples: no residual is left
    found = analyse(few, np.ones((1, 2)), np.zeros((1, 2), bool), **GIVEN, least=kept)
    np.testing.assert_allclose(found.se[0], spread, rtol=0.05)


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


def test_intervals_are_those_of_the_tables():
    """Student (1908): 97.5 % of t with 1, 2 and 10 degrees of freedom; 1.960 with known noise."""
    dof = np.array([1, 2, 10, 10])
    known = np.array([False, False, False, True])
    half = half_widths(dof, noise_known=known)
    np.testing.assert_allclose(half, [12.706, 4.3027, 2.2281, 1.95996], rtol=2e-5)


def test_estimated_noise_is_over_what_the_unknowns_leave():
    """Sum of squares over n - p; all of the lane's unknowns, not one."""
    study = synthetic.study(np.ones((1, len(synthetic.S_C), len(synthetic.DEPTHS))))
    unknowns = study.lanes.active.sum()
    assert unknowns > 1
    z = np.random.default_rng(6).normal(size=N)
    found = next_sigma(study, told(z)[1], first_sigma(study))
    np.testing.assert_allclose(found[0, 0], np.sqrt(np.sum(z**2) / (N - unknowns)), rtol=1e-12)
