"""A part compiled by itself: values and derivatives are those of the part, whatever is done to it.

The outside truth is the function without the mark. What the mark does is read in the compiled
program: one call is marked, several lanes and derivatives are not.
"""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea._numerics import epsilon
from jaxtrachea.fusion import fuse, one_by_one

#: With the first word: XLA makes calls of its own small loops.
MARK = 'inlineable="false",xla_cpu_small_call="true"'
pytestmark = [pytest.mark.long, pytest.mark.usefixtures("on_the_cpu"), pytest.mark.compiling]


def part(pair, n):
    """Trees in and out; a loop, a branch, a choice of whole numbers, an argument nobody reads."""
    x, y = pair
    x = jax.lax.fori_loop(0, 3, lambda _, v: jnp.sin(v) + jnp.cos(y) * n, x)
    y = jax.lax.cond(jnp.max(x) > 0, lambda v: 2 * v, jnp.negative, y)
    return {"sum": jnp.sum(x * y), "place": jnp.argmax(x), "both": (x, None)}


def arguments(dtype, lanes=()):
    rng = np.random.default_rng(5)
    pair = tuple(jnp.asarray(rng.normal(size=(*lanes, 7)), dtype) for _ in range(2))
    return pair, jnp.full(lanes, 0.5, dtype)


def total(f, *given):
    found = f(*given)
    return found["sum"] + jnp.sum(found["both"][0] ** 2)


WAYS = {
    "value": lambda f: f,
    "reverse": lambda f: jax.grad(lambda *v: total(f, *v), (0, 1)),
    "forward": lambda f: lambda *v: jax.jvp(lambda *w: total(f, *w), v, v),
    "second": lambda f: jax.hessian(lambda v, n: total(f, (v, v), n)),
    "one lane": lambda f: jax.vmap(f),
    "lanes": lambda f: jax.vmap(jax.vmap(f)),
    "gradients of lanes": lambda f: jax.vmap(jax.grad(lambda *v: total(f, *v), (0, 1))),
}
LANES = {"one lane": (1,), "lanes": (2, 3), "gradients of lanes": (4,)}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("way", WAYS)
def test_it_is_the_part(way, dtype):
    given = arguments(dtype, LANES.get(way, ()))
    if way == "second":
        given = given[0][0], given[1]
    program = jax.jit(WAYS[way](fuse(part))).lower(*given).compile()
    got, expected = program(*given), jax.jit(WAYS[way](part))(*given)
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, rtol=0, atol=64 * epsilon(dtype) * np.abs(b).max())
    assert (MARK in str(program.as_text())) == (way in ("value", "one lane"))


@pytest.mark.parametrize(
    ("f", "size", "fits"),
    [
        (jnp.sin, 1 << 16, True),
        (jnp.sin, (1 << 16) + 1, False),
        (jnp.sum, 4000, True),
        (jnp.max, 4001, False),
        (jnp.sort, 9, False),
        (lambda x: jax.jit(lambda x: x[:, None] @ x[None])(x), 9, False),
        (lambda x: x.at[3].set(2.0), 9, False),
        (lambda x: jnp.zeros((0, *x.shape)), 9, False),
    ],
)
def test_what_does_not_fit_is_compiled_as_it_stands(f, size, fits):
    """The compiler would refuse the program, or end the process."""
    x = jnp.linspace(0, 1, size)
    program = jax.jit(fuse(lambda x: f(x) + 0)).lower(x).compile()
    assert (MARK in str(program.as_text())) == fits
    np.testing.assert_allclose(program(x), f(x), rtol=1e-6)


@pytest.mark.parametrize("rows", [1, 4])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_one_row_after_the_other(rows, dtype):
    """Values and gradients are those of all rows together; of several there is a loop."""
    pair, n = arguments(dtype, (rows,))

    def summed(way):
        return lambda pair, n: jnp.sum(way(lambda v, n: jnp.sin(v[0] * v[1]) ** 2 * n, pair, n))

    def together(f, *given):
        return jax.vmap(f)(*given)

    program = jax.jit(jax.value_and_grad(summed(one_by_one), (0, 1))).lower(pair, n).compile()
    expected = jax.value_and_grad(summed(together), (0, 1))(pair, n)
    for a, b in zip(jax.tree.leaves(program(pair, n)), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=16 * epsilon(dtype) * np.abs(b).max())
    assert (" while(" in str(program.as_text())) == (rows > 1)


def test_without_kernels():
    """For programs that another compiler is to read."""
    program = "from jaxtrachea.fusion import fuse; assert fuse(abs) is abs"
    environment = os.environ | {"JAXTRACHEA_ONE_KERNEL": "0"}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)
