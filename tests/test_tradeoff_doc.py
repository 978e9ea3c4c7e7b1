"""docs/evidence/tradeoff.md says what the recorded measurements say."""

import importlib.util
from pathlib import Path

import pytest
from tradeoff_page import read
from tradeoff_text import measured

BENCH = Path(__file__).parent / "bench" / "tradeoff.py"
FOLDER = Path(__file__).parents[1] / "docs" / "evidence" / "tradeoff"
SCENES = sorted(p for p in FOLDER.glob("*.jsonl") if p.stem not in ("choice", "levels"))


def bench():
    spec = importlib.util.spec_from_file_location("bench_tradeoff", BENCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_document_is_what_the_measurements_give():
    module = bench()
    text = module.document()
    assert module.DOCUMENT.read_text("utf-8") == text, "run tests/bench/tradeoff.py --page"
    for path in SCENES:
        assert (FOLDER / f"{path.stem}.png").is_file()
        assert f"## {path.stem}\n" in text


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_measurements_are_complete(path):
    points = [row for row in read(path) if "left_out" not in row]
    for row in points:
        assert row["scene"] == path.stem
        assert {"device", "versions", "calls", "date"} <= row.keys()
        assert {"others", "load"} & row.keys()
        assert 0 < row["times"]["call"]["median"] <= row["times"]["call"]["p99"]
    for name in {row["ladder"] for row in points}:
        rungs = [row for row in points if row["ladder"] == name]
        finest = [row for row in rungs if row["finest"]]
        assert len(finest) == 1
        assert not any(v for v in finest[0]["errors"].values())
        assert len(rungs) > 1


def test_every_scene_has_its_ladders_and_choices():
    module = bench()
    names = {path.stem for path in SCENES}
    assert names == set(module.SCENES)
    chosen = [(row["scene"], row["tolerance"]) for row in read(FOLDER / "choice.jsonl")]
    for name in names:
        assert {v for scene, v in chosen if scene == name} >= {0.1, 0.01, 0.001}


def test_choices_hold_their_tolerance_and_are_no_dearer():
    rows = read(FOLDER / "choice.jsonl")
    assert rows
    for row in rows:
        errors = [row["errors"][k] for k in ("force", "joints", "surface")]
        assert max(v for v in errors if v is not None) <= row["tolerance"]
        assert (row["cost"]["high"] < 1) == bool(row["dropped"])
        assert (row["repeat"]["share"] < 1) == bool(row["dropped"])  # the page says so
        for rung in row["dropped"]:
            assert rung["error"] <= row["tolerance"]
        for rung in row["refused"]:
            assert float(rung["error"]) > row["tolerance"]


def test_every_run_has_a_line_of_its_own():
    """Two scenes of one run, one of another day and processor, by hand."""
    common = {"device": "cpu:0", "lanes": 0, "versions": {"jax": "1"}}
    old = common | {"date": "2026-01-01", "processor": "old", "calls": 1000, "load": 2.5}
    new = common | {"date": "2026-02-02", "processor": "new", "calls": 20, "others": 0.1}
    rows = [new | {"scene": "a"}, old | {"scene": "b"}, old | {"scene": "c"}]
    first, second = measured(rows).split("\n\n")
    assert first == (
        "a: measured 2026-02-02, cpu:0, new, others kept up to 0.1 cores busy, 20 calls, "
        "no batches; jax 1."
    )
    assert second.startswith("b, c: measured 2026-01-01, cpu:0, old, **load average up to 2.5")
    assert "1000 calls" in second
    assert measured(rows[:1]).startswith("Measured 2026-02-02, cpu:0, new")
    turns = [new | {"scene": "a", "turns": n} for n in (120, 37, 60)]
    assert "37 to 120 turns, no batches" in measured(turns)
    assert ", 120 turns, no" in measured(turns[:1])
    night = [new | {"scene": "a"}, new | {"scene": "a", "date": "2026-02-03"}]  # choices
    assert measured(night).startswith("a: measured 2026-02-02")
    one = [row | {"scene": "a", "ladder": name} for row, name in ((new, "dent"), (old, "rings"))]
    assert [line[:15] for line in measured(one).split("\n\n")] == [
        "dent: measured ",
        "rings: measured",
    ]


def test_levels_of_the_skeleton_are_there():
    rows = read(FOLDER / "levels.jsonl")
    assert {"mat", "punch", "softening", "sections", "sections, 90 deg"} <= {
        row["level"] for row in rows
    }
    for row in rows:
        assert row["call"] > 0
        assert row["lane"] > 0
