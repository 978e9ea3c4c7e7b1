"""One run of a fit: everything that was asked for, computed, written and shown."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from jaxtrachea.terminal import progress_bar, table, to_stderr


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


def run(
    spec, problem, settings, options, profile: tuple[str, ...], stop_if_asked, fit=None
) -> Found:
    """Fit, by `fit` if given, then what needs a fit; all with `settings`."""
    from jaxtrachea.identify.bootstrap import bootstrap
    from jaxtrachea.identify.fit import fit as in_one_go
    from jaxtrachea.identify.influence import influence as diagnose
    from jaxtrachea.identify.posterior import posterior as draw
    from jaxtrachea.identify.predictions import leave_one_out
    from jaxtrachea.identify.profile import profiles

    with progress_bar() as bar:

        def counted(text):
            task, finished = bar.add_task(text, total=None), 0

            def advance(done, of):
                nonlocal finished
                stop_if_asked()
                finished += done  # of a joint fit, lanes that fill up a chunk as well
                bar.update(task, completed=min(finished, of or finished), total=of or None)

            return advance

        result = (fit or in_one_go)(problem, settings, counted("fitting"))
        left_out = profiled = resampled = None
        if "leave-one-out" in options:
            left_out = leave_one_out(problem, settings, counted("leaving curves out"))
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
        found = diagnose(result, settings.chunk) if wanted else None
        drawn = None
        if u.posterior:
            drawn = draw(
                result, draws=u.posterior, chains=u.posterior_chains, seed=spec.fit.seed,
                progress=counted("drawing"),
            )  # fmt: skip
        specimens = _population(spec, result, profiled)
        return Found(result, left_out, profiled, resampled, found, drawn, specimens)


def _population(spec, result, profiled):
    """The specimens as a sample, or None with a word why not if it was asked for."""
    from jaxtrachea.identify.population import population, wanted

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

    from jaxtrachea import report
    from jaxtrachea.identify import results
    from jaxtrachea.identify.population import population_rows
    from jaxtrachea.identify.posterior_tables import rows_with_draws, write_draws
    from jaxtrachea.identify.predictions import predictions
    from jaxtrachea.identify.usage_tables import usage_rows, usage_section
    from jaxtrachea.plots import draw_all
    from jaxtrachea.sections import write_more
    from jaxtrachea.webpage import page

    result, profiles, resampled = found.result, found.profiles, found.resampled
    seen = predictions(result.problem, result.theta)
    rows = [*results.lane_rows(result, profiles), *map(results.bad_row, measurements.bad)]
    results.write_csv(folder / "summary.csv", rows)
    found_rows = rows_with_draws(result, profiles, resampled, found.population, found.posterior)
    results.write_csv(folder / "parameters.csv", list(found_rows))
    if found.population is not None:
        results.write_csv(folder / "population.csv", list(population_rows(found.population)))
    if profiles is not None:
        results.write_csv(folder / "profiles.csv", list(results.profile_rows(profiles)))
    drawn = draw_all(folder, result, seen, profiles)
    left = None if found.left_out is None else report.left_out_rows(result, found.left_out)
    title = loaded.title or spec.stem
    results.write_csv(folder / "curves.csv", list(usage_rows(measurements.curves)))
    used = usage_section(measurements.curves)
    more = [*used, *write_more(folder, found.influence, found.posterior)]
    text = report.report_text(
        title, result, measurements.bad, seen, left, profiles, resampled, more, found.population
    )
    results.write_text(folder / "report.md", text)
    ends = [*clock, time.perf_counter()]
    phases = ("read", "fit", "write")
    timings = {name: ends[i + 1] - ends[i] for i, name in enumerate(phases)}
    made = results.provenance(
        spec, measurements.sha256(), str(jax.devices()[0]), loaded.fit.precision, timings
    ) | {"run": journal}
    results.write_hdf5(folder / "results.h5", result, made, profiles, resampled)
    if found.posterior is not None:
        write_draws(folder / "results.h5", found.posterior)
    results.write_text(folder / "provenance.json", json.dumps(made, indent=2) + "\n")
    pictures = {path.name: path.read_bytes() for path in drawn}
    results.write_text(folder / "report.html", page(text, pictures, made))


def show(found: Found, folder: Path) -> None:
    """Tables of a run on the terminal."""
    from jaxtrachea import report
    from jaxtrachea.identify.results import lane_label, succeeded, verdict_sentence
    from jaxtrachea.identify.usage_tables import sentences

    out, result = Console(), found.result
    lanes = range(result.lanes)
    if result.lanes <= report.ONE_BY_ONE:
        rows = report.estimate_rows(result, lanes, found.profiles)
        out.print(table("Estimates", report.ESTIMATE_HEAD, rows))
        out.print(table("Quality", report.QUALITY_HEAD, report.quality_rows(result, lanes)))
        if found.profiles is not None:
            rows = report.profile_table(found.profiles, lanes)
            out.print(table("Profile likelihood", report.PROFILE_HEAD, rows))
        if found.resampled is not None:
            rows = report.bootstrap_table(found.resampled, lanes)
            out.print(table("Bootstrap", report.BOOTSTRAP_HEAD, rows))
        for lane in lanes:
            text = f"{lane_label(result, lane)}: {verdict_sentence(result, lane, found.profiles)}"
            out.print(escape(text), highlight=False)
    else:
        out.print(
            table(
                "Estimates over lanes",
                report.SPREAD_HEAD,
                report.spread_rows(result, found.profiles),
            )
        )
        if found.population is not None:
            rows = report.population_table(found.population)
            out.print(table("Population", report.POPULATION_HEAD, rows))
        good = sum(succeeded(result, lane) for lane in lanes)
        out.print(f"{good} of {result.lanes} lanes succeeded")
    for sentence in sentences([c for curves in result.problem.curves for c in curves]):
        out.print(escape(f"{sentence} (curves.csv)"), highlight=False)
    out.print(f"written to {escape(str(folder))}", highlight=False, soft_wrap=True)
