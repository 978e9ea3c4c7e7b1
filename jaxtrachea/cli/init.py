"""The command init, and check on data files: what was read, what is missing, a specification."""

import dataclasses
import re
import shlex
import tomllib
from pathlib import Path

import typer
from rich.markup import escape

from jaxtrachea.cli.file_options import CheckOptions, InitOptions
from jaxtrachea.cli.load import print_bad, print_notes
from jaxtrachea.cli.options import with_fields
from jaxtrachea.cli.sources import Sources, read_sources
from jaxtrachea.cli.terminal import Stop, say, set_up_jax, to_stderr
from jaxtrachea.cli.written_spec import specification_text, summary
from jaxtrachea.measurements.observed import OBSERVED

#: Rows of a table of columns, and tables of columns; a file has more in itself.
MANY, TABLES = 40, 3
#: Options that take the position from names of files, and what they find there.
_IN_NAME = re.compile(r"._s\d+")
OF_NAMES = r"--specimen '(?P<specimen>.+)_(?P<trial>s(?P<s>\d+))' --unit s=mm"
#: What roles are called.
ROLES = {
    "displacement": "displacement of the tool",
    "force": "force",
    **{q.role: q.words for q in OBSERVED if q.rings is None},
    "s": "position s along the tube",
    "phi": "angle phi",
    "specimen": "specimen",
    "trial": "trial",
    "segment": "approach or retraction",
    "joint": "markers on rings",
    "end": "ends of rings",
}


@with_fields(InitOptions)
def init(options: InitOptions) -> None:
    """Read data files and write a specification that fits them."""
    _check_target(options)
    sources = _read(options)
    blocked = missing(sources)
    text = specification_text(sources, options.out, blocked)
    _write(options, text)
    say(summary(sources.measurements.curves))
    print_missing(blocked, f"write it into {options.out}")
    written = f"written to {options.out}; {'complete it, then' if blocked else 'next'}: "
    written += f"jaxtrachea fit {shlex.quote(str(options.out))}"
    say(written, wrap=False)
    raise typer.Exit(1 if blocked or sources.measurements.bad else 0)


def read_and_show(options: CheckOptions) -> Sources:
    """Read data files and show what their columns seem to be; `check` shows the curves."""
    sources = _read(options)
    _print_columns(sources)
    return sources


def conclude(options: CheckOptions, sources: Sources) -> None:
    """What is missing to fit data files, and the command that writes a specification.

    Raises:
        typer.Exit: always; code 1 where something is missing or some curve cannot be used.
    """
    blocked = missing(sources)
    print_missing(blocked, "write it into the specification that init writes")
    if not blocked:
        say("Nothing is missing to fit these curves on the tube of Table 1.")
    command = f"jaxtrachea init {shlex.join(map(str, options.paths))}{options.words}"
    if "data" in blocked and options.s is None:
        named = all(_IN_NAME.search(path.stem) for path in sources.files)
        command += f" {OF_NAMES}" if named and not options.specimen else " --s '40 mm'"
    say("To write a specification:", f"    {command}", wrap=False)
    raise typer.Exit(1 if blocked or sources.measurements.bad else 0)


def print_missing(blocked: dict[str, str], cure: str) -> None:
    """What keeps the curves from being fitted."""
    for reason in blocked.values():
        to_stderr(f"[bold yellow]missing:[/] {escape(reason)}; {escape(cure)}")


