"""The command line: the only room that turns errors into messages and exit codes.

Exit codes: 0 everything converged, 1 some lane failed or some curve could not be used, 2 bad input,
3 another process was lost, 130 stopped by the user. What is heavy is imported inside the commands.
"""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxtrachea import __version__, cli_compare, cli_fit, cli_scene, cli_tradeoff
from jaxtrachea.cli_load import load
from jaxtrachea.terminal import Kept, Stop, complain, into, progress_bar, table, to_stderr

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Trachea mechanics: identify them from force-displacement curves, simulate scenes.",
)
#: Rows of a terminal table; the files hold all.
MANY = 40

SpecArgument = Annotated[Path, typer.Argument(help="TOML specification of the fit.")]
DataOption = Annotated[
    Path | None, typer.Option("--data", help="Folder the data paths start from (default: SPEC's).")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="New folder for the results.")]
LeaveOption = Annotated[
    bool, typer.Option("--leave-one-out", help="Also predict every curve from the others.")
]
ProfileOption = Annotated[
    bool, typer.Option("--profile", help="Also profile the likelihood of the parameters.")
]
InfluenceOption = Annotated[
    bool, typer.Option("--influence", help="Also say which samples and curves the estimates need.")
]


def main() -> None:
    """Entry point: every expected error becomes one message on stderr and an exit code."""
    try:
        code = app(prog_name="jaxtrachea", standalone_mode=False)
    except Stop as stop:
        code = complain(str(stop))
    except Kept as stop:
        to_stderr(str(stop))
        sys.exit(stop.code)
    except typer.Exit as stop:
        code = stop.exit_code
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    except Exception as error:
        # Usage errors come from click or from typer's own copy of it, whichever is installed.
        usage = getattr(error, "format_message", None)
        if usage is None:
            raise
        code = complain(usage())
    if code == 130:  # some versions of typer turn Ctrl-C into this exit code themselves
        to_stderr("stopped; nothing was written")
    sys.exit(code or 0)


for _command in (
    cli_compare.compare, cli_scene.plan, cli_scene.simulate, cli_scene.sweep, cli_tradeoff.tradeoff
):  # fmt: skip
    app.command()(_command)


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command()
def check(spec: SpecArgument, data: DataOption = None) -> None:
    """Read everything, fit nothing, say what was found."""
    _, measurements, problem = load(spec, data)
    out = Console()
    curves = measurements.curves
    out.print(_curve_table(curves))
    if len(curves) > MANY:
        out.print(f"... and {len(curves) - MANY} more")
    out.print(_parameter_table(problem.parameters))
    fixed = ", ".join(f"{p.name} = {p.value:g} {p.unit}" for p in problem.parameters if p.fixed)
    out.print(f"Fixed: {fixed or 'none'}", highlight=False)
    lanes, bad = len(problem.curves), len(measurements.bad)
    joint = ", fitted jointly" if problem.joint else ""
    out.print(f"{lanes} lane(s){joint} of up to {problem.size} unknowns, {bad} bad curves")
    raise typer.Exit(1 if bad else 0)


