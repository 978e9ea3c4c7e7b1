"""Products of matrices written out: against NumPy's, in calls, loops and branches, and in lanes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxpr_as_fun, jaxprs_in_params
from late import late

from jaxtrachea._numerics import epsilon
from jaxtrachea._written_out import written_out
from jaxtrachea.fusion import fuse

pytestmark = pytest.mark.long

#: Products as `einsum` names them, and the sizes of the two.
PRODUCTS = {
    "i,i->": ((5,), (5,)),
    "ij,j->i": ((3, 20), (20,)),
    "i,j->ij": ((3,), (4,)),
    "j,ji->i": ((4,), (4, 3)),
    "ij,jk->ik": ((3, 4), (4, 2)),
    "bij,bjk->bik": ((5, 3, 4), (5, 4, 2)),
    "ibj,kjb->bik": ((3, 5, 4), (2, 4, 5)),
    "ijk,kjl->il": ((2, 3, 4), (4, 3, 2)),
    "bcij,bcj->bci": ((2, 3, 4, 5), (2, 3, 5)),
}

#: In the default suite: of one vector, of matrices in a batch.
FEW = ("i,i->", "bij,bjk->bik")


def numbers(*shapes, dtype="float64"):
    rng = np.random.default_rng(3)
    return [jnp.asarray(rng.normal(size=shape), dtype) for shape in shapes]


def names(jaxpr):
    """Every operation, also in what an operation holds."""
    inside = [v for eqn in jaxpr.eqns for v in jaxprs_in_params(eqn.params)]
    return {eqn.primitive.name for eqn in jaxpr.eqns}.union(*map(names, inside))


@pytest.mark.parametrize("what", [*FEW, *late(*(n for n in PRODUCTS if n not in FEW))])
def test_a_product_is_that_of_numpy(what):
    a, b = numbers(*PRODUCTS[what], dtype="float64")
    sums = written_out(jax.make_jaxpr(functools.partial(jnp.einsum, what))(a, b))
    assert "dot_general" not in names(sums.jaxpr)
    (got,) = jaxpr_as_fun(sums)(a, b)
    wanted = np.einsum(what, np.asarray(a, float), np.asarray(b, float))
    assert got.dtype == "float64"
    np.testing.assert_allclose(got, wanted, rtol=0, atol=40 * epsilon("float64"))


@jax.custom_jvp
def with_a_rule(A, x):
    return A @ x


with_a_rule.defjvp(lambda at, along: (with_a_rule(*at), along[0] @ at[1] + at[0] @ along[1]))


def many(A, x):
    """Products in a loop, a scan, a branch, a call and a function with a rule of its own."""
    x = lax.fori_loop(0, 3, lambda _, v: A @ v / 2, x)
    x, rows = lax.scan(lambda v, row: (jnp.tanh(A @ v) + row, row @ A), x, A)
    x = lax.while_loop(lambda v: jnp.max(jnp.abs(v)) > 1, lambda v: A @ v / 8, x)
    x = lax.cond(x[0] > 0, lambda v: A @ v, lambda v: A.T @ v, x)
    return with_a_rule(A, x), jax.jit(jnp.matmul)(rows, A)


def test_all_that_holds_a_product_is_rewritten():
    A, x = numbers((4, 4), (4,))
    sums = written_out(jax.make_jaxpr(many)(A, x))
    assert "dot_general" in names(jax.make_jaxpr(many)(A, x).jaxpr)
    assert "dot_general" not in names(sums.jaxpr)
    for got, wanted in zip(jaxpr_as_fun(sums)(A, x), many(A, x), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-13, atol=1e-14)


def compiled(f, *inputs):
    return jax.jit(f).lower(*inputs).compile().as_text()


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.usefixtures("on_the_cpu")
def test_a_single_call_is_one_kernel_and_lanes_are_the_librarys():
    """One lane is a single call, too; values and derivatives are those of the function."""
    A, x = numbers((4, 4), (4,), dtype="float64")
    one = fuse(many, products=True)
    lanes = jnp.stack([x, -x, 2 * x])
    single = compiled(jax.vmap(one, (None, 0)), A, lanes[:1])
    assert "dot(" not in single
    assert "dot(" in compiled(jax.vmap(one, (None, 0)), A, lanes)
    assert "dot(" in compiled(fuse(many), A, x)

    def slope(f):
        return jax.jit(lambda A, x, along: jax.jvp(f, (A, x), (jnp.sin(A), along)))

    def close(got, wanted):
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=500 * epsilon("float64"))

    close(jax.jit(one)(A, x), many(A, x))
    close(slope(one)(A, x, jnp.cos(x)), slope(many)(A, x, jnp.cos(x)))
    for f in (jax.vmap, lambda g, axes: jax.vmap(jax.vmap(g, axes), axes)):
        given = lanes if f is jax.vmap else lanes[None]
        close(jax.jit(f(one, (None, 0)))(A, given), f(many, (None, 0))(A, given))


REFUSED = {
    "many terms": lambda A, x: jnp.sin(A @ x),
    "many entries": lambda A, x: jnp.sin(A[:, :20] @ x[:20]),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_stays_with_the_library(what):
    """Also of its derivative: the compiler would refuse the program."""
    A, x = numbers((300, 100), (100,))
    part = REFUSED[what]

    def slope(f):
        return lambda A, x: jax.jvp(f, (A, x), (A, x))

    got, wanted = (jax.jit(slope(f))(A, x) for f in (fuse(part, products=True), part))
    for a, b in zip(got, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


def test_the_dtype_is_that_of_the_result():
    a, b = jnp.arange(4, dtype=jnp.int8) + 60, jnp.arange(4, dtype=jnp.int8) + 90

    def part(a, b):
        return jnp.matmul(a, b, preferred_element_type=jnp.int32) + jnp.int32(1)

    (got,) = jaxpr_as_fun(written_out(jax.make_jaxpr(part)(a, b)))(a, b)
    assert got.dtype == jnp.int32
    assert int(got) == 1 + sum((60 + i) * (90 + i) for i in range(4))
