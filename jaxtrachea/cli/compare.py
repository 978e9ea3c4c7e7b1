"""The command compare: which of several models the same curves prefer (docs/after_a_fit.md)."""

import dataclasses
import enum
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxtrachea.cli.load import load
from jaxtrachea.cli.options import DataOption, OutOption
from jaxtrachea.cli.terminal import Stages, Stop, into, progress_bar, say, say_written

SpecsArgument = Annotated[
    list[Path], typer.Argument(help="Two or more fit specifications of the same curves.")
]
CrossOption = Annotated[
    bool, typer.Option(help="Also predict what is left out from fits without it.")
]


class _LeaveOut(enum.Enum):
    """What --leave-out takes."""

    positions = "positions"
    speeds = "speeds"
    holds = "holds"


LeaveOutOption = Annotated[
    _LeaveOut,
    typer.Option(
        help="What is left out: contact positions (or trials), speeds, or the second half of holds."
    ),
]
#: Specimens of a terminal table; the files hold all.
MANY = 8


def compare(
    specs: SpecsArgument,
    data: DataOption = None,
    out_dir: OutOption = None,
    cross_validation: CrossOption = True,
    leave_out: LeaveOutOption = _LeaveOut.positions,
) -> None:
    """Fit the same curves by several models and rank these."""
    from jaxtrachea.inference.repeats import repeats

    clock = [time.perf_counter()]
    if len(specs) < 2:
        raise Stop("compare: one model has nothing to be compared with; give two or more SPEC")
    printed: set[str] = set()
    loaded = [load(path, data, refits=True, printed=printed) for path in specs]
    names = _names(specs, [spec.title for spec, _, _ in loaded])
    _same_data(specs, loaded, names)
    left = leave_out.value if cross_validation else None
    _check_leave_out(loaded, names, left)
    clock.append(time.perf_counter())
    default = Path("out") / f"{specs[0].absolute().parent.name}-compare"
    with into(out_dir, default) as (folder, stop_if_asked):
        models = _fitted(loaded, names, left, stop_if_asked)
        clock.append(time.perf_counter())
        words = repeats(models[0].result.study, leave_out.value).words or "curves"
        rows, failed, sentences = _write(folder, specs, loaded, models, clock, words)
    _print(rows, sentences, failed, models, folder.parent)
    raise typer.Exit(1 if failed or loaded[0][1].bad else 0)


def _names(specs: list[Path], titles: list[str]) -> list[str]:
    """Titles where every model has its own, else file names, else paths."""
    for names in (titles, [path.stem for path in specs], [str(path) for path in specs]):
        if all(names) and len(set(names)) == len(names):
            return names
    raise Stop("compare: the same specification is given twice; give different ones")


def _same_data(specs, loaded, names) -> None:
    from jaxtrachea.inference.comparison import same_data

    digests = [sorted(measured.sha256().values()) for _, measured, _ in loaded]
    for path, digest in zip(specs[1:], digests[1:], strict=True):
        if digest != digests[0]:
            raise Stop(
                f"{path}: data.files: other content than that of {specs[0]} (SHA-256 differs); "
                "give both the same files"
            )
    try:
        same_data([study for _, _, study in loaded], names)
    except ValueError as error:
        raise Stop(f"compare: {error}") from None


def _check_leave_out(loaded, names, leave_out) -> None:
    """Refuse speeds and holds that the records do not have."""
    from jaxtrachea.inference.repeats import repeats

    lacks = {
        "speeds": "no specimen has curves of two speeds with their time, fitted together (curves "
        "of one specimen share its name, from data.specimen or a column; no stiffness has the "
        'scope "trial")',
        "holds": 'no curve is a whole record with its time (loading = "record") that goes on after '
        "its loading",
    }
    for (_, _, study), name in zip(loaded, names, strict=True):
        if leave_out in lacks and not len(repeats(study, leave_out).lanes):
            raise Stop(
                f"compare: --leave-out {leave_out}: {name}: {lacks[leave_out]}; "
                "use --leave-out positions"
            )


def _fitted(loaded, names, leave_out, stop_if_asked) -> list:
    from jaxtrachea.cli.specification import settings_of
    from jaxtrachea.fitting.fit import fit
    from jaxtrachea.inference.comparison import Model
    from jaxtrachea.inference.repeats import leave_repeats_out

    models = []
    with progress_bar() as bar:
        stages = Stages(bar, stop_if_asked)
        counted = stages.begin
        for (spec, _, study), name in zip(loaded, names, strict=True):
            settings = settings_of(spec)
            result = fit(study, settings, counted(name))
            left = None
            if leave_out is not None:
                told = counted(f"{name}, left out")
                left = leave_repeats_out(result, settings, told, leave_out)
            models.append(Model(name, result, left))
        stages.close()
    return models


