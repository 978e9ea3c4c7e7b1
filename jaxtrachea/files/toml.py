"""A TOML specification read and checked; what is wrong is said in a line each, with the cure."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from jaxtrachea._errors import InputError
from jaxtrachea.files.atomic import is_utf8

Spec = TypeVar("Spec", bound=BaseModel)
#: Longest specification that is read.
MAX_BYTES = 2**20
#: Problems that are listed one by one.
MAX_LINES = 10
#: Names of the two ways to write `trachea.rings`; pydantic puts them into the place of an error.
EVEN, LISTED = "evenly spaced", "listed"


class SpecError(InputError):
    """A specification that cannot be used; the message has one line per problem.

    The place is the file, which a command knows; where nothing else does, it is empty.
    """


def load_spec(
    path: Path, kind: type[Spec], called: str, others: Mapping[str, str] | None = None
) -> Spec:
    """Read and validate a specification of any kind.

    Args:
        kind: the record it must fit.
        called: what a user calls it.
        others: a table that only another kind of file has, and what that file is.

    Raises:
        SpecError: as `load_fit_spec`.
    """
    content = read_tables(path, called)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        for table, other in (others or {}).items():
            if table in content:
                found = f"has a table [{table}], so it is {other}"
                raise SpecError(found, place=str(path), expected=f"a {called}") from None
        lines = _lines(error, kind)
        more = f"\n... and {len(lines) - MAX_LINES} more" if len(lines) > MAX_LINES else ""
        told = f"\n{path}: ".join(lines[:MAX_LINES])
        raise SpecError(f"{told}{more}", place=str(path)) from None


def read_tables(path: Path, called: str) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SpecError: it cannot be read, or is no TOML.
    """
    text = _text(path, called)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        if path.suffix.lower() != ".toml":
            raise SpecError(
                "not TOML", place=str(path), expected=f"a TOML {called}",
                cure=f"for a data file `jaxtrachea init {path}` writes a fit specification",
            ) from None  # fmt: skip
        raise SpecError(f"not valid TOML: {_at_line(error, text)}", place=str(path)) from None
    except RecursionError:
        raise SpecError(
            "not valid TOML: nested too deeply", place=str(path), expected="tables"
        ) from None
    except ValueError:  # the one other refusal of tomllib: an integer that Python does not convert
        raise SpecError(
            "not valid TOML: an integer of too many digits",
            place=str(path),
            expected="4300 digits at most",
        ) from None


def _text(path: Path, called: str) -> str:
    """Content of a specification."""
    if not is_utf8(path):
        raise SpecError("its name is not UTF-8", place=str(path), cure="rename it")
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise SpecError("is a device or a pipe", place=str(path), expected=f"a TOML {called}")
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        reason = error.strerror or "cannot be read"
        raise SpecError(reason, place=str(path), expected=f"a TOML {called}") from None
    if len(data) > MAX_BYTES:
        raise SpecError(
            f"more than {MAX_BYTES} bytes", place=str(path), expected=f"a TOML {called}, not data"
        )
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise SpecError(
            f"not UTF-8 (byte {error.start})", place=str(path), cure="save it as UTF-8"
        ) from None


def _at_line(error: tomllib.TOMLDecodeError, text: str) -> str:
    """What is wrong with which line, and what that line is."""
    said, _, place = str(error).partition(" (at ")
    lines = text.rstrip("\n").split("\n")
    match = re.match(r"line (\d+)", place)
    number = min(int(match[1]), len(lines)) if match else len(lines)
    line = lines[number - 1].strip()
    shown = repr(line if len(line) < 60 else f"{line[:56]} ...")
    hint = ": a table or key that was there before" if "twice" in said or "Cannot" in said else ""
    return f"{said}{hint} (line {number}); correct {shown}"


def _lines(error: ValidationError, root: type[BaseModel]) -> list[str]:
    """One line per problem: dotted key, what is wrong, what was found."""
    lines: dict[str, None] = {}
    for problem in error.errors():
        parts = [part for part in problem["loc"] if part not in (EVEN, LISTED)]
        key = ".".join(map(str, parts))
        text = problem["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
        if problem["type"] == "extra_forbidden":
            text = f"unknown key; expected one of {', '.join(_known(parts, root))}"
        elif problem["type"] == "missing":
            text = _missing(parts, root)
        elif problem["type"] in ("too_short", "too_long"):
            bound = "min" if problem["type"] == "too_short" else "max"
            context = problem.get("ctx", {})
            count, found = context[f"{bound}_length"], context["actual_length"]
            word = "at least" if bound == "min" else "at most"
            text = f"expected {word} {count} item{'s' * (count != 1)} (found {found})"
        elif problem["type"] in ("model_type", "dict_type"):
            text = f"expected a table {{ key = value, ... }} (found {problem['input']!r})"
        elif not isinstance(problem["input"], dict | list):
            found = repr(problem["input"])
            text = f"{text} (found {found if len(found) < 80 else found[:76] + ' ...'})"
        lines.setdefault(f"{key}: {text}" if key else text)
    return list(lines)


def _missing(parts: list, root: type[BaseModel]) -> str:
    """What to do about a missing key."""
    if isinstance(parts[-1], int):
        return "missing; give one item more"
    section = _section(parts, root)
    field = section.model_fields.get(parts[-1])
    inner = _sections(field.annotation) if field else []
    if inner:
        fields = inner[-1].model_fields
        needed = [name for name, value in fields.items() if value.is_required()]
        keys = ", ".join(needed) if needed else f"some of {', '.join(fields)}"
        return f"missing; add a table [{parts[-1]}] with {keys}"
    return f"missing; add it to [{'.'.join(map(str, parts[:-1]))}]"


def _known(parts: list, root: type[BaseModel]) -> list[str]:
    """Keys of the section that holds the unknown key `parts`."""
    return list(_section(parts, root).model_fields)


def _section(parts: list, root: type[BaseModel]) -> type[BaseModel]:
    """The section that holds the key `parts`."""
    section = root
    for part in parts[:-1]:
        field = section.model_fields.get(part)
        section = _sections(field.annotation)[-1] if field else section
    return section


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """The sections named anywhere in a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _sections(part)]
