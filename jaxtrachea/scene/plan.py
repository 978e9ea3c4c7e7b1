"""The static `Plan` of a scene: the program that is compiled (`simulate`).

An effect that is off adds no operation to it. `rules` makes it of the facts and of the options.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args

from jaxtrachea._arguments import check_record
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.level import Level
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.skeleton import Rings
from jaxtrachea.scene.effects import EFFECTS
from jaxtrachea.surface.regions import Method

#: What a simulation can leave out of its result.
OUTPUTS = ("joints", "ring_ends")
#: Effects of a line of joints, and what no other skeleton has.
OF_JOINTS = ("friction", "rings", "axial", "end_motion", "shear", "two_material")


@dataclasses.dataclass(frozen=True)
class Decision:
    """One decision: its level (`on`, `off` or a word), the reason, and whether it was forced.

    `caveat`: what makes numbers at that level doubtful, and the cure; empty: nothing does.
    """

    name: str
    level: str
    reason: str
    forced: bool = False
    caveat: str = ""


@dataclasses.dataclass(frozen=True)
class ValidRange:
    """Presses that a plan within a tolerance was measured for; rows beyond are off the plan.

    Attributes:
        s: lowest and highest contact position, mm.
        angle: largest |phi|, rad.
        along: largest axial motion, mm.
        across: largest motion round the tube, mm.
        inward: largest motion inwards, mm.
    """

    s: tuple[float, float]
    angle: float
    along: float
    across: float
    inward: float


@dataclasses.dataclass(frozen=True)
class Plan:
    """The program of a scene; hashable, equal where the programs are. Effects as in `EFFECTS`.

    Attributes:
        contact: the path moves a tool.
        curved: motions of the tool are turned into the frame of the centreline at the contact.
        contact_point: see `EffectOptions`, like all down to `dent`.
        friction: -
        second_plane: -
        rings: -
        axial: -
        end_motion: -
        surface: method of interpolation, or the wall of deforming cross-sections; None: off.
        dent: number of centres, 0: off.
        joints: they are in the result.
        ring_ends: they are in the result.
        options: of the model.
        tools: see `EffectOptions`.
        ignored: effects that stay off (the contact point: that stays) whatever a path needs,
            because the user wished it or a tolerance allows it. A row that needs any other effect
            that is off is refused by status (`ranges.outside_plan`).
        valid_range: presses that a tolerance was measured for; None: no tolerance.
        effects: all decisions in words; they do not count in comparisons.
    """

    contact: bool
    curved: bool
    contact_point: Literal["fixed", "per_step"]
    friction: bool
    second_plane: bool
    rings: Rings
    axial: bool
    end_motion: bool
    surface: Method | Literal["sections"] | None
    dent: int
    joints: bool
    ring_ends: bool
    options: Options
    tools: Literal["one", "apart", "coupled"] = "one"
    ignored: frozenset[str] = frozenset()
    valid_range: ValidRange | None = None
    effects: tuple[Decision, ...] = dataclasses.field(default=(), compare=False, repr=False)

    def __post_init__(self):
        """Refuse words and numbers that mean nothing, and options that no scene has.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self, dent=0.0)
        self._check_options()

    def _check_options(self) -> None:
        """Refuse options of `press` that a scene would ignore or get wrong.

        Raises:
            InputError: naming the option.
        """
        if self.has("width") and self.second_plane and not self.mechanics.off_midline:
            raise InputError(
                f"is {self.options.half_width:g}, with second_plane 'on'", joint=" ",
                key="options.half_width", expected="0.0, or second_plane 'off'",
                cure="a width is for presses straight in on the midline",
            )  # fmt: skip
        self._check_skeleton()
        self._check_relaxation()
        wanders = self.contact and self.contact_point == "per_step"
        if wanders and self.options.split == "independent":
            raise InputError(
                "is 'independent', with which the stored energy jumps where a contact_point "
                "'per_step' passes a ring, so that no force is its derivative",
                key="options.split", joint=" ", expected="'continuous'",
                cure="or keep the contact_point 'fixed'",
            )  # fmt: skip

    def _check_skeleton(self) -> None:
        """Refuse effects that a skeleton has not.

        Raises:
            InputError: naming the effect.
        """
        level = self.options.skeleton
        without = {"softening": ("second_plane",), "sections": OF_JOINTS}.get(level, ())
        for name in without:
            if self.has(name):
                raise InputError(
                    f"is {level!r}, with {name} {self.level(name)!r}", key="options.skeleton",
                    joint=" ", expected=f"'linear', or {name} {EFFECTS[name].least!r}",
                    cure="press by `press` or `press_sections` with it",
                )  # fmt: skip
        sections = level == "sections"
        if self.surface is not None and sections != (self.surface == "sections"):
            kinds = ("sections",) if sections else get_args(Method)
            raise InputError(
                f"is {self.surface!r}, with a skeleton {level!r}", key="surface", joint=" ",
                expected=f"{', '.join(map(repr, kinds))} or None",
            )  # fmt: skip
        if sections and self.contact and self.contact_point == "per_step":
            raise InputError(
                "is 'sections', with contact_point 'per_step' of a tool", key="options.skeleton",
                joint=" ", expected="contact_point 'fixed', or presses at given points",
            )  # fmt: skip

    def _check_relaxation(self) -> None:
        """Refuse a force that relaxes where it has no history.

        Raises:
            InputError: naming the effect.
        """
        if not self.has("relaxation"):
            return
        level, found = self.options.relaxation, ""
        if self.contact_point != "fixed":
            found, cure = "contact_point 'per_step'", "each place has a history of its own"
        elif self.friction:
            found, cure = "friction 'on'", "slip depends on the relaxed force"
        elif level == "parts" and self.second_plane:
            found, cure = "second_plane 'on'", "choose 'uniform'"
        if found:
            raise InputError(
                f"is {level!r}, with {found}", key="options.relaxation", joint=" ",
                expected="'off'", cure=cure,
            )  # fmt: skip

    @property
    def mechanics(self) -> Level:
        """The level of the mechanics that the options ask for."""
        return level_of(self.options)

    @property
    def oblique(self) -> ObliqueOptions:
        """What presses as vectors include."""
        elastic = dataclasses.replace(self.options, relaxation="off")
        return ObliqueOptions(elastic, rings=self.rings, axial=self.axial)

    def level(self, name: str) -> str:
        """The level of an effect."""
        value = self
        for part in EFFECTS[name].field.split("."):
            value = getattr(value, part)
        return EFFECTS[name].level(value)

    def has(self, name: str) -> bool:
        """Whether an effect is in the program."""
        return self.level(name) != EFFECTS[name].least

    def at(self, **levels: str) -> "Plan":
        """The plan with these levels of effects; what cannot be without an effect goes with it.

        Raises:
            ValueError: a level with a number that the plan does not know.
        """
        for name, level in levels.items():
            if level == EFFECTS[name].measured and not self.has(name):
                raise ValueError(f"{name} {level!r} needs a number that this plan has not")
        own, model = stored(levels)
        made = dataclasses.replace(self, options=dataclasses.replace(self.options, **model), **own)
        lost = {
            e.name: e.least for e in EFFECTS.values()
            if made.has(e.name) and not all(map(made.has, (*e.requires, *e.implies)))
        }  # fmt: skip
        return made.at(**lost) if lost else made

    def without(self, name: str) -> "Plan | None":
        """The plan with one effect less on every path, or None where none goes alone."""
        if name in OUTPUTS:
            less = dataclasses.replace(self, **{name: False})
            return None if less == self else less
        if name not in EFFECTS or not EFFECTS[name].least:
            return None
        if name == "skeleton" and self.level(name) == "sections":  # another material
            return None
        if any(name in e.blocks_removal and self.has(e.name) for e in EFFECTS.values()):
            return None
        less = self.at(**{name: EFFECTS[name].least})
        if less == self:
            return None
        gone = {e for e in EFFECTS if self.level(e) != less.level(e)}
        return dataclasses.replace(less, ignored=self.ignored | gone)


def stored(levels: Mapping[str, str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fields of a `Plan`, and of its options, that hold these levels of effects.

    Not of those that keep a number (`Effect.measured`).
    """
    own, model = {}, {}
    for name, level in levels.items():
        if level == EFFECTS[name].measured:
            continue
        field = EFFECTS[name].field.split(".")
        (own if len(field) == 1 else model)[field[-1]] = EFFECTS[name].value(level)
    return own, model
