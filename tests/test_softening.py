"""A tube that softens in a deep press: forces in 40 digits, derivatives, the peak of the law."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax.test_util import check_grads
from jitted import jitted

from jaxtrachea.mechanics.equilibrium import press_series, press_softening, sensitivity
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

NAMES = ("displacement", "compliance", "k_1", "k_3", "e_1", "e_2")


softened = jitted(press_softening)


@jitted
@jax.vmap
def solve(D, c, k_1, k_3, e_1, e_2):
    return press_softening(D, c, Law(k_1, k_3), Softening(e_1, e_2))


def random_cases(n, dtype, seed=0):
    """D, c, k_1, k_3, e_1, e_2 over many decades; draws and presses, with and without a peak."""
    rng = np.random.default_rng(seed)
    k_3 = 10 ** rng.uniform(-4, 2, n) * (rng.random(n) < 0.7)
    rows = (
        rng.uniform(-3, 8, n), 10 ** rng.uniform(-4, 4, n), 10 ** rng.uniform(-3, 3, n), k_3,
        rng.uniform(-0.2, 0.3, n), rng.uniform(0, 0.05, n),
    )  # fmt: skip
    return [v.astype(dtype) for v in rows]


def exact(D, c, k_1, k_3, e_1, e_2):
    """Depth, load and force by bisection in 40 digits, and the condition of the ratio.

    None past the peak of D r(D), found on 4000 points of the way: independent of the closed form.
    """
    with mp.workdps(40):
        D, c, k_1, k_3, e_1, e_2 = (mp.mpf(float(v)) for v in (D, c, k_1, k_3, e_1, e_2))
        sign = -1 if D < 0 else 1
        D, e_1 = abs(D), sign * e_1
        way = np.linspace(0, float(D), 4001)
        carried = way * (1 - float(e_1) * way + float(e_2) * way**2)
        if np.any(np.diff(carried) < 0):
            return None
        low, high = mp.mpf(0), D
        for _ in range(140):
            middle = (low + high) / 2
            less = middle + c * (k_1 * middle + k_3 * middle**3) < D
            low, high = (middle, high) if less else (low, middle)
        ratio, load = 1 - e_1 * D + e_2 * D**2, k_1 * low + k_3 * low**3
        terms = 1 + abs(e_1) * D + e_2 * D**2
        return sign * low, sign * load, sign * load * ratio, terms / ratio


@pytest.mark.parametrize("many", ["k_3", "e_1"])
def test_one_displacement_and_many_values(many):
    """What has rows gives the result its shape, whichever it is."""
    given = {"D": 4.0, "c": 0.5, "k_1": 1.0, "k_3": 0.1, "e_1": 0.05, "e_2": 0.01}
    rows = [given | {many: v} for v in (0.03, 0.06)]
    D, c, k_1, k_3, e_1, e_2 = (np.asarray(v) for v in (given | {many: [0.03, 0.06]}).values())
    got = softened(D, c, Law(k_1, k_3), Softening(e_1, e_2))
    for i, row in enumerate(rows):
        np.testing.assert_allclose(
            np.asarray(got.force)[i], float(exact(*row.values())[2]), rtol=1e-14
        )


@pytest.mark.slow
@pytest.mark.compiling
def test_roots():
    """All three to a few roundings relative to themselves, however unequal; peaks are told."""
    cases = random_cases(400, "float64")
    got = solve(*cases)
    eps, folded = np.finfo("float64").eps, 0
    for i, row in enumerate(zip(*cases, strict=True)):
        truth = exact(*row)
        if truth is None:
            folded += 1
            assert got.status[i] == PressStatus.PAST_FOLD
            assert all(np.isnan(v[i]) for v in (got.depth, got.load, got.force))
            continue
        assert got.status[i] == PressStatus.OK
        for value, true in zip((got.depth, got.load, got.force), truth[:3], strict=True):
            error = abs(mp.mpf(float(value[i])) - true) / abs(true)
            assert error < 8 * eps * max(1, truth[3]), (i, row)
    assert 5 < folded < 100


def test_a_row_knows_nothing_of_its_neighbours():
    """Bit for bit among others; to rounding by itself, which is a program of its own."""
    cases, others = (random_cases(40, "float64", seed=seed) for seed in (1, 2))
    rows, keeps = [0, 17, 33], np.isin(np.arange(40), [0, 17, 33])
    together = np.array(solve(*cases)[:2])[:, rows]
    mixed = solve(*(np.where(keeps, v, w) for v, w in zip(cases, others, strict=True)))
    np.testing.assert_array_equal(np.array(mixed[:2])[:, rows], together)
    for i, found in zip(rows, together.T, strict=True):
        alone = np.array(solve(*(v[i : i + 1] for v in cases))[:2])[:, 0]
        np.testing.assert_allclose(alone, found, rtol=4 * np.finfo(float).eps)


def test_linear_limit():
    """e_1 = e_2 = 0 is the linear skeleton, to rounding."""
    D, c, k_1, k_3, _, _ = random_cases(300, "float64")
    zero = np.zeros_like(D)
    got = solve(D, c, k_1, k_3, zero, zero)
    linear = jitted(jax.vmap(lambda D, c, k_1, k_3: press_series(D, c, Law(k_1, k_3))))
    want = linear(D, c, k_1, k_3)
    rtol = 20 * np.finfo("float64").eps
    np.testing.assert_allclose(got.depth, want.depth, rtol=rtol)
    np.testing.assert_allclose(got.force, want.force, rtol=rtol)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("D", [3.0, 0.0])
def test_derivatives(D):
    """Forward, reverse and second order against differences; `sensitivity` is the forward one."""
    args = [jnp.asarray(v) for v in (D, 0.8, 1.2, 0.1, 0.1127, 0.0061)]

    def pressed(D, c, k_1, k_3, e_1, e_2):
        return press_softening(D, c, Law(k_1, k_3), Softening(e_1, e_2))

    def values(*args):
        solved = pressed(*map(jnp.asarray, args))
        return solved.depth, solved.force, solved.load

    check_grads(jax.jit(values), args, 2, rtol=1e-4)
    columns = tuple(range(len(args)))
    _, force, load = jax.jacfwd(values, columns)(*args)
    law, softening = Law(*args[2:4]), Softening(*args[4:])
    by_force, by_load = sensitivity(pressed(*args), args[1], law, softening)
    for i, name in enumerate(NAMES):
        np.testing.assert_allclose(by_force[name], force[i], rtol=1e-12, atol=1e-15, err_msg=name)
        np.testing.assert_allclose(by_load[name], load[i], rtol=1e-12, atol=1e-15, err_msg=name)


def test_the_peak_is_where_the_law_turns():
    """D r(D) on a fine grid; both signs of e_1, a draw and a press, and no peak at all."""
    way = np.linspace(0, 12, 120_001)
    past = jax.jit(lambda e_1, e_2, D: Softening(e_1, e_2).past_peak(D))
    for e_1, e_2 in ((0.2, 0.012), (0.11, 0.0), (-0.2, 0.012), (0.1, 0.0061)):
        for sign in (1, -1):
            D = sign * way
            falls = np.flatnonzero(np.diff(way * (1 - e_1 * D + e_2 * D * D)) < 0)
            peak = way[falls[0]] if len(falls) else 11.0
            near = sign * peak * np.array([0.999, 1.001])
            assert past(e_1, e_2, near).tolist() == [False, len(falls) > 0]


@pytest.mark.slow
@pytest.mark.compiling
def test_past_the_fold():
    """Softening to a peak at D = 1/(2 e_1): no row beyond it, gradients finite."""
    law, softening = Law(jnp.asarray(1e6), jnp.asarray(0.0)), Softening(0.25, 0.0)
    D = jnp.array([1.9, 1.99, 2.01, 5.0, -5.0])
    got = press_softening(D, jnp.asarray(1.0), law, softening)
    folded = [PressStatus.OK] * 2 + [PressStatus.PAST_FOLD] * 2 + [PressStatus.OK]
    assert got.status.tolist() == folded
    assert np.isnan(got.force[2:4]).all()
    # A rigid contact: the skeleton's own law.
    truth = np.asarray(D) * (1 - 0.25 * np.asarray(D))
    np.testing.assert_allclose(got.force[jnp.array([0, 1, 4])], truth[[0, 1, 4]], rtol=1e-5)

    def total(e_1):
        solved = press_softening(D, jnp.asarray(1.0), law, Softening(e_1, 0.0))
        return jnp.sum(jnp.where(solved.status == PressStatus.OK, solved.force, 0))

    slope = jax.grad(total)(0.25)
    np.testing.assert_allclose(slope, -np.sum(np.array([1.9, 1.99, -5.0]) ** 2), rtol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_not_finite(bad):
    law, softening = Law(np.asarray(1.0), np.asarray(0.1)), Softening(0.1, 0.01)
    got = softened(np.array([1.0, bad]), np.asarray(1.0), law, softening)
    assert got.status.tolist() == [PressStatus.OK, PressStatus.NON_FINITE]


def test_not_finite_is_no_fold():
    """A row of which anything is not finite is NON_FINITE; its derivatives are 0, not NaN."""
    rows = np.tile([1.0, 0.8, 1.2, 0.1, 0.1127, 0.0061], (13, 1))
    rows[1:7][np.eye(6, dtype=bool)] = np.nan
    rows[7:][np.eye(6, dtype=bool)] = np.inf

    @jax.vmap
    def pressed(row):
        D, c, k_1, k_3, e_1, e_2 = row
        return press_softening(D, c, Law(k_1, k_3), Softening(e_1, e_2))

    def total(rows):
        solved = pressed(rows)
        return jnp.sum(jnp.where(solved.status == PressStatus.OK, solved.force, 0)), solved

    run = jax.jit(jax.grad(total, has_aux=True))
    slope, got = run(rows)
    assert got.status.tolist() == [PressStatus.OK, *[PressStatus.NON_FINITE] * 12]
    assert np.isfinite(got.force[0])
    assert np.all(np.isnan(got.force[1:]))
    np.testing.assert_array_equal(slope[1:], 0)
    np.testing.assert_array_equal(slope[0], run(np.tile(rows[:1], (13, 1)))[0][0])


@pytest.mark.slow
@pytest.mark.compiling
def test_press():
    """In `press` the joints follow the deflection of C, the rings and the tool the softer force."""
    material = Material(
        *(jnp.asarray(v, "float64") for v in (40.0, 0.1, 0.6, 0.02)),
        e_1=jnp.asarray(0.11, "float64"), e_2=jnp.asarray(0.006, "float64"),
    )  # fmt: skip
    geometry = table_1(dtype="float64")
    options = Options(skeleton="softening", contact="bonded")
    D = jnp.linspace(0, 6, 2001).astype("float64")
    got = jax.jit(lambda D: press(geometry, material, 75.0, D, options))(D)
    linear = jax.jit(lambda: press(geometry, material, 75.0, 1.0, Options(contact="bonded")))()
    rtol = 60 * np.finfo("float64").eps
    np.testing.assert_allclose(got.depth + got.skeleton, D, rtol=rtol, atol=rtol)
    shape = linear.joints / linear.skeleton
    joints = np.outer(got.skeleton, shape)
    np.testing.assert_allclose(got.joints, joints, rtol=rtol, atol=1e-9)
    reactions = np.outer(got.force, linear.reactions / linear.force)
    np.testing.assert_allclose(got.reactions, reactions, rtol=rtol, atol=1e-9)
    F, d, D_ = (np.asarray(v, np.float64) for v in (got.force, got.depth, D))
    np.testing.assert_allclose(
        F, (0.6 * d + 0.02 * d**3) * (1 - 0.11 * D_ + 0.006 * D_**2), rtol=rtol, atol=1e-9
    )
    one = jax.vmap(lambda D: press(geometry, material, 75.0, D, options).force)(D[::500])
    np.testing.assert_allclose(one, got.force[::500], rtol=rtol)


def test_options():
    with pytest.raises(ValueError, match="coupling='series'"):
        Options(skeleton="softening", coupling="total")
    with pytest.raises(ValueError, match="Material.e_1"):
        press(table_1(), Material(40.0, 0.1, 0.6, 0.02), 75.0, 1.0, Options(skeleton="softening"))
