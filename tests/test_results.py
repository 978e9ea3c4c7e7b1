"""Rows and files of a fit, and their page; a study with a failed, a bad and a trial-wise lane."""

import csv
import dataclasses
import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxtrachea.files.output import OutputExists, new_directory, new_output
from jaxtrachea.files.table import Column, Interval, Table, number, words
from jaxtrachea.fitting.assessment import unknown_label
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.effective import lag_correlation
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.cross_validation import left_out_table
from jaxtrachea.inference.analyses.effective import EFFECTIVE
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.cross_validation import curves_to_leave_out, leave_one_out
from jaxtrachea.inference.labels import weakest_sentence
from jaxtrachea.inference.residuals import rms, worst
from jaxtrachea.measurements.read import BadCurve, Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.report.fit import report_text
from jaxtrachea.report.plots import _draw_bands, draw_all
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.results.rows import bad_row, lane_rows, parameter_rows
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import table_1

PAGE = (Path(__file__).parents[1] / "docs" / "results.md").read_text()
BAD = BadCurve("T9", "1", "x.csv", "non_finite", "line 3: force is nan", "leave it out")
TOTAL = Options(coupling="total")


def curves():
    """Two specimens of two trials, k_1 D + 0.1 D^3 with k_1 = 1 and 2; trial b 2 % stiffer."""
    depth = np.linspace(0.1, 2, 12)
    for s, k_1 in (("T1", 1.0), ("T2", 2.0)):
        for trial, factor in (("a", 1.0), ("b", 1.02)):
            yield Curve(s, trial, None, 0.0, depth, factor * (k_1 * depth + 0.1 * depth**3))


def make_study(**changes):
    names = ["k_1", "k_3", "onset", "force_offset"]
    table = [dataclasses.replace(DEFAULTS[n], **changes.get(n, {})) for n in names]
    return build_study(list(curves()), table_1(), TOTAL, table)


@pytest.fixture(scope="module")
def result():
    """Specimen-wise k_1 and k_3, trial-wise offset."""
    offset = {"fixed": False}
    return fit(make_study(force_offset=offset), Settings(starts=1))


def predicted(result, prediction):
    """Findings of a fit with these residuals."""
    result = dataclasses.replace(result)
    vars(result)["residuals"] = prediction
    return AnalysisResults(result, ((EFFECTIVE, AnalysisResults(result)),))


def columns(heading):
    body = re.split(r"^## ", PAGE.partition(heading)[2], maxsplit=1, flags=re.M)[0]
    return re.findall(r"^\| `([\w/]+)` \|", body, re.M)


def test_page_names_every_column(result):
    rows = list(lane_rows(result))
    names = list(rows[0])
    head = columns("## summary.csv")
    assert names[: len(head)] == head
    assert names[len(head) : len(head) + 5] == [
        *("k_1 [N/mm]", "k_1 se", "k_1 low95", "k_1 high95", "k_1 verdict")
    ]
    assert list(next(parameter_rows(AnalysisResults(result)))) == columns("## parameters.csv")


def test_page_names_every_dataset(result, tmp_path):
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {"a": 1})
    found = {}
    with h5py.File(tmp_path / "r.h5") as file:
        file.visititems(lambda name, item: found.__setitem__(name, getattr(item, "shape", None)))
        assert json.loads(file.attrs["provenance"]) == {"a": 1}
        assert (file.attrs["schema"], file.attrs["schema_version"]) == ("jaxtrachea-results", 6)
        assert json.loads(file["unknowns"].attrs["units"])["k_3"] == "N/mm^3"
    shapes = {name: shape for name, shape in found.items() if shape is not None}
    assert sorted(shapes) == sorted(columns("## results.h5"))
    assert shapes["unknowns/correlation"] == (2, 4, 4)
    with pytest.raises(FileExistsError):
        write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})


