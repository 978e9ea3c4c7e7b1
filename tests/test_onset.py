"""Fits with an unknown onset and force offset, against a sharp hinge fitted by SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from scipy.integrate import quad
from scipy.optimize import least_squares

from jaxtrachea._numerics import centred_hinge
from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import in_model
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.cross_validation import curves_to_leave_out, leave_one_out
from jaxtrachea.inference.design.candidates import Candidates, check
from jaxtrachea.inference.design.choice import gains
from jaxtrachea.inference.design.situation import situation
from jaxtrachea.inference.labels import verdict_sentence
from jaxtrachea.inference.repeats import leave_repeats_out
from jaxtrachea.inference.weakest_direction import describe_weakest
from jaxtrachea.measurements.first_touch import first_touch
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, compliance
from jaxtrachea.trachea.material import Material

ONE = Settings(starts=1, verify=False)
OWN = {"onset": {"fixed": False}, "force_offset": {"fixed": False}}


def test_rounded_corner_is_the_average_of_the_sharp_one():
    """`max(x, 0)` averaged with the kernel of the docstring, by quadrature; nothing outside."""

    def kernel(u):
        return 15 / 32 * (1 - u * u) * (3 - 7 * u * u)

    width, centred = 0.3, jax.jit(centred_hinge)
    for x in (-0.29, -0.1, 0.0, 0.12, 0.25):
        corner = [v for v in (x / width,) if abs(v) < 1]
        mean, _ = quad(lambda u, x=x: kernel(u) * max(x - width * u, 0), -1, 1, points=corner)
        np.testing.assert_allclose(centred(jnp.array(x), jnp.array(width)), mean, atol=1e-12)
    x = np.linspace(-1, 1, 401)
    got = np.asarray(centred(x, jnp.array(width)))
    outside = np.abs(x) >= width
    np.testing.assert_array_equal(got[outside], np.maximum(x, 0)[outside])
    np.testing.assert_array_equal(centred(x, jnp.array(0.0)), np.maximum(x, 0))
    # The integral of the sharp corner, 1/2, and what the trapezoidal rule adds: h^2 f'(1) / 12.
    np.testing.assert_allclose(np.trapezoid(got, x), 0.5 + 0.005**2 / 12, atol=1e-9)


def test_rounded_corner_differentiates():
    x, width = (
        jnp.asarray([-0.31, -0.3, -0.2, 0.0, 0.1, 0.3, 0.5], "float64"),
        jnp.asarray(0.3, "float64"),
    )
    one = jax.jit(jax.vmap(jax.value_and_grad(centred_hinge), (0, None)))
    value, slope = one(x, width)
    assert value.dtype == slope.dtype == x.dtype
    wide, centred = np.asarray(x, float), jax.jit(centred_hinge)
    h, exact = 1e-6, np.asarray(width, float)
    differences = np.asarray(centred(wide + h, exact) - centred(wide - h, exact)) / (2 * h)
    np.testing.assert_allclose(slope, differences, atol=1e-8)
    by_width = jax.jit(jax.jacfwd(centred_hinge, 1))(wide, exact)
    forth = np.asarray(centred(wide, exact + h) - centred(wide, exact - h)) / (2 * h)
    np.testing.assert_allclose(by_width, forth, atol=1e-8)
    reverse = jax.jit(jax.jacrev(centred_hinge, 1))(wide, exact)
    np.testing.assert_allclose(reverse, by_width, atol=1e-14)


def hinge_force(D, onset, c, k_1, k_3):
    """Force of Duffing law and compliance c in series after a sharp touch, by Newton steps."""
    x = np.maximum(D - onset, 0)
    d = x / (1 + c * k_1)
    for _ in range(50):
        d = d - ((1 + c * k_1) * d + c * k_3 * d**3 - x) / (1 + c * k_1 + 3 * c * k_3 * d * d)
    return k_1 * d + k_3 * d**3


def noisy_curves(count, seed, samples=60):
    """One press per specimen: onset 0 to 1.5 mm, offset up to 5 % and noise 0.5 to 2 % of peak."""
    rng = np.random.default_rng(seed)
    places = np.array([22.0, 45.0, 75.0, 80.0])
    beam = Material(300.0, 1.0, 1.0, 0.0)
    given = functools.partial(compliance, options=Options())
    soft = np.asarray(jax.jit(given)(synthetic.GEOMETRY, beam, places))
    curves, truth = [], []
    for i in range(count):
        k_1, k_3 = 1.5 * np.exp(rng.uniform(-0.5, 0.5)), 0.03 * np.exp(rng.uniform(-0.7, 0.7))
        onset, c = rng.uniform(0, 1.5), soft[i % 4]
        D = np.sort(np.linspace(0, 6, samples) + rng.uniform(-0.03, 0.03, samples))
        force = hinge_force(D, onset, c, k_1, k_3)
        peak, level = force.max(), rng.uniform(0.005, 0.02)
        offset = rng.uniform(-0.05, 0.05) * peak
        force = force + offset + level * peak * rng.normal(size=samples)
        curves.append(Curve(f"s{i:04d}", "t", float(places[i % 4]), 0.0, D, force))
        truth.append((k_1, k_3, onset, offset, c, level * peak))
    return curves, np.array(truth)


def pressed_study(curves, **changes):
    fixed = {"EI_L": {"fixed": True, "value": 300.0}, "k_M": {"fixed": True, "value": 1.0}}
    table = default_parameters(in_model(Options(), joints=False), fixed | OWN | changes)
    return build_study(curves, synthetic.GEOMETRY, Options(), table)


@pytest.fixture(scope="module")
def studied():
    curves, truth = noisy_curves(150, 1)
    return fit(pressed_study(curves), Settings(more_starts=0)), truth


def coverage(result, truth):
    """Share of k_1 and onset within their 95 % intervals; deviations in standard errors."""
    inside = (result.lower <= truth[:, :4]) & (truth[:, :4] <= result.upper)
    return inside, (result.value - truth[:, :4]) / result.standard_error


@pytest.mark.slow
@pytest.mark.compiling
def test_every_noisy_curve_converges(studied):
    """A third of them stopped at 200 iterations, with the touch smooth over 1e-3 mm."""
    result, truth = studied
    assert result.succeeded.all()
    assert np.all(np.quantile(result.iterations, [0.5, 0.99]) <= [10, 120])
    assert np.mean(result.converged_starts >= 2) > 0.9
    inside, z = coverage(result, truth)
    inner = ~result.at_bound.any(axis=1)
    assert inner.sum() >= 148
    # 150 curves: the binomial error of 95 % is 1.8 %, the mean of z has an error of 0.08.
    assert np.all(inside[inner].mean(axis=0)[[0, 2]] >= 0.90)
    assert np.all(np.abs(np.median(z[inner], axis=0)) < 0.3)


@pytest.mark.slow
@pytest.mark.compiling
def test_rounding_moves_the_onset_by_little_of_its_error(studied):
    """SciPy with the sharp hinge: onset scanned, all else least squares; 3 curves."""
    result, truth = studied
    for k in np.flatnonzero(~result.at_bound.any(axis=1))[:3]:
        curve, c = result.study.curves[k][0], truth[k, 4]
        best = (np.inf, np.nan)
        value = result.value[k]
        for onset in value[2] + result.standard_error[k, 2] * np.linspace(-0.5, 0.5, 41):

            def misfit(p, onset=onset, curve=curve, c=c):
                model = hinge_force(curve.displacement, onset, c, np.exp(p[0]), p[1]) + p[2]
                return model - curve.force

            found = least_squares(misfit, [np.log(value[0]), value[1], value[3]], x_scale="jac")
            best = min(best, (found.cost, onset))
        assert abs(best[1] - value[2]) <= 0.2 * result.standard_error[k, 2]


def test_change_point_of_exact_curves():
    """A cubic after the touch is in the family: the onset is found to the step of the scan."""
    D = np.linspace(0, 6, 80)
    onset = np.array([0.4, 1.5, 3.0])
    h = np.maximum(D - onset[:, None], 0)
    force = 0.3 + 1.2 * h + 0.05 * h**3
    found = first_touch(np.tile(D, (3, 1)), force, np.ones((3, 80), bool))
    np.testing.assert_allclose(found.onset, onset, atol=0.03)
    np.testing.assert_allclose(found.force_offset, 0.3, atol=0.02)
    np.testing.assert_allclose(found.slope, 1.2 + 0.05 * 1.2**2, rtol=0.1)
    nothing = first_touch(np.tile(D, (3, 1)), force, np.zeros((3, 80), bool))
    assert np.isnan(nothing.onset).all()


def test_noise_is_told_from_the_shape():
    D = np.sort(np.random.default_rng(4).uniform(0, 6, 400))
    shape = hinge_force(D, 1.0, 0.3, 1.5, 0.05)
    force = shape + 0.05 * np.random.default_rng(5).normal(size=(3, 400))
    every = np.ones((3, 400), bool)
    np.testing.assert_allclose(first_touch(np.tile(D, (3, 1)), force, every).noise, 0.05, rtol=0.25)
    quiet = first_touch(D[None], shape[None], every[:1])
    assert quiet.noise[0] < 1e-4


def own_study(noise, trials=4, **changes):
    """Two specimens, no skeleton (coupling total): onset and offset of each curve its own."""
    rng = np.random.default_rng(6)
    curves = []
    for i, (k_1, k_3) in enumerate([(1.2, 0.05), (0.9, 0.08)]):
        for j in range(trials):
            D = np.linspace(0, 5, 80)
            h = np.maximum(D - rng.uniform(0.2, 1.0), 0)
            force = k_1 * h + k_3 * h**3 + rng.uniform(-0.3, 0.3)
            force = force + noise * rng.normal(size=80)
            curves.append(Curve(f"s{i}", f"t{j}", 20.0 + 30 * j, 0.0, D, force))
    options = Options(coupling="total")
    table = default_parameters(in_model(options, joints=False), OWN | changes)
    return build_study(curves, synthetic.GEOMETRY, options, table)


@pytest.fixture(scope="module")
def owned():
    return fit(own_study(0.05), ONE)


def scipy_fit(curves, start):
    """k_1, k_3 and onset, offset of each curve by SciPy, with the sharp hinge."""

    def misfit(p):
        parts = []
        for j, c in enumerate(curves):
            h = np.maximum(c.displacement - p[2 + j], 0)
            parts.append(p[0] * h + p[1] * h**3 + p[2 + len(curves) + j] - c.force)
        return np.concatenate(parts)

    return least_squares(misfit, start, x_scale="jac").x


def own_misfit(curve, k_1, k_3, start):
    """Residuals of a curve with its best own onset and offset."""

    def misfit(p):
        h = np.maximum(curve.displacement - p[0], 0)
        return k_1 * h + k_3 * h**3 + p[1] - curve.force

    return misfit(least_squares(misfit, start, x_scale="jac").x)


@pytest.mark.long
def test_a_curve_left_out_fits_its_own_onset(owned):
    """SciPy: others fitted, then the curve's own two numbers with their k_1 and k_3."""
    left = leave_one_out(owned, ONE)
    assert left.result.succeeded.all()
    assert len(left.trial) == 8
    lane, t = 0, 2
    curves, value = list(owned.study.curves[lane]), owned.value[lane]
    gone = curves.pop(t)
    start = np.delete(value, [2 + t, 6 + t])
    k_1, k_3 = scipy_fit(curves, start)[:2]
    r = own_misfit(gone, k_1, k_3, value[[2 + t, 6 + t]])
    expected = np.sqrt(np.mean(r**2)) / np.max(np.abs(gone.force))
    np.testing.assert_allclose(left.force[2], expected, rtol=0.01)
    by_position = leave_repeats_out(owned, ONE).error
    assert np.isfinite(by_position).all()
    peak = max(np.max(np.abs(c.force)) for c in owned.study.curves[0])
    each = left.force[:4] * [np.max(np.abs(c.force)) for c in owned.study.curves[0]]
    np.testing.assert_allclose(by_position[0], np.sqrt(np.mean(each**2)) / peak, rtol=1e-6)


