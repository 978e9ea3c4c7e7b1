"""Air that records hide, where the fit ends in another minimum: two of six, or all of them.

Forces by an independent finite-element beam and Newton's method.
"""

import dataclasses

import beam_fem
import numpy as np
import pytest

from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.hidden_air import hidden_air, with_doubts
from jaxtrachea.fitting.omitted_zeros import Asked
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.labels import verdict_sentence
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.record_zeros import flat_until
from jaxtrachea.prediction.predict import predict
from jaxtrachea.status import PredictionStatus
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

TRUTH = {"EI_L": 300.0, "k_M": 0.5, "k_1": 1.2, "k_3": 0.08}
PLACES, MARKED = (4.0, 8.0, 15.0, 35.0, 55.0, 75.0), (15.0, 35.0, 75.0)
MARKERS = np.array([1, 3, 7])
FIVE = (4.0, 12.0, 30.0, 55.0, 75.0)


def law_of_model(d):
    """Force and stiffness."""
    return TRUTH["k_1"] * d + TRUTH["k_3"] * d**3, TRUTH["k_1"] + 3 * TRUTH["k_3"] * d**2


def press(s, depth, law=law_of_model):
    """Force and deflection of the rings at depths, mm; 0 in air."""
    x = np.asarray(table_1().ring_positions)
    unit = beam_fem.solve(x, 160.0, [TRUTH["EI_L"]] * 16, [TRUTH["k_M"]] * 15, s, 1.0)
    D, c = np.maximum(depth, 0.0), float(unit.w_C)
    d = D.copy()
    for _ in range(60):
        F, slope = law(d)
        d -= (d + c * F - D) / (1 + c * slope)
    F = law(d)[0]
    return F, F[:, None] * np.array(unit.w, float)


def record(rng, name, s, air, offset, depth, noise, marked=False, samples=51):
    """A curve that begins with its air."""
    way = np.linspace(-air, depth, samples)
    force, rings = press(s, way)
    seen = {}
    if marked:
        at = rings[:, MARKERS] + 0.003 * rng.normal(size=(samples, 3))
        seen = {"joint_rings": MARKERS, "joint_displacement": at}
    force = force + offset + noise * rng.normal(size=samples)
    return Curve(name, f"s{s:g}", s, 0.0, way + air, force, **seen)


CASES = {
    # air, offset, depth, noise, markers; EI_L that came out before, "identifiable"
    "two of six hide it": (0.5, 0.1, 1.5, 0.02, False),  # 15
    "all hide it, still markers": (0.5, 0.0, 2.0, 0.06, True),  # k_1 0.16
    "with offsets": (1.0, 0.2, 3.0, 0.05, False),  # k_1 0.39
    "shallow": (0.27, 0.1, 0.9, 0.01, False),  # 13
    "none": (0.0, 0.0, 2.0, 0.02, False),
}


@pytest.mark.parametrize("case", CASES)
def test_estimates_hold_the_truth(case):
    *how, marked = CASES[case]
    rng = np.random.default_rng(3)
    places = MARKED if marked else PLACES
    curves = [record(rng, "A", s, *how, marked) for s in places]
    result = fit(build_study(curves, table_1()), Settings(starts=4))
    names = [p.name for p, _, _ in result.study.unknowns[0]]
    air = how[0]
    for i, name in enumerate(names):
        truth = {**TRUTH, "onset": air, "force_offset": how[1]}[name]
        error = assess(result, 0, i).standard_error
        off = np.log(result.value[0, i] / truth) if name in TRUTH else result.value[0, i] - truth
        scale = error / result.value[0, i] if name in TRUTH else error
        assert abs(off) < 3.5 * scale, (name, result.value[0, i])
    assert names.count("onset") == (len(places) if air else 0)


def test_a_press_without_air_does_not_begin_flat():
    way = np.linspace(0.0, 2.0, 51)
    rng = np.random.default_rng(0)
    force = press(75.0, way)[0] + 0.001 * rng.normal(size=51)
    assert np.isnan(flat_until(way, force))
    still = np.concatenate([0.001 * rng.normal(size=20), force])
    end = flat_until(np.concatenate([np.linspace(-0.8, -0.04, 20), way]), still)
    assert -0.1 < end < 0.1


@pytest.mark.parametrize("power", [2.0, 2.5])
def test_a_law_that_is_missing_is_not_air(power):
    """One of six records has air; with onsets of the other five all would move by 0.3 mm."""
    rng = np.random.default_rng(7)

    def law(d):
        return 0.8 * d**power, 0.8 * power * d ** (power - 1)

    curves = []
    for i in range(12):
        for s in PLACES:
            air = 0.6 if s == PLACES[-1] else 0.0
            way = np.linspace(-air, 2.0, 51)
            force = press(s, way, law)[0] + 0.03 * rng.normal(size=51)
            curves.append(Curve(f"T{i:02d}", f"s{s:g}", s, 0.0, way + air, force))
    study = build_study(curves, table_1())
    result = fit(study, Settings(starts=2, verify=False))
    taken = [sum(p.name == "onset" for p, _, _ in lane) for lane in result.study.unknowns]
    assert max(taken) < len(PLACES)


