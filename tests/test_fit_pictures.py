"""Pictures of a fit: what they show is right, and nothing overlaps.

Truth: the hat matrix of linear least squares in closed form, `influence` by automatic
differentiation, and the boxes of the texts as matplotlib draws them.
"""

import dataclasses
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

import jaxtrachea
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.fitted_errors import fitted_errors
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.cross_validation import LEFT_OUT, draw_left_out
from jaxtrachea.inference.analyses.profile import draw_profiles
from jaxtrachea.inference.cross_validation import leave_one_out
from jaxtrachea.inference.influence import influence
from jaxtrachea.inference.profile import profiles
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.report.captions import captions
from jaxtrachea.report.fit_pictures import draw_force, draw_joints, scale_of
from jaxtrachea.report.plots import STYLE, _draw_bands, _scale, draw_residuals, draw_waterfall
from jaxtrachea.report.shown import Shown
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

SIGMA = 2e-3
DEPTH = np.linspace(0.1, 2, 12)
BONDED = Options(coupling="total", contact="bonded", onset_width=0.0)
ONE = Settings(starts=1, more_starts=0)


def table():
    """k_1 and k_3 linear, one of each specimen; onset and offset fixed."""
    free = {"lower": -1e3, "scale": "linear", "scope": "specimen", "value": 1.0}
    rows = [dataclasses.replace(DEFAULTS[n], **free) for n in ("k_1", "k_3")]
    return [*rows, DEFAULTS["onset"], DEFAULTS["force_offset"]]


def curve(specimen, trial, k, seed):
    scatter = SIGMA * np.random.default_rng(seed).normal(size=DEPTH.size)
    return Curve(specimen, trial, None, 0.0, DEPTH, k * DEPTH + 0.1 * DEPTH**3 + scatter)


