"""Guarded functions: closed forms, smoothness, derivatives at the awkward points."""

import functools
import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jitted import jitted
from late import late

from jaxtrachea._numerics import (
    cos_sin,
    epsilon,
    every,
    first_largest,
    largest,
    lowest,
    picked,
    positive_part,
    product,
    solve_spd,
    total,
    turned,
)

DTYPES = ["float64", *late("float32")]


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("width", [0.0, 1e-3])
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
    w = 0.5

    def f(x):
        return positive_part(x, jnp.asarray(w))

    run = jitted(lambda x: (f(x), jax.grad(f)(x), jax.grad(jax.grad(f))(x)))
    for end in (0.0, 0.5):
        left, right = (np.array(run(end + e)) for e in (-1e-9, 1e-9))
        # Third derivative is at most 24 / w^2.
        assert np.all(np.abs(left - right) < 3e-9 * 24 / 0.25)


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
    solve = jitted(jax.vmap(solve_spd))
    stacked = np.stack([matrix, -matrix])
    got = solve(np.asarray(stacked, dtype), np.asarray(np.stack([rhs, rhs]), dtype))
    assert got.dtype == dtype
    np.testing.assert_allclose(
        got[0], expected, rtol=0, atol=3000 * np.finfo(dtype).eps * abs(expected).max()
    )
    assert np.all(np.isnan(got[1]))


@pytest.mark.parametrize(("dtype", "reach"), [("float32", 1e2), ("float64", 1e4)])
def test_cosine_and_sine(dtype, reach):
    """Against 40 digits, at random, small and huge angles and beside multiples of pi / 4."""
    rng = np.random.default_rng(0)
    beside = np.arange(-40, 41) * np.pi / 4
    small = 10.0 ** -np.arange(1, 20)
    x = np.concatenate([rng.uniform(-reach, reach, 300), rng.normal(size=300), beside, small])
    x = np.append(x, [0.0, reach, -reach]).astype(dtype)
    both = jitted(cos_sin)
    got = np.asarray(both(np.asarray(x)))
    assert got.dtype == dtype
    with mp.workdps(40):
        wanted = [[float(f(mp.mpf(float(v)))) for v in x] for f in (mp.cos, mp.sin)]
    assert np.abs(got - wanted).max() <= np.finfo(dtype).eps
    sine = np.abs(x) < 0.5  # to the last digits of small sines as well
    np.testing.assert_allclose(
        got[1, sine], np.array(wanted)[1, sine], rtol=3 * np.finfo(dtype).eps
    )
    assert np.all(np.isnan(both(np.asarray([np.nan, np.inf], dtype))))


def test_cosine_and_sine_have_derivatives():
    x = np.linspace(-9, 9, 41)
    for jacobian in (jax.jacfwd, jax.jacrev):
        c, s = jitted(jacobian(cos_sin))(x)
        np.testing.assert_allclose(np.diagonal(c), -np.sin(x), atol=1e-15)
        np.testing.assert_allclose(np.diagonal(s), np.cos(x), atol=1e-15)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 3, 9, 33, 121, 1500])
def test_total_and_largest(n, dtype):
    """Against exact sums, with entries of both signs, in rows, at every way of summing."""
    x = np.random.default_rng(n).normal(size=(2, 3, n)).astype(dtype)
    got, top = jax.jit(total)(x), jax.jit(largest)(x)
    assert got.dtype == top.dtype == jnp.dtype(dtype)
    assert got.shape == top.shape == (2, 3)
    exact = [[math.fsum(map(float, row)) for row in rows] for rows in x]
    size = np.abs(x.astype(float)).sum(axis=-1).max()
    np.testing.assert_allclose(got, exact, rtol=0, atol=n * np.finfo(dtype).eps * size)
    np.testing.assert_array_equal(top, [[max(row) for row in rows] for rows in x])
    np.testing.assert_array_equal(jax.grad(lambda v: total(v))(x[0, 0]), np.ones(n, dtype))
    worst = x[0, 0].copy()
    worst[-1] = np.nan
    assert np.isnan(total(jnp.asarray(worst)))
    assert np.isnan(largest(jnp.asarray(worst)))
    worst[-1] = -np.inf
    assert np.isneginf(total(jnp.asarray(worst)))
    np.testing.assert_array_equal(largest(jnp.full(n, -3, dtype)), -3)
    ones = total(jnp.ones(n, jnp.int32))
    assert (ones, ones.dtype) == (n, jnp.int32)


