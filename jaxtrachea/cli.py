"""The command line: check, fit. The only room that turns errors into messages and exit codes.

Exit codes: 0 everything converged, 1 some lane failed or some curve could not be used, 2 bad input.
"""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from jaxtrachea import __version__

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Identify the mechanics of a trachea from force-displacement curves.",
)
out, err = Console(), Console(stderr=True)

SpecArgument = Annotated[Path, typer.Argument(help="TOML specification of the fit.")]
DataOption = Annotated[
    Path | None, typer.Option("--data", help="Folder the data paths start from (default: SPEC's).")
]


class _Stop(Exception):
    """End the command with a message and an exit code."""

    def __init__(self, message: str, code: int = 2):
        super().__init__(message)
        self.code = code


def main() -> None:
    """Entry point: every expected error becomes one message on stderr and an exit code."""
    try:
        code = app(standalone_mode=False)
    except _Stop as stop:
        err.print(f"[bold red]error:[/] {escape(str(stop))}", highlight=False, soft_wrap=True)
        code = stop.code
    except typer.Exit as stop:
        code = stop.exit_code
    except typer.Abort:
        err.print("stopped")
        code = 130
    except Exception as error:
        usage = getattr(error, "format_message", None)
        if usage is None:
            raise
        err.print(f"[bold red]error:[/] {escape(usage())}", highlight=False, soft_wrap=True)
        code = 2
    except KeyboardInterrupt:
        err.print("stopped")
        code = 130
    sys.exit(code or 0)


def _load(path: Path, data: Path | None):
    """Specification and measurements; input errors become `_Stop`."""
    from jaxtrachea.config import SpecError, load_fit_spec
    from jaxtrachea.identify.measurements import DataError
    from jaxtrachea.identify.study import read_data

    try:
        spec = load_fit_spec(path)
        return spec, read_data(spec, path.parent if data is None else data)
    except (SpecError, DataError) as error:
        raise _Stop(str(error)) from None


def _problem(spec, measurements):
    from jaxtrachea.config import SpecError
    from jaxtrachea.identify.study import problem_of

    try:
        return problem_of(spec, measurements)
    except SpecError as error:
        raise _Stop(str(error)) from None


def _table(title: str, head, rows) -> Table:
    table = Table(title=title, title_justify="left", header_style="bold")
    for i, name in enumerate(head):
        table.add_column(name, justify="left" if i == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def _print_bad(measurements) -> None:
    for bad in measurements.bad[:20]:
        name = escape(f"{bad.specimen} {bad.trial}")
        text = escape(f"{bad.kind}: {bad.source}: {bad.message}; {bad.cure}")
        err.print(f"[yellow]not usable:[/] {name}: {text}", highlight=False, soft_wrap=True)
    if len(measurements.bad) > 20:
        err.print(f"... and {len(measurements.bad) - 20} more, see summary.csv")


def _use_float64() -> None:
    import jax

    jax.config.update("jax_enable_x64", True)


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        out.print(__version__)
        raise typer.Exit


@app.command()
def check(spec: SpecArgument, data: DataOption = None) -> None:
    """Read everything, fit nothing, say what was found."""
    loaded, measurements = _load(spec, data)
    _print_bad(measurements)
    if not measurements.curves:
        raise _Stop("no usable curve")
    _use_float64()
    problem = _problem(loaded, measurements)
    curves = measurements.curves
    rows = []
    for curve in curves[:40]:
        where = "–" if curve.s_c is None else f"{curve.s_c:.4g}"
        markers = 0 if curve.joint_displacement is None else curve.joint_displacement.shape[1]
        spans = [f"{v.min():.4g} … {v.max():.4g}" for v in (curve.displacement, curve.force)]
        rows.append([curve.specimen, curve.trial, where, str(len(curve.force)), *spans,
                     str(markers)])  # fmt: skip
    head = ["specimen", "trial", "s [mm]", "samples", "displacement [mm]", "force [N]", "markers"]
    out.print(_table(f"{len(curves)} usable curves", head, rows))
    if len(curves) > 40:
        out.print(f"... and {len(curves) - 40} more")
    free = [p for p in problem.parameters if not p.fixed]
    rows = [
        [p.name, p.unit, p.description, f"{p.value:g}", f"{p.lower:g} … {p.upper:g}", p.scale,
         p.scope] for p in free
    ]  # fmt: skip
    head = ["parameter", "unit", "what", "initial", "bounds", "scale", "scope"]
    out.print(_table("Free parameters", head, rows))
    fixed = ", ".join(f"{p.name} = {p.value:g} {p.unit}" for p in problem.parameters if p.fixed)
    out.print(f"Fixed: {fixed or 'none'}", highlight=False)
    lanes = len(problem.curves)
    out.print(
        f"{lanes} lane(s) of up to {problem.size} unknowns, {len(measurements.bad)} bad curves"
    )
    raise typer.Exit(1 if measurements.bad else 0)


@app.command()
def fit(
    spec: SpecArgument,
    data: DataOption = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="New folder for the results.")
    ] = None,
    leave_one_out: Annotated[
        bool, typer.Option("--leave-one-out", help="Also predict every curve from the others.")
    ] = False,
) -> None:
    """Fit the parameters; write results.h5, summary.csv, parameters.csv, report.md and plots."""
    clock = {"start": time.perf_counter()}
    loaded, measurements = _load(spec, data)
    _print_bad(measurements)
    if not measurements.curves:
        raise _Stop("no usable curve; nothing was fitted and nothing written")
    _use_float64()
    problem = _problem(loaded, measurements)
    folder = _folder(out_dir, Path("out") / f"{spec.parent.name}-{spec.stem}")
    clock["read"] = time.perf_counter()
    result, left_out = _run(loaded, problem, leave_one_out)
    clock["fit"] = time.perf_counter()
    _write(folder, spec, loaded, measurements, result, left_out, clock)
    _print_result(result, folder)
    failed = any(not _succeeded(s) for s in result.status)
    raise typer.Exit(1 if failed or measurements.bad else 0)