def overlaps(figure):
    """Pairs of texts that lie on each other, as drawn."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    hidden = set()
    for axis in (part for a in figure.axes for part in (a.xaxis, a.yaxis)):
        low, high = sorted(axis.get_view_interval())
        for tick in axis.get_major_ticks():
            if not low <= tick.get_loc() <= high:
                hidden |= {tick.label1, tick.label2}
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t not in hidden]
    boxes = [(t.get_text(), t.get_window_extent(renderer)) for t in texts if t.get_text().strip()]
    return [
        (a, b)
        for i, (a, first) in enumerate(boxes)
        for b, other in boxes[i + 1 :]
        if first.overlaps(other)
    ]


@pytest.fixture(scope="module")
def one():
    """A specimen pressed at three places, one twice; two curves have a sigma of 3 SIGMA."""
    k = {"s020": 1.0, "s060": 1.2, "s060 again": 1.2, "s100": 0.9}
    curves = []
    for i, (name, stiffness) in enumerate(k.items()):
        made = curve("T", name, stiffness, i)
        share = np.full(DEPTH.size, SIGMA * (3 if i % 2 else 1))
        curves.append(dataclasses.replace(made, s_c=float(name[1:4]), sigma=share))
    return fit(build_study(curves, table_1(), BONDED, table()), ONE)


@pytest.fixture(scope="module")
def many():
    """Fourteen specimens pressed at two places; one is ten times as stiff, one has an outlier."""
    curves = []
    for i in range(14):
        for s in (25.0, 75.0):
            made = curve(f"T{i}", f"s{s:g}", 10.0 if i == 9 else 1 + 0.1 * i, i)
            force = made.force + (0.4 * (np.arange(DEPTH.size) == 5) if (i, s) == (2, 25) else 0)
            curves.append(dataclasses.replace(made, s_c=s, force=force))
    return fit(build_study(curves, table_1(), BONDED, table()), ONE)


def test_errors_of_a_linear_fit_are_those_of_its_hat_matrix(one):
    """Standard error sigma sqrt(h), studentised residual r / (sigma sqrt(1 - h)), weights 1/s^2."""
    curves = one.study.curves[0]
    X = np.concatenate([np.stack([c.displacement, c.displacement**3], 1) for c in curves])
    y, s = (np.concatenate([getattr(c, n) for c in curves]) for n in ("force", "sigma"))
    W = X / s[:, None]
    H = W @ np.linalg.solve(W.T @ W, W.T)
    h, r = np.diag(H), X @ np.linalg.solve(W.T @ W, W.T @ (y / s)) - y
    found = fitted_errors(one, np.array([0]))
    np.testing.assert_allclose(found.fitted["force"][0].ravel(), s * np.sqrt(h), rtol=1e-6)
    student = found.studentised["force"][0].ravel()
    np.testing.assert_allclose(student, r / (s * np.sqrt(1 - h)), rtol=1e-6, atol=1e-6)


def test_errors_are_those_of_influence_by_other_derivatives(many):
    """Of lanes in any order, with sigma estimated."""
    lanes = np.array([9, 2, 2])
    found = fitted_errors(many, lanes)
    of = influence(many).of
    np.testing.assert_allclose(found.studentised["force"], of.studentised[lanes], atol=1e-6)
    share = (found.fitted["force"] / many.sigma[lanes, :1, None]) ** 2
    np.testing.assert_allclose(share, of.leverage[lanes], atol=1e-8)


def test_errors_with_markers_and_scaled_unknowns(dense_result):
    """Of a skeleton, unknowns on a logarithmic scale, some of single trials."""
    found, n = fitted_errors(dense_result, np.array([0])), dense_result.study.lanes.force.shape[-1]
    of = influence(dense_result).of
    np.testing.assert_allclose(found.studentised["force"], of.studentised[..., :n], atol=1e-5)


@pytest.fixture(scope="module")
def dense_result():
    """Presses at three places with markers, one ring under the tool, onset of every trial."""
    depth, rings = np.linspace(0, 1, 9), np.arange(15)
    curves, at = [], np.asarray(table_1().ring_positions)
    for i, s in enumerate((35.0, 75.0, 125.0)):
        force = 0.7 * depth + 0.002 * np.random.default_rng(i).normal(size=9)
        shape = 0.6 * np.exp(-(((at - s) / 18) ** 2))
        curves.append(
            Curve("T", f"s{s:g}", s, 0.0, depth, force, joint_rings=rings,
                  joint_displacement=depth[:, None] * shape)
        )  # fmt: skip
    study = build_study(
        curves, table_1(), dataclasses.replace(BONDED, coupling="series", onset_width=1e-3),
        {"k_3": {"fixed": True, "value": 0.0}}, noise=Noise(force=0.002, joints=0.02),
        tool_radius=6.0,
    )  # fmt: skip
    return fit(study, ONE)


def test_panels_are_positions_of_few_fits_and_fits_of_many(one, many):
    assert [p.title for p in Shown(one).panels] == ["s = 20 mm", "s = 60 mm", "s = 100 mm"]
    assert [len(p.trials) for p in Shown(one).panels] == [1, 2, 1]
    shown = Shown(many)
    assert len(shown.panels) == 12
    assert shown.panels[0].title in ("T2", "T9")
    assert shown.title.startswith("12 of 14 fits")
    colours = {shown.colour(s) for s in shown.places}
    assert len(colours) == 2


@pytest.mark.parametrize("name", ["one", "many", "dense_result"])
def test_nothing_overlaps_and_every_axis_has_a_unit(name, request):
    result = request.getfixturevalue(name)
    drawings = [draw_force, draw_residuals]
    drawings += [draw_joints] if "joints" in captions(result) else []
    for draw in drawings:
        with mpl.rc_context(STYLE):
            figure = draw(Shown(result))
            assert not overlaps(figure), draw.__name__
        words = {a.get_ylabel() for a in figure.axes} | {a.get_xlabel() for a in figure.axes}
        assert words - {""}, draw.__name__
        assert all("[" in word for word in words - {"", "samples"}), words
        legend = {t.get_text() for t in figure.legends[0].get_texts()}
        assert legend >= ({"measured", "fit", "95 % of the noise"} if draw is not draw_residuals
                          else {"s = 25 mm"} if name == "many" else set())  # fmt: skip


def test_markers_under_the_tool_are_hollow(dense_result):
    """Two rings lie within 6 mm of s = 35 and 75 mm: they are drawn and take no part."""
    with mpl.rc_context(STYLE):
        figure = draw_joints(Shown(dense_result))
    hollow = [
        line for axis in figure.axes for line in axis.lines
        if line.get_markerfacecolor() == "none"
    ]  # fmt: skip
    used = np.isfinite(dense_result.residuals["joints"][0, :, -1]).sum()
    assert used < 45
    assert sum(np.isfinite(line.get_ydata()).sum() for line in hollow) == 45 - used
    assert "not used" in {t.get_text() for t in figure.legends[0].get_texts()}


def test_an_outlier_does_not_set_the_scale(many):
    values = np.append(np.random.default_rng(0).normal(size=999), 1e3)
    assert 3 < scale_of(values) < 4
    assert 4 < _scale(values) < 7
    assert _scale(np.array([-1.0, 1.0])) == 1.05
    with mpl.rc_context(STYLE):
        figure = draw_force(Shown(many))
    assert "beyond the scale" in {t.get_text() for t in figure.legends[0].get_texts()}
    limits = {a.get_ylim() for a in figure.axes[1::2]}
    assert len(limits) == 1
    assert max(limits)[1] < 10


def test_bands_have_no_gaps_where_samples_are_few():
    """Nine tenths of the samples lie in a tenth of the way; some intervals would hold none."""
    rng = np.random.default_rng(0)
    depth = np.concatenate([rng.uniform(0, 0.1, 900), rng.uniform(0.1, 1, 100), [0.05] * 50])
    axis = Figure().subplots()
    signs = _draw_bands(axis, depth, depth + 0.01 * rng.normal(size=depth.size))
    assert [s.get_label() for s in signs] == ["95 % of samples", "50 %", "median"]
    median = signs[-1].get_data()
    assert np.isfinite(median).all()
    assert median[0][0] < 0.02
    assert median[0][-1] > 0.85
    np.testing.assert_allclose(median[1], median[0], atol=0.08)
    assert _draw_bands(axis, np.ones(5), np.ones(5)) == []


def test_a_whole_record_is_drawn_along_its_time(one):
    """Trials of one place are told apart by line and marker, and named."""
    study = one.study
    curves = tuple(
        dataclasses.replace(c, time=np.linspace(3, 5, DEPTH.size), rise=(0, 6))
        for c in study.curves[0]
    )
    result = dataclasses.replace(one, study=dataclasses.replace(study, curves=(curves,)))
    with mpl.rc_context(STYLE):
        figure = draw_force(Shown(result))
        assert not overlaps(figure)
    assert {a.get_xlabel() for a in figure.axes} - {""} == {"time [s]"}
    named = [t.get_text() for t in figure.axes[0].findobj(Legend)[0].get_texts()]
    assert named == ["s060", "s060 again"]


def test_captions_follow_what_was_observed(one, many, dense_result):
    assert list(captions(many)) == ["fit", "residuals", "correlation"]
    assert list(captions(one)) == ["fit", "correlation"]
    assert list(captions(dense_result)) == ["fit", "joints", "correlation"]
    seen = one.residuals | {"side_force": one.residuals["force"]}
    both = dataclasses.replace(one, stored_residuals=seen)
    assert list(captions(both)) == ["fit", "side_force", "correlation"]


def test_a_waterfall_shows_starts_that_ended_elsewhere(one):
    """A problem with one minimum has no such picture; starts of equal cost lie below the line."""
    np.testing.assert_allclose(one.start_costs[0, 0], one.cost[0], rtol=1e-9)
    assert np.isnan(one.start_costs[0, 1:]).all()
    costs = np.full((1, 24), np.nan)
    costs[0, :4] = 2.0 * np.array([1.0, 1.0, 1.5, 11.0])
    other = dataclasses.replace(
        one, start_costs=costs, tried=np.array([4]), converged_starts=np.array([2])
    )
    assert list(captions(other)) == ["fit", "waterfall", "correlation"]
    with mpl.rc_context(STYLE):
        figure = draw_waterfall(other)
        assert not overlaps(figure)
    (axis,) = figure.axes
    drawn, line = (np.asarray(v.get_ydata(), float) for v in axis.lines)
    assert (drawn[:2] < line[0]).all()
    np.testing.assert_allclose(drawn[2:], [0.5, 10.0])


def test_the_stages_of_a_fit_are_logged(one, caplog):
    caplog.set_level("INFO", "jaxtrachea")
    fit(one.study, ONE)
    assert caplog.messages[0] == "1 fits of 2 unknowns, 1 starts each"


def test_a_notebook_shows_a_fit_as_table_and_picture(one):
    """What `%load_ext jaxtrachea` tells IPython."""
    shown: dict = {}
    formatter = SimpleNamespace(for_type=shown.__setitem__)
    shell = SimpleNamespace(display_formatter=SimpleNamespace(formatters={"text/html": formatter}))
    jaxtrachea.load_ipython_extension(shell)
    assert set(shown) == {jaxtrachea.FitResult, jaxtrachea.Scene, jaxtrachea.Simulation}
    text = shown[jaxtrachea.FitResult](one)
    assert "<td>k_1</td>" in text
    assert text.count('<img src="data:image/png;base64,') == 1


def test_curves_left_out_are_drawn_as_they_are_predicted(one):
    """Prediction: least squares, weighed by 1/sigma^2, of the other three curves."""
    found, curves = leave_one_out(one, ONE), one.study.curves[0]
    X = np.stack([DEPTH, DEPTH**3], 1)
    for k, t in enumerate(found.trial):
        rest = [c for i, c in enumerate(curves) if i != t]
        W = np.concatenate([X / c.sigma[:, None] for c in rest])
        b = np.linalg.lstsq(W, np.concatenate([c.force / c.sigma for c in rest]), rcond=None)[0]
        np.testing.assert_allclose(found.residual[k], X @ b - curves[t].force, atol=1e-8)
    with mpl.rc_context(STYLE):
        figure = draw_left_out(found)
        assert not overlaps(figure)
    drawn = figure.axes[0].lines[:4]
    assert {line.get_xdata().size for line in drawn} == {12}
    assert figure.axes[1].get_xlabel() == "s [mm]"
    assert "![curves left out: measured and predicted](left_out.png)" in LEFT_OUT.section(found)
    assert list(LEFT_OUT.figures(found)) == ["left_out.png"]


def test_one_profile_is_named_with_its_interval(one):
    """k_1: estimate and interval as the table has them, threshold and estimate drawn."""
    found = profiles(one, ONE, ("k_1",), points=4)
    with mpl.rc_context(STYLE):
        figure = draw_profiles(found)
        assert not overlaps(figure)
    (axis,) = [a for a in figure.axes if a.get_visible()]
    low, high = float(found.lower[0]), float(found.upper[0])
    assert axis.get_title() == f"k_1: {one.value[0, 0]:.4g} ({low:.4g} … {high:.4g})"
    words = {t.get_text() for t in axis.get_legend().get_texts()}
    assert words == {"estimate", "95 % interval", "local error"}
