"""Records as they went: which samples, what is told of speeds and holds, what is refused."""

import dataclasses
import itertools

import numpy as np
import pytest

from jaxtrachea.fitting.relaxing import beyond_ramps
from jaxtrachea.measurements.checks import finish
from jaxtrachea.measurements.curve import BadCurve, Curve, RawCurve, ReadOptions
from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.measurements.segments import segment
from jaxtrachea.measurements.whole_record import (
    averaged,
    averaged_noise,
    block_edges,
    ramp_speed,
)

#: Rest, a ramp of 2 mm/s, a hold, unloading at 1.5 mm/s, a second, smaller press of 2 mm/s.
CORNERS = np.array([0.0, 2.0, 4.0, 14.0, 16.0, 20.0, 21.0, 29.0])
WAY = np.array([-1.0, -1.0, 3.0, 3.0, 0.0, 0.0, 2.0, 2.0])
#: Strength and time of the branch, N/mm, s.
GAMMA, TAU, STIFF = 0.9, 1.0, 0.3


def linear(depth):
    return STIFF * np.maximum(depth, 0)


def force_of(time, depth, elastic=linear):
    """A spring beside one branch, step by step, each exact for a straight way."""
    held, before, out = 0.0, 0.0, []
    for dt, e in zip(np.diff(time, prepend=time[0] - 1e-9), elastic(depth), strict=True):
        x = dt / TAU
        held = np.exp(-x) * held - GAMMA * np.expm1(-x) / x * (e - before)
        before = e
        out.append(max(e + held, 0.0))
    return np.array(out)


def record(**changes):
    rng, time = np.random.default_rng(0), np.arange(0.0, 30.0, 0.01)
    depth = np.interp(time, CORNERS, WAY)
    force = force_of(time, depth) + rng.normal(0, 0.002, time.size)
    noisy = depth + rng.normal(0, 1e-4, time.size)
    raw = RawCurve("a", "t", "file", noisy, force, np.arange(time.size), s=20.0, time=time)
    return dataclasses.replace(raw, **changes)


WHOLE = ReadOptions(loading="record")


def test_all_of_it_is_used_and_its_first_loading_is_known():
    curve = finish(record(), WHOLE)
    assert isinstance(curve, Curve)
    assert len(curve.force) == len(curve.time) == 3000
    rising = curve.rising
    assert rising.rise is None
    assert rising.displacement[0] == pytest.approx(-1, abs=0.02)
    assert rising.displacement[-1] == pytest.approx(3, abs=0.02)
    assert rising.time[-1] == pytest.approx(4, abs=0.1)
    told = " ".join(curve.usage.remarks)
    assert "ramps of 1.5 to 2 mm/s" in told
    # The hold begins at exp(-0) of what the ramp has left of the branch, and ends at none of it.
    ramp = GAMMA * TAU / 1.5 * (1 - np.exp(-1.5 / TAU))
    fall = 100 * ramp / (1 + ramp)
    assert f"the force falls by up to {fall:.2g} %" in told


def test_an_elastic_fit_is_told_of_which_speed_its_stiffness_is():
    told = finish(record(), ReadOptions(loading="first")).usage.remarks
    assert any(remark.startswith("k_1 is that of 2 mm/s: in the hold the force") for remark in told)


def test_blocks_keep_corners_and_means():
    raw = record(sigma=np.full(3000, 0.1))
    curve = finish(raw, dataclasses.replace(WHOLE, samples=400))
    assert 300 < len(curve.force) <= 420
    found = segment(raw.displacement, raw.force, raw.time, first=True)
    edges = block_edges(found, raw.displacement, raw.time, 400)
    starts = [part.start for part in found.parts]
    assert np.isin(starts, edges).all()
    count = np.diff(np.append(edges, 3000))
    for values in (raw.force, raw.displacement, raw.time):
        assert averaged(values, edges) @ count / 3000 == pytest.approx(values.mean(), rel=1e-12)
    np.testing.assert_allclose(averaged_noise(raw.sigma, edges), 0.1 / np.sqrt(count), rtol=1e-12)
    np.testing.assert_allclose(curve.sigma, 0.1 / np.sqrt(count), rtol=1e-12)
    # Where the hold begins blocks are single samples, and grow; it ends in single ones.
    hold = next(part for part in found.parts if part.kind == "hold")
    of_hold = count[(edges >= hold.start) & (edges < hold.stop)]
    assert (of_hold[:5] == 1).all()
    assert of_hold.max() > 20
    assert (of_hold[-2:] == 1).all()


def spaced(step):
    """Times with every corner; `step`: those of a hold since it began, of its duration."""
    parts = [
        a + (step(b - a) if up == down else np.linspace(0, b - a, 200, endpoint=False))
        for (a, b), (up, down) in zip(
            itertools.pairwise(CORNERS), itertools.pairwise(WAY), strict=True
        )
    ]
    return np.concatenate([*parts, CORNERS[-1:]])