def _folder(wanted: Path | None, default: Path) -> Path:
    from jaxtrachea.identify.results import OutputExists, new_directory

    try:
        return new_directory(wanted, default)
    except OutputExists as error:
        raise _Stop(str(error)) from None
    except OSError as error:
        raise _Stop(f"{wanted or default}: {error.strerror}; choose another --out") from None


def _run(spec, problem, leave_out: bool):
    from jaxtrachea.identify.fit import fit as run_fit
    from jaxtrachea.identify.predictions import leave_one_out
    from jaxtrachea.identify.study import settings_of

    settings = settings_of(spec)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn())  # fmt: skip
    with Progress(*columns, console=err, transient=False) as bar:
        task = bar.add_task("fitting", total=None)
        result = run_fit(
            problem, settings, lambda done, of: bar.update(task, advance=done, total=of)
        )
        left_out = None
        if leave_out:
            second = bar.add_task("leaving curves out", total=None)
            report = lambda done, of: bar.update(second, advance=done, total=of)  # noqa: E731
            try:
                left_out = leave_one_out(problem, settings, report)
            except ValueError as error:
                raise _Stop(f"--leave-one-out: {error}") from None
    return result, left_out


def _write(folder, spec, loaded, measurements, result, left_out, clock) -> None:
    """All files of one run."""
    import json

    import jax

    from jaxtrachea import report
    from jaxtrachea.identify import results
    from jaxtrachea.identify.predictions import predictions

    seen = predictions(result.problem, result.theta)
    from jaxtrachea.plots import draw_all

    rows = [*results.lane_rows(result), *map(results.bad_row, measurements.bad)]
    results.write_csv(folder / "summary.csv", rows)
    results.write_csv(folder / "parameters.csv", list(results.parameter_rows(result)))
    draw_all(folder, result, seen)
    table = None if left_out is None else report.left_out_rows(result, left_out)
    text = report.report_text(loaded.title or spec.stem, result, measurements.bad, seen, table)
    results.write_text(folder / "report.md", text)
    timings = {"read": clock["read"] - clock["start"], "fit": clock["fit"] - clock["read"]}
    timings["write"] = time.perf_counter() - clock["fit"]
    made = results.provenance(
        spec, measurements.sha256(), str(jax.devices()[0]), loaded.fit.precision, timings
    )
    results.write_hdf5(folder / "results.h5", result, made)
    results.write_text(folder / "provenance.json", json.dumps(made, indent=2) + "\n")


def _print_result(result, folder: Path) -> None:
    from jaxtrachea import report
    from jaxtrachea.identify.results import flat_sentence

    lanes = range(result.lanes)
    if result.lanes <= report.ONE_BY_ONE:
        rows = report.estimate_rows(result, lanes)
        out.print(_table("Estimates", report.ESTIMATE_HEAD, rows))
        out.print(_table("Quality", report.QUALITY_HEAD, report.quality_rows(result, lanes)))
        for lane in lanes:
            name = result.problem.lane_name(lane)[0]
            out.print(escape(f"{name}: {flat_sentence(result, lane)}"), highlight=False)
    else:
        out.print(_table("Estimates over lanes", report.SPREAD_HEAD, report.spread_rows(result)))
        good = sum(map(_succeeded, result.status))
        out.print(f"{good} of {result.lanes} lanes succeeded")
    out.print(f"written to {folder}", highlight=False, soft_wrap=True)


def _succeeded(status) -> bool:
    from jaxtrachea.status import FitStatus

    return FitStatus(int(status)).succeeded
