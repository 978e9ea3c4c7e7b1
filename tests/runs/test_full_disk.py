"""Runs whose disk is full or read-only: one line says so, and what was saved is kept."""

import errno
import os
import shutil
import subprocess
import sys

import pytest
from full_disk import Disk
from interrupted import numbers, programs_kept
from run_cli import run, tree
from stopped import FIT, begun, from_peace, set_failed


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("code", "every"),
    [
        pytest.param(errno.ENOSPC, 7, id="full, every 7th"),
        pytest.param(errno.EROFS, 20, id="read-only, every 20th"),
    ],
)
def test_a_disk_that_fills_up(peace, study, monkeypatch, capsys, code, every):
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
@pytest.mark.parametrize("size", ["8k", "64k"])
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
