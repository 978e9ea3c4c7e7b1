"""Block elimination, spans and the contact's place, against dense algebra and transfer matrices."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sections_linear import E, beam_shares, span_stiffness, wall_matrices

from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.sections import block
from jaxtrachea.mechanics.sections.contact import effective_place, place_on
from jaxtrachea.mechanics.sections.section import Shape, make_grid
from jaxtrachea.mechanics.sections.span import (
    Wall,
    make_forms,
    make_span,
    span_energy,
    span_forces,
    span_tangent,
)

WALL = {"Gt_L": 20.0, "Et_L": 1.2, "D_L": 3.5, "c_W": 0.7, "rho": 0.01}
P = WALL | {"R": 11.7, "alpha": 2.0}
#: From (parity, left or right, four q and three psi) to (left or right, q of 8, psi of 6).
PLACES = np.concatenate([np.r_[14 * e : 14 * e + 4, 14 * e + 8 : 14 * e + 11] for e in (0, 1)]
                        + [np.r_[14 * e + 4 : 14 * e + 8, 14 * e + 11 : 14 * e + 14]
                           for e in (0, 1)])  # fmt: skip


@functools.cache
def span(h=9.0):
    shape = Shape(jnp.asarray(P["R"]), jnp.asarray(0.9), jnp.asarray(P["alpha"]))
    wall = Wall(**{k: jnp.asarray(v) for k, v in WALL.items()})
    grid = make_grid(shape, midline=False)
    make = jax.jit(lambda h: make_span(wall, h, make_forms(grid, shape), shape))
    return make(jnp.asarray(h))


def random_blocks(n, m, indefinite):
    rng = np.random.default_rng(n + m)
    lower = [rng.normal(size=(m, m)) + 3 * np.eye(m) for _ in range(n)]
    D = [L @ L.T for L in lower]
    if indefinite:
        D = [L @ np.diag(rng.choice([-1, 1], m)) @ L.T for L in lower]
    U = [rng.normal(size=(m, m)) for _ in range(n - 1)]
    dense = np.zeros((n * m, n * m))
    for i in range(n):
        dense[m * i : m * i + m, m * i : m * i + m] = D[i]
    for i in range(n - 1):
        dense[m * i : m * i + m, m * i + m : m * i + 2 * m] = U[i]
        dense[m * i + m : m * i + 2 * m, m * i : m * i + m] = U[i].T
    return np.stack(D), np.stack([*U, np.zeros((m, m))]), dense


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("n", [2, 9])
@pytest.mark.parametrize("indefinite", [False, True])
@pytest.mark.parametrize(("m", "alone"), [(7, True), (14, False)])
def test_block_elimination_is_dense(m, alone, indefinite, n):
    """As single kernels or not; also of many lanes, whose products are the library's."""
    D, U, dense = random_blocks(n, m, indefinite)
    if not indefinite:
        shift = max(0, 1 - np.linalg.eigvalsh(dense)[0])
        D, dense = D + shift * np.eye(m), dense + shift * np.eye(n * m)
    rhs = np.random.default_rng(0).normal(size=(n, m, 2))

    def plain(D, U, rhs):
        factors = block.factor(D, U)
        return block.solve(factors, rhs), factors.negative

    both = fuse(plain, products=True) if alone else plain

    one = jax.jit(both)(*map(jnp.asarray, (D, U, rhs)))
    scaled = (jnp.stack([v / 2, v, 4 * v]) for v in (D, U))
    lanes = jax.jit(jax.vmap(both, (0, 0, None)))(*scaled, jnp.asarray(rhs))
    wanted = np.linalg.solve(dense, rhs.reshape(n * m, 2)).reshape(n, m, 2)
    tolerance = (1e-10 if indefinite else 1e-12) * np.abs(wanted).max()
    for x, negative in (one, (lanes[0][1], lanes[1][1]), (4 * lanes[0][2], lanes[1][2])):
        assert np.abs(x - wanted).max() <= tolerance
        assert int(negative) == np.sum(np.linalg.eigvalsh(dense) < 0)


