"""Guarded functions: closed forms, smoothness, derivatives at the awkward points."""

import functools
import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from jaxtrachea._in_order import fits_one_kernel
from jaxtrachea._numerics import (
    Rising,
    cos_sin,
    cubic_ratio,
    epsilon,
    first_largest,
    first_positive_root,
    largest,
    lowest,
    newton_tolerance,
    picked,
    positive_part,
    product,
    quintic_past_fold,
    quintic_ratio,
    rising_root,
    solve_spd,
    total,
    turned,
)

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


@jax.jit
def cubic_derivatives(x):
    """First, forward and reverse; second, forward and reverse over reverse."""
    slope = jax.grad(cubic_ratio)
    return jax.jacfwd(cubic_ratio)(x), slope(x), jax.jacfwd(slope)(x), jax.grad(slope)(x)


@pytest.mark.parametrize("u", [0.0, 1e-12, 3.0, 1e8, -0.3, -0.95])
def test_cubic_ratio_derivatives(u):
    """First and second derivative: forward = reverse = implicit in 60 digits."""
    with mp.workdps(60):

        def root(v):
            return mp.findroot(lambda g: g + mp.mpf(4) / 27 * v * g**3 - 1, closed_form(float(v)))

        step = mp.mpf(max(abs(u), 1e-3)) * mp.mpf(10) ** -12
        low, mid, high = (root(mp.mpf(u) + i * step) for i in (-1, 0, 1))
        first, second = float((high - low) / (2 * step)), float((high - 2 * mid + low) / step**2)
    x = jnp.asarray(u)
    forward, reverse, *hessians = cubic_derivatives(x)
    np.testing.assert_allclose(forward, first, rtol=1e-12)
    np.testing.assert_allclose(reverse, first, rtol=1e-12)
    for hessian in hessians:
        np.testing.assert_allclose(hessian, second, rtol=1e-11)


def test_cubic_ratio_maps_row_by_row():
    """A NaN row leaves the bits of its neighbours alone."""
    good = jnp.asarray([0.1, 7.0, -0.5, 1e20])
    bad = good.at[1].set(jnp.nan)
    one, two = jax.vmap(cubic_ratio)(good), jax.vmap(cubic_ratio)(bad)
    keep = np.array([0, 2, 3])
    np.testing.assert_array_equal(one[keep], two[keep])
    assert np.isnan(two[1])


@pytest.mark.slow
@pytest.mark.compiling
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

    def f(x):
        return positive_part(x, w)

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


def first_root(u, v):
    """Root of g + u g^3 + v g^5 = 1 on the branch from 0, and the fold: all roots in 60 digits."""
    with mp.workdps(60):
        u, v = mp.mpf(float(u)), mp.mpf(float(v))

        def real(p):
            return [
            mp.re(r) for r in mp.polyroots(p[::-1], maxsteps=500, extraprec=800, asc=True)
            if abs(mp.im(r)) < mp.mpf(10) ** -25 * abs(r) and mp.re(r) > 0
        ]  # fmt: skip

        def trimmed(p):
            return p[next(i for i, c in enumerate(p) if c != 0) :]

        slope = trimmed([5 * v, 3 * u, 1])
        squares = real(slope) if len(slope) > 1 else []
        fold = mp.sqrt(min(squares)) if squares else mp.inf
        roots = [r for r in real(trimmed([v, 0, u, 0, 1, -1])) if r <= fold]
        return (float(min(roots)) if roots else np.nan), float(fold)


PARTS = [0.0, 1e-9, 0.03, 1.0, 40.0, 1e6, 1e15]
PAIRS = [(u, v) for u in PARTS for v in PARTS]
#: Softening and then hardening, with and without a fold, softening twice, hardening and softening.
PAIRS += [(-0.1, 1e-4), (-0.1, 0.01), (-0.12, 0.006), (-3.0, 20.0), (-40.0, 1e4), (-1e6, 1e13)]
PAIRS += [(-0.1, -1e-3), (-1e-12, -1e-12), (0.5, -0.05), (0.0, -0.05), (1e3, -1e4), (30.0, -60.0)]
PAST = [(-1.0, 0.3), (-1.0, 0.01), (-1.0, 0.0), (-0.2, -0.2), (0.0, -1.0), (3.0, -1e4)]
PAST += [(1e3, -4e4), (-1e9, 1e9)]


