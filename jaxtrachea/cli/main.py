"""The command line: the only room that turns errors into messages and exit codes.

Exit codes: 0 everything converged, 1 some lane failed, some curve could not be used or the chains
of a posterior are poor, 2 bad input, 3 another process was lost, 130 stopped by the user. What is
heavy is imported inside the commands.
"""

import atexit
import contextlib
import dataclasses
import gc
import itertools
import math
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from jaxtrachea import __version__
from jaxtrachea.cli import cache as cli_cache
from jaxtrachea.cli import compare as cli_compare
from jaxtrachea.cli import convert as cli_convert
from jaxtrachea.cli import demo as cli_demo
from jaxtrachea.cli import fit as cli_fit
from jaxtrachea.cli import init as cli_init
from jaxtrachea.cli import predict as cli_predict
from jaxtrachea.cli import scene as cli_scene
from jaxtrachea.cli import selfcheck as cli_selfcheck
from jaxtrachea.cli import tradeoff as cli_tradeoff
from jaxtrachea.cli import view as cli_view
from jaxtrachea.cli.file_options import CheckOptions
from jaxtrachea.cli.load import load, with_zeros_of_fits
from jaxtrachea.cli.options import DataOption, FitOptions, OutOption, SpecArgument, with_fields
from jaxtrachea.cli.run import poor, refuse, run, show, write, write_tables
from jaxtrachea.cli.sources import specification_in
from jaxtrachea.cli.terminal import (
    Kept,
    Stop,
    complain,
    into,
    quiet_compiler,
    say,
    say_lost,
    to_stderr,
)

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help=(
        "Mechanics of the trachea: identify stiffnesses from force-displacement curves "
        "(demo, check, init, fit, predict, design, compare, convert); simulate a tool on a trachea "
        "(plan, simulate, sweep, view, play)."
    ),
)
#: Rows of a terminal table; the files hold all.
MANY = 40
#: Objects made between two searches for garbage. Python's 700 look through what is imported, which
#: stays, again and again: 0.3 s of a start.
NEW_OBJECTS = 50_000


def main() -> None:
    """Entry point: every expected error becomes one message on stderr and an exit code."""
    gc.set_threshold(NEW_OBJECTS)
    atexit.register(gc.freeze)  # the search at Python's end would take 0.25 s
    quiet_compiler()
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
    except OSError as error:  # none of the folders: those say where and what is kept
        code = complain(_not_shown(error))
    except Exception as error:
        # Usage errors come from click or from typer's own copy of it, whichever is installed.
        usage = getattr(error, "format_message", None)
        if usage is None:
            raise
        if len(sys.argv) == 1:  # no command: the help
            typer.echo(usage())
            sys.exit(0)
        code = complain(usage())
    if code == 130:  # some versions of typer turn Ctrl-C into this exit code themselves
        to_stderr("stopped; nothing was written")
    elif (traces := sys.modules.get("jaxtrachea.files.traces")) is not None:
        traces.optimise_afterwards()
    sys.exit(code or 0)


def _not_shown(error: OSError) -> str:
    """What is said where the terminal, or what stands for it, takes no more text."""
    with contextlib.suppress(OSError):
        sys.stdout.close()  # not tried again as Python ends
    reason = error.strerror or str(error)
    return f"{error.filename or 'the output'}: {reason}; files said to be kept or written are there"


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command()
def demo(folder: cli_demo.FolderArgument = Path("jaxtrachea-demo")) -> None:
    """Write an example into a new folder and fit its curves."""
    cli_demo.write_example(folder)
    say(f"{folder}: curves of a finite-element trachea, a fit of them, a scene")
    try:
        fit(spec=folder / "fit.toml", out_dir=folder / "fit")
    except typer.Exit:
        say(*cli_demo.next_steps(folder), wrap=False)
        raise


@app.command()
@with_fields(CheckOptions)
def check(options: CheckOptions) -> None:
    """Read a specification or data files, show what a fit would use."""
    from jaxtrachea.cli.specification import settings_of
    from jaxtrachea.inference.analysis import Request
    from jaxtrachea.report.understood import understood

    if (spec := specification_in(options)) is None:
        sources = cli_init.read_and_show(options)
        _print_curves(sources.measurements.curves)
        cli_init.conclude(options, sources)
        return
    loaded, measurements, study = load(spec, options.data)
    refuse(spec, Request(loaded, study, settings_of(loaded)))
    _print_curves(measurements.curves, study.weighs_noise)
    say(*understood(loaded, study))
    if study.free:
        say(_parameter_table(study))
    fixed = ", ".join(f"{p.name} = {p.value:g} {p.unit}" for p in study.parameters if p.fixed)
    say(f"Fixed: {fixed or 'none'}")
    lanes, bad = len(study.curves), len(measurements.bad)
    joint = ", fitted jointly" if study.joint else ""
    say(f"{lanes} fit(s){joint} of up to {study.size} unknowns, {bad} bad curves")
    raise typer.Exit(1 if bad else 0)


app.command()(cli_init.init)


