"""Axial response: against a one-dimensional bar FEM."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.axial import stretch

X, LENGTH = np.array([10.0, 25.0, 40.0, 70.0]), 100.0
POSITIONS = [0.0, 1e-3, 7.0, 25.0, 55.0, 70.0, 99.0, 100.0]
SPRINGS = [(None, None), (2.0, None), (None, 0.05), (0.3, 1e4), (0.0, 0.4), (0.4, 0.0)]
jitted = jax.jit(stretch)


def fem(EA, s_c, force, k_A, k_B):
    """Bars between clamps, rings and C; springs at the ends (rigid: 1e12 times the bars)."""
    nodes = np.unique(np.concatenate([[0.0, LENGTH, s_c], X]))
    K = np.zeros((nodes.size, nodes.size))
    for e, (low, high) in enumerate(zip(nodes, nodes[1:], strict=False)):
        stiffness = EA[np.searchsorted(X, low, side="right")] / (high - low)
        K[e : e + 2, e : e + 2] += stiffness * np.array([[1, -1], [-1, 1]])
    free = np.ones(nodes.size, bool)
    for end, spring in ((0, k_A), (-1, k_B)):
        if spring is None:
            free[end] = False
        else:
            K[end, end] += spring
    f = np.where(nodes == s_c, force, 0.0)
    u = np.zeros(nodes.size)
    u[free] = np.linalg.solve(K[np.ix_(free, free)], f[free])
    at_A = k_A * u[0] if k_A is not None else -(K[0] @ u - f[0])
    return u[nodes == s_c][0], u[np.searchsorted(nodes, X)], at_A, u[[0, -1]]


@pytest.mark.parametrize("springs", SPRINGS)
@pytest.mark.parametrize("s_c", POSITIONS)
def test_against_bar_fem(s_c, springs):
    EA = np.array([4.0, 0.5, 8.0, 2.0, 1.0])
    u_C, u, force_A, of_ends = fem(EA, s_c, 0.7, *springs)
    end = {n: jnp.asarray(v) for n, v in zip(("k_A", "k_B"), springs, strict=True) if v is not None}
    got = jitted(*map(jnp.asarray, (X, LENGTH, EA, s_c, 0.7)), **end)
    scale = 1e-12 * (abs(u_C) + np.max(np.abs(u)))
    np.testing.assert_allclose(got.u_C, u_C, atol=scale)
    np.testing.assert_allclose(got.u, u, atol=scale)
    np.testing.assert_allclose([got.u_A, got.u_B], of_ends, atol=scale)
    if springs[0] is not None or s_c > 0:
        np.testing.assert_allclose(got.force_A, abs(force_A), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(got.force_A + got.force_B, 0.7, rtol=1e-14)


def uniform(s_c, dtype="float64"):
    def cast(v):
        return jnp.asarray(v, dtype)

    return jitted(cast(X), cast(LENGTH), cast(np.full(5, 3.9)), cast(s_c), cast(0.5))


def test_paper_formulas():
    """F_AC : F_BC = L_BC : L_AC and D_x = F / (E_L A_L (1/L_AC + 1/L_BC)) (paper eq. 2)."""
    got = uniform(30.0, "float64")
    assert all(v.dtype == "float64" for v in got)
    rtol = 10 * np.finfo("float64").eps
    np.testing.assert_allclose(got.force_A / got.force_B, 70 / 30, rtol=rtol)
    np.testing.assert_allclose(got.u_C, 0.5 / (3.9 * (1 / 30 + 1 / 70)), rtol=rtol)
    # Linear from C to each fixed end.
    expected = np.where(X <= 30, X / 30, (100 - X) / 70) * float(got.u_C)
    np.testing.assert_allclose(got.u, expected, rtol=rtol)


@functools.partial(jax.jit, static_argnums=2)
def on_a_spring(k, at, end):
    """Uniform bars with one end on a spring k, the other on one of 2 N/mm; slopes by k."""

    def run(k):
        place = at, jnp.asarray(0.5, k.dtype)
        springs = {end: k, "k_B" if end == "k_A" else "k_A": jnp.asarray(2.0, k.dtype)}
        bars = (jnp.asarray(v, k.dtype) for v in (X, LENGTH, np.full(5, 3.9)))
        return stretch(*bars, *place, **springs)

    name = "u_A" if end == "k_A" else "u_B"
    back = jax.grad(lambda k: getattr(run(k), name))(k)
    return *jax.jvp(run, (k,), (jnp.ones_like(k),)), back


@pytest.mark.parametrize("s_c", [4.0, 33.0])
@pytest.mark.parametrize("end", ["k_A", "k_B"])
def test_an_end_that_is_free_or_held(end, s_c):
    """Free: all that lies beyond C moves as C does. Held: not at all, as without a spring.

    The derivative at k = 0 by hand: with f = u_C = F (1 / k' + l / EA), l the way from C to the
    other end on its spring k', a weak spring takes k f of the force, so f falls by k f^2 / F and
    its end by the stretch on the way there, k f (s_c / EA), more.
    """
    F, EA, other = 0.5, 3.9, 2.0
    at = s_c if end == "k_A" else LENGTH - s_c
    name = "u_A" if end == "k_A" else "u_B"

    def run(k):
        return on_a_spring(jnp.asarray(k, "float64"), jnp.asarray(at, "float64"), end)

    (free, slope, pulled), (held, *_) = run(0.0), run(np.inf)
    f, rtol = F * (1 / other + (LENGTH - s_c) / EA), 20 * np.finfo("float64").eps
    np.testing.assert_allclose(free.u_C, f, rtol=rtol)
    beyond = X <= at if end == "k_A" else X >= at
    assert np.any(beyond) == (s_c > 10)
    for v in (*np.asarray(free.u)[beyond], getattr(free, name)):
        np.testing.assert_allclose(v, f, rtol=rtol)
    np.testing.assert_allclose(slope.u_C, -(f**2) / F, rtol=4 * rtol)
    by_end = -(f**2) / F - f * s_c / EA
    np.testing.assert_allclose(getattr(slope, name), by_end, rtol=4 * rtol)
    assert getattr(held, name) == 0
    np.testing.assert_allclose(getattr(run(1e-7)[0], name), f, rtol=1e-4)
    np.testing.assert_allclose(pulled, by_end, rtol=4 * rtol)


def test_contact_on_a_ring_and_vmap():
    """C on a ring moves with it, and the response is continuous there."""
    s = np.array([25.0 - 1e-9, 25.0, 25.0 + 1e-9])
    inputs = (jnp.asarray(v) for v in (X, LENGTH, [4.0, 0.5, 8.0, 2.0, 1.0], s, 1.0))
    found = jax.jit(jax.vmap(stretch, (None, None, None, 0, None)))(*inputs)
    got = jax.tree.map(np.asarray, found)
    np.testing.assert_allclose(got.u[1, 1], got.u_C[1], rtol=1e-14)
    np.testing.assert_allclose(got.u_C, got.u_C[1], rtol=1e-9)
    np.testing.assert_allclose(got.u, np.broadcast_to(got.u[1], (3, 4)), rtol=1e-9)


def test_derivatives_with_the_contact_on_a_ring():
    """One stiffness for all spans: rings do not matter; u_C = F s (L - s) / (EA L)."""
    rings = jnp.array([20.0, 40.0, 60.0])

    def u_C(s, shift):
        EA = jnp.full(4, 3.0)
        return stretch(rings + shift, jnp.array(100.0), EA, s, jnp.array(2.0)).u_C

    by_s, by_shift = jax.jit(jax.grad(u_C, argnums=(0, 1)))(jnp.array(40.0), jnp.zeros(3))
    np.testing.assert_allclose(by_s, 2 * (100 - 2 * 40) / (3 * 100), rtol=1e-12)
    np.testing.assert_allclose(by_shift, 0, atol=1e-12)
