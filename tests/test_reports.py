"""What people read of a fit: names of any kind, tables and what they leave out, wider errors."""

import csv
import dataclasses
import io
import warnings
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress

from jaxtrachea.cli.scene import _print_misses, _print_rows
from jaxtrachea.cli.terminal import Stages, progress_bar
from jaxtrachea.cli.terminal_table import wide_table
from jaxtrachea.files.html import page
from jaxtrachea.files.pictures import plain, save_each, without_lost
from jaxtrachea.files.table import Table, quoted, unquoted, words
from jaxtrachea.fitting.assessment import assess, unknown_label
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.effective import share_independent
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses import widened
from jaxtrachea.inference.analyses.cross_validation import LEFT_OUT, left_out_table
from jaxtrachea.inference.analyses.influence import (
    INFLUENCE,
    REASONS,
    influence_cell,
)
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.cross_validation import LeftOut
from jaxtrachea.inference.influence import influence
from jaxtrachea.inference.labels import peak_force
from jaxtrachea.inference.rows import worst_first
from jaxtrachea.measurements.read import Curve, read_measurements
from jaxtrachea.mechanics.press import Options
from jaxtrachea.report.fit import report_text
from jaxtrachea.report.overview import overview
from jaxtrachea.report.plots import STYLE, draw_all
from jaxtrachea.results.rows import lane_rows, parameter_rows, summary_rows
from jaxtrachea.status import FitStatus, PressStatus
from jaxtrachea.trachea.geometry import table_1

NAMES = ["$a$", "a_b$", r"$\frac{$", "=1+1", "<script>", "a|b", "two\nlines", "x" * 200, "🫁",
         "_hidden", "[bold]", ":smile:", r"\$x$"]  # fmt: skip
DEPTH = np.linspace(0.1, 2, 12)
BONDED = Options(coupling="total", contact="bonded", onset_width=0.0)
ONE = Settings(starts=1, more_starts=0)


