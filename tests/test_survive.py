"""Runs that are stopped, damaged, moved or shared: the numbers are those of a run in peace."""

import dataclasses
import errno
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from full_disk import Disk
from interrupted import (
    finish,
    kill_often,
    numbers,
    programs_kept,
    start,
    wait_for,
    write_study,
)
from run_cli import run, tree

import jaxtrachea
from jaxtrachea.cli import main as cli
from jaxtrachea.cli.specification import study_of
from jaxtrachea.cli.terminal import set_up_jax
from jaxtrachea.config import load_fit_spec
from jaxtrachea.files import lock as run_lock
from jaxtrachea.files import output
from jaxtrachea.files.provenance import source_digest
from jaxtrachea.fitting import fit
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.data_files import read_data
from jaxtrachea.optimisation import levenberg_marquardt
from jaxtrachea.optimisation.programs import program
from jaxtrachea.results.hdf5 import read_hdf5
from jaxtrachea.results.stored import NoResults
from jaxtrachea.runs import checkpoint, manifest, processes, rerun, shards
from jaxtrachea.runs import folder as run_folder
from jaxtrachea.runs.processes import Lost, Meeting, Watch

FIT = ("fit", "spec.toml", "--out", "out")


@pytest.fixture(scope="module")
def peace(tmp_path_factory):
    """A study of 9 lanes in 3 shards, fitted without interruption; all its files, as text."""
    folder = tmp_path_factory.mktemp("peace")
    write_study(folder, 9, 3)
    with pytest.MonkeyPatch.context() as patch:
        quietly(patch, folder)
        patch.setattr("sys.argv", ["jaxtrachea", *FIT])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    assert stop.value.code == 0
    return folder


def quietly(patch, folder):
    """Work in `folder`, without plots."""
    patch.chdir(folder)
    patch.setattr("jaxtrachea.report.plots.draw_all", lambda *_: ([], {}))
    patch.setattr("jaxtrachea.files.html.page", lambda *_: "")


@pytest.fixture
def study(peace, tmp_path, monkeypatch):
    """The same study, not yet fitted."""
    for name in ("curves.csv", "spec.toml"):
        shutil.copy(peace / name, tmp_path)
    quietly(monkeypatch, tmp_path)
    return tmp_path


def stop_at(patch, k, error=KeyboardInterrupt):
    """Let fits before the k-th through, one after the other, stop that one; counts them."""
    asked, real = [], fit.fit
    patch.setattr(checkpoint, "worker_devices", lambda _: jax.local_devices()[:1])

    def stopping(study, settings, progress):
        asked.append(study.lanes.lower.shape[0])
        if len(asked) == k:
            raise error
        return real(study, settings, progress)

    patch.setattr("jaxtrachea.fitting.fit.fit", stopping)
    return asked


def test_stopped_and_resumed(peace, study, monkeypatch, capsys):
    """Ctrl-C in the third shard, a damaged shard, and on: two shards anew, numbers as in peace."""
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        code, _, err = run(patch, capsys, *FIT)
    assert code == 130
    assert "2 of 3 shards are kept in out" in err
    assert "--out out --resume" in err
    assert "nothing was written" not in err
    so_far = (study / "out" / run_folder.SO_FAR).read_text().splitlines()
    assert so_far == (peace / "out" / "summary.csv").read_text().splitlines()[:7]
    code, _, err = run(monkeypatch, capsys, *FIT)
    assert (code, "go on with --resume" in err) == (2, True)
    path = study / "out" / ".run" / "00001.npz"
    path.write_bytes(path.read_bytes()[:-500])
    again = stop_at(monkeypatch, -1)
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert code == 0, err
    assert "damaged, fitted again: 00001.npz" in err
    assert "1 of 3 shards are there" in err
    assert again == [3, 3]
    assert numbers(study / "out") == numbers(peace / "out")
    assert sorted(tree(study / "out")) == sorted(tree(peace / "out"))


