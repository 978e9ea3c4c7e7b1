"""The population in tables and report."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.files.table import Column, Row, Table, ends, number
from jaxtrachea.inference.analysis import (
    Analysis,
    AnalysisResults,
    Cells,
    Progress,
    Request,
    Unavailable,
)
from jaxtrachea.inference.population import Population, population, wanted

#: Share of estimates with errors above half their value from which logarithms are no good scale.
MAX_OPEN_SHARE = 0.1


def _spread(row: Row) -> str:
    sign = "× / " if row["spread_is"] == "factor" else "± "
    return f"{sign}{number(float(str(row['spread'])))}"


COLUMNS = (
    Column("parameter", lambda row: f"{row['parameter']} [{row['unit']}]"),
    Column("n", "specimens"),
    Column("left out", "left_out"),
    Column("mean"),
    Column("95 % interval", ends("mean_low95", "mean_high95")),
    Column("spread", _spread),
    Column("95 % interval", ends("spread_low95", "spread_high95")),
)


def _asked(request: Request) -> bool:
    return wanted(request.spec.fit.population, request.study)


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> Population:
    try:
        return population(findings.result, findings.profiles)
    except ValueError as error:
        raise Unavailable(str(error)) from None


def population_rows(of: Population) -> Iterator[Cells]:
    """One row per parameter for population.csv; intervals with Student's t."""
    from scipy.special import stdtrit

    e = of.effects
    for j, p in enumerate(of.parameters):
        count = int(of.known[:, j].sum())
        half = float(stdtrit(e.dof[j], 0.975) * e.mean_se[j])
        log = p.scale == "log"
        ends = np.array([e.sd[j], e.sd_low[j], e.sd_high[j]])
        spread, low, high = map(float, p.from_scaled(ends))
        mean = float(e.mean[j])
        slope = p.from_scaled(mean) if log else p.step
        yield {
            "parameter": p.name,
            "unit": p.unit,
            "specimens": count,
            "left_out": int(of.left_out[j]),
            "at_bound": int(of.at_bound[j]),
            "mean": p.from_scaled(mean),
            "mean_se": slope * float(e.mean_se[j]),
            "mean_dof": float(e.dof[j]),
            "mean_low95": p.from_scaled(mean - half),
            "mean_high95": p.from_scaled(mean + half),
            "spread_is": "factor" if log else p.unit,
            "spread": spread,
            "spread_low95": low,
            "spread_high95": high,
            "sd_scaled": float(e.sd[j]),
            "sd_scaled_se": float(e.sd_se[j]),
        }


def population_table(found: Population) -> Table:
    """Specimens, mean and spread of each parameter, with their intervals."""
    return Table(population_rows(found), COLUMNS, title="Population")


def _section(found: Population) -> list[str]:
    """What the table says."""
    return [
        "The specimens as a sample, all whose estimate has an error: their errors are taken out of "
        "the spread between them. Spread: one standard deviation, with scale `log` as "
        "a factor, and the mean is then the geometric one. Estimates drawn towards the mean by "
        "what they are uncertain: `shrunk` in `parameters.csv`; all numbers: `population.csv` "
        "(docs/fit.md).",
    ]


def _biased(found: Population) -> list[str]:
    """What the mean is biased by: estimates on a bound, logarithms of what is hardly determined."""
    held, unsure = [], []
    each = zip(found.parameters, found.at_bound, found.undetermined, strict=True)
    for (p, on_bound, open_), count in zip(each, found.known.sum(axis=0), strict=True):
        if on_bound:
            held.append(f"{p.name} {on_bound} of {on_bound + count}")
        if p.scale == "log" and open_ > MAX_OPEN_SHARE * count:
            unsure.append(f"{p.name} {open_} of {count}")
    texts = []
    if held:
        texts.append(
            f"**Population: estimates on a bound took no part ({', '.join(held)}): the mean is too "
            "far from the bound, the spread too small.**"
        )
    if unsure:
        texts.append(
            f"**Population: errors above half the value ({', '.join(unsure)}): with scale = 'log' "
            "the small ones count too little, the mean is too large; fit it with scale = "
            "'linear'.**"
        )
    return texts


POPULATION = Analysis(
    name="population",
    after="bootstrap",
    compute=_compute,
    asked=_asked,
    tables=lambda found: {"population.csv": population_table(found)},
    parameter_cells=Population.shrunk_cells,
    report_section="estimates",
    table=lambda found, lanes: population_table(found),
    section=_section,
    warning=_biased,
)
