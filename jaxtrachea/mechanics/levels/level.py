"""What a level of the mechanics answers; who fits, predicts or designs asks nothing else.

A level holds no arrays: it is compared and hashed by value, and selects the program. Values of
parameters, tube and motion are arguments.
"""

import abc
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.press import Contact
from jaxtrachea.mechanics.samples import as_before, in_order, no_history
from jaxtrachea.relaxation.filter import Relaxation, relax
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Declaration


class Motion(NamedTuple):
    """Where the tool presses, and how it moves; N displacements.

    Attributes:
        s_c: contact position, mm.
        displacement: as recorded, mm.
        onset: displacement at first touch, mm.
        blend: rounded corner of a curve whose onset was fitted, mm; None: that of the options.
        phi_c: contact angle, rad; None, as `direction`: on the midline, along the normal.
        direction: of the tool, along the inward normal and the circumference.
        time: of every displacement, s; None: no level that relaxes.
    """

    s_c: Float[Array, ""]
    displacement: Float[Array, " N"]
    onset: Float[Array, ""] | None = None
    blend: Float[Array, ""] | None = None
    phi_c: Float[Array, ""] | None = None
    direction: Float[Array, "2"] | None = None
    time: Float[Array, " N"] | None = None


class Response(NamedTuple):
    """What can be observed of a press; None: the level has no such thing.

    Attributes:
        force: contact force along the tool's direction, N.
        joints: of every ring at the contact's angle along the inward normal, mm.
        status: a `PressStatus` of each displacement.
        side_force: along the tool's direction turned by 90 degrees, N.
        joint_side: of every ring along the circumference, mm.
        ends: of every ring's ends U and V, each y and z, mm.
        reactions: force of each ring against the load, N.
    """

    force: Float[Array, " N"]
    joints: Float[Array, "N rings"]
    status: Int[Array, " N"]
    side_force: Float[Array, " N"] | None = None
    joint_side: Float[Array, "N rings"] | None = None
    ends: Float[Array, "N rings 2 2"] | None = None
    reactions: Float[Array, "N rings"] | None = None


class Size(NamedTuple):
    """What a press must keep to of a tube, in plain numbers: many curves are held against it.

    Attributes:
        length: mm.
        radius: mm.
        half_angle: half opening of the C-rings, rad.
        rings: how many there are.
    """

    length: float
    radius: float
    half_angle: float
    rings: int

    @classmethod
    def of(cls, geometry: Geometry) -> "Size":
        """The size of a tube."""
        length, radius, angle = map(float, (geometry.length, geometry.radius, geometry.half_angle))
        return cls(length, radius, angle, geometry.rings)


@runtime_checkable
class Record(Protocol):
    """What a level reads of a measured curve, see `measurements.Curve`."""

    @property
    def s_c(self) -> float | None: ...  # noqa: D102
    @property
    def phi_c(self) -> float: ...  # noqa: D102
    @property
    def direction(self) -> Any: ...  # noqa: D102
    @property
    def displacement(self) -> np.ndarray: ...  # noqa: D102
    @property
    def time(self) -> np.ndarray | None: ...  # noqa: D102