def test_a_stiffness_of_one_curve_is_still_refused():
    study = own_study(0.05, k_1={"scope": "trial"})
    with pytest.raises(ValueError, match="k_1 belongs to single trials"):
        curves_to_leave_out(study)


def test_a_new_press_brings_its_own_onset(owned):
    """Information of a press by differences of the sharp hinge, its onset and offset eliminated."""
    known = situation(owned)
    assert known.base.shape[-2:] == (2, 2)
    value, sigma = owned.value[0], owned.sigma[0, 0]
    touch = np.median(value[2:6])
    # Records begin at 0, before the touch; the depth is from there on.
    got = gains(known, Candidates(np.array([50.0]), np.array([4.0 - touch])))[0, 0]
    D = 4.0 * np.arange(1, 81) / 80
    h = np.maximum(D - touch, 0)
    slope = -(value[0] + 3 * value[1] * h * h) * (h > 0)
    J = np.stack([value[0] * h, value[1] * h**3, slope, np.ones(80)]) / sigma
    full = J @ J.T
    expected = full[:2, :2] - full[:2, 2:] @ np.linalg.solve(full[2:, 2:], full[2:, :2])
    np.testing.assert_allclose(got, expected, rtol=0.05)
    fixed = full[:2, :2]
    assert np.all(np.diag(expected) < 0.6 * np.diag(fixed))
    alone = own_study(0.05, k_1={"scope": "trial"}, k_3={"scope": "trial"})
    with pytest.raises(ValueError, match="every free parameter belongs to single trials"):
        check(alone)


