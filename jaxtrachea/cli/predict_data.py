"""What `jaxtrachea predict --data` compares with: a specification or files of measured curves."""

import math
from collections.abc import Sequence
from pathlib import Path

from jaxtrachea.cli.terminal import Stop


def measured_curves(stored, given: Sequence[str]):
    """The measurements of --data, and what is to be said of how they were read.

    Raises:
        Stop: they cannot be read, or are of another tube or model.
    """
    from pydantic import ValidationError

    from jaxtrachea.config import FitSpec, SpecError, load_fit_spec
    from jaxtrachea.measurements.data_files import read_data
    from jaxtrachea.measurements.read import DataError

    specs = [name for name in given if name.lower().endswith(".toml")]
    if specs and len(given) > 1:
        raise Stop(f"--data: {specs[0]}: give one specification, or files, not both")
    notes = []
    _refuse_results(given)
    try:
        if specs:
            path = Path(specs[0])
            spec, root = load_fit_spec(path), path.parent
            _same_model(stored, path, spec)
        else:
            reading = _as_written(stored.origin.reading)
            spec = FitSpec.model_validate({"data": reading | {"files": list(given)}})
            root = Path()
            if reading.get("s") is not None:
                notes.append(
                    f"all curves are taken at s = {reading['s']}, as in the fit's specification; "
                    "for others give a specification with its own [data]"
                )
        measurements = read_data(spec, root)
    except (SpecError, DataError) as error:
        raise Stop(f"--data: {error}") from None
    except ValidationError:
        raise Stop(
            f"{stored.origin.path}: damaged or of another version (how the data were read is not "
            "understood); give --data a specification with a [data] section"
        ) from None
    return measurements, notes


def _refuse_results(given: Sequence[str]) -> None:
    """Results of a fit are no measured curves."""
    import contextlib

    from jaxtrachea.measurements.read import DataError
    from jaxtrachea.measurements.readers.hdf5_values import attribute
    from jaxtrachea.measurements.readers.safe_hdf5 import opened
    from jaxtrachea.results.hdf5 import SCHEMA

    for name in given:
        path = Path(name)
        if path.suffix.lower() not in (".h5", ".hdf5") or not path.is_file():
            continue
        with contextlib.suppress(DataError), opened(path, audit=False) as file:
            if attribute(file, "schema") == SCHEMA:
                raise Stop(
                    f"--data: {name} holds the results of a fit, not measured curves; give the "
                    "files that were measured"
                )


def _as_written(reading) -> dict[str, object]:
    """A stored [data] section as a user would write it: lengths with their unit."""
    return {
        key: f"{value!r} mm" if isinstance(value, float) else value
        for key, value in reading.items()
        if key != "files" and value is not None
    }


#: What a tube is compared by, and in words.
_OF_TUBE = {
    "length": lambda g: f"{float(g.length):g} mm with {g.rings} rings",
    "ring_positions": lambda g: f"rings at {', '.join(f'{x:g}' for x in g.ring_positions)} mm",
    "radius": lambda g: f"radius {float(g.radius):g} mm",
    "half_angle": lambda g: f"half_angle {math.degrees(float(g.half_angle)):g} deg",
    "ring_height": lambda g: f"ring_height {float(g.ring_height):g} mm",
}


def _same_model(stored, path: Path, spec) -> None:
    """Refuse a specification whose tube or model is not that of the fit; only [data] is used."""
    import numpy as np

    from jaxtrachea.mechanics.press import Options
    from jaxtrachea.trachea.section import geometry_of

    if "trachea" in spec.model_fields_set:
        mine, its = stored.study.model.geometry, geometry_of(spec.trachea)
        for name, words in _OF_TUBE.items():
            if not np.array_equal(getattr(mine, name), getattr(its, name)):
                raise Stop(
                    f"{path}: trachea: {words(its)}, but the fit's is {words(mine)}; predictions "
                    "are made with the fit's: leave the section out, or correct it"
                )
    mine = stored.study.model.options
    its = Options(**spec.model.model_dump(), shortest=mine.shortest, longest=mine.longest)
    if "model" in spec.model_fields_set and its != mine:
        raise Stop(
            f"{path}: model: not that of the fit, with which predictions are made; leave the "
            "section out, or fit again with it"
        )
