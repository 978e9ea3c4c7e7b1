"""Options that several commands share, and those of `jaxtrachea fit` as a record."""

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

SpecArgument = Annotated[Path, typer.Argument(help="Fit specification (TOML).")]
DataOption = Annotated[
    Path | None, typer.Option("--data", help="Folder of the data files (default: SPEC's).")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="New folder for the results.")]


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """Arguments and options of `jaxtrachea fit`, as on the command line."""

    spec: SpecArgument
    data: DataOption = None
    out_dir: OutOption = None
    leave_one_out: Annotated[
        bool,
        typer.Option("--leave-one-out", help="Also predict each curve from a fit of the others."),
    ] = False
    profile: Annotated[
        bool, typer.Option("--profile", help="Also compute 95 % intervals by profile likelihood.")
    ] = False
    influence: Annotated[
        bool,
        typer.Option("--influence", help="Also show which curves each estimate depends on."),
    ] = False
    resume: Annotated[bool, typer.Option("--resume", help="Go on where OUT stopped.")] = False
    rerun_failed: Annotated[
        bool, typer.Option("--rerun-failed", help="Repeat the failed fits of OUT.")
    ] = False
    force: Annotated[bool, typer.Option("--force", help="Go on though inputs have changed.")] = (
        False
    )
    no_lock: Annotated[
        bool, typer.Option("--no-lock", help="Start where the file system has no locks.")
    ] = False
    threads: Annotated[
        int | None,
        typer.Option(
            "--threads",
            min=1,
            help="Shards fitted side by side on a CPU; else its cores, up to 8.",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", help="HOST:PORT of a dask scheduler whose workers fit."),
    ] = None

    @property
    def default_folder(self) -> Path:
        """Folder of the results where none is named."""
        return Path("out") / f"{self.spec.absolute().parent.name}-{self.spec.stem}"

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        return self.out_dir or self.default_folder

    @property
    def continues(self) -> bool:
        """Whether the run is one that was begun before."""
        return self.resume or self.rerun_failed

    @property
    def analyses(self) -> list[str]:
        """Analyses asked for, by the option's name."""
        asked = {
            "leave-one-out": self.leave_one_out,
            "profile": self.profile,
            "influence": self.influence,
        }
        return [name for name, wanted in asked.items() if wanted]


def with_fields(kind: type) -> Callable[[Callable[[Any], None]], Callable[..., None]]:
    """A command of one record becomes one whose options are the record's fields."""

    def decorate(command):
        def with_options(**options) -> None:
            command(kind(**options))

        with_options.__name__, with_options.__doc__ = command.__name__, command.__doc__
        with_options.__annotations__ = get_type_hints(kind, include_extras=True)
        parameters = inspect.signature(kind).parameters.values()
        by_name = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
        with_options.__dict__["__signature__"] = inspect.Signature(by_name)
        return with_options

    return decorate
