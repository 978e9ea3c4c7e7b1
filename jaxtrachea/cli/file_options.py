"""Arguments of the commands that read data files without a specification: check and init."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea.cli.options import DataOption
from jaxtrachea.cli.terminal import Stop


def _option(name: str, meaning: str, metavar: str | None = None):
    return typer.Option(f"--{name}", help=meaning, metavar=metavar)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FileOptions:
    """How files are read, as the keys of [data] say it in a specification."""

    s: Annotated[str | None, _option("s", "Position of all curves, as '40 mm'.")] = None
    phi: Annotated[str | None, _option("phi", "Angle of all curves, as '30 deg'.")] = None
    column: Annotated[
        list[str] | None, _option("column", "Which column is which, as force=F_z.", "ROLE=NAME")
    ] = None
    unit: Annotated[
        list[str] | None, _option("unit", "Unit a file does not name, as force=N.", "ROLE=UNIT")
    ] = None
    specimen: Annotated[
        str | None,
        _option("specimen", "Names from file names, as '{specimen}_A{trial}'."),
    ] = None
    sheet: Annotated[str | None, _option("sheet", "Sheet of a workbook.")] = None
    format: Annotated[
        str | None, _option("format", "Format: tidy, machine, hdf5 or afmformats.")
    ] = None
    force_sign: Annotated[
        int | None, _option("force-sign", "-1: pushing back counts negative.")
    ] = None
    displacement_sign: Annotated[
        int | None, _option("displacement-sign", "-1: inward counts negative.")
    ] = None

    @property
    def keys(self) -> dict[str, object]:
        """The keys of [data] that were given.

        Raises:
            Stop: a column or unit without its role.
        """
        names = [field.name for field in dataclasses.fields(FileOptions)]
        given = {name: getattr(self, name) for name in names if name not in ("column", "unit")}
        found = {name: value for name, value in given.items() if value is not None}
        if self.column:
            found["columns"] = _pairs("column", self.column, "force=F_z")
        if self.unit:
            found["units"] = _pairs("unit", self.unit, "force=N")
        return found

    @property
    def words(self) -> str:
        """The options that were given, as a shell takes them; with a space before each."""
        text = ""
        for field in dataclasses.fields(FileOptions):
            value = getattr(self, field.name)
            for one in value if isinstance(value, list) else [value]:
                if one is not None:
                    text += f" --{field.name.replace('_', '-')} {shlex.quote(str(one))}"
        return text


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckOptions(FileOptions):
    """Arguments and options of `jaxtrachea check`."""

    paths: Annotated[
        list[Path],
        typer.Argument(metavar="SPEC|FILE", help="Fit specification (TOML), or data files."),
    ]
    data: DataOption = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class InitOptions(FileOptions):
    """Arguments and options of `jaxtrachea init`."""

    paths: Annotated[
        list[Path],
        typer.Argument(metavar="FILE", help="Files of measured curves, or a folder of them."),
    ]
    out: Annotated[Path, typer.Option("--out", help="The specification to write.")] = Path(
        "fit.toml"
    )
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is there.")] = (
        False
    )


def _pairs(option: str, texts: list[str], example: str) -> dict[str, str]:
    """Role to what stands behind its sign of equality."""
    pairs: dict[str, str] = {}
    for text in texts:
        role, sign, value = text.partition("=")
        if not sign or not role.strip() or not value.strip():
            raise Stop(f"--{option} {text!r}: expected a role and its {option}, as {example}")
        if pairs.setdefault(role.strip(), value.strip()) != value.strip():
            raise Stop(f"--{option}: {role.strip()} is given twice; remove one")
    return pairs
