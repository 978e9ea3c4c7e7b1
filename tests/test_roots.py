"""Roots of the force laws and in brackets: closed forms, folds, derivatives at awkward points."""

import functools
import re

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jitted import jitted

from jaxtrachea.mechanics.roots import (
    Rising,
    cubic_ratio,
    first_positive_root,
    newton_tolerance,
    quintic_past_fold,
    quintic_ratio,
    rising_root,
)

EPS = np.finfo(float).eps
ratio = jitted(cubic_ratio)


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


def test_cubic_ratio_closed_form():
    """60 decades of hardening, and softening up to the fold, to a few units in the last place."""
    u = np.concatenate([MAGNITUDES, SOFTENING, [0.0]])
    got = ratio(np.asarray(u))
    expected = np.array([closed_form(v) for v in u])
    # At the fold g changes as sqrt(1 + u): rounding of u is magnified there.
    room = 8 * EPS / np.sqrt(np.clip(1 + u.astype(float), 1e-12, 1))
    assert np.all(np.abs(np.asarray(got, float) / expected - 1) < room)


def test_cubic_ratio_ends_at_the_fold():
    u = np.asarray([-1 + 4 * EPS, -1, -1 - 2 * EPS, -50, np.nan])
    got = np.asarray(ratio(u))
    assert abs(got[0] - 1.5) < 4 * np.sqrt(4 * EPS)
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
    x = np.asarray(u)
    forward, reverse, *hessians = cubic_derivatives(x)
    np.testing.assert_allclose(forward, first, rtol=1e-12)
    np.testing.assert_allclose(reverse, first, rtol=1e-12)
    for hessian in hessians:
        np.testing.assert_allclose(hessian, second, rtol=1e-11)


def test_cubic_ratio_maps_row_by_row():
    """A NaN row leaves the bits of its neighbours alone."""
    run = jitted(jax.vmap(cubic_ratio))
    one, two = (np.asarray(run(np.array([0.1, v, -0.5, 1e20]))) for v in (7.0, np.nan))
    keep = np.array([0, 2, 3])
    np.testing.assert_array_equal(one[keep], two[keep])
    assert np.isnan(two[1])


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


def test_quintic_ratio_is_the_first_root():
    u, v = np.array(PAIRS + PAST).T
    got = np.asarray(jitted(quintic_ratio)(np.asarray(u), np.asarray(v)))
    expected, fold = np.array([first_root(a, b) for a, b in zip(u, v, strict=True)]).T
    assert np.all(np.isnan(expected[len(PAIRS) :]))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
    # Condition of the root: parts of the sum that cancel, over the slope.
    q, good = expected**2, slice(len(PAIRS))
    parts = 1 + np.abs(u) * q * expected + np.abs(v) * q * q * expected
    room = 8 * EPS * parts / (expected * (1 + 3 * u * q + 5 * v * q * q))
    assert np.all((np.abs(got / expected - 1) < room)[good])
    past = np.asarray(jitted(quintic_past_fold)(np.asarray(u), np.asarray(v)))
    np.testing.assert_array_equal(past, np.isnan(expected))
    assert np.all(expected[good] <= fold[good])


def test_quintic_ratio_knows_the_cubic():
    """Without the fifth power it is the other closed form, up to its fold."""
    u = np.concatenate([MAGNITUDES[:46], SOFTENING])
    got = jitted(quintic_ratio)(np.asarray(u * 4 / 27), np.zeros(len(u)))
    room = 16 * np.finfo(float).eps / np.sqrt(np.clip(1 + u, 1e-12, 1))
    assert np.all(np.abs(np.asarray(got) / np.array([closed_form(v) for v in u]) - 1) < room)


@pytest.mark.parametrize("away", [1e-1, 1e-3, 1e-5, 0.0, -1e-5])
def test_quintic_ratio_next_to_the_fold(away):
    """With the fold at g = f: u from v, and the right side as much below as `away` says."""
    f, v = 0.8, -0.05
    u = (-1 - 5 * v * f**4) / (3 * f * f)
    size = (f + u * f**3 + v * f**5) * (1 - away)  # g + ... = size, rescaled to 1
    u, v = np.asarray(u * size**2), np.asarray(v * size**4)
    expected, _ = first_root(u, v)
    got = float(jitted(quintic_ratio)(np.asarray(u), np.asarray(v)))
    if abs(away) > 1e-6:
        assert np.isnan(got) == np.isnan(expected) or abs(away) < 1e2 * EPS
    if np.isfinite(expected) and np.isfinite(got):
        # Rounding e of the arguments moves the root by sqrt(e) at the fold itself.
        assert abs(got / expected - 1) < 30 * EPS / max(np.sqrt(max(away, 0)), np.sqrt(EPS))


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
    forward, reverse, second = quintic_derivatives(np.array([u, v]))
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


