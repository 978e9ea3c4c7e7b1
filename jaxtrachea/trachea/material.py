"""The mechanical parameters of a trachea: each declared once, and as one pytree.

What a parameter is called, what it means and in which unit, where it may be given and how a fit
treats it stands here and nowhere else. The tables of a fit, the keys of a scene's `[material]` and
the page docs/reference.md follow from it.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal

import equinox as eqx
from jaxtyping import Array, Float

from jaxtrachea._arguments import check_word, real

Scope = Literal["shared", "specimen", "trial"]
Scale = Literal["log", "linear"]
Part = Literal["skeleton", "contact", "finite strain", "sections", "time", "press"]
Needs = Literal[
    "", "shear", "two-material", "softening", "axial", "arch", "second plane", "sections",
    "arch, sections", "relaxation", "parts",
]  # fmt: skip
VariesBy = Literal["", "span", "ring"]


@dataclasses.dataclass(frozen=True)
class Fitted:
    """How a fit treats a parameter unless the specification says otherwise.

    Attributes:
        value: initial guess, or the value if `fixed`; in the parameter's unit, like all here.
        lower: bound.
        upper: bound.
        scale: coordinate of steps and of relative errors.
        step: natural size of a change with scale `linear`.
        scope: one value for the whole study, per specimen, or per trial (curve).
        fixed: not fitted unless named.
        auto: fixed, but where a curve's own record shows that it is another.
        if_named: not even part of the model unless named.
    """

    value: float
    lower: float
    upper: float
    scale: Scale = "log"
    step: float = 1.0
    scope: Scope = "specimen"
    fixed: bool = False
    auto: bool = False
    if_named: bool = False

    def __post_init__(self):
        """Refuse words that no fit knows (`ValueError`)."""
        check_word("scale", self.scale, Scale)
        check_word("scope", self.scope, Scope)


@dataclasses.dataclass(frozen=True)
class Declaration:
    """A parameter, declared.

    Attributes:
        name: as in `Material`, TOML files and tables.
        unit: of every bare number.
        dimension: for `units.parse_quantity`.
        description: what the user reads in tables.
        part: `skeleton` (it changes the compliance under the contact), `contact` (the local law),
            `finite strain` (how the skeleton leaves that compliance in deep presses), `sections`
            (of a skeleton of deforming cross-sections, in `SectionMaterial`), `time` (how its force
            relaxes, in no record of a material: any level may) or `press` (of a single press: no
            property of the specimen, not in `Material`).
        symbol: in the paper.
        needs: option or effect that reads it; "" where every press does. A fit has it in its model
            where `mechanics.press.Options` has that option.
        absent: what a value that is not given stands for; "" where it must be given.
        requires: value without which it means nothing.
        varies_by: where an array may give each its own value.
        signed: whether it may be zero or negative.
        divides: whether every model that reads it divides by it: zero is then no limit of small
            values.
        fit: None where a fit cannot identify it.
    """

    name: str
    unit: str
    dimension: str
    description: str
    part: Part = "skeleton"
    symbol: str = ""
    needs: Needs = ""
    absent: str = ""
    requires: str = ""
    varies_by: VariesBy = ""
    signed: bool = False
    divides: bool = False
    fit: Fitted | None = None

    def __post_init__(self):
        """Refuse words that have no meaning (`ValueError`)."""
        check_word(f"{self.name}: part", self.part, Part)
        check_word(f"{self.name}: needs", self.needs, Needs)
        check_word(f"{self.name}: each", self.varies_by, VariesBy)


def _field(name: str, unit: str, dimension: str, description: str, **more: Any) -> Any:
    """A field and its declaration; by keyword, and None unless given, where it has an `absent`.

    Python numbers become arrays (one door, so that jit does not retrace).
    """
    declaration = Declaration(name, unit, dimension, description, **more)
    metadata = {"declaration": declaration}
    if not declaration.absent:
        return eqx.field(converter=lambda v: real(name, v), metadata=metadata)
    return eqx.field(
        default=None, kw_only=True, converter=lambda v: None if v is None else real(name, v),
        metadata=metadata,
    )  # fmt: skip


class Material(eqx.Module):
    """Stiffness of ligament, rings and local contact: everything that is identified.

    A scalar holds for all spans or rings; an array, shape (rings + 1,) or (rings,), gives each its
    own where the declaration says so. None: not given. EI_L, k_M, k_1 and k_3, in this order, are
    needed; the others are given by keyword. Units and meanings: docs/reference.md.

    The initial guesses of a fit are round numbers of the right order for a human-sized trachea, not
    values of the paper (which gives none).
    """

    EI_L: Float[Array, "..."] = _field(
        "EI_L", "N mm^2", "bending_stiffness", "ligament bending stiffness",
        symbol="E_L I_L", part="skeleton", varies_by="span", divides=True,
        fit=Fitted(10.0, 1e-4, 1e7),
    )  # fmt: skip
    GA_L: Float[Array, "..."] | None = _field(
        "GA_L", "N", "force", "ligament shear stiffness",
        symbol="kappa G A", part="skeleton", needs="shear", absent="no shear", varies_by="span",
        divides=True, fit=Fitted(10.0, 1e-4, 1e6),
    )  # fmt: skip
    k_M: Float[Array, "..."] = _field(
        "k_M", "N/mm", "stiffness", "muscle stiffness under a ring",
        part="skeleton", varies_by="ring", fit=Fitted(0.1, 1e-6, 1e6),
    )  # fmt: skip
    k_1: Float[Array, ""] = _field(
        "k_1", "N/mm", "stiffness", "linear contact stiffness",
        symbol="m_0 omega_0^2", part="contact", fit=Fitted(1.0, 1e-6, 1e6),
    )  # fmt: skip
    k_3: Float[Array, ""] = _field(
        "k_3", "N/mm^3", "cubic_stiffness", "cubic contact stiffness",
        symbol="3/4 m_0 beta_0^2 eps", part="contact", signed=True,
        fit=Fitted(0.01, 0.0, 1e6, "linear", 0.01),
    )  # fmt: skip
    k_5: Float[Array, ""] | None = _field(
        "k_5", "N/mm^5", "quintic_stiffness", "quintic contact stiffness",
        part="contact", absent="a cubic law", signed=True,
        fit=Fitted(1e-4, 0.0, 1e6, "linear", 1e-4, if_named=True),
    )  # fmt: skip
    k_1_ring: Float[Array, ""] | None = _field(
        "k_1_ring", "N/mm", "stiffness", "linear contact stiffness on a ring",
        part="contact", needs="two-material", absent="one law everywhere",
        fit=Fitted(10.0, 1e-6, 1e6),
    )  # fmt: skip
    k_3_ring: Float[Array, ""] | None = _field(
        "k_3_ring", "N/mm^3", "cubic_stiffness", "cubic contact stiffness on a ring",
        part="contact", needs="two-material", absent="k_3", requires="k_1_ring", signed=True,
        fit=Fitted(0.01, 0.0, 1e6, "linear", 0.01, if_named=True),
    )  # fmt: skip
    k_5_ring: Float[Array, ""] | None = _field(
        "k_5_ring", "N/mm^5", "quintic_stiffness", "quintic contact stiffness on a ring",
        part="contact", needs="two-material", absent="k_5", requires="k_1_ring", signed=True,
        fit=Fitted(1e-4, 0.0, 1e6, "linear", 1e-4, if_named=True),
    )  # fmt: skip
    e_1: Float[Array, ""] | None = _field(
        "e_1", "1/mm", "inverse_length", "softening of a press, linear in the way of the tool",
        part="finite strain", needs="softening", absent="a linear skeleton", signed=True,
        fit=Fitted(0.05, 0.0, 10.0, "linear", 0.01),
    )  # fmt: skip
    e_2: Float[Array, ""] | None = _field(
        "e_2", "1/mm^2", "inverse_area", "softening of a press, quadratic part",
        part="finite strain", needs="softening", absent="a linear skeleton", signed=True,
        fit=Fitted(0.002, 0.0, 10.0, "linear", 0.001),
    )  # fmt: skip
    EA_L: Float[Array, "..."] | None = _field(
        "EA_L", "N", "force", "ligament axial stiffness",
        symbol="E_L A_L", part="skeleton", needs="axial", absent="no stretch", varies_by="span",
        divides=True,
    )  # fmt: skip
    k_A: Float[Array, ""] | None = _field(
        "k_A", "N/mm", "stiffness", "axial spring of the carina end",
        part="skeleton", needs="axial", absent="held",
    )  # fmt: skip
    k_B: Float[Array, ""] | None = _field(
        "k_B", "N/mm", "stiffness", "axial spring of the larynx end",
        part="skeleton", needs="axial", absent="held",
    )  # fmt: skip
    EI_C: Float[Array, ""] | None = _field(
        "EI_C", "N mm^2", "bending_stiffness", "cartilage bending stiffness in a ring's plane",
        symbol="E_C I_C", part="skeleton", needs="arch, sections", absent="rings do not bend",
        divides=True, fit=Fitted(25.0, 1e-3, 1e6),
    )  # fmt: skip
    k_t: Float[Array, ""] | None = _field(
        "k_t", "N/mm", "stiffness", "muscular bar between the ends of a ring",
        part="skeleton", needs="arch", absent="rings do not bend",
    )  # fmt: skip
    EI_side: Float[Array, "..."] | None = _field(
        "EI_side", "N mm^2", "bending_stiffness", "EI_L for bending along the circumference",
        part="skeleton", needs="second plane", absent="EI_L", varies_by="span",
        divides=True,
    )  # fmt: skip
    GA_side: Float[Array, "..."] | None = _field(
        "GA_side", "N", "force", "GA_L for shear along the circumference",
        part="skeleton", needs="second plane", absent="GA_L", requires="GA_L", varies_by="span",
        divides=True,
    )  # fmt: skip


#: Parameters of single presses, which are no property of the specimen.
_OF_THE_PRESS = (
    Declaration(
        "onset", "mm", "length", "displacement at first touch", part="press", signed=True,
        fit=Fitted(0.0, -100.0, 100.0, "linear", scope="trial", fixed=True, auto=True),
    ),
    Declaration(
        "force_offset", "N", "force", "zero offset of the load cell", part="press", signed=True,
        fit=Fitted(0.0, -1e4, 1e4, "linear", 0.1, "trial", fixed=True, auto=True),
    ),
    Declaration(
        "force_slope", "N/mm", "stiffness", "slope of the force without contact", part="press",
        signed=True,
        fit=Fitted(0.0, -1e4, 1e4, "linear", 0.01, "trial", fixed=True, auto=True, if_named=True),
    ),
)  # fmt: skip


def _of_time(suffix: str, whose: str, needs: Needs) -> list[Declaration]:
    """The numbers of all laws of relaxation, see `relaxation.laws`."""

    def row(name: str, description: str, fit: Fitted) -> Declaration:
        time = name in ("tau_1", "tau_2")
        unit = ("s", "time") if time else ("1", "dimensionless")
        return Declaration(
            name + suffix, *unit, description, part="time", needs=needs, absent="no relaxation",
            fit=fit,
        )  # fmt: skip

    strength, ratio = Fitted(0.5, 1e-6, 1e6), Fitted(10.0, 2.0, 1e6)
    return [
        *(row(f"gamma_{b}", f"strength of branch {b} of {whose} (prony), over what lasts", strength)
          for b in range(1, 5)),
        row("tau_1", f"shortest time of {whose} (prony, fung)", Fitted(1.0, 1e-6, 1e6)),
        *(row(f"tau_ratio_{b}", f"time of branch {b} of {whose} over that before (prony)", ratio)
          for b in range(2, 5)),
        row("gamma", f"strength of {whose} after 1 s (power), over what lasts", strength),
        row("beta", f"exponent of {whose} (power)", Fitted(0.2, 0.05, 0.4)),
        row("C", f"strength of {whose} for each e-fold of time (fung), over what lasts",
            Fitted(0.1, 1e-6, 1e6)),
        row("tau_2", f"longest time of {whose} (fung)", Fitted(100.0, 1e-6, 1e9)),
    ]  # fmt: skip


_OF_TIME = _of_time("", "the relaxation", "relaxation") + _of_time(
    "_skeleton", "the skeleton's relaxation", "parts"
)
#: Values of a material by name, in the order of every table.
VALUES: dict[str, Declaration] = {
    field.name: field.metadata["declaration"] for field in dataclasses.fields(Material)
}
#: Numbers of the relaxation, likewise; where the skeleton relaxes apart the others are of the local
#: law alone.
OF_TIME: dict[str, Declaration] = {p.name: p for p in _OF_TIME}
#: Those of single presses.
OF_PRESS: dict[str, Declaration] = {p.name: p for p in _OF_THE_PRESS}
#: Every parameter of a line of joints, likewise; those of single presses last.
PARAMETERS: dict[str, Declaration] = VALUES | OF_PRESS
#: Values of a skeleton that softens in deep presses.
DEEP = tuple(name for name, p in VALUES.items() if p.needs == "softening")


def meaningless(given: Iterable[str]) -> dict[str, str]:
    """Values among these that mean nothing without another that is not, and that other."""
    given = set(given)
    wanting = {name: VALUES[name].requires for name in VALUES if name in given}
    return {name: other for name, other in wanting.items() if other and other not in given}


def material_of(values: dict[str, Array]) -> Material:
    """The material of values by name; names of no value of it are passed over."""
    return Material(**{name: v for name, v in values.items() if name in VALUES})
