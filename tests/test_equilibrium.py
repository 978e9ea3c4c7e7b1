"""Local and global deformation together: closed forms, folds and status codes."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jitted import jitted

from jaxtrachea.mechanics.equilibrium import press_series, press_total
from jaxtrachea.mechanics.force_law import Law, duffing, fold_depth
from jaxtrachea.status import PressStatus

series, total = jitted(press_series), jitted(press_total)


def law(k_1, k_3, dtype="float64"):
    return Law(jnp.asarray(k_1, dtype), jnp.asarray(k_3, dtype))


def scalar(v, dtype="float64"):
    return jnp.asarray(v, dtype)


def exact_depth(D, c, k_1, k_3):
    """(1 + c k_1) d + c k_3 d^3 = D: hyperbolic and trigonometric solutions in 60 digits."""
    with mp.workdps(60):
        D, c, k_1, k_3 = (mp.mpf(float(v)) for v in (D, c, k_1, k_3))
        p, q = 1 + c * k_1, c * k_3
        if q == 0:
            return D / p
        r = mp.sqrt(p / (3 * abs(q)))
        argument = D / (2 * r * p) * 3
        if q > 0:
            return 2 * r * mp.sinh(mp.asinh(argument) / 3)
        return 2 * r * mp.sin(mp.asin(argument) / 3)


@pytest.mark.parametrize("k_3", [0.0, *10.0 ** np.arange(-30, 31, 6), -1e-30, -1e-6, -0.003])
def test_series_closed_form(k_3):
    """60 decades of k_3: a few units in the last place, in depth and force."""
    c, k_1 = 1.7, 0.3
    D = np.array([-3.0, -0.2, 1e-6, 0.5, 4.0]).astype("float64")
    args = [np.asarray(v, "float64") for v in (c, k_1, k_3)]
    got = series(np.asarray(D), scalar(c, "float64"), law(k_1, k_3, "float64"))
    depth = [exact_depth(d, *args) for d in D]
    force = [float(args[1]) * d + float(args[2]) * d**3 for d in depth]
    assert got.depth.dtype == got.force.dtype == "float64"
    rtol = 30 * np.finfo("float64").eps
    np.testing.assert_allclose(got.depth, np.array(depth, dtype=float), rtol=rtol)
    np.testing.assert_allclose(got.force, np.array(force, dtype=float), rtol=rtol)
    assert np.all(got.status == PressStatus.OK)
    assert got.status.dtype == jnp.int8
    # Local and global parts add up to the tool's displacement.
    np.testing.assert_allclose(got.depth + scalar(c, "float64") * got.force, D, rtol=2 * rtol)


@pytest.mark.parametrize("c", [0.0, 1e-9, 2.0, 1e9])
def test_series_limits_of_compliance(c):
    """Rigid skeleton: the law itself. Endlessly soft one: the skeleton alone, D / c."""
    D, local = np.asarray([0.1, 2.0]), law(0.4, 0.02)
    got = series(D, scalar(c), local)
    if c < 1e-6:
        np.testing.assert_allclose(got.force, 0.4 * D + 0.02 * D**3, rtol=1e-8)
    if c > 1e6:
        np.testing.assert_allclose(got.force, D / c, rtol=1e-8)


@pytest.mark.parametrize("c", [1e-3, 0.8, 30.0])
def test_series_fold(c):
    """The coupled fold: d* = sqrt((1 + c k_1)/(-3 c k_3)), D* = 2/3 (1 + c k_1) d*."""
    k_1, k_3 = 0.5, -0.02
    depth = np.sqrt((1 + c * k_1) / (-3 * c * k_3))
    fold = 2 / 3 * (1 + c * k_1) * depth
    # Near the fold d* - d ~ sqrt(1 - D / D*): rounding of D shows as its square root.
    slack = 20 * np.finfo("float64").eps
    D = np.asarray(fold * np.array([1 - slack, 1 + slack, -1 - slack, 3.0, 0.5]), "float64")
    got = series(D, scalar(c, "float64"), law(k_1, k_3, "float64"))
    expected = [PressStatus.OK, *[PressStatus.PAST_FOLD] * 3, PressStatus.OK]
    np.testing.assert_array_equal(got.status, expected)
    np.testing.assert_allclose(got.depth[0], depth, rtol=4 * np.sqrt(2 * slack))
    assert np.all(np.isnan(got.force[1:4]))
    assert np.all(np.isnan(got.depth[1:4]))


def test_total():
    """The law takes the whole displacement; what is left after the skeleton is the local part."""
    D = np.asarray([0.0, 0.5, 2.0, -2.0], "float64")
    local, c = law(0.3, 0.05, "float64"), scalar(1.2, "float64")
    got = total(D, c, local)
    np.testing.assert_array_equal(got.force, jitted(duffing)(D, local))
    np.testing.assert_allclose(got.depth, D - c * got.force, rtol=1e-6)
    np.testing.assert_array_equal(got.status, [PressStatus.NO_CONTACT, *[PressStatus.OK] * 3])
    assert got.force.dtype == got.depth.dtype == "float64"


def test_total_reports_a_negative_local_part():
    got = total(np.asarray([0.1, 5.0, -5.0]), scalar(2.0), law(0.3, 0.05))
    n = PressStatus.NEGATIVE_LOCAL
    np.testing.assert_array_equal(got.status, [PressStatus.OK, n, n])
    assert got.depth[1] < 0 < got.depth[2]
    assert np.all(np.isfinite(got.force))


def test_total_has_the_fold_of_the_law():
    local = law(0.5, -0.02)
    fold = fold_depth(local)
    got = total(fold * np.asarray([0.999, 1.0, 1.001, -2.0]), scalar(0.1), local)
    p = PressStatus.PAST_FOLD
    np.testing.assert_array_equal(got.status, [PressStatus.OK, p, p, p])
    assert np.all(np.isnan(got.force[1:]) & np.isnan(got.depth[1:]))


@pytest.mark.parametrize("press", [series, total])
def test_zero_displacement(press):
    got = press(np.zeros(2), scalar(1.0), law(0.3, 0.05))
    np.testing.assert_array_equal([got.force, got.depth], 0)
    np.testing.assert_array_equal(got.status, PressStatus.NO_CONTACT)


@pytest.mark.parametrize("press", [series, total])
@pytest.mark.parametrize(
    ("c", "k_1", "D"),
    [(np.nan, 0.3, 1.0), (1.0, np.nan, 1.0), (1.0, 0.3, np.nan), (1.0, 0.3, np.inf)],
)
def test_non_finite_inputs_are_flagged(c, k_1, D, press):
    """No status OK beside a number that is not one."""
    got = press(np.asarray([D]), scalar(c), law(k_1, 0.05))
    np.testing.assert_array_equal(got.status, PressStatus.NON_FINITE)


@pytest.mark.parametrize("press", [press_series, press_total])
def test_bad_rows_stay_alone(press):
    """NaN and folded rows under vmap: the bits of all other rows are unchanged."""
    D, c = jnp.asarray([0.5, 1.0, 1.5, 2.0]), jnp.full(4, 0.7)
    k_1, k_3 = jnp.full(4, 0.4), jnp.full(4, 0.02)
    run = jax.jit(jax.vmap(lambda D, c, a, b: press(D, c, Law(a, b))))
    good = run(D, c, k_1, k_3)
    bad = run(D.at[0].set(jnp.nan), c, k_1, k_3.at[2].set(-5.0))
    for one, two in zip(good[:3], bad[:3], strict=True):
        np.testing.assert_array_equal(one[jnp.asarray([1, 3])], two[jnp.asarray([1, 3])])
    ok = PressStatus.OK
    expected = [PressStatus.NON_FINITE, ok, PressStatus.PAST_FOLD, ok]
    np.testing.assert_array_equal(bad.status, expected)
    assert np.all(np.isnan(bad.force[jnp.asarray([0, 2])]))


@pytest.mark.parametrize("unit", [1e-3, 1e3])
@pytest.mark.parametrize("k_3", [0.04, -0.003])
@pytest.mark.parametrize("press", [series, total])
def test_units(press, k_3, unit):
    """Lengths in another unit: depth rescales, force does not."""
    D = np.asarray([0.3, 2.0])
    one = press(D, scalar(0.9), law(0.4, k_3))
    two = press(D * unit, scalar(0.9 * unit), law(0.4 / unit, k_3 / unit**3))
    np.testing.assert_allclose(two.depth, one.depth * unit, rtol=1e-13)
    np.testing.assert_allclose(two.force, one.force, rtol=1e-13)
