"""Choices by measured time: known times are found, and what is timed is what `simulate` gives."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from run_cli import run
from scipy.stats import binom
from tradeoff_scene import SCENE, TOML

from jaxtrachea.scene.build import stage
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.tradeoff import calls as calling
from jaxtrachea.tradeoff import choice as choosing
from jaxtrachea.tradeoff import trial as trying
from jaxtrachea.tradeoff.calls import FEWEST, TURNS, one_pose, turn_medians, whole_path
from jaxtrachea.tradeoff.choice import choose
from jaxtrachea.tradeoff.cost import MIN_SAVING, Cost, describe, operations
from jaxtrachea.tradeoff.errors import Errors
from jaxtrachea.tradeoff.ladders import Ladder
from jaxtrachea.tradeoff.levels import BUILT_IN, cast, full_scene, program
from jaxtrachea.tradeoff.load import QUIET, Load, load_warning
from jaxtrachea.tradeoff.operations import count_operations
from jaxtrachea.tradeoff.trial import Trial


def full(record=SCENE):
    spec = SceneSpec.model_validate(record)
    return full_scene(spec, stage(spec, Path()))


class Clock:
    """Seconds that only calls let pass."""

    def __init__(self, monkeypatch):
        """At 0, in place of that of `calls`."""
        self.seconds = 0.0
        clock = SimpleNamespace(perf_counter=lambda: self.seconds)
        monkeypatch.setattr(calling, "time", clock)

    def call(self, *taken):
        """A call that takes one time after the other, and from the start again."""
        times = itertools.cycle(taken)

        def call():
            self.seconds += next(times)

        return call


def test_the_median_of_each_turn_is_found(monkeypatch):
    """Of ten calls one is quicker and one disturbed; one call takes longer than a turn."""
    clock = Clock(monkeypatch)
    found = turn_medians([clock.call(5e-5, *[1e-4] * 8, 5e-3), clock.call(4e-4), clock.call(0.05)])
    np.testing.assert_allclose(found.T, [[1e-4, 4e-4, 0.05]] * found.shape[1], rtol=1e-9)


def test_the_share_is_told_while_the_machine_changes_its_speed():
    """Turns of 1 to 3 times the time, each ratio 3 % off 0.8, and some calls disturbed."""
    rng = np.random.default_rng(0)
    speed, noise = rng.uniform(1, 3, 120), rng.normal(1, 0.03, 120)
    own = 0.8 * speed * noise
    own[::10] *= 5
    cost = Cost.measured(1e-4 * speed, 1e-4 * own)
    assert cost.full == pytest.approx(2e-4, rel=0.1)
    assert cost.low < 0.8 < cost.high < cost.low + 0.04
    assert cost.saved == 1 - cost.share == pytest.approx(0.2, abs=0.01)


def test_the_interval_holds_the_median_as_often_as_it_says():
    """Scipy's binomial distribution: how often the order statistics of n ratios enclose it."""
    for n in range(FEWEST, TURNS + 1):
        turns = np.arange(1.0, n + 1)
        cost = Cost.measured(np.ones(n), turns)
        outside = binom.cdf(cost.low - 1, n, 0.5) + binom.sf(cost.high - 1, n, 0.5)
        narrower = binom.cdf(cost.low, n, 0.5) + binom.sf(cost.high - 2, n, 0.5)
        assert outside <= 0.05, n
        assert narrower > 0.048, n  # none much narrower would do


def test_what_may_be_noise_saves_nothing():
    assert Cost(1.0, 0.9, 0.8, 1.01).saved == 0
    assert Cost(1.0, 0.9, 0.8, 0.99).saved == pytest.approx(0.1)
    assert Cost.exact(2.0, 2.0).saved == 0


def test_a_long_call_is_made_a_few_times_only(monkeypatch):
    """Longer than all turns together may take: twice in each of the fewest turns."""
    call, made = Clock(monkeypatch).call(3.0), []
    turn_medians([lambda: made.append(call())])
    assert len(made) == FEWEST * 2


BOTH = "shear", "local"
#: Seconds of the programs, by what is left out of them; and what is dropped then. What saves
#: nothing but operations is not, nor what saves nothing with another.
TIMES = [
    ({(): 2e-3, ("shear",): 1e-3, ("local",): 2e-3 * (1 - MIN_SAVING / 2)}, {"shear"}),
    ({(): 2e-3, ("shear",): 1e-3, ("local",): 1.5e-3, BOTH: 0.8e-3}, {"shear", "local"}),
    ({(): 2e-3, ("shear",): 1e-3, ("local",): 1.5e-3, BOTH: 2.1e-3}, {"shear"}),
    ({(): 2e-3, ("shear",): 2e-3, ("local",): 2.5e-3}, set()),
    # In every other turn half of the time, in the others a little more.
    ({(): 2e-3, ("shear",): 1e-3, ("local",): (1e-3, 2.1e-3)}, {"shear"}),
]


