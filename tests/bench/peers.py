"""Times ours beside other programs, in one run. Run: python tests/bench/peers.py.

Calls pytest with test_peers.py and writes of every case and turn the median and the smallest
sample to results/peers.jsonl, then docs/evidence/benchmarks.md anew. What cannot be loaded is left
out and the results say why.
"""

import json
import sys
import tempfile
from pathlib import Path

import common
import pytest
import report

PACKAGES = ("scipy", "openseespy", "PyNiteFEA", "scikit-fem", "coal", "lmfit", "pytest-benchmark")
OPTIONS = (
    *("--noconftest", "--import-mode=prepend", "-o", "addopts=", "-p", "no:cacheprovider"),
    *("-p", "no:xdist", "-q", "--benchmark-quiet", "--benchmark-disable-gc"),
    # A round is at least 2 ms of calls; a case gets 0.2 s or five rounds a turn.
    *("--benchmark-min-time=0.002", "--benchmark-max-time=0.2", "--benchmark-min-rounds=5"),
    *("--benchmark-warmup=on", "--benchmark-warmup-iterations=20"),
)


class Skipped:
    """Plugin that remembers why cases were left out."""

    def __init__(self):
        """Nothing so far."""
        self.reasons: list[str] = []

    def pytest_runtest_logreport(self, report):
        """Take the reason of what was skipped, once."""
        if report.skipped:
            reason = report.longrepr[2].removeprefix("Skipped: ")
            self.reasons += [reason] if reason not in self.reasons else []


def row(timed: dict) -> dict:
    """What is kept of one case and turn; seconds per call."""
    stats = {name: timed["stats"][name] for name in ("median", "min", "rounds")}
    told = {"kind": "row", "table": "peers"} | timed["extra_info"] | stats
    return {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in told.items()}


def main() -> int:
    """Measure, and write if everything agreed."""
    out, skipped = common.Writer("peers", *PACKAGES), Skipped()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "peers.json"
        what = [str(common.FOLDER / "test_peers.py"), f"--benchmark-json={path}"]
        code = pytest.main([*what, *OPTIONS], plugins=[skipped])
        if code != pytest.ExitCode.OK:
            return int(code)
        out.rows += [row(timed) for timed in json.loads(path.read_text())["benchmarks"]]
    for reason in skipped.reasons:
        out.note("peers", reason)
    out.write()
    report.DOCUMENT.write_text(report.document())
    return 0


if __name__ == "__main__":
    sys.exit(main())