@pytest.mark.parametrize("dtype", DTYPES)
def test_quintic_ratio_is_the_first_root(dtype):
    u, v = np.array(PAIRS + PAST).T.astype(dtype)
    got = np.asarray(jax.jit(quintic_ratio)(jnp.asarray(u), jnp.asarray(v)))
    expected, fold = np.array([first_root(a, b) for a, b in zip(u, v, strict=True)]).T
    assert got.dtype == dtype
    assert np.all(np.isnan(expected[len(PAIRS) :]))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
    # Condition of the root: parts of the sum that cancel, over the slope.
    q, good = expected**2, slice(len(PAIRS))
    parts = 1 + np.abs(u) * q * expected + np.abs(v) * q * q * expected
    room = 8 * np.finfo(dtype).eps * parts / (expected * (1 + 3 * u * q + 5 * v * q * q))
    assert np.all((np.abs(got / expected - 1) < room)[good])
    past = np.asarray(jax.jit(quintic_past_fold)(jnp.asarray(u), jnp.asarray(v)))
    np.testing.assert_array_equal(past, np.isnan(expected))
    assert np.all(expected[good] <= fold[good])


def test_quintic_ratio_knows_the_cubic():
    """Without the fifth power it is the other closed form, up to its fold."""
    u = np.concatenate([MAGNITUDES[:46], SOFTENING])
    got = jax.jit(quintic_ratio)(jnp.asarray(u * 4 / 27), jnp.zeros(len(u)))
    room = 16 * np.finfo(float).eps / np.sqrt(np.clip(1 + u, 1e-12, 1))
    assert np.all(np.abs(np.asarray(got) / np.array([closed_form(v) for v in u]) - 1) < room)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("away", [1e-1, 1e-3, 1e-5, 0.0, -1e-5])
def test_quintic_ratio_next_to_the_fold(away, dtype):
    """With the fold at g = f: u from v, and the right side as much below as `away` says."""
    f, v = 0.8, -0.05
    u = (-1 - 5 * v * f**4) / (3 * f * f)
    size = (f + u * f**3 + v * f**5) * (1 - away)  # g + ... = size, rescaled to 1
    u, v = np.asarray(u * size**2, dtype), np.asarray(v * size**4, dtype)
    expected, _ = first_root(u, v)
    got = float(jax.jit(quintic_ratio)(jnp.asarray(u), jnp.asarray(v)))
    if abs(away) > 1e-6:
        assert np.isnan(got) == np.isnan(expected) or abs(away) < 1e2 * np.finfo(dtype).eps
    if np.isfinite(expected) and np.isfinite(got):
        # Rounding e of the arguments moves the root by sqrt(e) at the fold itself.
        eps = float(np.finfo(dtype).eps)
        assert abs(got / expected - 1) < 30 * eps / max(np.sqrt(max(away, 0)), np.sqrt(eps))


def test_quintic_ratio_rows_stay_alone():
    """NaN, infinite and folded rows change no bit of the others; they are NaN themselves."""
    u, v = jnp.array([0.3, -0.2, 5.0, 0.1]), jnp.array([0.2, 0.05, 1.0, 2.0])
    run = jax.jit(quintic_ratio)
    good, bad = run(u, v), run(u.at[0].set(jnp.nan).at[2].set(jnp.inf), v.at[3].set(-9.0))
    assert good[1] == bad[1]
    assert np.all(np.isnan(np.asarray(bad)[[0, 2, 3]]))
    one = jax.vmap(run)(u, v)
    np.testing.assert_array_equal(one, good)


@jax.jit
def quintic_derivatives(at):
    """First, forward and reverse; second."""

    def f(x):
        return quintic_ratio(x[0], x[1])

    slope = jax.grad(f)
    return jax.jacfwd(f)(at), slope(at), jax.jacfwd(slope)(at)


@pytest.mark.parametrize(("u", "v"), [(0.0, 0.0), (0.4, 0.7), (-0.3, 0.2), (1e6, 1e9), (-0.1, 0.0)])
def test_quintic_ratio_derivatives(u, v):
    """First derivatives, forward = reverse, by differences in 60 digits; second ones likewise."""
    forward, reverse, second = quintic_derivatives(jnp.array([u, v]))
    with mp.workdps(60):

        def root(a, b):
            start, _ = first_root(u, v)
            return mp.findroot(lambda g: g + a * g**3 + b * g**5 - 1, start)

        m = mp.mpf
        step = [m(max(abs(x), 1e-3)) * m(10) ** -15 for x in (u, v)]

        def up(i, j):
            return root(m(u) + i * step[0], m(v) + j * step[1])

        first = [float((up(1, 0) - up(-1, 0)) / (2 * step[0])),
                 float((up(0, 1) - up(0, -1)) / (2 * step[1]))]  # fmt: skip
        mixed = float((up(1, 1) - up(1, -1) - up(-1, 1) + up(-1, -1)) / (4 * step[0] * step[1]))
    np.testing.assert_allclose(forward, first, rtol=1e-12)
    np.testing.assert_allclose(reverse, first, rtol=1e-12)
    np.testing.assert_allclose(second[0, 1], mixed, rtol=1e-11)


