"""A law with k_5 through everything that presses, against independent solutions."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.optimize
from jitted import jitted

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.structure import structure
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.equilibrium import press_series, press_total
from jaxtrachea.mechanics.force_law import Law, blend, coefficient, fold_depth
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.vector_equilibrium import press_vector, press_vector_total
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

C_FULL = np.array([[1.5, 0.3, -0.2], [0.3, 0.8, 0.1], [-0.2, 0.1, 2.2]])
#: k_1, k_3, k_5: hardening, as silicone (dips, then hardens), linear, all but k_5, softening.
LAWS = [(0.3, 0.02, 0.004), (0.5, -0.08, 0.012), (0.4, 0.0, 1e-12), (1e-3, 1e-6, 5.0),
        (0.5, 0.03, -2e-4)]  # fmt: skip
series, total, folds, mixed = map(jitted, (press_series, press_total, fold_depth, blend))
vectors = jitted(press_vector)


def law(k, dtype="float64"):
    return Law(*(jnp.asarray(v, dtype) for v in k))


def number(v, dtype="float64"):
    return np.asarray(v, dtype)


def exact_depth(D, c, k):
    """Smallest root of d + c F(d) = |D| in 60 digits, with the sign of D."""
    with mp.workdps(60):
        D, c, k_1, k_3, k_5 = (mp.mpf(float(v)) for v in (D, c, *k))
        rising = [-abs(D), 1 + c * k_1, 0, c * k_3, 0, c * k_5]
        while rising[-1] == 0:
            rising.pop()
        roots = mp.polyroots(rising, maxsteps=500, extraprec=900, asc=True)
        real = [mp.re(r) for r in roots if abs(mp.im(r)) <= mp.mpf(10) ** -25 * abs(r)]
        return mp.sign(D) * min(r for r in real if r >= 0)


@pytest.mark.parametrize("k", LAWS)
def test_series(k):
    """Depth and force to a few units in the last place; both parts add up to D."""
    c, D = 1.7, np.array([-3.0, -0.2, 1e-6, 0.5, 4.0]).astype("float64")
    used = [np.asarray(v, "float64") for v in k]
    got = series(D, number(c, "float64"), law(k, "float64"))
    depth = [exact_depth(d, np.asarray(c, "float64"), used) for d in D]
    force = [sum(float(v) * d ** (2 * i + 1) for i, v in enumerate(used)) for d in depth]
    assert got.depth.dtype == got.force.dtype == "float64"
    rtol = 60 * np.finfo("float64").eps
    np.testing.assert_allclose(got.depth, np.array(depth, float), rtol=rtol)
    np.testing.assert_allclose(got.force, np.array(force, float), rtol=rtol)
    np.testing.assert_allclose(got.depth + number(c, "float64") * got.force, D, rtol=2 * rtol)
    assert np.all(got.status == PressStatus.OK)


def test_without_its_last_coefficient_it_is_the_cubic_law():
    """k_5 = 0 by Newton steps, None by the closed form: the same to rounding; folds too."""
    D, c = np.linspace(-6, 6, 25, dtype="float64"), number(0.8, "float64")
    for k_3 in (0.0, 0.05, 1e6, -0.05):
        cubic, quintic = law((0.4, k_3), "float64"), law((0.4, k_3, 0.0), "float64")
        one, two = series(D, c, cubic), series(D, c, quintic)
        rtol = 40 * np.finfo("float64").eps
        np.testing.assert_allclose(two.force, one.force, rtol=rtol)
        np.testing.assert_array_equal(two.status, one.status)
        np.testing.assert_allclose(folds(quintic), folds(cubic), rtol=rtol)
    assert np.any(one.status == PressStatus.PAST_FOLD)
    assert law((0.4, 0.1)).coefficients().keys() == {"k_1", "k_3"}


def test_the_cubic_program_has_nothing_of_it():
    """No loop of Newton steps where k_5 is None, one where it is there."""

    def text(k):
        return str(jax.make_jaxpr(press_series)(number(1.0), number(1.0), law(k)))

    assert "while" not in text((0.4, 0.1))
    assert "while" in text((0.4, 0.1, 0.1))


@pytest.mark.parametrize("k", [(0.5, -0.2, 0.003), (0.5, 0.03, -0.01), (0.5, 0.0, -1e-3)])
@pytest.mark.parametrize("c", [0.3, 4.0])
def test_fold(c, k):
    """Where 1 + c F' first becomes 0: solved before, NaN and flagged after; by a scan of d."""
    d = np.linspace(0, 20, 2_000_001)
    rises = 1 + c * (k[0] + 3 * k[1] * d**2 + 5 * k[2] * d**4)
    at = d[np.argmax(rises <= 0)]
    D = at + c * (k[0] * at + k[1] * at**3 + k[2] * at**5)
    got = series(D * np.array([0.5, 1 - 1e-6, 1 + 1e-6, -2.0]), number(c), law(k))
    ok, past = PressStatus.OK, PressStatus.PAST_FOLD
    np.testing.assert_array_equal(got.status, [ok, ok, past, past])
    np.testing.assert_allclose(got.depth[1], at, rtol=5e-3)
    assert np.all(np.isnan(got.force[2:]) & np.isnan(got.depth[2:]))


