"""Tube, material, tool and path of a scene: the sections of its TOML, validated."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, create_model, model_validator

from jaxtrachea.config import (
    Angle,
    Length,
    PositiveLength,
    Rings,
    Section,
    WallSection,
    quantity,
)
from jaxtrachea.contact.shapes import MAX_PARTS
from jaxtrachea.mechanics.sections.material import (
    LEAST,
    SECTION_VALUES,
    TOOL_RADIUS,
    SectionMaterial,
)
from jaxtrachea.relaxation import laws
from jaxtrachea.relaxation.words import Word
from jaxtrachea.trachea.material import DEEP, OF_TIME, VALUES, Declaration, meaningless

Lengths3 = Annotated[list[Length], Field(min_length=3, max_length=3)]
Sizes3 = Annotated[list[PositiveLength], Field(min_length=3, max_length=3)]
Angles3 = Annotated[list[Angle], Field(min_length=3, max_length=3)]
Duration = Annotated[float, quantity("time", positive=True)]
Direction = Annotated[list[float], Field(min_length=3, max_length=3)]


class SceneTracheaSection(Section):
    """[trachea]: made from length and rings (left out: Table 1), or read from a surface file."""

    preset: Literal["table-1"] | None = None
    """the same as leaving length and rings out"""
    length: PositiveLength | None = None
    """of the tube; together with `rings`"""
    rings: Rings | None = None
    """list of positions, or `{ count, first, last }`; with `file` a list that is taken as it is"""
    radius: PositiveLength = 11.3
    """of the ring line; with `[sections]` or `[wall]` of the wall's mid-line, and then needed"""
    half_angle: Angle | None = None
    """half opening of the rings; none: 120 deg, or as found in the file"""
    ring_height: PositiveLength = 4.0
    """extent of a ring along the tube"""
    around: int = Field(35, ge=3, le=2000)
    """vertices round the generated tube"""
    along: int = Field(97, ge=1, le=5000)
    """vertices along it"""
    wall: PositiveLength = 2.6
    """thickness of the wall"""
    relief: Annotated[Length, Field(ge=0)] | None = None
    """how far rings stand out; none: 0.23 of the wall"""
    file: str | None = None
    """surface file (STL, OBJ, PLY, GLB), in place of a generated tube"""
    unit: str | None = None
    """of the file's lengths"""
    part: str | None = None
    """object of the file that is the wall"""
    cartilage: str | None = None
    """object, or file, that holds the rings"""
    larynx: Direction | None = None
    """direction towards the larynx, in the file's axes"""
    anterior: Direction | None = None
    """direction to the front, in the file's axes"""
    centreline: Annotated[list[Direction], Field(min_length=2)] | None = None
    """points along the tube, in the file's unit and axes"""

    @model_validator(mode="after")
    def _complete(self) -> "SceneTracheaSection":
        given = self.model_fields_set
        made = {"preset", "length", "radius", "ring_height", "around", "along", "wall", "relief"}
        made &= given
        read = {"unit", "part", "cartilage", "larynx", "anterior", "centreline"} & given
        if self.file is not None and made:
            raise ValueError(f"file excludes {', '.join(sorted(made))}; remove one side")
        if self.file is None and read:
            raise ValueError(f"{', '.join(sorted(read))}: only with file; name the file")
        if self.file is not None and isinstance(self.rings, Section):
            raise ValueError("with file, rings must be a list of positions")
        if self.file is None and (self.length is None) != (self.rings is None):
            raise ValueError("give both length and rings, or neither (preset 'table-1')")
        if self.preset is not None and self.length is not None:
            raise ValueError("preset and length exclude each other; remove one")
        return self


def _keys(declared: Mapping[str, Declaration], needed: Collection[str] = ()) -> type[Section]:
    """A key for each value that is declared; all but those `needed` may be left out."""
    keys: dict[str, Any] = {}
    for name, p in declared.items():
        number: Any = Annotated[float, quantity(p.dimension, positive=not p.signed)]
        keys[name] = (number, ...) if name in needed else (number | None, None)
    return create_model("Keys", __base__=Section, **keys)