@pytest.mark.parametrize("dtype", DTYPES)
def test_first_positive_root(dtype):
    """Of a + b q + e q^2, by all roots in 60 digits; inf where there is none."""
    rows = [(1, -3, 1), (1, -1, 0), (1, 2, -3), (1, -2.5, 1.5), (1, 1, 1), (1, 0, 0), (1, -1, 9)]
    rows += [(0, -1, 0), (1, -1e18, 1e17), (1, 1e18, -1), (1e-9, -1, -1), (2, 0, -8)]
    a, b, e = np.array(rows).T.astype(dtype)
    got = np.asarray(jax.jit(first_positive_root)(*map(jnp.asarray, (a, b, e))))
    expected = []
    for row in zip(a, b, e, strict=True):
        with mp.workdps(60):
            row = [mp.mpf(float(x)) for x in row]
            if row[0] == 0:
                expected.append(0.0)
                continue
            inverse = [r for r in mp.polyroots(row[::-1], 500, extraprec=500, asc=True)]
            # Of 1 / q.
            there = [1 / mp.re(r) for r in inverse if abs(mp.im(r)) < 1e-30 and mp.re(r) > 0]
            expected.append(float(min(there)) if there else np.inf)
    np.testing.assert_allclose(got, expected, rtol=8 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("lanes", [False, True])
def test_rising_root(lanes, dtype):
    """Tangents from values of arctan, from starts where plain Newton steps diverge (|x| > 1.4).

    The last three starts lie beside the root: free steps find them. The one before has no root in
    its bracket.
    """
    y = jnp.asarray([-1.4, -0.3, 0.0, 1.0, 1.5, 0.7, 0.6, 0.0, -0.6], dtype)
    start = jnp.asarray([20.0, -30.0, 40.0, -40.0, -9.0, 5.0, 0.7, 0.1, -0.6], dtype)

    def problem(y, start):
        low, solvable = jnp.full_like(y, -50), y != jnp.asarray(0.7, dtype)
        return Rising(
            lambda x: (jnp.arctan(x) - y, 1 / (1 + x * x)),
            lambda x: newton_tolerance(dtype) * jnp.abs(x),
            start, low, -low, solvable,
        )  # fmt: skip

    solve = functools.partial(rising_root, problem, steps=4)
    found = jax.jit(jax.vmap(solve) if lanes else solve)(y, start)
    assert found.dtype == jnp.dtype(dtype)
    # An error of one rounding in arctan moves x by 1 + x^2 of it, 35 at most.
    want, rtol = np.tan(np.asarray(y, float)), 50 * np.finfo(dtype).eps
    np.testing.assert_allclose(np.delete(found, 5), np.delete(want, 5), rtol=rtol, atol=rtol)
    assert np.isnan(found[5])


@pytest.mark.parametrize("dtype", DTYPES)
def test_rising_root_beside_another(dtype):
    """The root of sin(x) = 1/2 in the bracket, from starts that lead to others; pi/2 is its end."""

    def problem(start):
        end = jnp.full_like(start, jnp.pi / 2)
        return Rising(
            lambda x: (jnp.sin(x) - 0.5, jnp.cos(x)),
            lambda x: newton_tolerance(dtype) * jnp.abs(x),
            start, -end, end, end > 0,
        )  # fmt: skip

    start = jnp.asarray([2.5, 0.5, 7.0, -4.0], dtype)
    found = jax.jit(functools.partial(rising_root, problem, steps=4))(start)
    np.testing.assert_allclose(found, np.pi / 6, rtol=8 * np.finfo(dtype).eps)


def test_roots_in_a_bracket_are_a_loop_apart():
    """The compiler leaves the search in brackets inside its loop: it runs where one is sought."""

    def problem(y):
        end = jnp.full_like(y, 9)
        return Rising(lambda x: (x**3 + x - y, 3 * x * x + 1), jnp.abs, y, -end, end, end > y)

    solve = jax.jit(jax.vmap(functools.partial(rising_root, problem, steps=4)))
    text = solve.lower(jnp.ones((8, 100))).compile().as_text()
    entry = text[text.index("\nENTRY") :]
    # The steps that all take, and the loop with the search inside.
    assert (entry.count(" while("), text.count(" while(")) == (2, 3)


@pytest.mark.parametrize(("dtype", "reach"), [("float32", 1e2), ("float64", 1e4)])
def test_cosine_and_sine(dtype, reach):
    """Against 40 digits, at random, small and huge angles and beside multiples of pi / 4."""
    rng = np.random.default_rng(0)
    beside = np.arange(-40, 41) * np.pi / 4
    small = 10.0 ** -np.arange(1, 20)
    x = np.concatenate([rng.uniform(-reach, reach, 300), rng.normal(size=300), beside, small])
    x = np.append(x, [0.0, reach, -reach]).astype(dtype)
    both = jax.jit(cos_sin)
    got = np.asarray(both(jnp.asarray(x)))
    assert got.dtype == dtype
    with mp.workdps(40):
        wanted = [[float(f(mp.mpf(float(v)))) for v in x] for f in (mp.cos, mp.sin)]
    assert np.abs(got - wanted).max() <= np.finfo(dtype).eps
    sine = np.abs(x) < 0.5  # to the last digits of small sines as well
    np.testing.assert_allclose(
        got[1, sine], np.array(wanted)[1, sine], rtol=3 * np.finfo(dtype).eps
    )
    assert np.all(np.isnan(both(jnp.asarray([np.nan, np.inf], dtype))))


def test_cosine_and_sine_have_derivatives():
    x = jnp.linspace(-9, 9, 41)
    for jacobian in (jax.jacfwd, jax.jacrev):
        c, s = jacobian(cos_sin)(x)
        np.testing.assert_allclose(np.diagonal(c), -np.sin(x), atol=1e-15)
        np.testing.assert_allclose(np.diagonal(s), np.cos(x), atol=1e-15)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 9, 32, 33, 64, 97, 120, 121, 128, 1000, 1500])
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


