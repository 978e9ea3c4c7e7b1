"""Runs of the command line that are stopped on the way, and what of their results must agree."""

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np

#: Files of a run that must not depend on how often it was stopped.
TABLES = ("summary.csv", "parameters.csv", "report.md")


def write_study(
    folder: Path, lanes: int, every: int, *, samples: int = 12, starts: int = 2, more: str = ""
):
    """A study of `lanes` specimens, two presses each, in shards of `every`; coupling `total`."""
    rng = np.random.default_rng(0)
    rows = ["specimen,trial,s [mm],displacement [mm],force [N]"]
    depth = np.linspace(0.1, 3, samples)
    for k in range(lanes):
        k_1, k_3 = np.exp(rng.normal(0, 0.5)), 0.1 * np.exp(rng.normal(0, 0.5))
        for trial, s in enumerate((30, 75)):
            force = (k_1 * depth + k_3 * depth**3) * (1 + 0.02 * rng.normal(size=samples))
            cells = zip(depth.tolist(), force.tolist(), strict=True)
            rows += [f"T{k:04d},{trial},{s},{d!r},{f!r}" for d, f in cells]
    (folder / "curves.csv").write_text("\n".join(rows) + "\n")
    text = '[data]\nfiles = "curves.csv"\n[model]\ncoupling = "total"\n'
    (folder / "spec.toml").write_text(
        f"{text}[fit]\nstarts = {starts}\nbatch = 32\nsave_every = {every}\n{more}"
    )


def numbers(folder: Path) -> dict[str, bytes]:
    """Everything a finished run says, less when and how: arrays and tables by name, as bytes."""
    found = {name: (folder / name).read_bytes() for name in TABLES}

    def keep(name, item):
        if isinstance(item, h5py.Dataset):
            found[name] = repr(item[()].tolist()).encode() if item.dtype == object else (
                item[()].tobytes()
            )  # fmt: skip

    with h5py.File(folder / "results.h5") as file:
        file.visititems(keep)
    return found


def programs_kept(folder: Path) -> dict[str, str]:
    """What lets processes share compiled programs, in `folder`/cache."""
    return {
        "JAX_ENABLE_COMPILATION_CACHE": "true",
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }


def start(folder: Path, *arguments, **more) -> subprocess.Popen:
    """`jaxtrachea ARGUMENTS` in a process of its own, programs kept in `folder`/cache."""
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from jaxtrachea.cli.main import main; sys.exit(main())"
    )
    kept = programs_kept(folder) | {"COLUMNS": "80"}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=folder,
        env=os.environ | kept | more,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen, seconds: float = 300) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    out, err = process.communicate(timeout=seconds)
    return process.returncode, out, err


def wait_for(
    condition, process: subprocess.Popen, seconds: float = 120, pause: float = 0.01
) -> None:
    """Return when something has happened, or the process has ended."""
    end = time.monotonic() + seconds
    while not condition() and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(pause)


def saved(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every saved shard: another where a shard was written again."""
    found = {}
    with contextlib.suppress(FileNotFoundError):  # a shard or the folder may go meanwhile
        for path in sorted((folder / ".run").glob("*.npz")):
            found[path.name] = (path.stat().st_ino, path.stat().st_mtime_ns)
    return found


def kill_and_resume(folder: Path, name: str, shards: int, after: float) -> tuple[int, int, str]:
    """Kill a run `after` seconds from its `shards`-th shard, then let it go on to its end.

    Returns:
        Shards that were there after the kill (-1: it had ended), starts that the resumed run
        fitted, and what it said. No shard that was there is written again.
    """
    out = folder / name
    process = start(folder, "fit", "spec.toml", "--out", name)
    wait_for((out / ".run").exists, process)
    wait_for(lambda: len(saved(out)) >= shards, process, pause=0.001)
    time.sleep(after)
    process.send_signal(signal.SIGKILL)
    finish(process)
    if not (out / ".run").exists() and (out / "results.h5").exists():
        return -1, 0, ""
    there = saved(out)
    process = start(folder, "fit", "spec.toml", "--out", name, "--resume")
    while process.poll() is None:
        now = saved(out)
        assert all(now[shard] == there[shard] for shard in now.keys() & there.keys())
        time.sleep(0.01)
    code, _, err = finish(process)
    assert code == 0, err
    fitted = re.search(r"fitting.*?(\d+)/(\d+|\?)", err)
    assert fitted, err
    return len(there), int(fitted[1]), err


def kill_often(folder: Path, times: int, seed: int = 0, *, lanes: int = 240) -> list[int]:
    """Kill and resume `times` runs; their numbers are those of one in peace.

    Four of five between two shards, at a random moment after a random one of them; the others
    anywhere, also while files are written.

    Returns:
        Shards there after each kill, out of 20 (-1: the run had ended).
    """
    starts, every = 24, lanes // 20
    write_study(folder, lanes, every, samples=60, starts=starts)
    for name in ("first", "peace"):  # the second finds its programs compiled
        process = start(folder, "fit", "spec.toml", "--out", name)
        wait_for((folder / name / ".run").exists, process)
        begun = time.monotonic()
        wait_for(lambda name=name: len(saved(folder / name)) == 20, process)
        fitting = time.monotonic() - begun
        assert finish(process)[0] == 0
        lasted = time.monotonic() - begun
    expected, rng, there = numbers(folder / "peace"), random.Random(seed), []
    for k in range(times):
        anywhere = k % 5 == 4
        shards = 0 if anywhere else rng.randrange(20)
        after = rng.uniform(0, lasted if anywhere else fitting / 20)
        done, fitted, said = kill_and_resume(folder, f"run{k}", shards, after)
        assert numbers(folder / f"run{k}") == expected
        assert not any((folder / f"run{k}").glob(".*"))
        if done >= 0:
            assert (f"{done} of 20 shards are there" in said) == (done > 0)
            assert fitted == starts * every * (20 - done)
        there.append(done)
    return there
