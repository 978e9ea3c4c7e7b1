"""Influence against closed forms of a linear model and refits of moved and missing data."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.estimate import estimate, lane_of
from jaxtrachea.inference.influence import influence
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.trachea.geometry import table_1

SHARP = Settings(starts=1, verify=False, tolerances=Tolerances(1e-15, 1e-15, 1e-15, 100))


def linear_study(lengths, balance="curve", **noise):
    """F = k_1 D + noise: one unknown, curves of the given lengths."""
    rng = np.random.default_rng(3)
    rows = [dataclasses.replace(DEFAULTS["k_1"], scale="linear", value=1.0, step=0.5)]
    zero = {"lower": -1.0, "value": 0.0, "fixed": True}
    rows += [dataclasses.replace(DEFAULTS[n], **zero) for n in ("k_3", "onset", "force_offset")]
    curves = []
    for j, n in enumerate(lengths):
        D = np.linspace(0.2, 2, n)
        curves.append(Curve("T", f"t{j}", None, 0.0, D, 1.3 * D + 0.05 * rng.normal(size=n)))
    options = Options(coupling="total", onset_width=0.0)
    return build_study(
        curves, table_1(), options, rows, weighting=Weighting(balance), noise=Noise(**noise)
    )


@pytest.mark.parametrize("noise", [{}, {"force": 0.05}])
def test_one_unknown_is_the_textbook(noise):
    """Leverage D^2 / sum D^2, e / (s sqrt(1 - h)), s without the sample, Cook t^2 h / (1 - h)."""
    found = influence(fit(linear_study((12,), **noise), SHARP))
    curve = found.result.study.curves[0][0]
    D, F = curve.displacement, curve.force
    k = (D @ F) / (D @ D)
    e, h = k * D - F, D * D / (D @ D)
    s = noise.get("force", np.sqrt(e @ e / 11))
    t = e / (s * np.sqrt(1 - h))

    def one(v):
        return np.asarray(v)[0, 0]

    def close(a, b):
        return np.testing.assert_allclose(a, b, rtol=1e-8)

    close(one(found.of.leverage), h)
    close(one(found.of.studentised), t)
    close(one(found.of.cook), t * t * h / (1 - h))
    without = np.sqrt((e @ e - e * e / (1 - h)) / 10)
    close(one(found.external), t if noise else e / (without * np.sqrt(1 - h)))
    close(one(found.of.per_sigma)[0], np.sqrt(h))
    gone = np.array([(D @ F - d * f) / (D @ D - d * d) for d, f in zip(D, F, strict=True)])
    close(one(found.of.left_out)[0], (gone - k) * np.sqrt(D @ D) / s)
    assert np.isnan(found.of.curve_left_out).all()  # nothing is known without the only curve


@pytest.mark.long
def test_curves_of_unequal_weight():
    """Weights b^2 = mean length / n: variance of residuals by the whole hat matrix, lost curves."""
    found = influence(fit(linear_study((30, 10)), SHARP))
    curves = found.result.study.curves[0]
    D = np.concatenate([c.displacement for c in curves])
    F = np.concatenate([c.force for c in curves])
    first = np.arange(40) < 30
    w = np.where(first, 20 / 30, 20 / 10)
    A = np.sum(w * D * D)
    hat = np.outer(D, w * D) / A
    variance = np.sum((np.eye(40) - hat) ** 2, axis=1)
    s = found.result.sigma[0, 0]

    def pick(v):
        return np.concatenate([v[0, 0, :30], v[0, 1, :10]])

    np.testing.assert_allclose(pick(found.of.leverage), np.diag(hat), rtol=1e-8)
    t = (found.result.value[0, 0] * D - F) / s / np.sqrt(variance)
    np.testing.assert_allclose(pick(found.of.studentised), t, rtol=1e-7)
    se = found.result.standard_error[0, 0]
    best = np.sum(w * D * F) / A
    alone = [np.sum((D * F)[m]) / np.sum((D * D)[m]) for m in (~first, first)]
    np.testing.assert_allclose(
        found.of.curve_left_out[0, :, 0], (np.array(alone) - best) / se, rtol=1e-7
    )
    share = np.array([np.sum((w * w * D * D)[m]) for m in (first, ~first)])
    np.testing.assert_allclose(found.of.curve_share[0, :, 0], share / share.sum(), rtol=1e-8)
    assert np.isnan(found.of.leverage[0, 1, 10:]).all()


def moved(study, force, precision=None):
    """Estimates of lane 0 with each of these forces (B, T, N) in its place."""
    many = study.take(np.zeros(len(force), int))
    lanes = many.lanes._replace(force=force)
    if precision is not None:
        lanes = lanes._replace(precision=precision)
    return dataclasses.replace(many, lanes=lanes)


HUBER = {"weighting": Weighting(loss="huber"), "noise": Noise(force=0.04)}


#: Curve and sample.
PLACES = [(0, 3), (0, 49), (1, 20), (2, 30), (3, 0), (3, 49)]


def measured(share):
    """Forces of four curves with noise of this share of the largest."""
    force, _ = synthetic.forces(np.array([[300.0, 1.0, 0.5, 0.2]]))
    return force + share * force.max() * np.random.default_rng(2).normal(size=force.shape)


@pytest.fixture(scope="module")
def noisy():
    return measured(0.03)


@pytest.fixture(scope="module")
def quiet():
    return measured(0.003)


@pytest.mark.slow
@pytest.mark.compiling
def test_four_unknowns_against_refits(noisy):
    """Central differences of refits; a hat matrix of trace P."""
    study = synthetic.study(noisy, **HUBER)
    result = fit(study, SHARP)
    found = influence(result)
    np.testing.assert_allclose(np.nansum(found.of.leverage), 4, rtol=1e-9)
    places = PLACES
    T, N = noisy.shape[1:]
    sigma = result.sigma[0, 0]
    step = 0.1 * sigma  # the solver knows an estimate to some 1e-7 standard errors
    shift = np.zeros((2 * len(places), T, N))
    for k, (t, e) in enumerate(places):
        shift[2 * k, t, e], shift[2 * k + 1, t, e] = step, -step
    se = result.uncertainty.se[0]

    def start(n):
        return np.repeat(result.theta, n, axis=0)

    data = study.lanes.force + shift
    again = fit(moved(study, data), SHARP, starts=start(len(data))).theta
    slope = (again[::2] - again[1::2]) / (2 * step) * sigma / se
    of = [found.of.per_sigma[0, t, :, e] for t, e in places]
    np.testing.assert_allclose(of, slope, rtol=1e-3, atol=1e-4 * np.abs(slope).max())


@pytest.mark.slow
@pytest.mark.compiling
def test_left_out_is_a_refit_to_first_order(quiet):
    """Shifts of up to half a standard error, of a nearly linear model: to 5 % of the largest."""
    study = synthetic.study(quiet)
    result = fit(study, SHARP)
    found, places = influence(result), PLACES
    precision = np.repeat(study.lanes.precision, len(places), axis=0)
    for k, (t, e) in enumerate(places):
        precision[k, t, e] = 0
    held = study.lanes.force.repeat(len(places), axis=0)
    starts = np.repeat(result.theta, len(places), axis=0)
    gone = fit(moved(study, held, precision), SHARP, starts=starts).theta
    exact = (gone - result.theta) / result.uncertainty.se[0]
    first = np.array([found.of.left_out[0, t, :, e] for t, e in places])
    np.testing.assert_allclose(first, exact, atol=0.05 * np.abs(exact).max())


@pytest.mark.slow
@pytest.mark.compiling
def test_an_unknown_on_its_bound_is_held(noisy):
    """An unknown on its bound is held: it carries nothing, and the others as if it were fixed."""
    low = {"k_M": {"value": 2.0, "lower": 1.6}}
    found = influence(fit(synthetic.study(noisy, changes=low), SHARP))
    assert found.result.at_bound[0].tolist() == [False, True, False, False]
    np.testing.assert_allclose(np.nansum(found.of.leverage), 3, rtol=1e-9)
    assert np.isnan(found.of.per_sigma[0, :, 1]).all()
    np.testing.assert_allclose(found.of.curve_share[0].sum(axis=0)[[0, 2, 3]], 1, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_estimate_of_one_unknown_is_differentiable():
    """k_1 = D F / D D: derivatives by force and, forward over reverse, by D; many lanes at once."""
    study = linear_study((12,))
    lane, sigma = lane_of(study, 0), jnp.ones(2)
    start = jnp.array([1.0])

    def k(force, D):
        data = lane._replace(force=force, displacement=D)
        return 0.5 * estimate(study.model, start, data, sigma).theta[0]

    D, F = lane.displacement, lane.force
    by = jax.grad(k, argnums=(0, 1))
    quick = {"xla_backend_optimization_level": 0}
    run = jax.jit(jax.vmap(lambda F: (k(F, D), *by(F, D), jax.jvp(lambda D: by(F, D)[0],
                  (D,), (D,))[1])), compiler_options=quick)  # fmt: skip
    many = jnp.stack([F, 2 * F])
    value, by_force, by_depth, mixed = run(many)
    square = jnp.sum(D * D)
    np.testing.assert_allclose(value, jnp.sum(many * D[None], axis=(1, 2)) / square, rtol=1e-10)
    np.testing.assert_allclose(by_force, jnp.stack([D, D]) / square, rtol=1e-9)
    expected = (many - 2 * value[:, None, None] * D[None]) / square
    np.testing.assert_allclose(by_depth, expected, rtol=1e-7, atol=1e-9)
    # D / DD is homogeneous of degree -1: its derivative along D is minus itself.
    np.testing.assert_allclose(mixed, -by_force, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_estimate_follows_data_and_geometry(noisy):
    """Forward = reverse = central differences of the solver, by force, contact and rings."""
    study = synthetic.study(noisy)
    result = fit(study, SHARP)
    lane, start = lane_of(study, 0), jnp.asarray(result.theta[0])
    sigma = jnp.asarray(result.whitened_sigma[0])
    tube = jax.tree.map(jnp.asarray, study.model.geometry)
    rng = np.random.default_rng(0)
    along = [jnp.asarray(rng.normal(size=v.shape)) for v in (lane.force, lane.s_c)]
    along = (0.1 * along[0], along[1], jnp.asarray(rng.normal(size=15)))
    weight = jnp.asarray(rng.normal(size=4))

    def theta(force, s_c, rings):
        moved = lane._replace(force=force, s_c=s_c)
        geometry = dataclasses.replace(tube, ring_positions=rings)
        return estimate(study.model, start, moved, sigma, geometry, SHARP.tolerances).theta

    @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def both(*at):
        forward = jax.jvp(theta, at, along)[1]
        reverse = jax.grad(lambda *at: jnp.sum(theta(*at) * weight), argnums=(0, 1, 2))(*at)
        h = jnp.array([0.02, -0.02, 0.04, -0.04])
        apart = jax.vmap(lambda h: theta(*(a + h * d for a, d in zip(at, along, strict=True))))(h)
        coarse, fine = (apart[2] - apart[3]) / 0.08, (apart[0] - apart[1]) / 0.04
        return theta(*at), forward, reverse, fine + (fine - coarse) / 3

    at = lane.force, lane.s_c, tube.ring_positions
    value, forward, reverse, difference = both(*at)
    # Roundings of the cost hide a rise of it: 8 of them are this many standard errors.
    hidden = np.sqrt(16 * np.finfo(float).eps * result.samples[0]) * result.uncertainty.se[0]
    assert np.all(np.abs(value - result.theta[0]) <= hidden)
    np.testing.assert_allclose(forward, difference, rtol=1e-3)
    products = sum(float(jnp.sum(r * d)) for r, d in zip(reverse, along, strict=True))
    np.testing.assert_allclose(products, float(forward @ weight), rtol=1e-9)
