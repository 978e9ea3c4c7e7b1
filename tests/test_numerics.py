"""Guarded functions: closed forms, smoothness, derivatives at the awkward points."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from jaxtrachea._numerics import cubic_ratio, epsilon, positive_part, solve_spd

DTYPES = ["float32", "float64"]
ratio = jax.jit(cubic_ratio)


def closed_form(u):
    """Root of g + (4/27) u g^3 = 1: hyperbolic for u > 0, trigonometric for -1 < u < 0."""
    with mp.workdps(60):
        u = mp.mpf(float(u))
        if u == 0:
            return 1.0
        r = mp.sqrt(abs(u))
        if u > 0:
            return float(3 / r * mp.sinh(mp.asinh(r) / 3))
        return float(3 / r * mp.sin(mp.asin(r) / 3))


MAGNITUDES = 10.0 ** np.arange(-30, 31)
SOFTENING = -np.concatenate([10.0 ** -np.arange(1, 16), [0.25, 0.5, 0.9, 0.99, 0.9999]])


@pytest.mark.parametrize("dtype", DTYPES)
def test_cubic_ratio_closed_form(dtype):
    """60 decades of hardening, and softening up to the fold, to a few units in the last place."""
    u = np.concatenate([MAGNITUDES, SOFTENING, [0.0]]).astype(dtype)
    got = ratio(jnp.asarray(u))
    expected = np.array([closed_form(v) for v in u])
    assert got.dtype == dtype
    # At the fold g changes as sqrt(1 + u): rounding of u is magnified there.
    room = 8 * np.finfo(dtype).eps / np.sqrt(np.clip(1 + u.astype(float), 1e-12, 1))
    assert np.all(np.abs(np.asarray(got, float) / expected - 1) < room)


@pytest.mark.parametrize("dtype", DTYPES)
def test_cubic_ratio_ends_at_the_fold(dtype):
    eps = np.finfo(dtype).eps
    u = jnp.asarray([-1 + 4 * eps, -1, -1 - 2 * eps, -50, np.nan], dtype)
    got = np.asarray(ratio(u))
    assert abs(got[0] - 1.5) < 4 * np.sqrt(4 * eps)
    assert np.all(np.isnan(got[1:]))


@pytest.mark.parametrize("u", [0.0, 1e-12, 3.0, 1e8, -0.3, -0.95])
def test_cubic_ratio_derivatives(u):
    """First and second derivative: forward = reverse = implicit in 60 digits."""
    with mp.workdps(60):
        root = lambda v: mp.findroot(  # noqa: E731
            lambda g: g + mp.mpf(4) / 27 * v * g**3 - 1, closed_form(float(v))
        )
        step = mp.mpf(max(abs(u), 1e-3)) * mp.mpf(10) ** -12
        low, mid, high = (root(mp.mpf(u) + i * step) for i in (-1, 0, 1))
        first, second = float((high - low) / (2 * step)), float((high - 2 * mid + low) / step**2)
    x = jnp.asarray(u)
    np.testing.assert_allclose(jax.jacfwd(cubic_ratio)(x), first, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(cubic_ratio)(x), first, rtol=1e-12)
    for hessian in (jax.jacfwd(jax.grad(cubic_ratio)), jax.grad(jax.grad(cubic_ratio))):
        np.testing.assert_allclose(hessian(x), second, rtol=1e-11)


def test_cubic_ratio_maps_row_by_row():
    """A NaN row leaves the bits of its neighbours alone."""
    good = jnp.asarray([0.1, 7.0, -0.5, 1e20])
    bad = good.at[1].set(jnp.nan)
    one, two = jax.vmap(cubic_ratio)(good), jax.vmap(cubic_ratio)(bad)
    keep = np.array([0, 2, 3])
    np.testing.assert_array_equal(one[keep], two[keep])
    assert np.isnan(two[1])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("width", [0.0, 1e-3, 2.0])
def test_positive_part(width, dtype):
    """Exactly 0 below, exactly x above, rising between, and never above max(x, 0) + nothing."""
    w = jnp.asarray(width, dtype)
    x = jnp.asarray(np.concatenate([np.linspace(-3, 3, 301), [width, -0.0, 0.0]]), dtype)
    y = jax.jit(positive_part)(x, w)
    assert y.dtype == dtype
    np.testing.assert_array_equal(y[x <= 0], 0)
    np.testing.assert_array_equal(y[x >= w], jnp.maximum(x, 0)[x >= w])
    inside = np.sort(np.asarray(positive_part(jnp.linspace(0, width, 100, dtype=dtype), w)))
    assert np.all(np.diff(inside) >= 0)
    assert np.all(np.isfinite(jax.vmap(jax.grad(positive_part), (0, None))(x, w)))


def test_positive_part_is_c2():
    """Value, slope and curvature agree from both sides at both ends of the blend."""
    w = jnp.asarray(0.5)
    f = lambda x: positive_part(x, w)  # noqa: E731
    for order in range(3):
        for end in (0.0, 0.5):
            left, right = (f(jnp.asarray(end + e)) for e in (-1e-9, 1e-9))
            # Third derivative is at most 24 / w^2.
            assert abs(float(left - right)) < 3e-9 * 24 / 0.25
        f = jax.grad(f)
        assert order < 3


@pytest.mark.parametrize("dtype", DTYPES)
def test_epsilon(dtype):
    assert epsilon(dtype) == np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 2, 5, 8, 12])
def test_solve_spd(n, dtype):
    """Against numpy, on a graded matrix; a matrix that is not positive definite gives NaN."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, 2 * n))
    grade = 10.0 ** np.linspace(-2, 2, n)
    matrix = (root @ root.T) * grade[:, None] * grade
    rhs = rng.normal(size=n) * grade
    expected = np.linalg.solve(matrix, rhs)
    solve = jax.jit(jax.vmap(solve_spd))
    stacked = np.stack([matrix, -matrix])
    got = solve(jnp.asarray(stacked, dtype), jnp.asarray(np.stack([rhs, rhs]), dtype))
    assert got.dtype == dtype
    np.testing.assert_allclose(
        got[0], expected, rtol=0, atol=3000 * np.finfo(dtype).eps * abs(expected).max()
    )
    assert np.all(np.isnan(got[1]))
