"""A force that relaxes: closed forms, an ODE, laws of relaxation, energy, derivatives, lift-off."""

import functools

import jax
import jax.numpy as jnp
import maxwell
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import exp1

from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.relaxation_energy import energy
from jaxtrachea.relaxation.filter import overloads, relax, relax_with_derivatives
from jaxtrachea.relaxation.laws import LAWS, Span, branches
from jaxtrachea.relaxation.steps import Branches, bonded_in_parallel, fading, mean_kept

TWO = np.array([0.9, 0.5]), np.array([0.36, 4.3])
#: Load, hold, unload until the tool is off, wait, and load again.
JOURNEY = np.array([0.0, 1, 6, 7, 9, 10]), np.array([0.0, 4, 4, -0.5, -0.5, 3])


def two() -> Branches:
    return Branches(*TWO)


#: One program a law and span.
branches_of = jax.jit(branches, static_argnames=("word", "span"))


def journey(count=170):
    """Times without a common step, and the elastic force of the journey."""
    rng = np.random.default_rng(3)
    t = np.sort(np.r_[JOURNEY[0], rng.uniform(0, 10, count)])
    return t, np.interp(t, *JOURNEY)


@functools.partial(jax.jit, static_argnames="unilateral")
def run(time, elastic, gamma, tau, unilateral=True):
    return relax(time, elastic, Branches(gamma, tau), unilateral)


def padded(values, length):
    """Its last sample again and again, which changes nothing; records of one length share code."""
    return np.pad(values, (0, length - len(values)), mode="edge")


def ramp_and_hold(t, top, until, gamma, tau):
    """Force of an elastic force that rises evenly to `top` at the time `until`."""
    risen, rate = np.minimum(t, until), top / until
    force = rate * risen
    for g, s in zip(gamma, tau, strict=True):
        force = force + rate * g * s * (np.exp(-(t - risen) / s) - np.exp(-t / s))
    return force


def test_ramp_and_hold_is_the_closed_form_at_any_samples():
    rng = np.random.default_rng(0)
    t = np.sort(np.r_[0, 2.0, rng.uniform(0, 12, 97), 12])
    elastic = np.minimum(t, 2) * 0.25
    exact = ramp_and_hold(t, 0.5, 2.0, *TWO)
    for unilateral in (True, False):
        found = run(t, elastic, *two(), unilateral=unilateral)
        assert np.abs(np.asarray(found.force) - exact).max() < 1e-12 * exact.max()
        np.testing.assert_array_equal(found.elastic, elastic)


def test_a_sinus_stores_and_loses_as_its_moduli_say():
    """Of second order in the step, 1e-3 at 64 samples a period; bonded, once it is steady."""
    omega, errors = 2.0, []
    iw = 1j * omega * TWO[1]
    exact = 1 + np.sum(TWO[0] * iw / (1 + iw))
    for count in (64, 128, 256):
        t = np.arange(40 * count + 1) * (2 * np.pi / omega / count)
        given = padded(t, 40 * 256 + 1), padded(np.sin(omega * t), 40 * 256 + 1)
        force = np.asarray(run(*given, *two(), unilateral=False).force)[: t.size][-count:]
        modulus = 2 / count * np.sum(force * np.exp(-1j * (omega * t[-count:] - np.pi / 2)))
        errors.append(abs(modulus - exact) / abs(exact))
    assert errors[0] < 1e-3
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2, atol=0.05)


@pytest.mark.long
def test_lift_off_and_recovery_are_those_of_the_differential_equation():
    """While the tool is off the surface creeps and meets it again: of second order in the step."""
    errors = []
    for count in (200, 400, 800):
        t = np.linspace(0, 10, count + 1)
        force, elastic = maxwell.force_in_time(t, JOURNEY, *TWO)
        found = run(padded(t, 801), padded(np.interp(t, *JOURNEY), 801), *two())
        found = [np.asarray(v)[: t.size] for v in found]
        assert np.all((found[0] == 0) == (force <= 1e-12))
        for one, other in zip(found, (force, elastic), strict=True):
            errors.append(np.abs(one - other).max() / force.max())
    assert 0.05 * count < np.sum(force == 0) < 0.3 * count
    assert max(errors[-2:]) < 2e-5  # the step in which the tool leaves or lands is not resolved
    assert min(errors[0] / errors[4], errors[1] / errors[5]) > 10


def test_a_branch_that_is_fast_leaves_the_elastic_force_and_a_slow_one_multiplies_it():
    t, elastic = journey()
    for tau in (1e-300, 1e-12):
        found = run(t, elastic, np.array([0.9]), np.array([tau]))
        np.testing.assert_allclose(found.force, np.maximum(elastic, 0), rtol=0, atol=1e-9)
    for tau in (1e12, 1e300, np.inf):
        found = run(t, elastic, np.array([0.9]), np.array([tau]))
        np.testing.assert_allclose(found.force, 1.9 * np.maximum(elastic, 0), rtol=1e-9, atol=1e-9)


