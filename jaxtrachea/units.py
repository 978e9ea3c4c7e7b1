"""Units at the edges: everything inside is mm, N, rad, s (hence MPa, N/mm, N/mm^3, tonne).

A unit is a product of named units with integer powers: ``N/mm^3``, ``N mm/rad``, ``kPa``. Names are
case-sensitive, because ``mN`` and ``MN`` differ by nine orders of magnitude. Factors are exact
fractions until the last step, so ``9 mm`` is 9.0 and ``10 kPa`` is 0.01 to the last bit.
"""

import math
import re
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from typing import overload

import numpy as np

from jaxtrachea._errors import InputError


class UnitError(InputError):
    """A unit is missing, unknown, or of the wrong dimension."""


# Exponents of (force, length, time, angle) of each dimension a file or configuration may name.
DIMENSIONS: dict[str, tuple[int, int, int, int]] = {
    "dimensionless": (0, 0, 0, 0),
    "length": (0, 1, 0, 0),
    "area": (0, 2, 0, 0),
    "inverse_length": (0, -1, 0, 0),
    "inverse_area": (0, -2, 0, 0),
    "second_moment_of_area": (0, 4, 0, 0),
    "force": (1, 0, 0, 0),
    "moment": (1, 1, 0, 0),
    "inverse_energy": (-1, -1, 0, 0),
    "angle": (0, 0, 0, 1),
    "time": (0, 0, 1, 0),
    "velocity": (0, 1, -1, 0),
    "frequency": (0, 0, -1, 0),
    "acceleration": (0, 1, -2, 0),
    "mass": (1, -1, 2, 0),
    "density": (1, -4, 2, 0),
    "stress": (1, -2, 0, 0),
    "stiffness": (1, -1, 0, 0),
    "cubic_stiffness": (1, -3, 0, 0),
    "foundation_stiffness": (1, -3, 0, 0),
    "quintic_stiffness": (1, -5, 0, 0),
    "compliance": (-1, 1, 0, 0),
    "rotational_stiffness": (1, 1, 0, -1),
    "bending_stiffness": (1, 2, 0, 0),
    "damping": (1, -1, 1, 0),
}

# What an error message proposes; the parser accepts every product of the right dimension.
ACCEPTED: dict[str, tuple[str, ...]] = {
    "dimensionless": ("1", "-", "%"),
    "length": ("mm", "m", "cm", "um", "nm", "in"),
    "area": ("mm^2", "cm^2", "m^2"),
    "inverse_length": ("1/mm", "1/m"),
    "inverse_area": ("1/mm^2", "1/m^2"),
    "second_moment_of_area": ("mm^4", "m^4"),
    "force": ("N", "kN", "mN", "uN", "nN", "pN", "gf", "kgf", "lbf"),
    "moment": ("N mm", "N m", "mN m"),
    "inverse_energy": ("1/N/mm", "1/N/m", "1/mN/m"),
    "angle": ("rad", "deg", "mrad"),
    "time": ("s", "ms", "us", "min", "h"),
    "velocity": ("mm/s", "mm/min", "m/s", "um/s"),
    "frequency": ("Hz", "kHz", "1/s"),
    "acceleration": ("mm/s^2", "m/s^2"),
    "mass": ("tonne", "kg", "g", "mg"),
    "density": ("tonne/mm^3", "kg/m^3", "g/cm^3"),
    "stress": ("MPa", "kPa", "Pa", "GPa", "N/mm^2", "bar", "psi", "mmHg", "cmH2O"),
    "stiffness": ("N/mm", "N/m", "mN/mm", "kN/m", "nN/um"),
    "cubic_stiffness": ("N/mm^3", "N/m^3", "mN/mm^3"),
    "foundation_stiffness": ("N/mm^3", "MPa/mm", "kPa/mm"),
    "quintic_stiffness": ("N/mm^5", "N/m^5"),
    "compliance": ("mm/N", "m/N", "um/mN"),
    "rotational_stiffness": ("N mm/rad", "N m/rad", "N mm/deg"),
    "bending_stiffness": ("N mm^2", "N m^2", "MPa mm^4"),
    "damping": ("N s/mm", "N s/m"),
}

#: What numbers without a unit most likely are in, where that is not the first accepted one.
WRITTEN = {"angle": "deg"}

_LBF = Fraction("4.4482216152605")
_INCH = Fraction("25.4")


