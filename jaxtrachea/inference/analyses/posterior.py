"""Draws from the posterior in tables, report and results.h5."""

from collections.abc import Sequence

from jaxtrachea.config import SpecError
from jaxtrachea.files.table import Column, Table, ends
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.labels import lane_label, unknown_rows
from jaxtrachea.inference.posterior import MissingSampler, Posterior, posterior, sampler
from jaxtrachea.inference.posterior_file import write_posterior
from jaxtrachea.inference.rows import and_more

#: Lanes that are named; of more, the number.
_NAMED = 12
COLUMNS = (
    Column("specimen"),
    Column("parameter"),
    Column("median", "posterior_median"),
    Column("posterior 95 %", ends("posterior_low95", "posterior_high95")),
    Column("R-hat", "posterior_rhat"),
    Column("effective draws", "posterior_ess", digits=3),
    Column("chains", lambda row: str(row["posterior_verdict"]).partition(":")[0]),
)


def _refuse(request: Request) -> None:
    request.refuse_sections("uncertainty.posterior")
    try:
        sampler()
    except MissingSampler as error:
        raise SpecError(f"uncertainty.posterior: {error}") from None


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> Posterior:
    asked = request.spec.uncertainty
    return posterior(
        findings.result, draws=asked.posterior, chains=asked.posterior_chains,
        seed=request.spec.fit.seed, progress=progress,
    )  # fmt: skip


def _cells(posterior: Posterior, lane: int, i: int) -> Cells:
    """What chains say; of poor ones it stands in results.h5 alone, for those who look into it."""
    verdict = posterior.verdict(lane)
    poor = verdict.startswith("poor")
    ends = {"median": posterior.median, "low95": posterior.lower, "high95": posterior.upper}
    cells = {f"posterior_{name}": None if poor else float(v[lane, i]) for name, v in ends.items()}
    return cells | {
        "posterior_rhat": float(posterior.rhat[lane, i]),
        "posterior_ess": float(posterior.ess[lane, i]),
        "posterior_verdict": verdict,
    }


def not_good(posterior: Posterior) -> dict[int, str]:
    """Lanes whose chains are not good, with the verdict on them; poor ones first."""
    words = {lane: posterior.verdict(lane) for lane in range(posterior.result.lanes)}
    bad = {k: text for k, text in words.items() if not text.startswith("good")}
    return dict(sorted(bad.items(), key=lambda item: not item[1].startswith(("poor", "no draws"))))


def distrust(posterior: Posterior) -> list[str]:
    """A paragraph on the draws that deserve no trust; none if all do."""
    bad = not_good(posterior)
    if not bad:
        return []
    named = [f"{lane_label(posterior.result, k)} {bad[k]}" for k in list(bad)[:_NAMED]]
    more = f"; and {len(bad) - _NAMED} more, see parameters.csv" if len(bad) > _NAMED else ""
    return [
        f"**The posterior of {len(bad)} of {posterior.result.lanes} fits is not to be trusted as "
        f"it stands**: {'; '.join(named)}{more}. Draw more, or look at the profiles."
    ]


def posterior_table(posterior: Posterior, lanes: Sequence[int]) -> Table:
    """Medians, intervals and what they are worth; poor chains have neither median nor interval."""
    result = posterior.result
    return Table(
        unknown_rows(result, lanes, lambda lane, i: _cells(posterior, lane, i)),
        COLUMNS,
        title="Posterior",
        more=and_more(result.lanes, len(lanes), "parameters.csv"),
    )


def _section(posterior: Posterior) -> list[str]:
    """How many draws there are, and whether the chains deserve trust."""
    chains, draws = posterior.theta.shape[1:3]
    longer = posterior.steps[posterior.steps > draws]
    more = f", {longer.min()} to {longer.max()} in {len(longer)} fits" if len(longer) else ""
    return [
        f"{chains} chains of {draws} draws (NUTS{more}), priors uniform in scaled coordinates "
        "between the bounds. Good: R-hat up to 1.01, 400 effective draws, nothing divergent. Of "
        "poor chains (R-hat above 1.05, less than 100 effective draws, or more than 2 % divergent) "
        "no interval is given. All draws: `posterior.nc` (docs/read_a_fit.md).",
        *(distrust(posterior) or ["All chains are good."]),
    ]


POSTERIOR = Analysis(
    name="posterior",
    after="population",
    compute=_compute,
    work="drawing",
    key="posterior",
    refuse=_refuse,
    parameter_cells=_cells,
    datasets=(
        "theta", "sigma", "divergent", "steps", "lost", "rhat", "ess", "median", "lower", "upper",
    ),
    report_section="data",
    table=posterior_table,
    section=_section,
    warning=distrust,
    files={"posterior.nc": write_posterior},
    unreliable=lambda found: any(text.startswith("poor") for text in not_good(found).values()),
)  # fmt: skip
