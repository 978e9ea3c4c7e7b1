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
from jaxtrachea.relaxation.words import Word
from jaxtrachea.units import UnitError, parse_quantity

#: Most fits that are computed or saved together.
MOST_LANES = 1_000_000


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
            kind = "number" if dimension == "dimensionless" else dimension.replace("_", " ")
            raise ValueError(f"expected a positive {kind}")
        return number

    return BeforeValidator(read)


def _count_or_auto(value: Any) -> Any:
    """One message for both kinds."""
    number = isinstance(value, int) and not isinstance(value, bool)
    if value != "auto" and not (number and 1 <= value <= MOST_LANES):
        raise ValueError(f"expected 'auto', or a whole number from 1 to {MOST_LANES}")
    return value


def _number_or_quantity(value: Any) -> Any:
    """Checked against the parameter's unit later, in `fitting.build`."""
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
Speed = Annotated[float, quantity("velocity", positive=True)]
Duration = Annotated[float, quantity("time")]
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
CountOrAuto = Annotated[Literal["auto"] | int, BeforeValidator(_count_or_auto)]
Number = Annotated[Any, BeforeValidator(_number_or_quantity)]
NumberOrTrue = Annotated[Any, BeforeValidator(_value_or_true)]
#: One text stands for a list of it.
Texts = Annotated[list[str], BeforeValidator(lambda v: [v] if isinstance(v, str) else v)]


class Section(BaseModel):
    """A table of a specification: strict, closed, finite."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True
    )


class DataSection(Section):
    """[data]: which files, and how to read them (docs/measurements.md)."""

    files: Texts = Field(min_length=1)
    """a path or pattern, or a list of them, from the specification's folder or `--data`"""
    format: str = "auto"
    """`tidy`, `machine`, `hdf5`, `afmformats`, or `auto`: by content"""
    columns: dict[str, str] = {}
    """role to column name (a number, counted from 1, where there is no header)"""
    units: dict[str, str] = {}
    """role to unit, for files that name none"""
    specimen: str | None = None
    """template or regular expression for the file name"""
    s: str | None = None
    """contact position of all curves"""
    phi: str | None = None
    """contact angle of all curves"""
    displacement_min: Length | None = None
    """samples below are dropped"""
    displacement_max: Length | None = None
    """samples above are dropped"""
    loading: Literal["last", "first", "loading", "record", "all", "require-monotone"] = "last"
    """the last full loading, the first, the whole record by its time (for a model that relaxes),
    every sample, or every sample of records that only load
    """
    samples: int | None = Field(default=None, ge=20)
    """about how many samples a record is averaged to, in blocks (`loading = "record"`)"""
    force_sign: Literal[1, -1] = 1
    """-1 if the file counts resisting force negative; turns the side force too"""
    displacement_sign: Literal[1, -1] = 1
    """-1 if the file counts inward displacement of the tool negative"""
    machine_compliance: Compliance | None = None
    """of the rig, `"0.05 mm/N"`: times the force, it is taken off the displacement; or by file, `{
    "a.csv" = "0.05 mm/N", "*" = "0 mm/N" }`
    """
    sheet: str | Annotated[list[str], Field(min_length=1)] | None = None
    """sheet of a workbook, a pattern (`"Trial *"`) or a list, each a trial; none: the first that is
    not hidden
    """
    tool_radius: PositiveLength | None = None
    """markers closer to the contact are moved by the tool and left out; with `sections` the local
    contact begins at what a flat end of this radius gives
    """
    pressed_ends: bool = True
    """false: ends of rings within `tool_radius` of the contact along the tube are left out too"""
    together: list[Annotated[list[str], Field(min_length=2)]] | None = None
    """trials of a specimen that `compare` and `--leave-one-out` leave out together, `[["s035",
    "s125"]]`: mirror images and other twins
    """
    exclude: list[str] = []
    """curves that are read and left out, each as specimen/trial, `["T1/s035"]`"""
    baseline: Literal["auto", "slope", "none"] = "auto"
    """line of the force before first touch. `auto`: fitted where a record shows one. `slope`: of
    every curve, and a curve without 5 samples there is left out. `none`: of no curve
    """

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
    """rings"""
    first: PositiveLength
    """position of the first"""
    last: PositiveLength
    """position of the last"""

    @model_validator(mode="after")
    def _apart(self) -> "EvenRings":
        if self.count == 1 and self.first != self.last:
            raise ValueError(
                f"1 ring cannot stand at {self.first:g} and at {self.last:g} mm; expected the same "
                "first and last, or a count of 2 or more"
            )
        return self


