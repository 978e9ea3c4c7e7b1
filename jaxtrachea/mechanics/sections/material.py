r"""What a skeleton of deforming cross-sections is made of, and where its numbers come from.

Four stiffnesses and the bed are what force-displacement curves and markers determine: EI_C, Et_L,
D_L, c_W, bed_n and bed_t. `from_wall` derives all from moduli and thicknesses; what the wall's own
numbers leave open are `Factors`, each with its name.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._arguments import real, shaped
from jaxtrachea._errors import InputError
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import VALUES, Declaration, Fitted
from jaxtrachea.trachea.sizes import THICKNESSES, TOOLS, check_length


def _field(name: str, unit: str, dimension: str, description: str, fit: Fitted, **more: Any) -> Any:
    """A field and its declaration; `default`: of the field."""
    default = {"default": more.pop("default")} if "default" in more else {}
    absent = f"{default['default']:g}" if default else ""
    declaration = Declaration(
        name, unit, dimension, description, part="sections", needs="sections", absent=absent,
        fit=fit, **more,
    )  # fmt: skip
    return _declared(declaration, **default)


def _declared(declaration: Declaration, **default: Any) -> Any:
    convert = functools.partial(real, declaration.name)
    return eqx.field(converter=convert, metadata={"declaration": declaration}, **default)


def _fixed(value: float, lower: float = 1e-9, upper: float = 1e9, **more: Any) -> Fitted:
    """Not fitted unless named: what a few presses do not determine."""
    return Fitted(value, lower, upper, fixed=True, **more)


class SectionMaterial(eqx.Module):
    """Stiffnesses of rings, wall, bed and contact.

    A scalar holds for all; an array gives each ring, shape (rings,), or span, shape (rings + 1,),
    its own. The mid-line of the sections has the radius of the `Geometry`.

    Attributes:
        offset: from the mid-line of the wall to its outer surface, mm; a scalar.
        EI_C: bending stiffness in front, N mm^2 for each ring with its pitch of wall; a ring.
        EI_M: likewise of the muscle behind; a ring.
        Et_M: modulus times thickness of the muscle around the tube, N/mm; a ring.
        bed_n: bed behind the muscle, along the normal, per area of the outer surface, N/mm^3; a
            ring.
        bed_t: likewise along the circumference; a ring.
        Gt_L: shear modulus times thickness of the wall between rings, N/mm; a span. Large values
            stand for a wall without membrane shear.
        Et_L: modulus along the tube times thickness of that wall, N/mm; a span.
        D_L: bending stiffness of that wall, N mm; a span.
        c_W: softening of a span with its energy, 1/(N mm); 0: linear; a span.
        c_K: softening of bending in a ring, mm^2; 0: linear; a ring.
        rho: share of the muscle in shear and stretch of the wall; a span.
        c_end: factor on c_W in the two spans at the clamped ends, 0: these are linear; a scalar.
        k_end: how the clamped ends hold the warping, 1/mm, in [0, inf]; a scalar.
        footprint: exponent by which a tool near a ring rests on it, 1 (a point) or more; a scalar.
        c_n: local compliance along the normal, mm/N, positive; a scalar.
        c_t: likewise along the circumference, mid-span.
        c_t_ring: that on a ring.
        extrapolated: 1 where moduli gave these stiffnesses and `Factors` were not found on such a
            tube: presses are EXTRAPOLATED; else 0.
    """

    offset: Float[Array, ""] = _field(
        "offset", "mm", "length", "from the mid-line of the wall to its outer surface",
        _fixed(0.9, 1e-3, 100.0),
    )  # fmt: skip
    EI_C: Float[Array, "..."] = _declared(VALUES["EI_C"])
    EI_M: Float[Array, "..."] = _field(
        "EI_M", "N mm^2", "bending_stiffness", "bending stiffness of the muscle behind, each ring",
        _fixed(2.0), varies_by="ring",
    )  # fmt: skip
    Et_M: Float[Array, "..."] = _field(
        "Et_M", "N/mm", "stiffness", "modulus times thickness of the muscle around the tube",
        _fixed(0.65), varies_by="ring",
    )  # fmt: skip
    bed_n: Float[Array, "..."] = _field(
        "bed_n", "N/mm^3", "cubic_stiffness",
        "bed behind the muscle, on its outer surface, along the normal",
        Fitted(0.02, 1e-8, 1e3), varies_by="ring",
    )  # fmt: skip
    bed_t: Float[Array, "..."] = _field(
        "bed_t", "N/mm^3", "cubic_stiffness",
        "bed behind the muscle, on its outer surface, along the circumference",
        Fitted(0.002, 1e-8, 1e3), varies_by="ring",
    )  # fmt: skip
    Gt_L: Float[Array, "..."] = _field(
        "Gt_L", "N/mm", "stiffness", "shear modulus times thickness of the wall between rings",
        _fixed(20.0), varies_by="span",
    )  # fmt: skip
    Et_L: Float[Array, "..."] = _field(
        "Et_L", "N/mm", "stiffness", "modulus along the tube times thickness of that wall",
        Fitted(1.2, 1e-5, 1e5), varies_by="span",
    )  # fmt: skip
    D_L: Float[Array, "..."] = _field(
        "D_L", "N mm", "moment", "bending stiffness of that wall, each length",
        Fitted(4.0, 1e-5, 1e5), varies_by="span",
    )  # fmt: skip
    c_W: Float[Array, "..."] = _field(
        "c_W", "1/N/mm", "inverse_energy", "softening of a span with its energy",
        Fitted(0.9, 1e-6, 1e4), varies_by="span",
    )  # fmt: skip
    c_K: Float[Array, "..."] = _field(
        "c_K", "mm^2", "area", "softening of bending in a ring",
        _fixed(0.0, 0.0, 1e6, scale="linear", step=10.0), default=0.0, signed=True,
        varies_by="ring",
    )  # fmt: skip
    rho: Float[Array, "..."] = _field(
        "rho", "1", "dimensionless", "share of the muscle in shear and stretch of the wall",
        _fixed(1e-3, 1e-9, 10.0), default=1e-3, varies_by="span",
    )  # fmt: skip
    c_end: Float[Array, ""] = _field(
        "c_end", "1", "dimensionless", "share of c_W that the spans at the clamped ends have",
        _fixed(0.0, 0.0, 10.0, scale="linear", step=0.5), default=1.0, signed=True,
    )  # fmt: skip
    k_end: Float[Array, ""] = _field(
        "k_end", "1/mm", "inverse_length", "how the clamped ends hold the warping",
        _fixed(0.16, 1e-6, 1e9), default=float("inf"),
    )  # fmt: skip
    footprint: Float[Array, ""] = _field(
        "footprint", "1", "dimensionless", "exponent by which a tool near a ring rests on it",
        _fixed(2.85, 1.0, 100.0), default=1.0,
    )  # fmt: skip
    c_n: Float[Array, ""] = _field(
        "c_n", "mm/N", "compliance", "local compliance along the normal",
        _fixed(3e-3, 1e-9, 1e3), default=3e-3,
    )  # fmt: skip
    c_t: Float[Array, ""] = _field(
        "c_t", "mm/N", "compliance", "local compliance along the circumference, mid-span",
        _fixed(0.1, 1e-9, 1e3), default=0.1,
    )  # fmt: skip
    c_t_ring: Float[Array, ""] = _field(
        "c_t_ring", "mm/N", "compliance", "local compliance along the circumference, on a ring",
        _fixed(0.1, 1e-9, 1e3), default=0.1,
    )  # fmt: skip
    extrapolated: Float[Array, ""] = eqx.field(
        converter=functools.partial(real, "extrapolated"), default=0.0
    )


#: Values of the sections by name, as `SectionMaterial` has them; `EI_C` is that of `Material`.
SECTION_VALUES: dict[str, Declaration] = {
    field.name: field.metadata["declaration"]
    for field in dataclasses.fields(SectionMaterial)
    if "declaration" in field.metadata
}
#: Fields that may differ from ring to ring and from span to span; the others are scalars.
EACH_RING = ("EI_C", "EI_M", "Et_M", "bed_n", "bed_t", "c_K")
EACH_SPAN = ("Gt_L", "Et_L", "D_L", "c_W", "rho")
#: Values that must be more than zero; the others must not be negative.
POSITIVE = ("EI_C", "EI_M", "Et_M", "Gt_L", "Et_L", "c_n", "c_t", "c_t_ring")
#: Values that fits keep fixed and `from_wall` takes from `Factors`.
FROM_FACTORS = ("Et_M", "Gt_L", "k_end", "footprint", "c_t", "c_t_ring")
#: Smallest values where these are not 0.
LEAST = {"footprint": 1.0}


def check_sections(geometry: Geometry, material: SectionMaterial) -> None:
    """Refuse arrays of a wrong length.

    Raises:
        ValueError: the field, its length and the expected one.
    """
    rings = geometry.rings
    for field in dataclasses.fields(material):
        name, value = f"SectionMaterial.{field.name}", getattr(material, field.name)
        if field.name in EACH_RING:
            shaped(name, value, (), (rings,), why=" (one for each ring)")
        elif field.name in EACH_SPAN:
            shaped(name, value, (), (rings + 1,), why=f" ({rings} rings make {rings + 1} spans)")
        else:
            shaped(name, value, ())


@dataclasses.dataclass(frozen=True)
class Wall:
    """Moduli and thicknesses of a tracheal wall; MPa, mm.

    A ring is a layer of cartilage on the outside of the wall, ligament below it and between rings;
    muscle closes it behind. Table 1 of the paper gives E_C, E_L, h and h_M; the others are those of
    the virtual specimen of docs/evidence/virtual_trachea.md.

    Attributes:
        E_C: cartilage.
        E_L: ligament.
        E_M: muscle.
        nu: Poisson's ratio of the wall.
        h: thickness of the wall in front.
        h_C: thickness of the cartilage, at most h.
        h_M: thickness of the muscle.
        bed_n: bed behind along the normal, N/mm^3.
        bed_t: likewise along the circumference.
    """

    E_C: float = 5.8
    E_L: float = 0.65
    E_M: float = 0.30
    nu: float = 0.45
    h: float = 2.6
    h_C: float = 1.56
    h_M: float = 2.0
    bed_n: float = 0.02
    bed_t: float = 0.002

    def __post_init__(self):
        """Refuse a wall that cannot be, or is most likely in another unit (`InputError`)."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "nu" and not (np.isfinite(value) and value > 0):
                raise InputError(f"is {value}", key=field.name, expected="more than 0", joint=" ")
        if not 0 <= self.nu < 0.5:
            raise InputError(f"is {self.nu}", key="nu", expected="in [0, 0.5)", joint=" ")
        for name in ("h", "h_M"):
            check_length(name, getattr(self, name), THICKNESSES)
        if self.h_C > self.h:
            expected = f"at most the thickness of the wall, {self.h} mm"
            raise InputError(f"is {self.h_C} mm", key="h_C", expected=expected, joint=" ")


