"""Speeds and later halves of holds left out: errors by numpy, and the law that made the records."""

import dataclasses

import maxwell
import numpy as np
import pytest

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.comparison import Model, compared, sentence
from jaxtrachea.inference.repeats import leave_repeats_out, repeats
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.whole_record import second_half_of_hold
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

K_1, GAMMA, TAU, DEPTH, NOISE = 0.5, (0.9, 0.6), (0.3, 5.0), 2.0, 0.003
SPEEDS = (0.5, 0.5, 2.0, 8.0)
ONE = Settings(starts=1, verify=False)
TABLE = {
    "k_1": {"value": 0.4},
    "k_3": {"fixed": True, "value": 0.0},
    "onset": {"fixed": True, "value": 0.0},
    "force_offset": {"fixed": True, "value": 0.0},
}


def record(trial, speed, branches=(GAMMA, TAU)):
    """A ramp of 2 mm, a hold of 16 s, unloading; the force by a differential equation."""
    rise = DEPTH / speed
    corners = np.array([0, rise, rise + 16, 2 * rise + 16])
    way = np.array([0, DEPTH, DEPTH, 0])
    parts = ((0, 21), (1, 40), (2, 15))
    t = [np.linspace(corners[i], corners[i + 1], n, endpoint=False) for i, n in parts]
    t = np.concatenate(t)
    force, _ = maxwell.force_in_time(t, (corners, K_1 * way), *branches)
    force = force + np.random.default_rng(trial).normal(0, NOISE, t.size)
    D = np.interp(t, corners, way)
    return Curve("T", f"t{trial}", None, 0.0, D, force, time=t, rise=(0, 22))


@pytest.fixture(scope="module")
def records():
    return [record(i, v) for i, v in enumerate(SPEEDS)]


def study_of(records, word):
    options = Options(coupling="total")
    if word != "off":
        options = dataclasses.replace(options, relaxation="uniform", branches=word)
    return build_study(records, table_1(), options, TABLE)


@pytest.fixture(scope="module")
def elastic(records):
    return fit(study_of(records, "off"), ONE)


def test_the_later_half_begins_in_the_middle_of_the_hold(records):
    for curve, speed in zip(records, SPEEDS, strict=True):
        later = second_half_of_hold(curve)
        middle, end = DEPTH / speed + 8, DEPTH / speed + 16
        step = 0.4
        assert abs(curve.time[later.start] - middle) < 2 * step
        assert abs(curve.time[later.stop - 1] - end) < 2 * step
    assert second_half_of_hold(dataclasses.replace(records[0], rise=None)) is None
    # Without a hold all that follows the loading.
    short = dataclasses.replace(
        records[3],
        **{n: np.delete(getattr(records[3], n), np.s_[22:61]) for n in ("displacement", "force")},
        time=np.r_[records[3].time[:22], records[3].time[61:] - 15.9],
    )
    assert second_half_of_hold(short) == slice(22, short.force.size)


def least_squares(pairs):
    """Slope through the origin of displacement and force."""
    D, force = (np.concatenate(v) for v in zip(*pairs, strict=True))
    return float(D @ force / (D @ D))


def test_errors_of_later_halves_are_those_of_a_line_through_what_was_before(records, elastic):
    """The unloading is neither fitted nor predicted."""
    halves = [second_half_of_hold(c) for c in records]
    pairs = list(zip(records, halves, strict=True))
    slope = least_squares([(c.displacement[: h.start], c.force[: h.start]) for c, h in pairs])
    off = [slope * c.displacement[h] - c.force[h] for c, h in pairs]
    peak = max(np.abs(c.force).max() for c in records)
    found = leave_repeats_out(elastic, ONE, leave_out="holds")
    assert repeats(elastic.study, "holds").words == "the second half of holds"
    np.testing.assert_allclose(found.error, rms(np.concatenate(off)) / peak, rtol=1e-6)
    each = [rms(v) / peak for v in off]
    np.testing.assert_allclose(found.worst[0].error, max(each), rtol=1e-6)
    assert found.worst[0].place == f"t{int(np.argmax(each))}"
    assert found.refits.tolist() == [1]


def test_records_of_one_speed_are_left_out_together(records, elastic):
    plan = repeats(elastic.study, "speeds")
    assert [np.flatnonzero(row).tolist() for row in plan.held] == [[0, 1], [2], [3]]
    off = []
    for group in ([0, 1], [2], [3]):
        kept = [(c.displacement, c.force) for i, c in enumerate(records) if i not in group]
        slope = least_squares(kept)
        off.append(
            np.concatenate([slope * records[i].displacement - records[i].force for i in group])
        )
    peak = max(np.abs(c.force).max() for c in records)
    found = leave_repeats_out(elastic, ONE, leave_out="speeds")
    np.testing.assert_allclose(found.error, rms(np.concatenate(off)) / peak, rtol=1e-6)
    worst = int(np.argmax([rms(v) for v in off]))
    assert found.worst[0].place == ("0.5 mm/s", "2 mm/s", "8 mm/s")[worst]


def rms(v):
    return float(np.sqrt(np.mean(np.square(v))))


def test_what_the_records_do_not_have_is_not_left_out(records):
    cut = [c.rising for c in records]
    assert not len(repeats(study_of(cut, "off"), "holds").lanes)
    same = study_of(records[:2], "off")
    assert not len(repeats(same, "speeds").lanes)
    timeless = [dataclasses.replace(c, time=None) for c in cut]
    assert not len(repeats(study_of(timeless, "off"), "speeds").lanes)


def test_records_of_two_branches_choose_two_branches_by_time(records, elastic):
    """Over an elastic press and one branch; what is predicted is missed by the noise alone."""
    models = [Model("elastic", elastic, leave_repeats_out(elastic, ONE, leave_out="holds"))]
    for word in ("prony-1", "prony-2"):
        result = fit(study_of(records, word), ONE)
        models.append(Model(word, result, leave_repeats_out(result, ONE, leave_out="holds")))
    rows, failed = compared(models)
    assert failed == 0
    left = {row.model: row.left_out for row in rows}
    peak = max(np.abs(c.force).max() for c in records)
    assert left["elastic"] > 2 * left["prony-1"] > 20 * left["prony-2"]
    assert left["prony-2"] < 2 * NOISE / peak
    text = sentence(rows, "the second half of holds")
    assert text.startswith("the data prefer prony-2 decisively")
    assert text.endswith("it predicts the second half of holds left out best)")


@pytest.mark.slow
def test_records_of_a_box_of_times_choose_fung():
    """Of 40 branches, even in log tau from 0.2 to 20 s: over one branch, with the box's numbers."""
    C, (low, high), count = 0.3, (0.2, 20.0), 40
    width = np.log(high / low) / count
    tau = low * np.exp(width * (np.arange(count) + 0.5))
    made = [record(i, v, (np.full(count, C * width), tau)) for i, v in enumerate(SPEEDS)]
    results = {word: fit(study_of(made, word), ONE) for word in ("off", "prony-1", "fung")}
    rows, failed = compared([Model(word, result, None) for word, result in results.items()])
    assert failed == 0
    assert sentence(rows).startswith("the data prefer fung decisively")
    found = results["fung"]
    truth = {"k_1": K_1, "C": C, "tau_1": low, "tau_2": high}
    for i, (p, _, _) in enumerate(found.study.unknowns[0]):
        error = abs(np.log(found.value[0, i] / truth[p.name]))
        assert error < 4 * found.relative_se[0, i], p.name
    np.testing.assert_allclose(found.rms[0, 0], NOISE, rtol=0.15)
