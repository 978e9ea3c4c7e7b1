"""Which column of a table plays which role, by its name, and the unit that it is in."""

from collections.abc import Sequence

from jaxtrachea.measurements.curve import DataError, Fault, ReadOptions
from jaxtrachea.measurements.observed import OBSERVED
from jaxtrachea.measurements.roles import general_role, ring_role_of, role_dimension
from jaxtrachea.units import UnitError, column_unit, is_unit, unit_factor

# Column names understood without `ReadOptions.columns`, in lower case.
ALIASES = {
    "specimen": ("specimen",),
    "trial": ("trial",),
    "s": ("s", "s_c"),
    "phi": ("phi", "phi_c"),
    "displacement": ("displacement", "compression", "indentation", "compressive displacement"),
    "force": ("force", "load", "compressive load", "compressive force"),
} | {q.role: (q.role, *q.names) for q in OBSERVED if q.names}
#: Names that testing machines give to the travel of their crosshead; they count where no column
#: has a name of `ALIASES`.
TRAVEL = (
    "extension", "compressive extension", "stroke", "distance", "deflection", "crosshead",
    "crosshead position", "crosshead displacement", "position",
)  # fmt: skip
# Roles that a tidy table gives in every row; of a machine file its name gives them, if at all.
OF_TIDY = ("specimen", "trial", "s", "phi")
# Columns of time, taken where they have a unit; they tell the duration of holds.
TIMES = ("time", "elapsed time", "total time", "test time", "running time", "zeit", "prüfzeit")
#: Units of mass that scales and texture analysers write for a force.
WEIGHTS = {"g": "gf", "kg": "kgf"}
_NAMES = {*TRAVEL, *TIMES}.union(*ALIASES.values())
#: Names in lower case that decide among several columns in the unit of a role, or without a unit.
USUAL = {
    "force": ("f", "fz", "f_z", "force z", "normal force", "axial force", "standard force",
              "reaction force", "load cell", "kraft", "standardkraft", "prüfkraft"),
    "displacement": ("d", "u", "uz", "depth", "displ", "disp", "travel", "position (z)", "weg",
                     "standardweg", "traversenweg", "eindringtiefe"),
}  # fmt: skip


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """Name and unit of a column by its cell in the header, ``Load [N]`` or ``Load N``."""
    name, unit = column_unit(cell)
    head, _, tail = name.rpartition(" ")
    if unit is None and head.lower() in _NAMES and is_unit(tail) and not tail.isdigit():
        return head, tail
    return name, unit


def find_roles(
    names: Sequence[str], options: ReadOptions, units: Sequence[str | None] = ()
) -> dict[str, int]:
    """Which column plays which role: by `ReadOptions.columns`, else by the names in `ALIASES`.

    Args:
        names: column names without units.
        options: explicit names.
        units: of the columns; of several of one name those in a unit of the role count, or in that
            which the options have with the name.

    Returns:
        Role -> column index, for the roles found.

    Raises:
        Fault: a named column is absent ("column_missing") or a role has several ("ambiguous").
    """
    lower = [name.lower() for name in names]
    found: dict[str, int] = {}
    for role in {**ALIASES, **options.columns}:
        wanted = options.columns.get(role)
        if wanted is None:
            hits = [i for i, name in enumerate(lower) if name in ALIASES[role]]
            if role == "displacement":
                # Beside a depth a position may be that along the tube.
                names_of_travel = {*TRAVEL}
                if {*lower} & {*USUAL[role]}:
                    names_of_travel.discard("position")
                taken = options.columns.values()
                hits = hits or [
                    i for i, name in enumerate(lower)
                    if name in names_of_travel and names[i] not in taken
                ]  # fmt: skip
        else:
            full = {wanted.strip(), column_unit(wanted)[0]}
            hits = [i for i, name in enumerate(names) if name in full]
            if not hits:
                raise no_column(wanted, role, names)
        if len(hits) > 1 and units:
            meant = None if wanted is None else column_unit(wanted)[1]
            own = [i for i in hits if units[i] == meant] if meant else []
            hits = own or [i for i in hits if may_be(role, units[i])] or hits
        if len(hits) > 1:
            same = units and len({names[i] for i in hits}) < len(hits)
            shown = [f"{names[i]} [{units[i]}]" if same else names[i] for i in hits]
            several = ", ".join(map(repr, shown))
            raise Fault(
                "ambiguous",
                f"{several} can all be the {role}",
                f"name the one meant in columns.{role}",
            )
        if hits:
            found[role] = hits[0]
    for i, name in enumerate(lower):
        of_ring = ring_role_of(name)
        if of_ring is not None and i not in found.values():
            role, ring = of_ring
            if ring < 1 or role in found:
                raise Fault(
                    "ambiguous", f"column {names[i]!r}: ring below 1 or given twice", "count from 1"
                )
            found[role] = i
    return found