@dataclasses.dataclass(frozen=True)
class Factors:
    """What the moduli leave open, as factors on what they give; fitted to one virtual specimen.

    Fit of 10 parameters, with `c_end = 1`, to its presses on the midline and at 30 and 90 degrees,
    D to 6 mm (errors, with `c_end = 0`: tests/sections): EI_C 23.6 N mm^2, Et_L 1.18 N/mm, D_L
    4.19 N mm, Gt_L 20.7 N/mm, Et_M 0.65 N/mm, c_W 0.915 /(N mm), k_end 0.159 /mm, footprint 2.85;
    bed as given to 10 %.

    Attributes:
        EI_C: on the composite section in plane strain.
        Et_L: on E_L h.
        D_L: on E_L h^3 / 12 / (1 - nu^2); more than 1 since stiff rings hold the wall's ends.
        Gt_L: on E_L h / 2 / (1 + nu); not physical, it stands for a wall without membrane shear.
        Et_M: on E_M h_M.
        c_W: on 1 / (E_L h R p), p the mean span: softening at a given strain, an assumption for
            other sizes than that of the specimen.
        c_end: as in `SectionMaterial`. None of the softening: a clamped section cannot flatten, and
            it is flattened sections that make the wall between them yield. Reasoned, not fitted.
        k_end: times R is this: warping held within about a diameter.
        footprint: of a punch of 3 mm radius on rings 10 mm apart.
        slide: on (2 - nu) / (8 G a), by which a disc of radius a that is stuck to a half-space of
            ligament slides (Mindlin 1949), G = E_L / 2 / (1 + nu). Less than 1, as the wall is a
            layer with stiff rings in it. Chosen at 30, 60 and 90 degrees on the specimen.
    """

    EI_C: float = 1.08
    Et_L: float = 0.70
    D_L: float = 3.5
    Gt_L: float = 35.0
    Et_M: float = 1.08
    c_W: float = 181.0
    c_end: float = 0.0
    k_end: float = 1.86
    footprint: float = 2.85
    slide: float = 0.35


