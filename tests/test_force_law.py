"""Local contact law: the paper's symbols, the fold, and the blend between ring and ligament."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jitted import jitted
from scipy.optimize import brentq

from jaxtrachea.mechanics.force_law import (
    Law,
    blend,
    duffing,
    fold_depth,
    from_duffing,
    ring_weight,
)

RINGS = np.array([10.0, 20.0, 32.0])


def law(k_1, k_3):
    return Law(np.asarray(k_1), np.asarray(k_3))


force_of = jitted(duffing)
blended = jitted(blend)
#: Depth of the fold of k_1 = 0.5, and its derivative by k_3.
peak = jitted(jax.value_and_grad(lambda k_3: fold_depth(Law(jnp.asarray(0.5), k_3))))


def test_duffing():
    d = np.linspace(-2, 2, 9)
    force = force_of(d, law(0.3, 0.05))
    expected = 0.3 * d + 0.05 * d**3
    np.testing.assert_allclose(force, expected, rtol=4 * np.finfo(float).eps, atol=1e-30)
    np.testing.assert_array_equal(force, -force[::-1])


def test_from_duffing():
    """|F| = m_0 |omega_0^2 d + 3/4 beta_0^2 eps d^3| (paper eq. 1); m_0 merely scales."""
    m_0, omega, beta = 0.02, 15.0, 8.0
    run = jax.jit(lambda d, *numbers: duffing(d, from_duffing(*numbers)))
    force = run(1.7, m_0, omega, beta)
    np.testing.assert_allclose(force, m_0 * (omega * 1.7 + 0.75 * beta * 1.7**3), rtol=1e-14)
    np.testing.assert_allclose(run(1.7, 2 * m_0, omega / 2, beta / 2), force, rtol=1e-14)


@pytest.mark.parametrize("k_3", [-1e-30, -0.02, -1e10])
def test_fold_is_where_the_law_peaks(k_3):
    d, by_k_3 = peak(k_3)
    np.testing.assert_allclose(d, np.sqrt(0.5 / (-3 * k_3)), rtol=1e-14)
    assert abs(jitted(jax.grad(duffing))(d, law(0.5, k_3))) < 1e-14
    assert np.isfinite(by_k_3)


@pytest.mark.parametrize("k_3", [0.0, 1e-30, 4.0])
def test_no_fold(k_3):
    assert peak(k_3) == (np.inf, 0)


def test_ring_weight_limits():
    """1 on a ring's centre, exactly 0 from `transition` on, between 0 and 1 elsewhere."""
    weight = jitted(jax.vmap(lambda s, width: ring_weight(s, jnp.asarray(RINGS), width), (0, None)))
    for width in (5.0, 9.0):  # rings apart; neighbourhoods that overlap
        s = np.concatenate([RINGS, np.linspace(0, 42, 421)])
        w = weight(s, width)
        assert np.all((w >= 0) & (w <= 1))
        np.testing.assert_array_equal(w[: len(RINGS)], 1)
        distance = np.min(np.abs(s[:, None] - RINGS), axis=1)
        assert np.all(w[distance >= width + 1e-3] == 0)
        assert np.all(w[distance < 0.99 * width] > 0)


def test_ring_weight_is_c2():
    """Left and right limits of value, slope and curvature, at centres and at the rim."""

    def f(s):
        return ring_weight(s, jnp.asarray(RINGS), jnp.asarray(5.0))

    for tolerance in (1e-8, 1e-8, 1e-7):
        run = jitted(f)
        for s in (5.0, 10.0, 15.0, 25.0, 27.0, 37.0):
            left, at, right = (run(s + e) for e in (-1e-9, 0.0, 1e-9))
            np.testing.assert_allclose([left, right], [at, at], atol=tolerance)
        f = jax.grad(f)


def test_blend():
    """Compliances are mixed: 1 / k_1 by weight, k_3 as of the two springs in series."""
    soft, stiff = law(0.2, 0.01), law(3.0, -0.5)
    k_1 = 1 / (0.75 / 0.2 + 0.25 / 3.0)
    k_3 = (0.75 * 0.01 / 0.2**4 + 0.25 * -0.5 / 3.0**4) * k_1**4
    for weight, expected in ((0.0, soft), (1.0, stiff), (0.25, law(k_1, k_3))):
        got = blended(soft, stiff, weight)
        np.testing.assert_allclose(got[:2], expected[:2], rtol=1e-14)
        assert got.k_5 is None


@pytest.mark.parametrize("weight", [0.1, 0.5, 0.9])
def test_blend_is_springs_in_series(weight):
    """Force at small depth to fifth order, of the laws in series by their shares of the depth."""
    soft, stiff = law(0.2, 0.01), law(3.0, 0.5)

    def depth(F):
        def of(part, k):
            return part * brentq(lambda d: k.k_1 * d + k.k_3 * d**3 - F, 0, 1e3, xtol=1e-15)

        return of(1 - weight, soft) + of(weight, stiff)

    got = blended(soft, stiff, weight)
    errors = [force_of(depth(F), got) / F - 1 for F in (0.02, 0.01)]
    assert abs(errors[0]) < 1e-5
    np.testing.assert_allclose(errors[0] / errors[1], 16, rtol=0.1)
