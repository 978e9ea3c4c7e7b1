"""Oblique press: against SciPy's root and 60 digits, then folds, gradients and lanes."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.optimize
from jitted import jitted

from jaxtrachea.mechanics.equilibrium import press_series
from jaxtrachea.mechanics.force_law import Law, duffing
from jaxtrachea.mechanics.vector_equilibrium import press_vector, press_vector_total
from jaxtrachea.status import PressStatus

solve = jitted(press_vector)
lanes = jitted(jax.vmap(lambda D, C, a, b: press_vector(D, C, Law(a, b))))
C_FULL = np.array([[3.0, 0.5, 0.2], [0.5, 1.0, 0.1], [0.2, 0.1, 0.3]])


def cast(dtype, *values):
    return tuple(jnp.asarray(v, dtype) for v in values)


def law(k_1, k_3, dtype="float64"):
    return Law(*cast(dtype, k_1, k_3))


@functools.cache
def random_cases(count=200, decades=6):
    """D, C with axes in any direction, k_1 and k_3, as float32 numbers."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    c = 10 ** rng.uniform(-decades / 2, decades / 2, (count, 3))
    C = np.einsum("nij,nj,nkj->nik", axes, c, axes)
    C = (C + C.mT) / 2 + 1e-4 * np.max(c, 1)[:, None, None] * np.eye(3)
    k = 10 ** rng.uniform(-2, 2, count), 10 ** rng.uniform(-9, 9, count)
    return tuple(np.float32(v) for v in (rng.normal(size=(count, 3)), C, *k))


def exact(D, C, k_1, k_3):
    """Depth in 60 digits: bisection on kappa, which rises from k_1 to at most k_1 + k_3 |D|^2."""
    with mp.workdps(60):
        D, C = mp.matrix(D.astype(float)), mp.matrix(C.astype(float).tolist())
        k_1, k_3 = mp.mpf(float(k_1)), mp.mpf(float(k_3))

        def depth(kappa):
            return mp.lu_solve(mp.eye(3) + kappa * C, D)

        low, high = k_1, k_1 + k_3 * mp.norm(D) ** 2
        for _ in range(120):
            middle = mp.sqrt(low * high)
            if k_1 + k_3 * mp.norm(depth(middle)) ** 2 > middle:
                low = middle
            else:
                high = middle
        return np.array([float(v) for v in depth(low)])


@pytest.mark.slow
@pytest.mark.compiling
def test_any_compliance():
    """12 decades of stiffness, 4 of compliance: rounding times the condition of M = 1 + kappa C.

    A Cholesky solve is exact for a matrix that differs from M by at most n gamma_{3n+1} |M|
    (Higham 2002, thm. 10.3): 15 eps for n = 3, and one more for forming M.
    """
    cases = random_cases()
    got = lanes(*cast("float64", *cases))
    assert got.depth.dtype == got.force.dtype == "float64"
    assert np.all(got.status == PressStatus.OK)
    for i in range(0, 200, 10):
        _, C, k_1, k_3 = (np.asarray(v[i], float) for v in cases)
        truth = exact(*(v[i] for v in cases))
        M = np.eye(3) + (k_1 + k_3 * truth @ truth) * C
        error = np.linalg.norm(np.asarray(got.depth[i], float) - truth) / np.linalg.norm(truth)
        assert error <= 16 * np.finfo("float64").eps * np.linalg.cond(M)