class MaterialSection(_keys(VALUES, [name for name, p in VALUES.items() if not p.absent])):
    """[material]: see `jaxtrachea.trachea.material`; one value for all rings and spans."""

    @model_validator(mode="after")
    def _meaningful(self) -> "MaterialSection":
        given = (name for name in VALUES if getattr(self, name) is not None)
        for name, other in meaningless(given).items():
            raise ValueError(f"{name} needs {other}; give {other} too, or remove {name}")
        deep = [name for name in DEEP if getattr(self, name) is not None]
        for other in (name for name in DEEP if deep and name not in deep):
            raise ValueError(f"{deep[0]} needs {other}; give {other} too, or remove {deep[0]}")
        return self


class SectionsSection(_keys(SECTION_VALUES)):
    """[sections]: see `SectionMaterial`; one value for all rings and spans."""

    @model_validator(mode="after")
    def _large_enough(self) -> "SectionsSection":
        for name, p in SECTION_VALUES.items():
            value, least = getattr(self, name), LEAST.get(name, 0.0)
            if value is not None and value < least:
                found = f"{value:g} {p.unit}".removesuffix(" 1")
                raise ValueError(f"{name} is {found}; expected {least:g} or more")
        return self


class SceneWallSection(WallSection):
    """[wall] of a scene, with the radius of the tool's flat end: the local contact follows it."""

    tool_radius: PositiveLength = TOOL_RADIUS
    """of the tool's flat end; the local contact follows it"""


class RelaxationSection(_keys(OF_TIME)):
    """[relaxation]: how the force relaxes; see `jaxtrachea.relaxation.laws`."""

    branches: Word = "prony-2"
    """law of the relaxation, as in a fit"""

    @model_validator(mode="after")
    def _complete(self) -> "RelaxationSection":
        given = self.numbers
        needed = laws.names(self.branches, parts=self.apart)
        if wanting := [name for name in needed if name not in given]:
            raise ValueError(f"branches {self.branches!r} need {', '.join(wanting)}; give them")
        if more := sorted(given.keys() - set(needed)):
            raise ValueError(f"{', '.join(more)}: not for branches {self.branches!r}; remove it")
        for name, value in given.items():
            p, fit = OF_TIME[name], OF_TIME[name].fit
            if fit is not None and not fit.lower <= value <= fit.upper:
                unit = "" if p.unit == "1" else f" {p.unit}"
                raise ValueError(
                    f"{name} is {value:g}{unit}; expected {fit.lower:g} to {fit.upper:g}{unit}"
                )
        return self

    @property
    def numbers(self) -> dict[str, float]:
        """Those that are given, by name."""
        return {name: v for name in OF_TIME if (v := getattr(self, name)) is not None}

    @property
    def apart(self) -> bool:
        """Whether the skeleton has branches of its own."""
        return any(name.endswith(laws.OF_SKELETON) for name in self.numbers)


#: Values of [sections] that have no default of their own.
NEEDED = tuple(
    f.name for f in dataclasses.fields(SectionMaterial) if f.default is dataclasses.MISSING
)

#: Keys that each shape of tool needs, and those it may have.
TOOLS = {
    "sphere": ({"radius"}, set()),
    "capsule": ({"radius", "length"}, set()),
    "box": ({"size"}, {"rounding"}),
    "cylinder": ({"radius", "length"}, {"rounding"}),
    "cloud": ({"file"}, {"rounding"}),
    "mesh": ({"file"}, {"unit", "rounding"}),
}


class ShapeSection(Section):
    """A convex shape about its own origin; capsule and cylinder along z."""

    shape: Literal["sphere", "capsule", "box", "cylinder", "cloud", "mesh"] | None = None
    """which convex shape; needed, but beside `parts`"""
    radius: PositiveLength | None = None
    """of sphere, capsule, cylinder"""
    length: PositiveLength | None = None
    """of the straight part of capsule or cylinder"""
    size: Sizes3 | None = None
    """edges of a box"""
    rounding: PositiveLength | None = None
    """of box, cylinder, cloud and mesh; it comes on top of the size, on every side"""
    file: str | None = None
    """of a cloud: CSV of x, y, z in mm; of a mesh: a surface, as STL, OBJ, PLY or GLB, each of
    whose bodies is convex
    """
    unit: str | None = None
    """of the file of a mesh: `mm` unless said"""

    @model_validator(mode="after")
    def _fitting(self):
        given = {name for name in ShapeSection.model_fields if name in self.model_fields_set}
        given -= {"shape"}
        if self.shape is None:
            return self._without_shape(given)
        needed, allowed = TOOLS[self.shape]
        if needed - given:
            raise ValueError(f"shape {self.shape!r} needs {', '.join(sorted(needed - given))}")
        if given - needed - allowed:
            more = ", ".join(sorted(given - needed - allowed))
            raise ValueError(f"{more}: not for shape {self.shape!r}; remove it")
        return self

    def _without_shape(self, given: set[str]):
        raise ValueError(f"shape: missing; expected one of {', '.join(TOOLS)}")


