"""The residual is what `press` gives; its two-stage Jacobian is that of the value."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from scipy.integrate import quad

from jaxtrachea._numerics import epsilon
from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.parameters import in_model
from jaxtrachea.fitting.residual import residual, residual_value
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling

FREE = {"fixed": False}
TRIAL = {"fixed": False, "scope": "trial"}
BOTH = {"onset": TRIAL, "force_offset": TRIAL}
SHARED = {"fixed": False, "scope": "shared"}
#: Options, with markers or without, and what is said of single parameters.
CASES = {
    "default": (Options(), False, {}),
    "softening": (Options(shear=True, skeleton="softening"), True, BOTH),
    "punch": (Options(shear=True, local="two-material", half_width=2.4), True, {}),
    "total, markers": (Options(coupling="total"), True, {}),
    "onset and offset": (Options(onset_width=0.5), False, BOTH),
    "all": (Options(shear=True, local="two-material"), True, BOTH),
    "bonded": (Options(contact="bonded"), True, {"onset": FREE | {"scope": "specimen"}}),
    "beam of a trial": (Options(), False, {"EI_L": TRIAL, "k_1": SHARED}),
    "several beams": (Options(), False, {"k_1": SHARED, "k_M": FREE | {"scale": "linear"}}),
}  # fmt: skip
QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation


def make_study(name, weighting=Weighting()):
    """Study of two specimens, of three curves and two, of unequal length and varying sigma."""
    options, markers, changes = CASES[name]
    rng = np.random.default_rng(5)
    found = []
    for i, (s, n) in enumerate([(22.0, 7), (45.0, 5), (80.0, 6), (15.0, 7), (77.0, 4)]):
        seen = {}
        if markers:
            moved = rng.normal(size=(n, 3))
            moved[1, 2] = np.nan
            seen = {"joint_rings": np.array([1, 6, 9]), "joint_displacement": moved}
        sigma = rng.uniform(0.5, 2.0, n) if i % 2 else None
        D, F = np.linspace(-0.2, 5.0, n), np.abs(rng.normal(size=n))
        found.append(Curve(f"s{i // 3}", f"t{i}", s, 0.0, D, F, sigma=sigma, **seen))
    named = ("k_3_ring", *changes)
    parameters = default_parameters(in_model(options, joints=markers, named=named), changes)
    noise = Noise(force=0.3, joints=0.7)
    return build_study(
        found, synthetic.GEOMETRY, options, parameters, noise=noise, weighting=weighting
    )


def lane_and_point(study, k, dtype=np.float64):
    """Arrays of lane k and unknowns near the guess."""

    def cast(v):
        return v if v.dtype == np.int32 else v.astype(dtype)

    lane = jax.tree.map(lambda v: jnp.asarray(cast(v[k])), study.lanes)
    rng = np.random.default_rng(k)
    guess = [p.to_scaled(p.value) for p, _, _ in study.unknowns[k]]
    theta = np.zeros(study.size)
    theta[: len(guess)] = np.array(guess) + 0.3 * rng.normal(size=len(guess))
    return lane, jnp.asarray(theta, dtype)


@functools.cache
def evaluated(name):
    """Residual with Jacobian, residual alone, and its derivative by jax; of every lane."""
    study = make_study(name)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def both(theta, lane):
        model = study.model
        value = functools.partial(residual_value, model)
        return residual(model, theta, lane), value(theta, lane), jax.jacfwd(value)(theta, lane)

    return [both(*reversed(lane_and_point(study, k))) for k in range(len(study.curves))]


def rounded(x, width):
    """`max(x, 0)` averaged with a kernel of the fourth order, by quadrature."""

    def kernel(u):
        return 15 / 32 * (1 - u * u) * (3 - 7 * u * u)

    corner = [x / width] if abs(x) < width else None
    return quad(lambda u: kernel(u) * max(x - width * u, 0), -1, 1, points=corner, epsabs=1e-13)[0]


def pressed(study, theta, k, t):
    """Force and joints of trial t of lane k by the public `press`."""
    curve = study.curves[k][t]
    values = {p.name: p.value for p in study.parameters}
    for (p, specimen, trial), scaled in zip(study.unknowns[k], np.asarray(theta), strict=False):
        if specimen in ("", curve.specimen) and trial in ("", curve.trial):
            values[p.name] = p.from_scaled(float(scaled))
    onset, offset = values.pop("onset"), values.pop("force_offset")
    material = Material(**{"EI_L": 1.0, "k_M": 1.0} | values)
    D, options = jnp.asarray(curve.displacement), study.model.options
    if study.lanes.blend is not None:  # a fitted onset: the corner is rounded on both sides
        D = jnp.asarray([rounded(d - onset, study.lanes.blend[k, t]) for d in curve.displacement])
        onset, options = 0.0, dataclasses.replace(options, contact="bonded")
    at = jnp.asarray(curve.s_c), jnp.asarray(onset)
    force, joints = _press(options, material, *at, jnp.pad(D, (0, 7 - len(D))))
    return np.asarray(force)[: len(D)] + offset, np.asarray(joints)[: len(D)]


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def _press(options, material, s_c, onset, displacement):
    out = press(synthetic.GEOMETRY, material, s_c, displacement, options, onset=onset)
    return out.force, out.joints


def check_jacobian(study, lane, trials, found, value, truth):
    np.testing.assert_allclose(found.value, value, rtol=1e-12, atol=1e-12)
    index = np.asarray(lane.index)[:, study.free_columns]
    for t in range(trials):
        for column, unknown in enumerate(index[t]):
            scale = np.abs(truth[t]).max()
            np.testing.assert_allclose(
                found.jacobian[t, column], truth[t, :, unknown], rtol=1e-9, atol=1e-11 * scale
            )
        others = np.setdiff1d(np.arange(study.size), index[t])
        assert np.all(truth[t][:, others] == 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CASES.keys() - {"onset and offset", "several beams"}))
def test_is_model_minus_data_and_has_its_jacobian(name):
    study = make_study(name)
    for k, curves in enumerate(study.curves):
        lane, theta = lane_and_point(study, k)
        found, value, truth = evaluated(name)[k]
        check_jacobian(study, lane, len(curves), found, value, np.asarray(truth))
        value = np.asarray(value)
        samples = lane.force.shape[-1]
        for t, curve in enumerate(curves):
            n = len(curve.force)
            force, joints = pressed(study, theta, k, t)
            sigma = 0.3 if curve.sigma is None else curve.sigma
            expected = (force - curve.force) / sigma
            np.testing.assert_allclose(value[t, :n], expected, rtol=1e-9, atol=1e-11)
            assert np.all(value[t, n:samples] == 0)
            if "joints" not in lane.others:
                continue
            markers = value[t, samples:].reshape(samples, -1)
            expected = (joints[:, curve.joint_rings] - curve.joint_displacement) / 0.7
            expected = np.nan_to_num(expected)
            np.testing.assert_allclose(
                markers[:n, curve.joint_rings], expected, rtol=1e-9, atol=1e-11
            )
            assert np.count_nonzero(markers) <= n * 3
        assert np.all(value[len(curves) :] == 0)


@pytest.mark.slow
def test_lanes_are_as_each_by_itself():
    """Many together give what each gives alone, with markers and a width, in both dtypes."""
    study = make_study("punch")
    for dtype in (np.float32, np.float64):
        ones = [lane_and_point(study, k, dtype) for k in range(2)]
        lanes, theta = jax.tree.map(lambda *v: jnp.stack(v), *ones)
        each = jax.vmap(functools.partial(residual, study.model))
        found = jax.jit(each, compiler_options=QUICK)(theta, lanes)
        for k, alone in enumerate(evaluated("punch")):
            for got, true in zip(found, alone[0], strict=True):
                if true is not None:
                    assert got.dtype == dtype
                    atol = 200 * epsilon(got.dtype) * np.abs(true).max()
                    np.testing.assert_allclose(got[k], true, rtol=0, atol=atol)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "loss"),
    [("default", "linear"), pytest.param("bonded", "huber", marks=pytest.mark.slow)],
)
def test_the_pull_ahead_is_the_second_derivative(name, loss):
    """J^T root(weight) r'' along a short step; with an onset its rounded corner takes no part."""
    study = make_study(name, Weighting(loss=loss))
    model = study.model

    @functools.partial(jax.jit, compiler_options=QUICK)
    def both(theta, step, lane):
        cost = LaneCost(model, lane, jnp.ones(2))
        value = functools.partial(residual_value, model, lane=lane)
        bent = jax.jvp(lambda v: jax.jvp(value, (v,), (step,))[1], (theta,), (step,))[1]
        slope = 1.0
        if loss == "huber":
            slope = 1 / jnp.maximum(jnp.abs(value(theta)) / 1.345, 1)
        weight = slope * lane.balance[:, None] ** 2
        true = jnp.einsum("tmp,tm->p", jax.jacfwd(value)(theta), weight * bent)
        return cost.ahead(cost.evaluate(theta), theta, step), true

    for k in range(len(study.curves)):
        lane, theta = lane_and_point(study, k)
        step = 1e-3 * np.random.default_rng(k).normal(size=study.size) * lane.active
        got, true = both(theta, jnp.asarray(step), lane)
        np.testing.assert_allclose(got, true, rtol=0, atol=1e-2 * np.abs(true).max())


@pytest.mark.parametrize(
    ("name", "common"),
    [("default", "all"), ("onset and offset", "beam"), ("beam of a trial", "nothing"),
     ("several beams", "nothing")],
)  # fmt: skip
def test_what_trials_of_a_lane_have_in_common(name, common):
    assert make_study(name).model.common == common
