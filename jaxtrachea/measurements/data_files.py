"""The files that a specification names, found and read; what is wrong is said with its key."""

import contextlib
import dataclasses
import re
from collections import Counter
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

from jaxtrachea._errors import InputError
from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.files.atomic import is_utf8
from jaxtrachea.measurements.machine import check_machine_files
from jaxtrachea.measurements.names import appearance
from jaxtrachea.measurements.read import (
    WHOLE_FILE,
    BadCurve,
    Curve,
    DataError,
    Measurements,
    ReadOptions,
    joined,
    read_measurements,
)
from jaxtrachea.measurements.readers import reader_of
from jaxtrachea.measurements.readers.recognise import is_workbook

#: Names of curves in a message.
_NAMES = 8


def find_files(spec: FitSpec, root: Path) -> list[Path]:
    """Files of `data.files`, patterns expanded, sorted within each pattern.

    Raises:
        SpecError: a path or pattern matches nothing, or a file whose name is not UTF-8.
    """
    found: dict[Path, None] = {}
    for i, pattern in enumerate(spec.data.files):
        try:
            matches = _matches(root, pattern)
        except (ValueError, NotImplementedError, IndexError, OSError) as error:
            raise SpecError(
                f"data.files.{i}: {_short(pattern)} is no usable path ({_reason(error)}); "
                "name files, or a pattern such as 'curves/*.csv'"
            ) from None
        files = [path for path in matches if path.is_file()]
        if not files:
            what = "a device or a pipe; expected a file"
            if not matches:
                what = _nothing(root / pattern)
            elif matches[0].is_dir():
                what = "a folder; list the files in it, as in 'folder/*.csv'"
            raise SpecError(f"data.files.{i}: {_short(pattern)} matches in {root} {what}")
        for path in files:
            if not is_utf8(path):
                raise SpecError(f"data.files.{i}: the name {str(path)!a} is not UTF-8; rename it")
        found.update(dict.fromkeys(files))
    return list(found)


def _short(pattern: str) -> str:
    """A pattern for a message."""
    return repr(pattern if len(pattern) < 200 else f"{pattern[:196]} ...")


def _nothing(path: Path) -> str:
    """That there is no such file, the one whose name looks like it if there is any, the cure."""
    with contextlib.suppress(OSError):
        names = sorted(other.name for other in path.parent.iterdir())
        for name in names:
            if name != path.name and appearance(name) == appearance(path.name):
                return f"no file; {ascii(name)}, which looks alike, is there; write its name so"
    return "no file; check the name, or say where the data are with --data"


def _reason(error: Exception) -> str:
    """Why, without repeating the path."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _matches(root: Path, pattern: str) -> list[Path]:
    """Files and folders that a path or pattern names; a name that exists is taken as it is."""
    path = root / pattern
    if pattern and path.exists():
        return [path]
    relative = path.relative_to(path.anchor) if Path(pattern).is_absolute() else pattern
    # Folders below folders once: pathlib walks through all of them for every further "**/".
    once = re.sub(r"(?:\*\*/)+", "**/", str(relative))
    return sorted((Path(path.anchor) if Path(pattern).is_absolute() else root).glob(once))


def read_data(spec: FitSpec, root: Path) -> Measurements:
    """Read all files of a specification, and leave out the curves of `data.exclude`.

    Of several files, one that cannot be read at all costs one `BadCurve` named after it.

    Raises:
        SpecError: no file, reading options that contradict each other, or `data.exclude` names a
            curve that is not there.
        DataError: the only file cannot be read, or two files hold the same specimen and trial.
    """
    names = {f.name for f in dataclasses.fields(ReadOptions)}
    try:
        options = ReadOptions(**{k: v for k, v in spec.data.model_dump().items() if k in names})
    except ValueError as error:
        raise SpecError(f"data: {error}") from None
    try:
        reader_of(options.format)
    except InputError as error:
        raise SpecError.like(error, key=f"data.{error.key}") from None
    files = find_files(spec, root)
    if options.sheet is not None and not any(map(is_workbook, files)):
        raise SpecError("data.sheet: none of the files is a workbook (xlsx); remove it")
    try:
        check_machine_files(files, options)
    except DataError as error:
        raise SpecError(f"data: {error}") from None
    if len(files) == 1:
        return _without(read_measurements(files, options), spec.data.exclude)
    return _without(joined([_read_one(path, options) for path in files]), spec.data.exclude)


def _name(curve: Curve | BadCurve) -> str:
    """As `data.exclude` names a curve."""
    return f"{curve.specimen}/{curve.trial}"


def _without(whole: Measurements, exclude: Sequence[str]) -> Measurements:
    """Without the curves that are excluded, usable or not; a note names them."""
    if not exclude:
        return whole
    count = Counter(map(_name, (*whole.curves, *whole.bad)))
    for i, name in enumerate(exclude):
        key = f"data.exclude.{i}"
        if name in exclude[:i]:
            raise SpecError(f"{key}: {name!r} stands twice; name each curve once")
        if count[name] > 1:
            raise SpecError(
                f"{key}: {name!r} are {count[name]} curves, for their names have a slash; rename "
                "one of them"
            )
        if not count[name]:
            near = get_close_matches(name, count, _NAMES) or list(count)[:_NAMES]
            more = f" and {len(count) - len(near)} more" if len(count) > len(near) else ""
            raise SpecError(
                f"{key}: no curve is called {name!r}; expected specimen/trial, one of "
                f"{', '.join(map(repr, near))}{more}"
            )
    curves, bad = (tuple(c for c in part if _name(c) not in exclude)
                   for part in (whole.curves, whole.bad))  # fmt: skip
    note = f"left out by data.exclude: {', '.join(exclude)}"
    return dataclasses.replace(whole, curves=curves, bad=bad, notes=(*whole.notes, note))


def _read_one(path: Path, options: ReadOptions) -> Measurements:
    """One file of several; what spoils it becomes its only row."""
    try:
        return read_measurements([path], options.of_file(path))
    except DataError as error:
        within = "" if error.place in ("", str(path)) else f"{error.place}: "
        cure = error.remedy or "repair the file or leave it out"
        problem = f"{within}{error.problem}"
        bad = BadCurve(path.stem, WHOLE_FILE, str(path), "unreadable", problem, cure)
        return Measurements((), (bad,), (path,))
