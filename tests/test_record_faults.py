"""Faults that are put into records by hand: what is left out, what is said, what is not."""

import re

import numpy as np
import pytest
from jaxtyping import Float

from jaxtrachea.fitting.curve_noise import weighed_by_curve
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.measurements.batch_checks import finish_all
from jaxtrachea.measurements.curve import Curve, RawCurve, ReadOptions
from jaxtrachea.measurements.read import DataError, read_measurements
from jaxtrachea.trials.differences import differing_trials
from jaxtrachea.trials.repeats import repeat_sentences, trial_remarks
from jaxtrachea.trials.uneven_noise import uneven_noise

D = np.linspace(0, 2, 200)
UP_DOWN = np.r_[D, D[::-1]]
SIGMA = 0.005


def force(displacement: Float[np.ndarray, " n"], seed=0, sigma=SIGMA):
    """Of a hardening press, 0 to 1.8 N, with noise."""
    noise = sigma * np.random.default_rng(seed).standard_normal(len(displacement))
    return 0.5 * displacement + 0.1 * displacement**3 + noise


def record(displacement, values, **more):
    return RawCurve("T", "1", "x", displacement, values, np.arange(len(values)), **more)


def finished(displacement, values, **options):
    (curve,) = finish_all([record(displacement, values)], ReadOptions(**options))
    assert isinstance(curve, Curve)
    assert curve.usage is not None
    return curve


CYCLES = np.r_[force(UP_DOWN), 0.85 * force(UP_DOWN, 1)]
#: name -> (displacement, force, what is said, largest displacement that is used)
FAULTY = {
    "clipped": (D, np.minimum(force(D), 1.0), "the force stays at 1 N over the last", 1.41),
    "clipped, then noise": (
        D, np.minimum(force(D, sigma=0), 1.0) + force(0 * D), "saturates, or the wall", 1.41,
    ),
    "broken": (D, force(D) - 0.5 * (D > 1.5), "the force falls by 3", 1.5),
    "broken at last": (D, force(D) - 0.5 * (D > 1.98), "the loading ends there", 1.98),
    "buckled": (D, force(np.where(D > 1.5, 3 - D, D)), "the loading ends there", 1.5),
    "drifted": (UP_DOWN, force(UP_DOWN) + 0.1 * np.linspace(0, 1, 400), "zero has drifted", 2),
    "softer cycle": (np.r_[UP_DOWN, UP_DOWN], CYCLES, "15 % softer than the first", 2),
}  # fmt: skip


@pytest.mark.parametrize(("displacement", "values", "said", "end"), FAULTY.values(), ids=FAULTY)
def test_faults_are_said(displacement, values, said, end):
    curve = finished(displacement, values)
    assert [r for r in curve.usage.remarks if said in r], curve.usage.remarks
    assert curve.displacement.max() == pytest.approx(end, abs=0.06)
    kept = finished(displacement, values, loading="all")
    assert kept.usage.used == len(values)
    assert [r for r in kept.usage.remarks if said in r], kept.usage.remarks


def test_a_small_slip_is_said_and_not_cut():
    slipped = force(np.where(D > 1.2, D - 0.1, D))
    curve = finished(D, slipped)
    (said,) = curve.usage.remarks
    assert re.search(r"falls by \d.* at 1\.1.* \(a slip\).*data.displacement_max", said), said
    assert curve.usage.used == len(D)


def test_a_hold_or_an_outlier_is_no_break():
    relaxing = force(D)[-1] * (1 - 0.2 * np.linspace(0, 1, 80))
    steps = [np.r_[np.linspace(i, i + 1, 40) / 2, np.full(60, (i + 1) / 2)] for i in range(4)]
    falls = np.tile(np.r_[np.zeros(40), np.linspace(0, 0.2, 60)], 4)
    stepwise = np.concatenate(steps)
    spike = force(D) + np.where(np.arange(200) == 120, 0.5, 0)
    pause = np.r_[D[:120], np.full(8, D[120]), D[120:]]  # too short for a hold
    dip = np.r_[np.zeros(120), np.linspace(0, 0.15, 9), np.linspace(0.14, 0, 20), np.zeros(59)]
    for displacement, values in (
        (pause, force(pause) - dip),
        (np.r_[D, np.full(80, 2.0)], np.r_[force(D), relaxing]),
        (stepwise, force(stepwise) - falls),
        (D, spike),
        (np.repeat(D, 2)[::2], np.round(force(D), 1)),  # a coarse resolution
    ):
        remarks = finished(displacement, values).usage.remarks
        assert not [r for r in remarks if "falls by" in r or "stays at" in r], remarks


def test_clean_records_say_nothing():
    """Of 600 clean presses, 10 to 500 samples, noise of 0.2 to 5 %: at most 2 % (found: none)."""
    rng, records = np.random.default_rng(5), []
    for _ in range(600):
        n, level = int(10 ** rng.uniform(1, 2.7)), 10 ** rng.uniform(-2.7, -1.3)
        d = np.linspace(0, rng.uniform(0.5, 4), n)
        clean = rng.uniform(0.3, 2) * d ** rng.uniform(1, 2.2)
        records.append(record(d, clean + level * clean.max() * rng.standard_normal(n)))
    curves = finish_all(records, ReadOptions())
    assert sum(bool(c.usage.remarks) for c in curves if isinstance(c, Curve) and c.usage) <= 12