@pytest.mark.long
def test_columns_that_gzip_makes_smaller_are_packed(tmp_path):
    """Displacements in even steps and a sigma that is not there; noise of full precision is not."""
    depth = np.round(np.linspace(0.001, 2, 2000), 3)
    noisy = depth + np.random.default_rng(0).normal(0, 0.01, depth.shape)
    study = build_study([Curve("A", "t", None, 0.0, depth, noisy)], table_1(), TOTAL)
    write_hdf5(tmp_path / "r.h5", AnalysisResults(fit(study, Settings(starts=1))), {})
    with h5py.File(tmp_path / "r.h5") as file:
        data = file["data"]
        packed = {name for name in data if data[name].compression == "gzip"}
        assert {"displacement", "sigma"} <= packed
        assert packed.isdisjoint({"force", "residual"})
        np.testing.assert_array_equal(data["displacement"], depth)
        np.testing.assert_array_equal(data["force"], noisy)


def test_trialwise_unknowns_are_named_by_trial(result):
    labels = [unknown_label(result, 0, i) for i in range(4)]
    assert labels == ["k_1", "k_3", "force_offset[a]", "force_offset[b]"]
    rows = list(parameter_rows(AnalysisResults(result)))
    assert [(r["specimen"], r["trial"]) for r in rows[:4]] == [
        *(("T1", "(all)"), ("T1", "(all)"), ("T1", "a"), ("T1", "b"))
    ]
    assert not any("force_offset" in name for name in next(lane_rows(result)))


def test_failed_lane_keeps_its_row_and_is_called_failed(result):
    status = result.status.copy()
    status[1] = FitStatus.MAX_ITERATIONS
    failed = dataclasses.replace(result, status=status)
    good, bad = lane_rows(failed)
    assert (good["status"], bad["status"]) == ("converged", "max_iterations")
    assert bad["message"] == FitStatus.MAX_ITERATIONS.message
    assert bad["k_1 verdict"] == "failed"
    assert weakest_sentence(failed, 1) == "no estimate"
    text = report_text("T", AnalysisResults(failed), [BAD])
    assert "1 of 2 fits solved, 0 with every unknown determined; 1 curves could not be used" in text
    assert "| T9 | 1 | non_finite | line 3: force is nan | leave it out |" in text
    assert "max iterations" in text


def flat(result, direction, error):
    change = {"weakest_direction": np.array([direction]), "weakest_se": np.array([error])}
    local = result.uncertainty._replace(**change)
    changed = dataclasses.replace(result, uncertainty=local)
    ones = np.ones(result.lanes)
    vars(changed)["effective"] = result.effective._replace(factor=ones, growth=ones)
    return weakest_sentence(changed, 0)


def test_flat_combination_in_words(result):
    assert flat(result, [1.0, 0, 0, 0], 0.067) == "least determined: k_1 alone, known to 6.7 %"
    told = flat(result, [0, 1.0, 0.05, 0], np.inf)
    assert told == "k_3 changes the curves too little to be told"
    several = flat(result, [0.8, -0.6, 0, 0], 0.2)
    assert several == "least determined: k_1 +10 %, k_3 -7.5 % together, known to 20 %"


def test_rows_with_different_keys_make_one_table(tmp_path, result):
    rows = [*lane_rows(result), bad_row(BAD)]
    Table(rows).write_csv(tmp_path / "s.csv")
    with (tmp_path / "s.csv").open(newline="") as stream:
        *_, last = csv.DictReader(stream)
    assert last["status"] == "bad_data"
    assert last["message"] == "non_finite: x.csv: line 3: force is nan; leave it out"
    assert last["k_1 [N/mm]"] == ""


def test_leaving_out_predicts_from_the_other_trial():
    """The trial left out is 2 % stiffer or softer than the one that predicts it; exact data."""
    study = make_study()
    left_out = leave_one_out(fit(study, Settings(starts=1)), Settings(starts=1))
    assert curves_to_leave_out(study) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert np.allclose(left_out.ratio, [1 / 1.02 - 1, 0.02] * 2, atol=1e-6)
    assert np.all(np.isnan(left_out.joints))
    assert left_out_table(left_out).cells[-1][2:] == ["1.98 %", "1.10 %", "–"]