@jax.jit
@functools.partial(jax.value_and_grad, argnums=(1, 2, 3))
def summed(t, elastic, gamma, log_tau):
    found = relax(t, elastic, Branches(gamma, jnp.exp(log_tau)))
    return jnp.sum(found.force + found.elastic)


@pytest.mark.parametrize("tau", [1e-300, 1e-30, 1e-3, 1.0, 1e30, 1e300])
def test_any_step_and_any_time_is_finite_with_its_derivatives(tau):
    t = np.array([0, 0, 1e-300, 1e-9, 1, 1, 3, 1e9, 1e300])
    elastic = np.array([0, 1.0, 2, 3, 3, 1, -4, 2, 1])
    value, slopes = summed(t, elastic, np.array([0.9, 0.3]), np.log([tau, tau]))
    assert all(np.isfinite(v).all() for v in (value, *slopes))


def test_samples_at_one_time_and_padding_change_nothing():
    t, elastic = journey()
    plain = run(t, elastic, *two())
    length = 2 * len(t)
    twice = run(np.repeat(t, 2), np.repeat(elastic, 2), *two())
    np.testing.assert_allclose(np.asarray(twice.force)[::2], plain.force, rtol=0, atol=1e-14)
    longer = run(padded(t, length), padded(np.append(elastic, 7.0), length), *two())
    found, last = np.split(np.asarray(longer.force), [len(t)])
    np.testing.assert_array_equal(found, plain.force)
    jump = 1 + TWO[0].sum()
    assert last[0] - found[-1] == pytest.approx(jump * (7 - elastic[-1]))


def test_records_a_thousand_times_as_slow_have_the_same_forces():
    t, elastic = journey()
    plain = run(t, elastic, *two())
    for factor in (1e-3, 1e3):
        found = run(t * factor, elastic, two().gamma, two().tau * factor)
        np.testing.assert_allclose(found.force, plain.force, rtol=0, atol=1e-12)


def test_a_bonded_contact_is_linear_and_the_same_in_parallel():
    t, elastic = journey()
    found = run(t, elastic, *two(), unilateral=False)
    parallel = jax.jit(lambda b: bonded_in_parallel(*fading(t, b), elastic, b.gamma))(two())
    np.testing.assert_allclose(parallel, found.force, rtol=0, atol=1e-14)
    assert np.asarray(found.force).min() < -0.5
    vectors = np.asarray(elastic)[:, None] * np.array([1.0, 2, -1])
    together = run(t, vectors, *two(), unilateral=False)
    expected = np.asarray(found.force)[:, None] * np.array([1.0, 2, -1])
    np.testing.assert_allclose(together.force, expected, rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="unilateral=False"):
        run(t, vectors, *two())


LANES = 5


