"""Runs whose disk is full or read-only: one line says so, and what was saved is kept."""

import errno
import os
import shutil
import subprocess
import sys

import pytest
from full_disk import Disk
from interrupted import numbers
from run_cli import run, tree
from stopped import FIT, begun, from_peace, set_failed


@pytest.mark.slow
@pytest.mark.compiling
def test_a_disk_that_fills_up(peace, study, monkeypatch, capsys):
    """Some writes of a run are in turn the first that fails: one line, exit code 2, what was kept.

    With room again the run goes on to the same numbers.
    """
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", from_peace(peace))
    monkeypatch.setattr("jaxtrachea.cli.run.show", lambda *_: None)
    out, expected = study / "out", numbers(peace / "out")
    with Disk(out).watched() as disk:
        assert run(monkeypatch, capsys, *FIT)[0] == 0
    writes = disk.count
    assert writes > 20
    for first in range(1, writes + 1, 7):
        shutil.rmtree(out)
        with Disk(out, first, errno.ENOSPC).watched() as disk:
            said, _, err = run(monkeypatch, capsys, *FIT)
        if said == 0:  # only what may be left undone
            assert numbers(out) == expected
            continue
        assert said == 2, err
        assert "Traceback" not in err
        assert os.strerror(errno.ENOSPC) in err.splitlines()[-1]
        kept = len(list(out.glob(".run/*.npz")))
        assert kept or not out.exists() or not any(out.iterdir())
        if kept:
            assert f"{kept} of 3 shards are kept in out" in err
            assert "make room on the disk, then go on with --out out --resume" in err
            assert not list(out.glob(".run/*.npz.*"))
        more = ("--resume",) if kept else ()
        again, _, err = run(monkeypatch, capsys, *FIT, *more)
        assert again == 0, (first, err)
        assert not kept or f"{kept} of 3 shards are there" in err or "are now in out" in err
        assert numbers(out) == expected
        assert sorted(tree(out)) == sorted(tree(peace / "out"))


@pytest.mark.long
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
    """The HDF5 library itself ends the process there: it is not told."""
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