@app.command()
def fit(
    spec: SpecArgument,
    data: DataOption = None,
    out_dir: OutOption = None,
    leave_one_out: LeaveOption = False,
    profile: ProfileOption = False,
    influence: InfluenceOption = False,
    resume: cli_fit.ResumeOption = False,
    rerun_failed: cli_fit.RerunOption = False,
    force: cli_fit.ForceOption = False,
    distributed: cli_fit.DistributedOption = False,
    coordinator: cli_fit.CoordinatorOption = None,
    processes: cli_fit.ProcessesOption = None,
    process: cli_fit.ProcessOption = None,
    patience: cli_fit.PatienceOption = 100.0,
) -> None:
    """Fit, write results.h5, tables, report, plots."""
    from jaxtrachea.identify.study import settings_of

    clock = [time.perf_counter()]
    meeting = cli_fit.meet(distributed, coordinator, processes, process, patience)
    default = Path("out") / f"{spec.absolute().parent.name}-{spec.stem}"
    how = cli_fit.How(out_dir, default, resume, rerun_failed, force, meeting)
    cli_fit.check_options(how)
    asked = {"leave-one-out": leave_one_out, "profile": profile, "influence": influence}
    options = [name for name, wanted in asked.items() if wanted]
    loaded, measurements, problem = load(spec, data, refits=bool(options))
    root = spec.parent if data is None else data
    now = cli_fit.describe(how, spec, root, loaded, measurements, problem, options)
    if meeting.process > 0:
        cli_fit.help_out(how, now, problem, settings_of(loaded))
        raise typer.Exit(0)
    if leave_one_out:
        _can_leave_out(problem)
    names = _names_to_profile(spec, loaded, problem, profile)
    if loaded.uncertainty.posterior:
        _can_draw(spec)
    clock.append(time.perf_counter())
    with cli_fit.running(how, now, problem, settings_of(loaded)) as run:
        names = _names_to_profile(spec, loaded, problem, "profile" in run.options)
        found = _run(loaded, problem, run.settings, run.options, names, run.stop_if_asked, run.fit)
        clock.append(time.perf_counter())
        _write(run.folder, spec, loaded, measurements, found, clock, run.journal)
    result = found.result
    _print_result(found, run.folder.parent)
    failed = any(not _succeeded(result, lane) for lane in range(result.lanes))
    raise typer.Exit(1 if failed or measurements.bad else 0)


@app.command()
def design(spec: SpecArgument, data: DataOption = None, out_dir: OutOption = None) -> None:
    """Fit, then say where the next presses tell most."""
    from jaxtrachea.config import SpecError
    from jaxtrachea.identify.study import candidates_of, settings_of

    loaded, measurements, problem = load(spec, data, refits=True)
    try:
        candidates = candidates_of(loaded, problem)
    except SpecError as error:
        raise Stop(f"{spec}: {error}") from None
    if loaded.uncertainty.posterior:
        _can_draw(spec)
    default = Path("out") / f"{spec.absolute().parent.name}-{spec.stem}-design"
    with into(out_dir, default) as (folder, stop_if_asked):
        found = _run(loaded, problem, settings_of(loaded), (), (), stop_if_asked)
        try:
            rows = _design(folder, loaded, found, candidates)
        except ValueError as error:
            raise Stop(f"{spec}: {error}") from None
    errors = [k.removesuffix(" relative se") for k in rows[0] if k.endswith(" relative se")]
    head = ["press", "s [mm]", "depth [mm]", *errors]
    cells = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    out = Console()
    out.print(table("Next presses, relative errors expected after each", head, cells))
    out.print(f"written to {escape(str(folder.parent))}", highlight=False, soft_wrap=True)
    raise typer.Exit(1 if measurements.bad else 0)


def _design(folder: Path, loaded, found, candidates) -> list[dict[str, object]]:
    """Choose, write the files, return the rows of the choice."""
    import numpy as np

    from jaxtrachea.identify import design as designs
    from jaxtrachea.identify import design_tables as tables
    from jaxtrachea.identify.results import write_csv
    from jaxtrachea.plots import draw_design

    section = loaded.design
    known = designs.situation(found.result, found.resampled)
    unknowns = tables.names(known, found.result)
    choice = designs.next_points(known, candidates, section.points, section.criterion)
    s = np.linspace(candidates.s.min(), candidates.s.max(), 121)
    chart = designs.identifiability(known, s, float(candidates.depth.max()))
    rows = list(tables.choice_rows(choice, candidates, unknowns))
    write_csv(folder / "next_points.csv", rows)
    gains = designs.gains(known, candidates)
    write_csv(folder / "candidates.csv", list(tables.candidate_rows(known, gains, candidates)))
    write_csv(folder / "identifiability.csv", list(tables.map_rows(chart, unknowns)))
    rings = np.asarray(found.result.problem.geometry.ring_positions)
    draw_design(folder / "identifiability.png", chart, candidates, choice, rings)
    return rows


def _can_leave_out(problem) -> None:
    from jaxtrachea.identify.predictions import curves_to_leave_out

    try:
        curves_to_leave_out(problem)
    except ValueError as error:
        raise Stop(f"--leave-one-out: {error}") from None