def test_an_error_while_files_are_written_keeps_the_shards(peace, study, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(
            "jaxtrachea.report.plots.draw_all", lambda *_: (_ for _ in ()).throw(OSError(28, ""))
        )
        code, _, err = run(patch, capsys, *FIT)
    assert (code, "3 of 3 shards are kept" in err) == (2, True)
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    assert run(monkeypatch, capsys, *FIT, "--resume")[0] == 0
    assert numbers(study / "out") == numbers(peace / "out")


def test_stopped_while_files_move(peace, study, monkeypatch, capsys):
    """From the renaming on nothing is computed again, and nothing is lost."""
    shutil.copytree(peace / "out", study / "out" / ".written")
    (study / "out" / ".run").mkdir()
    (study / "out" / ".written" / "summary.csv").replace(study / "out" / "summary.csv")
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert (code, "out is finished" in err) == (0, True)
    assert tree(study / "out") == tree(peace / "out")


def changed_spec(folder):
    path = folder / "spec.toml"
    path.write_text(path.read_text().replace("starts = 2", "starts = 3"))


def changed_dtype(folder):
    path = folder / "spec.toml"
    path.write_text(path.read_text() + 'precision = "float32"\n')


def changed_input(folder):
    path = folder / "curves.csv"
    path.write_text(path.read_text().replace("T0000,0,30,0.1,", "T0000,0,30,0.11,"))


def fewer_lanes(folder):
    path = folder / "curves.csv"
    rows = path.read_text().splitlines()
    path.write_text("\n".join(row for row in rows if not row.startswith("T0008")) + "\n")


CHANGES = {
    "specification": (changed_spec, ["the specification has changed", "--force"]),
    "dtype": (changed_dtype, ["dtype was float64 and is float32"]),
    "input": (changed_input, ["curves.csv has changed", "another --out"]),
    "another study": (fewer_lanes, ["lanes was 9 and is 8", "the run there is of another study"]),
}


def test_refusals(peace, study, monkeypatch, capsys):
    """Unfinished and finished runs of something else; nothing is touched, one line says why."""

    def refused(*arguments, says):
        before = tree(study)
        code, _, err = run(monkeypatch, capsys, *arguments)
        assert (code, len(err.splitlines())) == (2, 1), err
        for words in says:
            assert words in err
        assert tree(study) == before

    refused(*FIT, "--resume", says=["out holds no unfinished run"])
    refused("fit", "spec.toml", "--resume", says=["--out"])
    refused(*FIT, "--force", says=["--force goes with --resume"])
    refused(*FIT, "--process", 1, says=["--coordinator, --processes and --process"])
    with monkeypatch.context() as patch:
        stop_at(patch, 2)
        assert run(patch, capsys, *FIT)[0] == 130
    shutil.copytree(peace / "out", study / "finished")
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    refused(*FIT, "--rerun-failed", says=["not finished; use --resume first"])
    for change, says in CHANGES.values():
        kept = {p.name: p.read_text() for p in (study / "spec.toml", study / "curves.csv")}
        change(study)
        refused(*FIT, "--resume", says=says)
        for option in ("--resume", "--rerun-failed"):
            refused(*FIT[:3], "finished", option, says=["finished is finished, and", says[0]])
        for name, text in kept.items():
            (study / name).write_text(text)
    with monkeypatch.context() as patch:
        patch.setattr(jaxtrachea, "__version__", "99")
        refused(*FIT, "--resume", says=["jaxtrachea was 0", "and is 99"])
    with monkeypatch.context() as patch:
        patch.setattr(manifest, "source_digest", lambda: "0123")
        says = ["the source of jaxtrachea was ", " and is 0123; ", "another --out", "--force"]
        refused(*FIT, "--resume", says=says)
    strip_manifests(study / "out" / ".run")
    (study / "out" / ".run" / "run.json").write_text("{")
    refused(*FIT, "--resume", says=["its run.json cannot be read", "none of its 1 shards says"])


def strip_manifests(folder):
    """Shards as they were before each held the manifest of its run; its copy is gone."""
    for path in folder.glob("*.npz"):
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files if name != "journal"}
        np.savez(path, **arrays)
    (folder / "previous-run.json").unlink(missing_ok=True)


def test_the_digest_of_the_source_follows_every_file(tmp_path, monkeypatch):
    """And nothing else: neither the folder that it is installed in nor what is compiled there."""
    package = Path(jaxtrachea.__file__).parent

    def digest(change=None):
        shutil.rmtree(tmp_path, ignore_errors=True)
        shutil.copytree(package, tmp_path, ignore=shutil.ignore_patterns("__pycache__", "*.json"))
        if change is not None:
            change()
        monkeypatch.setattr(jaxtrachea, "__file__", str(tmp_path / "__init__.py"))
        return source_digest.__wrapped__()

    as_it_is = source_digest()
    assert digest() == as_it_is
    law = tmp_path / "mechanics" / "force_law.py"
    assert digest(lambda: law.write_text(law.read_text().replace("1", "2", 1))) != as_it_is
    assert digest(lambda: law.rename(law.with_name("law.py"))) != as_it_is


