"""A level whose force relaxes in time: it wraps any other."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxtrachea._arguments import check_word, real
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.levels.level import Closed, Level, Motion, Record, Response, Size
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.relaxation import laws as relaxation_laws
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.relaxation.steps import Branches
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import OF_TIME


class RelaxingMaterial(eqx.Module):
    """A material whose force relaxes.

    Attributes:
        material: values in the long run.
        relaxation: the branches beside them.
    """

    material: Any
    relaxation: Relaxation = eqx.field(converter=lambda given: _as_arrays(given))


def _as_arrays(given: Relaxation) -> Relaxation:
    """Branches of numbers, lists or arrays."""
    check_word("relaxation", given, Relaxation)

    def arrays(name: str, part: Branches) -> Branches:
        gamma, tau = (real(f"{name}.{of}", v) for of, v in zip(part._fields, part, strict=True))
        if gamma.ndim != 1 or gamma.shape != tau.shape or not gamma.shape[0]:
            raise ValueError(
                f"{name}: gamma has the shape {gamma.shape}, tau {tau.shape}; expected (B,) both"
            )
        return Branches(gamma, tau)

    skeleton = given.skeleton
    if skeleton is not None:
        skeleton = arrays("relaxation.skeleton", skeleton)
    return Relaxation(arrays("relaxation.local", given.local), skeleton)


def long_run(material: Any) -> Any:
    """The values in the long run, of a material that relaxes as of any other."""
    return material.material if isinstance(material, RelaxingMaterial) else material


def _of_inner(name: str) -> Any:
    return property(lambda self: getattr(self.inner, name))


@dataclasses.dataclass(frozen=True)
class Relaxing(Level):
    """The level within, its values those of the long run; see `relaxation.filter`.

    Attributes:
        inner: the level within.
        options: how it relaxes, and by which law.
    """

    inner: Level
    options: Options
    relaxes: ClassVar = True
    material_type = _of_inner("material_type")
    observes = _of_inner("observes")
    iterates = _of_inner("iterates")
    roundings = _of_inner("roundings")
    reads_wall = _of_inner("reads_wall")
    follows_axial = _of_inner("follows_axial")
    hangs_on_rings = _of_inner("hangs_on_rings")
    hides_refused = _of_inner("hides_refused")
    stepwise = _of_inner("stepwise")
    name = _of_inner("name")
    validated_depth = _of_inner("validated_depth")
    validated_angle = _of_inner("validated_angle")
    deepest = _of_inner("deepest")
    wall_radius = _of_inner("wall_radius")
    thickness = _of_inner("thickness")
    check = _of_inner("check")
    without_negative = _of_inner("without_negative")

    @property
    def declares(self):
        """Those of the level within, and the numbers of the law."""
        return self.inner.declares | {name: OF_TIME[name] for name in self.of_time}

    @property
    def of_time(self) -> tuple[str, ...]:
        """Names of the numbers of the law."""
        o = self.options
        return relaxation_laws.names(o.branches, parts=o.relaxation == "parts")

    @property
    def parts(self) -> tuple[str, ...]:
        """What relaxes, and the law."""
        return (*self.inner.parts, f"relaxing ({self.options.relaxation}, {self.options.branches})")

    def needs(self, *, joints: bool) -> frozenset[str]:
        """What the level within needs, and the numbers of the law."""
        return self.inner.needs(joints=joints) | frozenset(self.of_time)

    def admits(self, curve: Record, size: Size, onset: float = 0.0) -> InputError | None:
        """A curve with its time, that the level within presses."""
        if curve.time is None:
            return InputError(
                "it has no time, and a force that relaxes follows from it",
                cure="name its column ([data] columns, time = ...) and take loading = 'record', or "
                "relaxation = 'off'",
            )
        if np.any(np.diff(curve.time) < 0) or not curve.time[-1] > curve.time[0]:
            return InputError(
                "its time does not run from the first sample to the last",
                cure="take loading = 'record', or relaxation = 'off'",
            )
        return self.inner.admits(curve, size, onset)

    @property
    def closed(self) -> Closed | None:
        """Of the level within, elastic."""
        elastic = dataclasses.replace(self.options, relaxation="off")
        return dataclasses.replace(self.inner, options=elastic).closed  # type: ignore[call-arg]

    @property
    def forward(self) -> bool:
        """Where parts relax apart, every sample is an equilibrium with a past."""
        return self.options.relaxation == "parts" or self.inner.forward

    def material(self, values: Mapping[str, Array]) -> RelaxingMaterial:
        """Values of the level within, and the branches."""
        return RelaxingMaterial(self.inner.material(values), self.relaxation(values))

    def relaxation(self, values: Mapping[str, Array]) -> Relaxation:
        """See `relaxation_laws.relaxation`."""
        o = self.options
        parts = o.relaxation == "parts"
        return relaxation_laws.relaxation(o.branches, values, o.span, parts=parts)

    def response(self, tube: Geometry, material: RelaxingMaterial, motion: Motion) -> Response:
        """Press in time.

        Raises:
            ValueError: a motion without time.
        """
        if motion.time is None:
            raise ValueError("the motion has no time, and options.relaxation is not 'off'")
        return self.inner.relaxed(tube, material.material, motion, material.relaxation)
