"""Draws from the posterior in tables, report and results.h5."""

from collections.abc import Iterator, Sequence

from jaxtrachea.config import SpecError
from jaxtrachea.files.tables import markdown_table, number
from jaxtrachea.fitting.result import unknown_label
from jaxtrachea.inference.analysis import Analysis, Cells, Findings, Progress, Request, Table
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.posterior import MissingSampler, Posterior, posterior, sampler
from jaxtrachea.inference.rows import and_more, listed, more_of

#: Lanes that are named; of more, the number.
_NAMED = 12
_DATASETS = (
    "theta", "sigma", "divergent", "steps", "lost", "rhat", "ess", "median", "lower", "upper",
)  # fmt: skip
POSTERIOR_HEAD = [
    "specimen", "parameter", "median", "posterior 95 %", "R-hat", "effective draws", "chains",
]  # fmt: skip


def _refuse(request: Request) -> None:
    request.refuse_sections("uncertainty.posterior")
    try:
        sampler()
    except MissingSampler as error:
        raise SpecError(f"uncertainty.posterior: {error}") from None


def _compute(request: Request, findings: Findings, progress: Progress) -> Posterior:
    asked = request.spec.uncertainty
    return posterior(
        findings.result, draws=asked.posterior, chains=asked.posterior_chains,
        seed=request.spec.fit.seed, progress=progress,
    )  # fmt: skip


def _cells(drawn: Posterior, lane: int, i: int) -> Cells:
    """What chains say; of poor ones it stands in results.h5 alone, for those who look into it."""
    verdict = drawn.verdict(lane)
    poor = verdict.startswith("poor")
    ends = {"median": drawn.median, "low95": drawn.lower, "high95": drawn.upper}
    cells = {f"posterior_{name}": "" if poor else float(v[lane, i]) for name, v in ends.items()}
    return cells | {
        "posterior_rhat": float(drawn.rhat[lane, i]),
        "posterior_ess": float(drawn.ess[lane, i]),
        "posterior_verdict": verdict,
    }


def _datasets(group, drawn: Posterior) -> None:
    for name in _DATASETS:
        group.create_dataset(name, data=getattr(drawn, name), compression="gzip")


def not_good(drawn: Posterior) -> dict[int, str]:
    """Lanes whose chains are not good, with the verdict on them; poor ones first."""
    words = {lane: drawn.verdict(lane) for lane in range(drawn.result.lanes)}
    bad = {k: text for k, text in words.items() if not text.startswith("good")}
    return dict(sorted(bad.items(), key=lambda item: not item[1].startswith(("poor", "no draws"))))


def distrust(drawn: Posterior) -> list[str]:
    """A paragraph on the draws that deserve no trust; none if all do."""
    bad = not_good(drawn)
    if not bad:
        return []
    named = [f"{lane_label(drawn.result, k)} {bad[k]}" for k in list(bad)[:_NAMED]]
    more = f"; and {len(bad) - _NAMED} more, see parameters.csv" if len(bad) > _NAMED else ""
    return [
        f"**The posterior of {len(bad)} of {drawn.result.lanes} fits is not to be trusted as it "
        f"stands**: {'; '.join(named)}{more}. Draw more, or look at the profiles."
    ]


def posterior_rows(drawn: Posterior, lanes: Sequence[int]) -> list[list[str]]:
    """Medians, intervals and what they are worth; poor chains have neither median nor interval."""
    result, rows = drawn.result, []
    for lane in lanes:
        grade = drawn.verdict(lane).partition(":")[0]
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            median, low, high = (
                number(float(v[lane, i])) for v in (drawn.median, drawn.lower, drawn.upper)
            )
            rows.append(
                [
                    lane_label(result, lane),
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    "–" if grade == "poor" else median,
                    "–" if grade == "poor" else f"{low} … {high}",
                    number(float(drawn.rhat[lane, i])),
                    number(float(drawn.ess[lane, i]), 3),
                    grade,
                ]
            )
    return rows


def _section(drawn: Posterior) -> list[str]:
    """Medians and intervals of the draws, and whether the chains deserve trust."""
    result = drawn.result
    shown = listed(result)
    chains, draws = drawn.theta.shape[1:3]
    longer = drawn.steps[drawn.steps > draws]
    more = f", {longer.min()} to {longer.max()} in {len(longer)} fits" if len(longer) else ""
    return [
        "## Posterior",
        markdown_table(POSTERIOR_HEAD, posterior_rows(drawn, shown)),
        *more_of(result, shown, "parameters.csv"),
        f"{chains} chains of {draws} draws (NUTS{more}), priors uniform in scaled coordinates "
        "between the bounds. Good: R-hat up to 1.01, 400 effective draws, nothing divergent. Of "
        "poor chains (R-hat above 1.05, less than 100 effective draws, or more than 2 % divergent) "
        "no interval is given. All draws: `results.h5` (docs/read_a_fit.md).",
        *(distrust(drawn) or ["All chains are good."]),
    ]


def _shown(drawn: Posterior, lanes: list[int]) -> Iterator[Table | str]:
    yield "Posterior", POSTERIOR_HEAD, posterior_rows(drawn, lanes)
    yield from and_more(drawn.result.lanes, len(lanes), "parameters.csv")


def _poor(drawn: Posterior) -> bool:
    """Whether some lane's chains are poor."""
    return any(drawn.verdict(lane).startswith("poor") for lane in range(drawn.result.lanes))


POSTERIOR = Analysis(
    name="posterior",
    after="population",
    compute=_compute,
    work="drawing",
    key="posterior",
    refuse=_refuse,
    parameter_cells=_cells,
    datasets=_datasets,
    place="data",
    section=_section,
    warning=distrust,
    shown=_shown,
    poor=_poor,
)