def test_a_manifest_of_an_earlier_version_is_read():
    """Written out by hand, with the keys that the fields of today have on file; and back."""
    run = {
        "schema": "jaxtrachea-run", "schema_version": 1, "id": "a", "specification": "b",
        "inputs": {"c.csv": "d"}, "versions": {"jax": "1"}, "dtype": "float64", "device": "cpu",
        "lanes": 9, "chunk": 64, "save_every": 3, "options": ["profile"],
        "rerun": {"former": "e", "lanes": [1, 5], "count": 2}, "forced": [],
    }  # fmt: skip
    read = manifest.from_dict(run)
    assert (read.batch, read.save_every, read.lanes) == (64, 3, 9)
    assert read.rerun == manifest.Rerun(results="e", lanes=[1, 5], count=2)
    assert manifest.as_dict(read) == run


def test_force_goes_on_and_says_so(study, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        stop_at(patch, 2)
        assert run(patch, capsys, *FIT)[0] == 130
    changed_input(study)
    again = stop_at(monkeypatch, -1)
    assert run(monkeypatch, capsys, *FIT, "--resume", "--force")[0] == 0
    assert again == [3, 3]
    made = json.loads((study / "out" / "provenance.json").read_text())
    assert made["run"]["forced"] == ["curves.csv has changed"]


def test_failed_lanes_are_fitted_again(peace, study, monkeypatch, capsys):
    """Lanes 1 and 5 are made to fail; the rerun gives them an estimate and touches no other bit."""
    shutil.copytree(peace / "out", study / "out")
    set_failed(study / "out" / "results.h5", [1, 5])
    before = tree(study / "out")
    with monkeypatch.context() as patch:
        stop_at(patch, 1)
        assert run(patch, capsys, *FIT, "--rerun-failed")[0] == 130
    assert tree(study / "out") == before
    seen = []
    real = fit.fit

    def fit_and_tell(part, settings, progress):
        seen.append((part.lanes.lower.shape[0], settings.starts, settings.seed))
        return real(part, settings, progress)

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", fit_and_tell)
    code, _, err = run(monkeypatch, capsys, *FIT, "--rerun-failed")
    assert code == 0, err
    assert seen == [(2, 8, 1)]
    old, new = numbers(peace / "out"), numbers(study / "out")
    for name in ("lanes/status", "lanes/specimen"):
        assert new[name] == old[name]
    shapes = np.frombuffer(old["unknowns/value"]).reshape(9, -1)
    found = np.frombuffer(new["unknowns/value"]).reshape(9, -1)
    others = [k for k in range(9) if k not in (1, 5)]
    assert np.array_equal(found[others], shapes[others])
    np.testing.assert_allclose(found[[1, 5]], shapes[[1, 5]], rtol=1e-6)
    code, _, err = run(monkeypatch, capsys, *FIT, "--rerun-failed")
    assert (code, "no lane of out failed" in err) == (0, True)


def set_failed(path, lanes):
    """Let a results.h5 say that lanes did not converge."""
    with h5py.File(path, "r+") as file:
        file["lanes/status"][lanes] = 3
        file["unknowns/value"][lanes] = 7.0


def load_peace(peace):
    set_up_jax()
    spec = load_fit_spec(peace / "spec.toml")
    return study_of(spec, read_data(spec, peace))


def test_results_are_read_back_bit_for_bit(peace, tmp_path):
    """What write_hdf5 and save wrote comes back; damaged, foreign and truncated shards do not."""
    study = load_peace(peace)
    result = read_hdf5(peace / "out" / "results.h5", study)
    lanes, path = np.arange(9), tmp_path / "0.npz"
    run_of_it = rerun.read_manifest(peace / "out" / "results.h5")
    shards.save(path, dataclasses.replace(run_of_it, id="me"), lanes, result)
    assert shards.read_manifest(path) == dataclasses.replace(run_of_it, id="me")
    found = shards.load(path, "me", lanes, study)
    assert found is not None
    expected = shards.arrays_of(result)
    for name, array in shards.arrays_of(found).items():
        assert array.dtype == expected[name].dtype
        assert array.tobytes() == expected[name].tobytes(), name
    parts = [shards.load(path, "me", lanes, study) for _ in range(2)]
    assert shards.join(study.take(np.tile(lanes, 2)), parts).lanes == 18
    assert shards.load(path, "another", lanes, study) is None
    assert shards.load(path, "me", lanes[::-1], study) is None
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 40).astype(int):
        path.write_bytes(whole[:length])
        assert shards.load(path, "me", lanes, study) is None
    # Within an array: a byte between them may be one that nobody reads.
    middle = whole.index(result.theta.tobytes()) + result.theta.nbytes // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    assert shards.load(path, "me", lanes, study) is None
    with pytest.raises(NoResults, match="another study"):
        read_hdf5(peace / "out" / "results.h5", study.take(lanes[:8]))


