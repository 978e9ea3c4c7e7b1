"""What an effect of a scene is: its declaration, the facts that its rule reads, and its verdict."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

from jaxtrachea._arguments import check_record
from jaxtrachea._errors import InputError

#: What stands for deforming cross-sections among the values that a material gives.
SECTIONS = "sections"
#: The same for branches of its force, and for those of the skeleton alone.
RELAXES, RELAXES_APART = "relaxation", "relaxation.skeleton"


class PlanError(InputError):
    """A wish that this scene cannot meet: the effect, what was found, why not, the cure.

    Attributes:
        why: it cannot be met.
    """

    def __init__(self, key: str, found: str, why: str = "", cure: str = "") -> None:
        """Say which effect, what was asked for, why that cannot be, and the cure."""
        super().__init__(f"{found}, but {why}" if why else found, key=key, cure=cure)
        self.why = why


@dataclasses.dataclass(frozen=True)
class SceneFacts:
    """What the rules read of a scene; numbers in mm and rad.

    Attributes:
        poses: the path is given as motions of the tool, not as presses at contact points.
        angle: largest |phi| of a contact; this and the next four are those of rows that need more
            for it (`needs`), 0 where none does.
        several_points: the contacts of the path lie in more than one place.
        along: largest axial motion of the tool while it presses, against its whole motion.
        across: the same round the tube.
        slip: largest motion of the tool along the surface while it presses, mm.
        drags: whether more than a twentieth of its way is along the surface (of a row of several
            tools, see `needs.drags`).
        spacing: smallest distance of two rings, mm.
        friction: whether the tool has a coefficient of friction.
        known: optional values of the material that are there; `SECTIONS` alone: of a
            `SectionMaterial`.
        mesh: whether there is a surface.
        curved: whether its centreline is.
        near: whether the contact comes near a vertex of it.
        way_fixed: least and largest inward motion of the tool since first touch (of presses: of
            each), over the radius, where its contact point is fixed.
        way_per_step: the same of a tool whose rows are presses of their own.
        softness: e_1 R and e_2 R^2 of the material, R the radius; 0 where they are not known.
        timed: whether the path has times.
        duration: from its first time to its last, s.
        tools: number of tools with a path.
        glued: whether some of them are glued, and others not.
    """

    poses: bool = False
    angle: float = 0.0
    several_points: bool = False
    along: float = 0.0
    across: float = 0.0
    slip: float = 0.0
    drags: bool = False
    spacing: float = math.inf
    friction: bool = False
    known: frozenset[str] = frozenset()
    mesh: bool = True
    curved: bool = False
    near: bool = True
    way_fixed: tuple[float, float] = (0.0, 0.0)
    way_per_step: tuple[float, float] = (0.0, 0.0)
    softness: tuple[float, float] = (0.0, 0.0)
    timed: bool = False
    duration: float = 0.0
    tools: int = 1
    glued: bool = False


class Case(NamedTuple):
    """What a rule reads.

    Attributes:
        facts: of the scene.
        options: of the user (`effects.EffectOptions`).
        levels: of the effects above.
        finest: effects whose level in `options` is the finest, and not the user's wish.
    """

    facts: SceneFacts
    options: Any
    levels: dict[str, str]
    finest: frozenset[str] = frozenset()

    @property
    def prescribed(self) -> bool:
        """Whether displacements count as they are: a press of its own is along the normal."""
        return self.levels["contact_point"] == "fixed" or not self.facts.poses


class Verdict(NamedTuple):
    """What a rule says.

    Attributes:
        level: where the user left it to the rule.
        reason: for that.
        refused: levels that this scene cannot have: why, and the cure.
        free: the user's word counts; else the level is as it is.
        caveat: what makes numbers at that level doubtful, and the cure; a note of the scene.
    """

    level: str
    reason: str
    refused: Mapping[str, tuple[str, str]] = {}
    free: bool = True
    caveat: str = ""


@dataclasses.dataclass(frozen=True)
class Effect:
    """The declaration of an effect.

    Attributes:
        rule: chooses its level.
        least: level of a program without it; empty: none is without.
        field: where a `Plan` keeps it, empty: under its name. `options.` leads to those.
        values: what a plan keeps for a level; other levels are kept as they are.
        measured: level of which a plan keeps a number, an option of the user; empty: none is.
        material: optional values of the material that it reads.
        either: one of those is enough.
        requires: effects without which it cannot be.
        implies: effects that have to be on with it, and so are.
        blocks_removal: effects that do not go alone while it is on.
        rungs: levels of its ladder from coarse to fine; empty: it is not traded.
        ladder_kind: whether a truncation is climbed, or a model.
        ladder: its name, empty: that of the effect.
        words: what its ladder calls levels that have another name there.
        name: of the effect; that of its field in `EffectOptions`.
        levels: those that a user can choose.
    """

    rule: Callable[[Case], Verdict]
    least: str = "off"
    field: str = ""
    values: Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {"on": True, "off": False}
    )
    measured: str = ""
    material: tuple[str, ...] = ()
    either: bool = False
    requires: tuple[str, ...] = ()
    implies: tuple[str, ...] = ()
    blocks_removal: tuple[str, ...] = ()
    rungs: tuple[str, ...] = ()
    ladder_kind: Literal["truncation", "model"] = "model"
    ladder: str = ""
    words: Mapping[str, str] = dataclasses.field(default_factory=dict)
    name: str = ""
    levels: tuple[str, ...] = ()

    def __post_init__(self):
        """Refuse a kind that is none (`ValueError`)."""
        check_record(self)

    def value(self, level: str) -> Any:
        """What a plan keeps for this level."""
        return self.values.get(level, level)

    def level(self, value: Any) -> str:
        """The level of what a plan keeps."""
        other = self.measured or value
        return next((word for word, kept in self.values.items() if kept == value), other)

    def given(self, known: frozenset[str]) -> bool:
        """Whether the material gives what it reads; no effect is given by nothing."""
        there = [name in known for name in self.material]
        return any(there) if self.either else bool(there) and all(there)
