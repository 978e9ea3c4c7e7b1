"""Fits of records whose force relaxes, from the file to predictions at other speeds.

The records are of a body without a skeleton, in closed form.
"""

import csv
import dataclasses
import re
import sys

import numpy as np
import pytest
from run_cli import run

import jaxtrachea
from jaxtrachea.cli.main import main
from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.branch_times import unsampled_time
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import DEFAULTS, in_model
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.labels import verdict_sentence
from jaxtrachea.measurements.curve import Curve

pytestmark = pytest.mark.long

#: Strength and time, s, of the two branches; N/mm in the long run.
GAMMA, TAU, STIFF = (0.9, 0.5), (0.4, 4.0), 0.3
NOISE = 0.002
SPEC = """[data]
files = "holds.csv"
loading = "record"
[model]
coupling = "total"
relaxation = "uniform"
[parameters]
onset = { fixed = 0 }
k_3 = { fixed = 0 }
force_offset = { fixed = 0 }
[noise]
force = "0.002 N"
"""


def path_of(speed, hold=15.0, depth=2.0):
    """Corners of time, s, and displacement, mm: rest, ramp, hold."""
    time = np.cumsum([0.0, 1.0, depth / speed, hold])
    return time, np.array([0.0, 0.0, depth, depth])


def force_at(time, corners, way):
    """Of a path of straight pieces: what each corner changes of the rate, for each branch."""
    force = STIFF * np.interp(time, corners, way)
    rate = STIFF * np.diff(way) / np.diff(corners)
    for t_k, change in zip(corners[:-1], np.diff(rate, prepend=0.0), strict=True):
        since = np.maximum(time - t_k, 0)
        for gamma, tau in zip(GAMMA, TAU, strict=True):
            force = force - gamma * tau * change * np.expm1(-since / tau)
    return force


def record(speed):
    corners, way = path_of(speed)
    rest, ramp = (np.linspace(corners[i], corners[i + 1], 40, endpoint=False) for i in (0, 1))
    hold = corners[2] + np.geomspace(0.02, corners[3] - corners[2], 60)
    time = np.concatenate([rest, ramp, corners[2:3], hold])
    return time, np.interp(time, corners, way), force_at(time, corners, way)


