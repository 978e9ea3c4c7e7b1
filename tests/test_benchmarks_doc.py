"""docs/benchmarks.md says what the recorded measurements say."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parent / "bench"


def report():
    sys.path[:0] = [] if str(BENCH) in sys.path else [str(BENCH)]
    spec = importlib.util.spec_from_file_location("bench_report", BENCH / "report.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_document_is_what_the_results_give():
    module = report()
    assert module.DOCUMENT.read_text() == module.document(), "run python tests/bench/report.py"


@pytest.mark.parametrize("suite", ["skeleton", "fitting", "startup", "growth", "gradient"])
def test_results_name_their_machine_and_keep_every_sample(suite):
    environment, rows = report().read(suite)
    assert {"cpu", "cores_used", "versions", "date"} <= environment.keys()
    assert environment["cores_used"] == 1
    for row in rows:
        assert json.dumps(row)
        if row["kind"] == "row":
            assert len(row["samples"]) >= 3
            assert row["load"] >= 0


def test_competitors_agree_with_us():
    for suite in ("skeleton", "fitting"):
        for row in report().read(suite)[1]:
            assert (row.get("error") or 0) < 1e-8
            assert row.get("missed", 0) == 0