class PartSection(ShapeSection):
    """[[tool.parts]]: a convex part, placed in the frame of the tool."""

    position: Lengths3 | None = None
    """of its origin in the frame of the tool; none: there"""
    rotation: Angles3 | None = None
    """there, a rotation vector"""


class ToolSection(ShapeSection):
    """[tool], or one of [[tool]]: a convex shape, or parts that move together (forceps, a hook)."""

    name: str | None = Field(None, min_length=1, max_length=40)
    """of each of several tools, `[[tool]]`"""
    parts: list[PartSection] | None = Field(None, min_length=1, max_length=MAX_PARTS)
    """convex parts that move together, in the place of a shape: the deepest touches"""
    friction: float | None = Field(None, ge=0, le=10)
    """coefficient of Coulomb friction"""
    contact: Literal["unilateral", "bonded"] | None = None
    """of this tool: `bonded`: glued (forceps, a suture); none: that of [model]"""

    def _without_shape(self, given: set[str]):
        if self.parts is None:
            raise ValueError(f"shape: missing; expected one of {', '.join(TOOLS)}, or parts")
        if given:
            raise ValueError(f"{', '.join(sorted(given))}: of a shape, and parts have their own")
        return self

    @model_validator(mode="after")
    def _one_kind(self) -> "ToolSection":
        if self.shape is not None and self.parts is not None:
            raise ValueError("parts: not together with shape; remove one")
        if self.friction is not None and self.contact == "bonded":
            raise ValueError(
                "friction: not together with contact = 'bonded', as what is glued does not slide; "
                "remove one"
            )
        return self


#: Ways to write a path: the keys that tell it, and all it may have.
PATHS = {
    "press": ({"s", "displacement"}, {"phi", "steps", "duration"}),
    "line": ({"start", "end"}, {"steps", "rotation", "duration"}),
    "poses": ({"positions"}, {"rotation", "duration"}),
    "file": ({"file"}, {"duration"}),
}


class PathSection(Section):
    """[[path]]: a press at (s, phi) by a vector, a line of the tool, a list, or a CSV file."""

    tool: str | None = None
    """name of the one of several tools that it moves; all move side by side"""
    s: Length | None = None
    """press: contact position"""
    phi: Angle | None = None
    """press: contact angle"""
    displacement: Lengths3 | None = None
    """press: `[axial, anterior, lateral]`, the last row of the press"""
    start: Lengths3 | None = None
    """line: first position of the tool"""
    end: Lengths3 | None = None
    """line: last position of the tool"""
    positions: list[Lengths3] | None = Field(None, min_length=1)
    """poses: a list of positions"""
    rotation: Angles3 | None = None
    """of the tool, a rotation vector"""
    file: str | None = None
    """CSV of x, y, z, rx, ry, rz (mm, rad), and t (s)"""
    steps: int | None = Field(None, ge=1, le=100_000)
    """rows of a press or a line"""
    duration: Duration | None = None
    """from its first row to its last, for a force that relaxes; a press then goes on from the
    displacement of the one before, and its first row is that
    """

    @property
    def kind(self) -> str:
        """One of `PATHS`."""
        given = self.model_fields_set - {"tool"}
        return next(kind for kind, (needed, _) in PATHS.items() if needed <= given)

    @model_validator(mode="after")
    def _one_kind(self) -> "PathSection":
        given = self.model_fields_set - {"tool"}
        for needed, allowed in PATHS.values():
            if needed <= given:
                if given - needed - allowed:
                    more = ", ".join(sorted(given - needed - allowed))
                    raise ValueError(f"{more}: not together with {', '.join(sorted(needed))}")
                return self
        ways = "; ".join(" and ".join(sorted(needed)) for needed, _ in PATHS.values())
        raise ValueError(f"incomplete; give one of: {ways}")