def test_total_has_the_fold_of_the_law():
    """k_1 + 3 k_3 d^2 + 5 k_5 d^4 = 0 by SciPy; a law that dips but still rises has none."""
    k = (0.5, -0.2, 0.01)

    def slope(d):
        return k[0] + 3 * k[1] * d**2 + 5 * k[2] * d**4

    at = scipy.optimize.brentq(slope, 0.5, 1.5, xtol=1e-15)
    np.testing.assert_allclose(folds(law(k)), at, rtol=1e-12)
    got = total(at * np.array([0.999, 1.001, 9.0]), number(0.1), law(k))
    ok, past = PressStatus.OK, PressStatus.PAST_FOLD
    np.testing.assert_array_equal(got.status, [ok, past, past])
    assert folds(law((0.5, -0.08, 0.012))) == np.inf
    D = np.array([0.4, -3.0, 0.0])
    free = total(D, number(0.0), law((0.5, -0.08, 0.012)))
    np.testing.assert_allclose(free.force, 0.5 * D - 0.08 * D**3 + 0.012 * D**5, rtol=1e-14)
    folded = jax.jit(press_vector_total)(np.array([0.0, 1.3, 0.0]), np.zeros((3, 3)), law(k))
    assert folded.status == past


def in_series(v):
    return press_series(v["D"], v["c"], Law(v["k_1"], v["k_3"], v["k_5"]))[:2]


def as_vector(v):
    D = v["D"] * jnp.asarray([0.6, -0.7, 0.3])
    return press_vector(D, jnp.asarray(C_FULL) * v["c"], Law(v["k_1"], v["k_3"], v["k_5"]))[:2]


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("press", [in_series, as_vector])
def test_derivatives(press):
    """Forward = reverse = central differences, by every input, through `vmap` and `jit`."""
    k = LAWS[1]
    point = {"D": 1.4, "c": 0.9, "k_1": k[0], "k_3": k[1], "k_5": k[2]}
    here = {n: jnp.asarray(v) for n, v in point.items()}
    forward = jax.jit(jax.jacfwd(press))(here)
    reverse = jax.jit(jax.jacrev(press))(here)
    run = jax.jit(jax.vmap(press))
    for name, v in point.items():
        step = 1e-5 * max(abs(v), 1e-2)
        around = {n: jnp.full(2, p) for n, p in point.items()}
        around[name] = jnp.asarray([v - step, v + step])
        for one, two, both in zip(forward, reverse, run(around), strict=True):
            np.testing.assert_allclose(one[name], two[name], rtol=1e-10, atol=1e-12)
            difference = (both[1] - both[0]) / (2 * step)
            scale = np.max(np.abs(difference)) + 1e-3
            np.testing.assert_allclose(one[name], difference, rtol=1e-6, atol=1e-7 * scale)


@pytest.mark.parametrize("k", LAWS)
def test_vectors_against_scipy(k):
    D = np.array([0.6, -1.2, 0.4])

    def force(d):
        return (k[0] + k[1] * (d @ d) + k[2] * (d @ d) ** 2) * d

    known = scipy.optimize.root(lambda d: d + C_FULL @ force(d) - D, D / 3, tol=1e-13)
    got = vectors(D, C_FULL, law(k))
    np.testing.assert_allclose(got.depth, known.x, rtol=1e-9)
    np.testing.assert_allclose(got.force, force(known.x), rtol=1e-9)
    assert got.status == PressStatus.OK


def test_a_vector_along_an_axis_is_the_scalar():
    C = np.diag([2.0, 1.7, 0.4]).astype("float64")
    for k in LAWS[:4]:
        for size in (-2.0, 1e-6, 3.0):
            D = number(size, "float64")
            got = vectors(D * np.eye(3, dtype="float64")[1], C, law(k, "float64"))
            one = series(D, C[1, 1], law(k, "float64"))
            np.testing.assert_allclose(got.depth[1], one.depth, rtol=60 * np.finfo("float64").eps)
            assert got.depth[0] == got.depth[2] == 0
    far = vectors(number([9.0, 0, 0], "float64"), C, law((0.5, 0.03, -0.01), "float64"))
    assert far.status == PressStatus.PAST_FOLD