def fast_then_slow(duration):
    """A sample every 2 ms for half a second, then every 0.2 s."""
    return np.append(np.arange(0, min(duration, 0.5), 0.002), np.arange(0.5, duration, 0.2))


TIMES = {
    "even": np.arange(0.0, 29.0, 0.01),
    "logarithm of time": spaced(lambda d: np.append(0, np.geomspace(2e-3, d, 300)[:-1])),
    "few, logarithm": spaced(lambda d: np.append(0, np.geomspace(2e-3, d, 60)[:-1])),
    "two rates": spaced(fast_then_slow),
    "jitter": np.sort(np.arange(0.0, 29.0, 0.01) + np.random.default_rng(3).uniform(0, 8e-3, 2900)),
}


@pytest.mark.parametrize("samples", [40, 100, 400])
@pytest.mark.parametrize("time", TIMES.values(), ids=TIMES)
def test_mean_forces_lie_on_the_curve_through_mean_samples(time, samples):
    """Whatever the times of samples are: the force from block to block is the mean force.

    Truth is the force at the times of all samples, from steps of 1 ms.
    """
    corners = WAY.copy()
    corners[4] = 1.0  # unloads in contact, so that the second press is upon what is left
    corners[5] = 1.0

    def elastic(depth):
        return STIFF * np.maximum(depth, 0) + 0.03 * np.maximum(depth, 0) ** 3

    fine = np.union1d(np.arange(0.0, 29.0, 1e-3), time)
    force = force_of(fine, np.interp(fine, CORNERS, corners), elastic)[np.isin(fine, time)]
    depth = np.interp(time, CORNERS, corners)
    raw = record(displacement=depth, force=force, time=time, rows=np.arange(time.size), sigma=None)
    curve = finish(raw, dataclasses.replace(WHOLE, samples=samples))
    assert len(curve.force) < time.size
    steps = force_of(curve.time, curve.displacement, elastic)
    # 0.1 % of the peak: a hundredth of what a branch gives.
    np.testing.assert_allclose(curve.force, steps, rtol=0, atol=1e-3 * force.max())


def test_markers_are_averaged_and_gaps_stay():
    moved = np.ones((3000, 2))
    moved[500, 1] = np.nan
    raw = record(joint_rings=np.array([3, 4]), joint_displacement=moved)
    curve = finish(raw, dataclasses.replace(WHOLE, samples=400))
    assert curve.joint_displacement.shape == (len(curve.force), 2)
    assert (curve.joint_displacement[:, 0] == 1).all()
    assert np.isnan(curve.joint_displacement[:, 1]).sum() == 1


STILL = np.repeat(np.arange(0.0, 30.0, 0.1), 10)
BACK = np.concatenate([np.arange(0.0, 15.0, 0.01), np.arange(0.0, 15.0, 0.01)])
REFUSED = {
    "no time": ({"time": None}, 'there is no time, which loading = "record" needs'),
    "it stands still": ({"time": STILL}, "time stands still in 2700 of 2999 steps"),
    "it falls": ({"time": BACK}, "time falls from 14.99 to 0 s"),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED)
def test_time_that_is_none_is_refused(changes, message):
    done = finish(record(**changes), WHOLE)
    assert isinstance(done, BadCurve)
    assert (done.kind, message in done.message) == ("time", True)
    assert 'loading = "' in done.cure


UNUSABLE = {
    "no unit": ("time", 2.0, "unit_missing", "column 'time' has no unit"),
    "a gap": ("time [s]", np.nan, "non_finite", "time is empty, NaN or infinite in line 42"),
}


@pytest.mark.parametrize(("head", "entry", "kind", "message"), UNUSABLE.values(), ids=UNUSABLE)
@pytest.mark.parametrize("tidy", [True, False])
def test_a_column_of_time_that_cannot_be_used_is_refused_by_name(
    tmp_path, tidy, head, entry, kind, message
):
    """It is there: the cure is a unit, or a sample less, not another column."""
    raw = record()
    table = np.stack([raw.time, raw.displacement, raw.force], axis=1)[::10]
    table[40, 0] = entry if np.isnan(entry) else table[40, 0]
    first = "specimen,trial," if tidy else ""
    rows = [f"{first}{head},displacement [mm],force [N]"]
    rows += [f"{'T,a,' if tidy else ''}{t:.9g},{d:.9g},{f:.9g}" for t, d, f in table]
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    (bad,) = read_measurements([tmp_path / "a.csv"], dataclasses.replace(WHOLE, s="35 mm")).bad
    assert (bad.kind, message in bad.message) == (kind, True)


