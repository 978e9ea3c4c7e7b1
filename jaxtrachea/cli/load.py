"""What commands on fit specifications share: reading everything, saying what is wrong with it."""

import dataclasses
from pathlib import Path

from rich.markup import escape

from jaxtrachea._memory import give_back
from jaxtrachea.cli.terminal import Stop, set_up_jax, to_stderr

#: Arrays that a curve and its lane have in common.
SAMPLES = ("displacement", "force")


def load(path: Path, data: Path | None, *, refits: bool = False, printed: set[str] | None = None):
    """Specification, measurements and study; what is wrong with curves goes to stderr.

    Args:
        data: folder its paths start from; None: its own.
        refits: single curves will be left out, or unknowns held (see `specification.study_of`).
        printed: lines that were printed before (of another model of the same curves) and are not
            printed again; those printed now are added.

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
        printed = set() if printed is None else printed
        print_bad(measurements, printed)
        print_notes(measurements, printed)
        if not measurements.curves:
            raise Stop(f"{path}: no usable curve; nothing was fitted, nothing was written")
        study = study_of(spec, measurements, refits=refits)
        _note_unused_batch(spec, study, printed)
        measurements = _with_zeros(measurements, study, printed)
        measurements, study = _samples_once(measurements, study)
        measurements = _with_depths(measurements, study, printed)
        give_back()
        return spec, measurements, study
    except SpecError as error:
        raise Stop(str(SpecError.like(error, place=str(path)))) from None
    except DataError as error:
        raise Stop(str(error)) from None


def _note_unused_batch(spec, study, printed: set[str]) -> None:
    """A note where fewer lanes are computed together than the specification says."""
    batch, most = spec.fit.batch, study.max_batch
    if batch != "auto" and batch > most:
        why = f"of curves as long as these a CPU takes {most} together"
        if study.one_at_a_time:
            why = "sections take one lane at a time on a CPU"
        _print("note", [f"fit.batch = {batch} is not used: {why}"], printed)


def _samples_once(measurements, study):
    """Both with curves whose displacements and forces are those of the lanes, not copies."""
    from jaxtrachea.fitting.build import with_recipe

    def shared(curve, k: int, t: int):
        arrays = {n: getattr(study.lanes, n)[k, t, : len(curve.force)] for n in SAMPLES}
        return dataclasses.replace(curve, **arrays)

    lanes = [[shared(c, k, t) for t, c in enumerate(lane)] for k, lane in enumerate(study.curves)]
    own = {(c.specimen, c.trial): c for lane in lanes for c in lane}
    curves = tuple(own[c.specimen, c.trial] for c in measurements.curves)
    study = with_recipe(study, curves=tuple(map(tuple, lanes)))
    return dataclasses.replace(measurements, curves=curves), study


def _with_zeros(measurements, study, printed: set[str]):
    """The measurements with notes on what curves take from their own records."""
    from jaxtrachea.fitting.zero_messages import sentences

    said = sentences(study)
    _print("note", said, printed)
    return dataclasses.replace(measurements, notes=(*measurements.notes, *said))


def with_zeros_of_fits(measurements, result):
    """The measurements with notes on what curves take because their fits ask for it."""
    from jaxtrachea.fitting.zero_messages import sentences_of_fits

    found = sentences_of_fits(result.study, result.value)
    _print("note", found, None)
    return dataclasses.replace(measurements, notes=(*measurements.notes, *found))


def _with_depths(measurements, study, printed: set[str]):
    """The measurements with notes on curves beyond what the model was tested for, or made for.

    Nothing is fitted yet: a sought onset is taken where its curve shows it.
    """
    from jaxtrachea.fitting.onset import counted_from
    from jaxtrachea.fitting.refusals import (
        deeper_than_validated,
        mixed_in_time,
        too_deep_for_uniform,
    )

    model = study.model
    curves = [c for lane in study.curves for c in lane]
    touch = [
        float(d)
        for row, lane in zip(study.first_touch, study.curves, strict=True)
        for d in row[: len(lane)]
    ]
    options, radius = model.options, float(model.geometry.radius)
    said = (
        deeper_than_validated(curves, options, radius, touch, counted_from(study.parameters)),
        too_deep_for_uniform(curves, options, radius, touch),
        mixed_in_time(curves, options),
    )
    notes = [note for note in said if note is not None]
    _print("note", notes, printed)
    return dataclasses.replace(measurements, notes=(*measurements.notes, *notes))


def print_notes(measurements, printed: set[str] | None = None) -> None:
    """Say what a user should know of how files were read, and which names look alike."""
    from jaxtrachea.measurements.names import look_alikes

    notes = [*measurements.notes, *look_alikes((*measurements.curves, *measurements.bad))]
    _print("note", notes, printed, more=" notes")


def print_bad(measurements, printed: set[str] | None = None) -> None:
    """Say which curves cannot be used, and why."""
    bad = [f"{b.specimen} {b.trial}: {b.reason}" for b in measurements.bad]
    _print("not usable", bad, printed)


def _print(what: str, lines: list[str], printed: set[str] | None, more: str = "") -> None:
    """The first twenty lines that were not printed before, and how many there are beside them."""
    printed = set() if printed is None else printed
    new = [line for line in lines if line not in printed]
    printed.update(new)
    for line in new[:20]:
        to_stderr(f"[yellow]{what}:[/] {escape(line)}")
    if len(new) > 20:
        to_stderr(f"... and {len(new) - 20} more{more}")
