"""Verdicts on specimens with known truth from an independent beam; where evidence is looked for."""

import csv
import dataclasses

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import specimens
from scipy.special import stdtrit
from specimens import NAMES, POSITIONS, STIFF_CONTACT

from jaxtrachea.files.table import Table
from jaxtrachea.fitting import other_starts, verify
from jaxtrachea.fitting import structure as structures
from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import in_model
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.population import population
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, compliance
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.report.tables import estimate_table, spread_table
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.results.rows import lane_rows, parameter_rows
from jaxtrachea.status import FitStatus, ProfileEnd
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

GEOMETRY = table_1()
RINGS, LENGTH = np.asarray(GEOMETRY.ring_positions), float(GEOMETRY.length)
OPTIONS = Options(onset_width=0.0)
#: Two skeletons far apart have the compliances of this one at its first two positions, to rounding.
TWIN = np.array([[1739.0, 1.12, 5.0, 0.3]])
#: Told well by four presses.
CLEAR = np.array([[300.0, 0.3, 2.0, 0.3]])

#: One of some thousand records takes an onset by chance: here the unknowns are the same for all.
HELD = {name: {"fixed": True, "value": 0.0} for name in ("onset", "force_offset")}


def curves(pressed, count, share, rng, name="s"):
    """Noisy curves of the first `count` positions."""
    force = specimens.noisy(pressed.force[:, :count], share, rng)
    for i in range(len(force)):
        for t in range(count):
            yield Curve(f"{name}{i:03d}", f"t{t}", POSITIONS[t], 0.0, specimens.DEPTHS, force[i, t])


def make_study(data):
    """A study with the defaults of the package."""
    parameters = default_parameters(in_model(OPTIONS, joints=False), HELD)
    return build_study(list(data), GEOMETRY, OPTIONS, parameters)


def verdicts(result, truth):
    """Verdicts, and whether truths lie outside the 95 and the 99.7 % interval, and 10 % off.

    The latter is the former drawn out by 3 / 1.96 on the logarithm, from the estimate.
    """
    assessed = [[assess(result, k, i) for i in range(4)] for k in range(result.lanes)]
    word = np.array([[j.verdict for j in row] for row in assessed])
    low, high = (np.array([[getattr(j, name) for j in row] for row in assessed])
                 for name in ("low", "high"))  # fmt: skip
    assert [p.name for p in result.study.free] == list(NAMES)
    value = np.maximum(result.value, 1e-300)
    with np.errstate(divide="ignore", over="ignore"):
        far_low = value * np.exp(3 / 1.96 * np.log(np.maximum(low, 0) / value))
        far_high = value * np.exp(3 / 1.96 * np.log(high / value))
        off = np.abs(np.log(value / truth)) > np.log(1.1)
    outside = (truth < low) | (truth > high)
    return word, outside, off & ((truth < far_low) | (truth > far_high))


@pytest.fixture(scope="module")
def pressed():
    """Four specimens of the case of one press, one with a twin skeleton, and a clear one."""
    truth = np.concatenate([specimens.draw(1, 4, STIFF_CONTACT), TWIN, CLEAR])
    return specimens.press(truth, RINGS, LENGTH)


@pytest.fixture(scope="module")
def study(pressed):
    """One press of the first four, two of the twin, four of the clear one."""
    rng = np.random.default_rng(3)
    parts = (slice(4), 1, 0.002), (slice(4, 5), 2, 0.002), (slice(5, 6), 4, 1e-4)
    data = []
    for part, count, share in parts:
        of_part = specimens.Specimens(*(v[part] for v in pressed))
        data += curves(of_part, count, share, rng, f"p{count}")
    return make_study(data)


@pytest.fixture(scope="module")
def result(study):
    """All of them, fitted together."""
    return fit(study)