@pytest.mark.parametrize("again", [True, False])
def test_two_records_of_one_trial_with_clocks_of_their_own_are_refused(tmp_path, again):
    """A trial of its own for each is the cure, and then both are read; one sample is a mistake."""
    raw = record()
    table = np.stack([raw.time, raw.displacement, raw.force], axis=1)[::10]
    if not again:
        table[[40, 41], 0] = table[[41, 40], 0]

    def read(names):
        rows = ["specimen,trial,time [s],displacement [mm],force [N]"]
        for name in names:
            rows += [f"T,{name},{t:.9g},{d:.9g},{f:.9g}" for t, d, f in table]
        (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
        return read_measurements([tmp_path / "a.csv"], dataclasses.replace(WHOLE, s="35 mm"))

    (bad,) = read(["a", "a"] if again else ["a"]).bad
    assert bad.kind == "time"
    assert ("where a second record begins its own clock" in bad.message) == again
    assert ("give each record a trial of its own" in bad.cure) == again
    if again:
        found = read(["a", "b"])
        assert (len(found.curves), found.bad) == (2, ())


def test_a_record_that_begins_pressed_is_refused():
    raw = record()
    cut = {n: getattr(raw, n)[300:] for n in ("displacement", "force", "rows", "time")}
    done = finish(dataclasses.replace(raw, **cut), WHOLE)
    assert isinstance(done, BadCurve)
    assert "begins with" in done.message
    assert "what relaxes from before is not known" in done.message


def test_a_force_that_moves_before_the_tool_is_refused():
    raw = record()
    falls = raw.force + 0.3 * np.exp(-raw.time / 0.8)
    done = finish(dataclasses.replace(raw, force=falls), WHOLE)
    assert isinstance(done, BadCurve)
    assert "before the tool does: the record does not begin at rest" in done.message


def test_an_offset_of_the_load_cell_is_no_preload():
    raw = record()
    assert isinstance(finish(dataclasses.replace(raw, force=raw.force + 0.4), WHOLE), Curve)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_a_time_in_another_unit_is_doubted(factor):
    raw = record()
    told = finish(dataclasses.replace(raw, time=raw.time * factor), WHOLE).usage.remarks
    assert any("is the unit of time right?" in remark for remark in told)


def test_what_ends_the_record_ends_it_for_good():
    """After a break nothing counts: what follows remembers it."""
    raw = record()
    force = raw.force.copy()
    force[330:] *= 0.3
    curve = finish(dataclasses.replace(raw, force=force), WHOLE)
    assert isinstance(curve, Curve)
    assert 320 < len(curve.force) <= 330


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loading": "record", "displacement_max": 2.0}, "take samples out of a record"),
        ({"loading": "record", "samples": 5}, "expected 20 or more"),
        ({"samples": 100}, 'of records \\(loading = "record"\\)'),
    ],
)
def test_options_that_cannot_be(options, message):
    with pytest.raises(ValueError, match=message):
        ReadOptions(**options)


def test_the_speed_of_a_ramp_is_that_of_its_corners():
    """With noise, of few samples, of steps with holds between them, and of a jump."""
    raw = record()
    assert raw.time is not None
    # 1e-4 mm of noise on steps of 0.02 mm: a running maximum goes ahead by less than 1 %.
    assert ramp_speed(raw.time, raw.displacement) == pytest.approx(2.0, rel=0.01)
    assert ramp_speed(CORNERS, WAY) == 2.0
    steps = np.array([0.0, 0.1, 5.1, 5.2, 9.2, 9.3]), np.array([0.0, 1, 1, 2, 2, 3])
    assert ramp_speed(*steps) == pytest.approx(10.0)
    assert ramp_speed(np.array([0.0, 0.0, 9.0]), np.array([0.0, 1.0, 1.0])) == np.inf
    assert ramp_speed(np.arange(3.0), np.ones(3)) == 0.0


@pytest.mark.parametrize(
    ("speed", "way", "says"),
    [
        (5000.0, 1.0, "extrapolated from ramps of at most 20 mm/s"),
        (40.0, 1.0, "extrapolated from ramps of at most 20 mm/s"),
        (5000.0, 0.1, ""),  # 5 ms, less than the step of the samples
        (21.0, 4.0, ""),  # the same speed
        (5.0, 4.0, ""),  # between the two
    ],
)
def test_a_ramp_beyond_those_of_the_records_is_told(speed, way, says):
    """Records of 1 and 20 mm/s, 10 ms from sample to sample."""
    curves = []
    for v in (1.0, 20.0):
        time = np.arange(0.0, 8.0, 0.01)
        depth = np.clip(v * (time - 1), 0, 4)
        curves.append(Curve("a", f"{v:g}", 20.0, 0.0, depth, depth, time=time))
    assert beyond_ramps(curves, speed, way) == says