def test_healthy_lanes_are_seldom_fitted_again():
    """Of normal noise 7 % exceed what their records show by 1.5 of its errors."""
    rng, again = np.random.default_rng(5), []
    curves = [
        record(rng, f"T{i}", s, 0.0, 0.0, 2.0, 0.02, False) for i in range(20) for s in PLACES
    ]
    study = build_study(curves, table_1())
    result = fit(study.take(np.arange(20)), Settings(starts=2, verify=False))

    def tried(part, near):
        again.append(len(part.curves))
        return fit(part.take(np.arange(again[-1])), Settings(starts=2, verify=False))

    found = hidden_air(study, result, Asked({}, {}), tried)
    assert not found.asked.names
    assert not found.doubts
    assert max(again, default=0) <= 5


def specimen(seed, airs, noise, depth, samples):
    """Curves of one specimen of `TRUTH`; `airs`: at each of `FIVE` places, mm."""
    rng = np.random.default_rng(seed)
    return [
        record(rng, "A", s, air, 0.0, depth, noise, samples=samples)
        for s, air in zip(FIVE, airs, strict=True)
    ]


def intervals(curves):
    """Assessments of all parameters, the number of onsets, and whether there is another reading."""
    result = fit(build_study(curves, table_1()), Settings())
    of = [assess(result, 0, i) for i in range(len(result.study.unknowns[0]))]
    names = [p.name for p, _, _ in result.study.unknowns[0]]
    apart = np.isfinite(result.with_air).any()
    return dict(zip(names, of, strict=True)), names.count("onset"), apart


def test_air_of_all_curves_that_is_no_flat_beginning():
    """0.15 of 2.15 mm: four samples of 51, too few for `flat_until`; k_1 was 0.95 for 1.2."""
    for seed in range(3):
        found, onsets, apart = intervals(specimen(seed, [0.15] * 5, 0.017, 2.0, 51))
        for name, truth in TRUTH.items():
            assert found[name].low < truth < found[name].high, (seed, name, found[name])
        # The end towards the truth is that of the reading with air, and no wider.
        assert found["k_1"].high < 1.05 * TRUTH["k_1"]
        assert onsets == 5 or apart


def test_air_that_nothing_speaks_for_is_in_the_intervals():
    """Two samples of air in three of five: offsets were taken, k_1 was 8 errors off."""
    airs = [0.25, 0.0, 0.25, 0.0, 0.25]
    several = 0
    for seed in range(4):
        found, _, apart = intervals(specimen(seed, airs, 0.15, 4.0, 31))
        for name, truth in TRUTH.items():
            assert found[name].low < truth < found[name].high, (seed, name, found[name])
        several += apart
    assert several


def test_a_short_record_does_not_keep_the_others_from_being_read_with_air():
    """Of five samples nothing is known of the noise; k_1 was 0.88 for 1.2, "identifiable"."""
    curves = specimen(0, [0.15] * 5, 0.017, 2.0, 51)
    long = curves[2]
    few = Curve("A", "few", 30.0, 0.0, long.displacement[10::10][:5], long.force[10::10][:5])
    found, _, apart = intervals([*curves, few])
    assert found["k_1"].low < TRUTH["k_1"] < found["k_1"].high
    assert apart


def test_intervals_hold_both_readings():
    curves = specimen(1, [0.0] * 5, 0.02, 2.0, 51)
    result = fit(build_study(curves, table_1()), Settings(starts=2))
    i = [p.name for p, _, _ in result.study.unknowns[0]].index("k_1")
    (p, *of), value = result.study.unknowns[0][i], float(result.value[0, i])
    alone = assess(result, 0, i)
    assert alone.verdict == "identifiable"

    def read(low, high, **changes):
        changed = dataclasses.replace(result, **changes)
        return with_doubts(changed, {0: {(p.name, *of): (low * value, high * value)}})

    both = assess(read(1.2, 1.3), 0, i)
    assert (both.low, both.high) == (alone.low, 1.3 * value)  # of neither more than it is
    assert both.verdict == "weak"
    assert both.error == pytest.approx(np.log(1.3) / result.uncertainty.half_width[0])
    assert assess(read(1.2, 4.0), 0, i).verdict == "practically non-identifiable"
    open_ = assess(read(-np.inf, np.inf), 0, i)
    assert open_.verdict == "practically non-identifiable"
    assert (open_.low, open_.high) == (p.lower, p.upper)
    everywhere = np.ones(result.theta.shape, bool)
    assert assess(read(1.2, 1.3, unexamined=everywhere), 0, i).verdict == "inconclusive"
    assert "structurally" in assess(read(1.2, 1.3, undetermined=everywhere), 0, i).verdict
    assert "curves may begin in air" in verdict_sentence(read(1.2, 1.3), 0)
    there = predict(read(1.2, 1.3), s=40.0, displacement=np.linspace(0, 1, 3))
    assert there.status == PredictionStatus.OTHER_ZERO