def test_first_positive_root():
    """Of a + b q + e q^2, by all roots in 60 digits; inf where there is none."""
    rows = [(1, -3, 1), (1, -1, 0), (1, 2, -3), (1, -2.5, 1.5), (1, 1, 1), (1, 0, 0), (1, -1, 9)]
    rows += [(0, -1, 0), (1, -1e18, 1e17), (1, 1e18, -1), (1e-9, -1, -1), (2, 0, -8)]
    a, b, e = np.array(rows).T
    got = np.asarray(jitted(first_positive_root)(*map(np.asarray, (a, b, e))))
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
    np.testing.assert_allclose(got, expected, rtol=8 * EPS)


@pytest.mark.parametrize("lanes", [False, True])
def test_rising_root(lanes):
    """Tangents from values of arctan, from starts where plain Newton steps diverge (|x| > 1.4).

    The last three starts lie beside the root: free steps find them. The one before has no root in
    its bracket.
    """
    y = np.asarray([-1.4, -0.3, 0.0, 1.0, 1.5, 0.7, 0.6, 0.0, -0.6])
    start = np.asarray([20.0, -30.0, 40.0, -40.0, -9.0, 5.0, 0.7, 0.1, -0.6])

    def problem(y, start):
        low, solvable = jnp.full_like(y, -50), y != jnp.asarray(0.7)
        return Rising(
            lambda x: (jnp.arctan(x) - y, 1 / (1 + x * x)),
            lambda x: newton_tolerance("float64") * jnp.abs(x),
            start, low, -low, solvable,
        )  # fmt: skip

    solve = functools.partial(rising_root, problem, steps=4)
    found = jitted(jax.vmap(solve) if lanes else solve)(y, start)
    # An error of one rounding in arctan moves x by 1 + x^2 of it, 35 at most.
    want, rtol = np.tan(np.asarray(y, float)), 50 * EPS
    np.testing.assert_allclose(np.delete(found, 5), np.delete(want, 5), rtol=rtol, atol=rtol)
    assert np.isnan(found[5])


def test_rising_root_beside_another():
    """The root of sin(x) = 1/2 in the bracket, from starts that lead to others; pi/2 is its end."""

    def problem(start):
        end = jnp.full_like(start, jnp.pi / 2)
        return Rising(
            lambda x: (jnp.sin(x) - 0.5, jnp.cos(x)),
            lambda x: newton_tolerance("float64") * jnp.abs(x),
            start, -end, end, end > 0,
        )  # fmt: skip

    start = np.asarray([2.5, 0.5, 7.0, -4.0])
    found = jitted(functools.partial(rising_root, problem, steps=4))(start)
    np.testing.assert_allclose(found, np.pi / 6, rtol=8 * EPS)


def test_roots_in_a_bracket_are_a_loop_apart():
    """The compiler leaves the search in brackets inside its loop: it runs where one is sought."""

    def problem(y):
        end = jnp.full_like(y, 9)
        return Rising(lambda x: (x**3 + x - y, 3 * x * x + 1), jnp.abs, y, -end, end, end > y)

    solve = jax.jit(jax.vmap(functools.partial(rising_root, problem, steps=4)))
    text = solve.lower(np.ones((8, 100))).compile().as_text()
    parts = dict(re.findall(r"^(ENTRY|%\S+) .*?\{\n(.*?)^\}", text, re.M | re.S))

    def loops(part):  # XLA of JAX 0.12 wraps a loop in a call
        called = re.findall(r" call\(.*?to_apply=(%[^\s,]+)", part)
        return part.count(" while(") + sum(loops(parts[name]) for name in called)

    # The steps that all take, and the loop with the search inside.
    assert (loops(parts["ENTRY"]), text.count(" while(")) == (2, 3)
