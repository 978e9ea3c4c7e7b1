"""What a scene calls for: its facts, the wishes of the user, and the static `Plan` made of both.

The plan selects the program that is compiled (`simulate`); an effect that is off adds no operation
to it. `rules` makes it.
"""

import dataclasses
import math
from typing import Literal

from jaxtrachea._arguments import check_record
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.skeleton import Rings
from jaxtrachea.surface.regions import Method

Switch = Literal["auto", "on", "off"]


class PlanError(ValueError):
    """A wish that this scene cannot meet: the effect, what was found, the cure."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What the rules read of a scene; numbers in mm and rad.

    Attributes:
        poses: the path is given as motions of the tool, not as presses at contact points.
        angle: largest |phi| of a contact.
        seats: whether the contacts of the path lie in more than one place.
        along: largest axial motion of the tool while it touches, against its whole motion.
        across: the same round the tube.
        slip: largest motion of the tool along the surface while it touches, mm.
        spacing: smallest distance of two rings, mm.
        friction: whether the tool has a coefficient of friction.
        known: optional values of the material that are there.
        mesh: whether there is a surface.
        curved: whether its centreline is.
        near: whether the contact comes near a vertex of it.
    """

    poses: bool = False
    angle: float = 0.0
    seats: bool = False
    along: float = 0.0
    across: float = 0.0
    slip: float = 0.0
    spacing: float = math.inf
    friction: bool = False
    known: frozenset[str] = frozenset()
    mesh: bool = True
    curved: bool = False
    near: bool = True


@dataclasses.dataclass(frozen=True)
class Wishes:
    """What the user asks for; `auto` leaves it to the rules.

    Attributes:
        seat: `first`: the tool stays on the place it touched first; `each`: every row is a press of
            its own, frictionless along the surface.
        friction: Coulomb friction along the path.
        second_plane: bending along the circumference, vectors; off: a normal press on the midline.
        rings: see `skeleton_response`.
        axial: the ligament stretches.
        shear: it shears.
        two_material: the rings have a local law of their own.
        end_motion: the clamps move on axial springs, and the surface with them.
        surface: method of interpolation, or off.
        dent: centres of the local correction, or off.
        want_surface: deformed vertices are asked for.
        want_joints: joints and their loads are asked for.
        want_ring_ends: ends of the rings are asked for.
        coupling: see `Options`; with `contact`, `onset_width` and `transition`.
        contact: -
        onset_width: -
        transition: -
    """

    seat: Literal["auto", "first", "each"] = "auto"
    friction: Switch = "auto"
    second_plane: Switch = "auto"
    rings: Literal["auto", "mat", "arch", "arch2"] = "auto"
    axial: Switch = "auto"
    shear: Switch = "auto"
    two_material: Switch = "auto"
    end_motion: Switch = "auto"
    surface: Literal["auto", "off", "linear", "hermite", "phong"] = "auto"
    dent: Literal["auto", "off", "8", "16", "32"] = "auto"
    want_surface: bool = True
    want_joints: bool = True
    want_ring_ends: bool = True
    coupling: Literal["series", "total"] = "series"
    contact: Literal["unilateral", "bonded"] = "unilateral"
    onset_width: float = 1e-3
    transition: float | None = None

    def __post_init__(self):
        """Refuse words and numbers that mean nothing.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self)
        Options(self.coupling, contact=self.contact, onset_width=self.onset_width,
                transition=self.transition)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Effect:
    """One decision: its level (`on`, `off` or a word), the reason, and whether it was forced."""

    name: str
    level: str
    reason: str
    forced: bool = False


@dataclasses.dataclass(frozen=True)
class Served:
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
    """The program of a scene; hashable, equal where the programs are. Fields as in `Wishes`.

    Attributes:
        curved: motions of the tool are turned into the frame of the centreline at the contact.
        dent: number of centres, 0: off.
        options: of the model.
        ignored: effects that stay off (the seat: that stays) whatever a path needs, because the
            user wished it or a tolerance allows it. A row that needs any other effect that is off
            is refused by status (`ranges.unserved`).
        served: presses that a tolerance was measured for; None: no tolerance.
        effects: all decisions in words; they do not count in comparisons.
    """

    contact: bool
    curved: bool
    seat: Literal["first", "each"]
    friction: bool
    second_plane: bool
    rings: Rings
    axial: bool
    end_motion: bool
    surface: Method | None
    dent: int
    joints: bool
    ring_ends: bool
    options: Options
    ignored: frozenset[str] = frozenset()
    served: Served | None = None
    effects: tuple[Effect, ...] = dataclasses.field(default=(), compare=False, repr=False)

    def __post_init__(self):
        """Refuse words and numbers that mean nothing.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self, dent=0.0)

    def without(self, name: str) -> "Plan | None":
        """The plan with one effect less on every path, or None where none goes alone."""
        off: dict[str, dict] = {
            "friction": {"friction": False},
            "axial": {"axial": False, "end_motion": False},
            "end_motion": {"end_motion": False},
            "surface": {"surface": None, "dent": 0, "end_motion": False},
            "dent": {"dent": 0},
            "joints": {"joints": False},
            "ring_ends": {"ring_ends": False},
            "rings": {"rings": "mat"},
            "shear": {"options": dataclasses.replace(self.options, shear=False)},
            "two_material": {"options": dataclasses.replace(self.options, local="uniform")},
        }
        less = dataclasses.replace(self, **off[name]) if name in off else self
        if name == "second_plane" and self.second_plane and not self.friction:
            less = dataclasses.replace(self, second_plane=False, rings="mat", axial=False,
                                       end_motion=False)  # fmt: skip
        if less == self:
            return None
        gone = {name} | ({"rings", "axial", "end_motion"} if name == "second_plane" else set())
        gone |= {"end_motion"} if name in ("axial", "surface") else set()
        return dataclasses.replace(less, ignored=self.ignored | gone)
