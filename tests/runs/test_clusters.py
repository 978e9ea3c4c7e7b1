"""Several processes: workers of a cluster, or two runs that want one folder."""

import errno
import os
import shutil
import signal
import subprocess
import sys

import pytest
from interrupted import numbers
from run_cli import run, tree
from stopped import FIT, begun, set_failed

from jaxtrachea.files import lock as run_lock
from jaxtrachea.files import output
from jaxtrachea.fitting import fit
from jaxtrachea.runs import cluster as cluster_runs
from jaxtrachea.runs import folder as run_folder
from jaxtrachea.runs import rerun, shards

pytestmark = pytest.mark.long


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Two worker processes of one thread that load the programs of `peace`'s kind themselves."""
    distributed, dask = map(pytest.importorskip, ("distributed", "dask"))
    config = {"distributed.scheduler.worker-saturation": 1.0, "distributed.admin.log-length": 0}
    with dask.config.set(config), distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as found:  # fmt: skip
        yield found


@pytest.mark.slow
@pytest.mark.compiling
def test_workers_of_a_cluster(peace, study, cluster, monkeypatch, capsys):
    """The same bits as one process, although one of two workers is killed while it fits."""
    killed, real = [], shards.save

    def save_and_kill(path, *arguments):
        real(path, *arguments)
        if not killed:
            killed.append(cluster.workers[1].pid)
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr("jaxtrachea.runs.cluster.save", save_and_kill)
    code, _, err = run(monkeypatch, capsys, *FIT, "--scheduler", cluster.scheduler_address)
    assert (code, len(killed)) == (0, 1), err
    assert numbers(study / "out") == numbers(peace / "out")


def test_a_worker_with_other_versions_fits_nothing():
    here = cluster_runs.computes_with()
    cluster_runs.refuse_other(here)
    with pytest.raises(cluster_runs.NoCluster, match="a worker on .* has jax [0-9.]+; install"):
        cluster_runs.refuse_other(here | {"jax": "0.1"})


def test_a_cluster_that_is_not_there(study, monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.setattr("jaxtrachea.runs.cluster.PATIENCE", 0.5)
    code, _, err = run(monkeypatch, capsys, *FIT, "--scheduler", "127.0.0.1:1")
    assert (code, len(err.splitlines())) == (2, 1), err
    assert "no scheduler answers at 127.0.0.1:1" in err
    assert "start one with 'dask scheduler'" in err
    assert not (study / "out").exists()
    code, _, err = run(monkeypatch, capsys, *FIT, "--scheduler", "h:1", "--threads", "2")
    assert code == 2
    assert "--threads is of this process" in err


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