def read_csv(path):
    """Rows of a file that `write_csv` wrote, all cells as text."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = csv.DictReader(stream)
        return [{unquoted(k): unquoted(v) for k, v in row.items()} for row in rows]


def table(**changes):
    """k_1 and k_3 linear, per specimen; onset and offset fixed; unless changed."""
    usual = {"lower": -1e3, "scale": "linear", "scope": "specimen", "value": 1.0}
    rows = [dataclasses.replace(DEFAULTS[n], **usual | changes.get(n, {})) for n in ("k_1", "k_3")]
    rest = [
        dataclasses.replace(DEFAULTS[n], **changes.get(n, {})) for n in ("onset", "force_offset")
    ]
    return [*rows, *rest]


def curve(specimen, trial="a", k=1.0, noise=0.0, seed=0):
    scatter = noise * np.random.default_rng(seed).normal(size=DEPTH.size)
    return Curve(specimen, trial, None, 0.0, DEPTH, k * DEPTH + 0.1 * DEPTH**3 + scatter)


@pytest.fixture(scope="module")
def many():
    """Fourteen lanes, the later the noisier, of names that no program expects; the third failed."""
    names = [*NAMES, "last"]
    study = build_study(
        [curve(n, noise=1e-3 * (i + 1), seed=i) for i, n in enumerate(names)],
        table_1(), BONDED, table(),
    )  # fmt: skip
    result = fit(study, ONE)
    status = result.status.copy()
    status[2] = FitStatus.MAX_ITERATIONS
    return dataclasses.replace(result, status=status)


def shown(items, width=80):
    """What a terminal of this width shows."""
    console = Console(width=width, file=io.StringIO(), force_terminal=False)
    for item in items:
        if isinstance(item, str):
            console.print(item, emoji=False)
            continue
        console.print(wide_table(item), emoji=False)
        console.print(item.more, emoji=False)
    return console.file.getvalue()


def test_formulas_are_quoted_and_read_back(tmp_path):
    """Every start that OWASP names; numbers and harmless text stay; names are read back."""
    texts = ["=1+1", "+1", "-1", "@SUM(A1)", "\tx", "\rx", "＝1", "'=1", "''-1", "'tis", "a=b", ""]
    assert [quoted(t) for t in texts[:6]] == ["'" + t for t in texts[:6]]
    assert [unquoted(quoted(t)) for t in texts] == texts
    assert quoted("a=b") == "a=b"
    assert quoted(-1.5) == -1.5
    rows = [{"specimen": t, "=head": -1.5} for t in texts]
    Table(rows).write_csv(tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(newline="", encoding="utf-8") as stream:
        cells = [row for row in csv.reader(stream)][1:]
    assert all(cell[0][:1] not in tuple("=+-@\t\r＝") or not cell[0] for cell in cells)
    assert all(cell[1] == "-1.5" for cell in cells)
    back = read_csv(tmp_path / "t.csv")
    assert [row["specimen"] for row in back] == texts
    (tmp_path / "d.csv").write_text(
        "specimen,trial,s [mm],displacement [mm],force [N]\n"
        + "".join(f"'=1+1,'-2,30,{d},{d}\n" for d in (0.1, 0.5, 1.0, 1.5))
    )
    read = read_measurements([tmp_path / "d.csv"]).curves[0]
    assert (read.specimen, read.trial) == ("=1+1", "-2")


def test_rows_of_unlike_cells_have_all_columns(tmp_path):
    Table([{}, {"a": 1.5}, {"b": 2.5}, {}]).write_csv(tmp_path / "t.csv")
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines[0] == "a,b"
    cells = list(csv.reader(lines[1:]))
    assert cells == [["", ""], ["1.5", ""], ["", "2.5"], ["", ""]]


def test_summary_quotes_what_specimens_are_called(many, tmp_path):
    Table(lane_rows(many)).write_csv(tmp_path / "s.csv")
    with (tmp_path / "s.csv").open(newline="", encoding="utf-8") as stream:
        names = [row["specimen"] for row in csv.DictReader(stream)]
    assert names[3] == "'=1+1"
    assert [row["specimen"] for row in read_csv(tmp_path / "s.csv")][:13] == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_names_are_plain_text_in_pictures(name):
    """As title, axis label and legend: no mathematics, no line of its own, in the legend."""
    figure = Figure()
    axis = figure.subplots()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="(?s).*Glyph")
        axis.plot([0, 1], [0, 1], label=plain(name))
        axis.set(title=plain(name), xlabel=f"{plain(name)} and {plain(name)} [mm]")
        legend = axis.legend()
        figure.savefig(io.BytesIO())
    assert len(legend.get_texts()) == 1
    for text in (axis.title, axis.xaxis.label):
        drawn, mathematics = text._preprocess_math(text.get_text())
        assert mathematics is False
        assert "\n" not in drawn
    assert len(plain(name)) <= 60
    head = " ".join(name.split())[:20]
    assert axis.title._preprocess_math(axis.title.get_text())[0].strip().startswith(head)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_run_of_such_names_writes_all_its_files(many, tmp_path):
    """Every picture and the page; markup and formulas as text; tables say what they leave out."""
    paths, lost = draw_all(tmp_path, AnalysisResults(many))
    assert lost == {}
    assert all(p.read_bytes()[:4] == b"\x89PNG" for p in paths)
    text = report_text("$x$ | <b>", AnalysisResults(many), [])
    made = page(text, {p.name: p.read_bytes() for p in paths}, {})
    assert "<script>" not in made
    assert "&lt;script&gt;" in made
    for part in (text, made):
        assert part.count("Worst first; and 2 more, see summary.csv") == 2
        assert part.count("Worst first; and 2 more, see parameters.csv") == 1
    quality = text.partition("## Quality")[2]
    first, second = quality.split("| --- |\n", 1)[1].splitlines()[:2]
    assert first.startswith(r"| $\frac{$ a | max iterations")
    assert second.startswith("| last a |")


def test_the_worst_come_first(many):
    order = worst_first(many)
    assert order[0] == 2
    share = [many.rms[k, 0] / peak_force(many, k) for k in order[1:]]
    assert share == sorted(share, reverse=True)


def test_a_picture_that_fails_costs_itself(many, tmp_path, monkeypatch):
    """The others are written, the report says which is missing and why; a full disk is no fault."""

    def broken(*_):
        raise ValueError("no such $ colour")

    monkeypatch.setattr("jaxtrachea.report.plots.draw_residuals", broken)
    paths, lost = draw_all(tmp_path, AnalysisResults(many))
    assert [p.name for p in paths] == ["fit.png", "correlation.png"]
    assert lost == {"residuals.png": "ValueError: no such $ colour"}
    text = without_lost(report_text("T", AnalysisResults(many), []), lost)
    assert "](residuals.png)" not in text
    assert "residuals.png could not be drawn (ValueError: no such $ colour)" in text
    made = page(text, {p.name: p.read_bytes() for p in paths}, {})
    assert "could not be drawn" in made
    with pytest.raises(OSError, match="such"):
        save_each(tmp_path / "nowhere", {"x.png": Figure})


def test_mathematics_of_matplotlib_itself_stays():
    """Powers of ten at logarithmic axes are drawn as such, not as dollars."""
    with mpl.rc_context(STYLE):
        figure = Figure()
        axis = figure.subplots()
        axis.set(xscale="log", xlim=(1, 1e6), title=plain("$a$"))
        figure.savefig(io.BytesIO())
        drawn = [t._preprocess_math(t.get_text()) for t in axis.get_xticklabels()]
    assert any("mathdefault" in text and mathematics for text, mathematics in drawn)


@pytest.mark.parametrize("width", [20, 40, 60, 80, 200])
def test_no_column_is_cut_without_an_ellipsis(width):
    head = ["specimen", "parameter", "value", "95 % interval", "a very long heading", "verdict"]
    rows = [["T1", "k_1 [N/mm]", "1.234", "1.2 … 1.3", "0.5", "structurally not"],
            ["x" * 200, "k_3", "–", "anything", "1", "weak"]]  # fmt: skip
    text = shown([words("All", head, rows)], width)
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    found = text.replace("\n", " ").split()
    for name in head[2:]:
        cut = [w for w in name.split() if w not in found]
        assert all(any(v.endswith("…") and w.startswith(v[:-1]) for v in found) for w in cut)
    assert any(w.startswith("xxx") and w.endswith("…") for w in found)
    if width >= 40:
        for cell in ("1.234", "structurally", "weak", "anything"):
            assert cell in found


def test_terminal_takes_names_as_they_are(many):
    text = shown(overview(AnalysisResults(many)), 120)
    for name in ("[bold]", ":smile:", "<script>", "=1+1"):
        assert name in text.split()
    assert "Worst first; and 2 more, see summary.csv" in " ".join(text.split())
    assert "13 of 14 fits solved, 12 with every unknown determined" in text


@pytest.fixture(scope="module")
def dense():
    """One lane of three specimens: shared k_1, own k_3, own offset of every curve."""
    curves = [curve(n, t, noise=0.01, seed=i) for i, (n, t) in
              enumerate((("A", "1"), ("A", "2"), ("B", "1"), ("C", "1")))]  # fmt: skip
    changes = {"k_1": {"scope": "shared"}, "force_offset": {"fixed": False, "scope": "trial"}}
    return fit(build_study(curves, table_1(), BONDED, table(**changes)), ONE)


@pytest.mark.slow
@pytest.mark.compiling
def test_one_lane_of_several_specimens_has_a_row_for_each(dense):
    """All columns of a specimen's own unknowns; what it has several of is named, not dropped."""
    assert dense.lanes == 1
    seen = predictions(dense.study, dense.theta)
    rows = list(summary_rows(widened(dense)))
    assert [(r["specimen"], r["trial"]) for r in rows] == [("A", "(all)"), ("B", "1"), ("C", "1")]
    labels = [unknown_label(dense, 0, i) for i in range(8)]
    for row in rows:
        k = labels.index(f"k_3[{row['specimen']}]")
        assert row["k_3 [N/mm^3]"] == dense.value[0, k]
        assert row["k_3 verdict"] == assess(dense, 0, k).verdict
        assert row["k_1 [N/mm]"] == dense.value[0, 0]
        assert row["k_1 low95"] == assess(dense, 0, 0).low <= dense.lower[0, 0]
    assert rows[0]["more"] == "force_offset[A/1], force_offset[A/2]: see parameters.csv"
    assert "more" not in rows[1]
    assert "force_offset [N]" in rows[1]
    assert [r["samples"] for r in rows] == [24, 12, 12]
    own = [np.sqrt(np.mean(np.square(seen["force"][0, t]))) for t in ([0, 1], [2], [3])]
    np.testing.assert_allclose([r["rms_force_N"] for r in rows], own, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.compiling
def test_influence_says_why_there_is_no_number(dense):
    """An unknown of one curve is its own; a lane without an estimate has none; bounds hold."""
    diagnosed = influence(dense)
    study = dense.study
    assert influence_cell(diagnosed, 0, 0, 2).endswith(", own")
    text = "\n".join(INFLUENCE.report(diagnosed, [0]))
    assert REASONS in text
    status = np.array([FitStatus.MAX_ITERATIONS])
    failed = dataclasses.replace(diagnosed, result=dataclasses.replace(dense, status=status))
    assert influence_cell(failed, 0, 0, 0) == "no estimate"
    bound = np.zeros((1, study.size), bool)
    bound[0, 0] = True
    held = dataclasses.replace(diagnosed, result=dataclasses.replace(dense, at_bound=bound))
    assert influence_cell(held, 0, 0, 0) == "held"
    shown_text = shown(overview(AnalysisResults(dense, ((INFLUENCE, diagnosed),))))
    assert "Influence of curves" in shown_text


def ends_of(result):
    """Lower and upper ends of all intervals; (lanes, P) each."""
    found = [[assess(result, k, i) for i in range(result.study.size)]
             for k in range(result.lanes)]  # fmt: skip
    return (
        np.array([[getattr(j, name) for j in row] for row in found]) for name in ("low", "high")
    )


def autoregressive(shape, r, seed):
    """AR(1) noise of unit variance."""
    noise = np.random.default_rng(seed).normal(size=shape)
    noise[..., 1:] *= np.sqrt(1 - r * r)
    for i in range(1, shape[-1]):
        noise[..., i] += r * noise[..., i - 1]
    return noise


@pytest.mark.slow
@pytest.mark.compiling
def test_widened_intervals_cover():
    """1,000 linear lanes of two curves of 100 samples, AR(1) noise of 0.8: 90 to 98 %, not < 75."""
    given = False
    depth, count, r = np.linspace(0.1, 2, 100), 1000, 0.8
    noise = 0.05 * autoregressive((count, 2, 100), r, 5)
    curves = [
        Curve(f"s{k}", t, None, 0.0, depth, 1.3 * depth + 0.4 * depth**3 + noise[k, i])
        for k in range(count)
        for i, t in enumerate("ab")
    ]
    level = Noise(force=0.05 if given else None)
    result = fit(build_study(curves, table_1(), BONDED, table(), noise=level), ONE)
    wide = result.effective
    low, high = ends_of(result)
    truth = np.array([1.3, 0.4])

    def inside(low, high):
        return np.mean((low <= truth) & (truth <= high), axis=0)

    plain_share = inside(result.lower, result.upper)
    share = inside(low, high)
    assert np.all(plain_share < 0.75), plain_share
    assert np.all((share > 0.90) & (share < 0.98)), share
    # Residuals of a fit are a little less correlated than the noise.
    assert abs(np.mean(wide.correlation) - r) < 0.06
    closed = 200 * (1 - wide.correlation) / (1 + wide.correlation)
    np.testing.assert_allclose(wide.samples, closed, rtol=1e-12)


def test_independent_residuals_widen_nothing():
    found = share_independent(np.array([-0.5, 0.0, 0.5, 1.0]), np.full(4, 40))
    assert found.tolist() == [1, 1, 1 / 3, 0]
    # Of 15 pairs a correlation of 0.4 comes by chance (1 / sqrt(15) = 0.26), of 40 it does not.
    assert share_independent(np.full(2, 0.4), np.array([15, 40])).tolist() == [1, 0.6 / 1.4]


def test_alike_residuals_far_below_the_noise_given_hardly_count():
    """Variance: of the noise the part that is seen is alike, the rest independent."""
    depth = np.linspace(0.1, 2, 100)
    noise = 0.05 * autoregressive((2, 100), 0.8, 5) * np.array([[0.1], [1.0]])
    curves = [Curve(f"s{k}", "a", None, 0.0, depth, 1.3 * depth + noise[k]) for k in range(2)]
    result = fit(build_study(curves, table_1(), BONDED, table(), noise=Noise(force=0.05)), ONE)
    part = np.nansum(result.residuals["force"] ** 2, axis=(1, 2)) / 98 / 0.05**2
    expected = np.sqrt(1 + np.minimum(part, 1) * (100 / result.effective.samples - 1))
    np.testing.assert_allclose(result.effective.growth, expected, rtol=1e-9)
    assert result.effective.growth[0] < 1.1
    assert result.effective.growth[1] > 2


@pytest.mark.slow
@pytest.mark.compiling
def test_fewer_independent_samples_than_unknowns_leave_no_limit():
    """A law through a curve of another shape: residuals of one sign, one after the other."""
    depth = np.linspace(0, 1, 40)
    bent = Curve("T", "a", None, 0.0, depth, depth - 0.2 * np.sin(3 * depth))
    result = fit(build_study([bent], table_1(), BONDED, table()), ONE)
    wide = result.effective
    assert wide.samples[0] < 2
    assert wide.misses[0]
    # No limit but the bounds.
    low, high = ends_of(result)
    assert low[0].tolist() == [p.lower for p in result.study.free]
    assert high[0].tolist() == [p.upper for p in result.study.free]
    words = {assess(result, 0, i).verdict for i in range(2)}
    assert words == {"inconclusive: the model misses the curve"}
    rows = list(parameter_rows(widened(result)))
    assert np.isnan([[row["se"], row["relative_se"]] for row in rows]).all()
    assert [row["low95_independent"] for row in rows] == result.lower[0].tolist()
    text = report_text("T", widened(result), [])
    said = " ".join(shown(overview(widened(result))).split())
    # The law is above the curve at first, and again at the end.
    place = "Most missed: T a from"
    for where in (text, said):
        assert "The model misses the curves in 1 of 1 fits" in where
        assert place in where
    assert "1 of 1 fits solved, 0 with every unknown determined" in text
    assert next(summary_rows(widened(result)))["determined"] == 0


@pytest.mark.slow
@pytest.mark.compiling
def test_of_many_curves_left_out_report_and_terminal_show_the_worst_first(dense):
    """The report had them in the order of the file, the terminal the worst first."""
    lane, trial = np.zeros(14, int), np.arange(14) % 4
    force = 0.01 * np.array([3.0, 1, 14, 2, 4, np.nan, 5, 13, 6, 7, 8, 9, 10, 12])
    left_out = LeftOut(
        lane,
        trial,
        force,
        np.full(14, np.nan),
        force,
        dense.study,
        dense,
        residual=np.full((14, DEPTH.size), np.nan),
        converged=np.ones(14, bool),
    )
    table = left_out_table(left_out)
    rows, further = table.cells, table.more
    shares = ["–", *(f"{v}.00 %" for v in (14, 13, 12, 10, 9, 8, 7, 6, 5, 4, 3))]
    assert [row[3] for row in rows[:-1]] == shares
    assert further == "Worst first; and 2 more, see left_out.csv"
    findings = AnalysisResults(dense, ((LEFT_OUT, left_out),))
    text = report_text("T", findings, [])
    section = text.split("## Leaving one curve out")[1].split("##")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")][2:14]
    assert [line.split(" | ")[3] for line in lines] == shares
    assert f"{further}." in section
    items = list(overview(findings))
    assert (rows, further) in [(v.cells, v.more) for v in items if not isinstance(v, str)]
    few = LeftOut(
        lane[:4], trial[:4], force[:4], np.full(4, np.nan), force[:4], dense.study, dense,
        residual=np.zeros((4, 1)), converged=np.ones(4, bool),
    )  # fmt: skip
    assert [row[1] for row in left_out_table(few).cells[:-1]] == ["1", "2", "1", "1"]


def test_counts_of_the_progress_bar_never_pass_the_total():
    """They ended in 60/32, where lanes were fitted again, and in 0/?, where none was counted."""
    stream = io.StringIO()
    bar = Progress(*progress_bar().columns, console=Console(file=stream, width=100), disable=True)
    stages = Stages(bar, [].copy)
    counted = stages.begin("fitting")
    cells = []
    for done, of in ((16, 32), (16, 32), (0, 32), (0, 0), (8, 10), (20, 10)):
        counted(done, of)
        cells.append(bar.columns[2].render(bar.tasks[0]).plain)
    assert cells == ["16/32", "32/32", "32/32", "32/32", "40/42", "60/60"]
    counted = stages.begin("profiling")
    cells = []
    for done in (0, 7, 5):
        counted(done, 0)
        cells.append(bar.columns[2].render(bar.tasks[1]).plain)
    assert cells == ["", "7", "12"]
    stages.begin("drawing")(0, 0)
    stages.close()
    assert [bar.columns[2].render(t).plain for t in bar.tasks] == ["60/60", "12/12", ""]
    assert all(task.finished for task in bar.tasks)


def test_rows_of_a_simulation_on_the_terminal(capsys, monkeypatch):
    """Each row has one line in each part; of many the title says how many are left out."""
    monkeypatch.setenv("COLUMNS", "80")
    for count, title in ((14, "14 rows"), (55, "40 of 55 rows; all are in simulation.h5")):
        ones = np.ones((count, 3))
        _print_rows(
            SimpleNamespace(
                s=np.full(count, 80.0), phi=np.full(count, -1e-17), gap=np.full(count, -0.265),
                force=ones * [0.0741, -0.191, 0], skeleton=ones * [1.14, -2.37, 0],
                depth_share=np.full(count, 0.24), status=np.zeros(count, int),
            ),
            (),
        )  # fmt: skip
        lines = [line.split() for line in capsys.readouterr().out.split("\n")]
        assert " ".join(lines[0]) == title
        body = [line for line in lines if line and not any(v.startswith("rows") for v in line)]
        numbered = [line[0] for line in body if line[0].isdecimal()]
        shown = [str(i + 1) for i in range(count)] if count == 14 else None
        assert len(numbered) == 2 * min(count, 40)
        assert shown is None or numbered == 2 * shown
        assert ["1", "80", "0", "-0.265", "0.0741", "-0.191", "0", "ok", "24", "%"] in lines
        assert ["1", "1.14", "-2.37", "0"] in lines


def test_a_tool_that_is_nowhere_near_is_told(capsys):
    clear, touching = PressStatus.NO_CONTACT, PressStatus.OK
    for status, gap, said in (
        (
            [clear, clear],
            np.array([237.2, 234.0]),
            "no row touches the wall: the tool stays 234 mm",
        ),
        ([clear, touching], np.array([1.0, -0.2]), ""),
        ([clear, clear], None, ""),
    ):
        _print_misses(SimpleNamespace(status=np.array(status), gap=gap))
        assert capsys.readouterr().out.startswith(said)
