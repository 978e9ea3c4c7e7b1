"""Columns whose names do not tell: force and displacement by their units, others by usual names.

A guess is for a person who is shown it: `jaxtrachea check` and `init` say what was guessed and
write it into a specification, where it stands as a choice. A fit never guesses.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from jaxtrachea.measurements.heads import Column, Head
from jaxtrachea.measurements.roles import role_dimension
from jaxtrachea.units import UnitError, unit_factor

#: Names in lower case that decide among several columns in the unit of a role, or without a unit.
USUAL = {
    "force": ("f", "fz", "f_z", "force z", "normal force", "axial force", "standard force",
              "reaction force", "load cell", "kraft", "standardkraft", "prüfkraft"),
    "displacement": ("d", "u", "uz", "depth", "displ", "disp", "stroke", "extension", "travel",
                     "crosshead", "deflection", "weg", "standardweg", "traversenweg",
                     "eindringtiefe"),
    "s": ("position", "pos", "location", "station", "site", "stelle", "ort"),
    "specimen": ("sample", "probe", "animal", "tier"),
    "trial": ("test", "run", "versuch", "messung", "repeat", "press"),
}  # fmt: skip
#: Roles that nothing but a usual name gives a column.
_BY_NAME = ("s", "specimen", "trial")


class Guess(NamedTuple):
    """What was found for the roles that no column has by its name.

    Attributes:
        columns: role to name of the column that is taken.
        open: role to the names of several columns of which none is taken.
    """

    columns: Mapping[str, str]
    open: Mapping[str, tuple[str, ...]]


def guess(heads: Sequence[Head], known: Collection[str] = ()) -> Guess:
    """Columns of force, displacement and place in tables where their names do not tell.

    Args:
        heads: of all files that are read alike.
        known: roles that are said besides, and are not looked for.

    Returns:
        A role is taken only where one column can have it, the same in all tables: the only one in
        its unit, or the only one of these with a usual name.
    """
    tables = [head for head in heads if head.is_table and head.columns and not head.ambiguous]
    taken: dict[str, str] = {}
    several: dict[str, tuple[str, ...]] = {}
    for role in USUAL.keys() - set(known):
        if not tables or any(c.role == role for head in tables for c in head.columns):
            continue
        found = {_candidates(role, head.columns) for head in tables}
        names = found.pop() if len(found) == 1 else ()
        if len(names) == 1:
            taken[role] = names[0]
        elif names:
            several[role] = names
    return Guess(taken, several)


def _candidates(role: str, columns: Sequence[Column]) -> tuple[str, ...]:
    """Names of the columns that may have a role; a usual name comes before the others."""
    unused = [c for c in columns if not c.role]
    if role in _BY_NAME:
        named = [c for c in unused if _plain(c) in USUAL[role]]
        able = [c for c in named if role != "s" or (c.unit and _measures(c.unit, "length"))]
        return tuple(c.name for c in able)
    fitting = [c for c in unused if c.unit and _measures(c.unit, role_dimension(role))]
    fitting = fitting or [c for c in unused if not c.unit and c.name.lower() in USUAL[role]]
    usual = [c.name for c in fitting if c.name.lower() in USUAL[role]]
    return tuple(usual) if len(usual) == 1 else tuple(c.name for c in fitting)


def _plain(column: Column) -> str:
    """Name in lower case, without a unit behind it as in ``Position mm``."""
    name = column.name.lower()
    return name.removesuffix(f" {column.unit.lower()}") if column.unit else name


def _measures(unit: str, dimension: str) -> bool:
    try:
        unit_factor(unit, dimension)
    except UnitError:
        return False
    return True