#: Of the punch that pressed the virtual specimen, mm.
TOOL_RADIUS = 3.0


def from_wall(
    geometry: Geometry,
    wall: Wall = Wall(),
    factors: Factors = Factors(),  # noqa: B008 (frozen)
    tool_radius: float = TOOL_RADIUS,
    half_width: float = 0.0,
) -> SectionMaterial:
    """Stiffnesses of the sections of a tube, from moduli and thicknesses.

    EI_C is that of a ring of the composite section (width `ring_height`) and of ligament for the
    rest of its pitch, in plane strain.

    Args:
        geometry: the tube; its radius is that of the mid-line, `neutral_radius`.
        wall: moduli and thicknesses.
        factors: what they leave open.
        tool_radius: of the tool's flat end, mm, which `c_t` and `c_t_ring` follow.
        half_width: with which the tool will be pressed, mm. The edges of a punch rest on rings
            where they are, so that its `footprint` is 1.

    Returns:
        The stiffnesses; `extrapolated` where the tube is unlike the specimen (`proportions`), or
        the tool has a width: `Factors` were found with a point.

    Raises:
        SizeError: a `tool_radius` that is most likely in another unit.
    """
    check_length("tool_radius", tool_radius, TOOLS)
    pitches = ring_pitches(geometry)
    plane = 1 - wall.nu**2
    (ring, neutral), ligament = _composite(wall), wall.E_L * wall.h**3 / 12
    height = jnp.minimum(geometry.ring_height, pitches)
    EI_C = (ring * height + ligament * (pitches - height)) / plane
    R, mean_span = geometry.radius, geometry.length / (geometry.rings + 1)
    values: dict[str, Any] = {
        "offset": wall.h - neutral + 0 * R,
        "EI_C": factors.EI_C * EI_C,
        "EI_M": wall.E_M * wall.h_M**3 / 12 * pitches,
        "Et_M": factors.Et_M * wall.E_M * wall.h_M,
        "bed_n": wall.bed_n,
        "bed_t": wall.bed_t,
        "Gt_L": factors.Gt_L * wall.E_L * wall.h / 2 / (1 + wall.nu),
        "Et_L": factors.Et_L * wall.E_L * wall.h,
        "D_L": factors.D_L * ligament / plane,
        "c_W": factors.c_W / (wall.E_L * wall.h * R * mean_span),
        "c_end": factors.c_end,
        "k_end": factors.k_end / R,
        "footprint": 1.0 if half_width > 0 else factors.footprint,
    }
    slides = (2 - wall.nu) * (1 + wall.nu) / (4 * wall.E_L * tool_radius)
    values["c_t"] = values["c_t_ring"] = factors.slide * slides
    apart = _apart(geometry, wall, tool_radius)
    unlike = jnp.any(apart > float(np.log(PROPORTION_TOLERANCE))) | (half_width > 0)
    values["extrapolated"] = unlike.astype(R.dtype)
    return SectionMaterial(**values)


