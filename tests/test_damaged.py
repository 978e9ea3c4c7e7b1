"""Damaged inputs of many kinds: each ends in a line with cause and cure, and harms nothing."""

import re
import resource
import subprocess
import sys
import time

import pytest
from damaged import CASES
from run_cli import run

#: Seconds of processor time and MB that refusing one input may take, whatever it declares;
#: measured 2.6 s (compiling) and 50 MB.
SECONDS, MEGABYTES = 20, 300
#: A message tells what is expected, or what to do.
CURE = re.compile(
    r"\b(accepted|add|check|choose|close|complete|convert|copy|correct|count|expected|export|"
    r"flatten|free|give|is its unit|keep|leave|list|make|move|must|name|needs|number|remove|"
    r"rename|save|set|split|store|swap|thin|update|use|write)\b",
    re.IGNORECASE,
)
#: What a message must never show: control characters, words of Python.
NEVER = re.compile(r"Traceback|Error:|NoneType|object at 0x|[\x00-\x08\x0b-\x1f\x7f]")


def entries(folder):
    """What lies in a folder; links, devices and pipes are not followed."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() and not p.is_symlink() else None
        for p in sorted(folder.rglob("*"))
    }


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with results of an earlier run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("years of work")
    return tmp_path


def is_helpful(case, err):
    """Few lines, each of which names the place, the cause and the cure."""
    lines = err.splitlines()
    assert 1 <= len(lines) <= 5
    told = [line for line in lines if not re.match(r"note: \d of \d curves go", line)]
    assert re.match("error: |not usable: ", told[0])
    assert not NEVER.search(err)
    assert max(map(len, lines)) < 700
    for words in case.says:
        assert words in err
    for line in lines:
        assert len(re.sub(r"^(error|not usable): ", "", line).split()) >= 6
        assert CURE.search(line) or "no usable curve" in line


@pytest.mark.parametrize("name", CASES)
def test_damaged(name, folder, monkeypatch, capsys):
    case = CASES[name]
    case.put(folder)
    before = entries(folder)
    began, used = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    code, out, err = run(monkeypatch, capsys, *case.command)
    seconds = time.process_time() - began
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used) / 1024
    assert code in case.codes, err
    if code:
        is_helpful(case, err)
    assert code != 2 or out == ""
    assert entries(folder) == before
    assert seconds < SECONDS
    assert grown < MEGABYTES


@pytest.mark.slow
@pytest.mark.compiling
def test_damaged_in_a_process(folder):
    """Where no check of shapes and no test settings help."""
    case = CASES["HDF5: bits flipped, seed 1"]
    case.put(folder)
    before = entries(folder)
    code = "from jaxtrachea.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *case.command], capture_output=True, text=True, timeout=60
    )
    assert done.returncode in case.codes
    is_helpful(case, done.stderr)
    assert entries(folder) == before


def test_there_are_many_kinds():
    assert len(CASES) >= 400
    assert len({name.partition(": ")[0] for name in CASES}) == 6