def test_predictions_are_model_minus_data(result):
    seen = predictions(result.study, result.theta)
    for lane in range(2):
        k_1, k_3, *offsets = result.value[lane]
        for t, curve in enumerate(result.study.curves[lane]):
            model = k_1 * curve.displacement + k_3 * curve.displacement**3 + offsets[t]
            # The smooth touch (1 micrometre) shifts the displacement by less than 1e-5 mm here.
            assert np.allclose(seen["force"][lane, t], model - curve.force, atol=1e-4)
    assert "N were measured" in worst(seen, result)
    nothing = seen | {"force": np.full_like(seen["force"], np.nan)}
    assert worst(nothing, result) == "none, no finite prediction"


def test_plots_of_many_lanes_and_of_nothing_finite(result, tmp_path):
    seen = predictions(result.study, result.theta)
    for name, one in (
        ("all", seen),
        ("none", seen | {"force": np.full_like(seen["force"], np.nan)}),
    ):
        (tmp_path / name).mkdir()
        paths, lost = draw_all(tmp_path / name, predicted(result, one))
        assert (len(paths), lost) == (2, {})
        assert all(p.read_bytes()[:4] == b"\x89PNG" for p in paths)


def test_bands_of_residuals_along_the_press():
    """Of normal residuals that grow along the press: quantiles of the normal distribution."""
    draw = np.random.default_rng(3)
    depth = np.tile(np.linspace(0, 6, 200), 5000)
    axis = Figure().subplots()
    _draw_bands(axis, depth, 0.3 + (1 + depth) * draw.normal(size=len(depth)))
    wide, narrow = (band.get_paths()[0].vertices for band in axis.collections)
    at, median = axis.lines[-1].get_data()
    assert len(at) == 60
    for band, quantile in ((wide, 1.95996), (narrow, 0.67449)):
        edges = [np.sort(band[np.isclose(band[:, 0], x), 1])[[0, -1]] for x in at]
        scaled = (np.array(edges) - 0.3) / (1 + at[:, None])
        np.testing.assert_allclose(scaled.mean(axis=0), [-quantile, quantile], atol=0.02)
        np.testing.assert_allclose(scaled, np.tile([-quantile, quantile], (60, 1)), atol=0.2)
    assert np.mean((median - 0.3) / (1 + at)) == pytest.approx(0, abs=0.01)
    # No sample, and one displacement for all: no band, no error.
    for few in (np.zeros(0), np.zeros(30)):
        axis = Figure().subplots()
        _draw_bands(axis, few, few)
        assert not axis.collections
        assert not axis.lines


def test_rms_skips_what_is_not_there():
    values = np.array([[3.0, np.nan, 4.0], [np.nan] * 3])
    assert np.array_equal(rms(values), [np.sqrt(12.5), np.nan], equal_nan=True)


def test_numbers_and_tables_for_people():
    assert [number(v) for v in (1.23456, np.nan, np.inf, 1e6)] == ["1.235", "–", "inf", "1e+06"]
    table = words("", ["a", "b"], [["x|y", "two\nlines"]])
    assert table.markdown() == "| a | b |\n| --- | --- |\n| x\\|y | two lines |"


ROWS = [
    {"name": "=a", "force [N]": 1.23456, "share": 0.025, "n": 3, "ends": (0.5, 2.0)},
    {"name": "b", "force [N]": np.nan, "share": None, "n": 4, "ends": (np.nan, np.nan)},
]
COLUMNS = [
    Column("who", "name"), Column("F", "force [N]", unit="N", digits=3),
    Column("share", unit="%", decimals=1), Column("n", null="none"),
    Column("interval", lambda row: Interval(*row["ends"])),
]  # fmt: skip


