"""Fits of records in time: residual and Jacobian against the press, bounds, what is refused."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late import late

from jaxtrachea.fitting import forward_residual
from jaxtrachea.fitting.branch_times import unsampled_time
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.few_samples import serves
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.refusals import mixed_in_time
from jaxtrachea.fitting.residual import of_press, of_trials, residual, residual_value
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.usage import Usage
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press import press
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

GEOMETRY = Geometry.create(160.0, list(np.arange(10.0, 151.0, 10.0)))
MATERIAL = Material(EI_L=20.0, k_M=0.3, k_1=0.6, k_3=0.05, e_1=0.05, e_2=0.002)
GAMMA, TAU = np.array([0.9, 0.5]), np.array([0.36, 4.3])
#: Rest, ramp, hold, unloading until the tool is off, rest, and a shallower press.
CORNERS = np.array([0.0, 1.0, 3.0, 13.0, 13.5, 16.0, 18.0, 20.0])
WAY = np.array([-0.2, 0.0, 3.0, 3.0, -0.5, -0.5, 2.0, 2.0])


def clock(count=60):
    """Corners, and more samples where a hold begins."""
    rng = np.random.default_rng(1)
    return np.unique(np.r_[CORNERS, 3 + np.geomspace(0.01, 9, 20), rng.uniform(0, 20, count)])


def march(time, elastic, gamma):
    """Step by step, each exact for an elastic force that is straight; the tool does not pull."""
    h, before, out = np.zeros(gamma.size), 0.0, []
    for dt, e in zip(np.diff(time, prepend=time[0] - 1e-9), elastic, strict=True):
        x = dt / TAU
        kept, share = np.exp(-x), -gamma * np.expm1(-x) / x
        e = max(e, -np.sum(kept * h - share * before) / (1 + share.sum()))
        h = kept * h + share * (e - before)
        before = e
        out.append(max(e + h.sum(), 0.0))
    return np.array(out)


def curve(s, trial="a", options=Options(), gamma=GAMMA, noise=0.0, **more):
    """The elastic press, relaxed."""
    t = clock()
    D = np.interp(t, CORNERS, WAY)
    elastic = press(GEOMETRY, MATERIAL, s, D, dataclasses.replace(options, relaxation="off"))
    force = march(t, np.asarray(elastic.force), gamma)
    force = force + np.random.default_rng(int(s)).normal(0, noise, t.size)
    rise = (0, int(np.searchsorted(t, 3.0)) + 1)
    return Curve("s", trial, s, 0.0, D, force, time=t, rise=rise, **more)


RELAXING = Options(relaxation="uniform")
KINDS = {
    "line": (RELAXING, False),
    "fung": (dataclasses.replace(RELAXING, branches="fung"), False),
    "parts": (dataclasses.replace(RELAXING, relaxation="parts", skeleton="softening"), True),
}


def point_of(study, seed=3):
    guess = np.array([p.to_scaled(p.value) for p, _, _ in study.unknowns[0]])
    return jnp.asarray(guess + 0.2 * np.random.default_rng(seed).normal(size=guess.size))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["line", "parts", *late("fung")])
def test_residual_is_that_of_the_press_in_time(kind):
    """In closed form beside `press_in_time` in forward mode, through lift-off."""
    options, marked = KINDS[kind]
    rings = {}
    if marked:
        moved = np.full((clock().size, 2), 0.1)
        rings = {"joint_rings": np.array([2, 7]), "joint_displacement": moved}
    curves = [curve(28.0, **rings), curve(62.0, "b", **rings)]
    more = {"onset": {}} if kind == "line" else {}
    study = build_study(curves, GEOMETRY, options, more, noise=Noise(force=0.01, joints=0.1))
    lane = jax.tree.map(lambda v: jnp.asarray(v[0]), study.lanes)
    if lane.blend is not None:
        assert (np.asarray(lane.blend) > 0).all()

    @jax.jit
    def both(theta, lane):
        free = of_trials(study.model, theta, lane)
        plain = forward_residual.residual(study.model, free, of_press(lane), study.model.geometry)
        return (
            residual(study.model, theta, lane)[:2],
            residual_value(study.model, theta, lane),
            plain,
        )

    (value, jacobian), alone, (plain, slopes) = both(point_of(study), lane)
    assert np.isfinite(plain).all()
    np.testing.assert_allclose(value, plain, rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(alone, plain, rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(jacobian, slopes, rtol=1e-7, atol=1e-7 * np.abs(slopes).max())


@pytest.mark.long
def test_truth_is_found_again():
    """Of two positions, noise of 0.3 %: strengths and times as they are, none on a bound."""
    table = {n: {"fixed": True, "value": float(getattr(MATERIAL, n))} for n in ("EI_L", "k_M")}
    curves = [curve(s, t, noise=0.004) for s, t in ((28.0, "a"), (62.0, "b"))]
    study = build_study(curves, GEOMETRY, RELAXING, table | {"k_1": {}, "k_3": {}})
    result = fit(study, Settings())
    truth = {"k_1": 0.6, "k_3": 0.05, "gamma_1": 0.9, "gamma_2": 0.5, "tau_1": 0.36}
    truth["tau_ratio_2"] = TAU[1] / TAU[0]
    for i, (p, _, _) in enumerate(study.unknowns[0]):
        if p.name in truth:
            error = np.log(result.value[0, i] / truth[p.name])
            assert abs(error) < 4 * result.relative_se[0, i] + 1e-3, p.name
    assert result.rms[0, 0] == pytest.approx(0.004, rel=0.15)
    assert not result.at_bound.any()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_times_and_bounds_go_with_the_records(scale):
    """Of records so many times as long: first guesses, bounds and shared programs."""
    first = curve(28.0)
    study = build_study([first], GEOMETRY, RELAXING)
    longer = dataclasses.replace(first, time=first.time * scale)
    other = build_study([longer], GEOMETRY, RELAXING)
    assert other.model == study.model
    for p, q in zip(study.parameters, other.parameters, strict=True):
        if p.name == "tau_1":
            found = (q.value, q.lower, q.upper)
            np.testing.assert_allclose(found, np.array([p.value, p.lower, p.upper]) * scale)
            assert p.lower == pytest.approx(np.diff(first.time).min() / 3)
            assert p.upper == pytest.approx(3 * 20)
        else:
            assert (p.value, p.lower) == pytest.approx((q.value, q.lower))


def test_what_the_user_says_of_a_time_stays():
    study = build_study([curve(28.0)], GEOMETRY, RELAXING, {"tau_1": {"value": 0.5, "lower": 0.4}})
    tau = next(p for p in study.parameters if p.name == "tau_1")
    assert (tau.value, tau.lower) == (0.5, 0.4)


@pytest.mark.parametrize(
    ("time", "message"),
    [(None, "has no time"), (np.zeros(clock().size), "does not run"), (-clock(), "does not run")],
)
def test_a_curve_without_a_time_is_refused(time, message):
    other = dataclasses.replace(curve(28.0), time=time)
    with pytest.raises(ValueError, match=message):
        build_study([other], GEOMETRY, RELAXING)


@pytest.mark.parametrize("cause", ["before", "turning back", "window"])
def test_a_loading_cut_out_of_what_it_remembers_is_refused(cause):
    """What went before is in its force; the same loading from rest is fitted."""
    rising = curve(28.0).rising
    whole = Usage(recorded=90, used=rising.force.size, low=0.0, high=3.0, left_out={"after": 20})
    build_study([dataclasses.replace(rising, usage=whole)], GEOMETRY, RELAXING)
    cut = dataclasses.replace(whole, left_out={cause: 20})
    with pytest.raises(ValueError, match="which a force that relaxes remembers"):
        build_study([dataclasses.replace(rising, usage=cut)], GEOMETRY, RELAXING)


def test_an_elastic_model_is_told_that_it_mixes_a_record():
    curves = [curve(28.0), curve(62.0, "b").rising]
    assert "1 of 2 curves are whole records" in (mixed_in_time(curves, Options()) or "")
    assert mixed_in_time(curves, RELAXING) is None
    assert mixed_in_time(curves[1:], Options()) is None


def test_a_few_samples_say_nothing_of_a_past():
    study = build_study([curve(28.0)], GEOMETRY, RELAXING)
    long = jax.tree.map(lambda v: np.repeat(v, 2, axis=2) if v.ndim == 3 else v, study.lanes)
    many = dataclasses.replace(
        study, lanes=long._replace(value=study.lanes.value, index=study.lanes.index)
    )
    assert not serves(many, Settings(), 10_000)
    assert serves(
        dataclasses.replace(many, lanes=many.lanes._replace(time=None)), Settings(), 10_000
    )


def times_told(word, span, **spread):
    """What is said of each unknown of a fit of a record of so many s, of 95 % factors by name."""
    first = curve(28.0)
    low, high = span
    time = np.r_[0.0, low, np.full(first.force.size - 2, high)]
    made = dataclasses.replace(first, time=time)
    options = dataclasses.replace(RELAXING, branches=word)
    study = build_study([made], GEOMETRY, options)
    names = [p.name for p, _, _ in study.unknowns[0]]
    value = np.array([[spread.get(n, (p.value, 1))[0] for n, (p, _, _) in
                       zip(names, study.unknowns[0], strict=True)]])  # fmt: skip
    error = np.array([np.log(spread.get(n, (1, 1.01))[1]) / 2 for n in names])
    result = types.SimpleNamespace(
        study=study, theta=value, value=value,
        uncertainty=types.SimpleNamespace(covariance=np.diag(error**2)[None], half_width=[2.0]),
        effective=types.SimpleNamespace(growth=[1.0]),
    )  # fmt: skip
    return {n: unsampled_time(result, 0, i) for i, n in enumerate(names)}


def test_strengths_are_told_where_their_times_are_sampled():
    """The density of `fung` where its box reaches surely into the records; `power` of a decade."""
    span = 0.1, 30.0
    fine = times_told("fung", span, tau_1=(0.5, 1.5), tau_2=(20.0, 1.2))
    assert set(fine.values()) == {""}
    wide = times_told("fung", span, tau_1=(0.5, 1.5), tau_2=(60.0, 1.2))
    assert wide["C"] == ""
    assert wide["tau_2"].startswith("the record is shorter than tau_2")
    for tau_1, tau_2 in (((20.0, 2.0), (60.0, 1.2)), ((0.01, 1.2), (0.15, 2.0))):
        told = times_told("fung", span, tau_1=tau_1, tau_2=tau_2)
        assert told["C"] == "tau_1 to tau_2 may lie beyond what the records tell, 0.1 to 30 s"
    assert not any(times_told("power", span).values())
    for name in ("gamma", "beta"):
        assert "needs a decade" in times_told("power", (0.1, 0.8))[name]
