"""Five contracts that every public function of the mechanics keeps, a row of registry.py each.

Forward mode is reverse mode is a central difference. One call is a row of a batch. A bad row leaves
the others as they are, bit by bit, and their derivatives. What does not fit is refused by name.
float32 gives float32, near float64.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from registry import EACH, ROWS, SLOW

pytestmark = pytest.mark.compiling

STEP = 1e-3  # relative; the five-point rule is then exact to 1e-11
each = pytest.mark.parametrize("name", EACH)
#: Jacobians of whole presses take ten seconds each to compile. That of a path has an oblique press
#: in it; of a distance: tests/test_distance.py.
LONG = {*SLOW, "press", "press_contacts"}
DIFFERENTIATED = [
    pytest.param(n, marks=pytest.mark.slow if n in LONG else ())
    for n in ROWS
    if n not in ("press_oblique", "signed_distance")
]


def arrays(values, dtype="float64"):
    return {n: np.asarray(v, dtype) for n, v in values.items()}


@functools.cache
def single(name):
    """One call of the function as a program."""
    return jax.jit(ROWS[name].call)


@functools.cache
def compiled(name):
    """A batch of three: results, and derivatives of their sum by everything."""

    def one(v):
        found = ROWS[name].call(v)
        return sum(jnp.sum(jnp.where(jnp.isfinite(r), r, 0)) for r in found), found

    return jax.jit(jax.vmap(jax.value_and_grad(one, has_aux=True)))


def batch(name, *changes):
    """Rows that differ in all they have, each with a change."""
    values = ROWS[name].inputs
    rows = [{n: (1 + 0.01 * i) * np.asarray(v) for n, v in values.items()} for i in range(3)]
    rows = [arrays(row | dict(c)) for row, c in zip(rows, changes, strict=True)]
    return jax.tree.map(lambda *v: np.stack(v), *rows)


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_forward_is_reverse_is_a_difference(name):
    row = ROWS[name]
    values = arrays(row.inputs)
    x = np.concatenate([v.ravel() for v in values.values()])
    ends = np.cumsum([v.size for v in values.values()])[:-1]

    def flat(x):
        parts = zip(values.items(), jnp.split(x, ends), strict=True)
        found = row.call({n: part.reshape(v.shape) for (n, v), part in parts})
        return jnp.concatenate([r.ravel() for r in found])

    scale = np.where(x == 0, 1.0, np.abs(x))
    steps = STEP * np.diag(scale)
    points = np.concatenate([x + m * steps for m in (-2, -1, 1, 2)])
    ways = jax.jit(lambda x, p: (jax.jacfwd(flat)(x), jax.jacrev(flat)(x), jax.lax.map(flat, p)))
    forward, reverse, y = map(np.asarray, ways(x, points))
    forward, reverse, y = forward * scale, reverse * scale, y.reshape(4, x.size, -1)
    numeric = (y[0] - 8 * y[1] + 8 * y[2] - y[3]).T / (12 * STEP)
    size = np.max(np.abs(forward), axis=1, keepdims=True) + 1e-12 * np.abs(y).max()
    assert np.all(np.isfinite(forward))
    assert np.any(forward != 0)
    assert np.all(np.abs(forward - reverse) <= 1e-9 * size)
    assert np.all(np.abs(forward - numeric) <= row.differences * size)


@each
def test_one_is_a_row_of_a_batch(name):
    """To rounding, of the largest entry of each result."""
    many = batch(name, {}, {}, {})
    (_, found), _ = compiled(name)(many)
    alone = single(name)({n: v[1] for n, v in many.items()})
    for a, b in zip(alone, found, strict=True):
        size = np.abs(np.asarray(a)).max()
        np.testing.assert_allclose(a, np.asarray(b)[1], rtol=0, atol=1e-12 * size)


@each
def test_a_bad_row_leaves_the_others_as_they_are(name):
    (_, mixed), slopes = compiled(name)(batch(name, {}, ROWS[name].bad, {}))
    (_, clean), others = compiled(name)(batch(name, {}, {}, {}))
    assert any(not np.all(np.isfinite(np.asarray(v)[1])) for v in mixed)
    for p, q in zip((*mixed, *slopes.values()), (*clean, *others.values()), strict=True):
        np.testing.assert_array_equal(np.asarray(p)[::2], np.asarray(q)[::2])


@pytest.mark.parametrize(
    ("name", "i"), [(n, i) for n, row in ROWS.items() for i in range(len(row.refused))]
)
def test_what_does_not_fit_is_refused_by_name(name, i):
    call, says = ROWS[name].refused[i]
    with pytest.raises(ValueError, match=says):
        call(ROWS[name].inputs)


@each
def test_float32_is_near_float64(name):
    row = ROWS[name]
    run = single(name)
    exact, found = run(arrays(row.inputs)), run(arrays(row.inputs, "float32"))
    for a, b in zip(exact, found, strict=True):
        assert b.dtype == jnp.float32
        size = np.abs(np.asarray(a)).max()
        np.testing.assert_allclose(b, a, rtol=0, atol=row.rounding * size)