def test_sizes_of_shards(peace):
    """Equal shards; fewer lanes together where lanes are long or memory is short."""
    assert [len(c) for c in shards.divide(10, 4)] == [4, 3, 3]
    assert np.array_equal(np.concatenate(shards.divide(1000, 7)), np.arange(1000))
    study = load_peace(peace)
    assert shards.lanes_per_shard(study, 2) == 4096
    long = dataclasses.replace(study, lanes=study.lanes._replace(force=np.zeros((1, 2, 100_000))))
    assert shards.lanes_per_shard(long, 4) == 5
    each = study.bytes_per_lane
    on_cpu = jax.default_backend() == "cpu"
    most = 128 if on_cpu else 1024
    assert [shards.slots(study, m) for m in (0.0, 2.1 * each, 65.0 * each, 1e12)] == [
        *(1, 1, 32, most)
    ]
    long = dataclasses.replace(study, lanes=study.lanes._replace(force=np.zeros((1, 2, 2000))))
    assert long.batch_size(1000, 128) == (16 if on_cpu else 128)
    assert shards.slots(long, 1e12) == (16 if on_cpu else most)
    assert long.batch_size(1000, 4) == 4
    assert dataclasses.replace(long, joint=True).batch_size(1000, 128) == 128
    assert shards.free_memory(1) > 1e6


@pytest.mark.slow
def test_memory_of_a_lane_is_what_xla_counts(peace):
    """The estimate bounds XLA's own figure, by at most a factor of 3."""
    study, count = load_peace(peace), 32
    lanes = jax.tree.map(lambda v: np.repeat(v[:1], count, axis=0), study.lanes)
    objective = LaneCost(study.model, lanes, np.ones((count, 2)))
    state = levenberg_marquardt._idle(objective, count, np.float64)
    step = program(
        levenberg_marquardt._advance, levenberg_marquardt.Tolerances(), 4, axes=None, donate=(3,)
    )
    starts = np.zeros((count, study.size))
    lowered = step.lower(objective, starts, np.ones(count, bool), state)
    used = lowered.compile().memory_analysis()
    total = used.temp_size_in_bytes + used.argument_size_in_bytes
    assert total / count <= study.bytes_per_lane <= 3 * total / count


def test_devices_share_the_work_and_its_end():
    """Each item once; an error on one device ends the others after the item they are at."""
    device, done = jax.local_devices()[0], []
    checkpoint._in_threads(lambda k, _: done.append(k), list(range(20)), [device] * 3)
    assert sorted(done) == list(range(20))

    def fail(k, _):
        done.append(k)
        time.sleep(0.01)
        if k == 3:
            raise OSError("full")

    done.clear()
    with pytest.raises(OSError, match="full"):
        checkpoint._in_threads(fail, list(range(100)), [device] * 3)
    assert len(done) < 20


def test_a_cpu_works_with_all_the_cores_it_may_use(monkeypatch):
    """At most 8 unless the user says; where the system does not tell, all there are."""
    cpu = jax.local_devices(backend="cpu")[:1]
    monkeypatch.setattr(jax, "local_devices", lambda: cpu)
    for cores, workers in ((1, 1), (3, 3), (64, 8)):
        monkeypatch.setattr(
            os, "sched_getaffinity", lambda _, n=cores: set(range(n)), raising=False
        )
        assert shards.worker_devices() == cpu * workers
    assert shards.worker_devices(12) == cpu * 12
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert shards.worker_devices() == cpu * 5
    two = cpu * 2
    monkeypatch.setattr(jax, "local_devices", lambda: two)
    assert shards.worker_devices() == two
    with pytest.raises(ValueError, match="for one CPU; .* 2 of kind cpu"):
        shards.worker_devices(3)


