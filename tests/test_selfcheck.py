"""The table of hard cases and the command that runs it."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hard_cases_page import page, skeleton
from run_cli import run

from jaxtrachea.selfcheck import table
from jaxtrachea.selfcheck.assess import gap_of
from jaxtrachea.selfcheck.functions import FUNCTIONS
from jaxtrachea.selfcheck.run import run_table

CASES, TRUTHS = table.read_cases(), table.read_truth()
DOCUMENT = Path(__file__).parents[1] / "docs" / "evidence" / "hard_cases.md"
#: Functions whose programs compile at once; the others are slow tests.
QUICK = ("series", "quintic", "first_touch", "axial")
#: Their programs are those of users; the others are compiled without optimisation.
OPTIMISED = ("vector", "beam")


def wrong(outcomes):
    return [o for o in outcomes if not o.passed]


@pytest.mark.long
def test_quick_functions():
    rows = [c for c in CASES if c.function in QUICK]
    assert not wrong(run_table(rows, TRUTHS, table.DTYPES, unoptimised=True))


@pytest.mark.slow
def test_optimised_functions():
    rows = [c for c in CASES if c.function in OPTIMISED]
    assert not wrong(run_table(rows, TRUTHS, table.DTYPES))


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("part", range(3))
def test_other_functions(part):
    others = [f for f in FUNCTIONS if f not in QUICK + OPTIMISED]
    rows = [c for c in CASES if c.function in others[part::3]]
    assert not wrong(run_table(rows, TRUTHS, table.DTYPES, unoptimised=True))


def test_table_is_whole():
    """Names once, every function used, every answer with a truth made for its very inputs."""
    names = [c.name for c in CASES]
    assert len(set(names)) == len(names)
    assert {c.function for c in CASES} == set(FUNCTIONS)
    assert set(TRUTHS) == {c.name for c in CASES if c.answer}
    for case in CASES:
        if case.answer:
            assert TRUTHS[case.name].inputs == {n: repr(v) for n, v in case.inputs.items()}


def test_spread_of_values_is_that_of_their_jacobian():
    """Where no input is free, an angle or one of positions on a line: sum |x dy/dx|, both kept."""
    seen = 0
    for case in CASES:
        if not case.answer or case.free or case.spans or case.angles or case.entrywise:
            continue
        truth = TRUTHS[case.name]
        for output, by in truth.gradient.items():
            size = truth.value[output].size
            moves = sum(np.abs(d.reshape(size, -1) * np.ravel(case.inputs[i])).sum(1)
                        for i, d in by.items())  # fmt: skip
            np.testing.assert_allclose(truth.spread[output], np.max(moves), 5.1e-3, 1e-30)
            seen += 1
    assert seen > 100


@pytest.mark.parametrize("times", [0.9, 1.1])
def test_limit_is_8_roundings_of_size_and_spread(times):
    """An error just within the limit passes, one just beyond fails; exact by the definition."""
    case = next(c for c in CASES if c.name == "softening, 2 % before the fold")
    truth = TRUTHS[case.name]
    size, spread = truth.value["force"], truth.spread["force"]
    assert spread > 30 * size
    got = size + times * 8 * 2.0**-52 * (size + spread)
    gap = gap_of(case, "force", np.float64(got), size, spread)
    assert (gap.over / case.tolerance["float64"].value > 1) == (times > 1)


def test_exceptions_are_few():
    assert {c.name for c in CASES if c.tolerance["float64"].why and c.function != "dent"} == {
        "two rigid rings 1e-3 mm apart"
    }


def test_document_follows_the_table():
    text = DOCUMENT.read_text()
    assert skeleton(text) == skeleton(page(CASES, [])), "run tests/reference/hard_cases_page.py"
    assert "; 0 numbers that are not finite where they must be." in text
    cells = re.findall(r"\| ([0-9.e+-]+) of ([0-9.e+-]+) (?=\|)", text)
    assert len(cells) > 400
    assert all(float(error) <= float(limit) for error, limit in cells)


def test_every_kind_of_fault_is_seen():
    """A wrong value, derivative or status each fail the row that has it, and no other."""
    case = next(c for c in CASES if c.name == "k_3 = 0")
    truth = TRUTHS[case.name]
    far = dataclasses.replace(
        truth, value=truth.value | {"force": np.asarray(truth.value["force"] * 1.0001)}
    )
    bent = {o: dict(by) for o, by in truth.gradient.items()}
    bent["force"]["c"] = np.asarray(bent["force"]["c"] * 1.0001)
    steep = dataclasses.replace(truth, gradient=bent)
    rows = [
        case,
        dataclasses.replace(case, name="value"),
        dataclasses.replace(case, name="gradient"),
        dataclasses.replace(case, name="status", status="PULLS"),
        dataclasses.replace(case, name="answer", answer=False),
        dataclasses.replace(case, name="truth"),
    ]
    truths = {case.name: truth, "value": far, "gradient": steep, "status": truth}
    found = {o.case: o for o in run_table(rows, truths, ["float64"], unoptimised=True)}
    assert [o.case for o in wrong(found.values())] == [r.name for r in rows[1:]]
    assert found["value"].value > 1 >= found["value"].gradient
    assert found["gradient"].gradient > 1 >= found["gradient"].value
    assert found["gradient"].gradient_gap.where == "force by c"


def test_command(monkeypatch, capsys, tmp_path):
    """Exit 0 and a file; with a wrong truth exit 1, and the row is named."""
    one = ("selfcheck", "--only", "k_3 = 0", "--dtype", "float64", "--quick")
    folder = tmp_path / "out"
    code, out, _ = run(monkeypatch, capsys, *one, "--out", folder)
    assert code == 0
    assert "1 cases, 1 rows: all within tolerance" in out
    made = json.loads((folder / "selfcheck.json").read_text())
    assert made["rows"][0]["passed"]
    truth = TRUTHS["k_3 = 0"]
    far = dataclasses.replace(truth, value=truth.value | {"force": np.asarray(1.0)})
    monkeypatch.setattr(table, "read_truth", lambda: {"k_3 = 0": far})
    code, out, _ = run(monkeypatch, capsys, *one)
    assert code == 1
    assert "FAILED" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "carin"], "similar: "),
        (["--only", "nothing"], "functions: series"),
        (["--dtype", "float16"], "float32, float64 or both"),
        (["--only", "EI_L = 1e-9", "--dtype", "float32"], "none of these cases"),
        (["--out", "."], "exists"),
    ],
)
def test_misuse_is_named(monkeypatch, capsys, arguments, words):
    code, out, err = run(monkeypatch, capsys, "selfcheck", *arguments)
    assert code == 2
    assert words in err
    assert not out