Rings = Annotated[
    Annotated[EvenRings, Tag(EVEN)] | Annotated[list[PositiveLength], Tag(LISTED)],
    Discriminator(lambda value: EVEN if isinstance(value, dict | EvenRings) else LISTED),
]


class TracheaSection(Section):
    """[trachea]: the tube at rest; Table 1 of the paper unless length and rings are given.

    Lengths that no trachea has are refused: `trachea.sizes`.
    """

    preset: Literal["table-1"] | None = None
    """the same as leaving length and rings out"""
    length: PositiveLength | None = None
    """of the tube; together with `rings`"""
    rings: Rings | None = None
    """list of positions, or `{ count, first, last }`"""
    radius: PositiveLength = 11.3
    """of the ring line; with `sections` of the wall's mid-line"""
    half_angle: Angle = 2.0943951023931953
    """half opening of the rings"""
    ring_height: PositiveLength = 4.0
    """extent of a ring along the tube"""

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
    """`series`: tool displacement = indentation + skeleton; `total`: the local law takes all of it
    """
    split: Literal["continuous", "independent"] = "continuous"
    """`continuous`: rotation continuous at the contact; `independent`: two spans (paper, eq. 3)"""
    form: Literal["recursion", "reactions"] = "recursion"
    """`reactions`: the paper's dense force method"""
    shear: bool = False
    """the ligament also deforms in shear"""
    local: Literal["uniform", "two-material"] = "uniform"
    """`two-material`: rings have a local law of their own"""
    contact: Literal["unilateral", "bonded"] = "unilateral"
    """`bonded`: press or draw, odd law"""
    onset_width: PositiveLength = 1e-3
    """width of the smooth first touch, at most a tenth of the radius; where an onset is fitted,
    each curve has its own
    """
    transition: PositiveLength | None = None
    """from a ring's centre to where the ligament's local law holds; none: half the closest spacing
    (of one ring: to the nearer end)
    """
    half_width: Length = 0.0
    """of a flat punch along s; 0: a point. For the flat end of a cylinder pi/4 of its radius.
    Curves nearer than that to an end of the tube are refused
    """
    skeleton: Literal["linear", "softening", "sections"] = "linear"
    """`softening`: deep presses, with `e_1` and `e_2`. `sections`: rings that change their shape,
    anywhere on them and deep; needs `contact = "bonded"` and no other option of this table
    """
    relaxation: Literal["off", "uniform", "parts"] = "off"
    """`uniform`: the force relaxes, all parts alike; `parts`: local contact and skeleton apart.
    Both read the time (`loading = "record"`)
    """
    branches: Word = "prony-2"
    """law of the relaxation"""

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
    """modulus of the cartilage"""
    E_L: Stress = 0.65
    """modulus of the ligament"""
    E_M: Stress = 0.30
    """modulus of the muscle"""
    nu: float = 0.45
    """Poisson's ratio of the wall, in [0, 0.5)"""
    h: PositiveLength = 2.6
    """thickness of the wall in front"""
    h_C: PositiveLength = 1.56
    """thickness of the cartilage in it, on its outside; at most `h`"""
    h_M: PositiveLength = 2.0
    """thickness of the muscle"""
    bed_n: Bed = 0.02
    """bed behind the muscle, on its outer surface, along the normal"""
    bed_t: Bed = 0.002
    """the same along the circumference"""


