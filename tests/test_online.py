"""`Online` against the fit of the same samples, scipy, differences, and what a fit refuses."""

import dataclasses

import compilations
import numpy as np
import pytest
import synthetic
from scipy.optimize import least_squares

import jaxtrachea as jt
from jaxtrachea.fitting.assessment import assess
from jaxtrachea.inference.design.candidates import Candidates
from jaxtrachea.inference.design.choice import next_points
from jaxtrachea.inference.design.situation import situation
from jaxtrachea.status import FitStatus
from jaxtrachea.viewer.stream import Experiment, Stream

pytestmark = pytest.mark.long

TRUTH = np.array([300.0, 1.0, 0.5, 0.2])
S = np.array([22.0, 75.0, 80.0, 45.0])
SIGMA, DEPTH = 0.05, 6.0
#: No one reads what a fit looks for beyond the local error.
ONE = jt.Settings(starts=1, verify=False)
ZEROS = ("onset", "force_offset")


def online(parameters=None, **changes):
    given = {"noise": jt.Noise(force=SIGMA), "depth": DEPTH} | changes
    table = synthetic.parameters() if parameters is None else parameters
    return jt.Online(synthetic.GEOMETRY, synthetic.OPTIONS, table, **given)


def measured(s=S, truth=TRUTH, seed=0):
    force = synthetic.forces(truth[None], s_c=s)[0][0]
    return force + SIGMA * np.random.default_rng(seed).normal(size=force.shape)


def intervals(result):
    found = [assess(result, 0, i) for i in range(4)]
    return [[a.low for a in found], [a.high for a in found]]


def pressed(one, force, s=S, displacement=synthetic.DEPTHS):
    """Sample by sample; all states."""
    states = []
    for at, row in zip(s, force, strict=True):
        one.press(at)
        states += [one.add(d, f) for d, f in zip(displacement, row, strict=True)]
    return states


@pytest.fixture(scope="module")
def run():
    """A stream, its states, what it settled at, and the fit of the same samples."""
    one = online()
    states = pressed(one, measured())
    settled = one.settle()
    return one, states, settled, jt.fit(one.study(), ONE)


def test_settled_it_is_the_fit_of_the_same_samples(run):
    _, states, settled, result = run
    assert settled.status == FitStatus.CONVERGED == result.status[0]
    np.testing.assert_allclose(settled.value, result.value[0], rtol=1e-6)
    covariance = result.uncertainty.covariance[0]
    np.testing.assert_allclose(settled.covariance, covariance, rtol=1e-6)
    of_fit = [assess(result, 0, i) for i in range(4)]
    assert settled.verdict == tuple(a.verdict for a in of_fit) == ("identifiable",) * 4
    np.testing.assert_allclose(
        settled.standard_error, [a.standard_error for a in of_fit], rtol=1e-6
    )
    np.testing.assert_allclose(settled.relative_error, [a.relative_se for a in of_fit], rtol=1e-6)
    np.testing.assert_allclose([settled.low, settled.high], intervals(result), rtol=1e-6)
    # The last sample had left little to settle: a hundredth of a standard error.
    last = (states[-1].value - settled.value) / settled.standard_error
    assert np.max(np.abs(last)) < 0.03
    assert settled.samples == 200


def test_settled_it_is_the_least_squares_of_scipy(run):
    force = measured()

    def residual(theta):
        return ((synthetic.forces(np.exp(theta)[None], s_c=S)[0][0] - force) / SIGMA).ravel()

    found = least_squares(residual, np.log(TRUTH), jac="3-point", xtol=1e-12, ftol=1e-12, gtol=1e-9)
    np.testing.assert_allclose(np.log(run[2].value), found.x, atol=1e-5)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    np.testing.assert_allclose(run[2].covariance, covariance, rtol=1e-4)


def test_all_blocks_are_linearised_at_one_point():
    """In the midst of it errors are those of one point: of several each would add its own."""
    one, force = online(), measured()
    for k in range(3):
        one.press(S[k])
        for first in (0, 10, 20, 30):
            part = slice(first, first + 10)
            one.add(synthetic.DEPTHS[part], force[k, part])
    h, minimum = 1e-4, one._minimum
    theta = minimum.stream.point

    def at(theta):
        return synthetic.forces(np.exp(theta)[None], s_c=S)[0][0][:3, :40].ravel() / SIGMA

    J = np.stack([(at(theta + h * e) - at(theta - h * e)) / (2 * h) for e in np.eye(4)])
    np.testing.assert_allclose(minimum.sums.hessian, J @ J.T, rtol=1e-5)


