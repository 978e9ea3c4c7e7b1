"""Data files without a specification: found, read, and what their columns seem to be."""

import dataclasses
import re
import shlex
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxtrachea.cli.file_options import CheckOptions, InitOptions
from jaxtrachea.cli.terminal import Stop

#: Endings of files that are taken from a folder.
ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".tab", ".xlsx", ".h5", ".hdf5", ".csv.gz", ".tsv.gz",
           ".txt.gz", ".lvm", ".jpk-force", ".jpk-force-map", ".jpk-qi-data", ".jpk-qi-series",
           ".ibw")  # fmt: skip
EXPECTED = "expected files of measured curves (CSV, TSV, text, xlsx, HDF5, afmformats)"


def _pairs(table: re.Match) -> str:
    """The options that say what a table of a specification says."""
    option = "--column" if table[1] == "columns" else "--unit"
    pairs = re.findall(r'(\w+) = "([^"]*)"', table[2])
    return " ".join(f"{option} {role}={shlex.quote(name)}" for role, name in pairs)


#: How the words of readers, which name keys of a specification, are said as options.
_AS_OPTION = (
    (re.compile(r"(columns|units) = \{ (.*?) \}"), _pairs),
    (re.compile(r"name (it|the one meant) in (?:data\.)?columns\.(\w+)"), r"say --column \2=NAME"),
    (re.compile(r"name the columns in (?=columns)"), "say "),
    (re.compile(r"units\.(\w+) (?=says)"), r"--unit \1 "),
    (re.compile(r"(?:data\.)?columns\.(\w+)"), r"--column \1=NAME"),
    (re.compile(r"(?:data\.)?units\.(\w+)"), r"--unit \1=UNIT"),
    (re.compile(r"data\.columns\b"), "--column ROLE=NAME"),
    (re.compile(r"give its unit in units"), "give its unit, as --unit s=mm"),
    (re.compile(r"\bdata\.(sheet|format|specimen)\b"), r"--\1"),
    (re.compile(r'set format = "(\w+)"'), r"say --format \1"),
    (re.compile(r"\b(force|displacement)_sign = -1"), r"--\1-sign -1"),
    (re.compile(r"a specimen pattern"), "--specimen PATTERN"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sources:
    """Data files as they were read.

    Attributes:
        given: paths as they were typed.
        files: the files; those of a folder sorted.
        keys: what [data] must say to read them so, but for `files`.
        guessed: roles whose column was guessed.
        turned: roles whose sign was turned.
        heads: of each file that could be opened.
        measurements: the curves, some at least.
        notes: of what was guessed, and of units that differ, a sentence each.
    """

    given: tuple[Path, ...]
    files: tuple[Path, ...]
    keys: dict[str, Any]
    guessed: frozenset[str]
    turned: frozenset[str]
    heads: dict[Path, Any]
    measurements: Any
    notes: tuple[str, ...]


def specification_in(options: CheckOptions) -> Path | None:
    """The specification among the arguments of check; None: they are data files.

    Raises:
        Stop: it stands beside other files, or options are of the other kind.
    """
    specs = [path for path in options.paths if is_specification(path)]
    if not specs:
        if options.data is not None:
            raise Stop("--data: for a specification alone; name the data files themselves")
        return None
    if len(options.paths) > 1:
        raise Stop(f"{specs[0]}: a specification; expected it alone, or data files without one")
    if options.keys:
        option = next(iter(options.words.split()))
        raise Stop(f"{option}: for data files alone; write it into [data] of {specs[0]}")
    return specs[0]


def is_specification(path: Path) -> bool:
    """Whether a path is called a TOML file, or is one with tables."""
    if path.suffix.lower() == ".toml":
        return True
    try:
        if not path.is_file() or path.stat().st_size > 2**20:
            return False
        content = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return any(isinstance(value, dict) for value in content.values())


def read_sources(options: CheckOptions | InitOptions) -> Sources:
    """Read the files; columns that no name tells are guessed by their units, and so are signs.

    Raises:
        Stop: a path is no data file, an option says what cannot be, or no curve can be used.
    """
    from jaxtrachea.measurements.guess import guess

    files = _expanded(options.paths)
    keys: dict[str, Any] = options.keys
    heads = _heads(files, keys)
    said = {"s", "specimen", "trial"} if "specimen" in keys else {"s"} & keys.keys()
    found = guess([*heads.values()], said)
    notes = [
        f"column {name!r} is taken for the {role}: no other can be; if it is another, say "
        f"--column {role}=NAME"
        for role, name in found.columns.items()
    ]
    for role, names in found.open.items():
        listed = " or ".join(map(repr, names))
        raise Stop(f"{files[0]}: which column is the {role}, {listed}? Say --column {role}=NAME")
    if found.columns:
        keys["columns"] = {**keys.get("columns", {}), **found.columns}
        heads = _heads(files, keys)
    measurements, turned = _turned(files, keys, _read(files, keys))
    notes += [
        f"the {role} counts negative where the tool presses: it is turned; if not so, say "
        f"--{role}-sign 1"
        for role in turned
    ]
    notes += _units_apart(heads)
    if not measurements.curves:
        reasons = [as_options(bad.reason) for bad in measurements.bad]
        more = f"\n... and {len(reasons) - 1} more" if len(reasons) > 1 else ""
        raise Stop(f"no usable curve: {reasons[0]}{more}")
    return Sources(
        given=tuple(options.paths),
        files=tuple(files),
        keys=keys,
        guessed=frozenset(found.columns),
        turned=frozenset(turned),
        heads=heads,
        measurements=_in_options(measurements),
        notes=tuple(notes),
    )


def as_options(text: str) -> str:
    """A message of a reader, with options in place of keys of a specification."""
    for pattern, option in _AS_OPTION:
        text = pattern.sub(option, text)
    return text


def _expanded(paths: Sequence[Path]) -> list[Path]:
    """Files of the arguments, each once; a folder stands for the data files in it."""
    files: dict[Path, None] = {}
    for path in paths:
        if path.is_dir():
            shown = (p for p in sorted(path.iterdir()) if p.is_file() and p.name[:1] != ".")
            inside = [p for p in shown if p.name.lower().endswith(ENDINGS)]
            if not inside:
                known = ", ".join(ENDINGS)
                raise Stop(f"{path}: a folder without data files ({known}); name the files")
            files.update(dict.fromkeys(inside))
            continue
        if not path.exists():
            raise Stop(f"{path}: no such file; {EXPECTED}; check the path")
        if not path.is_file():
            raise Stop(f"{path}: a device or a pipe; {EXPECTED}; save it as a file")
        if is_specification(path):
            raise Stop(
                f"{path}: a specification (TOML); {EXPECTED}; to see what it says: "
                f"jaxtrachea check {path}"
            )
        files[path] = None
    return list(files)


def _options(keys: dict[str, Any]):
    """How to read, of what was said."""
    from jaxtrachea._errors import InputError
    from jaxtrachea.measurements.curve import ReadOptions
    from jaxtrachea.measurements.readers import reader_of

    try:
        options = ReadOptions(**keys)
        reader_of(options.format)
        return options
    except InputError as error:
        raise Stop(f"--{error}") from None
    except ValueError as error:
        text = re.sub(r"^(s|phi|force_sign|displacement_sign)\b", r"--\1", str(error))
        text = re.sub(r"^(role .*) in (column|unit)s;", r"--\2: \1;", text)
        raise Stop(as_options(text).replace("_sign", "-sign")) from None


def _heads(files: Sequence[Path], keys: dict[str, Any]) -> dict[Path, Any]:
    """Heads of the files that can be opened; reading says what is wrong with the others."""
    from jaxtrachea.measurements.heads import head_of
    from jaxtrachea.measurements.read import DataError

    options, heads = _options(keys), {}
    for path in files:
        try:
            heads[path] = head_of(path, options)
        except DataError as error:
            if len(files) == 1:
                raise Stop(as_options(str(error))) from None
    return heads


def _read(files: Sequence[Path], keys: dict[str, Any]):
    """The measurements."""
    from jaxtrachea.config import DataSection, FitSpec, SpecError
    from jaxtrachea.measurements.data_files import read_data
    from jaxtrachea.measurements.read import DataError

    _options(keys)
    try:
        data = DataSection(files=[str(path) for path in files], **keys)
        return read_data(FitSpec(data=data), Path())
    except (SpecError, DataError) as error:
        raise Stop(as_options(str(error))) from None


def _turned(files: Sequence[Path], keys: dict[str, Any], before) -> tuple[Any, list[str]]:
    """Curves that count a press the other way, with the signs that make both grow from zero.

    Where no curve can be used for its sign, or force and displacement are negative in all.

    Returns:
        The measurements and the roles that were turned, which `keys` then says; those of before
        where no sign or several make presses of all.
    """
    roles = ("force", "displacement")
    drawn = all(_mean(c, role) < 0 for c in before.curves for role in roles)
    faults = {bad.kind for bad in before.bad}
    if not drawn or (not before.curves and not faults <= {"sign", "non_monotone"}):
        return before, []
    fitting = []
    for turned in (["force"], ["displacement"], [*roles]):
        signs = {f"{role}_sign": -1 for role in turned}
        if signs.keys() & keys.keys():
            continue
        read = _read(files, keys | signs)
        if read.curves and all(_mean(c, role) > 0 for c in read.curves for role in roles):
            fitting.append((read, turned, signs))
    if len(fitting) != 1:
        return before, []
    read, turned, signs = fitting[0]
    keys.update(signs)
    return read, turned


def _mean(curve: Any, role: str) -> float:
    return float(getattr(curve, role).mean())


def _units_apart(heads: dict[Path, Any]) -> list[str]:
    """That files write a quantity in different units, which is easily overlooked."""
    notes = []
    for role in ("force", "displacement", "s"):
        first: dict[str, Path] = {}
        for path, head in heads.items():
            for column in head.columns:
                if column.role == role and column.unit:
                    first.setdefault(column.unit, path)
        if len(first) > 1:
            listed = ", ".join(f"{unit} in {path.name}" for unit, path in first.items())
            notes.append(f"units of the {role} differ: {listed}; each file is converted by its own")
    return notes


def _in_options(measurements):
    """The measurements with notes and reasons that name options."""
    bad = tuple(
        dataclasses.replace(b, message=as_options(b.message), cure=as_options(b.cure))
        for b in measurements.bad
    )
    notes = tuple(as_options(note) for note in measurements.notes)
    return dataclasses.replace(measurements, bad=bad, notes=notes)
