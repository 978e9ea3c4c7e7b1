"""TOML specifications: what the user writes, validated, in internal units.

Every problem is reported with its dotted key, what was found and what is expected. Nothing here
opens a measurement file or imports JAX; the rooms below turn these records into objects.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from jaxtrachea.files.toml import EVEN, LISTED, load_spec
from jaxtrachea.files.toml import SpecError as SpecError
from jaxtrachea.units import UnitError, parse_quantity


def quantity(dimension: str, *, positive: bool = False, words: tuple[str, ...] = ()):
    """A field read as a quantity with its unit ("9 mm"), kept as a float in internal units.

    Args:
        dimension: of the quantity.
        positive: refuse zero and below.
        words: texts allowed instead of a quantity.
    """

    def read(value: Any) -> Any:
        if value in words:
            return value
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ValueError(f"expected a {dimension.replace('_', ' ')} with its unit")
        try:
            with np.errstate(over="ignore"):  # infinity is refused with the key's name
                number = parse_quantity(value, dimension)
        except UnitError as error:
            raise ValueError(", or ".join([str(error), *map(repr, words)])) from None
        if positive and number <= 0:
            raise ValueError(f"expected a positive {dimension}")
        return number

    return BeforeValidator(read)


def _number_or_quantity(value: Any) -> Any:
    """Checked against the parameter's unit later, in `fitting.study`."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError("expected a number, or a quantity with its unit")
    if isinstance(value, int) and abs(value) > 1e300:
        raise ValueError("expected a finite number")
    return value


def _value_or_true(value: Any) -> Any:
    """As `_number_or_quantity`, or true."""
    if value is True:
        return value
    if value is False:
        raise ValueError("expected true, a number, or a quantity with its unit; leave it out")
    return _number_or_quantity(value)


def _quantity_or_table(value: Any) -> Any:
    """Read by `measurements.curve.ReadOptions`."""
    texts = value.values() if isinstance(value, dict) else [value]
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(
            "expected a quantity with its unit, or a table of files with one each, as in "
            '{ "a.csv" = "0.05 mm/N", "*" = "0 mm/N" }'
        )
    return value


Compliance = Annotated[str | dict[str, str], BeforeValidator(_quantity_or_table)]
Length = Annotated[float, quantity("length")]
PositiveLength = Annotated[float, quantity("length", positive=True)]
Stress = Annotated[float, quantity("stress", positive=True)]
Bed = Annotated[float, quantity("foundation_stiffness", positive=True)]
Angle = Annotated[float, quantity("angle")]
Estimate = Literal["estimate"]
PerCurve = Literal["estimate per curve"]
ForceNoise = Annotated[
    Estimate | PerCurve | float,
    quantity("force", positive=True, words=("estimate", "estimate per curve")),
]
ShareNoise = Annotated[
    Literal["auto", "estimate"] | float,
    quantity("dimensionless", words=("estimate", "auto")),
]
LengthNoise = Annotated[Estimate | float, quantity("length", positive=True, words=("estimate",))]
Number = Annotated[Any, BeforeValidator(_number_or_quantity)]
NumberOrTrue = Annotated[Any, BeforeValidator(_value_or_true)]


