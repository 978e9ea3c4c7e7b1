"""Derivatives written by hand, there and back: those of the plain formula by JAX's own rules.

First the tool (`linear`), then the rules of the surface that are written with it.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea._linear import linear, replaced
from jaxtrachea._numerics import epsilon
from jaxtrachea.surface import local, regions

pytestmark = pytest.mark.long

#: Most of the time is compilation.
SLOW = [pytest.mark.slow, pytest.mark.compiling]


def numbers(dtype, *shapes, seed=3):
    rng = np.random.default_rng(seed)
    return [jnp.asarray(rng.normal(size=s), dtype) for s in shapes]


def close(got, expected, factor=64):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        atol = factor * epsilon(b.dtype) * np.abs(b).max(initial=1)
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def plain(A, t):
    """Linear in t, and not in A."""
    return [jnp.sin(A) @ t, jnp.sum(A**2) * t]


def by_hand(A, t, back=1):
    def pull(fixed, cotangents):
        (A,), (g, h) = fixed, cotangents
        terms = [] if g is None else [jnp.sin(A).T @ g]
        terms += [] if h is None else [jnp.sum(A**2) * h]
        return [back * sum(terms)]

    return linear(lambda fixed, t: plain(fixed[0], t[0]), pull, [A], [t], [t, t])


def total(f, *v):
    return sum(jnp.sum(jnp.cos(x)) for x in f(*v))


WAYS = {
    "value": lambda f, *v: f(*v),
    "forward": lambda f, *v: jax.jvp(f, v, tuple(jnp.cos(x) for x in v)),
    "forward by one": lambda f, A, t: jax.jvp(lambda A: f(A, t), (A,), (A,)),
    "reverse": lambda f, *v: jax.grad(lambda *v: total(f, *v), argnums=(0, 1))(*v),
    "transposed": lambda f, A, t: jax.linear_transpose(lambda t: f(A, t), t)([t, t]),
    "twice transposed": lambda f, A, t: jax.linear_transpose(
        lambda g: jax.linear_transpose(lambda t: f(A, t), t)(g)[0], [t, t]
    )(t),
    "second": lambda f, *v: jax.hessian(lambda *v: total(f, *v), argnums=(0, 1))(*v),
}


@pytest.mark.parametrize(
    "way", ["reverse", *(pytest.param(n, marks=SLOW) for n in WAYS if n != "reverse")]
)
def test_it_is_the_plain_formula(way):
    """Alone, and with lanes of either argument or both."""
    A, t, As, ts = numbers("float64", (3, 3), (3,), (4, 3, 3), (3, 4))
    do = WAYS[way]
    for axes, at in {
        (None, None): (A, t),
        (0, None): (As, t),
        (None, 1): (A, ts),
        (0, 1): (As, ts),
    }.items():
        got, expected = (
            jax.jit(f if axes == (None, None) else jax.vmap(f, axes))(*at)
            for f in (lambda *v: do(by_hand, *v), lambda *v: do(plain, *v))
        )
        close(got, expected)


def test_going_back_is_what_was_written():
    """A way back that is twice as long as it should be gives twice the gradient."""
    A, t = numbers("float64", (3, 3), (3,))
    found = [jax.grad(lambda t, n=n: sum(map(jnp.sum, by_hand(A, t, n))))(t) for n in (1, 2)]
    np.testing.assert_allclose(found[1], 2 * found[0], rtol=1e-14)


def test_a_way_back_of_another_shape_is_refused():
    def run(t):
        return linear(lambda _, t: [2 * t[0]], lambda _, g: [2 * g[0][:2]], [], [t], [t])[0]

    with pytest.raises(TypeError, match=r"pull gives .*\(2,\).*expected .*\(3,\)"):
        jax.grad(lambda t: jnp.sum(run(t)))(jnp.ones(3))


def shares(dtype):
    phi = jnp.linspace(-np.pi, np.pi, 60, dtype=dtype)[:-1].reshape(-1, 1)
    return regions.line_shares, [phi, jnp.asarray(0.4, dtype), jnp.asarray(2.3, dtype)]


def combined(dtype):
    """Two edges, so three parts of the patch; whether a vertex is beyond one is not moved.

    In the first block the part before both edges has no length, and no vertex.
    """
    U, J, V, f, s, rows = numbers(dtype, *[(4, 7)] * 5, (4, 3, 26))
    rows = rows.at[0, 0, 1].set(0)
    beyond = (s > 0).at[0].set(True), s > 0.5

    def with_edges(f):
        return lambda U, J, V, fraction, s, rows: f((U, J, V), fraction, s, beyond, rows)

    run = with_edges(regions._combine)
    run.fun = with_edges(regions._combine.fun)
    return run, [U, J, V, f, s, rows]


def spread(dtype, on_a_centre=True):
    """Some points within reach, one beyond all and one on a centre, where psi is C2 only."""
    weights, centres, points = numbers(dtype, (5,), (5, 3), (9, 3))
    points = jnp.concatenate([points, centres[:1] + int(not on_a_centre), 50 + centres[1:2]])
    return local._spread, [weights, centres, points, jnp.asarray(2.5, dtype)]


RULES = {"shares": shares, "combined": combined, "spread": spread}


@pytest.mark.parametrize(
    "rule", ["shares", *(pytest.param(v, marks=SLOW) for v in ("spread", "combined"))]
)
def test_rules_of_the_surface(rule):
    """By all arguments, by each and by each two, both ways."""
    f, at = RULES[rule]("float64")
    along = numbers("float64", *(v.shape for v in at), seed=4)

    def there_and_back(f, moving):
        def only(*moved):
            return f(*replaced(at, moving, moved))

        inputs = [at[i] for i in moving]
        out, change = jax.jvp(only, inputs, [along[i] for i in moving])
        return out, change, jax.vjp(only, *inputs)[1](jax.tree.map(jnp.sin, out))

    places = range(len(at))
    for count in (1, 2, len(at)):
        for moving in itertools.combinations(places, count):
            got, expected = jax.jit(
                lambda moving=moving: [there_and_back(g, moving) for g in (f, f.fun)]
            )()
            close(got, expected, factor=1024)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("rule", list(RULES))
def test_rules_of_the_surface_against_differences(rule):
    """Central differences of values and of gradients, along random directions."""
    f, at = spread("float64", on_a_centre=False) if rule == "spread" else RULES[rule]("float64")
    along = numbers("float64", *(v.shape for v in at), seed=5)

    def gradient(*v):
        return jax.grad(lambda *v: total(lambda *v: jax.tree.leaves(f(*v)), *v), range(len(at)))(*v)

    for of in (f, gradient):
        change = jax.jvp(of, at, along)[1]
        ahead, behind = (
            of(*(v + s * d for v, d in zip(at, along, strict=True))) for s in (1e-5, -1e-5)
        )
        steps = jax.tree.map(lambda a, b: (a - b) / 2e-5, ahead, behind)
        for a, b in zip(jax.tree.leaves(change), jax.tree.leaves(steps), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(b).max())