def trial(name, factor=1.0, seed=0, s=40.0, sigma=SIGMA, **more):
    return Curve("T", name, s, 0.0, D, factor * force(D, seed, sigma), **more)


def test_trials_that_differ():
    slow, fast = (("speed [mm/s]", 0.1), ("lot", 3.0)), (("speed [mm/s]", 10.0), ("lot", 3.0))
    same = [trial("a", seed=1), trial("b", seed=2), trial("c", s=60.0)]
    assert list(repeat_sentences(differing_trials(same))) == []
    differing = [trial("a", seed=1, conditions=slow), trial("b", 1.35, seed=2, conditions=fast)]
    found = differing_trials([*differing, trial("c", s=60.0)])
    (sentence,) = repeat_sentences(found)
    assert "trials of T at s = 40 mm differ by 35 %, their noise is 0.2" in sentence
    assert "speed [mm/s] (0.1 to 10, with which it grows)" in sentence
    assert "lot" not in sentence
    told = trial_remarks(found)  # for each of them in curves.csv
    assert told.keys() == {("T", "a"), ("T", "b")}
    assert "differ by 35 %; the force goes along with speed" in told["T", "a"]
    ordered = [trial(f"{k}", 1 - 0.1 * k, seed=k) for k in range(3)]
    assert "the number of the trial (0 to 2, with which it falls)" in next(
        repeat_sentences(differing_trials(ordered))
    )


def test_air_of_another_length_is_no_difference():
    def in_air(name, air, factor, seed):
        way = np.linspace(0, 2 + air, 300)
        noise = SIGMA * np.random.default_rng(seed).standard_normal(300)
        return Curve("T", name, 40.0, 0.0, way, factor * force(np.maximum(way - air, 0)) + noise)

    assert differing_trials([in_air("a", 0.3, 1, 1), in_air("b", 0.8, 1, 2)]) == []
    assert differing_trials([in_air("a", 0.3, 1, 1), in_air("b", 0.8, 1.6, 2)])


def test_uneven_noise_and_its_weights():
    curves = [trial("quiet", seed=1), trial("loud", seed=2, s=60.0, sigma=0.1)]
    (sentence,) = uneven_noise(curves)
    assert "(quiet) to 0.1" in sentence
    assert "'estimate per curve'" in sentence
    assert list(uneven_noise([curves[0], trial("also", seed=3, s=60.0)])) == []
    lane = dict.fromkeys(Lane._fields)
    ones = np.ones((1, 2, 200))
    lane |= {"others": {}, "s_c": np.zeros((1, 2)), "precision": ones, "force": ones}
    precision = weighed_by_curve(Lane(**lane), [curves], joint=False).precision
    # The floor of 0.2 % of the largest force is 0.0036 N.
    ratio = 0.1 / np.hypot(SIGMA, 0.0036)
    assert precision[0, 0, 0] / precision[0, 1, 0] == pytest.approx(ratio, rel=0.2)
    assert np.mean(1 / precision[0, :, 0] ** 2) == pytest.approx(1, rel=1e-9)
    own = [trial("a", sigma=0.1), Curve("T", "b", 60.0, 0.0, D, force(D), sigma=np.ones(200))]
    with pytest.raises(ValueError, match="trial 'b'.*a sigma of its own"):
        weighed_by_curve(Lane(**lane), [own], joint=False)


HEAD = "specimen,trial,s [mm],displacement [mm],force [N],speed [mm/s],operator\n"


def test_machine_compliance(tmp_path):
    """A rig that gives way by 0.05 mm/N: the displacement of the tool comes back."""
    clean = force(D, sigma=0)
    for name in ("a.csv", "b.csv"):
        rows = [
            f"{name[0]},1,40,{d + 0.05 * f!r},{f!r},0.5,me"
            for d, f in zip(D.tolist(), clean.tolist(), strict=True)
        ]
        (tmp_path / name).write_text(HEAD + "\n".join(rows))
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for given in ("50 um/N", {"a.csv": "0.05 mm/N", "*": "0 mm/N"}):
        first, second = read_measurements(files, ReadOptions(machine_compliance=given)).curves
        np.testing.assert_allclose(first.displacement, D, atol=1e-12)
        rest = 0.0 if isinstance(given, str) else 0.05
        np.testing.assert_allclose(second.displacement, D + rest * clean, atol=1e-12)
    assert first.conditions == (("speed [mm/s]", 0.5),)
    turned = ReadOptions(machine_compliance="0.05 mm/N", force_sign=-1, displacement_sign=-1)
    (drawn,) = read_measurements(files[:1], turned).curves
    np.testing.assert_allclose(drawn.displacement, -D, atol=1e-12)
    (bad,) = read_measurements(files[:1], ReadOptions(machine_compliance="1.3 mm/N")).bad
    assert bad.kind == "absurd_scale"
    assert "measure it against a rigid stop" in bad.cure
    for table, says in (
        ({"a.csv": "0 mm/N"}, "b.csv: machine_compliance names 'a.csv', not this file"),
        ({"*": "0 mm/N", "c.csv": "0 mm/N"}, "names 'c.csv', which none of the 2 files fits"),
    ):
        with pytest.raises(DataError, match=says.replace("(", r"\(")):
            read_measurements(files, ReadOptions(machine_compliance=table))
    with pytest.raises(ValueError, match="unit 'mm' does not measure compliance"):
        ReadOptions(machine_compliance="0.05 mm")