class Section(BaseModel):
    """A table of a specification: strict, closed, finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class DataSection(Section):
    """[data]: which files, and how to read them (docs/measurements.md)."""

    files: list[str] = Field(min_length=1)
    format: str = "auto"
    columns: dict[str, str] = {}
    units: dict[str, str] = {}
    specimen: str | None = None
    s: str | None = None
    phi: str | None = None
    displacement_min: Length | None = None
    displacement_max: Length | None = None
    loading: Literal["last", "first", "loading", "all", "require-monotone"] = "last"
    force_sign: Literal[1, -1] = 1
    displacement_sign: Literal[1, -1] = 1
    machine_compliance: Compliance | None = None
    sheet: str | Annotated[list[str], Field(min_length=1)] | None = None
    tool_radius: PositiveLength | None = None
    pressed_ends: bool = True
    together: list[Annotated[list[str], Field(min_length=2)]] | None = None
    baseline: Literal["auto", "slope", "none"] = "auto"

    @model_validator(mode="before")
    @classmethod
    def _one_file(cls, data: Any) -> Any:
        if isinstance(data, dict) and isinstance(data.get("files"), str):
            return {**data, "files": [data["files"]]}
        return data

    @model_validator(mode="after")
    def _told(self) -> "DataSection":
        if not self.pressed_ends and self.tool_radius is None:
            raise ValueError(
                "pressed_ends = false needs tool_radius: which rings are under the tool"
            )
        return self


class EvenRings(Section):
    """Evenly spaced rings."""

    count: int = Field(ge=1, le=2000)
    first: PositiveLength
    last: PositiveLength


Rings = Annotated[
    Annotated[EvenRings, Tag(EVEN)] | Annotated[list[PositiveLength], Tag(LISTED)],
    Discriminator(lambda value: EVEN if isinstance(value, dict | EvenRings) else LISTED),
]


class TracheaSection(Section):
    """[trachea]: the tube at rest; Table 1 of the paper unless length and rings are given."""

    preset: Literal["table-1"] | None = None
    length: PositiveLength | None = None
    rings: Rings | None = None
    radius: PositiveLength = 11.3
    half_angle: Angle = 2.0943951023931953
    ring_height: PositiveLength = 4.0

    @model_validator(mode="after")
    def _complete(self) -> "TracheaSection":
        if (self.length is None) != (self.rings is None):
            raise ValueError("give both length and rings, or neither (preset 'table-1')")
        if self.preset is not None and self.length is not None:
            raise ValueError("preset and length exclude each other; remove one")
        return self


class ModelSection(Section):
    """[model]: what the forward model includes; see `jaxtrachea.mechanics.press.Options`."""

    coupling: Literal["series", "total"] = "series"
    split: Literal["continuous", "independent"] = "continuous"
    form: Literal["recursion", "reactions"] = "recursion"
    shear: bool = False
    local: Literal["uniform", "two-material"] = "uniform"
    contact: Literal["unilateral", "bonded"] = "unilateral"
    onset_width: PositiveLength = 1e-3
    transition: PositiveLength | None = None
    half_width: Length = 0.0
    skeleton: Literal["linear", "softening", "sections"] = "linear"

    @model_validator(mode="before")
    @classmethod
    def _no_level_of_rings(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "rings" not in data:
            return data
        key = f"rings = {data['rings']!r}: a key of scenes."
        if data.get("skeleton") == "sections":
            raise ValueError(
                f"{key} With skeleton = 'sections' rings bend as they are; leave it out"
            )
        raise ValueError(
            f"{key} Presses on the midline cannot tell an arch from its mat: in a fit k_M is the "
            "whole ring, as with 'mat'. Leave it out, or choose skeleton = 'sections' for rings "
            "that bend, anywhere on them"
        )


class WallSection(Section):
    """[wall]: moduli and thicknesses that a fit of deforming cross-sections begins with.

    See `jaxtrachea.mechanics.sections.material.Wall`.
    """

    E_C: Stress = 5.8
    E_L: Stress = 0.65
    E_M: Stress = 0.30
    nu: float = 0.45
    h: PositiveLength = 2.6
    h_C: PositiveLength = 1.56
    h_M: PositiveLength = 2.0
    bed_n: Bed = 0.02
    bed_t: Bed = 0.002


class ParameterSection(Section):
    """[parameters.NAME]: `fixed`, or free with any of `initial`, `bounds`, `scale`, `scope`.

    Names and units are those that `jaxtrachea.trachea.material` declares (docs/parameters.md).
    Numbers are in the parameter's own unit, or quantities with a unit. `fixed = true` keeps the
    initial value: with deforming cross-sections what `[wall]` gives.
    """

    fixed: NumberOrTrue | None = None
    initial: Number | None = None
    bounds: tuple[Number, Number] | None = Field(None, strict=False)
    scale: Literal["log", "linear"] | None = None
    scope: Literal["shared", "specimen", "trial"] | None = None

    @model_validator(mode="after")
    def _either(self) -> "ParameterSection":
        free = ("initial", "bounds", "scale", "scope")
        if self.fixed is not None and any(getattr(self, name) is not None for name in free):
            raise ValueError("fixed excludes initial, bounds, scale and scope; remove it or them")
        return self


class NoiseSection(Section):
    """[noise]: standard deviation of each kind of observation, or "estimate".

    What excludes each other is said by `fitting.lanes.Noise`.
    """

    force: ForceNoise = "estimate"
    force_share: ShareNoise = "auto"
    joints: LengthNoise = "estimate"
    joints_share: Annotated[float, quantity("dimensionless")] = 0.0


class FitSection(Section):
    """[fit]: how to weigh and solve; see `jaxtrachea.fitting.fit.Settings`."""

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    balance: Literal["curve", "sample"] = "curve"
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    loss_scale: float = Field(1.345, gt=0)
    starts: int = Field(4, ge=1, le=10_000)
    start_decades: float = Field(1.0, ge=0, le=10)
    seed: int = Field(0, ge=0, lt=2**63)
    more_starts: int = Field(8, ge=0, le=10_000)
    max_iterations: int = Field(200, ge=1, le=1_000_000)
    tolerance: float = Field(1e-10, gt=0, lt=0.1)
    batch: Literal["auto"] | Annotated[int, Field(ge=1, le=1_000_000)] = "auto"
    save_every: Literal["auto"] | Annotated[int, Field(ge=1, le=1_000_000)] = "auto"
    precision: Literal["float64", "float32"] = "float64"
    population: bool | None = None

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, data: Any) -> Any:
        if isinstance(data, dict) and "chunk" in data:
            raise ValueError("chunk: this key is called 'batch' now; rename it")
        return data


class UncertaintySection(Section):
    """[uncertainty]: what is done beyond the local standard errors (docs/uncertainty.md)."""

    profile: list[str] = []
    profile_points: int = Field(10, ge=2, le=1000)
    bootstrap: int = Field(0, ge=0, le=1_000_000)
    kind: Literal["parametric", "residual"] = "parametric"
    block: int = Field(1, ge=1, le=1_000_000)
    influence: bool = False
    posterior: int = Field(0, ge=0, le=1_000_000)
    posterior_chains: int = Field(4, ge=2, le=1000)

    @model_validator(mode="before")
    @classmethod
    def _one_name(cls, data: Any) -> Any:
        if isinstance(data, dict) and isinstance(data.get("profile"), str):
            return {**data, "profile": [data["profile"]]}
        return data

    @model_validator(mode="after")
    def _enough(self) -> "UncertaintySection":
        if 0 < self.bootstrap < 40:
            raise ValueError("bootstrap needs 40 replicates or more for a 95 % interval (0: none)")
        if 0 < self.posterior < 100:
            raise ValueError("posterior needs 100 draws of each chain or more (0: none)")
        if self.block > 1 and self.kind == "parametric":
            raise ValueError("block draws neighbouring residuals together; set kind = 'residual'")
        return self


class DesignSection(Section):
    """[design]: which presses are possible, and what is asked of the next ones."""

    s: tuple[Length, Length] | None = Field(None, strict=False)
    depth: tuple[PositiveLength, PositiveLength] | None = Field(None, strict=False)
    points: int = Field(3, ge=1, le=100)
    criterion: Literal["D", "A", "E"] = "D"
    candidates: int | None = Field(None, ge=5, le=10_000_000)
    phi: tuple[Angle, ...] | None = Field(None, strict=False, min_length=1)

    @model_validator(mode="after")
    def _ordered(self) -> "DesignSection":
        for name, span in (("s", self.s), ("depth", self.depth)):
            if span is not None and span[0] > span[1]:
                raise ValueError(f"{name} runs from {span[0]:g} down to {span[1]:g} mm; swap them")
        return self


class FitSpec(Section):
    """A whole fit specification."""

    title: str = ""
    data: DataSection
    trachea: TracheaSection = TracheaSection()
    model: ModelSection = ModelSection()
    wall: WallSection | None = None
    parameters: dict[str, ParameterSection] = {}
    noise: NoiseSection = NoiseSection()
    fit: FitSection = Field(default_factory=lambda: FitSection.model_validate({}))
    uncertainty: UncertaintySection = Field(
        default_factory=lambda: UncertaintySection.model_validate({})
    )
    design: DesignSection = Field(default_factory=lambda: DesignSection.model_validate({}))


def load_fit_spec(path: Path) -> FitSpec:
    """Read and validate a fit specification.

    Raises:
        SpecError: missing file, broken TOML (line and column), unknown key, wrong value; one line
            per problem with its dotted key.
    """
    scene = "a scene (commands plan, simulate, sweep)"
    others = {"path": scene, "material": scene}
    return load_spec(path, FitSpec, "fit specification", others)