def test_ctrl_c_ends_all_threads_and_waits_for_them():
    """Work under way is told and ends before the caller goes on, also when it comes twice."""
    device, under_way, ended = jax.local_devices()[0], threading.Barrier(3), []

    def work(k, told):
        under_way.wait()
        if k == 0:
            signal.raise_signal(signal.SIGINT)
        while not told.now:
            time.sleep(0.01)
        if k == 0:
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.5)
        ended.append(k)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            checkpoint._in_threads(work, list(range(9)), [device] * 3)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(ended) == [0, 1, 2]


@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_gives_the_same_bits(threads, peace, study, monkeypatch, capsys):
    seen, real = set(), fit.fit

    def watched(*arguments):
        seen.add(threading.get_ident())
        time.sleep(0.2)  # for the other threads to take theirs
        return real(*arguments)

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", watched)
    code, _, err = run(monkeypatch, capsys, *FIT, "--threads", str(threads))
    assert code == 0, err
    assert len(seen) == threads
    assert numbers(study / "out") == numbers(peace / "out")


def test_what_a_thread_raises_ends_the_fit_under_way_in_the_others(peace, study, monkeypatch):
    """At its next step, long before its shard is done."""
    loaded, asked, left = load_peace(study), threading.Barrier(3), []

    def working(study, settings, progress):
        if asked.wait() == 0:
            raise OSError(28, "full")
        for _ in range(1000):
            time.sleep(0.01)
            try:
                progress(0, 1)
            except BaseException as error:
                left.append(type(error).__name__)
                raise

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", working)
    monkeypatch.setattr(checkpoint, "_shards", lambda *_: np.arange(3)[:, None])
    monkeypatch.setattr(checkpoint, "fitted_lanes", lambda _, study: study)
    folder = object.__new__(run_folder.RunFolder)
    with pytest.raises(OSError, match="full"):
        checkpoint.fit_shards(folder, loaded, Settings(), [0, 1, 2], lambda *_: None, 3)
    assert left == ["_Ended", "_Ended"]


def test_processes_notice_each_other(tmp_path):
    """One that is through is waited for no longer; a silent one and one that failed are lost."""
    meetings = [Meeting(k, 2, "s", 1.0) for k in range(2)]
    first, second = (Watch(tmp_path, m) for m in meetings)
    assert processes.opened(tmp_path, meetings[1]) is None
    with first.watching(todo=[1, 2]):
        assert processes.opened(tmp_path, meetings[1])["todo"] == [1, 2]
        with second.watching():
            second.done()
            first.wait_for_others()
    silent = Watch(tmp_path, Meeting(0, 3, "s", 1.0))
    with pytest.raises(Lost, match="process 2 has been silent for 1 s"), silent.watching():
        silent.wait_for_others()
    with pytest.raises(Lost, match="process 0 stopped early"), Watch(
        tmp_path, Meeting(2, 3, "s", 9.0)
    ).watching() as third:  # fmt: skip
        third.wait_for(0)


@pytest.mark.slow
@pytest.mark.compiling
def test_no_cluster_is_said(study):
    code, _, err = finish(start(study, *FIT, "--distributed"))
    assert code == 2
    assert "no cluster found" in err
    assert "give --coordinator" in err
    assert not (study / "out").exists()


def begun(peace, study, monkeypatch, capsys):
    """Stop the study in its third shard; two are saved."""
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        assert run(patch, capsys, *FIT)[0] == 130


HOLD = """
import sys
from pathlib import Path
from jaxtrachea.files.lock import take
lock = take(Path("out"))
print("held", "jax" in sys.modules, flush=True)
sys.stdin.read()
"""


def test_two_runs_of_one_folder(peace, study, monkeypatch, capsys):
    """A process holds the folder: nobody else starts, resumes or reruns there.

    Killed, it holds nobody, though its file is still there.
    """
    begun(peace, study, monkeypatch, capsys)
    shutil.copytree(peace / "out", study / "finished")
    with subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held False\n"
        before = tree(study)
        # Reading is free; the second of two commands of any kind is told who is at work.
        for more in ((), ("--resume",), ("--resume", "--force"), ("--rerun-failed",)):
            code, _, err = run(monkeypatch, capsys, *FIT, *more)
            assert (code, len(err.splitlines())) == (2, 1), err
            assert f"out: another run is at work here (process {other.pid} on " in err
            assert "since 20" in err
            assert "go on with" not in err
            assert tree(study) == before
        other.kill()
    assert (study / "out" / run_lock.LOCK).exists()
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert (code, "2 of 3 shards are there" in err) == (0, True), err
    assert numbers(study / "out") == numbers(peace / "out")
    assert sorted(tree(study / "out")) == sorted(tree(peace / "out"))


