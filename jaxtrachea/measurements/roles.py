"""Roles of the columns of a table: what each is called, its dimension, and the ring it is of."""

import re

from jaxtrachea.measurements.observed import OBSERVED, RINGS

#: Dimension of every role; "joint" and "end" stand for all columns of markers and of ring ends.
ROLE_DIMENSIONS = {
    "s": "length",
    "phi": "angle",
    "displacement": "length",
    "force": "force",
} | {q.role: q.dimension for q in OBSERVED}
ROLES = ("specimen", "trial", *ROLE_DIMENSIONS)
#: Roles of columns of numbers, one per sample, that a curve is made of; time has its own rules.
SAMPLED = (
    "displacement",
    "force",
    *(q.role for q in OBSERVED if q.rings is None and q.name != "time"),
)
# Columns of rings: the general role, and a name in lower case, with the ring's number in it.
_OF_RING = [
    (q.role, role, re.compile(role.lower().replace("_", "[ _]?").replace("#", r"(\d{1,4})")))
    for of_rings in RINGS.values()
    for q in of_rings
    for role in q.columns("#")
]
#: Roles of single rings, for messages.
RING_ROLES = ", ".join(role.replace("#", "<ring>") for _, role, _ in _OF_RING)


def _of_ring(role: str) -> str | None:
    """The general role of a single ring's; rings count from 1 at the carina end."""
    alike = re.sub(r"(?<=_)[1-9]\d{0,3}(?=_|$)", "#", role)
    return next((general for general, name, _ in _OF_RING if name == alike), None)


def general_role(role: str) -> str:
    """The role that `units` may name for all rings: ``"joint"`` of ``"joint_7_side"``."""
    return _of_ring(role) or role


def is_role(role: str) -> bool:
    """Whether there is such a role."""
    return role in ROLES or is_ring_role(role)


def is_ring_role(role: str) -> bool:
    """Whether a role is that of a single ring: ``"joint_7"``, ``"end_U_7_y"``."""
    return _of_ring(role) is not None


def role_dimension(role: str) -> str:
    """Dimension of a role, e.g. ``"length"`` for ``"displacement"`` or ``"joint_7"``."""
    return ROLE_DIMENSIONS[general_role(role)]


def ring_role_of(name: str) -> tuple[str, int] | None:
    """Role and ring number of a column by its name, which may count from 0 by mistake.

    Args:
        name: as in the header, without unit, in lower case.

    Returns:
        For example ``("end_U_7_y", 7)``; None if it is no column of a ring.
    """
    for _, role, pattern in _OF_RING:
        if match := pattern.fullmatch(name):
            return role.replace("#", str(int(match[1]))), int(match[1])
    return None