def _apart(geometry: Geometry, wall: Wall, tool_radius: float) -> Float[Array, "12"]:
    """How far each proportion is from the specimen's, as a logarithm."""
    given = proportions(geometry, wall, tool_radius)
    return jnp.abs(jnp.log(given / jnp.asarray(_SPECIMEN, given.dtype)))


def furthest_proportion(geometry: Geometry, wall: Wall, tool_radius: float) -> str:
    """The proportion that is least like the specimen's, in words; empty: `Factors` hold.

    Args:
        wall: moduli and thicknesses.
        tool_radius: of the tool's flat end, mm.
    """
    apart = np.asarray(_apart(geometry, wall, tool_radius))
    if not apart.max() > np.log(PROPORTION_TOLERANCE):
        return ""
    i = int(np.argmax(apart))
    given = float(proportions(geometry, wall, tool_radius)[i])
    return f"{_PROPORTIONS[i]} is {given:.3g}, there {_SPECIMEN[i]:.3g}"


#: Largest ratio of a proportion to the specimen's with which `Factors` hold
#: (docs/evidence/off_midline.md).
PROPORTION_TOLERANCE = 1.02


def proportions(geometry: Geometry, wall: Wall, tool_radius: float) -> Float[Array, "12"]:
    """Numbers without a dimension by which tubes with equal `Factors` are alike.

    Of the tube, pitch (median distance of rings) over radius, height of a ring over its pitch and
    half-angle; of the wall its thickness over the radius, those of cartilage and muscle over its
    own, moduli over the ligament's, Poisson's ratio plus 1, and the bed; the gap between rings over
    the tool's radius.

    Args:
        wall: moduli and thicknesses.
        tool_radius: of the tool's flat end, mm.
    """
    R, rings, height = geometry.radius, geometry.ring_positions, geometry.ring_height
    pitch = jnp.median(jnp.diff(rings)) if geometry.rings > 1 else geometry.length / 2
    values = [
        pitch / R, height / pitch, geometry.half_angle, wall.h / R, wall.h_C / wall.h,
        wall.h_M / wall.h, wall.E_C / wall.E_L, wall.E_M / wall.E_L, 1 + wall.nu,
        wall.bed_n * R / wall.E_M, wall.bed_t * R / wall.E_M,
        jnp.maximum(pitch - height, 0) / tool_radius,
    ]  # fmt: skip
    return jnp.stack([jnp.asarray(value, R.dtype) for value in values])


