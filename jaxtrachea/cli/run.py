"""One run of a fit: everything that was asked for, computed, written and shown."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from jaxtrachea.cli.terminal import Stages, progress_bar, say_lost, table, to_stderr


@dataclasses.dataclass(frozen=True)
class Found:
    """What a run has computed; None: not asked for."""

    result: Any
    left_out: Any
    profiles: Any
    resampled: Any
    influence: Any = None
    posterior: Any = None
    population: Any = None


def run(spec, study, settings, options, profile: tuple[str, ...], stop_if_asked, fit=None) -> Found:
    """Fit, by `fit` if given, then what needs a fit; all with `settings`."""
    from jaxtrachea.fit.fit import fit as in_one_go
    from jaxtrachea.inference.bootstrap import bootstrap
    from jaxtrachea.inference.cross_validation import leave_one_out
    from jaxtrachea.inference.influence import influence as diagnose
    from jaxtrachea.inference.posterior import posterior as draw
    from jaxtrachea.inference.profile import profiles

    with progress_bar() as bar:
        stages = Stages(bar, stop_if_asked)
        counted = stages.begin
        result = (fit or in_one_go)(study, settings, counted("fitting"))
        left_out = profiled = resampled = None
        if "leave-one-out" in options:
            left_out = leave_one_out(study, settings, counted("leaving curves out"))
        if profile:
            points, report = spec.uncertainty.profile_points, counted("profiling")
            profiled = profiles(result, settings, profile, points=points, progress=report)
        u = spec.uncertainty
        if u.bootstrap:
            resampled = bootstrap(
                result, settings, count=u.bootstrap, kind=u.kind, block=u.block,
                progress=counted("resampling"),
            )  # fmt: skip
        wanted = u.influence or "influence" in options
        found = diagnose(result, settings.batch) if wanted else None
        drawn = None
        if u.posterior:
            drawn = draw(
                result, draws=u.posterior, chains=u.posterior_chains, seed=spec.fit.seed,
                progress=counted("drawing"),
            )  # fmt: skip
        stages.close()
        specimens = _population(spec, result, profiled)
        return Found(result, left_out, profiled, resampled, found, drawn, specimens)


def _population(spec, result, profiled):
    """The specimens as a sample, or None with a word why not if it was asked for."""
    from jaxtrachea.inference.population import population, wanted

    if not wanted(spec.fit.population, result):
        return None
    try:
        return population(result, profiled)
    except ValueError as error:
        to_stderr(f"[yellow]no population:[/] {escape(str(error))}")
        return None


def write(folder: Path, spec: Path, loaded, measurements, found: Found, clock, journal) -> None:
    """All files of one run; `clock`: when reading began, ended, and the fit ended."""
    import json

    import jax

    from jaxtrachea.files.html import page
    from jaxtrachea.files.pictures import without_lost
    from jaxtrachea.files.provenance import provenance
    from jaxtrachea.files.tables import write_text
    from jaxtrachea.fit.predictions import predictions
    from jaxtrachea.inference import results
    from jaxtrachea.inference.posterior_tables import write_draws
    from jaxtrachea.measurements.usage_tables import usage_rows, usage_section
    from jaxtrachea.report import fit as report
    from jaxtrachea.report.plots import draw_all
    from jaxtrachea.report.sections import write_more

    result, profiles, resampled = found.result, found.profiles, found.resampled
    seen = predictions(result.study, result.theta)
    _write_tables(folder, found, measurements.bad, seen)
    drawn, lost = draw_all(folder, result, seen, profiles)
    say_lost(lost)
    title = loaded.title or spec.stem
    results.write_csv(folder / "curves.csv", list(usage_rows(measurements.curves)))
    used = usage_section(measurements.curves)
    more = [*used, *write_more(folder, found.influence, found.posterior)]
    text = report.report_text(
        title, result, measurements.bad, seen, found.left_out, profiles, resampled, more,
        found.population, found.posterior,
    )  # fmt: skip
    text = without_lost(text, lost)
    write_text(folder / "report.md", text)
    ends = [*clock, time.perf_counter()]
    phases = ("read", "fit", "write")
    timings = {name: ends[i + 1] - ends[i] for i, name in enumerate(phases)}
    made = provenance(
        spec, measurements.sha256(), str(jax.devices()[0]), loaded.fit.precision, timings
    ) | {"run": journal}
    reading = loaded.data.model_dump(mode="json")
    results.write_hdf5(folder / "results.h5", result, made, profiles, resampled, reading)
    if found.posterior is not None:
        write_draws(folder / "results.h5", found.posterior)
    write_text(folder / "provenance.json", json.dumps(made, indent=2) + "\n")
    pictures = {path.name: path.read_bytes() for path in drawn}
    write_text(folder / "report.html", page(text, pictures, made))


def _write_tables(folder: Path, found: Found, bad, seen) -> None:
    """All CSV files but those on influence."""
    from jaxtrachea.inference import results
    from jaxtrachea.inference.effective import effective
    from jaxtrachea.inference.population import population_rows
    from jaxtrachea.inference.posterior_tables import rows_with_draws
    from jaxtrachea.inference.summary import left_out_cells, widened_rows, with_residuals

    result, profiles = found.result, found.profiles
    wide = effective(result, seen, profiles)
    rows = with_residuals(result, list(results.lane_rows(result, profiles)), seen, wide)
    results.write_csv(folder / "summary.csv", [*rows, *map(results.bad_row, bad)])
    rows = rows_with_draws(result, profiles, found.resampled, found.population, found.posterior)
    results.write_csv(folder / "parameters.csv", widened_rows(result, list(rows), wide))
    if found.population is not None:
        results.write_csv(folder / "population.csv", list(population_rows(found.population)))
    if profiles is not None:
        results.write_csv(folder / "profiles.csv", list(results.profile_rows(profiles)))
    if found.left_out is not None:
        results.write_csv(folder / "left_out.csv", left_out_cells(result, found.left_out))


def show(found: Found, folder: Path) -> None:
    """Tables of a run on the terminal."""
    from jaxtrachea.report.overview import overview

    out = Console()
    for item in overview(found):
        if isinstance(item, str):
            out.print(escape(item), highlight=False, emoji=False)
        else:
            out.print(table(*item))
    out.print(f"written to {escape(str(folder))}", highlight=False, soft_wrap=True)


def posterior_failed(found: Found) -> bool:
    """Whether the posterior was asked for and some lane's chains are poor."""
    drawn, result = found.posterior, found.result
    if drawn is None:
        return False
    return any(drawn.verdict(lane).startswith("poor") for lane in range(result.lanes))
