"""What the name of a file says of its curves: specimen, trial, position, conditions."""

import contextlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from jaxtrachea.measurements.curve import DataError, ReadOptions
from jaxtrachea.measurements.roles import role_dimension
from jaxtrachea.units import parse_quantity

_LEADING = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)")


@dataclass(frozen=True)
class FileIdentity:
    """What the name of a file says about its curves: s in mm, phi in rad, None if not said.

    `conditions`: further names of the pattern whose text begins with a number.
    """

    specimen: str
    trial: str | None
    s: float | None
    phi: float | None
    conditions: tuple[tuple[str, float], ...] = ()


def identify_file(path: Path, options: ReadOptions) -> FileIdentity:
    """Specimen, trial and position from a file name by `ReadOptions.specimen`.

    Without a pattern the specimen is the file name without its suffix (``.csv`` or ``.csv.gz``).

    Raises:
        DataError: the pattern does not fit, or s or phi is no number or has no unit.
    """
    pattern = options.name_pattern
    if pattern is None:
        name = path.with_suffix("") if path.suffix.lower() == ".gz" else path
        return FileIdentity(name.stem, None, None, None)
    match = pattern.search(path.name)
    if match is None:
        raise DataError(
            f"the file name does not fit the specimen pattern {options.specimen!r}",
            place=str(path),
            cure="correct the pattern or leave the file out",
        )
    found = match.groupdict()
    position: dict[str, float | None] = {"s": None, "phi": None}
    for role in position:
        if found.get(role) is not None:
            try:
                position[role] = parse_quantity(
                    f"{found[role]} {options.units.get(role, '')}", role_dimension(role)
                )
            except ValueError as error:
                raise DataError(
                    f"{role} in the file name: {error}",
                    place=str(path),
                    cure="give its unit in units",
                ) from None
    others = {k: v for k, v in found.items() if k not in ("specimen", "trial", *position)}
    place = (position["s"], position["phi"])
    return FileIdentity(found["specimen"], found.get("trial"), *place, numbers_of(others))


def numbers_of(texts: Mapping[str, object]) -> tuple[tuple[str, float], ...]:
    """The entries that are finite numbers, or texts that begin with one."""
    found = []
    for name, value in texts.items():
        match = _LEADING.match(value) if isinstance(value, str) else None
        number = match[1] if match else value
        if isinstance(number, str | int | float) and not isinstance(number, bool):
            with contextlib.suppress(ValueError, OverflowError):
                found.append((name, float(number)))
    return tuple((name, value) for name, value in found if math.isfinite(value))