def test_bad_rows_stay_alone():
    D, c = np.array([0.5, 1.0, 1.5, 2.0]), np.full(4, 0.7)
    k_1, k_3, k_5 = np.full(4, 0.4), np.full(4, 0.02), np.full(4, 0.03)
    run = jitted(jax.vmap(lambda D, c, a, b, e: press_series(D, c, Law(a, b, e))))
    good = run(D, c, k_1, k_3, k_5)
    D[0], k_5[2] = np.nan, -5.0
    bad = run(D, c, k_1, k_3, k_5)
    for one, two in zip(good[:3], bad[:3], strict=True):
        np.testing.assert_array_equal(one[[1, 3]], two[[1, 3]])
    ok = PressStatus.OK
    expected = [PressStatus.NON_FINITE, ok, PressStatus.PAST_FOLD, ok]
    np.testing.assert_array_equal(bad.status, expected)


def test_rings_have_their_own_or_the_ligaments():
    soft, ring = law((0.2, 0.01, 0.004)), law((3.0, 0.5))
    got = mixed(soft, ring, number(0.25))
    k_1 = 1 / (0.75 / 0.2 + 0.25 / 3)  # compliances are mixed
    k_3 = (0.75 * 0.01 / 0.2**4 + 0.25 * 0.5 / 3**4) * k_1**4
    k_5 = 0.75 * 0.004 / 0.2**6 * k_1**6
    np.testing.assert_allclose(got, (k_1, k_3, k_5), rtol=1e-14)
    assert mixed(law((0.2, 0.01)), ring, number(0.25)).k_5 is None
    assert coefficient("k_5_ring") == "k_5"
    g, options = table_1(), Options(local="two-material", coupling="total")
    material = Material(1.9, 0.1, 0.3, 0.02, k_5=0.01, k_1_ring=0.9)
    run = jax.jit(press, static_argnums=4)
    on_ring = run(g, material, g.ring_positions[4], 2.0, options)
    np.testing.assert_allclose(on_ring.force, 0.9 * 2 + 0.02 * 8 + 0.01 * 32, rtol=1e-12)
    stiff = Material(1.9, 0.1, 0.3, 0.02, k_1_ring=0.9, k_5_ring=0.5)
    on_ring = run(g, stiff, g.ring_positions[4], 2.0, options)
    np.testing.assert_allclose(on_ring.force, 0.9 * 2 + 0.02 * 8 + 0.5 * 32, rtol=1e-12)


TRUTH = {"EI_L": 1.5, "k_M": 0.2, "k_1": 0.4, "k_3": -0.03, "k_5": 0.008}
SIGNED = {"k_3": {"lower": -1e6}, "k_5": {}}


def curves(positions):
    geometry, D = table_1(), np.linspace(0.05, 3.5, 40)
    material = Material(**TRUTH)
    run = jax.jit(press)
    forces = (np.asarray(run(geometry, material, s, D).force) for s in positions)
    return [Curve("a", f"t{i}", s, 0.0, D, F)
            for i, (s, F) in enumerate(zip(positions, forces, strict=True))]  # fmt: skip


@pytest.mark.slow
@pytest.mark.compiling
def test_a_fit_has_it_back():
    """Noiseless curves at four positions: the five numbers they were made of."""
    study = build_study(curves([20.0, 45.0, 62.0, 80.0]), table_1(), Options(), SIGNED,
                        noise=Noise(force=1e-3))  # fmt: skip
    assert [p.name for p in study.free] == list(TRUTH)
    result = fit(study, Settings(starts=6, verify=False))
    np.testing.assert_allclose(result.value[0], list(TRUTH.values()), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.compiling
def test_structure_knows_it():
    """k_5 is told by the shape of a curve; one position still leaves the skeleton open."""
    for positions, nullity in (([20.0, 45.0, 62.0], 0), ([45.0], 1)):
        study = build_study(curves(positions), table_1(), Options(), SIGNED)
        known = structure(study)
        assert known.nullity[0] == nullity
        names = [p.name for p, _, _ in study.unknowns[0]]
        open_ = {n for n, u in zip(names, known.undetermined[0], strict=True) if u}
        assert open_ == ({"EI_L", "k_M"} if nullity else set())