def test_the_lock_lasts_as_long_as_the_run(study, monkeypatch, capsys):
    """From the first shard to the last file; new runs, too; and it is gone with the run."""
    seen, real = [], fit.fit

    def at_work(*_):
        with pytest.raises(run_lock.Busy, match=f"process {os.getpid()} on"):
            run_lock.take(study / "out")
        with pytest.raises(output.InUse, match="another run is at work"):
            output.new_directory(study / "out", study)
        seen.append(len(seen))

    def fit_and_look(*arguments):
        at_work()
        return real(*arguments)

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", fit_and_look)
    monkeypatch.setattr("jaxtrachea.report.plots.draw_all", lambda *_: at_work() or ([], {}))
    assert run(monkeypatch, capsys, *FIT)[0] == 0
    assert len(seen) == 4
    set_failed(study / "out" / "results.h5", [1])
    assert run(monkeypatch, capsys, *FIT, "--rerun-failed")[0] == 0
    assert len(seen) == 6
    assert not any((study / "out").glob(".*"))


def test_a_folder_that_another_run_takes_first(peace, tmp_path, monkeypatch):
    """Between a look at an empty folder and its lock: a run that is there, or has come and gone."""
    real, now = run_folder.take, rerun.read_manifest(peace / "out" / "results.h5")

    def late(folder):
        lock = real(folder)
        (folder / "results.h5").write_text("of the other")
        return lock

    monkeypatch.setattr(run_folder, "take", late)
    with pytest.raises(output.OutputExists, match="not empty"):
        run_folder.claim(tmp_path / "a", tmp_path, now)
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["results.h5"]
    # The file is removed between the opening and the lock of another: that one opens it anew.
    taken, first = run_lock._take, real(tmp_path)

    def overtaken(stream):
        monkeypatch.setattr(run_lock, "_take", taken)
        first.release()
        taken(stream)

    monkeypatch.setattr(run_lock, "_take", overtaken)
    second = real(tmp_path)
    with pytest.raises(run_lock.Busy):
        real(tmp_path)
    second.release()
    second.release()
    assert not (tmp_path / run_lock.LOCK).exists()


def test_a_file_system_without_locks(peace, study, monkeypatch, capsys):
    def no_locks(stream):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(run_lock, "_take", no_locks)
    code, _, err = run(monkeypatch, capsys, *FIT)
    assert (code, len(err.splitlines())) == (2, 1)
    assert "its file system has no locks (No locks available)" in err
    assert "--no-lock" in err
    assert run(monkeypatch, capsys, *FIT, "--no-lock")[0] == 0
    assert numbers(study / "out") == numbers(peace / "out")


def from_peace(folder):
    """Stand in for `fit.fit`: the same numbers, read back."""
    whole = read_hdf5(folder / "out" / "results.h5", load_peace(folder))
    names = [curves[0].specimen for curves in whole.study.curves]
    arrays = shards.arrays_of(whole)

    def fitted(study, settings, progress):
        rows = np.array([names.index(curves[0].specimen) for curves in study.curves])
        return shards.result_of(study, {name: v[rows] for name, v in arrays.items()})

    return fitted


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("code", "every"),
    [
        pytest.param(errno.ENOSPC, 1, marks=pytest.mark.slow, id="full"),
        pytest.param(errno.ENOSPC, 7, id="full, every 7th"),
        pytest.param(errno.EROFS, 6, marks=pytest.mark.slow, id="read-only"),
        pytest.param(errno.EROFS, 20, id="read-only, every 20th"),
    ],
)
def test_a_disk_that_fills_up(peace, study, monkeypatch, capsys, code, every):
    """Each write of a run in turn is the first that fails: one line, exit code 2, what was saved.

    With room again the run goes on to the same numbers. By default some of the writes.
    """
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", from_peace(peace))
    monkeypatch.setattr("jaxtrachea.cli.run.show", lambda *_: None)
    out, expected = study / "out", numbers(peace / "out")
    with Disk(out).watched() as disk:
        assert run(monkeypatch, capsys, *FIT)[0] == 0
    writes = disk.count
    assert writes > 20
    for first in range(1, writes + 1, every):
        shutil.rmtree(out)
        with Disk(out, first, code).watched() as disk:
            said, _, err = run(monkeypatch, capsys, *FIT)
        if said == 0:  # only what may be left undone
            assert numbers(out) == expected
            continue
        assert said == 2, err
        assert "Traceback" not in err
        assert os.strerror(code) in err.splitlines()[-1]
        kept = len(list(out.glob(".run/*.npz")))
        assert kept or not out.exists() or not any(out.iterdir())
        if kept:
            assert f"{kept} of 3 shards are kept in out" in err
            assert ("make room on the disk, then go on with --out out --resume" in err) == (
                code == errno.ENOSPC
            )
            assert not list(out.glob(".run/*.npz.*"))
        more = ("--resume",) if kept else ()
        again, _, err = run(monkeypatch, capsys, *FIT, *more)
        assert again == 0, (first, err)
        assert not kept or f"{kept} of 3 shards are there" in err or "are now in out" in err
        assert numbers(out) == expected
        assert sorted(tree(out)) == sorted(tree(peace / "out"))