def _can_draw(spec: Path) -> None:
    from jaxtrachea.identify.posterior import MissingSampler, sampler

    try:
        sampler()
    except MissingSampler as error:
        raise Stop(f"{spec}: uncertainty.posterior: {error}") from None


def _names_to_profile(path: Path, spec, problem, asked: bool) -> tuple[str, ...]:
    from jaxtrachea.config import SpecError
    from jaxtrachea.identify.study import profiled

    try:
        return profiled(spec, problem, asked=asked)
    except SpecError as error:
        raise Stop(f"{path}: {error}") from None


@dataclasses.dataclass(frozen=True)
class _Found:
    """What a run has computed; None: not asked for."""

    result: Any
    left_out: Any
    profiles: Any
    resampled: Any
    influence: Any = None
    posterior: Any = None
    population: Any = None


def _run(
    spec, problem, settings, options, profile: tuple[str, ...], stop_if_asked, fit=None
) -> _Found:
    """Fit, by `fit` if given, then what needs a fit; all with `settings`."""
    from jaxtrachea.identify.bootstrap import bootstrap
    from jaxtrachea.identify.fit import fit as in_one_go
    from jaxtrachea.identify.influence import influence as diagnose
    from jaxtrachea.identify.posterior import posterior as draw
    from jaxtrachea.identify.predictions import leave_one_out
    from jaxtrachea.identify.profile import profiles

    with progress_bar() as bar:

        def counted(text):
            task = bar.add_task(text, total=None)

            def advance(done, of):
                stop_if_asked()
                bar.update(task, advance=done, total=of or None)

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
        specimens = _population(spec, result)
        return _Found(result, left_out, profiled, resampled, found, drawn, specimens)


def _population(spec, result):
    """The specimens as a sample, or None with a word why not if it was asked for."""
    from jaxtrachea.identify.population import population, wanted

    if not wanted(spec.fit.population, result):
        return None
    try:
        return population(result)
    except ValueError as error:
        to_stderr(f"[yellow]no population:[/] {escape(str(error))}")
        return None


def _write(folder: Path, spec: Path, loaded, measurements, found: _Found, clock, journal) -> None:
    """All files of one run; `clock`: when reading began, ended, and the fit ended."""
    import json

    import jax

    from jaxtrachea import report
    from jaxtrachea.identify import results
    from jaxtrachea.identify.population import population_rows
    from jaxtrachea.identify.posterior_tables import rows_with_draws, write_draws
    from jaxtrachea.identify.predictions import predictions
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
    more = write_more(folder, found.influence, found.posterior)
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


def _succeeded(result, lane: int) -> bool:
    from jaxtrachea.identify.results import succeeded

    return succeeded(result, lane)


def _print_result(found: _Found, folder: Path) -> None:
    from jaxtrachea import report
    from jaxtrachea.identify.results import lane_label, verdict_sentence

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
        good = sum(_succeeded(result, lane) for lane in lanes)
        out.print(f"{good} of {result.lanes} lanes succeeded")
    out.print(f"written to {escape(str(folder))}", highlight=False, soft_wrap=True)


def _curve_table(curves) -> Table:
    rows = []
    for curve in curves[:MANY]:
        where = "–" if curve.s_c is None else f"{curve.s_c:.4g}"
        markers = 0 if curve.joint_displacement is None else curve.joint_displacement.shape[1]
        spans = [f"{v.min():.3g} … {v.max():.3g}" for v in (curve.displacement, curve.force)]
        row = [curve.specimen, curve.trial, where, str(len(curve.force)), *spans, str(markers)]
        rows.append(row)
    head = ["specimen", "trial", "s [mm]", "n", "D [mm]", "F [N]", "markers"]
    return table(f"{len(curves)} usable curves", head, rows)


def _parameter_table(parameters) -> Table:
    head = ["free parameter", "what", "initial", "bounds", "scale", "scope"]
    rows = [
        [f"{p.name} [{p.unit}]", p.description, f"{p.value:g}", f"{p.lower:g} … {p.upper:g}",
         p.scale, p.scope] for p in parameters if not p.fixed
    ]  # fmt: skip
    return table("Free parameters", head, rows)
