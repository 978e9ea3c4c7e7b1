"""What `posterior` drew, as rows and datasets (docs/results.md)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxtrachea.identify.bootstrap import Bootstrap
from jaxtrachea.identify.fit import FitResult
from jaxtrachea.identify.population import Population
from jaxtrachea.identify.posterior import Posterior
from jaxtrachea.identify.profile import Profiles
from jaxtrachea.identify.results import parameter_rows
from jaxtrachea.identify.whole_files import hdf5_file

_DATASETS = ("theta", "sigma", "divergent", "rhat", "ess", "median", "lower", "upper")


def rows_with_draws(
    result: FitResult,
    profiles: Profiles | None,
    resampled: Bootstrap | None,
    population: Population | None,
    drawn: Posterior | None,
) -> Iterator[dict[str, Any]]:
    """`parameter_rows`, with the posterior where there is one."""
    rows = parameter_rows(result, profiles, resampled, population)
    if drawn is None:
        yield from rows
        return
    places = ((k, i) for k, unknowns in enumerate(result.problem.unknowns)
              for i in range(len(unknowns)))  # fmt: skip
    for (lane, i), row in zip(places, rows, strict=True):
        yield row | {
            "posterior_median": float(drawn.median[lane, i]),
            "posterior_low95": float(drawn.lower[lane, i]),
            "posterior_high95": float(drawn.upper[lane, i]),
            "posterior_rhat": float(drawn.rhat[lane, i]),
            "posterior_ess": float(drawn.ess[lane, i]),
            "posterior_verdict": drawn.verdict(lane),
        }


def write_draws(path: Path, drawn: Posterior) -> None:
    """Add the group `posterior` to a results file."""
    with hdf5_file(path, "r+") as file:
        group = file.create_group("posterior")
        for name in _DATASETS:
            group.create_dataset(name, data=getattr(drawn, name), compression="gzip")
