"""Roles of the columns of a table: what each is called, its dimension, and the ring it is of."""

import re

#: Dimension of every role; "joint" and "end" stand for all columns of markers and of ring ends.
ROLE_DIMENSIONS = {
    "s": "length",
    "phi": "angle",
    "displacement": "length",
    "force": "force",
    "side_force": "force",
    "sigma": "force",
    "time": "time",
    "joint": "length",
    "end": "length",
}
ROLES = ("specimen", "trial", *ROLE_DIMENSIONS)
#: Roles of columns of numbers, one per sample, that a curve is made of.
SAMPLED = ("displacement", "force", "side_force", "sigma")
#: Roles of single rings, for messages.
RING_ROLES = "joint_<ring>, joint_<ring>_side, end_U_<ring>_y (V, z likewise)"
# Roles of single rings, and the columns of a header in lower case that play them: ring numbers
# count from 1 at the carina end.
_RING = r"[1-9]\d{0,3}"
_RING_ROLE = re.compile(rf"(joint)_{_RING}(?:_side)?|(end)_[UV]_{_RING}_[yz]")
_JOINT = re.compile(r"joint[ _]?(\d{1,4})([ _]side)?")
_END = re.compile(r"end[ _]?([uv])[ _]?(\d{1,4})[ _]?([yz])")


def general_role(role: str) -> str:
    """The role that `units` may name for all rings: ``"joint"`` of ``"joint_7_side"``."""
    match = _RING_ROLE.fullmatch(role)
    return role if match is None else match[1] or match[2]


def is_role(role: str) -> bool:
    """Whether there is such a role."""
    return role in ROLES or is_ring_role(role)


def is_ring_role(role: str) -> bool:
    """Whether a role is that of a single ring: ``"joint_7"``, ``"end_U_7_y"``."""
    return _RING_ROLE.fullmatch(role) is not None


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
    if match := _JOINT.fullmatch(name):
        return f"joint_{int(match[1])}{'_side' if match[2] else ''}", int(match[1])
    if match := _END.fullmatch(name):
        return f"end_{match[1].upper()}_{int(match[2])}_{match[3]}", int(match[2])
    return None