@pytest.mark.parametrize("n", [7, 8, 9, 120, 121, 300])
@pytest.mark.parametrize("reduced", [total, largest])
def test_a_reduction_fills_up_no_row(reduced, n):
    """A loop over filled-up rows asks for each entry whether it is one: 1.8 times a contact."""
    program = jax.make_jaxpr(reduced)(jnp.zeros(n)).jaxpr
    assert " pad[" not in str(program)
    assert fits_one_kernel(program)  # no array is empty


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 5, 8, 9, 120, 300])
def test_first_largest(n, dtype):
    """As numpy's argmax, of equal entries the first, also in lanes; an index even without one."""
    draw = np.random.default_rng(n)
    x = np.vstack(
        [draw.normal(size=(4, n)), draw.integers(-3, 0, (4, n)), np.full((1, n), -np.inf)]
    )
    found = jax.jit(jax.vmap(first_largest))(x.astype(dtype))
    np.testing.assert_array_equal(found, x.argmax(axis=1))
    for bad in (np.full(n, np.nan), np.where(np.arange(n) == n // 2, np.nan, x[0])):
        assert 0 <= int(first_largest(jnp.asarray(bad, dtype))) < n


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "shapes", [((3, 4), (4,)), ((2, 3, 4), (4, 5)), ((4,), (4, 2)), ((4,), (4,))]
)
def test_product_is_that_of_matrices(shapes, dtype):
    """Against numpy; derivatives, which are exact, by the product rule; lanes."""
    rng = np.random.default_rng(2)
    a, b = (jnp.asarray(rng.normal(size=shape), dtype) for shape in shapes)
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
    a = jnp.arange(12.0).reshape(3, 4)
    for b in (jnp.ones(3), jnp.ones(5), jnp.ones((3, 2))):
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

    found, slope = both(jnp.asarray(values), jnp.asarray(index))
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
    found = jax.jit(turned)(jnp.asarray(matrices, dtype), jnp.asarray(frame, dtype))
    assert found.dtype == dtype
    atol = 32 * epsilon(found.dtype) * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("count", [0, 1, 3, 8, 9, 20])
def test_lowest_are_those_of_a_sort(count):
    """Of equal ones the first; in lanes too."""
    x = np.random.default_rng(6).integers(0, 12, (3, 40)).astype(float)
    places, left = jax.jit(jax.vmap(lambda v: lowest(v, count)))(jnp.asarray(x))
    expected = np.argsort(x, axis=1, kind="stable")[:, :count]
    np.testing.assert_array_equal(places, expected)
    for kept, taken in zip(left, expected, strict=True):
        np.testing.assert_array_equal(np.flatnonzero(~kept), np.sort(taken))
