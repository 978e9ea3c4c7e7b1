"""What commands on fit specifications share: reading everything, saying what is wrong with it."""

import dataclasses
from pathlib import Path

from rich.markup import escape

from jaxtrachea.cli.terminal import Stop, set_up_jax, to_stderr


def load(path: Path, data: Path | None, *, refits: bool = False, quiet: bool = False):
    """Specification, measurements and study; what is wrong with curves is said on stderr.

    Args:
        path: the specification.
        data: folder its paths start from; None: its own.
        refits: single curves will be left out, or unknowns held (see `specification.study_of`).
        quiet: name no curve that cannot be used.

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
        if not quiet:
            print_bad(measurements)
            print_notes(measurements)
        if not measurements.curves:
            raise Stop(f"{path}: no usable curve; nothing was fitted, nothing was written")
        study = study_of(spec, measurements, refits=refits)
        return spec, _with_depths(measurements, study.model, quiet), study
    except SpecError as error:
        raise Stop(str(SpecError.like(error, place=str(path)))) from None
    except DataError as error:
        raise Stop(str(error)) from None


def _with_depths(measurements, model, quiet: bool):
    """The measurements with a note on curves that go deeper than the model was tested."""
    from jaxtrachea.fitting.tested import deeper_than_tested

    note = deeper_than_tested(measurements.curves, model.options, float(model.geometry.radius))
    if note is None:
        return measurements
    if not quiet:
        to_stderr(f"[yellow]note:[/] {escape(note)}")
    return dataclasses.replace(measurements, notes=(*measurements.notes, note))


def print_notes(measurements) -> None:
    """Say what a user should know of how files were read, and which names look alike."""
    from jaxtrachea.measurements.names import look_alikes

    notes = [*measurements.notes, *look_alikes((*measurements.curves, *measurements.bad))]
    for note in notes[:20]:
        to_stderr(f"[yellow]note:[/] {escape(note)}")
    if len(notes) > 20:
        to_stderr(f"... and {len(notes) - 20} more notes")


def print_bad(measurements) -> None:
    """Say which curves cannot be used, and why."""
    for bad in measurements.bad[:20]:
        to_stderr(f"[yellow]not usable:[/] {escape(f'{bad.specimen} {bad.trial}: {bad.reason}')}")
    if len(measurements.bad) > 20:
        to_stderr(f"... and {len(measurements.bad) - 20} more")
