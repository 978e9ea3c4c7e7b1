"""All analyses of a fit, one file each: what they compute, and what is said of it where."""

import importlib
import pkgutil
from collections.abc import Callable, Iterable

from jaxtrachea.config import SpecError
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analyses.effective import EFFECTIVE
from jaxtrachea.inference.analyses.misfit import MISFIT
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Progress, Request, Unavailable


def in_order(analyses: Iterable[Analysis]) -> tuple[Analysis, ...]:
    """Each after the one that it follows; of several that follow the same, by name.

    Raises:
        ValueError: a name comes twice, or an analysis follows none that there is.
    """
    left = sorted(dict.fromkeys(analyses), key=lambda analysis: analysis.name)
    ordered: list[Analysis] = []

    def append(before: str) -> None:
        for analysis in left:
            if analysis.after == before:
                ordered.append(analysis)
                append(analysis.name)

    if len({analysis.name for analysis in left}) < len(left):
        raise ValueError(f"analyses: a name comes twice: {[a.name for a in left]}")
    append("")
    for analysis in left:
        if analysis not in ordered:
            found = f"analysis {analysis.name}: after is {analysis.after!r}"
            raise ValueError(f"{found}; expected an analysis that comes before it")
    return tuple(ordered)


def _declared() -> Iterable[Analysis]:
    """The analyses in the files beside this one."""
    for module in pkgutil.iter_modules(__path__):
        content = vars(importlib.import_module(f"{__name__}.{module.name}"))
        yield from (value for value in content.values() if isinstance(value, Analysis))


#: In the order in which they are done, in which their columns stand in parameters.csv, and, at each
#: place, their sections in the report. One may use what those before it have found.
ANALYSES = in_order(_declared())


def refuse(request: Request) -> None:
    """Say what cannot be done, before anything is fitted.

    Raises:
        SpecError: naming what was asked for.
    """
    wanted = [analysis for analysis in ANALYSES if analysis.wanted(request)]
    if not request.study.free:
        names = [f"--{name}" for name in request.options]
        asked = request.spec.uncertainty
        names += [f"uncertainty.{a.key}" for a in wanted if a.key and getattr(asked, a.key)]
        if names:
            raise SpecError(
                f"{', '.join(names)}: no free parameter, nothing to analyse; leave it out (the "
                "model is then evaluated), or free a parameter"
            )
    for analysis in wanted:
        analysis.refuse(request)


def left_out(request: Request) -> list[str]:
    """Keys of the specification that ask for what the command of the request does not do."""
    asked = request.spec.uncertainty
    return [
        f"uncertainty.{analysis.key}"
        for analysis in ANALYSES
        if analysis.key and getattr(asked, analysis.key)
        if request.command not in analysis.commands
    ]


def analyse(
    request: Request, result: FitResult, begin: Callable[[str], Progress] | None = None
) -> AnalysisResults:
    """Do all analyses of a fit that are asked for.

    Args:
        request: what is asked for, as `refuse` lets it pass.
        begin: called with what is done next; returns whom to tell of its progress.
    """
    findings = AnalysisResults(result)
    for analysis in ANALYSES:
        if not analysis.wanted(request):
            continue
        progress = begin(analysis.work) if begin and analysis.work else lambda done, of: None
        found, unavailable = findings.found, dict(findings.unavailable)
        try:
            found = (*found, (analysis, analysis.compute(request, findings, progress)))
        except Unavailable as error:
            unavailable[analysis.name] = str(error)
        findings = AnalysisResults(result, found, unavailable)
    return findings


def widened(result: FitResult) -> AnalysisResults:
    """A fit with the analyses that every table of lanes has, and no others."""
    return AnalysisResults(result, ((EFFECTIVE, AnalysisResults(result)), (MISFIT, result)))
