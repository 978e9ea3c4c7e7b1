"""Runs of the command line that are stopped on the way, and what of their results must agree."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np

#: Files of a run that must not depend on how often it was stopped.
TABLES = ("summary.csv", "parameters.csv", "report.md")


def write_study(folder: Path, lanes: int, every: int, *, samples: int = 12, more: str = ""):
    """A study of `lanes` specimens, two presses each, in chunks of `every`; coupling `total`."""
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
        f"{text}[fit]\nstarts = 2\nchunk = 32\nsave_every = {every}\n{more}"
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


def start(folder: Path, *arguments, **more) -> subprocess.Popen:
    """`jaxtrachea ARGUMENTS` in a process of its own, programs kept in `folder`/cache."""
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from jaxtrachea.cli import main; sys.exit(main())"
    )
    kept = {
        "JAX_ENABLE_COMPILATION_CACHE": "true",
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "COLUMNS": "80",
    }
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


def wait_for(condition, process: subprocess.Popen, seconds: float = 120) -> None:
    """Return when something has happened, or the process has ended."""
    end = time.monotonic() + seconds
    while not condition() and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.01)


def kill_and_resume(folder: Path, name: str, after: float) -> tuple[int, str]:
    """Kill a run `after` seconds from the opening of its folder, then let it go on to its end.

    Returns:
        Chunks that were there after the kill (-1: it had ended), and what the resumed run said.
    """
    out = folder / name
    process = start(folder, "fit", "spec.toml", "--out", name)
    wait_for((out / ".run").exists, process)
    time.sleep(after)
    process.send_signal(signal.SIGKILL)
    finish(process)
    if not (out / ".run").exists() and (out / "results.h5").exists():
        return -1, ""
    done = len(list((out / ".run").glob("*.npz")))
    code, _, err = finish(start(folder, "fit", "spec.toml", "--out", name, "--resume"))
    assert code == 0, err
    return done, err


def kill_often(folder: Path, times: int, seed: int = 0) -> list[int]:
    """Kill and resume `times` runs at random moments; their numbers are those of one in peace.

    Returns:
        Chunks there after each kill.
    """
    write_study(folder, 100, 10)
    for name in ("first", "peace"):  # the second finds its programs compiled
        process = start(folder, "fit", "spec.toml", "--out", name)
        wait_for((folder / name / ".run").exists, process)
        begun = time.monotonic()
        assert finish(process)[0] == 0
        lasted = time.monotonic() - begun
    expected, rng, there = numbers(folder / "peace"), random.Random(seed), []
    for k in range(times):
        # Every other one early, among the chunks; the rest anywhere, also while files are written.
        latest = lasted if k % 2 else 0.4 * lasted
        done, said = kill_and_resume(folder, f"run{k}", rng.uniform(0, latest))
        assert numbers(folder / f"run{k}") == expected
        assert not any((folder / f"run{k}").glob(".*"))
        assert (f"{done} of 10 chunks are there" in said) == (done > 0)
        there.append(done)
    return there