@pytest.mark.parametrize("k_3", [0.0, 0.05, 3.0, -0.01])
def test_against_scipy(k_3):
    D, k_1 = np.array([0.6, -1.7, 0.4]), 0.3

    def force(d):
        return (k_1 + k_3 * d @ d) * d

    found = scipy.optimize.root(lambda d: d + C_FULL @ force(d) - D, D / 3, tol=1e-13)
    got = solve(*cast("float64", D, C_FULL), law(k_1, k_3))
    np.testing.assert_allclose(got.depth, found.x, rtol=1e-10)
    np.testing.assert_allclose(got.force, force(found.x), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.compiling
def test_along_an_axis_it_is_press_series():
    C, ways = np.diag([2.0, 1.7, 0.4]), (-2.0, 1e-6, 0.5, 3.0)
    for k_3, D in itertools.product((0.0, 1e-9, 0.1, 1e9, -0.003), ways):
        local = law(0.3, k_3, "float64")
        got = jax.tree.map(np.asarray, solve(*cast("float64", [0, D, 0], C), local))
        one = jax.tree.map(np.asarray, press_series(*cast("float64", D, 1.7), local))
        rtol = 20 * np.finfo("float64").eps
        np.testing.assert_allclose(got.depth, [0, one.depth, 0], rtol=rtol)
        np.testing.assert_allclose(got.force, [0, one.force, 0], rtol=rtol)


def fold(D, k_1, k_3):
    """Where |D| turns back along d(kappa): the length of D there, over the given one."""
    c, axes = np.linalg.eigh(C_FULL)
    parts = axes.T @ D

    def length(kappa):
        unit = np.sqrt(np.sum((parts / (1 + kappa * c)) ** 2))
        return -np.sqrt((k_1 - kappa) / -k_3) / unit

    found = scipy.optimize.minimize_scalar(
        length, bounds=(-0.99 / c[-1], k_1), method="bounded", options={"xatol": 1e-12}
    )
    return -found.fun


def test_fold():
    """Flagged from the fold on, at most 3e-6 of |D| before it (float32: 1e-4)."""
    D, k_1, k_3 = np.array([0.6, 0.7, 0.4]), 0.3, -0.02
    early = 3e-6
    scale = fold(D, k_1, k_3) * np.array([0.5, 1 - early, 1 + early, 2.0, -3.0])
    full = (np.broadcast_to(v, (5, *np.shape(v))) for v in (C_FULL, k_1, k_3))
    got = lanes(*cast("float64", scale[:, None] * D, *full))
    wanted = [PressStatus.OK] * 2 + [PressStatus.PAST_FOLD] * 3
    np.testing.assert_array_equal(got.status, wanted)
    assert np.all(np.isnan(got.force[2:]) & np.isnan(got.depth[2:]))
    assert np.all(np.isfinite(got.force[:2]))


def test_no_displacement():
    """Zero, exactly, and the stiffness (C + 1/k_1)^-1 of both parts in series."""
    C, zero = cast("float64", C_FULL, np.zeros(3))
    local = law(0.3, 0.1, "float64")
    got = solve(zero, C, local)
    np.testing.assert_array_equal([got.depth, got.force], 0)
    assert got.status == PressStatus.NO_CONTACT
    wanted = np.linalg.inv(C_FULL + np.eye(3) / 0.3)
    for of in (jax.jacfwd, jax.jacrev):
        stiffness = np.asarray(jitted(of(lambda D: press_vector(D, C, local).force))(zero))
        np.testing.assert_allclose(stiffness, wanted, rtol=200 * np.finfo("float64").eps)


def test_flat_and_rigid_skeleton():
    """C of rank one and zero: without compliance the law alone, |F| = k_1 |d| + k_3 |d|^3."""
    D = jnp.asarray([0.5, -1.0, 0.2])
    rigid = solve(D, jnp.zeros((3, 3)), law(0.4, 0.2))
    np.testing.assert_allclose(rigid.depth, D, rtol=1e-15)
    size = jnp.linalg.norm(D)
    np.testing.assert_allclose(jnp.linalg.norm(rigid.force), duffing(size, law(0.4, 0.2)))
    flat = solve(D, jnp.zeros((3, 3)).at[0, 0].set(2.0), law(0.4, 0.2))
    np.testing.assert_allclose(flat.depth[1:], D[1:], rtol=1e-15)


def _values(v):
    got = press_vector(v["D"], v["C"], Law(v["k_1"], v["k_3"]))
    return jnp.concatenate([got.depth, got.force])


forward_of, reverse_of = jitted(jax.jacfwd(_values)), jitted(jax.jacrev(_values))
value_of = jitted(_values)


@pytest.mark.parametrize("k_3", [0.0, 0.7, -0.01])
def test_gradients(k_3):
    """Forward = reverse = central differences (these in float64) in a random direction of each."""
    rng = np.random.default_rng(3)
    point = {"D": np.array([0.6, -1.7, 0.4]), "C": C_FULL, "k_1": 0.3, "k_3": k_3}
    here = {n: np.asarray(v, "float64") for n, v in point.items()}
    forward, reverse = forward_of(here), reverse_of(here)
    tolerance = 100 * np.finfo("float64").eps
    for name, v in point.items():
        size = np.max(np.abs(forward[name]))
        np.testing.assert_allclose(forward[name], reverse[name], rtol=0, atol=tolerance * size)
        direction = rng.normal(size=np.shape(v))
        direction = direction + direction.T if name == "C" else direction
        up, down = (
            value_of(
                {
                    n: np.asarray(p, "float64")
                    for n, p in (point | {name: v + e * direction}).items()
                }
            )
            for e in (1e-6, -1e-6)
        )
        along = np.tensordot(np.asarray(forward[name], float), direction, np.ndim(v))
        close = max(tolerance, 1e-8) * max(size, 1)
        np.testing.assert_allclose(along, (up - down) / 2e-6, atol=close, rtol=0)


def test_bad_lanes_stay_alone():
    """NaN, infinite and folded lanes: the bits of the others are unchanged."""
    D, C, k_1, k_3 = (v[:5] for v in cast("float64", *random_cases()))
    good = lanes(D, C, k_1, k_3)
    bad = lanes(D.at[0, 1].set(jnp.nan), C.at[3].set(jnp.inf), k_1, k_3.at[2].set(-1e9))
    for one, two in zip(good, bad, strict=True):
        np.testing.assert_array_equal(one[jnp.asarray([1, 4])], two[jnp.asarray([1, 4])])
    ok, no = PressStatus.OK, PressStatus.NON_FINITE
    np.testing.assert_array_equal(bad.status, [no, ok, PressStatus.PAST_FOLD, no, ok])
    assert np.all(np.isnan(bad.force[jnp.asarray([0, 2, 3])]))


def test_total():
    """As printed: the law takes all of D; the skeleton may then outrun the tool."""
    D, local = np.array([0.3, -0.4, 0.0]), law(0.2, 0.4)
    run = jitted(press_vector_total)
    got = run(*cast("float64", D, C_FULL), local)
    np.testing.assert_allclose(got.force, (0.2 + 0.4 * 0.25) * D, rtol=1e-14)
    # The third is 0 by cancellation: to the rounding of what cancels.
    met = np.asarray(got.depth) + np.asarray(C_FULL) @ np.asarray(got.force)
    np.testing.assert_allclose(met, D, rtol=1e-14, atol=np.finfo(float).eps * np.abs(D).max())
    outrun = run(*cast("float64", 5 * D, C_FULL), local)
    assert outrun.status == PressStatus.NEGATIVE_LOCAL
    folded = run(*cast("float64", 5 * D, C_FULL), law(0.2, -0.4))
    assert folded.status == PressStatus.PAST_FOLD
    assert np.all(np.isnan(folded.force))
