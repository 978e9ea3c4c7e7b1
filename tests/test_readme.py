"""What the README shows is run: its Python, its commands. Other pages: `test_docs.py`."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxtrachea.measurements.read import read_measurements

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def shell_lines():
    return re.findall(r"^    (\S.*)$", README, re.M)


def test_two_commands_install_and_the_second_is_what_ci_runs():
    install = [line for line in shell_lines() if "pip install" in line]
    assert len(install) == 2
    assert "jaxtrachea fit fits/virtual_trachea/fit.toml" in install[0]
    assert install[1] in (ROOT / ".ci" / "run").read_text().splitlines()


@pytest.mark.long
def test_fit_from_python_runs_and_finds_what_the_source_states(tmp_path):
    """Ten lines at most; the force at 75 mm is near the finite-element specimen's there."""
    code = blocks("python")[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    assert re.search(r"k_M +N/mm +0\.\d+ .* identifiable", run.stdout)
    force = float(re.search(r"\[\S+ +(\S+)\] N", run.stdout)[1])
    read = read_measurements(ROOT / "fits" / "virtual_trachea" / "small_strain.h5")
    measured = [np.interp(0.1, c.displacement, c.force) for c in read.curves if c.s_c == 75.0]
    assert force == pytest.approx(np.mean(measured), rel=0.1)
