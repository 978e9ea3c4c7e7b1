"""All analyses of a fit, one file each: what they compute, and what is said of it where."""

from collections.abc import Callable

from jaxtrachea.config import SpecError
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analyses.bootstrap import BOOTSTRAP
from jaxtrachea.inference.analyses.cross_validation import LEFT_OUT
from jaxtrachea.inference.analyses.design import DESIGN
from jaxtrachea.inference.analyses.effective import EFFECTIVE
from jaxtrachea.inference.analyses.influence import INFLUENCE
from jaxtrachea.inference.analyses.population import POPULATION
from jaxtrachea.inference.analyses.posterior import POSTERIOR
from jaxtrachea.inference.analyses.profile import PROFILES
from jaxtrachea.inference.analysis import Analysis, Findings, Progress, Request, Unavailable

#: In the order in which they are done, in which their columns stand in parameters.csv, and, at each
#: place, their sections in the report. One may use what those before it have found.
ANALYSES: tuple[Analysis, ...] = (
    PROFILES,
    BOOTSTRAP,
    POPULATION,
    POSTERIOR,
    LEFT_OUT,
    INFLUENCE,
    EFFECTIVE,
    DESIGN,
)


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
                f"{', '.join(names)}: every parameter is fixed, so that there is no estimate to be "
                "doubted; leave it out (the model is then evaluated), or free a parameter"
            )
    for analysis in wanted:
        analysis.refuse(request)


def analyse(
    request: Request, result: FitResult, begin: Callable[[str], Progress] | None = None
) -> Findings:
    """Do all analyses of a fit that are asked for.

    Args:
        request: what is asked for, as `refuse` lets it pass.
        result: the fit.
        begin: called with what is done next; returns whom to tell of its progress.
    """
    findings = Findings(result)
    for analysis in ANALYSES:
        if not analysis.wanted(request):
            continue
        progress = begin(analysis.work) if begin and analysis.work else lambda done, of: None
        found, unavailable = findings.found, dict(findings.unavailable)
        try:
            found = (*found, (analysis, analysis.compute(request, findings, progress)))
        except Unavailable as error:
            unavailable[analysis.name] = str(error)
        findings = Findings(result, found, unavailable)
    return findings