def test_what_one_position_leaves_open_is_said_until_there_is_another(run):
    _, states, _, _ = run
    first, second = states[49], states[99]
    assert first.status == FitStatus.UNIDENTIFIABLE
    assert first.verdict[:2] == ("structurally non-identifiable",) * 2
    assert np.isnan(first.standard_error[:2]).all()
    assert (first.low[1], first.high[1]) == pytest.approx((1e-6, 1e6))  # its bounds
    assert np.isfinite(first.standard_error[2:]).all()
    assert np.isfinite(second.standard_error).all()
    # So few positions may have another skeleton that fits as well: nothing is promised.
    assert set(second.verdict) == {"inconclusive"}
    errors = np.array([s.relative_error for s in states[100:]])
    assert np.all(errors[-1] < errors[0])
    inside = np.abs(np.log(states[-1].value / TRUTH)) / states[-1].relative_error
    assert np.max(inside) < 3


def test_the_next_place_is_that_of_a_design(run):
    one, _, settled, result = run
    rings = np.asarray(synthetic.GEOMETRY.ring_positions)
    places = np.linspace(rings[0], rings[-1], 25)
    known = situation(result, samples=50)
    choice = next_points(known, Candidates(places, np.full(25, DEPTH)))
    best = choice.score[0, np.argmin(np.abs(places - settled.next_point))]
    assert best == pytest.approx(choice.score[0].max(), rel=1e-9)
    assert online().state.next_point in places  # before any sample
    assert online(candidates=[60.0]).state.next_point == 60.0


def test_a_sample_compiles_nothing_and_many_take_room(run):
    """Nine presses of arrays, one of them of 2,300 samples: more than any first room."""
    s = np.append(S, [30.0, 60.0, 100.0, 115.0, 140.0])
    force = measured(s)
    one = online()
    with compilations.compilations() as compiled:
        for at, row in zip(s, force, strict=True):
            one.press(at)
            one.add(synthetic.DEPTHS, row)
        one.add(np.tile(synthetic.DEPTHS, 45), np.tile(row, 45))
        found = one.settle()
    assert compiled == []
    assert found.samples == 9 * 50 + 45 * 50
    assert [len(c.force) for c in one.curves] == [50] * 8 + [46 * 50]
    np.testing.assert_array_equal(one.curves[8].force, np.tile(force[8], 46))
    # Sample by sample it settles at the same.
    several = online()
    pressed(several, force[:4])
    whole = online()
    for at, row in zip(S, force[:4], strict=True):
        whole.press(at)
        whole.add(synthetic.DEPTHS, row)
    np.testing.assert_allclose(whole.settle().value, several.settle().value, rtol=1e-8)


def test_the_stream_of_a_page_takes_every_sample_once(run):
    """In any order it ends where the fit of the samples does; a fault leaves its press out."""
    one, _, settled, _ = run
    stream = Stream("fit.toml", lambda _: Experiment(online(), one.curves, {}))
    stream.pace(1e9)
    stream.choose(True)
    stream.play(True)
    first = online().state.next_point
    stream.run()
    assert (stream.state.phase, stream.fault, stream.done) == ("ready", "", True)
    assert len(stream.states) == 200 + 1
    assert [n for n, _ in stream.presses] == [0, 50, 100, 150]
    assert stream.presses[0][1].s_c == min(S, key=lambda s: abs(s - first))
    np.testing.assert_allclose(stream.states[-1].value, settled.value, rtol=1e-6)

    deep = dataclasses.replace(one.curves[0], displacement=100 + one.curves[0].displacement)
    stream = Stream("fit.toml", lambda _: Experiment(online(), [deep, one.curves[1]], {}))
    made = stream.prepare()
    for taken in (0, 1, 2):  # the fault, then two samples
        stream.step()
        assert stream.answer(made)
        assert len(stream.states) == taken
    assert stream.fault.startswith("1: displacement is 100.1 mm; expected at most the radius")
    stream.end()
    assert not stream.answer(made)


def test_on_a_bound():
    """No cubic term: it ends on its bound, the others where the fit has them."""
    truth = TRUTH * [1, 1, 4, 1e-9]
    table = synthetic.parameters(k_3={"lower": 1e-3})
    one = online(table)
    pressed(one, measured(truth=truth, seed=1))
    settled, result = one.settle(), jt.fit(one.study(), ONE)
    assert settled.verdict[3] == "at bound"
    assert settled.value[3] == pytest.approx(1e-3)
    assert settled.status == FitStatus.AT_BOUND == result.status[0]
    np.testing.assert_allclose(settled.value, result.value[0], rtol=1e-6)
    # Of the estimate and of its error.
    np.testing.assert_allclose([settled.low, settled.high], intervals(result), rtol=2e-6)