def _write(folder: Path, specs, loaded, models, clock, left: str):
    """compare.csv, report.md, provenance.json; returns the rows, failed lanes and sentences."""
    from hashlib import sha256 as digest

    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.files.provenance import provenance, write_provenance
    from jaxtrachea.inference.comparison import compared

    rows, failed = compared(models)
    sentences = _sentences(rows, left)
    _table(rows).write_csv(folder / "compare.csv")
    write_text(folder / "report.md", _report(rows, sentences, failed, models, left))
    phases, ends = ("read", "fit", "write"), [*clock, time.perf_counter()]
    measured, precision = loaded[0][1], loaded[0][0].fit.precision
    made = provenance(specs[0], measured.sha256(), precision, phases, ends)
    made["specifications"] = [
        {"file": path.name, "model": m.name, "sha256": digest(path.read_bytes()).hexdigest()}
        for path, m in zip(specs, models, strict=True)
    ]
    del made["specification"]
    write_provenance(folder, made)
    return rows, failed, sentences


def _sentences(rows, left: str) -> dict[str, str]:
    """Specimen to what its data prefer; the sum last."""
    from jaxtrachea.inference.comparison import sentence

    sentences = {}
    for specimen in dict.fromkeys(row.specimen for row in rows):
        own = [row for row in rows if row.specimen == specimen]
        sentences[specimen] = sentence(own, left)
    return sentences


def _left_out_notes(models) -> list[str]:
    """What is to be said of the refits behind the left-out column; nothing if all is well."""
    from jaxtrachea.inference.cross_validation import refits_sentence
    from jaxtrachea.inference.holdout_groups import holdout_sentence

    notes = []
    if any(model.left_out is not None for model in models):
        notes += [f"{text}." for text in holdout_sentence(models[0].result.study.holdout_groups)]
    for model in models:
        if model.left_out is None:
            continue
        left = model.left_out
        refits, unconverged, lost = (
            int(v.sum()) for v in (left.refits, left.unconverged, left.lost)
        )
        if not refits:
            notes.append(f"Nothing was left out of {model.name}: {_why_nothing(model)}.")
        elif words := refits_sentence(refits, unconverged, lost):
            none = "; there the left-out column has no number" if lost else ""
            notes.append(f"Left out of {model.name}: {words}{none}.")
    return notes


def _why_nothing(model) -> str:
    """Why there was nothing to leave out of a model."""
    from jaxtrachea.fitting.parameters import OF_THE_PRESS

    free = model.result.study.free
    own = [p.name for p in free if p.scope == "trial" and p.name not in OF_THE_PRESS]
    if own:
        return f"{', '.join(own)} belongs to single curves, and no other curve tells of it"
    apart = " that is not left out with the first" if model.result.study.holdout_groups else ""
    return f"no specimen has a second position or trial{apart}"


def _table(rows: Iterable[Any]):
    """Models of one specimen after the other."""
    from jaxtrachea.files.table import Column, Table

    share = Column("", "worst", unit="%", decimals=2)

    def worst(row) -> str:
        return share.text(row) + (f" ({row['worst_place']})" if row["worst_place"] else "")

    columns = [
        Column("specimen"), Column("model"), Column("k", "unknowns"),
        Column("-2 ln L", "deviance", digits=6), Column("dAICc", "delta", digits=3),
        Column("deflated", digits=3), Column("weight", digits=2), Column("BIC", digits=6),
        Column("left out", "left_out", unit="%", decimals=2), Column("worst", worst),
    ]  # fmt: skip
    return Table(map(dataclasses.asdict, rows), columns, title="Models")


def _report(rows, sentences: dict[str, str], failed: int, models, left: str) -> str:
    parts = [
        "# Which model",
        "\n".join(f"- {specimen}: {text}." for specimen, text in sentences.items()),
        _table(rows).markdown(),
        "k: fitted parameters and estimated standard deviations. dAICc: above the best model; "
        "below 2 models cannot be told apart, from 10 on the worse one has next to no support. "
        "deflated: the same where the likelihood counts only as many samples as are independent, "
        "by the correlation of neighbouring residuals of the best model; decisive is what stays at "
        "10 or more so. weight: Akaike weight. left out: root mean square error of force of "
        f"{left} that took no part in the fit, over the largest force; worst: "
        "the largest of them by itself "
        "(docs/after_a_fit.md). All numbers: `compare.csv`.",
        *_left_out_notes(models),
    ]
    if failed:
        parts.append(f"{failed} specimens could not be fitted by every model and count for none.")
    return "\n\n".join(parts) + "\n"


def _print(rows, sentences, failed: int, models, folder: Path) -> None:
    names = [name for name in sentences if name != "(all)"]
    if len(names) > MANY:  # what is decided says little more
        names.sort(key=lambda name: "decisively (" in sentences[name])
    shown = names[:MANY] + [name for name in sentences if name == "(all)"]
    for name in shown:
        own = (row for row in rows if row.specimen == name)
        say(_table(own), f"{name}: {sentences[name]}")
    if len(names) > MANY:
        say(f"and {len(names) - MANY} more specimens, see compare.csv")
    say(*_left_out_notes(models))
    if failed:
        say(f"{failed} specimens could not be fitted by every model and count for none")
    say_written(folder)
