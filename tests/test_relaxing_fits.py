"""Shipped fits of records that relax: truth in the intervals, and the recorded results."""

import csv
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from run_cli import run

FITS = Path(__file__).parents[1] / "fits"
SPEEDS, AFM = FITS / "three_speeds", FITS / "afm_relaxation"


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def estimates(folder):
    with (folder / "parameters.csv").open(newline="") as stream:
        return {row["parameter"]: row for row in csv.DictReader(stream)}


def compare(folder, known):
    rows = estimates(folder)
    assert list(rows) == list(known["parameters"])
    for name, value in known["parameters"].items():
        assert float(rows[name]["value"]) == pytest.approx(value, rel=known["tolerance"])
    with (folder / "summary.csv").open(newline="") as stream:
        (summary,) = csv.DictReader(stream)
    assert summary["status"] == known["status"]
    assert float(summary["rms_over_peak"]) == pytest.approx(known["rms_over_peak"], rel=0.01)


def test_records_are_those_of_the_script(tmp_path):
    """The first at one place and speed, written anew."""
    script = load(SPEEDS / "make.py")
    rng = np.random.default_rng(46)
    time, way, force = script.record(script.PLACES[0], script.SPEEDS[0], rng)
    with (SPEEDS / "records.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))[: len(time)]
    for name, made in (("time [s]", time), ("displacement [mm]", way), ("force [N]", force)):
        np.testing.assert_allclose([float(r[name]) for r in rows], made, rtol=2e-5, atol=1e-6)


@pytest.mark.slow
def test_three_speeds_tell_what_lasts_and_what_relaxes(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert run(monkeypatch, capsys, "fit", SPEEDS / "fit.toml", "--out", out)[0] == 0
    truth = load(SPEEDS / "make.py").TRUTH
    rows = estimates(out)
    assert list(rows) == list(truth)
    for name, value in truth.items():
        assert float(rows[name]["low95"]) < value < float(rows[name]["high95"])
    for name in ("gamma_1", "gamma_2", "tau_1", "tau_ratio_2"):
        assert rows[name]["verdict"] == "identifiable"
        assert float(rows[name]["value"]) == pytest.approx(truth[name], rel=0.02)
    compare(out, json.loads((SPEEDS / "expected.json").read_text()))


@pytest.mark.slow
def test_the_record_of_a_microscope_is_fitted_by_two_branches(tmp_path, monkeypatch, capsys):
    """Numbers that the record does not tell are not compared: the misfit and the onset are."""
    out, known = tmp_path / "out", json.loads((AFM / "expected.json").read_text())
    assert run(monkeypatch, capsys, "fit", AFM / "fit.toml", "--out", out)[0] == 0
    rows = estimates(out)
    assert float(rows["onset"]["value"]) == pytest.approx(known["onset"], abs=1e-4)
    assert rows["k_1"]["verdict"] == "at bound"
    with (out / "summary.csv").open(newline="") as stream:
        (summary,) = csv.DictReader(stream)
    assert float(summary["rms_over_peak"]) == pytest.approx(known["rms_over_peak"], rel=0.05)
