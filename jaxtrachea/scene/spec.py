"""TOML scenes: trachea, material, tool and path, validated, in internal units (docs/simulate.md).

As in `config`: every problem with its dotted key, what was found and what is expected. No file but
the specification is opened here.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, create_model, model_validator

from jaxtrachea.config import (
    EVEN,
    LISTED,
    Angle,
    Length,
    PositiveLength,
    Section,
    load_spec,
    quantity,
)
from jaxtrachea.mechanics.press_contacts import MOST_CONTACTS
from jaxtrachea.scene.declare import Effect
from jaxtrachea.scene.effects import EFFECTS
from jaxtrachea.scene.spec_parts import (
    NEEDED,
    MaterialSection,
    PathSection,
    RelaxationSection,
    SceneTracheaSection,
    SceneWallSection,
    SectionsSection,
    ToolSection,
)


class LawSection(Section):
    """[model]: the contact law; see `jaxtrachea.mechanics.press.Options`."""

    coupling: Literal["series", "total"] = "series"
    """as in a fit"""
    contact: Literal["unilateral", "bonded"] = "unilateral"
    """as in a fit"""
    onset_width: PositiveLength = 1e-3
    """as in a fit"""
    transition: PositiveLength | None = None
    """as in a fit"""
    half_width: Annotated[Length, Field(ge=0)] = 0.0
    """as in a fit: copy it from the fit that gave the stiffnesses"""


def _one_or_auto(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _levels(effect: Effect) -> Any:
    words = Literal[("auto", *effect.levels)]  # pyright: ignore
    return Annotated[words, BeforeValidator(_one_or_auto)], "auto"


_Effects: Any = create_model(
    "_Effects", __base__=Section, **{e.name: _levels(e) for e in EFFECTS.values()}
)


class EffectsSection(_Effects):
    """[effects], as `scene.effects` declares them; what is "auto" follows docs/simulate.md."""


class OutputSection(Section):
    """[output]: what is wanted."""

    surface: bool = True
    """the deformed mesh"""
    joints: bool = True
    """motion of every ring"""
    ring_ends: bool = True
    """motion of the ends of the rings"""
    pictures: bool = True
    """series.png, surface.png"""
    play: bool = False
    """play.html: the simulation as a page that plays in any browser (extra `viewer`)"""
    vtk: bool = False
    """simulation.pvd: wall, tool and contact force in every row; sweep.vtp: the maps of a sweep on
    the wall; for ParaView"""
    animation: bool = False
    """simulation.glb: the simulation as an animation for slides and 3-D viewers"""

    @model_validator(mode="after")
    def _surface_to_show(self) -> "OutputSection":
        for name in ("play", "vtk", "animation"):
            if getattr(self, name) and not self.surface:
                raise ValueError(f"{name} needs surface = true; remove one")
        return self


class PlanSection(Section):
    """[plan]: choose the cheapest program within a tolerance, for this path."""

    tolerance: Annotated[float, quantity("dimensionless", positive=True), Field(lt=1)]
    """share of error allowed, `"1 %"`: the cheapest program within it"""
    precision: Literal["auto", "float64"] = "auto"
    """`float64` also where float32 is within the tolerance"""
    cost: Literal["path", "step", "operations"] = "path"
    """what is made least: measured time of the whole path, of a step (`Session`), or `operations`
    (the same plan on every machine)
    """


class SweepSection(Section):
    """[sweep]: normal presses on a grid of contact points."""

    depth: PositiveLength
    """of each press"""
    s_count: int = Field(60, ge=1, le=10_000)
    """positions"""
    phi_count: int = Field(25, ge=1, le=10_000)
    """angles"""
    phi_max: Angle | None = None
    """largest angle; none: as far as the rings go"""
    chunk: int = Field(256, ge=1, le=1_000_000)
    """presses computed together"""


#: `[tool]`, or several as `[[tool]]`.
Tools = Annotated[
    Annotated[ToolSection, Tag(EVEN)] | Annotated[list[ToolSection], Tag(LISTED)],
    Discriminator(lambda value: LISTED if isinstance(value, list) else EVEN),
]


class SceneSpec(Section):
    """A whole scene."""

    title: str = ""
    """of the output"""
    trachea: SceneTracheaSection = Field(
        default_factory=lambda: SceneTracheaSection.model_validate({})
    )
    """the tube"""
    material: MaterialSection | None = None
    """stiffnesses of a line of joints; or `sections`, `wall`"""
    sections: SectionsSection | None = None
    """stiffnesses of deforming cross-sections"""
    wall: SceneWallSection | None = None
    """moduli that those follow from"""
    relaxation: RelaxationSection | None = None
    """how the force relaxes in time; the path needs times"""
    tool: Tools | None = None
    """the tool; presses need none. Several: `[[tool]]`, each with a `name`"""
    path: list[PathSection] = Field(min_length=1)
    """what happens, in order"""
    model: LawSection = LawSection()
    """the contact law"""
    effects: EffectsSection = EffectsSection()
    """which effects are on"""
    output: OutputSection = OutputSection()
    """what is wanted"""
    plan: PlanSection | None = None
    """a choice within a tolerance"""
    sweep: SweepSection | None = None
    """for `jaxtrachea sweep`"""

    @model_validator(mode="before")
    @classmethod
    def _one_path(cls, data: Any) -> Any:
        if isinstance(data, dict) and isinstance(data.get("path"), dict):
            return {**data, "path": [data["path"]]}
        return data

    @model_validator(mode="after")
    def _one_material(self) -> "SceneSpec":
        sections = self.sections is not None or self.wall is not None
        if self.material is None and not sections:
            raise ValueError("material: missing; give [material], or [sections] or [wall]")
        if self.material is not None and sections:
            given = "sections" if self.sections is not None else "wall"
            raise ValueError(
                f"{given}: not together with [material], which is of a line of joints; remove one"
            )
        if sections and self.trachea.file is not None:
            raise ValueError(
                "trachea.file: it tells the radius of the outer wall, and deforming cross-sections "
                "need that of the wall's mid-line; give length, rings and radius of a tube"
            )
        if sections and "radius" not in self.trachea.model_fields_set:
            raise ValueError(
                "trachea.radius: missing; deforming cross-sections need that of the wall's "
                "mid-line (11.7 mm of an inner radius of 10 mm and the wall of Table 1)"
            )
        if sections and "wall" in self.trachea.model_fields_set:
            raise ValueError(
                "trachea.wall: the outside of deforming cross-sections lies `offset` outside of "
                "their mid-line; remove it, and give [wall] h or [sections] offset"
            )
        if sections and "relief" in self.trachea.model_fields_set:
            raise ValueError(
                "trachea.relief: the outside of deforming cross-sections is round; remove it"
            )
        if self.wall is None and self.sections is not None:
            lacking = [name for name in NEEDED if getattr(self.sections, name) is None]
            if lacking:
                raise ValueError(
                    f"sections.{lacking[0]}: missing; give it, or [wall] to derive it from"
                )
        return self

    @model_validator(mode="after")
    def _agree(self) -> "SceneSpec":
        presses = [leg.kind == "press" for leg in self.path]
        if any(presses) and not all(presses):
            raise ValueError("path: presses (s, displacement) and motions of the tool do not mix")
        if not any(presses) and self.tool is None:
            raise ValueError("path: a motion of the tool needs [tool]; or give s and displacement")
        self._check_names()
        if self.names and self.plan is not None:
            raise ValueError("plan: a tolerance is for one tool; leave [plan] out")
        return self

    @property
    def names(self) -> list[str]:
        """Names of the tools that have a path each; empty: one tool, or presses, without a name."""
        if isinstance(self.tool, list):
            return [tool.name or "" for tool in self.tool]
        return list(dict.fromkeys(leg.tool for leg in self.path if leg.tool is not None))

    def _check_names(self) -> None:
        """Refuse tools and paths that do not belong to one another."""
        many = self.tool if isinstance(self.tool, list) else []
        if not isinstance(self.tool, list | None) and self.tool.name is not None:
            raise ValueError("tool.name: of several tools alone; write [[tool]], or remove it")
        names, seen = self.names, {}
        if len(names) > MOST_CONTACTS:
            raise ValueError(f"tool: {len(names)} tools; expected at most {MOST_CONTACTS}")
        for i, tool in enumerate(many):
            if tool.name is None:
                raise ValueError(f"tool.{i}.name: missing; several tools have a name each")
            if tool.name in seen:
                raise ValueError(
                    f"tool.{i}.name: {tool.name!r} is the name of tool.{seen[tool.name]}, too; "
                    "give each its own"
                )
            seen[tool.name] = i
        of_one = self.tool is not None and not many
        for i, leg in enumerate(self.path):
            if leg.tool is not None and of_one:
                raise ValueError(f"path.{i}.tool: there is one [tool]; remove it, or use [[tool]]")
            if leg.tool is None and names:
                raise ValueError(
                    f"path.{i}.tool: missing; name the tool that it moves: {_words(names)}"
                )
            if leg.tool is not None and leg.tool not in names:
                raise ValueError(
                    f"path.{i}.tool: there is no tool {leg.tool!r}; expected {_words(names)}"
                )
        moved = {leg.tool for leg in self.path}
        for i, tool in enumerate(many):
            if tool.name not in moved:
                raise ValueError(
                    f"tool.{i}: no path moves {tool.name!r}; give a [[path]] with "
                    f"tool = {tool.name!r}, or remove the tool"
                )


def _words(names: list[str]) -> str:
    return ", ".join(map(repr, names))


def load_scene_spec(path: Path) -> SceneSpec:
    """Read and validate a scene.

    Raises:
        SpecError: as `jaxtrachea.config.load_fit_spec`.
    """
    others = {"data": "a fit specification (commands check, fit, design, compare)"}
    return load_spec(path, SceneSpec, "scene", others)