def test_one_table_is_rendered_everywhere(tmp_path):
    """Files have every cell exactly, people the columns with unit, digits and null text."""
    table = Table(ROWS, COLUMNS, title="T", more="and 1 more")
    assert table.head == ["who", "F", "share", "n", "interval"]
    assert table.cells == [["=a", "1.23 N", "2.5 %", "3", "0.5 … 2"], ["b", "–", "–", "4", "–"]]
    assert table.paragraphs()[1] == "and 1 more."
    assert "<td>1.23 N</td>" in table._repr_html_()
    assert repr(table).splitlines()[1] == "=a   1.23 N  2.5 %  3  0.5 … 2"
    Table([{k: v for k, v in row.items() if k != "ends"} for row in ROWS]).write_csv(
        tmp_path / "t.csv"
    )
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines == ["name,force [N],share,n", "'=a,1.23456,0.025,3", "b,nan,,4"]
    with h5py.File(tmp_path / "t.h5", "w") as file:
        Table({k: row[k] for k in ("name", "share", "n")} for row in ROWS).write_hdf5(file)
        assert [v.decode() for v in file["name"][()]] == ["=a", "b"]
        np.testing.assert_array_equal(file["share"], [0.025, np.nan])
        assert file["n"].dtype.kind == "i"
    assert len(table.first(1, "and {} more, see x")) == 1
    assert table.first(1, "and {} more, see x").more == "and 1 more, see x"


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (Interval(-np.inf, np.inf), "anything"),
        (Interval(0.0, np.inf, log=True), "anything"),
        (Interval(0.0, 2.0, log=True), "up to 2"),
        (Interval(0.0, 2.0), "0 … 2"),
        (Interval(1.5, np.inf), "from 1.5"),
        (True, "True"), (None, "–"), ("", ""), (7, "7"), (1e-9, "1e-09"),
    ],
)  # fmt: skip
def test_cells_for_people(cell, text):
    assert Column("a").text({"a": cell}) == text


def test_output_folder_is_new_or_empty(tmp_path):
    default = tmp_path / "out" / "fit"
    assert [new_directory(None, default).name for _ in range(3)] == ["fit", "fit-2", "fit-3"]
    assert new_directory(default, default) == default
    (default / "x").touch()
    with pytest.raises(OutputExists, match="not empty"):
        new_directory(default, default)


def test_output_appears_complete_or_not_at_all(tmp_path):
    with new_output(tmp_path / "a" / "b", tmp_path) as staging:
        (staging / "x").write_text("1")
        assert not (tmp_path / "a" / "b" / "x").exists()
    assert [p.name for p in (tmp_path / "a" / "b").iterdir()] == ["x"]

    def fail():
        with new_output(tmp_path / "c" / "d", tmp_path) as staging:
            (staging / "x").write_text("1")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_correlated_residuals_are_found():
    """AR(1) noise of known coefficient, with gaps; and too few samples to say."""
    rng = np.random.default_rng(3)
    truth = np.array([0.0, 0.6, 0.95])
    force = np.zeros((3, 4, 4000))
    step = rng.normal(size=force.shape)
    for i in range(1, force.shape[-1]):
        force[..., i] = truth[:, None] * force[..., i - 1] + step[..., i]
    force[:, :, ::50] = np.nan
    np.testing.assert_allclose(lag_correlation(force), truth, atol=0.03)
    assert np.isnan(lag_correlation(force[:, :1, 1:9])).all()


def test_report_doubts_what_it_should(result):
    seen = predictions(result.study, result.theta)
    shape = seen["force"].shape
    bend = seen | {"force": np.tile(np.linspace(1, 2, shape[-1]), (*shape[:2], 1))}
    noise = seen | {"force": np.tile([1.0, -1.0], (*shape[:2], shape[-1] // 2))}
    text = report_text("T", predicted(result, bend), [])
    assert "misses the curves in 2 of 2 fits" in text
    assert "on its bound" not in text
    held = dataclasses.replace(result, at_bound=np.eye(2, result.at_bound.shape[1], dtype=bool))
    text = report_text("T", predicted(held, noise), [])
    assert "correlated" not in text
    assert "In 2 of 2 fits an unknown ended on its bound" in text
