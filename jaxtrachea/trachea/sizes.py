"""Sizes that a trachea can have; beyond them the unit is most likely wrong."""

from jaxtrachea._errors import InputError
from jaxtrachea.trachea.geometry import Geometry

#: Length of a trachea, mm: from a newborn mouse's to more than a horse's (some 800 mm).
LENGTHS = (2.0, 1000.0)
#: Its radius, mm: a mouse's is 0.6, a horse's some 30.
RADII = (0.2, 100.0)
#: Extent of a ring along it, mm: from a tenth of a newborn mouse's to ten times a horse's.
HEIGHTS = (0.02, 100.0)
#: Thickness of its wall, mm: from a tenth of a mouse's to some five times a horse's.
THICKNESSES = (0.005, 50.0)
#: Radius of a tool's flat end, mm: from a needle's.
TOOLS = (0.01, 100.0)
#: Widest smooth first touch, over the radius: wider ones are a good part of a press.
ONSET = 0.1


class SizeError(InputError):
    """A length that no trachea and no tool has: what, how long, what is expected, the cause."""


def check_tube(geometry: Geometry, onset_width: float, transition: float | None) -> None:
    """Refuse lengths that are most likely given in another unit.

    Args:
        onset_width: of the smooth first touch, mm.
        transition: from a ring's centre to where the ligament's local law holds, mm, or None.

    Raises:
        SizeError: the first of them.
    """
    check_geometry(geometry)
    check_length("onset_width", onset_width, (0.0, ONSET * float(geometry.radius)))
    if transition is not None:
        check_length("transition", transition, (HEIGHTS[0], float(geometry.length)))


def check_geometry(geometry: Geometry) -> None:
    """Refuse a tube of which a length is most likely given in another unit.

    Raises:
        SizeError: the first of them, with the key `geometry.length`, say.
    """
    for name, limits in (("length", LENGTHS), ("radius", RADII), ("ring_height", HEIGHTS)):
        check_length(f"geometry.{name}", float(getattr(geometry, name)), limits)


def check_length(name: str, value: float, limits: tuple[float, float]) -> None:
    """Refuse a length that is most likely given in another unit.

    Args:
        name: key of the error.
        value: mm.
        limits: least and largest, mm.

    Raises:
        SizeError: it is outside its limits.
    """
    low, high = limits
    if not low <= value <= high:
        small = f"is the unit wrong (mm in place of m)? It would be {1000 * value:.4g} mm"
        raise SizeError(
            f"is {value:.4g} mm",
            key=name,
            expected=f"{low:g} to {high:.4g} mm",
            cure=f"lengths are in mm: {cause(value) if value > high else small}",
            joint=" ",
        )


def cause(value: float) -> str:
    """The unit that a length of `value` mm, which is too long, may be in."""
    return (
        f"is the unit wrong (m or cm in place of mm)? It would be {value / 1000:.4g} mm or "
        f"{value / 10:.4g} mm"
    )
