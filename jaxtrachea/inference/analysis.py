"""What an analysis of a fit is: one record of what it computes, and of all that is said of it.

An analysis is a file in `analyses`, found by itself. The command line, report.md, the tables,
results.h5 and the pictures go through all of them. One that is asked for has that declared where
users give it: a key in `config.UncertaintySection`, an option in `cli.main`.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from jaxtrachea._arguments import check_word
from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.files.table import Row, Table
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.profile import Profiles

#: Cells of a row of a table, by name.
Cells = Row
#: Where an analysis speaks, see `Analysis`.
Place = Literal["estimates", "quality", "checks", "data", "design"]
#: Called with (steps done since the last call, steps in all, 0 if unknown).
Progress = Callable[[int, int], None]


class Unavailable(ValueError):
    """A fit does not allow an analysis; the message says why, and the rest of the run stands."""


@dataclasses.dataclass(frozen=True, eq=False)
class Request:
    """What the user asks for.

    Attributes:
        spec: the specification.
        study: the study.
        settings: of the solver.
        options: of the command line, without dashes.
        command: whose analyses are done.
    """

    spec: FitSpec
    study: Study
    settings: Settings
    options: Collection[str] = ()
    command: Literal["fit", "design"] = "fit"

    def refuse_sections(self, what: str) -> None:
        """Say that an analysis is made for a line of joints.

        Raises:
            SpecError: the skeleton is of deforming cross-sections.
        """
        try:
            self.study.refuse_sections(what)
        except ValueError as error:
            raise SpecError(str(error)) from None


@dataclasses.dataclass(frozen=True, eq=False)
class AnalysisResults:
    """A fit, and what its analyses have found.

    Attributes:
        result: the fit.
        found: each analysis that was done, with what it found, in the order of `ANALYSES`.
        unavailable: name of an analysis that could not be done, and why.
    """

    result: FitResult
    found: tuple[tuple["Analysis", Any], ...] = ()
    unavailable: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def get(self, name: str) -> Any:
        """What the analysis of this name has found; None if it was not done."""
        return next((found for analysis, found in self.found if analysis.name == name), None)

    def at(self, place: str) -> Iterator[tuple["Analysis", Any]]:
        """The analyses that the report has at this place."""
        return (
            (analysis, found) for analysis, found in self.found if analysis.report_section == place
        )

    @property
    def profiles(self) -> Profiles | None:
        """Profiles that were asked for: they add to the evidence for all verdicts."""
        return self.get("profiles")


@dataclasses.dataclass(frozen=True, eq=False)
class Analysis:
    """An analysis of a fit; what it has nothing to say of is left at its default.

    `found` is what `compute` returns. Pictures import matplotlib when they are drawn.

    Attributes:
        name: of its group in results.h5, and of itself.
        after: the analysis that it follows: it may use what those before it have found, and its
            columns in parameters.csv and its section at a place of the report come after theirs.
        compute: the analysis itself, out of the request, the findings so far and whom to tell of
            progress; raises `Unavailable` where the fit does not allow it.
        work: what is done meanwhile, for the progress bar; "" if it takes no time.
        option: of the command line that asks for it, without dashes.
        key: of the section [uncertainty] that asks for it.
        asked: whether it is asked for otherwise.
        commands: that it belongs to.
        refuse: raises `SpecError`, before anything is fitted, where it cannot be done.
        tables: by name of a CSV file.
        lane_cells: cells of summary.csv, for (found, lane).
        parameter_cells: cells of parameters.csv, for (found, lane, unknown).
        datasets: arrays of `found` in its group of results.h5; none: it has no such group.
        attributes: of this group, likewise.
        meanings: enumeration of the codes in a dataset, by its name.
        report_section: where its section stands in report.md, and its tables on the terminal:
            `estimates`, before the quality of the fit; `quality`, with it; `checks`, after it;
            `data`, after what is used of the data; `design`: it belongs to that command.
        table: for people, in the report under its title and on the terminal, for (found, lanes
            that are listed); None: it has none.
        section: paragraphs of the report, below its table.
        warning: paragraphs below the table of estimates.
        sentences: sentences on the terminal, below its table.
        figures: what draws each picture, by name of the file.
        files: what writes each further file, by its name, for (found, path).
        unreliable: whether it came out so that the command ends with exit code 1.
    """

    name: str
    compute: Callable[[Request, AnalysisResults, Progress], Any]
    after: str = ""
    work: str = ""
    option: str = ""
    key: str = ""
    asked: Callable[[Request], bool] = lambda request: False
    commands: tuple[str, ...] = ("fit",)
    refuse: Callable[[Request], None] = lambda request: None
    tables: Callable[[Any], Mapping[str, Table]] = lambda found: {}
    lane_cells: Callable[[Any, int], Cells] = lambda found, lane: {}
    parameter_cells: Callable[[Any, int, int], Cells] = lambda found, lane, i: {}
    datasets: tuple[str, ...] = ()
    attributes: tuple[str, ...] = ()
    meanings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    report_section: Place = "checks"
    table: Callable[[Any, list[int]], Table | None] = lambda found, lanes: None
    section: Callable[[Any], list[str]] = lambda found: []
    warning: Callable[[Any], list[str]] = lambda found: []
    sentences: Callable[[Any], Iterable[str]] = lambda found: ()
    figures: Callable[[Any], Mapping[str, Callable[[], Any]]] = lambda found: {}
    files: Mapping[str, Callable[[Any, Path], None]] = dataclasses.field(default_factory=dict)
    unreliable: Callable[[Any], bool] = lambda found: False

    def __post_init__(self):
        """Refuse a place that no report has: what stands there would never be seen.

        Raises:
            ValueError: with the places there are.
        """
        check_word("place", self.report_section, Place)

    def report(self, found: Any, lanes: list[int]) -> list[str]:
        """Paragraphs of the report: its table, where it has one, and its section."""
        table = self.table(found, lanes)
        above = [] if table is None else [f"## {table.title}", *table.paragraphs()]
        return above + self.section(found)

    def terminal(self, found: Any, lanes: list[int]) -> Iterator[Table | str]:
        """Its table on the terminal, where it has one, and its sentences."""
        table = self.table(found, lanes)
        yield from () if table is None else [table]
        yield from self.sentences(found)

    def wanted(self, request: Request) -> bool:
        """Whether the request asks for it."""
        by_key = bool(self.key) and bool(getattr(request.spec.uncertainty, self.key))
        asked = self.option in request.options or by_key or self.asked(request)
        return request.command in self.commands and asked