def test_the_specimens_are_those_of_the_case(pressed):
    assert pressed.compliance[:4, 0].min() > 0.35
    assert pressed.compliance[:4, 0].max() < 0.6


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("iterations", "converges"), [(1, False), (3, True), (12, True)])
def test_a_fit_that_ran_out_of_iterations_is_no_estimate(pressed, iterations, converges):
    """Four presses that tell the truth well: it is found, or the status says that it is not."""
    clear = specimens.Specimens(*(v[5:] for v in pressed))
    study = make_study(curves(clear, 4, 1e-4, np.random.default_rng(4)))
    tolerances = Tolerances(iterations=iterations)
    result = fit(study, Settings(starts=2, more_starts=0, tolerances=tolerances))
    if converges:
        assert result.status == [FitStatus.CONVERGED]
        np.testing.assert_allclose(result.value, clear.truth, rtol=0.02)
    else:
        assert result.status == [FitStatus.MAX_ITERATIONS]
        assert assess(result, 0, 0).verdict == "failed"


@pytest.mark.slow
@pytest.mark.compiling
def test_one_press_has_one_verdict_and_an_estimate(result, pressed):
    """One cause, one verdict: no lane fails, and none calls k_1 known where it is not."""
    word, outside, false = verdicts(result, pressed.truth)
    assert np.all(result.status[:4] == FitStatus.UNIDENTIFIABLE)
    assert np.all(word[:4, :2] == "structurally non-identifiable")
    assert np.all(word[:4, 2] == "practically non-identifiable")
    assert not false.any()
    assert not outside[:4, 2].any()
    # What is determined is fitted: residuals are the noise of 0.2 %.
    peak = pressed.force[:4, 0].max(axis=1)
    np.testing.assert_allclose(result.rms[:4, 0] / peak, 0.002, rtol=0.35)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_twin_skeleton_belongs_to_the_interval(result, pressed):
    """Both skeletons have the same compliances; the truth is inside whichever was found."""
    word, outside, _ = verdicts(result, pressed.truth)
    assert np.all(word[4, :2] == "practically non-identifiable")
    assert not outside[4, :2].any()
    assert result.minima[4] > 1


@pytest.mark.long
@pytest.mark.parametrize("GA_L", [None, 50.0])
@pytest.mark.parametrize("best", [2.0, 11.0])
def test_other_skeletons_are_as_soft_as_the_beam_says(GA_L, best):
    """On grids whole and cut by a bound; without shear a line through the grid is enough."""
    geometry, options = table_1(), Options(shear=GA_L is not None)
    D = np.linspace(0, 1, 9)
    curves = [Curve("a", str(s), s, 0.0, D, D) for s in (30.0, 80.0)]
    given = {} if GA_L is None else {"GA_L": {"fixed": True, "value": GA_L}}
    study = build_study(curves, geometry, options, given)
    names = [p.name for p, _, _ in study.unknowns[0]]
    beam = np.array([[names.index("EI_L"), names.index("k_M")]])
    theta, lanes = np.zeros((1, study.size)), np.array([0])
    theta[0, beam[0]] = best, 0.5
    axes = other_starts._axes(study, lanes, theta, beam)
    change = other_starts._softer(study, lanes, theta, beam, axes)

    @jax.vmap
    def softness(ln):
        EI, k = jnp.exp(ln)
        wall = Material(EI, k, 1.0, 0.0, GA_L=GA_L)
        return jnp.log(compliance(geometry, wall, np.array([30.0, 80.0]), options))

    grid = np.stack(np.meshgrid(*axes[0], indexing="ij"), axis=-1).reshape(-1, 2)
    expected = jax.jit(softness)(grid) - softness(theta[:, beam[0]])
    np.testing.assert_allclose(change.reshape(-1, 2), expected, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.compiling
def test_all_that_is_written_agrees(result, tmp_path):
    lanes = range(result.lanes)
    table = [row[-1] for row in estimate_table(result, lanes).cells]
    rows = list(parameter_rows(AnalysisResults(result)))
    assert [row["verdict"] for row in rows] == table
    summary = [row[f"{n} verdict"] for row in lane_rows(result) for n in NAMES]
    assert summary == table
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})
    with h5py.File(tmp_path / "r.h5") as file:
        assert [v.decode() for v in file["unknowns/verdict"][()].ravel()] == table
    Table(rows).write_csv(tmp_path / "p.csv")
    with (tmp_path / "p.csv").open(newline="") as stream:
        low = [float(row["low95"]) for row in csv.DictReader(stream)]
    assert low == [assess(result, k, i).low for k in lanes for i in range(4)]


