"""Which columns are force and displacement where no name says so: by their units, if one alone can.

A guess is for a person who is shown it: `jaxtrachea check` and `init` say what was guessed and
write it into a specification, where it stands as a choice. A fit never guesses.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxtrachea.measurements.heads import Head
from jaxtrachea.measurements.readers.column_roles import USUAL, candidates


class Guess(NamedTuple):
    """What was found for the roles that no column has by its name.

    Attributes:
        columns: role to name of the column that is taken.
        open: role to the names of several columns of which none is taken.
    """

    columns: Mapping[str, str]
    open: Mapping[str, tuple[str, ...]]


def guess(heads: Sequence[Head]) -> Guess:
    """Columns of force and displacement in tables where their names do not tell.

    Args:
        heads: of all files that are read alike.

    Returns:
        A role is taken only where one column can have it, the same in all tables: the only one in
        its unit, or the only one of these with a usual name.
    """
    tables = [head for head in heads if head.is_table and head.columns and not head.ambiguous]
    taken: dict[str, str] = {}
    several: dict[str, tuple[str, ...]] = {}
    for role in USUAL:
        if not tables or any(c.role == role for head in tables for c in head.columns):
            continue
        found = {
            candidates(role, [(c.name, c.unit) for c in head.columns if not c.role])
            for head in tables
        }
        names = found.pop() if len(found) == 1 else ()
        if len(names) == 1:
            taken[role] = names[0]
        elif names:
            several[role] = names
    return Guess(taken, several)
