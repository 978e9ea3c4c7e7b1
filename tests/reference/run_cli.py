"""Run the command line inside the test process."""

import sys
from pathlib import Path

import pytest

from jaxtrachea.cli import main as cli

GOOD = """specimen,trial,s [mm],displacement [mm],force [N]
T01,1,35,0.0,0.00
T01,1,35,0.5,0.31
T01,1,35,1.0,0.66
T01,1,35,1.5,1.08
"""


def run(monkeypatch, capsys, *arguments):
    """Exit code, stdout and stderr of `jaxtrachea ARGUMENTS`."""
    monkeypatch.setattr(sys, "argv", ["jaxtrachea", *map(str, arguments)])
    monkeypatch.setenv("COLUMNS", "80")
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        cli.main()
    done = capsys.readouterr()
    return stop.value.code, done.out, done.err


def tree(folder: Path):
    """Everything below a folder, with the bytes of its files."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in sorted(folder.rglob("*"))
    }
