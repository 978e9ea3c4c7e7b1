"""Figure 7 of the paper: the page's statements, and its numbers."""

import importlib.util
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs" / "evidence"
# Compiles every level of the rings.
pytestmark = [pytest.mark.slow, pytest.mark.compiling]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("paper_figures", DOCS / "paper_figures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_statements(script):
    facts = script.facts()
    assert set(facts["largest_load"].values()) == {6}
    assert facts["largest_load_arch"] == 6
    assert facts["P_x_spread"] < 1e-12
    assert facts["d_x_bend"] < 1e-12
    side_A, side_B = facts["P_x_sides"]
    assert abs(side_A / side_B - 100 / 60) < 1e-12
    assert facts["d_y"][0] > facts["d_y"][1] > 0 > min(facts["d_y"])
    assert facts["opening"] > 0


def test_page(script):
    assert (DOCS / "paper_figures.md").read_text(encoding="utf-8") == script.document()
    for letter in "abc":
        assert (DOCS / "figures" / f"fig_7{letter}.png").stat().st_size < 100_000
        assert (DOCS / "figures" / f"fig_6{letter}.png").stat().st_size < 150_000
