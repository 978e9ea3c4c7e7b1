"""docs/evidence/benchmarks.md says what the recorded measurements say."""

import ast
import contextlib
import importlib
import importlib.util
import itertools
import json
from pathlib import Path

import pytest

BENCH = Path(__file__).parent / "bench"


def report(name: str = "report"):
    spec = importlib.util.spec_from_file_location(f"bench_{name}", BENCH / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCH)
        spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted(BENCH.glob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_use_what_the_package_has(path):
    """They are run by hand, with packages that the tests have not: only imports are looked at."""
    sources = [ast.parse(path.read_text())]
    for node in ast.walk(sources[0]):  # programs of other processes are strings
        if isinstance(node, ast.Constant) and "import" in str(node.value):
            with contextlib.suppress(SyntaxError):
                sources.append(ast.parse(node.value))
    for node in itertools.chain(*map(ast.walk, sources)):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("jaxtrachea"):
            module = importlib.import_module(node.module)
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")


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


def test_every_peer_has_the_turns_that_we_have_and_agrees():
    rows = [r for r in report().read("peers")[1] if r["kind"] == "row"]
    turns = {}
    for r in rows:
        turns.setdefault(r["group"], {}).setdefault(r["case"], []).append(r["turn"])
        smooth = r["group"].startswith(("contact", "whole"))
        assert (r["error"] or 0) < (0.05 if smooth else 1e-3 if r["group"] == "fit" else 1e-8)
    assert len(turns) >= 5
    for cases in turns.values():
        assert len(cases) >= 2
        assert len(cases["jaxtrachea"]) >= 5
        assert all(found == cases["jaxtrachea"] for found in cases.values())


def test_ratio_to_a_peer_is_taken_within_a_turn():
    ours = [{"turn": i, "lanes": 2, "median": t} for i, t in enumerate([1.0, 4.0, 16.0])]
    peer = [{"turn": i, "lanes": 10, "median": t} for i, t in enumerate([20.0, 40.0, 480.0])]
    # Per problem 2 / 0.5, 4 / 2 and 48 / 8.
    assert report("report_peers").ratios(ours, peer[::-1]) == [6.0, 2.0, 4.0]