def write(path, speeds, *, clock=True):
    rng = np.random.default_rng(3)
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        head = ["specimen", "trial", "s [mm]", "displacement [mm]", "force [N]"]
        rows.writerow([*head, "time [s]"] if clock else head)
        for speed in speeds:
            for t, d, f in zip(*record(speed), strict=True):
                noisy = f + NOISE * rng.standard_normal()
                cells = ["T", f"v{speed:g}", 40, d, noisy]
                rows.writerow([*cells, t] if clock else cells)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Folder with a fit of two speeds, by the command line."""
    folder = tmp_path_factory.mktemp("time")
    write(folder / "holds.csv", (2.0, 0.2))
    (folder / "fit.toml").write_text(SPEC)
    command = ["jaxtrachea", "fit", str(folder / "fit.toml"), "--out", str(folder / "out")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 0
    return folder


@pytest.fixture(scope="module")
def read(fitted):
    return jaxtrachea.read_results(fitted / "out")


def test_the_branches_are_found_and_the_file_keeps_the_records(read):
    found = {row["parameter"]: row for row in read.table().rows}
    truth = {"k_1": STIFF, "gamma_1": GAMMA[0], "gamma_2": GAMMA[1], "tau_1": TAU[0]}
    for name, value in (truth | {"tau_ratio_2": TAU[1] / TAU[0]}).items():
        row = found[name]
        # 95 % of an interval each: five of them are off by 1.5 half-widths in one of 40 samples.
        half = 1.5 * (row["high95"] - row["low95"]) / 2
        assert abs(row["value"] - value) < half, name
        assert row["verdict"] == "identifiable"
    curve = read.study.curves[0][0]
    time, depth, _ = record(2.0)
    np.testing.assert_allclose(curve.time, time, rtol=1e-12)
    np.testing.assert_allclose(curve.rising.displacement[-1], depth.max(), rtol=1e-6)


def test_another_speed_is_predicted_within_its_band(read):
    """Of neither speed of the fit, ramp and hold."""
    corners, way = path_of(0.7)
    time = np.linspace(0, corners[3], 60)
    curve = jaxtrachea.predict(read, s=40.0, displacement=np.interp(time, corners, way), time=time)
    truth = force_at(time, corners, way)
    pressed = truth > 0.01
    # Steps of 0.29 s across a corner, where the elastic force is not straight, are left out.
    straight = pressed & (np.abs(time - corners[1]) > 0.3) & (np.abs(time - corners[2]) > 0.3)
    off = np.abs(curve.force - truth)[straight]
    assert off.max() < 0.004 * truth.max()


def test_a_speed_and_a_hold_on_the_command_line(fitted, monkeypatch, capsys):
    out = fitted / "ramp"
    code, _, err = run(
        monkeypatch, capsys, "predict", fitted / "out", "--out", out,
        "--at", "s=40,D=0:2:0.1,speed=42 mm/min,hold=10 s",
    )  # fmt: skip
    assert code == 0, err
    with (out / "predictions.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    time, depth, force, low, high = (
        np.array([float(row[name]) for row in rows])
        for name in ("time [s]", "displacement [mm]", "predicted [N]", "low95 [N]", "high95 [N]")
    )
    assert (time[-1], depth.max()) == pytest.approx((2 / 0.7 + 10, 2))
    corners, way = np.array([0, 2 / 0.7, 2 / 0.7 + 10]), np.array([0.0, 2.0, 2.0])
    truth = force_at(time, corners, way)
    assert np.all((low < truth) & (truth < high))
    assert truth[-1] < 0.7 * force.max()
    (line,) = (v for v in (out / "report.md").read_text().splitlines() if v.startswith("| T "))
    shown = [float(v) for v in re.findall(r"[\d.]+", line)]
    assert any(v == pytest.approx(force[-1], rel=5e-3) for v in shown)  # not that of the ramp's end


def test_a_ramp_faster_than_all_records_is_told(read):
    """As a hold that is too long; between the speeds of the fit nothing is said."""
    for speed, told in ((0.7, ""), (200.0, "extrapolated from ramps of at most 2 mm/s")):
        way = np.linspace(0, 2, 21)
        curve = jaxtrachea.predict(read, s=40.0, displacement=way, time=way / speed)
        assert ("extrapolated" in curve.message) == bool(told)
        assert told in curve.message


def test_records_of_other_speeds_are_compared_by_their_own_time(fitted, monkeypatch, capsys):
    write(fitted / "other.csv", (0.7,))
    out = fitted / "other"
    code, _, err = run(
        monkeypatch, capsys, "predict", fitted / "out", "--data", fitted / "other.csv",
        "--out", out,
    )  # fmt: skip
    assert code == 0, err
    with (out / "errors.csv").open(newline="", encoding="utf-8") as stream:
        row = next(csv.DictReader(stream))
    assert row["in_fit"] == "no"
    assert float(row["rms [N]"]) < 1.2 * NOISE
    assert float(row["coverage95"]) > 0.9


def table_of(path):
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


def within(rows, name, truth):
    """Share of the rows whose band has the truth."""
    low, high = (column(rows, f"{name}_{end}") for end in ("low95", "high95"))
    return np.mean((low <= truth) & (truth <= high))


def test_relaxation_and_moduli_have_the_truth_in_their_bands(fitted):
    """Points of a curve are right or wrong together: most, and all within 2 % of the truth."""
    rows = table_of(fitted / "out" / "relaxation.csv")
    t = column(rows, "time [s]")
    truth = 1 + sum(g * np.exp(-t / tau) for g, tau in zip(GAMMA, TAU, strict=True))
    np.testing.assert_allclose(column(rows, "relaxation"), truth, rtol=0.02)
    assert within(rows, "relaxation", truth) > 0.7
    beyond = np.array([row["extrapolated"] == "True" for row in rows])
    assert (beyond == ((t < 0.02) | (t > 17 + 9))).mean() > 0.8
    rows = table_of(fitted / "out" / "moduli.csv")
    x = 2 * np.pi * column(rows, "frequency [Hz]")[:, None] * np.array(TAU)
    storage = 1 + (x**2 / (1 + x**2)) @ np.array(GAMMA)
    loss = (x / (1 + x**2)) @ np.array(GAMMA)
    np.testing.assert_allclose(column(rows, "storage"), storage, rtol=0.02)
    np.testing.assert_allclose(column(rows, "loss"), loss, rtol=0.05)
    assert within(rows, "storage", storage) > 0.7


def test_force_against_speed_has_the_truth_and_the_records(fitted):
    rows = table_of(fitted / "out" / "rates.csv")
    model = [row for row in rows if row["force [N]"]]
    speed = column(model, "speed [mm/s]")
    truth = [
        force_at(np.array([2 / v]), np.array([0, 2 / v]), np.array([0, 2.0]))[0] for v in speed
    ]
    np.testing.assert_allclose(column(model, "force [N]"), truth, rtol=0.01)
    seen = [row for row in rows if row["measured [N]"]]
    np.testing.assert_allclose(sorted(column(seen, "speed [mm/s]")), [0.2, 2.0], rtol=0.02)
    flags = {row["extrapolated"] for row in model if not 0.19 < float(row["speed [mm/s]"]) < 2.1}
    assert flags == {"True"}
    assert {row["extrapolated"] for row in seen} == {"False"}


def test_the_work_of_each_record_is_that_of_the_model(fitted):
    rows = table_of(fitted / "out" / "energy.csv")
    assert [row["trial"] for row in rows] == ["v2", "v0.2"]
    for row, speed in zip(rows, (2.0, 0.2), strict=True):
        t = np.linspace(0, 2 / speed, 2001)
        force = force_at(t, np.array([0, 2 / speed]), np.array([0, 2.0]))
        work = np.sum((force[1:] + force[:-1]) / 2) * 2 / 2000
        assert float(row["measured [N mm]"]) == pytest.approx(work, rel=0.01)
        assert float(row["model [N mm]"]) == pytest.approx(work, rel=0.005)
        low, high = (float(row[f"model_{end} [N mm]"]) for end in ("low95", "high95"))
        assert low < work < high
    assert (fitted / "out" / "energy.png").exists()


def test_the_band_of_the_work_is_that_of_differences(read, fitted):
    """The delta method by numpy: derivatives of the model's work by central differences."""
    study, h = read.study, 1e-5

    def work(theta):
        off = predictions(study, theta[None])["force"][0]
        rows = zip(study.curves[0], off, strict=False)
        return np.array([np.trapezoid(c.force + v[: len(c.force)], c.displacement)
                         for c, v in rows])  # fmt: skip

    theta = read.theta[0]
    step = h * np.eye(len(theta))
    J = np.stack([(work(theta + e) - work(theta - e)) / (2 * h) for e in step])
    se = np.sqrt(np.einsum("pt,pq,qt->t", J, read.uncertainty.covariance[0], J))
    half = read.uncertainty.half_width[0] * read.effective.growth[0] * se
    rows = table_of(fitted / "out" / "energy.csv")
    wide = column(rows, "model_high95 [N mm]") - column(rows, "model_low95 [N mm]")
    np.testing.assert_allclose(wide, 2 * half, rtol=1e-4)


