"""Columns whose names do not tell: force and displacement by their units, others by usual names.

A guess is for a person who is shown it: `jaxtrachea check` and `init` say what was guessed and
write it into a specification, where it stands as a choice. A fit never guesses.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from jaxtrachea.measurements.heads import Head
from jaxtrachea.measurements.readers.column_roles import USUAL, candidates, may_be, name_and_unit

#: Names in lower case that give a column a role which no unit tells.
BY_NAME = {
    "s": ("position", "pos", "location", "station", "site", "stelle", "ort"),
    "specimen": ("sample", "probe", "animal", "tier"),
    "trial": ("test", "run", "versuch", "messung", "repeat", "press"),
}


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
    for role in (*USUAL, *BY_NAME):
        has = (c.role == role for head in tables for c in head.columns)
        if role in known or not tables or any(has):
            continue
        unused = [[(c.name, c.unit) for c in head.columns if not c.role] for head in tables]
        of_role = _named if role in BY_NAME else candidates
        found = {of_role(role, columns) for columns in unused}
        names = found.pop() if len(found) == 1 else ()
        if len(names) == 1:
            taken[role] = names[0]
        elif names:
            several[role] = names
    return Guess(taken, several)


def _named(role: str, columns: Sequence[tuple[str, str | None]]) -> tuple[str, ...]:
    """Names of the columns that are called as a role is; a position has a unit of length."""
    usual = BY_NAME[role]
    named = [(name, unit) for name, unit in columns if name_and_unit(name)[0].lower() in usual]
    return tuple(name for name, unit in named if role != "s" or (unit and may_be("s", unit)))