def test_a_folder_that_became_read_only(peace, study, monkeypatch, capsys):
    """Resumed and rerun where nothing can be written: said with what is kept, nothing changed."""
    begun(peace, study, monkeypatch, capsys)
    shutil.copytree(peace / "out", study / "finished")
    set_failed(study / "finished" / "results.h5", [1])
    before = tree(study)
    for folder, option in (("out", "--resume"), ("finished", "--rerun-failed")):
        with Disk(study / folder, 1, errno.EROFS).watched():
            code, _, err = run(monkeypatch, capsys, *FIT[:3], folder, option)
        assert (code, len(err.splitlines())) == (2, 1), err
        assert f"{folder}: cannot be written (Read-only file system)" in err
        assert ("2 finished shards are kept there" in err) == (folder == "out")
        assert "copy it and go on in the copy" in err
        assert tree(study) == before
    with Disk(study / "finished", 1, errno.EROFS).watched():
        code, _, err = run(monkeypatch, capsys, *FIT[:3], "finished", "--resume")
    assert (code, "finished is finished" in err) == (0, True)


def test_hdf5_on_a_full_disk(tmp_path):
    """The HDF5 library itself ends the process there: files are put together in memory."""
    code = f"""
import resource
from pathlib import Path
from jaxtrachea.files.atomic import hdf5_file
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, resource.RLIM_INFINITY))
try:
    with hdf5_file(Path({str(tmp_path / "a.h5")!r})) as file:
        for k in range(20):
            file[f"a{{k}}"] = [1.0] * 500
except OSError as error:
    print(error.strerror)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "File too large\n", "")
    assert not any(tmp_path.iterdir())


def garbled(path):
    """run.json, damaged in one way after another; yields what is to be said of it."""
    text = path.read_text()
    for content in (text[: len(text) // 2], "", "\0\xff" * 40, "[1, 2]", "5", '{"schema": 1}',
                    text.replace('"lanes": 9', '"lanes": "9"'), "[" * 100_000):  # fmt: skip
        path.write_bytes(content.encode("latin-1"))
        yield
    path.unlink()
    yield


@pytest.mark.slow
@pytest.mark.compiling
def test_a_damaged_manifest_costs_no_shard(peace, study, monkeypatch, capsys):
    """Every shard holds the manifest of its run: rebuilt, still checked, and said."""
    begun(peace, study, monkeypatch, capsys)
    shutil.copytree(study / "out", study / "kept")
    path = study / "out" / ".run" / "run.json"
    fitted = from_peace(peace)
    for _ in garbled(path):
        (path.parent / "previous-run.json").unlink(missing_ok=True)
        with monkeypatch.context() as patch:
            changed_input(study)
            code, _, err = run(patch, capsys, *FIT, "--resume")
            assert (code, "curves.csv has changed" in err) == (2, True), err
            shutil.copy(peace / "curves.csv", study)
            asked = []
            patch.setattr(
                "jaxtrachea.fitting.fit.fit", lambda p, *a, n=asked: n.append(p) or fitted(p, *a)
            )
            code, _, err = run(patch, capsys, *FIT, "--resume")
        assert code == 0, err
        assert "its run.json cannot be read" in err
        assert "it was rebuilt from its 2 shards" in err
        assert len(asked) == 1
        assert numbers(study / "out") == numbers(peace / "out")
        shutil.rmtree(study / "out")
        shutil.copytree(study / "kept", study / "out")


def test_options_and_force_outlive_the_manifest(peace, study, monkeypatch, capsys):
    """What a resume added is in the copy of the manifest, or in the shards saved since.

    Without both and without shards nothing is lost, and the run starts anew.
    """
    begun(peace, study, monkeypatch, capsys)
    folder = study / "out" / ".run"
    changed_input(study)
    with monkeypatch.context() as patch:
        stop_at(patch, 1)
        assert run(patch, capsys, *FIT, "--resume", "--force", "--influence")[0] == 130
    text = (folder / "run.json").read_text()
    (folder / "previous-run.json").write_text(text)
    (folder / "run.json").write_text(text[:-30])
    found, note = run_folder.known_manifest(study / "out")
    assert found is not None
    assert (found.options, found.forced) == (["influence"], ["curves.csv has changed"])
    assert "rebuilt from its 2 shards" in note
    for path in folder.glob("*.npz"):
        path.unlink()
    assert run_folder.known_manifest(study / "out")[0] == manifest.from_dict(json.loads(text))
    (folder / "previous-run.json").unlink()
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", from_peace(peace))
    shutil.copy(peace / "curves.csv", study)
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert (code, "nothing was saved yet" in err) == (0, True), err
    assert numbers(study / "out") == numbers(peace / "out")


FILL = """
set -e
mount -t tmpfs -o size=$SIZE tmpfs disk
"$@" fit spec.toml --out disk/out && exit 9 || echo "first $?"
mount -o remount,size=20m disk
"$@" fit spec.toml --out disk/out $(test -d disk/out/.run && echo --resume)
cp -r disk/out done
"""


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("size", ["8k", "32k", "64k", "160k"])
def test_a_disk_that_is_really_full(peace, study, size):
    """A tiny file system of its own, filled by the run and then enlarged."""
    own = ["unshare", "--user", "--map-root-user", "--mount"]
    if shutil.which("unshare") is None or subprocess.run([*own, "true"]).returncode:
        pytest.skip("no file systems of one's own here")
    (study / "disk").mkdir()
    command = [*own, "sh", "-c", FILL, "sh", sys.executable, "-m", "jaxtrachea"]
    # What is compiled lies beside the full disk, and is there for the next size.
    kept = programs_kept(peace) | {"SIZE": size}
    done = subprocess.run(command, capture_output=True, text=True, cwd=study, env=os.environ | kept)
    assert done.returncode == 0, done.stderr
    assert "first 2" in done.stdout
    assert "No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
    whole = {name: v for name, v in numbers(peace / "out").items() if name != "report.md"}
    found = numbers(study / "done")
    assert {name: found[name] for name in whole} == whole


@pytest.mark.slow
@pytest.mark.compiling
def test_killed_runs_give_the_same_numbers(tmp_path):
    kill_often(tmp_path, 2)


def two(folder, *arguments):
    """The same command in two processes that meet on a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    meeting = ("--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process")
    return [start(folder, *arguments, *meeting, k) for k in range(2)]


