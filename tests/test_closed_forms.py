"""Single factors of the statistics and the solver, each by a closed form of a model of one line.

F = k_1 D (stiffness `total`, linear scale) makes estimates, variances and steps plain algebra.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
import synthetic
from small_scenes import MATERIAL, MESH, TUBE, presses

from jaxtrachea import EffectOptions, make_scene, simulate
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.cost import LaneCost, evaluate
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import draw_starts
from jaxtrachea.inference import bootstrap
from jaxtrachea.inference.design.situation import situation
from jaxtrachea.inference.influence import influence
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.optimisation import trust_region
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1

ONE = Settings(
    starts=1, verify=False, tolerances=Tolerances(cost=1e-15, gradient=1e-12, step=1e-12)
)
D = np.linspace(0.1, 2, 12)
FORCE = 1.3 * D + np.random.default_rng(4).standard_t(2, size=12) * 0.1


def line(force, *, changes=None, options=Options(coupling="total"), **how):  # noqa: B008
    """k_1 free and linear, all others fixed, unless `changes` says otherwise."""
    free = {"k_1": {"scale": "linear", "lower": 0.01, "upper": 50.0, "value": 1.0, "step": 0.5}}
    held = {"lower": -1.0, "value": 0.0, "fixed": True, "auto": False}
    still = dict.fromkeys(("onset", "force_offset"), held)
    still["k_3"] = {"lower": 0.0, "value": 0.0, "fixed": True}
    if options.coupling == "series":
        still |= {"EI_L": {"value": 300.0, "fixed": True}, "k_M": {"value": 1.0, "fixed": True}}
    rows = [
        dataclasses.replace(DEFAULTS[n], **v)
        for n, v in (free | still | (changes or {})).items()
    ]  # fmt: skip
    curves = [Curve("T", f"t{i}", 75.0, 0.0, D, f) for i, f in enumerate(np.atleast_2d(force))]
    return build_study(
        curves, table_1(), dataclasses.replace(options, onset_width=0.0), rows, **how
    )


@pytest.fixture(scope="module")
def robust():
    return fit(line(FORCE, weighting=Weighting(loss="huber")), ONE)


def test_noise_of_a_robust_fit_is_the_median_of_a_normal_distribution(robust):
    """Half of |N(0, 1)| lies below its 75 % quantile, 0.6745."""
    residual = np.abs(FORCE - robust.value[0, 0] * D)
    expected = np.median(residual) / scipy.stats.norm.ppf(0.75)
    np.testing.assert_allclose(robust.sigma[0, 0], expected, rtol=1e-3)


def test_standard_error_of_a_robust_fit_is_huber_s(robust):
    """sigma^2 E psi^2 / (E psi')^2 / sum D^2, with n / (n - 1) (Huber 1973)."""
    k, sigma = robust.value[0, 0], robust.sigma[0, 0]
    z = (k * D - FORCE) / robust.whitened_sigma[0, 0]
    limit = robust.study.model.loss_scale
    assert 0.05 < np.mean(np.abs(z) > limit) < 0.6  # so that psi' is neither 0 nor 1
    psi = np.clip(z, -limit, limit)
    slope = np.mean(np.abs(z) <= limit)
    variance = sigma**2 * np.mean(psi**2) / slope**2 / (D @ D) * 12 / 11
    np.testing.assert_allclose(robust.standard_error[0, 0] ** 2, variance, rtol=2e-3)


def test_resampled_residuals_have_the_variance_of_the_noise():
    """Residuals are smaller than the noise by (n - P) / n, and centred in their curve."""
    result = fit(line(np.stack([FORCE, FORCE[::-1]])), ONE)
    residual = np.stack([FORCE, FORCE[::-1]]) - result.value[0, 0] * D
    seen = {"force": residual[None]}
    noise = bootstrap._blocks(np.random.default_rng(0), result, seen, 0, 20_000, 1)["force"]
    expected = np.var(residual, axis=1) * 24 / 23
    # 240,000 draws of heavy tails tell a variance to 1 %; the factor is 4.3 %.
    np.testing.assert_allclose(np.var(noise, axis=(0, 2)), expected, rtol=0.01)


@pytest.mark.slow
@pytest.mark.compiling
def test_influence_of_a_curved_model_is_that_of_refits():
    """k_1 in series with the skeleton beside a fixed k_3: residuals change the curvature."""
    changes = {"k_3": {"lower": 0.0, "value": 0.3, "fixed": True}}
    rough = FORCE * np.where(np.arange(12) % 3 == 0, 0.3, 1.0)
    study = line(rough, changes=changes, options=Options(), noise=Noise(force=0.1))
    found = influence(fit(study, ONE))
    pressed, jacobian, second = force_of_k_1()
    k = found.result.value[0, 0]

    def slope(k, force):
        return (pressed(k) - force) @ jacobian(k)

    per_sigma = []
    for e in np.eye(12) * 1e-4:
        up, down = (
            scipy.optimize.brentq(slope, 0.5 * k, 2 * k, args=(rough + h,), xtol=1e-14)
            for h in (e, -e)
        )
        per_sigma.append(0.1 * (up - down) / 2e-4)
    curved = second(k) @ (pressed(k) - rough)
    assert abs(curved) > 0.01 * (jacobian(k) @ jacobian(k))  # Gauss and Newton would leave it out
    expected = np.array(per_sigma) / found.result.standard_error[0, 0]
    np.testing.assert_allclose(found.of.per_sigma[0, 0, 0], expected, rtol=1e-4)


def force_of_k_1():
    """F(k), dF/dk, d2F/dk2 at D, by Newton on the indentation: D = c (k d + k_3 d^3) + d."""
    c, k_3 = compliance(), 0.3

    def indentation(k):
        d = D.copy()
        for _ in range(60):
            d = d - (d + c * (k * d + k_3 * d**3) - D) / (1 + c * (k + 3 * k_3 * d**2))
        return d

    def force(k):
        return (D - indentation(k)) / c

    def first(k, h=1e-4):
        return (force(k + h) - force(k - h)) / (2 * h)

    def second(k, h=1e-3):
        return (force(k + h) - 2 * force(k) + force(k - h)) / h**2

    return force, first, second


def compliance():
    """Of Table 1's skeleton at s = 75 mm, from a press that is nearly rigid at the contact."""
    values = np.array([[300.0, 1.0, 1e9, 0.0]])
    force, _ = synthetic.forces(values, np.array([75.0]), np.array([1.0]))
    return 1 / force[0, 0, 0]


def test_a_step_is_bent_by_the_second_derivative():
    """F = exp(theta) D, exact data: the step v is bent by -v^2 / 2 (Transtrum and Sethna 2012)."""
    changes = {"k_1": {"scale": "log", "lower": 1e-3, "upper": 1e3, "value": 1.0, "step": 0.5}}
    study = line(1.3 * D, changes=changes)
    lane = jax.tree.map(lambda v: v[0], study.lanes)
    sigma, theta = jnp.ones(2), jnp.log(jnp.array([1.0]))

    @jax.jit
    def one_step(theta, lane, sigma):
        point = evaluate(study.model, theta, lane, sigma)
        objective = LaneCost(study.model, lane, sigma)
        state = trust_region.initial_state(theta, objective)._replace(
            point=point, radius=jnp.array(10.0)
        )
        step = trust_region._step(objective, state)
        return step.straight, step.delta

    straight, delta = one_step(theta, lane, sigma)
    v = 0.3  # (1.3 - 1) / 1, undamped within the trust region
    np.testing.assert_allclose(straight, v, rtol=1e-6)
    np.testing.assert_allclose(delta[0], v - v * v / 2, rtol=0.01)


def test_bounds_alone_are_known_as_uniform_distributions():
    """Before any measurement: variance of a number drawn between the bounds."""
    result = fit(line(FORCE, noise=Noise(force=0.1)), ONE)
    before = situation(result, with_data=False)
    drawn = np.linspace(0.01, 50.0, 100_001) / result.value[0, 0]
    np.testing.assert_allclose(1 / before.base[0, 0, 0], np.var(drawn), rtol=1e-4)


def test_starts_of_a_latin_hypercube_are_paired_at_random():
    """Each stratum once for each unknown, and no unknown in step with another."""
    force, _ = synthetic.forces(synthetic.draw(1, 1, 2.0))
    starts = draw_starts(synthetic.study(force), Settings(starts=201))[1:]
    ranks = np.argsort(np.argsort(starts, axis=0), axis=0)
    low, high = starts.min(axis=0), starts.max(axis=0)
    strata = np.floor((starts - low) / (high - low) * 200).clip(0, 199)
    assert np.abs(strata - ranks).max() <= 1
    pairs = scipy.stats.spearmanr(starts)[0][np.triu_indices(starts.shape[1], 1)]
    assert np.abs(pairs).max() < 0.35  # five standard deviations of 1 / sqrt(199)


@pytest.mark.slow
@pytest.mark.compiling
def test_each_end_moves_on_its_own_spring():
    """Unequal springs: an axial force F at s moves end A by F_A / k_A, springs and spans in series.

    F_A / F = (1 / k_B + (L - s) / EA) / (1 / k_A + 1 / k_B + L / EA).
    """
    springs = {"k_A": jnp.array(0.2), "k_B": jnp.array(1.5)}
    material = dataclasses.replace(MATERIAL, **springs)
    path = presses([-2, -4, 0], s=45.0)
    effects = EffectOptions(rings="mat", contact="bonded", dent="off", want_joints=False)
    scene = make_scene(TUBE, material, path, mesh=MESH, effects=effects)
    out = jax.jit(simulate)(scene, material, path)
    moved = np.asarray(out.vertices[-1] - out.vertices[0])[:, 0]
    at, length, EA = np.asarray(MESH.s), 160.0, 3.9
    F = float(out.force[-1, 0])
    softness = 1 / 0.2, 1 / 1.5, length / EA
    F_A = F * (softness[1] + (length - 45.0) / EA) / sum(softness)
    front = np.abs(np.asarray(MESH.phi)) < 0.2
    end_A, end_B = (moved[front & (np.abs(at - s) < 1e-9)].mean() for s in (0.0, length))
    np.testing.assert_allclose([end_A, end_B], [F_A / 0.2, (F - F_A) / 1.5], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_free_end_moves_as_the_contact_does():
    """All vertices were NaN there, with status OK. The limit of weak springs, and its derivative.

    Between the free end and C nothing stretches: the surface there moves by what C does,
    F (1 / k' + l / EA), l the way from C to the other end, which a spring k' holds.
    """

    def cast(v):
        def one(a):
            floating = jnp.issubdtype(jnp.asarray(a).dtype, jnp.floating)
            return jnp.asarray(a, "float64") if floating else a

        return jax.tree.map(one, v)

    material = dataclasses.replace(MATERIAL, k_A=0.0, k_B=0.5)
    path = presses([-2, -4, 0], s=45.0, rows=2)
    effects = EffectOptions(rings="mat", contact="bonded", dent="off", want_joints=False)
    scene = make_scene(TUBE, material, path, mesh=MESH, effects=effects)
    scene, material, path = cast(scene), cast(material), cast(path)

    def moved(k):
        out = simulate(scene, dataclasses.replace(material, k_A=k), path)
        return (out.vertices[-1] - scene.mesh.vertices)[:, 0], out

    run = jax.jit(lambda k: jax.jvp(moved, (k,), (jnp.ones_like(k),)))
    (u, out), (slope, _) = run(cast(0.0))
    assert out.status[-1] == PressStatus.OK
    assert u.dtype == "float64"
    wanted = float(out.force[-1, 0]) * (1 / 0.5 + (160.0 - 45.0) / 3.9)
    s, front = np.asarray(MESH.s), np.abs(np.asarray(MESH.phi)) < 0.2
    beyond = front & (s < 45)
    assert s[beyond].min() == 0
    eps = np.finfo("float64").eps
    # Vertices are read as places up to 160 mm away.
    np.testing.assert_allclose(u[beyond], wanted, atol=4 * eps * 160 + 1e3 * eps * abs(wanted))
    h = 1e-6
    weak = [run(cast(k))[0][0] for k in (h, 2 * h)]
    ahead = (4 * weak[0] - weak[1] - 3 * u) / (2 * h)  # one-sided, of second order
    size = np.max(np.abs(slope))
    assert np.all(np.isfinite(slope))
    rtol = 1e-5
    np.testing.assert_allclose(slope, ahead, atol=rtol * size)
