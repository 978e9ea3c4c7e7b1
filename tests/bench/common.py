"""What all benchmarks share: one pinned core, interleaved timing, JSON lines.

Importing this module pins the process to one core and makes every library in it single-threaded;
it must come before numpy and jax.
"""

import os

ALL_CORES = os.sched_getaffinity(0)
CORES = sorted(ALL_CORES)[-1:]
os.sched_setaffinity(0, CORES)
for _name in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{_name}_NUM_THREADS"] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["JAX_ENABLE_X64"] = "1"

import datetime  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
import statistics  # noqa: E402
import subprocess  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Mapping  # noqa: E402
from pathlib import Path  # noqa: E402

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "results"


def cpu_model() -> str:
    """Model name as the kernel gives it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


def versions(*names: str) -> dict[str, str]:
    """Installed versions; "not installed" where there is none."""
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def commit(root: Path = FOLDER.parents[1]) -> str:
    """Last that changed the package in the checkout `root`; "+" where its files differ from it.

    "unknown" without git.
    """
    package = ["--", "jaxtrachea"]
    try:
        last = _git(root, "log", "-1", "--format=%h", *package)
        dirty = bool(_git(root, "status", "--porcelain", *package))
        return last + "+" * dirty if last else "unknown"
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(root: Path, *words: str) -> str:
    command = ["git", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def compiler() -> str:
    """First line of `cc --version`."""
    return subprocess.run(
        ["cc", "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]


def interleaved(
    cases: Mapping[str, Callable[[], object]], *, rounds: int, target: float = 0.02
) -> dict[str, list[float]]:
    """Seconds per call of every case, one sample of each in turn (A B C A B C ...).

    Args:
        cases: functions that wait for their result.
        rounds: samples of each.
        target: wall time of one sample, s; fast functions are repeated within it.
    """
    repeats = {}
    for name, call in cases.items():
        call()
        call()
        start = time.perf_counter()
        call()
        repeats[name] = max(1, int(target / (time.perf_counter() - start)))
    samples: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, call in cases.items():
            count = repeats[name]
            call()  # Caches and memory as this case leaves them, not the one before.
            start = time.perf_counter()
            for _ in range(count):
                call()
            samples[name].append((time.perf_counter() - start) / count)
    return samples


class Writer:
    """Collects rows and writes them as one file of JSON lines, the environment first."""

    def __init__(self, suite: str, *packages: str):
        """Note the machine and the load at the start."""
        self.suite = suite
        self.rows = [
            {
                "kind": "environment",
                "suite": suite,
                "date": datetime.date.today().isoformat(),
                "commit": commit(),
                "cpu": cpu_model(),
                "cores_of_machine": os.cpu_count(),
                "cores_used": len(CORES),
                "compiler": compiler(),
                "versions": versions("jax", "jaxlib", "numpy", *packages),
            }
        ]

    def add(self, table: str, case: str, samples: list[float], **fields) -> None:
        """One row: seconds per call, all samples; further fields as given."""
        row = {"kind": "row", "table": table, "case": case, "load": os.getloadavg()[0]}
        self.rows.append(row | fields | {"samples": [float(f"{s:.5g}") for s in samples]})
        per = statistics.median(samples) / fields.get("lanes", 1)
        print(f"{self.suite} {table:12} {case:45} {per * 1e6:12.3f} us", flush=True)

    def table(self, table: str, samples: Mapping[str, list[float]], **fields) -> None:
        """One row per case; a field that is a dict is looked up by case."""
        for case, values in samples.items():
            own = {k: v[case] if isinstance(v, dict) else v for k, v in fields.items()}
            self.add(table, case, values, **own)

    def note(self, table: str, text: str) -> None:
        """A remark that the document must show."""
        self.rows.append({"kind": "note", "table": table, "text": text})

    def write(self) -> None:
        """Replace the results of this suite."""
        RESULTS.mkdir(exist_ok=True)
        path = RESULTS / f"{self.suite}.jsonl"
        path.write_text("".join(json.dumps(row) + "\n" for row in self.rows))


def close(name: str, found, expected, tolerance: float = 1e-8) -> float:
    """Largest difference relative to the largest expected entry; refuses what disagrees.

    Raises:
        AssertionError: the competitor does not compute the same thing.
    """
    import numpy as np

    found, expected = np.asarray(found), np.asarray(expected)
    error = float(np.max(np.abs(found - expected)) / np.max(np.abs(expected)))
    assert error < tolerance, f"{name}: differs by {error:.3g}"
    return error
