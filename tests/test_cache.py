"""Programs kept for the next start: the bounds of their folder, and the command that tells."""

import atexit
import os
from pathlib import Path

import pytest
from jax import monitoring
from run_cli import run

from jaxtrachea.files import programs as kept

DAY = 86_400.0
NOW = 1.9e9


def program(folder, name, size, days, kind="cache"):
    path = folder / f"jit_{name}-{'0a' * 32}-{kind}"
    path.write_bytes(b"x" * size)
    os.utime(path, (NOW - days * DAY,) * 2)


def names(folder):
    return sorted(path.name.removeprefix("jit_").split("-")[0] for path in folder.iterdir())


def test_bounds_of_size_and_age(tmp_path, monkeypatch):
    """300 bytes, newest first: 100 + 150 fit, 100 more do not; a year is too long."""
    monkeypatch.setattr(kept, "MOST_BYTES", 300)
    for name, size, days in (("new", 100, 1), ("used", 150, 2), ("old", 100, 3), ("year", 1, 365)):
        program(tmp_path, name, size, days)
    (tmp_path / "other.txt").write_text("not ours")
    os.utime(tmp_path / "other.txt", (0, 0))
    assert kept.keep_bounds(tmp_path, NOW) == 2
    assert names(tmp_path) == [kept.LAST_LOOK, "new", "other.txt", "used"]


def test_what_was_read_lately_is_kept(tmp_path):
    """Written a year ago, read yesterday."""
    program(tmp_path, "read", 10, 365)
    (path,) = tmp_path.iterdir()
    os.utime(path, (NOW - DAY, NOW - 365 * DAY))
    assert kept.keep_bounds(tmp_path, NOW) == 0


def test_bounds_are_looked_at_once_a_day(tmp_path):
    assert kept.keep_bounds(tmp_path, NOW) == 0
    os.utime(tmp_path / kept.LAST_LOOK, (NOW, NOW))
    program(tmp_path, "year", 1, 365)
    assert kept.keep_bounds(tmp_path, NOW + DAY - 1) == 0
    assert kept.keep_bounds(tmp_path, NOW + DAY + 1) == 1


def test_uses_of_the_last_command(tmp_path):
    """Two loaded; of three compiled one is new, two were kept already: refused."""
    assert kept.last_uses(tmp_path) is None
    program(tmp_path, "here", 10, 1)
    write = kept.count_uses(tmp_path)
    for event, times in (("cache_hits", 2), ("compile_requests_use_cache", 5)):
        for _ in range(times):
            monitoring.record_event(f"/jax/compilation_cache/{event}")
    program(tmp_path, "new", 10, 0)
    program(tmp_path, "trace", 10, 0, "traced")
    write()
    atexit.unregister(write)
    assert kept.last_uses(tmp_path) == (2, 3, 2)


def test_other_files_are_no_programs(tmp_path):
    (tmp_path / "my-cache").write_text("notes")
    (tmp_path / "what-was-traced").write_text("notes")
    (tmp_path / f"jit_f-{'0' * 64}-cache").mkdir()
    assert list(kept.programs(tmp_path)) == []


def test_what_a_killed_process_left_goes_too(tmp_path):
    program(tmp_path, "year", 1, 365, "traced.4711")
    assert kept.keep_bounds(tmp_path, NOW) == 1
    assert names(tmp_path) == [kept.LAST_LOOK]


def test_a_folder_that_is_not_there(tmp_path):
    assert kept.keep_bounds(tmp_path / "none", NOW) == 0
    assert list(kept.programs(tmp_path / "none")) == []


def test_command(tmp_path, monkeypatch, capsys):
    import jax

    from jaxtrachea.cli import cache as command

    monkeypatch.setattr(command, "programs_folder", lambda: tmp_path)
    program(tmp_path, "a", 2**20, 1)
    program(tmp_path, "b", 2**19, 1, "traced")
    code, out, err = run(monkeypatch, capsys, "cache")
    assert (code, err) == (0, "")
    assert f"1 compiled programs and 1 traces, 1.5 MiB, in {tmp_path}" in out
    code, out, _ = run(monkeypatch, capsys, "cache", "--clear")
    assert code == 0
    assert f"2 of 2 programs and traces deleted from {tmp_path}" in out
    assert names(tmp_path) == []
    monkeypatch.undo()
    assert not jax.config.values["jax_enable_compilation_cache"]  # in all tests
    code, _, err = run(monkeypatch, capsys, "cache")
    assert code == 2
    assert "no compiled programs are kept" in err
    assert "XDG_CACHE_HOME" in err


@pytest.mark.parametrize("name", ["XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"])
def test_where_programs_are_kept(name, tmp_path):
    """A folder that the user chose is left alone; that of the package is kept within bounds."""
    import subprocess
    import sys

    folder = tmp_path / "jaxtrachea" if name == "XDG_CACHE_HOME" else tmp_path
    folder.mkdir(exist_ok=True)
    program(folder, "year", 1, 3650)
    kept_on = {"JAX_ENABLE_COMPILATION_CACHE": "true", name: str(tmp_path), "JAX_PLATFORMS": "cpu"}
    code = "from jaxtrachea.cli.terminal import *; set_up_jax(); print(programs_folder())"
    environment = {k: v for k, v in os.environ.items() if "CACHE" not in k} | kept_on
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert Path(done.stdout.strip()) == folder
    assert ("year" in names(folder)) == (name == "JAX_COMPILATION_CACHE_DIR")


def test_an_empty_name_keeps_none(monkeypatch):
    """As jax reads it."""
    import jax

    from jaxtrachea.cli.terminal import programs_folder

    found = {"jax_enable_compilation_cache": True, "jax_compilation_cache_dir": ""}
    monkeypatch.setattr(type(jax.config), "values", property(lambda config: found))
    assert programs_folder() is None
