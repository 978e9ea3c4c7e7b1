"""The command predict: what a finished fit says of other curves (docs/after_a_fit.md)."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from jaxtrachea.cli.load import print_bad
from jaxtrachea.cli.predict_data import measured_curves
from jaxtrachea.cli.terminal import Stop, into, say, say_lost, say_written, set_up_jax, to_stderr

ResultsArgument = Annotated[
    Path, typer.Argument(help="Folder of a finished fit, or its results.h5.")
]
FilesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[FILE]...", help="Further files of --data.")
]
AtOption = Annotated[
    list[str] | None,
    typer.Option(
        "--at",
        metavar="s=75,D=0:6:0.5",
        help="Contact position and displacement, mm (and phi, tilt, deg; where the force relaxes "
        "speed=5 mm/s, hold=30 s); repeatable.",
    ),
]
DataOption = Annotated[
    list[str] | None,
    typer.Option("--data", metavar="SPEC|FILE", help="Measured curves to compare with."),
]
OutOption = Annotated[Path | None, typer.Option("--out", help="New folder for the predictions.")]
AsOption = Annotated[
    str | None,
    typer.Option("--as", metavar="SPECIMEN", help="Take unknown specimens for this one."),
]


def predict(
    results: ResultsArgument,
    files: FilesArgument = None,
    at: AtOption = None,
    data: DataOption = None,
    out_dir: OutOption = None,
    as_specimen: AsOption = None,
) -> None:
    """Predict force curves from a finished fit, with 95 % bands."""
    from jaxtrachea.results.read import NoResults, read_results

    set_up_jax()
    given = [*(data or []), *(files or [])]
    if bool(at) == bool(given):
        raise Stop(
            "predict: give either --at (where and how deep, as in --at s=75,D=0:6:0.5) or --data "
            "(a specification or files of measured curves)"
        )
    if files and not data:
        raise Stop(f"predict: {files[0]}: files of measured curves come after --data")
    try:
        stored = read_results(results)
    except NoResults as error:
        raise Stop(str(error)) from None
    except OSError as error:
        raise Stop(f"{results}: cannot be read ({error.strerror}); check its rights") from None
    path = stored.origin.path
    known = dict.fromkeys(c.specimen for lane in stored.study.curves for c in lane)
    if as_specimen is not None and as_specimen not in known:
        raise Stop(f"--as: {_unknown('specimen', as_specimen, known)}")
    name = path.absolute().parent
    default = Path("out") / f"{name.name}-predict"
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if at:
        code = _predict_at(stored, at, out_dir, default, digest)
    else:
        code = _predict_data(stored, given, as_specimen, out_dir, default, digest)
    raise typer.Exit(code)


def _unknown(kind: str, name: str, known) -> str:
    from jaxtrachea.prediction.predict import unknown_name

    return unknown_name(kind, name, known)


def _predict_at(stored, texts: Sequence[str], out_dir, default: Path, digest: str) -> int:
    """Predictions at chosen positions; returns the exit code."""
    import numpy as np

    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.files.pictures import without_lost
    from jaxtrachea.files.table import Table
    from jaxtrachea.prediction import report, tables
    from jaxtrachea.prediction.curves import predict_sources
    from jaxtrachea.prediction.plots import draw_predictions

    sources, s, depths, aside, times = _asked(stored, texts)
    with into(out_dir, default) as (folder, stop_if_asked):
        curves = predict_sources(stored, sources, s, depths, aside=aside, times=times)
        stop_if_asked()
        rings = np.asarray(stored.study.model.geometry.ring_positions)
        rows = {
            "predictions": [r for p in curves for r in tables.prediction_rows(p)],
            "bands": [r for p in curves for r in tables.band_rows(p)],
        }
        if any(p.has_skeleton for p in curves):
            every = (tables.joint_rows(p, rings, range(len(p.displacement))) for p in curves)
            rows["joints"] = [r for of_curve in every for r in of_curve]
        for name, content in rows.items():
            Table(content).write_csv(folder / f"{name}.csv")
        lost = draw_predictions(folder, curves)
        say_lost(lost)
        text = without_lost(report.report_at(stored, digest, curves), lost)
        write_text(folder / "report.md", text)
    _show("Predictions, at the deepest displacement, of a hold at its end", report.at_table(curves))
    _end(report.outcomes(curves), folder.parent)
    return 0 if all(p.status.predicts for p in curves) else 1


def _asked(stored, texts: Sequence[str]):
    """Sources, positions, displacements, angle with direction, and times, of every --at."""
    from jaxtrachea.measurements.presses import parse_presses
    from jaxtrachea.prediction.predict import check_off_midline, check_position, check_timed
    from jaxtrachea.prediction.pressed import pressed
    from jaxtrachea.prediction.sources import source_of

    fitted = pressed(stored)
    needs = stored.study.model.options.coupling == "series"
    sources, places, depths, aside, times = [], [], [], [], []
    for text in texts:
        try:
            asked = parse_presses(text, needs_position=needs)
            check_off_midline(stored, asked.phi, asked.direction)
            check_timed(stored, asked.time is not None, "speed (as speed=5 mm/s), and hold")
            names = fitted.specimens if asked.specimen is None else (asked.specimen,)
            if asked.specimen is not None and asked.specimen not in fitted.specimens:
                raise ValueError(_unknown("specimen", asked.specimen, fitted.specimens))
            s = [float("nan")] if asked.s is None else asked.s.tolist()
            for place in s:
                if asked.s is not None:
                    check_position(stored, place)
            trials = dict.fromkeys(c.trial for c in fitted.curves if c.specimen in names)
            if asked.trial is not None and asked.trial not in trials:
                raise ValueError(_unknown("trial", asked.trial, tuple(trials)))
        except ValueError as error:
            raise Stop(f"--at {text}: {error}") from None
        for name in names:
            source = source_of(stored, name, asked.trial)
            for place in s:
                sources.append(source)
                places.append(place)
                depths.append(asked.displacement)
                aside.append((asked.phi, asked.direction))
                times.append(asked.time)
    return sources, places, depths, aside, times if stored.study.model.relaxes else None


def _predict_data(stored, given: Sequence[str], as_specimen, out_dir, default, digest) -> int:
    """Measured curves against predictions; returns the exit code."""
    import numpy as np

    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.files.pictures import without_lost
    from jaxtrachea.files.table import Table
    from jaxtrachea.fitting.refusals import as_read
    from jaxtrachea.prediction import report, tables
    from jaxtrachea.prediction.held_out import compare, pressable
    from jaxtrachea.prediction.plots import draw_compared

    measurements, notes = measured_curves(stored, given)
    curves, unusable = pressable(stored, measurements.curves)
    curves, unused = as_read(curves, stored.study.model.level)
    notes += [] if unused is None else [unused]
    bad = [*measurements.bad, *unusable]
    print_bad(dataclasses.replace(measurements, bad=tuple(bad)))
    if not curves:
        raise Stop("--data: no usable curve; nothing was predicted, nothing was written")
    with into(out_dir, default) as (folder, stop_if_asked):
        compared = compare(stored, curves, as_specimen=as_specimen)
        stop_if_asked()
        rings = np.asarray(stored.study.model.geometry.ring_positions)
        rows = {"predictions": [], "bands": [], "joints": []}
        for c in compared:
            p = c.prediction
            rows["predictions"] += tables.prediction_rows(p, c.curve)
            rows["bands"] += tables.band_rows(p)
            deepest = [int(np.argmax(np.abs(p.displacement)))]
            rows["joints"] += tables.joint_rows(p, rings, deepest, _markers(c, len(rings)))
        if not any(c.prediction.has_skeleton for c in compared):
            del rows["joints"]
        for name, content in rows.items():
            Table(content).write_csv(folder / f"{name}.csv")
        errors = tables.error_rows(compared, bad, stored.origin.reading.get("tool_radius"), rings)
        Table(errors).write_csv(folder / "errors.csv")
        lost = draw_compared(folder, compared)
        say_lost(lost)
        text = report.report_data(stored, digest, compared, bad, errors, notes)
        write_text(folder / "report.md", without_lost(text, lost))
    for note in notes:
        to_stderr(f"[yellow]note:[/] {escape(note)}")
    _show("Measured against predicted, worst first", report.error_table(errors))
    _end(report.outcomes([c.prediction for c in compared]), folder.parent)
    good = all(c.prediction.status.predicts for c in compared)
    return 0 if good and not bad else 1


def _markers(compared, rings: int):
    """Markers in the columns of their rings, or None."""
    import numpy as np

    curve = compared.curve
    if curve.joint_displacement is None:
        return None
    found = np.full((len(curve.force), rings), np.nan)
    found[:, curve.joint_rings] = curve.joint_displacement
    return found


def _show(title: str, shown) -> None:
    shown.title = title
    if shown:
        say(shown)


def _end(lines: Sequence[str], folder: Path) -> None:
    say(*lines)
    say_written(folder)