def test_a_linear_span_is_exact():
    got = np.zeros((28, 28))
    got[:14, :14], got[14:, 14:] = span().stiffness
    A, C = wall_matrices(P)
    wanted = span_stiffness(A, C, E, 9.0)[np.ix_(PLACES, PLACES)]
    np.testing.assert_allclose(got, wanted, atol=1e-9 * np.abs(wanted).max())


def test_the_span_softens_and_its_tangent_is_the_derivative():
    """2 W_0 / (1 + sqrt(1 + 2 c W_0)), forces and tangent by AD; convex."""
    one = span()
    ends = jnp.asarray(np.random.default_rng(2).normal(size=(2, 14)) * np.repeat([1, 0.1], [8, 6]))

    @jax.jit
    def values(ends):
        by_ad = jax.grad(span_energy)(ends, one), jax.hessian(span_energy)(ends, one)
        return span_energy(ends, one), span_forces(ends, one), span_tangent(ends, one), by_ad

    W, force, (same, slope), (grad, hessian) = values(ends)
    linear = np.einsum("pij,pj->pi", one.stiffness, ends)
    W_0 = np.sum(linear * ends) / 2
    assert W_0 > 3  # far from linear
    assert float(W) == pytest.approx((np.sqrt(1 + 2 * WALL["c_W"] * W_0) - 1) / WALL["c_W"])
    for v in (force, same):
        np.testing.assert_allclose(v, grad, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(slope, hessian.reshape(28, 28), rtol=1e-9, atol=1e-9)
    values = np.linalg.eigvalsh(slope)
    assert values[0] > -1e-9 * values[-1]


def test_the_place_of_a_contact():
    """Shares and own compliance of each mode are those of a beam between two rings."""
    one = span()
    nodes = jnp.asarray([0.0, 9.0, 18.0])
    two = jax.tree.map(lambda v: jnp.stack([v, v]), one)
    A, C = wall_matrices(P)
    place = jax.jit(lambda s: place_on(nodes, s[None], two, jnp.asarray(1.0)))
    for s, x in ((9.0, 0.0), (9.4, 0.4), (13.5, 4.5), (17.0, 8.0), (18.0, 9.0)):
        got = place(jnp.asarray(s))
        np.testing.assert_array_equal(got.shares[0, 0], 0)
        for parity, modes in enumerate(((0, 1, 2, 3), (4, 5, 6, 7))):
            for k, mode in enumerate(modes):
                warp = np.flatnonzero(E[mode])
                c = C[warp[0], warp[0]] if warp.size else None
                share, own = beam_shares(A[mode, mode], c, 9.0, x)
                psi = [4 + warp[0] % 3] if warp.size else []
                full = np.zeros((2, 7))
                full[:, [k, *psi]] = share.reshape(2, -1)
                np.testing.assert_allclose(got.shares[0, 1:, parity, k], full, atol=1e-9)
                assert float(got.own[0, 0, parity, k]) == pytest.approx(own, rel=1e-8, abs=1e-15)


def test_a_round_tool_rests_on_the_ring():
    place = jax.jit(jax.vmap(effective_place, (0, None, None, None)))
    s = np.array([20.0, 21.0, 24.9, 25.0, 25.1, 29.0, 30.0])
    ends = jnp.asarray(20.0), jnp.asarray(30.0)
    np.testing.assert_allclose(place(jnp.asarray(s), *ends, jnp.asarray(1.0)), s, atol=1e-14)
    got = place(jnp.asarray(s), *ends, jnp.asarray(3.0))
    d = np.minimum(s - 20, 30 - s)
    moved = 5 * (d / 5) ** 3
    np.testing.assert_allclose(got, np.where(s <= 25, 20 + moved, 30 - moved), atol=1e-12)
    slope = jax.jit(jax.vmap(jax.grad(effective_place, (0, 3)), (0, None, None, None)))
    for exponent in (1.0, 3.0):
        assert np.all(np.isfinite(slope(jnp.asarray(s), *ends, jnp.asarray(exponent))))
