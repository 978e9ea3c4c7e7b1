"""The command convert: measured curves from any format that is read to HDF5 or a tidy table."""

from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea import __version__
from jaxtrachea.cli.load import print_bad, print_notes
from jaxtrachea.cli.terminal import Stop, say, say_written

PathsArgument = Annotated[
    list[Path], typer.Argument(metavar="SOURCE... TARGET", help="Data files; the new file last.")
]
SpecOption = Annotated[
    Path | None,
    typer.Option("--spec", help="Fit specification whose [data] says how to read the SOURCEs."),
]
HDF5, TIDY = (".h5", ".hdf5"), (".csv",)
#: Curves that are named where samples of them are left out.
MANY = 40


def convert(paths: PathsArgument, spec: SpecOption = None) -> None:
    """Write curves of data files as HDF5 or as a table (CSV).

    Every sample is kept. With --spec its [data] holds, but for the files; samples are left out only
    where it names a loading or a window.
    """
    if len(paths) < 2:
        raise Stop("convert: expected SOURCE... TARGET; name the file to write last")
    *sources, target = paths
    _check_target(target)
    measurements = _read(sources, spec)
    print_bad(measurements)
    print_notes(measurements)
    curves, bad = measurements.curves, measurements.bad
    if not curves:
        raise Stop(f"{target}: no usable curve; nothing was written")
    _write(target, measurements)
    _print_cut(curves)
    samples = sum(curve.force.size for curve in curves)
    say(f"{len(curves)} curves, {samples} samples; {len(bad)} bad curves left out")
    say_written(target)
    raise typer.Exit(1 if bad else 0)


def _check_target(target: Path) -> None:
    """Refuse what cannot be written before anything is read."""
    if target.suffix.lower() not in HDF5 + TIDY:
        raise Stop(f"{target}: expected a name that ends in .h5, .hdf5 or .csv")
    if target.exists() or target.is_symlink():
        raise Stop(f"{target}: exists; nothing was written; choose another name, or remove it")
    if not target.parent.is_dir():
        raise Stop(f"{target}: there is no folder {target.parent}; make it, or choose another name")


def _read(sources: list[Path], path: Path | None):
    """The curves of the files."""
    from jaxtrachea.config import DataSection, FitSpec, SpecError, load_fit_spec
    from jaxtrachea.measurements.data_files import read_data
    from jaxtrachea.measurements.read import DataError

    for source in sources:
        if not source.is_file():
            what = "is no file" if source.exists() else "no such file"
            raise Stop(f"{source}: {what}; name files of measured curves, the file to write last")
    try:
        spec = FitSpec(data=DataSection(files=["-"])) if path is None else load_fit_spec(path)
        changed: dict[str, object] = {"files": [str(source) for source in sources]}
        if "loading" not in spec.data.model_fields_set:
            changed["loading"] = "all"
        data = spec.data.model_copy(update=changed)
        return read_data(spec.model_copy(update={"data": data}), Path())
    except SpecError as error:
        raise Stop(str(error if path is None else SpecError.like(error, place=str(path)))) from None
    except DataError as error:
        raise Stop(str(error)) from None


def _write(target: Path, measurements) -> None:
    """Write the usable curves."""
    from jaxtrachea._errors import InputError
    from jaxtrachea.measurements.read import write_hdf5
    from jaxtrachea.measurements.tidy_writer import write_tidy

    try:
        if target.suffix.lower() in TIDY:
            write_tidy(target, measurements.curves)
        else:
            write_hdf5(target, measurements, attrs={"written_by": f"jaxtrachea {__version__}"})
    except InputError as error:
        raise Stop(str(InputError.like(error, place=str(target)))) from None
    except ValueError as error:
        raise Stop(f"{target}: {error}; nothing was written") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise Stop(f"{target}: cannot be written ({reason}); choose another name") from None


def _print_cut(curves) -> None:
    """Name the curves of which samples are left out."""
    from jaxtrachea.measurements.usage_tables import usage_lines

    cut = [c for c in curves if c.usage is not None and c.usage.used < c.usage.recorded]
    say(*usage_lines(cut[:MANY]))
    if len(cut) > MANY:
        say(f"... and {len(cut) - MANY} more curves of which samples are left out")