def _prefixed(
    table: dict[str, tuple[Fraction, tuple[int, int, int, int]]],
    name: str,
    factor: Fraction,
    exponents: tuple[int, int, int, int],
    prefixes: str,
) -> None:
    """Add `name` and its multiples, with those prefixes that make sense for it."""
    scale = {"p": -12, "n": -9, "u": -6, "µ": -6, "m": -3, "c": -2, "k": 3, "M": 6, "G": 9}
    table[name] = (factor, exponents)
    for prefix in prefixes:
        table[prefix + name] = (factor * Fraction(10) ** scale[prefix], exponents)


def _unit_table() -> dict[str, tuple[Fraction, tuple[int, int, int, int]]]:
    table: dict[str, tuple[Fraction, tuple[int, int, int, int]]] = {}
    _prefixed(table, "m", Fraction(1000), DIMENSIONS["length"], "nuµmck")
    _prefixed(table, "N", Fraction(1), DIMENSIONS["force"], "pnuµmckM")
    _prefixed(table, "Pa", Fraction(1, 10**6), DIMENSIONS["stress"], "mkMG")
    _prefixed(table, "s", Fraction(1), DIMENSIONS["time"], "nuµm")
    _prefixed(table, "rad", Fraction(1), DIMENSIONS["angle"], "m")
    _prefixed(table, "Hz", Fraction(1), DIMENSIONS["frequency"], "mk")
    _prefixed(table, "g", Fraction(1, 10**6), DIMENSIONS["mass"], "umk")  # kg = 1e-3 N s^2/mm
    degree = Fraction(math.pi) / 180
    named = {
        "length": {"in": _INCH, "inch": _INCH},
        "force": {
            "gf": Fraction("0.00980665"),
            "kgf": Fraction("9.80665"),
            "lbf": _LBF,
            "newton": Fraction(1),
        },
        "angle": {"deg": degree, "°": degree, "degree": degree, "degrees": degree},
        "time": {"sec": Fraction(1), "Sec": Fraction(1), "min": Fraction(60), "h": Fraction(3600)},
        "mass": {"tonne": Fraction(1)},
        "stress": {
            "bar": Fraction(1, 10),
            "mbar": Fraction(1, 10**4),
            "psi": _LBF / _INCH**2,
            "mmHg": Fraction("133.322387415") / 10**6,
            "cmH2O": Fraction("98.0665") / 10**6,
        },
        "dimensionless": {"1": Fraction(1), "-": Fraction(1), "%": Fraction(1, 100)},
    }
    for dimension, units in named.items():
        table.update({name: (factor, DIMENSIONS[dimension]) for name, factor in units.items()})
    return table


_UNITS = _unit_table()
#: Longest header or quantity that is looked into; the expressions below may take its square.
MAX_TEXT = 1000
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_FACTOR = re.compile(r"(?P<name>.*?[^\d^+-])\^?(?P<power>[+-]?\d+)")
_QUANTITY = re.compile(r"(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>.*)")


def _named(text: str) -> tuple[Fraction, tuple[int, ...]] | None:
    """One named unit with an optional power: ``mm``, ``mm^2``, ``mm2``, ``cmH2O``."""
    if text in _UNITS:
        return _UNITS[text]
    match = _FACTOR.fullmatch(text)
    if match is None or match["name"] not in _UNITS:
        return None
    power = int(match["power"])
    if not 0 < abs(power) <= 9:
        return None
    factor, exponents = _UNITS[match["name"]]
    return factor**power, tuple(power * e for e in exponents)