def lanes():
    """Different journeys side by side."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.uniform(0, 10, (LANES, 60)), axis=1)
    elastic = np.stack([np.interp(v, *JOURNEY) for v in t]) * rng.uniform(0.5, 2, (LANES, 1))
    gamma, tau = rng.uniform(0.2, 1, (LANES, 2)), 10 ** rng.uniform(-1, 1, (LANES, 2))
    return [t, elastic, gamma, tau]


@pytest.mark.parametrize("unilateral", [True, False])
def test_many_lanes_are_each_as_if_alone(unilateral):
    @jax.jit
    def one(t, elastic, gamma, tau):
        return relax(t, elastic, Branches(gamma, tau), unilateral)

    together = jax.jit(jax.vmap(one))(*lanes())
    twice = jax.jit(jax.vmap(jax.vmap(one), in_axes=(0, 0, 0, None)))(
        *(np.stack([v, v]) for v in lanes()[:3]), lanes()[3]
    )
    together, twice = ([np.asarray(v) for v in found] for found in (together, twice))
    for i, given in enumerate(zip(*lanes(), strict=True)):
        alone = one(*given)
        for side in (0, 1):
            np.testing.assert_allclose(together[side][i], alone[side], rtol=0, atol=1e-14)
            np.testing.assert_allclose(twice[side][1, i], alone[side], rtol=0, atol=1e-14)


@pytest.mark.parametrize("unilateral", [True, False])
def test_derivatives_in_both_modes_are_those_of_differences(unilateral):
    t, elastic = (v[1:] for v in journey(40))  # before the first sample there is a corner
    given = elastic, *map(np.log, TWO)

    @jax.jit
    def of(elastic, log_gamma, log_tau):
        given = Branches(jnp.exp(log_gamma), jnp.exp(log_tau))
        return tuple(relax(jnp.asarray(t), jnp.asarray(elastic), given, unilateral))

    check_grads(of, given, order=1, rtol=1e-6, atol=1e-6, eps=1e-6)
    if unilateral:
        assert np.sum(np.asarray(of(*given)[0]) == 0) > 3


@pytest.mark.long
@pytest.mark.parametrize("unilateral", [True, False])
def test_derivatives_beside_the_value_are_those_of_jax_through_lift_off(unilateral):
    t, elastic, *_ = lanes()

    def of(t, e, scale, log_gamma, log_tau):
        moved = scale[0] * e + scale[1] * e * e * e
        return tuple(relax(t, moved, Branches(jnp.exp(log_gamma), jnp.exp(log_tau)), unilateral))

    def beside(t, e, scale, log_gamma, log_tau):
        moved = scale[0] * e + scale[1] * e * e * e
        given = Branches(jnp.exp(log_gamma), jnp.exp(log_tau))
        columns = jnp.stack([e, e * e * e])
        return relax_with_derivatives(t, moved, columns, given, unilateral, surface=True)

    given = np.array([1.0, 0.05]), *map(np.log, TWO)
    axes = (0, 0, None, None, None)
    value, by = jax.jit(jax.vmap(beside, axes))(t, elastic, *given)
    expected = jax.jit(jax.vmap(jax.jacfwd(of, argnums=(2, 3, 4)), axes))(t, elastic, *given)
    plain = jax.jit(jax.vmap(of, axes))(t, elastic, *given)
    for i in (0, 1):
        np.testing.assert_allclose(value[i], plain[i], rtol=0, atol=1e-13)
        rows = np.moveaxis(np.concatenate(expected[i], axis=-1), -1, 1)
        np.testing.assert_allclose(by[i], rows, rtol=0, atol=1e-11)

    def of_lanes(scale):
        return jax.vmap(beside, axes)(t, elastic, scale, *given[1:])[0]

    # Differentiated once more, as influence does: value, and direction of the first column.
    along = jax.jit(lambda scale: jax.jvp(of_lanes, (scale,), (jnp.asarray([1.0, 0.0]),))[1])
    for i, moved in enumerate(along(given[0])[:2]):
        np.testing.assert_allclose(moved, by[i][:, 0], rtol=0, atol=1e-11)
    alone = jax.eval_shape(relax_with_derivatives, t[0], elastic[0], elastic[:1], two())
    assert alone[1].elastic is None


@pytest.mark.long
def test_directions_chain_a_law_of_few_numbers_to_its_branches():
    t, elastic = map(jax.device_put, journey(60))
    span, given = Span(0.05, 10.0), np.array([0.7, 0.2])

    def of(given):
        return branches("power", dict(zip(("gamma", "beta"), given, strict=True)), span)

    @jax.jit
    def both(given):
        along = jax.tree.map(jnp.transpose, jax.jacfwd(of)(given))
        _, by = relax_with_derivatives(t, elastic, elastic[None], of(given), along=along)
        return by.force, jax.jacfwd(lambda v: relax(t, elastic, of(v)).force)(given)

    force, expected = both(given)
    np.testing.assert_allclose(np.asarray(force)[1:], np.asarray(expected).T, rtol=0, atol=1e-12)


@pytest.mark.long
def test_no_path_gives_more_work_than_was_put_in():
    """Random paths, laws and branches with lift-off; the work is integrated here.

    Within a step the elastic force is linear in time and each branch a known exponential.
    """
    rng = np.random.default_rng(8)
    n, steps = 100, 80
    knots = np.cumsum(rng.uniform(0.1, 1, (n, 9)), axis=1)
    heights = rng.uniform(-1, 3, (n, 9)) * 10 ** rng.uniform(-1, 1, (n, 1))
    t = np.stack([np.linspace(0, k[-1], steps) for k in knots])
    tool = np.stack([np.interp(v, *given) for v, *given in zip(t, knots, heights, strict=True)])
    gamma, tau = 10 ** rng.uniform(-2, 1, (n, 2)), 10 ** rng.uniform(-0.9, 2, (n, 2))
    c, k = 10 ** rng.uniform(-1, 1, n), 10 ** rng.uniform(-2, 1, (n, 3))
    k[:, 1:] *= rng.random((n, 2)) < 0.7

    def one(t, tool, gamma, tau, c, k):
        law, made = Law(k[0], k[1], k[2]), Branches(gamma, tau)
        found = relax(t, tool, made)
        e, h = found.elastic, overloads(t, found.elastic, made)
        e_0, h_0 = (jnp.concatenate([jnp.zeros_like(v[:1]), v[:-1]]) for v in (e, h))
        dt = jnp.diff(t, prepend=t[:1])
        d = law.root(e, jnp.ones_like(e), 0.0)
        d_0, moved = jnp.append(0, d[:-1]), jnp.where(e == e_0, 1, e - e_0)

        def share(place, weight):
            depth = d_0 + (1 + place) / 2 * (d - d_0)  # smooth in it, however steep the law
            now = law.force(depth)
            lapsed = ((now - e_0) / moved * dt)[:, None] / tau[None]
            carried = gamma[None] * mean_kept(lapsed) * (now - e_0)[:, None]
            force = now + jnp.sum(jnp.exp(-lapsed) * h_0 + carried, axis=-1)
            return weight / 2 * force * (1 + c * law.tangent(depth)) * (d - d_0)

        work = jnp.sum(jax.vmap(share)(*np.polynomial.legendre.leggauss(12)), axis=0)
        return jnp.cumsum(work), found.force, energy(t, e, made, law, c)

    found = jax.jit(jax.vmap(one))(t, tool, gamma, tau, c, k)
    work, force, (stored, dissipated) = jax.tree.map(np.asarray, found)
    peak = np.maximum(np.abs(work), np.abs(stored)).max(1, keepdims=True)
    assert np.mean(np.any(force[:, 1:] == 0, axis=1)) > 0.7
    taken = work - stored
    assert (taken / peak).min() > -1e-9
    assert (np.diff(taken, axis=1) / peak).min() > -1e-9
    assert (stored / peak).min() > -1e-12
    assert np.diff(dissipated, axis=1).min() >= 0
    off = np.abs((taken - dissipated) / peak).max(1)  # of places in time, which a steep law sees
    assert np.median(off) < 1e-9
    assert off.max() < 1e-3


def reduced(t, made):
    """The reduced relaxation function, without what lasts."""
    return np.exp(-t[:, None] / np.asarray(made.tau)) @ np.asarray(made.gamma)


@pytest.mark.parametrize("beta", [0.05, 0.1, 0.2, 0.35, 0.4])
def test_the_power_law_is_one_from_the_shortest_step_to_the_longest_record(beta):
    for span in (Span(1e-3, 1e3), Span(0.02, 30.0), Span(0.5, 0.5)):
        made = branches_of("power", {"gamma": 0.8, "beta": beta}, span)
        t = np.geomspace(span.shortest, span.longest, 400)
        np.testing.assert_allclose(reduced(t, made), 0.8 * t**-beta, rtol=1e-3)


@pytest.mark.parametrize("beta", [0.1, 0.4])
def test_a_ramp_of_the_power_law_counts_what_relaxes_within_a_step(beta):
    """The closed form t^(1 - beta) / (1 - beta); without the fast rest it is short by up to 1 %."""
    t = np.linspace(0, 10, 201)
    made = branches_of("power", {"gamma": 1.0, "beta": beta}, Span(0.05, 10))
    exact = t + t ** (1 - beta) / (1 - beta)
    found = np.asarray(run(t, t, made.gamma, made.tau).force)
    np.testing.assert_allclose(found[1:], exact[1:], rtol=1.5e-3)


@pytest.mark.parametrize("apart", [1.01, 100.0, 1e4])
def test_the_box_of_fung_is_the_difference_of_exponential_integrals(apart):
    values = {"C": 0.2, "tau_1": 0.01, "tau_2": 0.01 * apart}
    made = branches_of("fung", values, Span(0.1, 1))
    t = np.geomspace(1e-3, 1e3, 400)
    exact = 0.2 * (exp1(t / values["tau_2"]) - exp1(t / values["tau_1"]))
    assert np.abs(reduced(t, made) - exact).max() < 1e-4 * 0.2 * np.log(apart)


def test_prony_keeps_its_branches_in_order():
    values = {"gamma_1": 0.5, "gamma_2": 0.4, "gamma_3": 0.3, "tau_1": 0.2,
              "tau_ratio_2": 3.0, "tau_ratio_3": 10.0}  # fmt: skip
    made = branches_of("prony-3", values, Span(0.1, 1))
    np.testing.assert_allclose(made.gamma, [0.5, 0.4, 0.3])
    np.testing.assert_allclose(made.tau, [0.2, 0.6, 6.0])
    assert LAWS["prony-1"].names == ("gamma_1", "tau_1")


def test_a_law_names_what_it_lacks():
    with pytest.raises(ValueError, match="'fung' needs tau_1, tau_2"):
        branches("fung", {"C": jnp.asarray(1.0)}, Span(0.1, 1))
    with pytest.raises(ValueError, match="shortest <= longest"):
        branches("prony-1", {"gamma_1": jnp.asarray(1.0), "tau_1": jnp.asarray(1.0)}, Span(2, 1))