@pytest.mark.parametrize(("times", "expected"), TIMES)
@pytest.mark.parametrize("by", ["path", "step"])
def test_what_saves_no_time_is_not_dropped(by, times, expected, monkeypatch):
    whole = full()
    trial = object.__new__(Trial)
    trial.full, trial.report, trial.reference = whole, lambda text: None, None
    trial.counts, trial.times, trial.calls, trial.others, asked = {}, {}, {}, 0.0, []

    def dropped(arguments):
        options = arguments[0].plan.options
        left = (("shear", not options.shear), ("local", options.local == "uniform"))
        return tuple(name for name, out in left if out)

    def compiled(word, arguments):
        asked.append(word)
        return dropped(arguments)

    def measured(calls):
        """Each its time in every turn; a pair of times by turns."""
        return np.array([np.resize(times[v], 12) for v in calls])

    monkeypatch.setattr(trying, "compiled", compiled)
    monkeypatch.setattr(trying, "turn_medians", measured)
    monkeypatch.setattr("jaxtrachea.tradeoff.choice._served", lambda reference: None)
    few = Errors(0.01, None, None, None, None, None)
    monkeypatch.setattr(Trial, "errors", lambda self, levels: few)
    by_time = choose(trial, 0.1, precision="float64", by=by)
    assert {rung.ladder for rung in by_time.dropped} == expected
    assert {rung.ladder for rung in by_time.no_gain} == set(BOTH) - expected
    share = times[tuple(v for v in BOTH if v in expected)] / 2e-3
    assert by_time.cost == (2e-3, share, share, share)
    assert set(asked) == {by}
    said = {"shear": "50 % of its time (50 to 50 %, measured", "local": "40 % of its time"}
    describe = [said[v] for v in BOTH if v in expected]
    describe = describe[-1] if describe else "nothing that is within 10 % surely saves time"
    assert describe in by_time.sentence
    reasons = {e.name: e.reason for e in by_time.scene.plan.effects}
    assert ("not surely save time" in reasons["two_material"]) == ("local" not in expected)
    by_operations = choose(trial, 0.1, precision="float64")
    assert {rung.ladder for rung in by_operations.dropped} == {"shear", "local"}
    assert by_operations.operations < 1
    assert (by_time.operations < 1) == bool(expected)


def test_a_finer_rung_is_taken_where_the_coarsest_saves_no_time():
    trial = object.__new__(Trial)
    trial.full, trial.report = full(), lambda text: None
    rungs = {name: {"kept": i} for i, name in enumerate(("slow", "quick"), 1)}
    ladder = Ladder("made up", "truncation", rungs | {"finest": {}}, {})
    costs = {"operations": {1: 0.5, 2: 0.7}, "path": {1: 1.1, 2: 0.8}}
    trial.cost = lambda by, levels: Cost.exact(1.0, costs[by][levels.kept])
    trial.errors = lambda levels: Errors(0.01)
    found = choosing._Found([], [], [])
    taken = choosing._within(trial, "path", ladder, 0.1, found)
    assert (taken.level, taken.saved) == ("quick", pytest.approx(0.2))
    assert [rung.level for rung in found.no_gain] == ["slow"]


def test_operations_of_a_step_are_those_of_a_row():
    """Rows of normal presses are alike: a path of two has twice the operations of one."""
    trial = object.__new__(Trial)
    trial.full, trial.counts = (whole := full()), {}
    trial.share("step", whole.levels), trial.share("path", whole.levels)
    path, row = (trial.counts[step, whole.levels] for step in (False, True))
    assert path / 2 <= row < path


def test_operations_as_by_hand():
    """Those in float32 counted half, of the whole path."""
    arguments = program(whole := full(), whole.levels)
    count = float(count_operations(simulate, *arguments))
    assert operations(arguments) == count
    assert operations(cast(arguments, "float32")) == count / 2
    assert describe("operations", Cost.exact(count, count / 2)) == "50 % of its cost"


def test_the_full_program_is_its_own_measure(monkeypatch):
    """Timed once, both times the same."""
    trial = object.__new__(Trial)
    clock = Clock(monkeypatch)
    trial.full, trial.times, trial.calls = (whole := full()), {}, {"path": clock.call(1e-4)}
    trial.others = 0.0
    cost = trial.cost("path", whole.levels)
    assert cost == (pytest.approx(1e-4), 1, 1, 1)
    assert cost.saved == 0


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


@pytest.mark.slow
def test_what_is_timed_of_a_press_is_what_simulate_gives():
    whole = full(SHOWN)
    arguments = program(whole, whole.levels)
    expected = last_row(arguments)
    call = one_pose(arguments)
    for _ in range(2):  # the second writes where the first did
        same_row(call(), expected, 1e-12)
    for last in (1, 2):  # every row of the path, by a program of its own
        upto = (*arguments[:2], jax.tree.map(lambda v, n=last: v[:n], arguments[2]))
        path = jax.tree.map(lambda v, n=last: np.asarray(v)[n - 1], whole_path(arguments)())
        same_row(path, one_pose(upto)(), 1e-12)


@pytest.mark.slow
@pytest.mark.compiling
def test_what_is_timed_of_a_tool_is_its_step():
    """With friction `simulate` of the last pose."""
    record = BUILT_IN | {"output": {"surface": True}}
    whole = full(record | {"tool": record["tool"] | {"friction": 0.3}})
    scene, material, path = program(whole, whole.levels)
    row = jax.tree.map(lambda v: v[-1:], path)
    call, expected = one_pose((scene, material, path)), last_row((scene, material, row))
    for _ in range(2):
        found = call()
        for name in ("force", "joints", "vertices"):
            a, b = getattr(found, name), getattr(expected, name)
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
        assert found.status == expected.status


def test_a_bad_word_for_the_cost(tmp_path, monkeypatch, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(TOML + '[plan]\ntolerance = "10 %"\ncost = "lane"\n')
    code, _, err = run(monkeypatch, capsys, "plan", path)
    assert code == 2
    assert "plan.cost" in err


def test_others_at_work_are_told():
    load = Load()
    np.linalg.svd(np.ones((300, 300)))
    others = load.others()
    assert others is None or others >= 0
    for busy in (None, 0.0, QUIET):
        assert load_warning(busy) == ()
    (said,) = load_warning(0.9)
    assert "machine was busy (0.9 cores)" in said