def test_errors_of_an_onset_are_of_the_press(owned):
    """The range is 5 mm: 0.28 mm is 5.6 %, and not 28,000 % of 1e-3 mm."""
    names = [p.name for p, _, _ in owned.study.unknowns[0]]
    at = names.index("onset")
    expected = owned.standard_error[0, at] / 5.0
    np.testing.assert_allclose(owned.relative_se[0, at], expected, rtol=1e-12)
    peak = np.max(np.abs(owned.study.curves[0][0].force))
    at = names.index("force_offset")
    np.testing.assert_allclose(
        owned.relative_se[0, at], owned.standard_error[0, at] / peak, rtol=1e-12
    )
    assert "onset" in verdict_sentence(owned, 0)


@pytest.mark.parametrize(
    ("flat", "error", "text"),
    [
        ((0, 0, 1), 0.056, "least determined: onset alone, known to 0.28 mm"),
        ((0, 0, 1), 2.0, "least determined: onset alone, known to 10 mm"),
        (
            (0.8, 0, -0.6),
            0.25,
            "least determined: k_1 +10 %, onset -0.375 mm together, known to 2 times that",
        ),
        ((0.8, 0, -0.6), np.inf, "k_1 and onset change together without a change of any curve"),
        ((0, 1, 0), 0.2, "least determined: k_3 alone, known to 20 %"),
    ],
)
def test_onset_in_words(flat, error, text):
    names = ["k_1", "k_3", "onset"]
    assert describe_weakest(names, np.array(flat, float), error, press={2: (5.0, "mm")}) == text


def test_where_no_onset_is_fitted_nothing_changes():
    force, _ = synthetic.forces(np.array([[300.0, 1.0, 0.5, 0.2]]))
    study = synthetic.study(force)
    assert study.lanes.blend is None
    assert study.parameters[-1].step == 0.1
