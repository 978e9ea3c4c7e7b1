"""Times of two checkouts in turns: shipped fit and scene, and a table of many specimens.

    python tests/bench/turns.py BEFORE AFTER [--rounds 7] [--cold 3] [--specimens 2000]
        [--label NAME]

Each sample is a command in a fresh process with the programs that two before it kept (a cache
folder for each checkout, emptied at the end) and that were optimised after the second, or, of the
cold ones, with an empty cache. All find compiled Python. Samples are taken in turns, and the first
of a pair alternates (A B, B A, ...). Given are wall seconds and processor seconds (user and system,
of all cores), which a busy machine moves less, medians, and the ratio of medians, after over
before.
The specimens are those of situations.py, clean, four positions of 60 samples.
`--specimens 0`, `--cold 0` leave out. Rows go to results/turns.jsonl under NAME, others stay there.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common
import numpy as np
import presses
import situations

SHIPPED, SCENE = "fits/virtual_trachea/fit.toml", "configs/normal.toml"


def write_cohort(folder: Path, count: int) -> Path:
    """The specification of a table of `count` clean specimens, written into a folder."""
    rng = np.random.default_rng(1)
    records = [
        record
        for specimen in situations.make_specimens(count, 1)
        for position in specimen.positions
        for record in situations.clean(situations.Press(specimen, position, rng))
    ]
    presses.write_csv(folder / "d.csv", records)
    (folder / "spec.toml").write_text('[data]\nfiles = "d.csv"\n')
    return folder / "spec.toml"


def timed(package: Path, what: tuple[str, Path], base: Path, cache: Path) -> tuple[float, float]:
    """Wall and processor seconds of one command, named with its file.

    Raises:
        RuntimeError: it ended with a code that is neither 0 nor 1 (some specimen failed).
    """
    with tempfile.TemporaryDirectory(dir=base) as out, open(base / "messages", "w+") as messages:
        command = [sys.executable, "-m", "jaxtrachea", what[0], str(what[1]), "--out", f"{out}/out"]
        environment = presses.environment(package, cache)
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        environment["PYTHONPYCACHEPREFIX"] = str(base / "compiled")
        begin = time.perf_counter()
        process = subprocess.Popen(
            command, cwd=out, env=environment, stdout=messages, stderr=messages
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in (0, 1):
            messages.seek(0)
            raise RuntimeError(f"{package}: exit code {process.returncode}\n{messages.read()}")
    return wall, usage.ru_utime + usage.ru_stime


def await_optimised(cache: Path) -> None:
    """Until no process optimises programs in the background; it has its lock within seconds."""
    time.sleep(10)
    while (cache / "jaxtrachea" / ".jaxtrachea-lock").exists():
        time.sleep(1)


def compare(case: str, command: str, specs: dict[str, Path], packages, base: Path, rounds: int):
    """A row of all samples of a case, and its ratios; the first two of each keep its programs."""
    samples = {name: [] for name in packages}
    order = list(packages)
    before = 1 if case.endswith("cold") else 2
    for i in range(rounds + before):
        for name in order:
            cache = base / f"cache_{name}"
            if case.endswith("cold"):
                shutil.rmtree(cache, ignore_errors=True)
            found = timed(packages[name], (command, specs[name]), base, cache)
            if i == 1 and before == 2:
                await_optimised(cache)
            if i >= before:
                samples[name].append(found)
            print(
                f"{case} {name} {i}: {found[0]:.2f} s wall, {found[1]:.2f} s processor", flush=True
            )
        order.reverse()
    row = {"kind": "row", "table": "turns", "case": case, "load": os.getloadavg()[0]}
    for j, clock in enumerate(("wall", "processor")):
        taken = {name: [round(v[j], 3) for v in values] for name, values in samples.items()}
        median = {name: statistics.median(values) for name, values in taken.items()}
        row[clock] = taken | {"ratio": round(median["after"] / median["before"], 4)}
    return row


def main() -> None:
    """All cases, and a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--cold", type=int, default=3)
    parser.add_argument("--specimens", type=int, default=2000)
    parser.add_argument("--label", default="", help="left out: nothing is written")
    asked = parser.parse_args()
    packages = {"before": asked.before.resolve(), "after": asked.after.resolve()}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        base = Path(name)
        fit = {name: path / SHIPPED for name, path in packages.items()}
        scene = {name: path / SCENE for name, path in packages.items()}
        cases = [
            ("shipped fit", "fit", fit, asked.rounds),
            ("shipped scene", "simulate", scene, asked.rounds),
            ("shipped fit, cold", "fit", fit, asked.cold),
        ]
        if asked.specimens:
            spec = dict.fromkeys(packages, write_cohort(base, asked.specimens))
            cases.append((f"{asked.specimens} specimens", "fit", spec, asked.rounds))
        rows = [
            compare(case, command, specs, packages, base, rounds)
            for case, command, specs, rounds in cases
            if rounds
        ]
    lines = []
    for row in rows:
        row["commits"] = {name: common.commit(path) for name, path in packages.items()}
        for clock in ("wall", "processor"):
            median = {name: statistics.median(row[clock][name]) for name in packages}
            cells = [f"{median[name]:.2f} s" for name in packages]
            lines.append([row["case"], clock, *cells, f"{row[clock]['ratio']:.3f}"])
    print(presses.markdown(["case", "time", "before", "after", "ratio of medians"], lines))
    if asked.label:
        presses.keep("turns", asked.label, asked.after, rows)


if __name__ == "__main__":
    main()