REFUSED = {
    "no speed": (("--at", "s=40,D=0:2"), "the force of this fit relaxes"),
    "a hold alone": (("--at", "s=40,D=0:2,hold=3 s"), "give its speed"),
    "a speed in mm": (("--at", "s=40,D=0:2,speed=3 mm"), "does not measure velocity"),
    "a speed of 0": (("--at", "s=40,D=0:2,speed=0"), "expected more than 0"),
}


@pytest.mark.parametrize(("asked", "says"), REFUSED.values(), ids=REFUSED)
def test_presses_that_have_no_force_are_refused(fitted, monkeypatch, capsys, asked, says):
    code, _, err = run(monkeypatch, capsys, "predict", fitted / "out", *asked)
    assert code == 2
    assert says in " ".join(err.split())


def test_times_that_are_none_are_refused(read):
    asked = {"s": 40.0, "displacement": [0.0, 1.0, 2.0]}
    with pytest.raises(ValueError, match="give time"):
        jaxtrachea.predict(read, **asked)
    with pytest.raises(ValueError, match="never fall"):
        jaxtrachea.predict(read, **asked, time=[0.0, 2.0, 1.0])
    with pytest.raises(ValueError, match="time has 2 numbers, displacement 3"):
        jaxtrachea.predict(read, **asked, time=[0.0, 2.0])


