"""What commands on fit specifications share: reading everything, saying what is wrong with it."""

import dataclasses
from pathlib import Path

from rich.markup import escape

from jaxtrachea.cli.terminal import Stop, set_up_jax, to_stderr


def load(path: Path, data: Path | None, *, refits: bool = False, said: set[str] | None = None):
    """Specification, measurements and study; what is wrong with curves is said on stderr.

    Args:
        path: the specification.
        data: folder its paths start from; None: its own.
        refits: single curves will be left out, or unknowns held (see `specification.study_of`).
        said: what was said before (of another model of the same curves) and is not said again;
            what is said now is added.

    Raises:
        Stop: nothing can be fitted.
    """
    from jaxtrachea.cli.specification import study_of, usable
    from jaxtrachea.config import SpecError, load_fit_spec
    from jaxtrachea.measurements.data_files import read_data
    from jaxtrachea.measurements.read import DataError

    try:
        spec = load_fit_spec(path)
        measurements = read_data(spec, path.parent if data is None else data)
        set_up_jax()
        if measurements.curves:
            measurements = usable(spec, measurements)
        said = set() if said is None else said
        print_bad(measurements, said)
        print_notes(measurements, said)
        if not measurements.curves:
            raise Stop(f"{path}: no usable curve; nothing was fitted, nothing was written")
        study = study_of(spec, measurements, refits=refits)
        _say_unused_batch(spec, study, said)
        return spec, _with_depths(measurements, study.model, said), study
    except SpecError as error:
        raise Stop(str(SpecError.like(error, place=str(path)))) from None
    except DataError as error:
        raise Stop(str(error)) from None


def _say_unused_batch(spec, study, said: set[str]) -> None:
    """A note where lanes are fitted one at a time and the specification says otherwise."""
    batch = spec.fit.batch
    if batch != "auto" and batch > 1 and study.one_at_a_time:
        note = f"fit.batch = {batch} is not used: sections take one lane at a time on a CPU"
        _say("note", [note], said)


def _with_depths(measurements, model, said: set[str]):
    """The measurements with a note on curves that go deeper than the model was tested."""
    from jaxtrachea.fitting.tested import deeper_than_tested

    note = deeper_than_tested(measurements.curves, model.options, float(model.geometry.radius))
    if note is None:
        return measurements
    _say("note", [note], said)
    return dataclasses.replace(measurements, notes=(*measurements.notes, note))


def print_notes(measurements, said: set[str] | None = None) -> None:
    """Say what a user should know of how files were read, and which names look alike."""
    from jaxtrachea.measurements.names import look_alikes

    notes = [*measurements.notes, *look_alikes((*measurements.curves, *measurements.bad))]
    _say("note", notes, said, more=" notes")


def print_bad(measurements, said: set[str] | None = None) -> None:
    """Say which curves cannot be used, and why."""
    bad = [f"{b.specimen} {b.trial}: {b.reason}" for b in measurements.bad]
    _say("not usable", bad, said)


def _say(what: str, lines: list[str], said: set[str] | None, more: str = "") -> None:
    """The first twenty lines that were not said before, and how many there are beside them."""
    said = set() if said is None else said
    new = [line for line in lines if line not in said]
    said.update(new)
    for line in new[:20]:
        to_stderr(f"[yellow]{what}:[/] {escape(line)}")
    if len(new) > 20:
        to_stderr(f"... and {len(new) - 20} more{more}")