@runtime_checkable
class Closed(Protocol):
    """A press through few numbers, with derivatives in closed form.

    The skeleton enters by its compliance at the contact alone, so that a fit differentiates it once
    for each position, and not for each sample.
    """

    def material(self, values: Mapping[str, Array]) -> Any:
        """Values by name as its record."""
        ...

    def skeleton(
        self, tube: Geometry, material: Any, s_c: Float[Array, "*m"], *, joints: bool
    ) -> tuple[Float[Array, "*m"], Float[Array, "*m rings"] | None]:
        """Motion of C under a unit force there, mm/N, and of every ring if `joints`."""
        ...

    def contact(
        self, tube: Geometry, material: Any, s_c: Any, onset: Any, blend: Any = None
    ) -> Contact:
        """What the force at a position depends on, beside the compliance."""
        ...

    def felt(self, compliance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Compliance that the contact force depends on."""
        ...

    def indentation(self, displacement: Any, onset: Any, blend: Any = None) -> Any:
        """Displacement after first touch, mm."""
        ...

    def respond(self, displacement: Any, compliance: Any, contact: Contact) -> Any:
        """The `Equilibrium` of a press; its derivatives are `equilibrium.sensitivity`."""
        ...


class Level(abc.ABC):
    """A level of the mechanics.

    Attributes:
        observes: fields of a `Response` that are measured.
        declares: declarations of the parameters that it has, by name.
        material_type: record of its values.
        iterates: an equilibrium is a path of Newton steps, not a formula: its programs are long to
            compile, and lanes side by side wait for the slowest.
        roundings: error of a computed force, in roundings of it.
        reads_wall: initial values follow from moduli and thicknesses of a wall.
        follows_axial: the skeleton can move along the tube.
        hangs_on_rings: a surface is bound to the rings; else to the wall of the level itself.
        hides_refused: it computes refused rows safely by itself.
        stepwise: a session can step it.
        relaxes: its force relaxes: motions and records have their time.
    """

    observes: ClassVar[frozenset[str]]
    declares: ClassVar[dict[str, Declaration]]
    material_type: ClassVar[type]
    iterates: ClassVar[bool] = False
    roundings: ClassVar[float] = 10.0
    reads_wall: ClassVar[bool] = False
    follows_axial: ClassVar[bool] = True
    hangs_on_rings: ClassVar[bool] = True
    hides_refused: ClassVar[bool] = False
    stepwise: ClassVar[bool] = True
    relaxes: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Word of the options."""

    @property
    @abc.abstractmethod
    def validated_depth(self) -> float:
        """Depth to which it was compared with finite elements, in radii of the tube."""

    @property
    def closed(self) -> Closed | None:
        """Its closed form; None: it is differentiated as it stands, in forward mode."""
        return None

    @property
    def forward(self) -> bool:
        """Whether its press is differentiated as it stands, in forward mode."""
        return self.closed is None

    @property
    def off_midline(self) -> bool:
        """Whether it presses at any angle on the rings, and across the tube."""
        return "side_force" in self.observes

    @property
    def parts(self) -> tuple[str, ...]:
        """What of it the options chose, in words."""
        return ()

    def relaxation(self, values: Mapping[str, Array]) -> Relaxation | None:
        """How its force relaxes; None: it does not."""
        return None

    def validated_angle(self, half_angle: float) -> float:
        """Angle from the midline to which it was tested, rad; 0: it presses there alone."""
        return 0.0

    def deepest(self, radius: float) -> float:
        """Depth beyond which it has no meaning, mm."""
        return np.inf

    @classmethod
    def wall_radius(cls, tube: Geometry, outer: Any) -> Any:
        """Radius that the depth of a press is measured by, mm; `outer`: of the tube's outside."""
        return outer

    @classmethod
    def thickness(cls, material: Any) -> Any:
        """Of the wall that the material itself has, mm; None: it has none."""
        return None

    @classmethod
    @abc.abstractmethod
    def check(cls, tube: Geometry, material: Any) -> None:
        """Refuse arrays of a wrong length, and values that mean nothing without another.

        Raises:
            ValueError: naming the value, what was expected and the cure.
        """

    @abc.abstractmethod
    def without_negative(self, material: Any, also: Iterable[str]) -> tuple[Any, Bool[Array, ""]]:
        """Values that it can compute with, and whether a negative one was read."""

    @abc.abstractmethod
    def needs(self, *, joints: bool) -> frozenset[str]:
        """Names of the parameters that it reads; `joints`: whether rings are observed."""

    @abc.abstractmethod
    def admits(self, curve: Record, size: Size, onset: float = 0.0) -> InputError | None:
        """Why it cannot press a curve on the tube; None: it can.

        Args:
            size: of the tube.
            onset: displacement at first touch, mm: held there, or the first guess.
        """

    @abc.abstractmethod
    def material(self, values: Mapping[str, Array]) -> Any:
        """Values by name as its record; names that it does not have are passed over."""

    @abc.abstractmethod
    def response(self, tube: Geometry, material: Any, motion: Motion) -> Response:
        """Press; pure, of one example."""

    def relaxed(
        self, tube: Geometry, material: Any, motion: Motion, relaxation: Relaxation
    ) -> Response:
        """Press in time: what `levels.relaxing` wraps.

        Of a tool that sticks to the wall; all of the organ relaxes alike, in its elastic shape.
        """
        assert motion.time is not None
        time, order = in_order(motion.time, motion.displacement)
        found = self.response(tube, material, motion)
        skipped, status = order != PressStatus.OK, found.status
        lost, status = no_history(status, skipped)
        hidden = lost | skipped

        def filtered(force):
            if force is None:
                return None
            safe = as_before(jnp.where(lost, 0, force), skipped)
            relaxed = relax(time, safe, relaxation.local, unilateral=False).force
            return jnp.where(hidden, jnp.nan, relaxed)

        return found._replace(
            force=filtered(found.force), side_force=filtered(found.side_force),
            status=jnp.where(skipped, order, status).astype(jnp.int8),
        )  # fmt: skip