@lru_cache(maxsize=1024)
def _parse(unit: str) -> tuple[Fraction, tuple[int, ...]] | None:
    """Factor to internal units and exponents of a unit expression, or None if it is not one."""
    text = unit.strip().replace("μ", "µ")
    text = re.sub("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda m: "^" + m[0].translate(_SUPERSCRIPTS), text)
    if len(text) > 64:
        return None
    if text == "":
        return Fraction(1), DIMENSIONS["dimensionless"]
    factor, total = Fraction(1), (0, 0, 0, 0)
    for sign, name in re.findall(
        r"(^|[*·/]|\s)\s*([^*·/\s]*)", re.sub(r"\s*([*·/])\s*", r"\1", text)
    ):
        named = _named(name)
        if named is None:
            return None
        power = -1 if sign == "/" else 1
        factor *= named[0] ** power
        total = tuple(t + power * e for t, e in zip(total, named[1], strict=True))
    return factor, total


def _similar(unit: str) -> str:
    names = [name for name in _UNITS if name.casefold() == unit.strip().casefold()]
    return f"; names are case-sensitive, did you mean {' or '.join(names)}?" if names else ""


def unit_factor(unit: str, dimension: str) -> Fraction:
    """Factor that turns a number in `unit` into internal units (mm, N, rad, s).

    Args:
        unit: unit expression, e.g. ``"kPa"``, ``"N/mm^3"``, ``"µm"``.
        dimension: one of `DIMENSIONS`.

    Returns:
        The factor as a fraction (exact, but for degrees, where pi is a float64).

    Raises:
        UnitError: the unit is unknown or of another dimension; the message lists accepted ones.
        ValueError: `dimension` itself is unknown (a slip of the caller).
    """
    if dimension not in DIMENSIONS:
        raise ValueError(f"dimension {dimension!r} is none of {', '.join(DIMENSIONS)}")
    accepted = ", ".join(ACCEPTED[dimension])
    parsed = _parse(unit)
    if parsed is None:
        raise UnitError(
            f"unknown unit {unit!r} for {dimension}: accepted are {accepted}{_similar(unit)}"
        )
    if parsed[1] != DIMENSIONS[dimension]:
        raise UnitError(f"unit {unit!r} does not measure {dimension}: accepted are {accepted}")
    return parsed[0]


def is_unit(text: str) -> bool:
    """Whether `text` reads as a unit of any dimension (an empty text does not)."""
    return text.strip() != "" and _parse(text) is not None


@overload
def convert(value: float, unit: str, dimension: str) -> float: ...
@overload
def convert(value: np.ndarray | Sequence[float], unit: str, dimension: str) -> np.ndarray: ...
def convert(
    value: float | int | np.ndarray | Sequence, unit: str, dimension: str
) -> float | np.ndarray:
    """Convert a number or an array from `unit` to internal units (mm, N, rad, s).

    Args:
        value: a number, or an array or sequence of any shape.
        unit: the unit it is in.
        dimension: the dimension it must have, one of `DIMENSIONS`.

    Returns:
        float for a number, else a new float64 array of the same shape.

    Raises:
        UnitError: the unit is unknown or of another dimension.
    """
    factor = unit_factor(unit, dimension)
    array = np.array(value, dtype=np.float64)
    # Division by an integer rounds once; multiplication by its rounded inverse would round twice.
    scaled = array / factor.denominator if factor.numerator == 1 else array * float(factor)
    return float(scaled) if np.ndim(scaled) == 0 else scaled


def parse_quantity(text: str | float | int, dimension: str) -> float:
    """Read ``"9 mm"``, ``"0.03 N"``, ``"10 kPa"`` into internal units (mm, N, rad, s).

    Args:
        text: number and unit. A bare number is refused unless `dimension` is "dimensionless".
        dimension: the dimension it must have, one of `DIMENSIONS`.

    Raises:
        UnitError: no unit, an unknown one, one of another dimension, or no finite number.
    """
    example = WRITTEN.get(dimension) or ACCEPTED.get(dimension, ("",))[0]
    if not isinstance(text, str):
        if dimension == "dimensionless" and not isinstance(text, bool) and math.isfinite(text):
            return float(text)
        raise UnitError(f'{text!r} has no unit: write it with one, as in "{text} {example}"')
    if len(text) > MAX_TEXT:
        raise UnitError(
            f'{text[:40]!r} ... is too long for a number with a unit: write "9.5 {example}"'
        )
    match = _QUANTITY.fullmatch(text.strip())
    if match is None or match["unit"].startswith(","):
        raise UnitError(f'{text!r} is not a number with a unit: write it as in "9.5 {example}"')
    number, unit = float(match["number"]), match["unit"]
    if not unit and dimension != "dimensionless":
        raise UnitError(
            f'{text!r} has no unit: write it with one, as in "{text.strip()} {example}"'
        )
    if not math.isfinite(number):
        raise UnitError(f"{text!r} is not a finite number; write a smaller one")
    return convert(number, unit, dimension)


def column_unit(header: str) -> tuple[str, str | None]:
    """Split a column header into name and unit.

    ``force [N]``, ``force (N)``, ``force / N``, ``force, N`` and ``force_N`` all give
    ``("force", "N")``. What stands in brackets is taken for a unit whether or not it is a known
    one, so that a slip is reported as such; after ``_``, ``/`` or a comma only a known unit counts.
    """
    text = header.strip()
    if len(text) > MAX_TEXT:
        return text, None
    match = re.fullmatch(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))", text)
    if match and match[1]:
        return match[1], (match[2] if match[2] is not None else match[3]).strip()
    # A name may hold underscores and still have its unit after a slash: joint_7 / mm.
    for separator in ("_", r"\s/\s", r",\s"):
        match = re.fullmatch(rf"(.+?)\s*{separator}\s*([^_]+)", text)
        if match and is_unit(match[2]) and not re.fullmatch(r"[\d\s-]+", match[2]):
            return match[1], match[2].strip()
    return text, None
