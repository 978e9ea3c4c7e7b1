"""The parameters that can be identified, as one table, and how each enters a fit."""

import dataclasses
import math
from typing import Literal

from jaxtrachea._arguments import check_word
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.press import Options

Scope = Literal["shared", "specimen", "trial"]
Scale = Literal["log", "linear"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of a fit.

    Attributes:
        name: as in `Material`, or `onset` / `force_offset`.
        unit: of every number here.
        dimension: for `units.parse_quantity`.
        description: what the user reads in tables.
        value: initial guess, or the value if `fixed`.
        lower: bound; must be positive with scale `log`.
        upper: bound.
        scale: the coordinate in which steps are taken and identifiability is judged: `log`
            (relative changes) or `linear` (changes relative to `step`).
        step: natural size of a change with scale `linear`, in `unit`.
        scope: one value for the whole study, per specimen, or per trial (curve).
        fixed: not fitted.
    """

    name: str
    unit: str
    dimension: str
    description: str
    value: float
    lower: float
    upper: float
    scale: Scale = "log"
    step: float = 1.0
    scope: Scope = "specimen"
    fixed: bool = False

    def __post_init__(self):
        """Check that value, bounds and scale agree.

        Raises:
            InputError: naming the parameter and the cure.
        """
        check_word(f"{self.name}: scale", self.scale, Scale)
        check_word(f"{self.name}: scope", self.scope, Scope)
        if not 0 < self.step < math.inf:
            raise InputError(f"step is {self.step}", key=self.name, expected="more than 0")
        if not all(map(math.isfinite, (self.value, self.lower, self.upper))):
            raise InputError(
                "value and bounds must be finite numbers", key=self.name, cure="give such"
            )
        if self.fixed:
            return
        if self.lower >= self.upper:
            raise InputError(
                f"lower bound {self.lower:g} is not below upper bound {self.upper:g}",
                key=self.name,
                cure="swap or correct them",
            )
        if self.scale == "log" and self.lower <= 0:
            raise InputError(
                f"scale 'log' needs a positive lower bound, found {self.lower:g}",
                key=self.name,
                cure="raise the bound or use scale = 'linear'",
            )
        if not self.lower <= self.value <= self.upper:
            raise InputError(
                f"initial value {self.value:g} {self.unit} is outside its bounds "
                f"[{self.lower:g}, {self.upper:g}]",
                key=self.name,
                cure="move one or the other",
            )

    def to_scaled(self, value: float) -> float:
        """Coordinate of a value: log(value) or value / step."""
        return math.log(value) if self.scale == "log" else value / self.step

    def from_scaled(self, theta: float) -> float:
        """Value at a coordinate."""
        return math.exp(theta) if self.scale == "log" else theta * self.step


def _stiffness(name, text, value, lower=1e-6, upper=1e6):
    return Parameter(name, "N/mm", "stiffness", text, value, lower, upper)


#: Every parameter with its defaults. The initial guesses are round numbers of the right order for a
#: human-sized trachea, not values of the paper (which gives none).
DEFAULTS = {
    p.name: p
    for p in (
        Parameter(
            "EI_L", "N mm^2", "bending_stiffness", "ligament bending stiffness", 10.0, 1e-4, 1e7
        ),
        Parameter("GA_L", "N", "force", "ligament shear stiffness", 10.0, 1e-4, 1e6),
        _stiffness("k_M", "muscle stiffness under a ring", 0.1),
        _stiffness("k_1", "linear contact stiffness", 1.0),
        Parameter(
            "k_3",
            "N/mm^3",
            "cubic_stiffness",
            "cubic contact stiffness",
            0.01,
            0.0,
            1e6,
            scale="linear",
            step=0.01,
        ),
        _stiffness("k_1_ring", "linear contact stiffness on a ring", 10.0),
        Parameter(
            "k_3_ring",
            "N/mm^3",
            "cubic_stiffness",
            "cubic contact stiffness on a ring",
            0.01,
            0.0,
            1e6,
            scale="linear",
            step=0.01,
        ),
        Parameter(
            "onset",
            "mm",
            "length",
            "displacement at first touch",
            0.0,
            -100.0,
            100.0,
            scale="linear",
            scope="trial",
            fixed=True,
        ),
        Parameter(
            "force_offset",
            "N",
            "force",
            "zero offset of the load cell",
            0.0,
            -1e4,
            1e4,
            scale="linear",
            step=0.1,
            scope="trial",
            fixed=True,
        ),
    )
}

#: Parameters of the beam; all others act at the contact.
SKELETON = ("EI_L", "GA_L", "k_M")
#: Parameters of single presses that are no property of the specimen: errors are measured against
#: the range of displacement and the largest force.
OF_THE_PRESS = ("onset", "force_offset")


def in_model(options: Options, *, joints: bool) -> list[str]:
    """Names of the parameters that the chosen model can see, in table order.

    With coupling `total` and no joint markers the skeleton does not enter: force-displacement
    curves then see k_1 and k_3 alone.
    """
    names = []
    for name in DEFAULTS:
        if name in SKELETON and options.coupling == "total" and not joints:
            continue
        if name == "GA_L" and not options.shear:
            continue
        if name.endswith("_ring") and options.local != "two-material":
            continue
        names.append(name)
    return names