@pytest.mark.parametrize("n", [1, 9, 33, 300])
def test_every(n):
    run = jitted(every)
    assert run(np.ones(n, bool))
    for i in (0, n // 2, n - 1):
        assert not run(np.asarray(np.arange(n) != i))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 5, 8, 9, 120, 300])
def test_first_largest(n, dtype):
    """As numpy's argmax, of equal entries the first, also in lanes; an index even without one."""
    draw = np.random.default_rng(n)
    x = np.vstack(
        [draw.normal(size=(4, n)), draw.integers(-3, 0, (4, n)), np.full((1, n), -np.inf)]
    )
    found, alone = jitted(jax.vmap(first_largest))(x.astype(dtype)), jitted(first_largest)
    np.testing.assert_array_equal(found, x.argmax(axis=1))
    for bad in (np.full(n, np.nan), np.where(np.arange(n) == n // 2, np.nan, x[0])):
        assert 0 <= int(alone(np.asarray(bad, dtype))) < n


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "shapes", [((3, 4), (4,)), ((2, 3, 4), (4, 5)), ((4,), (4, 2)), ((4,), (4,))]
)
def test_product_is_that_of_matrices(shapes, dtype):
    """Against numpy; derivatives, which are exact, by the product rule; lanes."""
    rng = np.random.default_rng(2)
    a, b = (np.asarray(rng.normal(size=shape), dtype) for shape in shapes)
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=20 * epsilon(a.dtype))
    lanes, along = np.stack([a, 2 * a]), float(np.sum(b[0]))

    @jax.jit
    def found(a, b, lanes):
        moved = jax.jvp(product, (a, b), (along * a, b))
        back = jax.grad(lambda a: jnp.sum(product(a, b)))(a)
        return *moved, back, jax.vmap(product, (0, None))(lanes, b)

    value, change, back, many = found(a, b, lanes)
    a, b = np.asarray(a), np.asarray(b)
    close(value, a @ b)
    close(many[1], 2 * (a @ b))
    close(change, (1 + along) * (a @ b))
    close(back, np.broadcast_to(b.reshape(4, -1).sum(1), a.shape))


def test_product_of_unequal_sizes():
    a = np.arange(12.0).reshape(3, 4)
    for b in (np.ones(3), np.ones(5), np.ones((3, 2))):
        with pytest.raises(Exception, match=r"expected 4 rows|Type-check error"):
            product(a, b)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [5, 40])
@pytest.mark.parametrize(("rows", "places"), [((), ()), ((), (2,)), ((3,), (2,)), ((2, 3), (4, 1))])
def test_picked_is_the_entry(rows, places, n, dtype):
    """As by indexing; NaN stays where it is, and the derivative is 1 for what is picked."""
    rng = np.random.default_rng(3)
    values, index = rng.normal(size=(*rows, n)).astype(dtype), rng.integers(1, n, places)
    values[..., 0] = np.nan

    @jax.jit
    def both(values, index):
        slope = jax.grad(lambda v: jnp.sum(picked(v, index)))
        return picked(values, index), slope(values)

    found, slope = both(np.asarray(values), np.asarray(index))
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, values[..., index])
    count = np.bincount(index.ravel(), minlength=n)
    np.testing.assert_array_equal(slope, np.broadcast_to(count, values.shape))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_turned_is_the_congruence(shape, dtype):
    rng = np.random.default_rng(4)
    matrices, frame = rng.normal(size=(*shape, 3, 3)), rng.normal(size=(3, 2))
    expected = frame.T @ matrices @ frame
    found = jitted(turned)(np.asarray(matrices, dtype), np.asarray(frame, dtype))
    assert found.dtype == dtype
    atol = 32 * epsilon(found.dtype) * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("count", [0, 1, 3, 8, 9, 20])
def test_lowest_are_those_of_a_sort(count):
    """Of equal ones the first; in lanes too."""
    x = np.random.default_rng(6).integers(0, 12, (3, 40)).astype(float)
    places, left = jitted(jax.vmap(lambda v: lowest(v, count)))(np.asarray(x))
    expected = np.argsort(x, axis=1, kind="stable")[:, :count]
    np.testing.assert_array_equal(places, expected)
    for kept, taken in zip(left, expected, strict=True):
        np.testing.assert_array_equal(np.flatnonzero(~kept), np.sort(taken))
