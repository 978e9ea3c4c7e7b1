"""The model of a machine's time: known numbers come back, what is kept is read, choices by it."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from run_cli import run
from tradeoff_scene import SCENE, TOML

from jaxtrachea.files.programs import TIME_MODEL
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.operations import count_operations
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.tradeoff import calibrate as counted
from jaxtrachea.tradeoff import time_model as timing
from jaxtrachea.tradeoff import trial as trying
from jaxtrachea.tradeoff.choice import choose
from jaxtrachea.tradeoff.errors import Errors
from jaxtrachea.tradeoff.ladders import ladders
from jaxtrachea.tradeoff.levels import full_scene, program
from jaxtrachea.tradeoff.load import QUIET, Load
from jaxtrachea.tradeoff.price import OPERATIONS, Price, price, started
from jaxtrachea.tradeoff.time_model import TimeModel, Uncalibrated, Work, fitted, keep, kept
from jaxtrachea.tradeoff.trial import Trial

#: s: a call, a kernel, an operation in float32 and in float64.
TRUTH = np.array([20e-6, 80e-9, 0.1e-9, 0.2e-9])
WORK = [Work(k, a, b) for k, a, b in (
    (260, 0, 2e3), (30, 0, 1e4), (530, 6e5, 0), (530, 0, 6e5), (550, 2.4e6, 0), (1200, 0, 5e5),
)]  # fmt: skip
SECONDS = [float(TRUTH @ (1, *w)) for w in WORK]
MODEL = TimeModel(*map(float, TRUTH), worst=0.1, date="2026-11-23")


@pytest.fixture(autouse=True)
def _on_a_cpu(monkeypatch):
    """Whatever device JAX names first: what is kept and read is of a CPU only."""
    monkeypatch.setattr(timing.jax, "default_backend", lambda: "cpu")


def full():
    spec = SceneSpec.model_validate(SCENE)
    return full_scene(spec, stage(spec, Path()))


def test_known_numbers_come_back():
    found = fitted(WORK, SECONDS)
    np.testing.assert_allclose(found[:4], TRUTH, rtol=1e-9)
    assert found.worst < 1e-9
    assert found.seconds(WORK[3]) == pytest.approx(SECONDS[3])


def test_noise_moves_them_little():
    """5 % on every time; the error that the model names bounds that of its own programs."""
    noisy = np.array(SECONDS) * (1 + 0.05 * np.cos(np.arange(len(WORK)) * 2.4))
    found = fitted(WORK, noisy.tolist())
    np.testing.assert_allclose(found[1:4], TRUTH[1:], rtol=0.35)
    predicted = [found.seconds(w) for w in WORK]
    np.testing.assert_allclose(predicted / noisy, 1, atol=found.worst * (1 + 1e-9))
    assert 0 < found.worst < 0.06


def test_times_that_make_no_sense_are_refused():
    with pytest.raises(Uncalibrated, match="do not rise"):
        fitted(WORK, [1e-5] * len(WORK))


def test_a_kept_model_is_read_back(tmp_path):
    assert kept(tmp_path) is None
    keep(MODEL, tmp_path)
    assert kept(tmp_path) == MODEL


def damage(change):
    """The file with something changed in it."""
    read = {"device": timing.device(), "model": MODEL._asdict()}
    change(read)
    return json.dumps(read)


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v["device"].update(processor="another"),
        lambda v: v["device"].update(jaxlib="0.0"),
        lambda v: v["model"].pop("kernel"),
        lambda v: v["model"].update(kernel=0.0),
        lambda v: v["model"].update(float64=-1e-9),
        lambda v: v["model"].update(call=float("nan")),
        lambda v: v["model"].update(call=10**400),
        lambda v: v["device"].pop("cores"),
        lambda v: v["model"].update(float32="fast"),
        lambda v: v["model"].update(date="tomorrow"),
        lambda v: v.update(model=[1, 2, 3]),
    ],
)
def test_a_damaged_model_is_not_read(change, tmp_path):
    (tmp_path / TIME_MODEL).write_text(damage(change))
    assert kept(tmp_path) is None
    keep(MODEL, tmp_path)  # what is measured anew takes its place
    assert kept(tmp_path) == MODEL


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\x01", "[" * 200_000])
def test_what_is_no_model_is_not_read(text, tmp_path):
    (tmp_path / TIME_MODEL).write_text(text)
    assert kept(tmp_path) is None


BUSY, POOR = MODEL._replace(others=0.9), MODEL._replace(worst=1.3)


@pytest.mark.parametrize(("model", "why"), [
    (BUSY, "others kept 0.9 cores busy while it was measured"),
    (POOR, "the worst error of its fit is 130 %"),
])  # fmt: skip
def test_a_model_of_a_busy_machine_is_not_kept(model, why, tmp_path, monkeypatch):
    """Used for the run; a quiet one is kept, and read by the next."""
    from jaxtrachea.cli import timing as command

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    monkeypatch.setattr(counted, "calibrate", lambda report: model)
    found, said = command.time_model(print)
    monkeypatch.setattr(counted, "calibrate", None)  # once a run
    assert found == model
    assert said == f"model of time: for this run only, not kept: {why}"
    assert not list(tmp_path.iterdir())
    assert command.price_of("step", print) == (Price("step", model), said)
    monkeypatch.setattr(command, "_of_this_run", {})  # the next start
    monkeypatch.setattr(counted, "calibrate", lambda report: MODEL._replace(others=0.1))
    assert command.time_model(print)[1] == ""
    monkeypatch.setattr(counted, "calibrate", None)
    assert command.time_model(print) == (MODEL, "")


def test_a_model_that_cannot_be_kept_is_said(tmp_path):
    assert "cannot be written" in keep(MODEL, tmp_path / "none")
    assert keep(MODEL, tmp_path) == ""


def test_a_predicted_time_says_how_good_the_model_is():
    words = Price("step", MODEL._replace(worst=0.45)).words((2e-3, 1e-3))
    assert words == (
        "50 % of its time (predicted here for one pose a call: 1 ms of 2 ms, within 45 %)"
    )


@pytest.mark.slow
@pytest.mark.compiling
def test_plan_measures_and_keeps_a_model(tmp_path, monkeypatch, capsys):
    """With an empty folder; where others are busy it says why none is kept, or none is found."""
    from jaxtrachea.cli import timing as command

    measured = []

    def fit(work, seconds, real=fitted):
        measured.append(real(work, seconds))
        return measured[-1]

    monkeypatch.setattr(counted, "fitted", fit)
    monkeypatch.setattr(counted, "TURNS", 60)  # the least of more times, beside other tests
    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    path, load = tmp_path / "scene.toml", Load()
    path.write_text(TOML)
    code, out, _ = run(monkeypatch, capsys, "plan", path, "--time")
    out, others = " ".join(out.split()), load.others()
    assert code == 0
    if not measured:  # times that do not rise with the work: only where others disturb them
        assert "no time is predicted: the times measured do not rise" in out
        assert others is None or others > QUIET
        return
    (model,) = measured
    assert "time predicted on this machine" in out
    assert np.isfinite(model[:5]).all()
    assert min(model[:5]) >= 0
    assert min(model[1:4]) > 0  # a kernel, an operation in float32 and in float64
    if (tmp_path / TIME_MODEL).exists():
        assert kept(tmp_path) == model
        assert "not kept" not in out
    else:
        assert "not kept: others kept" in out or model.worst > 1


def test_another_kind_of_device_has_no_model(monkeypatch):
    monkeypatch.setattr(timing.jax, "default_backend", lambda: "gpu")
    with pytest.raises(Uncalibrated, match="the device is a gpu"):
        timing.device()


@pytest.mark.parametrize(
    ("kernel", "operation", "expected"), [(1e-6, 1e-12, "off"), (1e-12, 1e-6, "uniform")]
)
def test_a_plan_by_time_takes_what_is_truly_cheaper(kernel, operation, expected, monkeypatch):
    """Two rungs of one ladder: one with few kernels, one with few operations; both are exact."""
    whole = full()
    trial = object.__new__(Trial)
    trial.full, trial.report, trial.costs, trial.known = whole, lambda text: None, {}, {}
    trial.price = Price("path", TimeModel(0.0, kernel, operation, operation))
    found = {ladder.name: ladder for ladder in ladders(whole)[0]}
    few = found["local"].levels(whole, "uniform"), found["shear"].levels(whole, "off")
    kernels = dict(zip((whole.levels, *few), (1000, 900, 100), strict=True))
    operations = {whole.levels: 10_000, few[0]: 100, few[1]: 9_000}
    trial.kernels = {("path", v): n for v, n in kernels.items()}
    by_plan = {v.plan.options: operations[v] for v in kernels}
    monkeypatch.setattr(
        "jaxtrachea.tradeoff.price.count_operations",
        lambda f, scene, *rest: by_plan[scene.plan.options],
    )
    saved = {name: trial.saved(v) for name, v in zip(("uniform", "off"), few, strict=True)}
    assert max(saved, key=lambda name: saved[name]) == expected
    assert saved[expected] == pytest.approx(0.9 if expected == "off" else 0.99)


def test_operations_are_the_cost_unless_told_otherwise():
    """As by hand: those in float32 counted half, of the whole path; kernels do not count."""
    whole = full()
    arguments = program(whole, whole.levels)
    count = count_operations(simulate, *arguments)
    assert OPERATIONS.of(arguments, 10**9) == count
    half = program(whole, dataclasses.replace(whole.levels, dtype="float32"))
    assert OPERATIONS.of(half, 0) == count / 2
    assert price("operations", MODEL) == OPERATIONS == price("path", None)


def test_a_step_is_one_pose_and_a_path_is_all():
    whole = full()
    arguments = program(whole, whole.levels)
    scene, material, path = arguments
    last = type(path)(path.s[-1:], path.phi[-1:], path.displacement[-1:])
    kernels = 300
    for by, own in (("path", arguments), ("step", (scene, material, last))):
        expected = TRUTH @ (1, kernels, 0, count_operations(simulate, *own))
        assert Price(by, MODEL).of(arguments, kernels) == pytest.approx(expected)


def test_time_is_known_to_a_per_cent():
    """Rungs that save less than half of one are not worth an error."""
    timed = Price("path", MODEL)
    assert timed.saved(0.996, 1.0) == 0
    assert timed.saved(0.994, 1.0) == pytest.approx(0.01)
    assert OPERATIONS.saved(0.996, 1.0) == pytest.approx(0.004)


@pytest.mark.slow
@pytest.mark.compiling
def test_choices_by_operations_and_by_time_keep_the_tolerance():
    """On a machine whose float32 is no faster and whose kernels cost nothing, float64 stays."""
    trial = Trial(full())
    same = TimeModel(0.0, 1e-15, 1e-9, 1e-9)
    by_time = choose(trial, 0.1, price=Price("path", same))
    by_operations = choose(trial, 0.1)
    assert by_operations.levels == choose(full(), 0.1).levels
    assert {r.ladder for r in by_operations.dropped} == {"shear", "local", "dtype"}
    assert "dtype" not in {r.ladder for r in by_time.dropped}
    for found in (by_time, by_operations):
        assert found.errors.worst <= 0.1
        assert isinstance(found.errors, Errors)
    assert "of its cost" in by_operations.sentence
    if by_time.dropped:
        assert "predicted here for the whole path in one call" in by_time.sentence


@pytest.mark.parametrize("cost", ["path", "operations"])
def test_plan_says_what_was_made_least(cost, tmp_path, monkeypatch, capsys):
    from jaxtrachea.cli import timing as command

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    keep(MODEL, tmp_path)
    path = tmp_path / "scene.toml"
    path.write_text(TOML + f'[plan]\ntolerance = "10 %"\ncost = "{cost}"\n')
    code, out, _ = run(monkeypatch, capsys, "plan", path, "--time")
    out = " ".join(out.split())
    assert code == 0
    assert ("of its time (predicted here" in out) == (cost == "path")
    assert "of its cost" in out or cost == "path"
    assert "time predicted on this machine" in out
    assert "measured 2026-11-23" in out


def test_a_bad_word_for_the_cost(tmp_path, monkeypatch, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(TOML + '[plan]\ntolerance = "10 %"\ncost = "lane"\n')
    code, _, err = run(monkeypatch, capsys, "plan", path)
    assert code == 2
    assert "plan.cost" in err


def test_no_model_falls_back_to_operations(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(timing.jax, "default_backend", lambda: "gpu")
    path = tmp_path / "scene.toml"
    path.write_text(TOML + '[plan]\ntolerance = "10 %"\n')
    code, out, _ = run(monkeypatch, capsys, "plan", path)
    out = " ".join(out.split())
    assert code == 0
    assert "cost: operations in place of time: the device is a gpu" in out
    assert "of its cost" in out


#: With a quintic law, whose Newton solve stops where it has converged.
QUINTIC = TOML.replace("[model]", 'k_5 = "0.001 N/mm^5"\n[model]')


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("cost", ["path", "step"])
def test_no_time_is_predicted_where_rounds_are_not_fixed(cost, tmp_path, monkeypatch, capsys):
    from jaxtrachea.cli import timing as command

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    keep(MODEL, tmp_path)
    path = tmp_path / "scene.toml"
    path.write_text(QUINTIC + f'[plan]\ntolerance = "10 %"\ncost = "{cost}"\n')
    code, out, _ = run(monkeypatch, capsys, "plan", path, "--time")
    out, why = " ".join(out.split()), "the program has loops without a fixed number of rounds"
    assert code == 0
    assert f"no time is predicted: {why}" in out
    assert f"cost: operations in place of time: {why}" in out
    assert "of its cost" in out


def test_a_pose_alone_starts_the_kernels_of_its_own_program(monkeypatch):
    """By rows: a path of two starts ten, a pose alone three; a press is no pose of a `Session`."""
    whole = full()
    arguments = program(whole, whole.levels)
    monkeypatch.setattr(counted, "started", lambda made: {2: 10, 1: 3}[made])
    rows = SimpleNamespace(lower=lambda *a: SimpleNamespace(compile=lambda: len(a[2].s)))
    monkeypatch.setattr(counted.jax, "jit", lambda f, **options: rows)
    assert [v and v.kernels for v in counted.predicted(MODEL, arguments)] == [10, None]
    monkeypatch.setattr(counted, "check_scene", lambda scene, material: None)
    assert [v and v.kernels for v in counted.predicted(MODEL, arguments)] == [10, 3]


@pytest.mark.parametrize(("by", "kernels"), [("path", 10), ("step", 3)])
def test_a_trial_counts_what_one_call_starts(by, kernels, monkeypatch):
    """As above; a trial made for operations counts nothing until a time is asked for."""
    count = {2: 10, 1: 3}
    monkeypatch.setattr(trying, "started", lambda made: count[made])
    monkeypatch.setattr(trying, "_compiled", lambda *arguments: len(arguments[2].s))
    whole = full()
    trial = object.__new__(Trial)
    trial.full, trial.kernels, trial.costs = whole, {}, {}
    trial.known = {whole.levels: Errors(0.0, None, None, None, None, None)}
    trial.price = OPERATIONS
    operations = trial.cost(whole.levels)
    assert not trial.kernels
    trial.price = Price(by, TimeModel(0.0, 1.0, 1e-12, 1e-12))
    assert trial.cost(whole.levels) == pytest.approx(kernels, abs=2e-12 * operations)
    assert trial.kernels == {(by, whole.levels): kernels}


@pytest.mark.parametrize("text", [None, "odd", "ENTRY %m (v: f64[]) -> f64[] {\n"
                                  "  ROOT %o = f64[] call(%v), to_apply=%gone\n}"])  # fmt: skip
def test_a_program_whose_text_cannot_be_read_has_no_time(text):
    with pytest.raises(Uncalibrated, match="ENTRY|gone"):
        started(SimpleNamespace(as_text=lambda: text))


def test_the_cache_shows_and_clears_the_model(tmp_path, monkeypatch, capsys):
    from jaxtrachea.cli import cache as command

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    keep(MODEL, tmp_path)
    _, out, _ = run(monkeypatch, capsys, "cache")
    assert "a kernel 80 ns" in out
    for name, value, words in (
        ("flags", "--xla_other", "of XLA_FLAGS '--xla_other'"),
        ("cores", "512", "of number of cores '512'"),
        ("processor", "another", "of processor 'another'"),
    ):
        (tmp_path / TIME_MODEL).write_text(
            damage(lambda v, n=name, x=value: v["device"].update({n: x}))
        )
        _, out, _ = run(monkeypatch, capsys, "cache")
        assert out.rstrip().endswith(
            f"not for here, the next choice measures it anew: it is {words}"
        )
    (tmp_path / TIME_MODEL).write_text("{")
    _, out, _ = run(monkeypatch, capsys, "cache")
    assert "model of time: damaged; the next choice measures it anew" in out
    _, out, _ = run(monkeypatch, capsys, "cache", "--clear")
    assert "model of time deleted" in out
    assert not (tmp_path / TIME_MODEL).exists()


def test_a_model_that_cannot_be_deleted_is_said(tmp_path, monkeypatch, capsys):
    """A folder of that name; a file that goes between the look and the deletion."""
    from jaxtrachea.cli import cache as command

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    (tmp_path / TIME_MODEL).mkdir()
    code, out, _ = run(monkeypatch, capsys, "cache", "--clear")
    assert code == 0
    assert f"model of time not deleted: {tmp_path / TIME_MODEL}: " in out
    code, out, _ = run(monkeypatch, capsys, "cache")
    assert (code, "model of time: damaged" in out) == (0, True)
    (tmp_path / TIME_MODEL).rmdir()
    monkeypatch.setattr(command.os.path, "lexists", lambda path: True)
    code, out, _ = run(monkeypatch, capsys, "cache", "--clear")
    assert (code, "another process deleted it" in out) == (0, True)


def test_the_cache_starts_no_device(tmp_path, monkeypatch, capsys):
    """As with JAX_PLATFORMS=cuda where there is none."""
    from jaxtrachea.cli import cache as command

    def absent():
        raise RuntimeError("Unable to initialize backend 'cuda'")

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    keep(MODEL, tmp_path)
    monkeypatch.setattr(timing.jax, "default_backend", absent)
    code, out, _ = run(monkeypatch, capsys, "cache")
    assert code == 0
    assert "a kernel 80 ns" in out
    assert "not for here" not in out


def test_load_of_others_is_not_negative():
    load = Load()
    np.linalg.svd(np.ones((300, 300)))
    others = load.others()
    assert others is None or others >= 0
