"""Errors of rungs by hand, and plans chosen by tolerance against the full model."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import h5py
import jax
import numpy as np
import pytest
from matplotlib.text import Text
from run_cli import run
from tradeoff_front import pareto
from tradeoff_page import choice_row, choice_rows, fronts
from tradeoff_plots import QUESTIONS, draw
from tradeoff_scene import DEPTH, K_1, K_3, SCENE, TOML

from jaxtrachea.scene.build import stage
from jaxtrachea.scene.declare import PlanError
from jaxtrachea.scene.effects import EFFECTS
from jaxtrachea.scene.ranges import outside_plan
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.tradeoff import choice as choosing
from jaxtrachea.tradeoff import measure as measuring
from jaxtrachea.tradeoff.choice import choose
from jaxtrachea.tradeoff.cost import Cost
from jaxtrachea.tradeoff.errors import Errors, relative, remesh, spread
from jaxtrachea.tradeoff.ladders import Ladder, ladders
from jaxtrachea.tradeoff.levels import full_scene, kept_rings, program
from jaxtrachea.tradeoff.load import Load
from jaxtrachea.tradeoff.trial import Trial

pytestmark = pytest.mark.long


def staged(scene=SCENE, **material):
    spec = SceneSpec.model_validate(scene | {"material": scene["material"] | material})
    return spec, stage(spec, Path())


def test_errors_are_those_of_the_longest_vector():
    expected = np.array([[3.0, 4, 0], [0, 0, 1]])
    assert relative(expected + [0, 0, 0.5], expected) == pytest.approx(0.1)
    lost = expected.copy()
    lost[1] = np.nan
    assert relative(lost, expected) == np.inf
    assert relative(lost, lost) == 0
    assert relative(0 * expected, 0 * expected) == 0


def test_a_ring_left_out_lies_between_its_neighbours():
    found = spread(np.array([[[2.0, 8, 0]]]), np.array([20.0]), np.array([10.0, 20, 70]), 120.0)
    np.testing.assert_allclose(found, [[[1, 4, 0], [2, 8, 0], [1, 4, 0]]])


def test_a_coarse_mesh_is_interpolated_where_the_fine_one_has_vertices():
    from jaxtrachea import table_1
    from jaxtrachea.trachea.tube import make_tube

    coarse, fine = (make_tube(table_1(), around=n, along=2 * n) for n in (8, 16))

    def field(mesh):
        return np.stack([mesh.s, 2 * mesh.s + 1, 0 * mesh.s], 1)[None]

    found = remesh(np.asarray(field(coarse)), coarse, fine)
    np.testing.assert_allclose(found, field(fine), atol=1e-12)

    # Linear in the turn from 0 to 315 deg, and from there back to its value at 360 = 0 deg.
    def turn(mesh):
        return np.asarray(mesh.phi) % (2 * np.pi)

    def around(mesh):
        return np.stack([turn(mesh)] * 3, 1)[None]

    found = remesh(around(coarse), coarse, fine)[0, :, 0]
    last = 7 / 8 * 2 * np.pi
    expected = np.where(turn(fine) <= last + 1e-9, turn(fine), last / 2)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_pareto_front_by_hand():
    x, y = np.array([1.0, 2, 3, 1, np.nan]), np.array([5.0, 6, 1, 4, 0])
    assert pareto(x, y).tolist() == [3, 2]


def rung(ladder, kind, level, error, seconds, finest=False):
    time = {"median": seconds, "p99": 3 * seconds}
    errors = {"force": error, "joints": None, "surface": error / 2, "gradient": 2 * error}
    names = {"ladder": ladder, "kind": kind, "level": level, "finest": finest}
    return names | {"errors": errors, "times": {"call": time, "gradient": time}}


def test_every_level_has_its_row_and_lies_within_its_panels():
    """Errors of 0 and infinity are words; the finest level is what the others are drawn against."""
    points = [rung("a", "model", "late", np.inf, 5e-4), rung("a", "model", "full", 0.0, 2e-3, True),
              rung("b", "algebra", "same", 0.0, 2e-6), rung("b", "algebra", "near", 1e-3, 0.05),
              rung("b", "algebra", "best", 0.0, 1e-2, True)]  # fmt: skip
    figure = draw(points, "scene")
    figure.draw_without_rendering()
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["b: same", "b: near", "a: late"]
    assert len(figure.axes) == 4
    for axis in figure.axes:
        (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
        box = axis.get_tightbbox()
        assert box is not None
        assert min(box.x0, box.y0) >= 0
        dots = [line for line in axis.lines if line.get_marker() == "o"]
        for line in dots:
            assert left < line.get_xdata()[0] < right
            assert low > line.get_ydata()[0] > high
    errors, times = ([line.get_xdata()[0] for line in axis.lines if line.get_marker() == "o"]
                     for axis in figure.axes[:2])  # fmt: skip
    assert errors == [1e-3]
    assert [text.get_text() for text in figure.axes[0].texts] == ["exact", "infinite"]
    assert times == [2e-6, 0.05, 5e-4]
    finest = [line.get_xdata()[0] for line in figure.axes[1].lines if line.get_marker() == "|"]
    assert finest == [1e-2, 1e-2, 2e-3]


def test_a_worthless_level_does_not_squeeze_the_others():
    points = [rung("a", "model", "wild", 2e6, 5e-4), rung("a", "model", "poor", 10.0, 5e-4),
              rung("a", "model", "full", 0.0, 2e-3, True)]  # fmt: skip
    axis = draw(points, "scene").axes[0]
    assert [text.get_text() for text in axis.texts] == ["2e+06"]
    (dot,) = (line for line in axis.lines if line.get_marker() == "o")
    left, right = axis.get_xlim()
    assert 10.0 == dot.get_xdata()[0] < axis.texts[0].get_position()[0] < right
    assert right / left < 1e8


def test_no_text_of_a_picture_lies_on_another():
    points = [rung("b", "algebra", f"level {i}", 10.0**-i, 1e-5 * (i + 1)) for i in range(30)]
    figure = draw([*points, rung("b", "algebra", "best", 0.0, 1e-2, True)], "scene")
    figure.draw_without_rendering()
    axis = figure.axes[0]
    titles = [t for a in figure.axes for t in a.findobj(Text) if t.get_text() in QUESTIONS]
    boxes = [t.get_window_extent() for t in (*axis.get_yticklabels(), *titles)]
    assert len(boxes) == 34
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[i + 1 :])


def test_span_of_a_front_is_that_of_whole_plans():
    """Three plans by hand, one beaten; a quicker finest level of another ladder does not count."""

    def row(ladder, error, call):
        errors = {"force": error, "joints": None, "surface": None}
        return {"ladder": ladder, "errors": errors, "times": {"call": {"median": call}}}

    plans = [row("together", *v) for v in ((0, 6e-4), (0.05, 4e-4), (0.08, 5e-4), (0.8, 1e-4))]
    others = [row("form", 0.0, 5e-5), {"ladder": "mesh", "left_out": "-"}]
    assert fronts({"a": plans + others, "b": others}) == [
        ["a", "1.5", "-", "6", "-", "80 %"], ["b", "-", "-", "-", "-", "-"],
    ]  # fmt: skip


def test_no_plan_is_left_out_of_the_plans_compared():
    rungs = {str(i): {} for i in range(7)}
    assert measuring.picked(Ladder("together", "together", rungs, {}), 3) == list(rungs)
    assert measuring.picked(Ladder("mesh", "truncation", rungs, {}), 3) == ["0", "3", "6"]


def test_what_the_finest_level_beats_is_not_on_the_front():
    """Error and time of `worse` are both more than those of the finest; `quick` is quicker."""
    points = [rung("b", "algebra", "worse", 0.1, 2e-4), rung("b", "algebra", "quick", 0.2, 5e-5),
              rung("b", "algebra", "best", 0.0, 1e-4, True)]  # fmt: skip
    for axis in draw(points, "scene").axes:
        dots = [line for line in axis.lines if line.get_marker() == "o"]
        assert [line.get_markeredgecolor() == "k" for line in dots] == [False, True]


def test_a_scene_without_choices_has_a_picture():
    figure = draw([rung("b", "algebra", "best", 0.0, 1e-2, True)], "scene")
    figure.draw_without_rendering()


def test_ladders_of_a_scene_and_why_others_are_left_out():
    full = full_scene(*staged())
    found, out = ladders(full)
    names = {ladder.name for ladder in found}
    assert names == {"form", "split", "coupling", "shear", "local", "rings_kept", "dtype"}
    assert out["dent"] == "no surface"
    assert out["smoothing"] == "the contact points are given"
    assert "fixed numbers of steps" in out["tolerance"]
    assert kept_rings(full, 3).tolist() == [2, 3, 4]  # 30, 40, 50 mm beside 42 mm
    kinds = {ladder.name: ladder.kind for ladder in found}
    assert (kinds["form"], kinds["dtype"], kinds["shear"]) == ("algebra", "truncation", "model")


def test_the_finest_level_is_no_wish_of_the_user():
    arch = {"EI_C": "13 N mm^2", "k_t": "0.4 N/mm"}
    said = {e.name: e for e in full_scene(*staged(**arch)).scene.plan.effects}
    assert (said["rings"].level, said["rings"].forced) == ("arch2", False)
    assert said["second_plane"].reason == "arches need vectors"
    requested = SCENE | {"effects": {"rings": "arch2"}}
    said = {e.name: e for e in full_scene(*staged(requested, **arch)).scene.plan.effects}
    assert said["rings"].forced
    requested = SCENE | {"effects": {"rings": "mat"}}
    full = full_scene(*staged(requested, **arch))
    assert full.levels.plan.rings == "mat"
    assert not full.levels.plan.second_plane


@pytest.mark.slow
@pytest.mark.compiling
def test_a_measured_rung_errs_as_by_hand(monkeypatch):
    """`total` is F = k_1 D + k_3 D^3, by hand; `series` solves d + c F(d) = D."""
    full = full_scene(*staged(GA_L=None, k_1_ring=None))
    ladder = Ladder("coupling", "model", {v: {"coupling": v} for v in ("total", "series")}, {})
    monkeypatch.setattr(measuring, "ladders", lambda full: ([ladder], {"x": "why"}))
    rows = measuring.measure("small", full, measuring.Settings(calls=10, lanes=4))
    total, series, left = rows
    solve = jax.jit(simulate, compiler_options={"xla_backend_optimization_level": 0})
    out = solve(full.scene, full.material, full.path)
    F = -float(out.force[-1, 1])
    c = float(out.skeleton[-1, 1]) / float(out.force[-1, 1])
    d = np.roots([c * K_3, 0, 1 + c * K_1, -DEPTH])
    d = d[np.abs(d.imag) < 1e-12].real.item()
    assert pytest.approx(K_1 * d + K_3 * d**3) == F
    printed = K_1 * DEPTH + K_3 * DEPTH**3
    assert total["errors"]["force"] == pytest.approx((printed - F) / F, rel=1e-3)
    assert series["errors"]["force"] == 0
    assert series["finest"]
    # d F / d log (EI_L, k_M, k_1, k_3): total: (0, 0, k_1 D, k_3 D^3); series: implicit.
    slope = K_1 + 3 * K_3 * d**2
    own = np.array([K_1 * d, K_3 * d**3]) / (1 + c * slope)
    small = 1e-4
    stiff = [F]
    for name in ("EI_L", "k_M"):
        value = getattr(full.material, name) * (1 + small)
        more = dataclasses.replace(full.material, **{name: value})
        stiff.append(-float(solve(full.scene, more, full.path).force[-1, 1]))
    J = np.array([*(np.array(stiff[1:]) - F) / small, *own])
    expected = np.abs(np.array([0, 0, K_1 * DEPTH, K_3 * DEPTH**3]) - J)
    found = total["errors"]["gradient"]
    assert found == pytest.approx(expected.max() / np.abs(J).max(), rel=2e-3)
    for row in (total, series):
        times = row["times"]
        assert 0 < times["call"]["median"] <= times["call"]["p99"]
        assert times["gradient"]["median"] > 0
        assert 0 < times["part_lane"]["median"] < times["part"]["median"]
        assert times["compile"] > 0
    assert left == {"scene": "small", "ladder": "x", "left_out": "why"}


def off(found, reference):
    """Largest error of force and joints, by hand."""
    worst = 0.0
    for a, b in ((found.force, reference.force), (found.joints, reference.joints)):
        a, b = np.asarray(a, float), np.asarray(b)

        def length(v):
            return np.sqrt((v**2).sum(-1)).max()

        worst = max(worst, length(a - b) / length(b))
    return worst


@pytest.mark.slow
@pytest.mark.compiling
def test_chosen_plan_is_within_the_tolerance():
    spec, made = staged()
    full = full_scene(spec, made)
    solve = jax.jit(simulate, compiler_options={"xla_backend_optimization_level": 0})
    reference = solve(made.scene, made.material, made.path)  # the rules leave nothing out here
    dropped = []
    for tolerance in (0.1, 0.01, 0.001, 1e-10):
        choice = choose(full, tolerance)
        assert off(solve(choice.scene, choice.material, choice.path), reference) <= tolerance
        assert choice.errors.worst <= tolerance
        dropped.append({rung.ladder for rung in choice.dropped})
        level = {e.name: e.level for e in choice.scene.plan.effects}
        reason = {e.name: e.reason for e in choice.scene.plan.effects}
        assert (level["shear"] == "off") == ("shear" in dropped[-1])
        assert "change" in reason["shear"]
        assert level["precision"] == str(choice.material.k_1.dtype) == str(choice.path.s.dtype)
    assert dropped[0] == {"shear", "local", "dtype"}
    assert dropped[0] > dropped[1] >= dropped[2] == {"dtype"} > dropped[3]
    assert {rung.ladder for rung in choice.refused} == {"shear", "local", "dtype"}
    assert not choice.restored
    assert "no program but the full one is within 1e-08 %" in choice.sentence
    assert choice.cost.share == 1


def test_a_tolerance_needs_something_to_be_measured_by():
    lifted = SCENE | {"path": SCENE["path"] | {"displacement": ["0 mm", "1 mm", "0 mm"]},
                      "model": {"contact": "unilateral"}}  # fmt: skip
    with pytest.raises(PlanError, match="no row of the path is solved with a force"):
        choose(full_scene(*staged(lifted)), 0.1)


def test_of_rungs_that_cost_the_same_the_best_is_taken():
    """Sharpness of the contact is free: the sharpest within the tolerance, and no other is kept."""
    full = full_scene(*staged())
    rungs = {name: {"kept": i} for i, name in enumerate(("worst", "best", "good"), 1)}
    ladder = Ladder("made up", "truncation", rungs | {"finest": {}}, {})
    errors = {1: 0.5, 2: 0.001, 3: 0.01}
    trial = object.__new__(Trial)
    trial.full, trial.report = full, lambda text: None
    trial.cost = lambda by, levels: Cost.exact(1.0, 0.75)
    trial.errors = lambda levels: Errors(errors[levels.kept], None, None, None, None, None)
    found = choosing._Found([], [], [])
    assert choosing._within(trial, "operations", ladder, 0.1, found).level == "best"
    assert not found.refused
    assert choosing._within(trial, "operations", ladder, 1e-4, found) is None
    assert {rung.level for rung in found.refused} == set(rungs)
    assert not found.no_gain


def test_a_choice_can_be_shown():
    full = full_scene(*staged())
    choice = choose(full, 0.1, precision="float64")
    repeat = Cost(1e-5, 0.9, 0.87, 0.94)
    end = measuring.environment(measuring.Settings(), Load())
    row = choice_row("small", choice, repeat, end)
    recorded = json.loads(json.dumps(row))
    ((*_, error, cost, operations, time, calls, share, alike),) = choice_rows([recorded])
    assert (time, calls) == ("90 % (87 to 94)", "9 / 10")
    assert float(share) == pytest.approx(0.9 / row["operations"], abs=0.005)
    assert alike == share  # nothing is float32
    again = recorded | {"tolerance": 0.01}
    ((_, both, *_),) = choice_rows([recorded, again])  # equal plans are one row
    assert both == "10 %, 1 %"
    half = recorded | {"dropped": [{"ladder": "dtype", "level": "float32", "error": 1e-7}]}
    ((*_, share, alike),) = choice_rows([half])
    assert float(alike) == pytest.approx(float(share) / 2, abs=0.006)
    assert float(error.removesuffix(" %")) <= 10
    assert cost == operations
    assert float(cost.removesuffix(" %")) < 100


def test_a_wish_is_kept():
    requested = SCENE | {"effects": {"shear": "on"}}
    choice = choose(full_scene(*staged(requested)), 0.1, precision="float64")
    assert {rung.ladder for rung in choice.dropped} == {"local"}
    assert choice.material.k_1.dtype == float
    assert choice.levels.plan.options.shear


@pytest.mark.slow
@pytest.mark.compiling
def test_simulate_takes_the_plan_within_the_tolerance(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plan = '[plan]\ntolerance = "10 %"\ncost = "operations"\n'
    Path("scene.toml").write_text(TOML + plan)
    code, out, _ = run(monkeypatch, capsys, "simulate", "scene.toml", "--out", "result")
    assert code == 0
    assert "within 10 %: force" in out
    with h5py.File("result/simulation.h5") as file:
        level = {row[0]: (row[1], row[4]) for row in json.loads(file.attrs["plan"])}
        force = file["series/force"][:]
    assert level["shear"][0] == level["two_material"][0] == "off"
    assert level["shear"][1].startswith("within the tolerance: changes force 0.")
    spec, made = staged(GA_L=None, k_1_ring=None)  # never knew of the two effects
    solve = jax.jit(simulate, compiler_options={"xla_backend_optimization_level": 0})
    expected = solve(made.scene, made.material, made.path).force
    assert json.loads(Path("result/provenance.json").read_text())["dtype"] == "float32"
    assert force.dtype == level["precision"][0] == "float32"
    np.testing.assert_allclose(force, expected, rtol=3e-6, atol=1e-12)


@pytest.mark.parametrize("tolerance", ["0 %", "100 %", "1 mm"])
def test_bad_tolerance_is_refused(tolerance, tmp_path, monkeypatch, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(TOML + f'[plan]\ntolerance = "{tolerance}"\n')
    code, _, err = run(monkeypatch, capsys, "plan", path)
    assert code == 2
    assert "plan.tolerance" in err


def test_data_must_cover_the_scene():
    full = full_scene(*staged())
    curve = SimpleNamespace(s_c=42.0, displacement=np.array([0, 3.0]), force=np.array([0, 1.0]))
    with pytest.raises(ValueError, match=r"row 2 \(s = 42 mm, 4 mm deep\): no curve covers it"):
        measuring.check_curves(full.path, [curve])


@pytest.mark.slow
@pytest.mark.compiling
def test_command_writes_every_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(TOML)
    code, out, _ = run(monkeypatch, capsys, "tradeoff", "scene.toml", "--quick", "--out", "made")
    assert code == 0
    assert "left out: dent: no surface" in out
    names = {path.name for path in Path("made").iterdir()}
    assert names == {"tradeoff.jsonl", "tradeoff.csv", "provenance.json"}
    rows = [json.loads(line) for line in Path("made/tradeoff.jsonl").read_text().splitlines()]
    error = {(r["ladder"], r["level"]): r["errors"] for r in rows if "errors" in r}
    assert error["form", "reactions"]["force"] < 1e-9
    assert 1e-9 < error["dtype", "float32"]["force"] < 1e-5
    kept = [error["rings_kept", n]["joints"] for n in ("1", "3", "7")]
    assert kept[0] > kept[1] > kept[2] == 0


def test_no_rung_of_an_effect_is_refused_as_off_its_plan():
    """The rung `dent 0` was: its rows were NaN, and its error infinite."""
    spec, made = staged(SCENE | {"output": {"ring_ends": False}}, EI_C="13 N mm^2", k_t="0.4 N/mm")
    full = full_scene(spec, made)
    climbed = {ladder.effect: ladder for ladder in ladders(full)[0] if ladder.effect in EFFECTS}
    assert {"rings", "shear", "two_material", "surface", "dent"} <= set(climbed)
    pressing = jax.numpy.ones(len(full.path.s), bool)
    for ladder in climbed.values():
        for rung in ladder.rungs:
            scene, material, path = program(full, ladder.levels(full, rung))
            asked = outside_plan(scene, material, path, pressing)
            assert asked is None or not asked.any(), (ladder.name, rung)
