"""Presses in time: parts against an ODE and against uniform, lift-off, what is refused."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.press_in_time import press_in_time
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.relaxation.laws import Span, names, relaxation
from jaxtrachea.relaxation.steps import Branches
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

TUBE = Geometry.create(60.0, [15.0, 30.0, 45.0], radius=11.7)
VALUES = {"EI_L": 60.0, "k_M": 3.0, "k_1": 0.3, "k_3": 0.02}
QUINTIC = Material(**VALUES, k_5=0.003)
TWO = Branches(jnp.asarray([0.9, 0.5]), jnp.asarray([0.36, 4.3]))
OTHER = Branches(jnp.asarray([0.6]), jnp.asarray([1.7]))
UNIFORM, PARTS = Options(relaxation="uniform"), Options(relaxation="parts")
TIMES = np.unique(np.r_[np.linspace(0, 1, 40), np.linspace(1, 6, 50), np.linspace(6, 10, 110)])
#: Samples of most records here: of one length they share their programs.
LENGTH = len(TIMES) + 3


def padded(values, length=LENGTH):
    """Its last sample again and again, which changes nothing."""
    return np.pad(values, (0, length - len(values)), mode="edge")


TIMES = padded(TIMES)
WAY = np.interp(TIMES, [0, 1, 6, 7, 9, 10], [0, 4, 4, 0.2, 0.2, 3])


@functools.partial(jax.jit, static_argnames="options")
def run(material, relaxes, options, time=TIMES, way=WAY, s_c=22.0):
    return press_in_time(TUBE, material, Motion(s_c, way, time=time), relaxes, options)


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "material"),
    [
        ({"local": "two-material"}, dataclasses.replace(QUINTIC, k_1_ring=jnp.asarray(2.0))),
        ({"contact": "bonded"}, QUINTIC),
        ({"skeleton": "softening"}, Material(**VALUES, e_1=0.08, e_2=0.003)),
    ],
    ids=["two-material", "bonded", "softening"],
)
def test_parts_that_relax_alike_are_the_uniform_level(change, material):
    """With lift-off and recovery; two programs that share no equilibrium."""
    one = run(material, Relaxation(TWO), dataclasses.replace(UNIFORM, **change))
    two = run(material, Relaxation(TWO, TWO), dataclasses.replace(PARTS, **change))
    off = np.asarray(one.force) == 0
    assert change.get("contact") == "bonded" or 30 < off.sum() < 150
    for name in ("force", "depth", "skeleton", "joints", "reactions"):
        a, b = (np.asarray(getattr(v, name)) for v in (one, two))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(a).max(), err_msg=name)
    np.testing.assert_array_equal(one.status, two.status)
    assert set(np.unique(one.status)) <= {PressStatus.OK, PressStatus.NO_CONTACT}
    # Of the surface, in or out of contact: depth and skeleton make its displacement.
    way = np.asarray(one.depth + one.skeleton)
    np.testing.assert_allclose(way[~off], WAY[~off], atol=2e-3)
    assert np.all(way[off] > WAY[off] - 1e-12) or not off[1:].any()


@pytest.mark.long
def test_without_strength_it_is_the_elastic_press():
    none = Branches(jnp.zeros(2), TWO.tau)
    plain = press(TUBE, QUINTIC, 22.0, WAY)
    for options, relaxes in ((UNIFORM, Relaxation(none)), (PARTS, Relaxation(none, none))):
        found = run(QUINTIC, relaxes, options)
        for a, b in zip(found, plain, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def parts_by_ode(times, way, rate, c, law, local, skeleton, top):
    """Force of two relaxing parts in series; unknown is the depth, and what the branches carry."""
    (g, tau), (g_s, tau_s) = (tuple(map(np.asarray, b)) for b in (local, skeleton))
    k_1, k_3, k_5 = law

    def change(t, y):
        d, h, q = y[0], y[1 : 1 + len(g)], y[1 + len(g) :]
        stiff = k_1 + 3 * k_3 * d**2 + 5 * k_5 * d**4
        a, a_s = (1 + g.sum()) * stiff, (1 + g_s.sum()) / c
        dd = (a_s * rate(t) - np.sum(q / tau_s) + np.sum(h / tau)) / (a + a_s)
        return np.concatenate(
            [[dd], g * stiff * dd - h / tau, g_s / c * (rate(t) - dd) - q / tau_s]
        )

    start = np.zeros(1 + len(g) + len(g_s))
    found = solve_ivp(change, (0, top), start, method="Radau", rtol=1e-11, atol=1e-13, t_eval=times)
    d = found.y[0]
    force = k_1 * d + k_3 * d**3 + k_5 * d**5 + found.y[1 : 1 + len(g)].sum(0)
    return force, way(times) - d


@pytest.mark.long
@pytest.mark.parametrize("softens", [False, True])
def test_parts_apart_are_those_of_the_differential_equation(softens):
    """Order 2 in the step. Softening multiplies the force of small strain.

    It is that of the way of an elastic press whose skeleton is as deflected.
    """
    change = {"e_1": 0.08, "e_2": 0.003} if softens else {}
    skeleton = "softening" if softens else "linear"
    options = dataclasses.replace(PARTS, skeleton=skeleton, contact="bonded")
    material = dataclasses.replace(QUINTIC, **{k: jnp.asarray(v) for k, v in change.items()})
    c = float(press(TUBE, QUINTIC, 22.0, 0.0).compliance)

    def way(t):
        return 3 * np.sin(0.8 * t) ** 2

    def rate(t):
        return 2.4 * np.sin(1.6 * t)

    t = np.linspace(0, 3.5, 481)
    force, u = parts_by_ode(t, way, rate, c, (0.3, 0.02, 0.003), TWO, OTHER, 3.5)
    d = [brentq(lambda d, F=F: 0.3 * d + 0.02 * d**3 + 0.003 * d**5 - F, -9, 9) for F in u / c]
    force *= 1 - (u + d) * (change.get("e_1", 0) - change.get("e_2", 0) * (u + d))
    errors = []
    for each in (8, 4, 2, 1):
        some, exact = padded(t[::each], len(t)), force[::each]
        found = np.asarray(run(material, Relaxation(TWO, OTHER), options, some, way(some)).force)
        errors.append(np.abs(found[: len(exact)] - exact).max() / exact.max())
    assert errors[-1] < 1e-5
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all((orders > 1.9) & (orders < 2.1)), orders


@pytest.mark.long
@pytest.mark.parametrize(("options", "relaxes"), [(UNIFORM, Relaxation(TWO)),
                                                  (PARTS, Relaxation(TWO, OTHER))])  # fmt: skip
def test_samples_back_in_time_or_at_no_place_are_as_if_not_there(options, relaxes):
    plain = run(QUINTIC, relaxes, options)
    time = np.insert(TIMES[:-3], [50, 120], [0.5, np.nan])
    way = np.insert(WAY[:-3], [50, 120], [9.0, 1.0])
    time, way = np.insert(time, 80, time[80]), np.insert(way, 80, np.nan)
    found = run(QUINTIC, relaxes, options, time, way)
    bad = [50, 80, 122]
    stays = np.delete(np.arange(len(time)), bad)
    for name in ("force", "depth", "joints", "status"):
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(plain, name))
        np.testing.assert_allclose(a[stays], b[:-3], rtol=0, atol=1e-14)
        assert name == "status" or np.isnan(a[bad]).all()
    back, nowhere = PressStatus.BACK_IN_TIME, PressStatus.NON_FINITE
    assert np.asarray(found.status)[bad].tolist() == [back, nowhere, back]


@pytest.mark.long
@pytest.mark.parametrize(("options", "relaxes"), [(UNIFORM, Relaxation(TWO)),
                                                  (PARTS, Relaxation(TWO, OTHER))])  # fmt: skip
def test_after_a_fold_there_is_no_history(options, relaxes):
    """Nor a derivative: those of the samples before are untouched."""
    soft = dataclasses.replace(QUINTIC, k_3=jnp.asarray(-0.05), k_5=None)
    found = run(soft, relaxes, options)
    elastic = np.asarray(press(TUBE, soft, 22.0, WAY).status)
    first = np.argmax(elastic > PressStatus.NO_CONTACT)
    lost = np.asarray(found.status) == elastic[first]
    assert 10 < first < 40
    assert lost[first:].all()
    assert np.isnan(np.asarray(found.force)[first:]).all()
    cut = run(soft, relaxes, options, padded(TIMES[:first]), padded(WAY[:first]))
    forces = (np.asarray(v.force)[:first] for v in (found, cut))
    np.testing.assert_allclose(*forces, rtol=0, atol=1e-14)

    def before(k_1):
        given = dataclasses.replace(soft, k_1=k_1)
        return jnp.sum(run(given, relaxes, options).force[: first - 1])

    assert np.isfinite(jax.jit(jax.grad(before))(jnp.asarray(0.3)))


def test_a_branch_that_is_none_is_told():
    for change, status in ((-0.1, PressStatus.BAD_MATERIAL), (np.nan, PressStatus.NON_FINITE)):
        bad = Branches(TWO.gamma.at[0].set(change), TWO.tau)
        found = run(QUINTIC, Relaxation(bad), UNIFORM)
        assert set(np.unique(found.status)) == {status}
        assert np.isnan(found.force).all()


@pytest.mark.long
def test_derivatives_through_lift_off():
    """By stiffnesses, branches and displacement, in both modes."""
    way = np.interp(TIMES[::8], [0, 1, 6, 7, 9, 10], [0, 4, 4, 0.2, 0.2, 3])

    def of(values, log_gamma, log_tau, way):
        material = Material(values[0], values[1], values[2], values[3], k_5=values[4])
        branches = Branches(jnp.exp(log_gamma), jnp.exp(log_tau))
        found = run(
            material, Relaxation(branches, OTHER), PARTS, jnp.asarray(TIMES[::8]), jnp.asarray(way)
        )
        return found.force[1:], found.depth[1:], found.skeleton[1:]

    values = jnp.asarray([60.0, 3.0, 0.3, 0.02, 0.003])
    given = values, jnp.log(TWO.gamma), jnp.log(TWO.tau), jnp.asarray(way + 0.01)
    assert np.sum(np.asarray(of(*given)[0]) == 0) > 5
    check_grads(jax.jit(of), given, order=1, rtol=1e-6, atol=1e-6, eps=1e-6)


@pytest.mark.long
def test_many_presses_side_by_side_are_each_as_if_alone():
    rng = np.random.default_rng(1)
    gamma, tau = rng.uniform(0.2, 1, (3, 2)), rng.uniform(0.2, 3, (3, 2))

    def one(gamma, tau, way):
        return run(QUINTIC, Relaxation(Branches(gamma, tau), OTHER), PARTS, way=way)

    way = np.stack([WAY, 0.5 * WAY, WAY[::-1]])
    given = jnp.asarray(gamma), jnp.asarray(tau), jnp.asarray(way)
    together = jax.jit(jax.vmap(one))(*given)
    for i in range(3):
        for a, b in zip(together, one(*(v[i] for v in given)), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=0, atol=1e-13)


def test_what_knows_no_time_refuses_it_by_name():
    with pytest.raises(ValueError, match="press knows no time.*press_in_time"):
        press(TUBE, QUINTIC, 22.0, 1.0, UNIFORM)
    with pytest.raises(ValueError, match="relaxation is 'off'"):
        run(QUINTIC, Relaxation(TWO), Options())
    with pytest.raises(ValueError, match="'uniform', found branches of the skeleton"):
        run(QUINTIC, Relaxation(TWO, TWO), UNIFORM)
    with pytest.raises(ValueError, match="'parts', found no branches"):
        run(QUINTIC, Relaxation(TWO), PARTS)
    with pytest.raises(ValueError, match="coupling='series'"):
        Options(relaxation="parts", coupling="total")
    with pytest.raises(ValueError, match="not derived for skeleton='sections'"):
        Options(relaxation="parts", skeleton="sections", contact="bonded")
    with pytest.raises(ValueError, match="shortest"):
        Options(relaxation="uniform", shortest=2.0, longest=1.0)
    with pytest.raises(ValueError, match="time has"):
        run(QUINTIC, Relaxation(TWO), UNIFORM, TIMES[1:])
    for motion, words in (
        (Motion(22.0, WAY), "no time"), (Motion(22.0, WAY, phi_c=0.1, time=TIMES), "midline"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            press_in_time(TUBE, QUINTIC, motion, Relaxation(TWO), UNIFORM)


def test_numbers_of_the_skeleton_end_in_its_name():
    values = {name: jnp.asarray(1.0 + i) for i, name in enumerate(names("prony-1", parts=True))}
    assert list(values) == ["gamma_1", "tau_1", "gamma_1_skeleton", "tau_1_skeleton"]
    found = relaxation("prony-1", values, Span(0.1, 1), parts=True)
    assert [float(v[0]) for v in jax.tree.leaves(found)] == [1, 2, 3, 4]
    assert relaxation("prony-1", values, Span(0.1, 1)).skeleton is None