def test_a_file_without_time_is_a_row_of_its_own(tmp_path, monkeypatch, capsys):
    write(tmp_path / "holds.csv", (2.0,), clock=False)
    (tmp_path / "fit.toml").write_text(SPEC)
    code, _, err = run(monkeypatch, capsys, "fit", tmp_path / "fit.toml", "--out", tmp_path / "o")
    assert code == 2
    assert 'there is no time, which loading = "record" needs' in " ".join(err.split())


def test_a_branch_that_outlasts_the_records_is_no_estimate(read):
    """The same fit, as if its records had ended at the estimate of tau_2, within its interval."""
    (curves,) = read.study.curves
    assert not any(unsampled_time(read, 0, i) for i in range(len(read.study.unknowns[0])))
    value = {p.name: v for p, v in zip(read.study.free, read.value[0], strict=True)}
    end = value["tau_1"] * value["tau_ratio_2"]
    short = [dataclasses.replace(c, time=c.time * (end / c.time[-1])) for c in curves]
    study = dataclasses.replace(read.study, curves=(tuple(short),))
    result = dataclasses.replace(read, study=study)
    for i, parameter in enumerate(study.free):
        lost = parameter.name in ("gamma_2", "tau_ratio_2")
        says = unsampled_time(result, 0, i)
        assert says.startswith("the record is shorter than tau_2: " if lost else ""), says
        assert bool(says) == lost
        assert (assess(result, 0, i).verdict == "identifiable") != lost


@pytest.mark.slow
def test_a_record_shorter_than_a_branch_does_not_determine_it():
    """Of 20 records of 3 s, tau_2 is 4 s: gamma_2 and its time are never called identifiable."""
    geometry = jaxtrachea.Geometry.create(160.0, list(np.arange(10.0, 151.0, 10.0)))
    options = jaxtrachea.Options(coupling="total", relaxation="uniform")
    rng, curves = np.random.default_rng(5), []
    corners, way = path_of(2.0, hold=1.0)
    time = np.linspace(0, corners[-1], 150)
    depth, force = np.interp(time, corners, way), force_at(time, corners, way)
    for n in range(20):
        noisy = force + NOISE * rng.standard_normal(time.size)
        curves.append(Curve(f"T{n}", "a", 40.0, 0.0, depth, noisy, time=time, rise=(0, 100)))
    held = {"onset": 0.0, "k_3": 0.0, "force_offset": 0.0}
    table = [
        dataclasses.replace(DEFAULTS[p], fixed=True, auto=False, value=held[p])
        if p in held else DEFAULTS[p]
        for p in in_model(options, joints=False)
    ]  # fmt: skip
    result = fit(build_study(curves, geometry, options, table), Settings())
    names = [p.name for p in result.study.free]
    verdicts = [
        assess(result, lane, names.index(name)).verdict
        for lane in range(20)
        for name in ("gamma_2", "tau_ratio_2")
    ]
    assert "identifiable" not in verdicts
    assert "weak" not in verdicts
    said = [verdict_sentence(result, lane) for lane in range(20)]
    # Where noise makes it seem shorter than the record, its relative error says enough.
    assert sum("the record is shorter than tau_2" in text for text in said) >= 15
