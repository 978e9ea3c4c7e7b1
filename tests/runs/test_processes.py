"""Several processes: they share one run, or keep out of the folder of another."""

import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from interrupted import finish, numbers, start, wait_for, write_study
from run_cli import run, tree
from stopped import FIT, begun, set_failed

from jaxtrachea.files import lock as run_lock
from jaxtrachea.files import output
from jaxtrachea.fitting import fit
from jaxtrachea.runs import folder as run_folder
from jaxtrachea.runs import processes, rerun
from jaxtrachea.runs.processes import Lost, Meeting, Watch


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