@pytest.mark.slow
@pytest.mark.compiling
def test_widened_intervals_hold_the_plain_ones(result):
    """They were drawn about the estimate by its local error, inside the evidence.

    Of a given interval each side grows by the ratio of the half widths, on the logarithm; none
    leaves the bounds, and an open side is at them.
    """
    low, high, end = (v.copy() for v in (
        result.evidence_low, result.evidence_high, result.evidence_end))  # fmt: skip
    sides, value = np.array([-0.4, 0.1]), result.value[5, 2]
    (low[5, 2], high[5, 2]), end[5, 2] = value * np.exp(sides), ProfileEnd.CLOSED
    low[5, 3] = high[5, 3] = result.value[5, 3]
    end[5, 3] = ProfileEnd.FAILED
    given = dataclasses.replace(result, evidence_low=low, evidence_high=high, evidence_end=end)
    slow = np.sin(np.arange(result.study.lanes.force.shape[2]))
    seen = {"force": np.where(result.study.lanes.precision > 0, slow, np.nan)}
    given.__dict__["residuals"] = seen
    wide = given.effective
    bounds = [(p.lower, p.upper) for p in given.study.free]
    for k in range(given.lanes):
        for i, (least, most) in enumerate(bounds):
            assessed = assess(given, k, i)
            low, high = assessed.independent
            assert least <= assessed.low <= low <= given.value[k, i] * (1 + 1e-12)
            assert given.value[k, i] * (1 - 1e-12) <= high <= assessed.high <= most
            if assessed.ends is not None and assessed.ends[1] == ProfileEnd.OPEN:
                assert assessed.high == high == most
    left = wide.samples[5] - 4
    ratio = stdtrit(left, 0.975) * wide.factor[5] / given.uncertainty.half_width[5]
    assert ratio > 1.5
    assessed = assess(given, 5, 2)
    found = np.log([assessed.low / value, assessed.high / value])
    np.testing.assert_allclose(found, ratio * sides, rtol=1e-9)
    assert assessed.verdict == "weak"  # plain it would be identifiable or weak by 0.4 / 1.96
    # Where an end was not found, the local error is left.
    assert result.study.free[3].scale == "linear"
    local = np.array([result.lower[5, 3], result.upper[5, 3]]) - result.value[5, 3]
    assessed = assess(given, 5, 3)
    found = np.array([assessed.low, assessed.high]) - result.value[5, 3]
    np.testing.assert_allclose(found, ratio * local, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.compiling
def test_local_intervals_end_at_the_bounds(result):
    """k_3 of [0, 1e6] had a low95 of -40."""
    lower, upper = result.lower.copy(), result.upper.copy()
    lower[5, 2:], upper[5, 2:] = (0.5, -40.0), (np.inf, 3.0)
    assessed = [assess(dataclasses.replace(result, lower=lower, upper=upper), 5, i) for i in (2, 3)]
    assert [(j.low, j.high) for j in assessed] == [(0.5, result.study.free[2].upper), (0, 3)]


@pytest.mark.slow
@pytest.mark.compiling
def test_population_and_medians_take_what_is_identifiable(result):
    with pytest.raises(ValueError, match="no parameter is determined in 3 specimens"):
        population(result)
    told = [row[1] for row in spread_table(result).cells]
    assert told == ["1 of 6", "1 of 6", "2 of 6", "2 of 6"]


@pytest.mark.slow
@pytest.mark.compiling
def test_an_end_that_was_not_found_is_no_proof(result):
    """A narrow interval of which an end failed: inconclusive, in place of identifiable."""
    end, low, high = (v.copy() for v in (
        result.evidence_end, result.evidence_low, result.evidence_high))  # fmt: skip
    low[4, 2], high[4, 2] = result.value[4, 2] * np.array([0.99, 1.01])
    words = []
    for last in (ProfileEnd.CLOSED, ProfileEnd.FAILED):
        end[4, 2] = ProfileEnd.CLOSED, last
        changed = dataclasses.replace(
            result, evidence_end=end, evidence_low=low, evidence_high=high
        )
        words.append(assess(changed, 4, 2).verdict)
        high[4, 2] = result.value[4, 2]
    assert words == ["identifiable", "inconclusive"]
    # Where nothing is known of a side, the local error: no interval of no width.
    assessed = assess(changed, 4, 2)
    assert assessed.low == low[4, 2]
    assert assessed.high == result.upper[4, 2] > 1.001 * result.value[4, 2]


@pytest.mark.slow
@pytest.mark.compiling
def test_no_doubt_costs_nothing(study, monkeypatch):
    """Nothing is looked for where nothing gives cause: the estimate is that of the plain fit."""
    clear = study.take(np.full(6, 5))
    plain = fit(clear, Settings(verify=False))
    for module, name in ((verify, "verify_minimum"), (structures, "structure")):
        monkeypatch.setattr(module, name, None)
    usual = fit(clear)
    np.testing.assert_array_equal(usual.theta, plain.theta)
    assert (usual.evidence_end == -1).all()
    assert [assess(usual, 0, i).verdict for i in range(4)] == ["identifiable"] * 4


@pytest.mark.long
def test_each_lane_is_profiled_once(study, monkeypatch):
    """Where one has a better minimum the others are profiled at once; it is, when it has moved."""
    lanes, profiled = study.take(np.full(3, 5)), []

    def other_minima(region, rows, known):
        if not profiled:
            region.better[0] = region.result.theta[0]
        return np.ones(len(rows), int)

    def profile(region, evidence):
        profiled.append(sorted(set(region.sides.lane.tolist())))
        evidence.evidence_low[profiled[-1]] = len(profiled)

    monkeypatch.setattr(verify, "_other_minima", other_minima)
    monkeypatch.setattr(verify, "_profiled", profile)
    monkeypatch.setattr("jaxtrachea.fitting.fit.needs_review", lambda r, _: r.value > 0)
    result = fit(lanes, Settings(starts=1))
    assert profiled == [[1, 2], [0]]
    np.testing.assert_array_equal(result.evidence_low, np.tile([[2.0], [1.0], [1.0]], 4))


@pytest.mark.slow
@pytest.mark.compiling
def test_truth_table():
    """50 specimens at 0.2 and 2 % noise: at most 5 % have an unknown falsely identifiable.

    Of two presses. False: identifiable, more than 10 % off and outside the interval of 99.7 %.
    Truths and noise are not those that the thresholds were chosen with (seeds 100 and 107).
    """
    pressed = specimens.press(specimens.draw(2024, 50), RINGS, LENGTH, POSITIONS[:2])
    rng = np.random.default_rng(2025)
    data = [c for share, name in ((0.002, "a"), (0.02, "b"))
            for c in curves(pressed, 2, share, rng, name)]  # fmt: skip
    found = fit(make_study(data))
    assert found.succeeded.all()
    word, _, false = verdicts(found, np.tile(pressed.truth, (2, 1)))
    identifiable = word == "identifiable"
    for part in (slice(50), slice(50, 100)):
        wrong = (identifiable & false)[part]
        assert wrong.any(axis=1).mean() <= 0.05
        assert wrong.sum() <= 0.05 * max(identifiable[part].sum(), 20)


def joint_study(seed, shared, count, share):
    """Four specimens with some parameters in common, and their truths."""
    truth = specimens.draw(5000 + seed, 4)
    for name in shared:
        truth[:, NAMES.index(name)] = truth[0, NAMES.index(name)]
    pressed = specimens.press(truth, RINGS, LENGTH, POSITIONS[:count], digits=16)
    data = curves(pressed, count, share, np.random.default_rng(seed))
    changes = {name: {"scope": "shared"} for name in shared} | HELD
    parameters = default_parameters(in_model(OPTIONS, joints=False), changes)
    return build_study(list(data), GEOMETRY, OPTIONS, parameters, joint=True), truth


@pytest.mark.slow
@pytest.mark.compiling
def test_a_joint_fit_says_what_it_has_not_looked_at():
    """No wrong unknown is identifiable; with local errors alone 7 of 8, 30 of 53, 9 of 21 were.

    All come to rest, also where an unknown is best at infinity (seed 2 had stalled).
    """
    words = []
    for seed in range(4):
        study, truth = joint_study(seed, ("k_1", "k_3"), 2, 0.002)
        result = fit(study, Settings(starts=4))
        assert np.all(result.status <= FitStatus.UNIDENTIFIABLE), seed
        word, _, false = verdicts(result, truth)
        assert not np.any(false & (word == "identifiable")), seed
        words.append(word)
    assert np.any(np.array(words) == "inconclusive")
