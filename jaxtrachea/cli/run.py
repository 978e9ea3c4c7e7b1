"""One run of a fit: everything that was asked for, computed, written and shown."""

import time
from collections.abc import Iterator
from pathlib import Path

from rich.markup import escape

from jaxtrachea._memory import give_back
from jaxtrachea.cli.beside import beside, load_beside
from jaxtrachea.cli.terminal import (
    Stages,
    Stop,
    progress_bar,
    say,
    say_lost,
    say_written,
    to_stderr,
)

#: Fits of a study whose programs, some 200 MB, are let go before its results take their room.
LARGE = 1000


def refuse(path: Path, request) -> None:
    """End the command where something asked for cannot be done; say what it leaves out."""
    from jaxtrachea.config import SpecError
    from jaxtrachea.inference import analyses

    try:
        analyses.refuse(request)
    except SpecError as error:
        raise Stop(f"{path}: {error}") from None
    if names := ", ".join(analyses.left_out(request)):
        text = f"{path}: {names}: left out by {request.command}; fit does what they ask for"
        to_stderr(f"[yellow]note:[/] {escape(text)}")


def run(request, stop_if_asked, fit=None):
    """Fit, by `fit` if given, then what needs a fit; the `AnalysisResults`."""
    from jaxtrachea.fitting.fit import fit as in_one_go
    from jaxtrachea.fitting.fit import with_omitted_zeros
    from jaxtrachea.inference.analyses import analyse
    from jaxtrachea.optimisation.programs import forget

    with progress_bar() as bar:
        stages = Stages(bar, stop_if_asked)
        progress = stages.begin("fitting")
        load_beside("jaxtrachea.report.plots")
        asked = request.study, request.settings
        if fit is None:
            result = in_one_go(*asked, progress)
        else:  # shards are of some lanes each: the whole study takes more zeros
            # By no name of its own: it is as large as the one that takes its place.
            result = with_omitted_zeros(asked[0], fit(*asked, progress), asked[1], progress)
            if result.lanes > LARGE:
                forget()
                give_back()
        findings = analyse(request, result, stages.begin)
        stages.close()
        give_back()
        return findings


def write(folder: Path, spec: Path, loaded, measurements, findings, clock, manifest) -> None:
    """All files of one run; `clock`: when reading began, ended, and the fit ended."""
    import shlex

    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.files.html import page
    from jaxtrachea.files.pictures import with_ending, without_lost
    from jaxtrachea.files.provenance import provenance, write_provenance
    from jaxtrachea.files.table import write_csv
    from jaxtrachea.measurements.usage_tables import usage_section
    from jaxtrachea.report.fit import report_text
    from jaxtrachea.report.plots import draw_all
    from jaxtrachea.report.understood import understood
    from jaxtrachea.results.hdf5 import write_hdf5
    from jaxtrachea.results.rows import parameter_rows, summary_rows
    from jaxtrachea.trials.differences import differing_trials
    from jaxtrachea.trials.repeats import trial_sentences

    ending = loaded.output.format
    with beside(draw_all, folder, findings, ending) as drawing:
        write_csv(folder / "summary.csv", summary_rows(findings, measurements.bad))
        write_csv(folder / "parameters.csv", parameter_rows(findings))
        apart = differing_trials(measurements.curves)
        write_csv(folder / "curves.csv", _curve_rows(measurements, findings, apart))
        write_tables(folder, findings)
        title = loaded.title or spec.stem
        curves = measurements.curves
        weighed = findings.result.study.weighs_noise
        more = trial_sentences(curves, found=apart, weighed=weighed)
        used = usage_section(curves, measurements.notes, more)
        lines = understood(loaded, findings.result.study, findings.result)
        text = report_text(title, findings, measurements.bad, used, lines)
        drawn, lost = drawing.result()
    say_lost(lost)
    text = without_lost(with_ending(text, ending), lost)
    write_text(folder / "report.md", text)
    phases, ends = ("read", "fit", "write"), [*clock, time.perf_counter()]
    made = provenance(spec, measurements.sha256(), loaded.fit.precision, phases, ends)
    made |= {"excluded": loaded.data.exclude, "run": manifest}
    write_hdf5(folder / "results.h5", findings, made, loaded.data.model_dump(mode="json"))
    write_provenance(folder, made)
    pictures = {path.name: path.read_bytes() for path in drawn}
    names = {path.name for path in folder.iterdir()}
    influence, section = findings.get("influence"), ""
    if influence is not None:
        from jaxtrachea.report.explorer import explorer

        command = shlex.join(["jaxtrachea", "fit", str(spec)])
        section = explorer(influence, command, loaded.data.exclude)
    write_text(folder / "report.html", page(text, pictures, made, files=names, explorer=section))


def _curve_rows(measurements, findings, apart) -> Iterator[dict[str, object]]:
    """Of each curve what is used, what is doubtful, and the zeros that it takes."""
    from jaxtrachea.fitting.zero_messages import cells
    from jaxtrachea.measurements.usage_tables import usage_rows
    from jaxtrachea.trials.repeats import trial_remarks

    zeros, of_trials = cells(findings.result.study), trial_remarks(apart)
    for row in usage_rows(measurements.curves):
        curve = str(row["specimen"]), str(row["trial"])
        remarks = "; ".join(filter(None, (str(row["remarks"]), of_trials.get(curve))))
        yield row | {"remarks": remarks} | zeros.get(curve, {})


def write_tables(folder: Path, findings) -> None:
    """The CSV files of the analyses, and what else they write."""
    for analysis, found in findings.found:
        for name, write_file in analysis.files.items():
            write_file(found, folder / name)
        for name, rows in analysis.tables(found).items():
            rows.write_csv(folder / name)


def show(items, folder: Path) -> None:
    """Tables and sentences of a run on the terminal, and where its files are."""
    say(*items)
    say_written(folder)


def poor(findings) -> bool:
    """Whether an analysis came out so that it is not to be relied on."""
    return any(analysis.unreliable(found) for analysis, found in findings.found)