@pytest.mark.slow
@pytest.mark.compiling
def test_two_processes_and_two_devices(peace, study):
    found = [finish(p) for p in two(study, *FIT)]
    assert [code for code, _, _ in found] == [0, 0], found
    assert numbers(study / "out") == numbers(peace / "out")
    # Added to those of `peace`: other code for the same sums rounds otherwise.
    devices = "--xla_force_host_platform_device_count=2"
    flags = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {devices}"}
    code, _, err = finish(start(study, *FIT[:3], "devices", **flags))
    assert code == 0, err
    assert numbers(study / "devices") == numbers(peace / "out")


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("lost", [0, 1])
def test_a_lost_process_ends_the_other(lost, tmp_path):
    """Exit code 3 and a clear line within the timeout; one process goes on alone."""
    write_study(tmp_path, 60, 3)
    pair = two(tmp_path, *FIT, "--heartbeat-timeout", 5)

    def there():
        return any((tmp_path / "out" / ".run").glob("*.npz"))

    wait_for(there, pair[lost])
    pair[lost].send_signal(signal.SIGKILL)
    since = time.monotonic()
    code, _, err = finish(pair[1 - lost])
    assert time.monotonic() - since < 20
    finish(pair[lost])
    assert code == 3, err
    assert f"process {lost} has been silent for 5 s; it is lost" in err
    assert "--resume" in err
    assert "Traceback" not in err
    code, _, err = finish(start(tmp_path, *FIT, "--resume"))
    assert code == 0, err
    assert "of 20 shards are there" in err
