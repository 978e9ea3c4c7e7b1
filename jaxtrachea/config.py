"""TOML specifications: what the user writes, validated, in internal units.

Every problem is reported with its dotted key, what was found and what is expected. Nothing here
opens a measurement file or imports JAX; the rooms below turn these records into objects.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from jaxtrachea.units import parse_quantity

Spec = TypeVar("Spec", bound=BaseModel)


class SpecError(ValueError):
    """A specification that cannot be used; the message has one line per problem."""


def quantity(dimension: str, *, positive: bool = False, word: str | None = None):
    """A field read as a quantity with its unit ("9 mm"), kept as a float in internal units.

    Args:
        dimension: of the quantity.
        positive: refuse zero and below.
        word: a text allowed instead of a quantity.
    """

    def read(value: Any) -> Any:
        if word is not None and value == word:
            return value
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ValueError(f"expected a {dimension} with its unit")
        with np.errstate(over="ignore"):  # infinity is refused with the key's name
            number = parse_quantity(value, dimension)
        if positive and number <= 0:
            raise ValueError(f"expected a positive {dimension}")
        return number

    return BeforeValidator(read)


def _number_or_quantity(value: Any) -> Any:
    """Checked against the parameter's unit later, in `identify.study`."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError("expected a number, or a quantity with its unit")
    if isinstance(value, int) and abs(value) > 1e300:
        raise ValueError("expected a finite number")
    return value


Length = Annotated[float, quantity("length")]
PositiveLength = Annotated[float, quantity("length", positive=True)]
Angle = Annotated[float, quantity("angle")]
Estimate = Literal["estimate"]
ForceNoise = Annotated[Estimate | float, quantity("force", positive=True, word="estimate")]
LengthNoise = Annotated[Estimate | float, quantity("length", positive=True, word="estimate")]
Number = Annotated[Any, BeforeValidator(_number_or_quantity)]


