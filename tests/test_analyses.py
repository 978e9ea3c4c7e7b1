"""An analysis is one record: what it says stands in every file of a run, and nowhere else."""

import csv
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pytest
from run_cli import GOOD, run

from jaxtrachea.cli.main import app
from jaxtrachea.config import SpecError, UncertaintySection
from jaxtrachea.files.table import Table
from jaxtrachea.inference import analyses
from jaxtrachea.inference.analysis import Analysis, Unavailable

SPEC = '[data]\nfiles = "good.csv"\n[model]\ncoupling = "total"\n'


def draw():
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots()
    return figure


def refuse(request):
    raise SpecError("--toy: not today")


class Played(NamedTuple):
    """What is found."""

    lanes: int

    @property
    def twice(self):
        return np.array([2 * self.lanes])


#: Finds the number of lanes, and says it in every way there is.
TOY = Analysis(
    name="toy",
    compute=lambda request, findings, progress: Played(findings.result.lanes),
    work="playing",
    asked=lambda request: True,
    tables=lambda found: {"toy.csv": Table([{"lanes": found.lanes}])},
    lane_cells=lambda found, lane: {"played": lane + 100},
    parameter_cells=lambda found, lane, i: {"toy": 10 * lane + i},
    datasets=("twice",),
    attributes=("lanes",),
    table=lambda found, lanes: Table([{"played": found.lanes}], title="Toys"),
    section=lambda found: [f"{found.lanes} lanes were played with."],
    warning=lambda found: ["Toys are **no** tools."],
    sentences=lambda found: [f"{found.lanes} toys"],
    figures=lambda found: {"toy.png": draw},
    unreliable=lambda found: True,
)


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """The command `fit` on a small study, with these analyses alone."""
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    Path("spec.toml").write_text(SPEC)

    def fit(*wanted):
        monkeypatch.setattr(analyses, "ANALYSES", wanted)
        return run(monkeypatch, capsys, "fit", "spec.toml", "--out", "out")

    return fit


def test_one_record_is_all_that_a_new_analysis_takes(command):
    """Columns, files, sections, datasets, picture, terminal, progress and exit code."""
    code, out, err = command(TOY)
    assert code == 1
    assert "toys" in out
    assert "Toys are no tools." in out
    assert "playing" in err
    text = Path("out/report.md").read_text()
    assert "lanes were played with." in text
    assert text.index("Toys are **no** tools.") < text.index("## Quality") < text.index("## Toys")
    assert Path("out/toy.png").read_bytes()[:4] == b"\x89PNG"
    with h5py.File("out/results.h5") as file:
        lanes = len(file["lanes/status"])
        assert file["toy/twice"][()].tolist() == [2 * lanes]
        assert file["toy"].attrs["lanes"] == lanes
    assert f"## Toys\n\n| played |\n| --- |\n| {lanes} |\n\n{lanes} lanes" in text
    with Path("out/parameters.csv").open(newline="") as stream:
        cells = [row["toy"] for row in csv.DictReader(stream)]
    assert cells == [str(10 * lane + i) for lane in range(lanes) for i in range(2)]
    with Path("out/summary.csv").open(newline="") as stream:
        cells = [row["played"] for row in csv.DictReader(stream)]
    assert cells == [str(lane + 100) for lane in range(lanes)]
    assert Path("out/toy.csv").read_text().split() == ["lanes", str(lanes)]


def test_what_cannot_be_done_stops_before_the_fit_or_is_said_after_it(command):
    """Refused: nothing is written. Unavailable: everything else stands."""

    def unavailable(request, findings, progress):
        raise Unavailable("the fit is too [small]")

    wishes = {"compute": unavailable, "asked": lambda request: True}
    code, _, err = command(Analysis(name="toy", refuse=refuse, **wishes))
    assert code == 2
    assert "--toy: not today" in err
    assert not Path("out").exists()
    code, _, err = command(Analysis(name="toy", **wishes))
    assert code == 0
    assert "no toy: the fit is too [small]" in err
    assert Path("out/report.md").exists()


def test_an_analysis_is_done_only_if_asked_for_and_sees_those_before_it(command):
    seen = []

    def look(request, findings, progress):
        seen.append(findings.get("toy"))

    after = Analysis(name="after", compute=look, asked=lambda request: True)
    never = Analysis(name="never", compute=lambda *_: seen.append("never"))
    elsewhere = Analysis(
        name="elsewhere", compute=lambda *_: seen.append("elsewhere"),
        asked=lambda request: True, commands=("design",),
    )  # fmt: skip
    command(never, TOY, after, elsewhere)
    assert len(seen) == 1
    assert isinstance(seen[0], Played)


def test_each_analysis_follows_the_one_that_it_names():
    """A chain and a fork, given in another order; what follows nothing is refused."""

    def named(name, after=""):
        return Analysis(name=name, compute=lambda *_: None, after=after)

    first, second, fork, end = named("m"), named("z", "m"), named("b", "m"), named("a", "z")
    assert analyses.in_order([end, second, first, fork, first]) == (first, fork, second, end)
    with pytest.raises(ValueError, match="analysis b: after is 'm'; expected"):
        analyses.in_order([fork])
    with pytest.raises(ValueError, match="twice"):
        analyses.in_order([first, named("m", "z"), second])


def test_an_analysis_is_found_by_its_file():
    """A file beside the others is all that it takes."""
    files = {p.stem for p in Path(analyses.__file__).parent.glob("*.py")} - {"__init__"}
    assert len(files) == len(analyses.ANALYSES)
    modules = {a.compute.__module__.rpartition(".")[2] for a in analyses.ANALYSES}
    assert modules == files


def test_names_options_and_keys_exist_once():
    names = [a.name for a in analyses.ANALYSES]
    assert len(set(names)) == len(names)
    keys = [a.key for a in analyses.ANALYSES if a.key]
    assert set(keys) <= set(UncertaintySection.model_fields)
    fit = next(c for c in app.registered_commands if c.callback and c.callback.__name__ == "fit")
    options = [a.option.replace("-", "_") for a in analyses.ANALYSES if a.option]
    assert set(options) <= set(fit.callback.__annotations__)
