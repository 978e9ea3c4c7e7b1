"""The command `predict`: what it is asked for, what it writes, what it refuses."""

import csv
import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from hardening import pairs
from noisy_fits import DEPTHS, true_force
from run_cli import run, tree

import jaxtrachea
from jaxtrachea.measurements.presses import parse_presses
from jaxtrachea.measurements.read import Curve
from jaxtrachea.prediction import held_out
from jaxtrachea.prediction import plots as prediction_plots

ROOT = Path(__file__).parents[2]
COLUMNS = ("specimen", "trial", "s [mm]", "phi [deg]", "tilt [deg]", "displacement [mm]",
           "force [N]", "predicted [N]", "low95 [N]", "high95 [N]")  # fmt: skip


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def write_curves(path, curves):
    """A tidy file of curves."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["specimen", "trial", "s [mm]", "displacement [mm]", "force [N]"])
        for c in curves:
            for d, f in zip(c.displacement, c.force, strict=True):
                writer.writerow([c.specimen, c.trial, c.s_c, float(d), float(f)])
    return path


@pytest.mark.slow
@pytest.mark.compiling
def test_fixed_specification_on_the_command_line(tmp_path, monkeypatch, capsys):
    """It is evaluated, its results predict; what doubts an estimate says that there is none."""
    text = '[data]\nfiles = "a.csv"\n[model]\ncoupling = "total"\n[parameters]\n'
    text += "k_1 = { fixed = 1.0 }\nk_3 = { fixed = 0.1 }\n"
    spec, out = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(text)
    write_curves(tmp_path / "a.csv", [dataclasses.replace(c, s_c=80.0) for c in pairs()])
    code, said, err = run(monkeypatch, capsys, "fit", spec, "--out", out)
    assert code == 0, err
    assert "nothing was fitted" in said
    names = {"results.h5", "summary.csv", "parameters.csv", "report.md", "report.html", "fit.png",
             "provenance.json"}  # fmt: skip
    assert names <= set(tree(out))
    assert "correlation.png" not in tree(out)
    report = (out / "report.md").read_text()
    assert "None: every parameter is fixed" in report
    assert "What the data determine" not in report
    assert "standard errors" not in report + said
    assert "more, see" not in report
    assert [r["specimen"] for r in rows_of(out / "summary.csv")] == ["T1", "T2"]
    for option in ("--profile", "--leave-one-out", "--influence"):
        code, _, err = run(monkeypatch, capsys, "fit", spec, option)
        assert code == 2
        assert f"{option}: no free parameter" in err
    code, _, err = run(monkeypatch, capsys, "design", spec)
    assert code == 2
    assert "design: no free parameter" in err
    data = ["--data", tmp_path / "a.csv", "--out", tmp_path / "p"]
    code, _, err = run(monkeypatch, capsys, "predict", out, *data)
    assert code == 0, err
    fitted = {r["specimen"]: float(r["rms_force_N"]) for r in rows_of(out / "summary.csv")}
    errors = [r for r in rows_of(tmp_path / "p" / "errors.csv") if r["of"] == "curve"]
    assert {r["in_fit"] for r in errors} == {"yes"}
    for name, rms in fitted.items():
        mine = [float(r["rms [N]"]) for r in errors if r["specimen"] == name]
        assert np.isclose(np.sqrt(np.mean(np.square(mine))), rms, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected s, D, phi, tilt, speed, hold, specimen or trial"),
        ("75", "expected s, D, phi, tilt, speed, hold, specimen or trial"),
        ("s=75", "no displacement D"),
        ("D=2", "no contact position s"),
        ("s=75,D=two", "neither a length nor a range"),
        ("s=75,D=2 N", "'N' does not measure length"),
        ("s=75,D=2,D=3", "D is given twice"),
        ("s=75,D=0:6:-1", "do not lead from 0 to 6"),
        ("s=75,D=0:6:0", "do not lead from 0 to 6"),
        ("s=75,D=0:1e9:1e-3", "more than 100000"),
        ("s=0:160:0.1,D=0:6:0.01", "more than 100000"),
        ("s=75,D=1e999", "finite"),
        ("s=75,D=0:1 cm:0.25", "some numbers have a unit and others none"),
        ("s=75,D=0 mm:1:0.25", "some numbers have a unit and others none"),
        ("s=75,D=1:2 mm:0.5 mm", "some numbers have a unit and others none"),
        ("s=75,D=0:1 N:1 mm", "'N' does not measure length"),
        ("s=75,D=0:1:2:3", "neither a length nor a range"),
        ("s=75,D=0::1", "neither a length nor a range"),
        ("s=75,D=0 mm:", "neither a length nor a range"),
        ("s=75,D=2,q=1", "'q=1' is not understood"),
        ("s=75,D=2,phi=north", "phi:"),
        ("s=75,D=2,phi=1_0", "phi:"),
        ("s=75,D=2,phi=nan", "expected a finite angle"),
        ("s=75,D=2,tilt=90", "moves inwards; expected within 90 deg"),
        ("s=75,D=2,tilt=1 mm", "tilt:"),
    ],
)
def test_presses_that_make_no_sense(text, says):
    with pytest.raises(ValueError, match=says.replace("(", r"\(")):
        parse_presses(text, needs_position=True)


def test_presses_in_units_and_ranges():
    found = parse_presses("s = 7.5 cm, D=0:2000:500 um, specimen=a,b, trial=x", needs_position=True)
    assert np.allclose(found.s, [75.0])
    assert np.allclose(found.displacement, [0, 0.5, 1, 1.5, 2])
    assert (found.specimen, found.trial) == ("a,b", "x")
    assert np.allclose(
        parse_presses("D=1:-0.5:-0.5", needs_position=False).displacement, [1, 0.5, 0, -0.5]
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0 mm:2 mm:0.5 mm", [0, 0.5, 1, 1.5, 2]),
        ("0:2 mm:500 um", [0, 0.5, 1, 1.5, 2]),
        ("1 mm : 0.3 cm : 1mm", [1, 2, 3]),
        ("1 cm:0:-5 mm", [10, 5, 0]),
        ("0:1:0.25 cm", [0, 2.5, 5, 7.5, 10]),
        ("1:2 um", 1e-3 + np.arange(21) * 5e-5),
        ("100 um:2 mm", 0.1 + np.arange(21) * 0.095),
    ],
)
def test_each_number_of_a_range_may_have_a_unit(text, expected):
    """One at the end holds for all of them."""
    found = parse_presses(f"D={text}", needs_position=False)
    np.testing.assert_allclose(found.displacement, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        parse_presses(f"s={text},D=1", needs_position=True).s, expected, rtol=1e-12, atol=1e-15
    )


def test_a_range_ends_within_its_end():
    """Whole steps: the end is a value where one ends on it; without a step 20 lead to it."""
    for text, values in (
        ("D=0:1:0.3", [0, 0.3, 0.6, 0.9]),
        ("D=0:0.9:0.3", [0, 0.3, 0.6, 0.9]),
        ("D=0:1", np.linspace(0, 1, 21)),
    ):
        found = parse_presses(text, needs_position=False)
        np.testing.assert_allclose(found.displacement, values, atol=1e-12)
    for text in ("D=two", "D=0:1:-0.3"):
        with pytest.raises(ValueError, match="whole steps from START, none beyond STOP"):
            parse_presses(text, needs_position=False)
    page = (ROOT / "docs/after_a_fit.md").read_text()
    assert "0:1:0.3" in page
    assert "the end is included" not in page


def test_presses_aside_in_degrees_or_a_unit():
    """Tan 45 deg is 1; growing phi is positive."""
    found = parse_presses("s=75,D=2,phi=-30,tilt=0.25 rad", needs_position=True)
    assert np.isclose(found.phi, -np.pi / 6, rtol=1e-15)
    assert np.isclose(found.direction[1] / found.direction[0], np.tan(0.25), rtol=1e-15)
    plain = parse_presses("s=75,D=2,phi=0", needs_position=True)
    assert (plain.phi, plain.direction) == (0.0, (1.0, 0.0))


@pytest.mark.parametrize("aside", ["phi=30 deg", "tilt=10"])
def test_a_line_of_joints_is_pressed_on_the_midline(study, tmp_path, monkeypatch, capsys, aside):
    at = ("--at", f"s=75,D=2,{aside}", "--out", tmp_path / "a")
    code, _, err = run(monkeypatch, capsys, "predict", study[0], *at)
    assert code == 2
    assert "anterior midline" in err
    assert "skeleton = 'sections'" in " ".join(err.split())
    assert not (tmp_path / "a").exists()


def test_command_writes_what_the_page_says(study, tmp_path, monkeypatch, capsys):
    data = [Curve("s0001", "new", 61.0, 0.0, DEPTHS, true_force(61.0)),
            Curve("s0002", "off", 200.0, 0.0, DEPTHS, true_force(61.0)),
            Curve("$T9 $x", "new", 61.0, 0.0, DEPTHS, true_force(61.0))]  # fmt: skip
    file = write_curves(tmp_path / "new.csv", data)
    code, out, err = run(
        monkeypatch, capsys, "predict", study[0], "--data", file, "--out", tmp_path / "a"
    )
    assert code == 1
    assert "position" in err
    assert "unknown" in out
    rows = rows_of(tmp_path / "a" / "predictions.csv")
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 2 * len(DEPTHS)
    good = [r for r in rows if r["specimen"] == "s0001"]
    miss = [abs(float(r["force [N]"]) - float(r["predicted [N]"])) for r in good]
    errors = rows_of(tmp_path / "a" / "errors.csv")
    one = next(r for r in errors if r["specimen"] == "s0001")
    assert np.isclose(float(one["rms [N]"]), np.sqrt(np.mean(np.square(miss))))
    assert np.isclose(abs(float(one["worst [N]"])), max(miss))
    assert one["coverage95"] == "1.0"
    assert {r["status"] for r in errors if r["of"] == "curve"} == {
        "ok",
        "unknown_specimen",
        "bad_data",
    }
    assert [r["of"] for r in errors] == ["curve", "curve", "position", "all", "curve"]
    names = {"predictions.csv", "bands.csv", "joints.csv", "errors.csv", "report.md", "curves.png",
             "measured_predicted.png"}  # fmt: skip
    assert set(tree(tmp_path / "a")) == names
    code, out, err = run(
        monkeypatch, capsys, "predict", study[0] / "results.h5", "--at",
        "s=6.1 cm,D=0:6:2,specimen=s0001", "--out", tmp_path / "b",
    )  # fmt: skip
    assert (code, err) == (0, "")
    page = (ROOT / "docs" / "after_a_fit.md").read_text()
    for path in (*(tmp_path / "a").iterdir(), *(tmp_path / "b").iterdir()):
        assert f"`{path.name}`" in page
        if path.suffix == ".csv":
            assert all(f"`{name}`" in page for name in rows_of(path)[0]), path
    joints = rows_of(tmp_path / "b" / "joints.csv")
    assert len(joints) == 4 * 15
    assert float(joints[-8]["reaction_low95 [N]"]) < float(joints[-8]["reaction [N]"])


def test_pictures_say_what_they_leave_out_and_cost_themselves_only(read, tmp_path, monkeypatch):
    """13 specimens, one of 11 curves, names that matplotlib would read; a picture that fails."""
    at = {"s": 61.0, "displacement": DEPTHS}
    one = jaxtrachea.predict(read, specimen="s0003", **at)
    names = ["$T9 $x", "_hidden", *(f"s{i}" for i in range(11))]
    many = [dataclasses.replace(one, specimen=name, trial="$a_$") for name in names]
    titles = [axis.get_title() for axis in prediction_plots._panels(many_pairs(many)).axes]
    assert titles[:2] == [r"\$T9 \$x", " _hidden"]
    title = prediction_plots._panels(many_pairs(many)).get_suptitle()
    assert title == "the first 12 of 13 specimens; all: predictions.csv"
    figure = prediction_plots._panels(many_pairs([one] * 11))
    assert figure.axes[0].get_title() == "s0003 (the first 10 of 11 curves)"
    assert figure.get_suptitle() == "all: predictions.csv"
    curve = dataclasses.replace(read.study.curves[0][0], displacement=DEPTHS)
    compared = [held_out.Compared(curve, p, "no") for p in many[:2]]

    def fail(*_):
        raise ValueError("no room")

    with monkeypatch.context() as patch:
        patch.setattr(prediction_plots, "_panels", fail)
        lost = prediction_plots.draw_compared(tmp_path, compared)
    assert lost == {"curves.png": "ValueError: no room"}
    assert list(tree(tmp_path)) == ["measured_predicted.png"]
    assert prediction_plots.draw_predictions(tmp_path, many[:2]) == {}


#: Those of Table 1, as a specification has them.
TABLE_1_RINGS = str([f"{10 * k} mm" for k in range(1, 16)]).replace("'", '"')


def many_pairs(curves):
    return [(curve, None) for curve in curves]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["RESULTS"], "give either --at"),
        (["RESULTS", "--at", "s=1,D=1", "--data", "x.csv"], "give either --at"),
        (["RESULTS", "x.csv"], "come after --data"),
        (["nowhere", "--at", "s=75,D=1"], "no such folder or file"),
        (["RESULTS", "--at", "s=75"], "no displacement D"),
        (["RESULTS", "--at", "s=175,D=1"], "expected 0 to 160 mm"),
        (["RESULTS", "--at", "s=75,D=1,specimen=x"], "specimen 'x' is not in this fit"),
        (["RESULTS", "--at", "s=75,D=1,specimen=s0001,trial=x"], "trial 'x' is not in this fit"),
        (["RESULTS", "--data", "nowhere.csv"], "no file"),
        (["RESULTS", "--data", "nowhere.toml"], "nowhere.toml"),
        (["RESULTS", "--data", "results.h5"], "holds the results of a fit"),
        (["RESULTS", "--data", "off.csv"], "no usable curve"),
        (["RESULTS", "--data", "off.csv", "--as", "x"], "specimen 'x' is not in this fit"),
        (["RESULTS", "--data", "tube.toml"], "120 mm with 2 rings, but the fit's is 160 mm"),
        (["RESULTS", "--data", "round.toml"], "radius 9 mm, but the fit's is radius 11.3 mm"),
        (["RESULTS", "--data", "model.toml"], "model: not that of the fit"),
        (
            ["RESULTS", "--at", "s=75,D=1,specimen=s0001", "--out", "full"],
            "exists and is not empty",
        ),
        (["RESULTS", "--at", "s=75,D=1,specimen=s0001", "--out", "off.csv/x"], "off.csv"),
    ],
)
def test_bad_input_ends_with_a_cure(arguments, says, study, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_curves(tmp_path / "off.csv", [Curve("s0001", "a", 200.0, 0.0, DEPTHS, DEPTHS)])
    shutil.copy(study[0] / "results.h5", tmp_path)
    tube = '[trachea]\nlength = "120 mm"\nrings = ["30 mm", "60 mm"]\n'
    (tmp_path / "tube.toml").write_text(f'[data]\nfiles = "off.csv"\n{tube}')
    wide = tube.replace("120", "160").replace('["30 mm", "60 mm"]', TABLE_1_RINGS)
    (tmp_path / "round.toml").write_text(f'[data]\nfiles = "off.csv"\n{wide}radius = "9 mm"\n')
    (tmp_path / "model.toml").write_text('[data]\nfiles = "off.csv"\n[model]\nshear = true\n')
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    before = tree(tmp_path)
    names = [str(study[0]) if a == "RESULTS" else a for a in arguments]
    code, _, err = run(monkeypatch, capsys, "predict", *names)
    assert code == 2
    assert says in " ".join(err.split())
    assert "Traceback" not in err
    assert tree(tmp_path) == before