def no_column(wanted: str, role: str, names: Sequence[str]) -> Fault:
    """The fault of a table without a column that is needed; it names those that are there."""
    return Fault(
        "column_missing",
        f"no column {wanted!r} for the {role}; the columns are {listed(names)}",
        f"name it in columns.{role}",
    )


def listed(names: Sequence[str]) -> str:
    """Names of columns in quotes, thirty at most."""
    shown = [repr(name if len(name) <= 60 else f"{name[:56]} ...") for name in names[:30]]
    more = f" and {len(names) - 30} more" if len(names) > 30 else ""
    return f"{', '.join(shown)}{more}"


def require_roles(roles: dict[str, int], names: Sequence[str]) -> None:
    """Refuse a table without displacement or force."""
    for role in ("displacement", "force"):
        if role not in roles:
            raise no_column(role, role, names)


def candidates(
    role: str, columns: Sequence[tuple[str, str | None]], usual_only: bool = False
) -> tuple[str, ...]:
    """Names of the columns that may be force or displacement; a usual name comes before the others.

    Args:
        role: "force" or "displacement".
        columns: name and unit of those that have no role.
        usual_only: leave out columns that only their unit speaks for.
    """
    fitting = [name for name, unit in columns if unit and may_be(role, unit)]
    fitting = fitting or [n for n, unit in columns if not unit and n.lower() in USUAL[role]]
    usual = tuple(name for name in fitting if name.lower() in USUAL[role])
    return usual if len(usual) == 1 or usual_only else tuple(fitting)


def columns_of_tidy(roles: dict[str, int], units: Sequence[str | None]) -> list[str]:
    """Roles of which every row of a tidy table tells, and which a file of one trial has not.

    Without a column that has another role as well, as a way that its file calls `s`, and without
    one in the unit of something else, as a time.
    """
    others = {i for role, i in roles.items() if role not in OF_TIDY}
    return [
        role
        for role in OF_TIDY
        if role in roles and roles[role] not in others and may_be(role, units[roles[role]])
    ]


def may_be(role: str, unit: str | None) -> bool:
    """Whether a column in this unit may have the role; without a unit, and names, always."""
    if unit is None or role in ("specimen", "trial"):
        return True
    try:
        unit_factor(unit, role_dimension(role))
    except UnitError:
        return unit in WEIGHTS and role_dimension(role) == "force"
    return True


def resolve_unit(role: str, found: str | None, options: ReadOptions, place: str) -> str:
    """The unit of a role, from the file or from the options, which must not contradict.

    Args:
        role: e.g. ``"force"``, ``"joint_7"`` or ``"end_U_7_y"``.
        found: the unit the file gives, or None.
        options: units for files that give none.
        place: for messages, e.g. ``"column 'Load'"``.

    Raises:
        Fault: no unit ("unit_missing") or an unknown one ("unit_unknown").
        DataError: file and options contradict each other.
    """
    general = general_role(role)
    given = options.units.get(role, options.units.get(general))
    unit = given if found is None else found
    if unit is None:
        raise Fault(
            "unit_missing",
            f"{place} has no unit",
            f"write it in the header, as in 'force [N]', or give data.units.{general}",
        )
    try:
        factor = unit_factor(unit, role_dimension(role))
    except UnitError as error:
        raise Fault(
            "unit_unknown", f"{place}: {error}", "write one of the accepted units"
        ) from None
    if given is not None and unit_factor(given, role_dimension(role)) != factor:
        raise DataError(
            f"{place} is in {found} but units.{general} says {given}",
            cure="remove the wrong one",
        )
    return unit


def time_column(
    names: Sequence[str], units: Sequence[str | None], roles: dict[str, int], options: ReadOptions
) -> tuple[int, str | None] | None:
    """The column of time and its unit: of `columns.time`, else the only one named so.

    Args:
        names: of the columns, without units.
        units: of the columns, None where the header gives none.
        roles: columns by role.
        options: units for columns that have none.

    Returns:
        None if there is no such column; a unit of None: it can be times of day alone.
    """
    hits = [i for i, name in enumerate(names) if name.lower() in TIMES]
    if "time" in roles:
        hits = [roles["time"]]
    if len(hits) != 1:
        return None
    try:
        return hits[0], resolve_unit("time", units[hits[0]], options, f"column {names[hits[0]]!r}")
    except Fault:
        return hits[0], None