def missing(sources: Sources) -> dict[str, str]:
    """Why the curves cannot be fitted as they are, by the section that a cure goes into.

    The study is built as a fit builds it, with the keys of [data] and defaults for all else.
    """
    from jaxtrachea.cli.specification import study_of, usable
    from jaxtrachea.config import DataSection, FitSpec, SpecError

    set_up_jax()
    measurements, blocked = sources.measurements, {}
    placed = [c for c in measurements.curves if c.s_c is not None]
    if without := len(measurements.curves) - len(placed):
        blocked["data"] = (
            f"the position s along the tube, of {without} of {len(measurements.curves)} curves "
            f"(--s '40 mm' for all, a column s, or of names as T01_s40.csv {OF_NAMES})"
        )
    if not placed:
        return blocked
    spec = FitSpec(data=DataSection(files=["-"], **sources.keys))
    try:
        kept = usable(spec, dataclasses.replace(measurements, curves=tuple(placed)))
    except SpecError as error:
        return blocked | _refused(str(error))
    refused = [bad.reason for bad in kept.bad[len(measurements.bad) :]]
    if refused:
        others = f" (and {len(refused) - 1} more)" if len(refused) > 1 else ""
        return blocked | _refused(f"{refused[0]}{others}")
    try:
        study_of(spec, kept)
    except SpecError as error:
        blocked["noise" if "sigma" in str(error) else "parameters"] = str(error)
    return blocked


def _refused(reason: str) -> dict[str, str]:
    """Curves that the default tube or model cannot press, by the section to be written."""
    if re.search(r"on the tube|on ring|end of ring|beyond", reason):
        return {"trachea": f"a tube that holds all curves; Table 1's does not: {reason}"}
    return {"model": f"a model that takes all curves; the default does not: {reason}"}


def _read(options: CheckOptions | InitOptions) -> Sources:
    """Read the files; what is wrong with single curves goes to stderr."""
    sources = read_sources(options)
    print_bad(sources.measurements)
    print_notes(sources.measurements)
    for note in sources.notes:
        to_stderr(f"[yellow]note:[/] {escape(note)}")
    return sources


def _print_columns(sources: Sources) -> None:
    """The columns of the files, those with the same columns together."""
    from jaxtrachea.files.table import Column, Table

    groups: dict[tuple, list[Path]] = {}
    for path, head in sources.heads.items():
        if head.columns:
            groups.setdefault((head.format, head.columns), []).append(path)
    for (kind, columns), paths in [*groups.items()][:TABLES]:
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        rows = (
            {"column": c.name, "unit": c.unit or None,
             "read as": role_in_words(c.role, sources.guessed)}
            for c in columns
        )  # fmt: skip
        heads = [Column("column"), Column("unit", left=True), Column("read as", left=True)]
        shown = Table(rows, heads, title=f"{paths[0].name}{more} ({kind})")
        say(shown.first(MANY, "... and {} more columns"))
    if len(groups) > TABLES:
        say(f"... and {len(groups) - TABLES} more kinds of files")


def role_in_words(role: str, guessed: frozenset[str]) -> str:
    """What a column is read as."""
    if not role:
        return "not used"
    general = role.split("_")[0] if role.startswith(("joint_", "end_")) else role
    ring = "".join(c if c.isdigit() else " " for c in role).strip()
    words = f"{ROLES.get(general, role)}{f' {ring}' if ring else ''}"
    return f"{words} (guessed)" if role in guessed else words


def _check_target(options: InitOptions) -> None:
    """Refuse what cannot be written before anything is read."""
    out = options.out
    if out.suffix.lower() != ".toml":
        raise Stop(f"{out}: expected a name that ends in .toml; choose another --out")
    if out.is_dir():
        raise Stop(f"{out}: a folder; expected a file to write; choose another --out")
    if (out.exists() or out.is_symlink()) and not options.overwrite:
        raise Stop(f"{out}: exists; nothing was written; choose another --out, or say --overwrite")
    if not out.parent.is_dir():
        raise Stop(f"{out}: there is no folder {out.parent}; make it, or choose another --out")


def _write(options: InitOptions, text: str) -> None:
    """Write the specification, whole or not at all."""
    from jaxtrachea.config import FitSpec
    from jaxtrachea.files.atomic import write_whole

    try:
        data = text.encode()
    except UnicodeEncodeError:
        raise Stop(f"{options.out}: the name of a data file is not UTF-8; rename it") from None
    FitSpec.model_validate(tomllib.loads(text))  # what is written is valid
    try:
        write_whole(options.out, data)
    except OSError as error:
        reason = error.strerror or str(error)
        raise Stop(f"{options.out}: cannot be written ({reason}); choose another --out") from None