class ParameterSection(Section):
    """[parameters.NAME]: `fixed`, or free with any of `initial`, `bounds`, `scale`, `scope`.

    Names and units are those that `jaxtrachea.trachea.material` declares (docs/reference.md).
    Numbers are in the parameter's own unit, or quantities with a unit. `fixed = true` keeps the
    initial value: with deforming cross-sections what `[wall]` gives.
    """

    fixed: NumberOrTrue | None = None
    """not fitted: this number. `true`: what `[wall]` gives (sections), or as it is fixed unless
    named; refused where that is only a first guess. Excludes the other keys
    """
    initial: Number | None = None
    """first start"""
    bounds: tuple[Number, Number] | None = Field(None, strict=False)
    """`[lower, upper]`"""
    scale: Literal["log", "linear"] | None = None
    """coordinate of steps and of relative errors"""
    scope: Literal["shared", "specimen", "trial"] | None = None
    """one value for the study (`shared`), for each specimen, or for each trial"""

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
    """standard deviation; `"estimate per curve"`: estimated, each curve weighed by its own. A
    column sigma comes before it. All curves have a sigma, or none
    """
    force_share: ShareNoise = "auto"
    """share of the force that the standard deviation has beside `force`: sqrt(force² + (share F)²).
    `"estimate"`: by maximum likelihood, 0 where it gains less than 9 in -2 ln L. `"auto"`:
    `"estimate"` where curves go deeper than a tenth of the radius, `force` is estimated and
    there is a skeleton. `0`: none
    """
    joints: LengthNoise = "estimate"
    """standard deviation of the markers, of sideward markers and ring ends"""
    joints_share: Annotated[float, quantity("dimensionless")] = 0.0
    """share of the tool's displacement from first touch that this has beside `joints` (root of the
    sum of squares)
    """


class FitSection(Section):
    """[fit]: how to weigh and solve; see `jaxtrachea.fitting.fit.Settings`."""

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    """solver"""
    balance: Literal["curve", "sample"] = "curve"
    """`curve`: every curve weighs the same; `sample`: every sample"""
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    """of a residual; all but `linear` are robust"""
    loss_scale: float = Field(1.345, gt=0)
    """residual, in standard deviations, where the loss turns robust"""
    starts: int = Field(4, ge=1, le=10_000)
    """starts per fit; more than 2,048 saved together, of curves of 96 samples and more, begin on 24
    samples of each
    """
    start_decades: float = Field(1.0, ge=0, le=10)
    """how far starts spread around the first"""
    seed: int = Field(0, ge=0, lt=2**63)
    """of the drawn starts"""
    more_starts: int = Field(8, ge=0, le=10_000)
    """starts added to a fit none of whose starts converged, or whose best was reached once;
    infeasible starts are then drawn anew, too; 0: neither
    """
    max_iterations: int = Field(200, ge=1, le=1_000_000)
    """per start, on the few samples and on all"""
    tolerance: float = Field(1e-10, gt=0, lt=0.1)
    """relative, of cost, step and gradient"""
    batch: CountOrAuto = "auto"
    """fits computed together, at most. `auto`: 128, on a GPU 1,024, or what memory allows; on a CPU
    fewer of long curves; one with `skeleton = "sections"` on a CPU
    """
    save_every: CountOrAuto = "auto"
    """fits saved together"""
    precision: Literal["float64", "float32"] = "float64"
    """of all numbers of the fit"""
    population: bool | None = None
    """mean and spread over specimens; none: with five or more"""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, data: Any) -> Any:
        if isinstance(data, dict) and "chunk" in data:
            raise ValueError("chunk: this key is called 'batch' now; rename it")
        return data


