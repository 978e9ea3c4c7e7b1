"""Choices by measured time: known times are found, and what is timed is what `simulate` gives."""

import time
from pathlib import Path

import jax
import numpy as np
import pytest
from run_cli import run
from tradeoff_scene import SCENE, TOML

from jaxtrachea.scene.build import stage
from jaxtrachea.scene.operations import count_operations
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.tradeoff import calls as calling
from jaxtrachea.tradeoff import trial as trying
from jaxtrachea.tradeoff.calls import one_pose, quickest, whole_path
from jaxtrachea.tradeoff.choice import choose
from jaxtrachea.tradeoff.errors import Errors
from jaxtrachea.tradeoff.levels import BUILT_IN, cast, full_scene, program
from jaxtrachea.tradeoff.load import QUIET, Load
from jaxtrachea.tradeoff.price import GRAIN, operations, words
from jaxtrachea.tradeoff.trial import Trial


def full(record=SCENE):
    spec = SceneSpec.model_validate(record)
    return full_scene(spec, stage(spec, Path()))


def waiting(seconds):
    """A call that takes so long."""

    def call():
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            pass

    return call


def test_the_least_time_of_each_call_is_found():
    seconds = [1e-3, 4e-4]
    found = quickest([waiting(v) for v in seconds])
    assert all(taken >= true for taken, true in zip(found, seconds, strict=True))
    np.testing.assert_allclose(found, seconds, rtol=0.2)  # only what other processes take away


def test_a_long_call_is_made_a_few_times_only(monkeypatch):
    made = []
    monkeypatch.setattr(calling, "ENOUGH", 0.0)
    monkeypatch.setattr(calling, "BURST", 0.0)
    quickest([lambda: made.append(0)])
    assert 3 <= len(made) <= 6


#: Seconds of the programs, by what is left out of them.
TIMES = {(): 2e-3, ("shear",): 1e-3, ("local",): 2e-3 * (1 - GRAIN / 2)}


@pytest.mark.parametrize("by", ["path", "step"])
def test_what_saves_no_time_is_not_dropped(by, monkeypatch):
    """Without the local law nothing is saved but operations; without shear half the time."""
    whole = full()
    trial = object.__new__(Trial)
    trial.full, trial.report, trial.reference = whole, lambda text: None, None
    trial.counts, trial.times, trial.calls, asked = {}, {}, {}, []

    def dropped(arguments):
        options = arguments[0].plan.options
        left = (("shear", not options.shear), ("local", options.local == "uniform"))
        return tuple(name for name, out in left if out)

    def compiled(word, arguments):
        asked.append(word)
        return dropped(arguments)

    def measured(calls):
        return [TIMES.get(v, TIMES["shear",]) for v in calls]

    monkeypatch.setattr(trying, "compiled", compiled)
    monkeypatch.setattr(trying, "quickest", measured)
    monkeypatch.setattr("jaxtrachea.tradeoff.choice._served", lambda reference: None)
    few = Errors(0.01, None, None, None, None, None)
    monkeypatch.setattr(Trial, "errors", lambda self, levels: few)
    by_time = choose(trial, 0.1, precision="float64", by=by)
    assert {rung.ladder for rung in by_time.dropped} == {"shear"}
    assert by_time.cost == (2e-3, 1e-3)
    assert set(asked) == {by}
    assert "50 % of its time (measured here for" in by_time.sentence
    by_operations = choose(trial, 0.1, precision="float64")
    assert {rung.ladder for rung in by_operations.dropped} == {"shear", "local"}
    assert by_operations.operations < by_time.operations < 1


def test_operations_as_by_hand():
    """Those in float32 counted half, of the whole path."""
    arguments = program(whole := full(), whole.levels)
    count = float(count_operations(simulate, *arguments))
    assert operations(arguments) == count
    assert operations(cast(arguments, "float32")) == count / 2
    assert words("operations", (count, count / 2)) == "50 % of its cost"


def test_the_full_program_is_its_own_measure():
    """Timed once, both times the same."""
    trial = object.__new__(Trial)
    trial.full, trial.times, trial.calls = (whole := full()), {}, {"path": waiting(1e-4)}
    own, same = trial.cost("path", whole.levels)
    assert own == same
    assert trial.saved("path", whole.levels) == 0


def last_row(arguments):
    return jax.tree.map(lambda v: np.asarray(v)[-1], jax.jit(simulate)(*arguments))


def same_row(found, expected, rtol):
    for name, a, b in zip(expected._fields, found, expected, strict=True):
        assert (a is None) == (b is None), name
        if a is not None:
            scale = np.abs(b).max(initial=0.0, where=np.isfinite(b))
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * scale, err_msg=name)
            assert np.asarray(a).dtype == b.dtype, name


#: A press with a surface as well.
SHOWN = SCENE | {"output": {"surface": True}}


@pytest.mark.parametrize(("record", "dtype"), [
    (SCENE, "float64"), (SCENE, "float32"),
    pytest.param(SHOWN, "float64", marks=pytest.mark.compiling),
])  # fmt: skip
def test_what_is_timed_of_a_press_is_what_simulate_gives(record, dtype):
    whole = full(record)
    arguments = cast(program(whole, whole.levels), dtype)
    expected = last_row(arguments)
    call = one_pose(arguments)
    for _ in range(2):  # the second writes where the first did
        same_row(call(), expected, {"float64": 1e-12, "float32": 1e-4}[dtype])
    path = jax.tree.map(lambda v: np.asarray(v)[-1], whole_path(arguments)())
    same_row(path, expected, 1e-12)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("friction", [False, True])
def test_what_is_timed_of_a_tool_is_its_step(friction):
    """A step of a `Session`; with friction, which no session takes, `simulate` of the last pose."""
    record = BUILT_IN | {"output": {"surface": False}}
    if friction:
        record = record | {"tool": record["tool"] | {"friction": 0.3}}
    whole = full(record)
    scene, material, path = program(whole, whole.levels)
    row = jax.tree.map(lambda v: v[-1:], path)
    found, expected = one_pose((scene, material, path))(), last_row((scene, material, row))
    np.testing.assert_allclose(found.force, expected.force, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.joints, expected.joints, rtol=1e-9, atol=1e-12)
    assert found.status == expected.status


@pytest.mark.parametrize("cost", ["path", "operations"])
def test_plan_says_what_was_made_least(cost, tmp_path, monkeypatch, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(TOML + f'[plan]\ntolerance = "10 %"\ncost = "{cost}"\n')
    code, out, _ = run(monkeypatch, capsys, "plan", path, "--time")
    out = " ".join(out.split())
    assert code == 0
    assert "time measured on this machine: " in out
    assert "ms for the whole path in one call, " in out
    if cost == "operations":
        assert "of its cost" in out
    else:
        none = "no program but the full one" in out  # where noise hides what is saved
        assert none or "of its time (measured here for the whole path in one call: " in out


def test_a_bad_word_for_the_cost(tmp_path, monkeypatch, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(TOML + '[plan]\ntolerance = "10 %"\ncost = "lane"\n')
    code, _, err = run(monkeypatch, capsys, "plan", path)
    assert code == 2
    assert "plan.cost" in err


def test_others_at_work_are_told(monkeypatch):
    load = Load()
    np.linalg.svd(np.ones((300, 300)))
    others = load.others()
    assert others is None or others >= 0
    for busy, said in ((None, False), (QUIET, False), (0.9, True)):
        monkeypatch.setattr(Load, "others", lambda self, busy=busy: busy)
        notes = load.notes()
        assert bool(notes) == said
        assert not said or "others kept 0.9 cores busy" in notes[0]