class Section(BaseModel):
    """A table of a specification: strict, closed, finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class DataSection(Section):
    """[data]: which files, and how to read them (docs/measurements.md)."""

    files: list[str] = Field(min_length=1)
    format: Literal["auto", "tidy", "machine", "hdf5", "afmformats"] = "auto"
    columns: dict[str, str] = {}
    units: dict[str, str] = {}
    specimen: str | None = None
    s: str | None = None
    phi: str | None = None
    displacement_min: Length | None = None
    displacement_max: Length | None = None
    loading: Literal["require-monotone", "loading", "all"] = "require-monotone"
    force_sign: Literal[1, -1] = 1
    displacement_sign: Literal[1, -1] = 1
    tool_radius: PositiveLength | None = None

    @model_validator(mode="before")
    @classmethod
    def _one_file(cls, data: Any) -> Any:
        if isinstance(data, dict) and isinstance(data.get("files"), str):
            return {**data, "files": [data["files"]]}
        return data


class EvenRings(Section):
    """Evenly spaced rings."""

    count: int = Field(ge=1, le=2000)
    first: PositiveLength
    last: PositiveLength


#: Names of the two ways to write `trachea.rings`; pydantic puts them into the place of an error.
_EVEN, _LISTED = "evenly spaced", "listed"
Rings = Annotated[
    Annotated[EvenRings, Tag(_EVEN)] | Annotated[list[PositiveLength], Tag(_LISTED)],
    Discriminator(lambda value: _EVEN if isinstance(value, dict | EvenRings) else _LISTED),
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
    """[model]: what the forward model includes; see `jaxtrachea.model.Options`."""

    coupling: Literal["series", "total"] = "series"
    split: Literal["continuous", "independent"] = "continuous"
    form: Literal["recursion", "reactions"] = "recursion"
    shear: bool = False
    local: Literal["uniform", "two-material"] = "uniform"
    contact: Literal["unilateral", "bonded"] = "unilateral"
    onset_width: PositiveLength = 1e-3
    transition: PositiveLength | None = None


class ParameterSection(Section):
    """[parameters.NAME]: `fixed`, or free with any of `initial`, `bounds`, `scale`, `scope`.

    Numbers are in the parameter's own unit (EI_L N mm^2, GA_L N, k_M, k_1, k_1_ring N/mm, k_3,
    k_3_ring N/mm^3, onset mm, force_offset N), or quantities with a unit.
    """

    fixed: Number | None = None
    initial: Number | None = None
    bounds: tuple[Number, Number] | None = Field(None, strict=False)
    scale: Literal["log", "linear"] | None = None
    scope: Literal["shared", "specimen", "trial"] | None = None

    @model_validator(mode="after")
    def _either(self) -> "ParameterSection":
        free = ("initial", "bounds", "scale", "scope")
        if self.fixed is not None and any(getattr(self, name) is not None for name in free):
            raise ValueError("fixed excludes initial, bounds, scale and scope")
        return self


class NoiseSection(Section):
    """[noise]: standard deviation of each kind of observation, or "estimate"."""

    force: ForceNoise = "estimate"
    joints: LengthNoise = "estimate"


class FitSection(Section):
    """[fit]: how to weigh and solve; see `jaxtrachea.identify.fit.Settings`."""

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    balance: Literal["curve", "sample"] = "curve"
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    loss_scale: float = Field(1.345, gt=0)
    starts: int = Field(4, ge=1, le=10_000)
    start_decades: float = Field(1.0, ge=0, le=10)
    seed: int = Field(0, ge=0, lt=2**63)
    max_iterations: int = Field(200, ge=1, le=1_000_000)
    tolerance: float = Field(1e-10, gt=0, lt=0.1)
    chunk: Literal["auto"] | Annotated[int, Field(ge=1, le=1_000_000)] = "auto"
    save_every: Literal["auto"] | Annotated[int, Field(ge=1, le=1_000_000)] = "auto"
    precision: Literal["float64", "float32"] = "float64"


class UncertaintySection(Section):
    """[uncertainty]: what is done beyond the local standard errors (docs/uncertainty.md)."""

    profile: list[str] = []
    profile_points: int = Field(10, ge=2, le=1000)
    bootstrap: int = Field(0, ge=0, le=1_000_000)
    kind: Literal["parametric", "residual"] = "parametric"
    block: int = Field(1, ge=1, le=1_000_000)

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
        if self.block > 1 and self.kind == "parametric":
            raise ValueError("block draws neighbouring residuals together; set kind = 'residual'")
        return self


class DesignSection(Section):
    """[design]: which presses are possible, and what is asked of the next ones."""

    s: tuple[Length, Length] | None = Field(None, strict=False)
    depth: tuple[PositiveLength, PositiveLength] | None = Field(None, strict=False)
    points: int = Field(3, ge=1, le=100)
    criterion: Literal["D", "A", "E"] = "D"
    candidates: int = Field(10_000, ge=5, le=10_000_000)

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
    return load_spec(path, FitSpec, "fit specification")


def load_spec(path: Path, kind: type[Spec], called: str) -> Spec:
    """Read and validate a specification of any kind.

    Args:
        path: the TOML file.
        kind: the record it must fit.
        called: what a user calls it.

    Raises:
        SpecError: as `load_fit_spec`.
    """
    try:
        with path.open("rb") as stream:
            content = tomllib.load(stream)
    except OSError as error:
        reason = error.strerror or "cannot be read"
        raise SpecError(f"{path}: {reason}; expected a TOML {called}") from None
    except UnicodeDecodeError as error:
        raise SpecError(f"{path}: not UTF-8 (byte {error.start}); save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise SpecError(f"{path}: not valid TOML: nested too deeply") from None
    except ValueError as error:  # integers beyond what Python converts
        raise SpecError(f"{path}: not valid TOML: {error}") from None
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise SpecError("\n".join(f"{path}: {line}" for line in _lines(error, kind))) from None


def _lines(error: ValidationError, root: type[BaseModel]) -> list[str]:
    """One line per problem: dotted key, what is wrong, what was found."""
    lines: dict[str, None] = {}
    for problem in error.errors():
        parts = [part for part in problem["loc"] if part not in (_EVEN, _LISTED)]
        key = ".".join(map(str, parts)) or "(top level)"
        text = problem["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
        if problem["type"] == "extra_forbidden":
            text = f"unknown key; expected one of {', '.join(_known(parts, root))}"
        elif problem["type"] == "missing":
            text = "missing"
        elif problem["type"] in ("model_type", "dict_type"):
            text = f"expected a table {{ key = value, ... }} (found {problem['input']!r})"
        elif not isinstance(problem["input"], dict | list):
            found = repr(problem["input"])
            text = f"{text} (found {found if len(found) < 80 else found[:76] + ' ...'})"
        lines.setdefault(f"{key}: {text}")
    return list(lines)


def _known(parts: list, root: type[BaseModel]) -> list[str]:
    """Keys of the section that holds the unknown key `parts`."""
    section = root
    for part in parts[:-1]:
        field = section.model_fields.get(part)
        section = _sections(field.annotation)[-1] if field else section
    return list(section.model_fields)


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """The sections named anywhere in a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _sections(part)]
