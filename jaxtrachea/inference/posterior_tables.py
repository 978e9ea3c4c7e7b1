"""What `posterior` drew, as rows and datasets (docs/results.md)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxtrachea.files.atomic import hdf5_file
from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.bootstrap import Bootstrap
from jaxtrachea.inference.population import Population
from jaxtrachea.inference.posterior import Posterior
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.results import parameter_rows

_DATASETS = (
    "theta", "sigma", "divergent", "steps", "lost", "rhat", "ess", "median", "lower", "upper",
)  # fmt: skip


def rows_with_draws(
    result: FitResult,
    profiles: Profiles | None,
    resampled: Bootstrap | None,
    population: Population | None,
    drawn: Posterior | None,
) -> Iterator[dict[str, Any]]:
    """`parameter_rows`, with the posterior where there is one.

    What poor chains say is left out: it stands in results.h5 for those who want to look into it.
    """
    rows = parameter_rows(result, profiles, resampled, population)
    if drawn is None:
        yield from rows
        return
    places = ((k, i) for k, unknowns in enumerate(result.study.unknowns)
              for i in range(len(unknowns)))  # fmt: skip
    for (lane, i), row in zip(places, rows, strict=True):
        verdict = drawn.verdict(lane)
        poor = verdict.startswith("poor")
        ends = {"median": drawn.median, "low95": drawn.lower, "high95": drawn.upper}
        cells = {f"posterior_{name}": "" if poor else float(v[lane, i]) for name, v in ends.items()}
        yield (
            row
            | cells
            | {
                "posterior_rhat": float(drawn.rhat[lane, i]),
                "posterior_ess": float(drawn.ess[lane, i]),
                "posterior_verdict": verdict,
            }
        )


def write_draws(path: Path, drawn: Posterior) -> None:
    """Add the group `posterior` to a results file."""
    with hdf5_file(path, "r+") as file:
        group = file.create_group("posterior")
        for name in _DATASETS:
            group.create_dataset(name, data=getattr(drawn, name), compression="gzip")