def test_a_record_with_a_zero_of_its_own_is_named():
    """A tenth of the noise, 1 mm of air: verdicts are withdrawn when the press has ended."""
    force = measured() - 0.9 * (measured() - synthetic.forces(TRUTH[None], s_c=S)[0][0])
    table = [dataclasses.replace(p, auto=p.name in ZEROS) for p in synthetic.parameters()]
    one = online(table, noise=jt.Noise(force=SIGMA / 10))
    air = SIGMA / 10 * np.random.default_rng(3).normal(size=20)
    one.press(S[0])
    one.add(np.append(np.linspace(0, 1, 20), 1 + synthetic.DEPTHS), np.append(air, force[0]))
    assert one.state.message == ""
    for at, row in zip(S[1:], force[1:], strict=True):
        one.press(at)
        state = one.add(synthetic.DEPTHS, row)
    assert state.message.startswith("press 1 (s = 22 mm) shows onset, held at 0 here; fit the")
    assert set(state.verdict) <= {"inconclusive", "inconclusive: the model misses the curve"}
    assert any(p.name == "onset" for p in one.study().free)


def test_a_force_of_the_wrong_sign_is_named():
    one = online()
    one.press(75.0)
    one.add(synthetic.DEPTHS, -measured()[1])
    assert "its largest force pulls" in one.settle().message


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"options": jt.Options(skeleton="sections", contact="bonded")}, "options.skeleton is"),
        ({"options": jt.Options(relaxation="uniform")}, "options.relaxation is 'uniform'"),
        ({"noise": jt.Noise()}, "noise.force is None; expected a number, N"),
        ({"noise": jt.Noise(force=1.0, joints=0.1)}, "noise.joints is 0.1; expected None; fit the"),
        ({"noise": jt.Noise(force=1.0, force_share=0.1)}, "noise.force_share is 0.1"),
        ({"parameters": {"onset": {}}}, "parameters.onset belongs to single presses"),
        (
            {"parameters": {n: {"fixed": True, "value": 1.0} for n in synthetic.NAMES}},
            "parameters: every parameter is fixed; expected a free one",
        ),
        ({"depth": 0.0}, "depth is 0.0; expected above 0"),
        ({"depth": np.nan}, "depth is nan"),
        ({"depth": 12.0}, "depth is 12.0; .* at most the radius, 11.3 mm"),
        ({"samples": 0}, "samples is 0; expected 1 or more"),
        ({"candidates": [10.0, 200.0]}, "candidates: .*200.* expected positions in mm"),
        ({"candidates": [np.nan]}, "candidates: .nan"),
    ],
)
def test_what_is_refused(change, says):
    given = {"options": jt.Options(), "noise": jt.Noise(force=0.1), "depth": 1.0} | change
    with pytest.raises(ValueError, match=f"^{says}"):
        jt.Online(jt.table_1(), **given)


def test_samples_that_are_refused(run):
    one = online()
    with pytest.raises(ValueError, match="no press has begun; call press"):
        one.add(1.0, 1.0)
    with pytest.raises(ValueError, match="contact at s = 200 mm, expected on the tube"):
        one.press(200.0)
    one.press(75.0)
    for d, f, says in (
        (np.nan, 1.0, "displacement is nan; expected finite numbers"),
        (1.0, np.inf, "force is inf"),
        ([1.0, 2.0], 1.0, r"displacement: \(2,\), force \(1,\); expected two numbers"),
        ([], [], r"displacement: \(0,\)"),
        (1e100, 1.0, "displacement is 1e\\+100 mm; expected at most the radius, 11.3 mm"),
    ):
        with pytest.raises(ValueError, match=f"^{says}"):
            one.add(d, f)
    assert one.state.samples == 0
    assert one.curves == []


@pytest.mark.slow
@pytest.mark.compiling
def test_past_a_fold_the_estimate_stays():
    """A contact that softens has no equilibrium at 6 mm: k_1 / (3 |k_3|) = 3.3 mm squared."""
    table = synthetic.parameters(k_3={"fixed": True, "value": -0.1, "scale": "linear"})
    one = online(table)
    one.press(75.0)
    for d in np.linspace(0.1, 1.0, 40):
        before = one.add(d, 0.8 * d)
    state = one.add(6.0, 1.0)
    assert state.status == FitStatus.NON_FINITE
    assert state.verdict == ("failed",) * 3
    np.testing.assert_allclose(state.value, before.value, rtol=0.05)
    assert one.settle().status == FitStatus.NON_FINITE