@app.command()
@with_fields(FitOptions)
def fit(options: FitOptions) -> None:
    """Identify stiffnesses from curves; write report, tables, plots."""
    from jaxtrachea.cli.specification import settings_of
    from jaxtrachea.inference.analysis import Request
    from jaxtrachea.report.overview import overview
    from jaxtrachea.report.understood import understood

    clock = [time.perf_counter()]
    spec = options.spec
    cli_fit.check_options(options)
    analyses = sorted({*options.analyses, *cli_fit.remembered(options)})
    loaded, measurements, study = load(spec, options.data, refits=bool(analyses))
    request = Request(loaded, study, settings_of(loaded), analyses)
    refuse(spec, request)
    devices = cli_fit.worker_devices(options)
    now = cli_fit.describe(options, loaded, measurements, study, analyses, devices)
    clock.append(time.perf_counter())
    with cli_fit.running(options, now, study, request.settings, devices) as under:
        changed = {"settings": under.settings, "options": under.options}
        findings = run(dataclasses.replace(request, **changed), under.stop_if_asked, under.fit)
        clock.append(time.perf_counter())
        measurements = with_zeros_of_fits(measurements, findings.result)
        for name, reason in findings.unavailable.items():
            to_stderr(f"[yellow]no {name}:[/] {escape(reason)}")
        write(under.folder, spec, loaded, measurements, findings, clock, under.manifest)
    lines = understood(loaded, findings.result.study, findings.result)
    show(itertools.chain(lines, overview(findings)), under.folder.parent)
    failed = not findings.result.succeeded.all()
    raise typer.Exit(1 if failed or measurements.bad or poor(findings) else 0)


app.command()(cli_predict.predict)


@app.command()
def design(spec: SpecArgument, data: DataOption = None, out_dir: OutOption = None) -> None:
    """Fit, then show where further presses would tell most."""
    from jaxtrachea.cli.specification import settings_of
    from jaxtrachea.inference.analysis import Request
    from jaxtrachea.report.plots import draw_analyses

    loaded, measurements, study = load(spec, data, refits=True)
    request = Request(loaded, study, settings_of(loaded), command="design")
    refuse(spec, request)
    default = Path("out") / f"{spec.absolute().parent.name}-{spec.stem}-design"
    with into(out_dir, default) as (folder, stop_if_asked):
        findings = run(request, stop_if_asked)
        for reason in findings.unavailable.values():
            raise Stop(f"{spec}: {reason}")
        write_tables(folder, findings)
        say_lost(draw_analyses(folder, findings, loaded.output.format))
    chosen = (analysis.terminal(found, []) for analysis, found in findings.at("design"))
    show(itertools.chain.from_iterable(chosen), folder.parent)
    raise typer.Exit(1 if measurements.bad else 0)


for _command in (
    cli_compare.compare, cli_convert.convert, cli_scene.plan, cli_scene.simulate, cli_scene.sweep,
    cli_view.view, cli_view.play, cli_tradeoff.tradeoff, cli_selfcheck.selfcheck, cli_cache.cache,
):  # fmt: skip
    app.command()(_command)


def _print_curves(curves, weighed: bool = False) -> None:
    """The first curves, one a row, and what is used of them."""
    say(_curve_table(curves))
    _print_usage(curves, weighed)


def _print_usage(curves, weighed: bool) -> None:
    """What is used of the curves that are not used whole, and what is doubtful about them."""
    from jaxtrachea.measurements.usage_tables import sentences, usage_lines
    from jaxtrachea.trials.repeats import trial_sentences

    told = [c for c in curves if usage_lines([c])]
    say(*usage_lines(told[:MANY]))
    if len(told) > MANY:
        say(f"... and {len(told) - MANY} more curves not used whole; a fit lists all")
    for sentence in [*sentences(curves), *trial_sentences(curves, weighed=weighed)]:
        say(f"{sentence[:1].upper()}{sentence[1:]}.")


def _curve_table(curves):
    """Curves, one a row; angle and vectors only where some curve has them."""
    from jaxtrachea.files.table import Column, Table
    from jaxtrachea.measurements.vectors import vector_words

    turned, several = any(c.phi_c for c in curves), any(map(vector_words, curves))
    rows = [
        {
            "specimen": c.specimen,
            "trial": c.trial,
            "s [mm]": c.s_c,
            "phi [deg]": math.degrees(c.phi_c),
            "n": len(c.force),
            "of": len(c.force) if c.usage is None else c.usage.recorded,
            "D [mm]": (float(c.displacement.min()), float(c.displacement.max())),
            "F [N]": (float(c.force.min()), float(c.force.max())),
            "markers": 0 if c.joint_displacement is None else c.joint_displacement.shape[1],
            "vectors": vector_words(c),
        }
        for c in curves
    ]
    spans = [Column(name, digits=3) for name in ("D [mm]", "F [N]")]
    columns = [
        *map(Column, ("specimen", "trial", "s [mm]", *(["phi [deg]"] if turned else []))),
        Column("n"), Column("of"), *spans, Column("markers"),
        *([Column("vectors", left=True)] if several else []),
    ]  # fmt: skip
    shown = Table(rows, columns, title=f"{len(curves)} usable curves")
    return shown.first(MANY, "... and {} more")


def _parameter_table(study):
    """Free parameters; of those that are `auto`, how many curves have one."""
    from jaxtrachea.files.table import words
    from jaxtrachea.fitting.onset import where_sought

    head = ["free parameter", "what", "initial", "bounds", "scale", "scope"]
    own = study.lanes.index >= 0
    curves = sum(map(len, study.curves))
    rows = [
        [f"{p.name} [{p.unit}]", p.description,
         *where_sought(p, study.parameters, study.model.options), p.scale,
         f"{p.scope}, {own[:, :, j].sum()} of {curves}" if p.auto else p.scope]
        for j, p in enumerate(study.parameters) if not p.fixed
    ]  # fmt: skip
    return words("Free parameters", head, rows)