_PROPORTIONS = (
    "pitch over radius", "height of a ring over pitch", "half-angle of a ring in rad",
    "h over radius", "h_C over h", "h_M over h", "E_C over E_L", "E_M over E_L", "1 + nu",
    "bed_n R over E_M", "bed_t R over E_M", "gap between rings over the tool's radius",
)  # fmt: skip
#: `proportions` of the specimen (docs/evidence/virtual_trachea.md) with its punch of 3 mm.
_SPECIMEN = np.array([
    10 / 11.7, 0.4, 2 * np.pi / 3, 2.6 / 11.7, 0.6, 2 / 2.6, 5.8 / 0.65, 0.3 / 0.65, 1.45,
    0.02 * 11.7 / 0.3, 0.002 * 11.7 / 0.3, 2.0,
])  # fmt: skip


def neutral_radius(inner_radius: float, wall: Wall = Wall()) -> float:  # noqa: B008 (frozen)
    """Radius of the mid-line of a ring, mm: where bending of the composite section strains nothing.

    11.73 mm for the virtual specimen; the fits above take 11.7.
    """
    return inner_radius + _composite(wall)[1]


def ring_pitches(geometry: Geometry) -> Float[Array, " rings"]:
    """Length of tube that belongs to each ring, mm: half of both its spans."""
    nodes = ends_and_rings(geometry)
    return (nodes[2:] - nodes[:-2]) / 2


def ends_and_rings(geometry: Geometry) -> Float[Array, " nodes"]:
    """Positions of one end of the tube, its rings and the other end, mm; shape (rings + 2,)."""
    x = geometry.ring_positions
    return jnp.concatenate([jnp.zeros_like(x[:1]), x, geometry.length[None]])


def _composite(wall: Wall) -> tuple[float, float]:
    """Bending stiffness per width, N mm, of cartilage on ligament, and its height above inside."""
    inner = wall.h - wall.h_C
    layers = ((wall.E_L, inner, inner / 2), (wall.E_C, wall.h_C, inner + wall.h_C / 2))
    total = sum(E * t for E, t, _ in layers)
    height = sum(E * t * y for E, t, y in layers) / total
    return sum(E * t * (t * t / 12 + (y - height) ** 2) for E, t, y in layers), height
