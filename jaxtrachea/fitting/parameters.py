"""The parameters that can be identified, as one table, and how each enters a fit."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from jaxtrachea._arguments import check_word
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.levels.choose import DECLARED as OF_LEVELS
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.line import OF_BEAM
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.sections.material import (
    FROM_FACTORS,
    SECTION_VALUES,
    TOOL_RADIUS,
    Wall,
    from_wall,
)
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import OF_PRESS, Declaration, Fitted, Scale, Scope


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of a fit.

    Attributes:
        name: as in `Material`, or `onset`, `force_offset`, `force_slope`.
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
        auto: fixed, but `build_study` fits it to those curves whose own record shows that it is not
            `value` (and `fixed` is then false); other curves keep `value`, which is 0.
        foreign_value: what the factors of another tube give (`from_wall`); None: nothing. Fixed at
            it, predictions are EXTRAPOLATED.
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
    auto: bool = False
    foreign_value: float | None = dataclasses.field(default=None, compare=False)

    def __post_init__(self):
        """Check that value, bounds and scale agree (`InputError`)."""
        check_word(f"{self.name}: scale", self.scale, Scale)
        check_word(f"{self.name}: scope", self.scope, Scope)
        if not isinstance(self.fixed, bool):
            raise InputError(
                f"fixed is {self.fixed!r}", key=self.name, expected="True or False",
                cure="give the number as value",
            )  # fmt: skip
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

    @property
    def foreign(self) -> bool:
        """Whether it stays at what the factors of another tube give."""
        return self.fixed and self.value == self.foreign_value

    def to_scaled(self, value: float) -> float:
        """Coordinate of a value: log(value) or value / step."""
        return math.log(value) if self.scale == "log" else value / self.step

    def from_scaled(self, theta: Any) -> Any:
        """Value at a coordinate, of a number or of an array of any shape."""
        with np.errstate(over="ignore"):
            return np.exp(theta) if self.scale == "log" else theta * self.step


def held(p: Parameter) -> Parameter:
    """A parameter fixed at its own value, where that is more than a first guess.

    Raises:
        InputError: it is none: neither fixed by default, nor given by the wall of cross-sections.
    """
    if p.fixed or p.name in SECTION_VALUES:
        return dataclasses.replace(p, fixed=True, auto=False)
    raise InputError(
        f"true would hold the first guess, {p.value:g} {p.unit}".rstrip(),
        key="fixed",
        expected="a number; only values of deforming cross-sections have one, by [wall]",
    )


def _of(declared: Declaration, fit: Fitted) -> Parameter:
    return Parameter(
        declared.name, declared.unit, declared.dimension, declared.description, fit.value,
        fit.lower, fit.upper, fit.scale, fit.step, fit.scope, fit.fixed, fit.auto,
    )  # fmt: skip


#: Every parameter there is, as the levels of the mechanics and `trachea.material` declare it.
DECLARED: Mapping[str, Declaration] = {**OF_LEVELS, **OF_PRESS}
#: Every parameter that can be identified, with its defaults.
DEFAULTS = {name: _of(p, p.fit) for name, p in DECLARED.items() if p.fit is not None}
#: Parameters of the beam; of a line of joints all others act at the contact.
SKELETON = OF_BEAM
#: Parameters of single presses that are no property of the specimen: errors are measured against
#: the range of displacement and the largest force.
OF_THE_PRESS = tuple(OF_PRESS)


def visible(options: Options, *, joints: bool) -> list[str]:
    """Names of the parameters that the chosen model can see, in table order."""
    needed = level_of(options).needs(joints=joints)
    return [name for name in DEFAULTS if name in needed]


def in_model(options: Options, *, joints: bool, named: Collection[str] = ()) -> list[str]:
    """`visible`, but for those that a model has only where they are named.

    Args:
        options: of the model.
        joints: whether there are markers.
        named: parameters that the specification names.
    """
    tacit = {name for name, p in DECLARED.items() if p.fit is not None and p.fit.if_named}
    return [n for n in visible(options, joints=joints) if n not in tacit or n in named]


def defaults_of(
    options: Options,
    geometry: Geometry,
    wall: Wall | None = None,
    tool_radius: float | None = None,
) -> Mapping[str, Parameter]:
    """Parameters by name as a fit begins with them.

    `DEFAULTS`, but for deforming cross-sections: those begin at what moduli and thicknesses of the
    wall give for this tube (`from_wall`; of rings with pitches of their own the median).

    Args:
        wall: moduli and thicknesses; None: those of the paper and the virtual specimen.
        tool_radius: mm, which the local contact begins with; None: that of the virtual specimen's.

    Raises:
        InputError: a wall for a model that does not read it.
    """
    if not level_of(options).reads_wall:
        if wall is not None:
            raise InputError(
                "moduli and thicknesses are read by the skeleton 'sections' alone", key="wall",
                cure="leave it out, or choose skeleton = 'sections'",
            )  # fmt: skip
        return DEFAULTS
    material = from_wall(
        geometry, wall or Wall(), tool_radius=tool_radius or TOOL_RADIUS,
        half_width=options.half_width,
    )  # fmt: skip
    values = {name: getattr(material, name) for name in SECTION_VALUES}
    foreign = FROM_FACTORS if material.extrapolated else ()
    begun = {
        n: _begun(DEFAULTS[n], float(np.median(np.asarray(v))), foreign=n in foreign)
        for n, v in values.items()
    }
    return DEFAULTS | begun


def _begun(p: Parameter, value: float, *, foreign: bool) -> Parameter:
    """A parameter with another initial value, its bounds as far from that as need be."""
    return dataclasses.replace(
        p, value=value, lower=min(p.lower, value), upper=max(p.upper, value),
        foreign_value=value if foreign else None,
    )  # fmt: skip