class UncertaintySection(Section):
    """[uncertainty]: what is done beyond the local standard errors (docs/read_a_fit.md)."""

    profile: Texts = []
    """parameters to profile; `"all"`: every fitted one"""
    profile_points: int = Field(10, ge=2, le=1000)
    """points on each side of the estimate"""
    bootstrap: int = Field(0, ge=0, le=1_000_000)
    """replicates of each fit, 40 or more; 0: none"""
    kind: Literal["parametric", "residual"] = "parametric"
    """`parametric`: normal noise; `residual`: residuals drawn anew"""
    block: int = Field(1, ge=1, le=1_000_000)
    """neighbouring residuals drawn together (`residual`)"""
    influence: bool = False
    """which samples and curves the estimates hang on"""
    posterior: int = Field(0, ge=0, le=1_000_000)
    """draws of each chain (NUTS), 100 or more; 0: none"""
    posterior_chains: int = Field(4, ge=2, le=1000)
    """chains of each fit"""

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
    """`[first, last]` position within reach; none: first to last ring, as far as all of the tool
    lies on the tube
    """
    depth: tuple[PositiveLength, PositiveLength] | None = Field(None, strict=False)
    """`[least, largest]` displacement from first touch, at most the tube's radius; none: half to
    all of the largest measured
    """
    points: int = Field(3, ge=1, le=100)
    """presses to choose, one after the other"""
    criterion: Literal["D", "A", "E"] = "D"
    """what is made small: volume (`D`), mean (`A`) or largest axis (`E`) of the error ellipsoid"""
    candidates: int | None = Field(None, ge=5, le=10_000_000)
    """presses to choose from, at five depths, on all specimens; none: 10,000, with sections 250"""
    phi: tuple[Angle, ...] | None = Field(None, strict=False, min_length=1)
    """angles of the presses, each at every position and depth (`["0 deg", "60 deg"]`); none: those
    measured. Sections alone
    """
    speed: tuple[Speed, ...] | None = Field(None, strict=False, min_length=1)
    """speeds of the tool (`["1 mm/s", "5 mm/s"]`), where the force relaxes; none: the slowest and
    the fastest measured
    """
    hold: tuple[Duration, ...] | None = Field(None, strict=False, min_length=1)
    """how long the tool then stays (`["0 s", "30 s"]`), each with every speed; none: the longest
    measured
    """

    @model_validator(mode="after")
    def _ordered(self) -> "DesignSection":
        for name, span in (("s", self.s), ("depth", self.depth)):
            if span is not None and span[0] > span[1]:
                raise ValueError(f"{name} runs from {span[0]:g} down to {span[1]:g} mm; swap them")
        return self


class FitOutputSection(Section):
    """[output]: what is written."""

    format: Literal["png", "svg"] = "png"
    """of the pictures; `svg`: lines and text that can be enlarged and edited"""


class FitSpec(Section):
    """A whole fit specification."""

    title: str = ""
    """heading of the report"""
    data: DataSection
    """files and how to read them"""
    trachea: TracheaSection = TracheaSection()
    """the tube at rest"""
    model: ModelSection = ModelSection()
    """what the model includes"""
    wall: WallSection | None = None
    """moduli and thicknesses that `sections` begins with"""
    parameters: dict[str, ParameterSection] = {}
    """a table for each parameter that is named"""
    noise: NoiseSection = NoiseSection()
    """standard deviations"""
    fit: FitSection = Field(default_factory=lambda: FitSection.model_validate({}))
    """weights and solver"""
    uncertainty: UncertaintySection = Field(
        default_factory=lambda: UncertaintySection.model_validate({})
    )
    """what is done beyond local standard errors"""
    design: DesignSection = Field(default_factory=lambda: DesignSection.model_validate({}))
    """for `jaxtrachea design`"""
    output: FitOutputSection = Field(default_factory=lambda: FitOutputSection.model_validate({}))
    """what is written"""


def load_fit_spec(path: Path) -> FitSpec:
    """Read and validate a fit specification.

    Raises:
        SpecError: missing file, broken TOML (line and column), unknown key, wrong value; one line
            per problem with its dotted key.
    """
    scene = "a scene (commands plan, simulate, sweep)"
    others = {"path": scene, "material": scene}
    return load_spec(path, FitSpec, "fit specification", others)
