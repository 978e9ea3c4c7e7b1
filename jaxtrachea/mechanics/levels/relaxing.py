"""A level whose force relaxes: any other level, and a filter of its force by the time.

If all parts of the organ relax alike, its shape is the elastic one at every instant and the force
is that of `mechanics.relaxation`. Parameters of the level within are those that last.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.admission import has_solution
from jaxtrachea.mechanics.levels.level import Closed, Level, Motion, Record, Response, Size
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press_in_time import press_in_time
from jaxtrachea.mechanics.relaxation import Relaxation, relax
from jaxtrachea.mechanics.relaxation_laws import names, relaxation
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import OF_TIME


class Lasting(NamedTuple):
    """Values of a level that relaxes: of the level within, which last, and what relaxes."""

    elastic: Any
    relaxation: Relaxation


def _of_within(name: str) -> Any:
    """An attribute that the level within has."""
    return property(lambda self: getattr(self.within, name))


@dataclasses.dataclass(frozen=True)
class Relaxing(Level):
    """A level whose force relaxes.

    Attributes:
        within: the elastic level.
        options: that asked for it.
    """

    within: Level
    options: Options

    observes = _of_within("observes")
    material_type = _of_within("material_type")
    iterates = _of_within("iterates")
    roundings = _of_within("roundings")
    reads_wall = _of_within("reads_wall")
    follows_axial = _of_within("follows_axial")
    hangs_on_rings = _of_within("hangs_on_rings")
    hides_refused = _of_within("hides_refused")
    stepwise = _of_within("stepwise")
    name = _of_within("name")
    tested = _of_within("tested")
    tested_angle = _of_within("tested_angle")
    deepest = _of_within("deepest")
    wall_radius = _of_within("wall_radius")
    thickness = _of_within("thickness")
    check = _of_within("check")
    without_negative = _of_within("without_negative")

    @property
    def declares(self) -> Any:
        """With the strengths and times of the branches."""
        return {**self.within.declares, **OF_TIME}

    @property
    def closed(self) -> Closed | None:
        """Of the elastic level."""
        return self.within.closed

    @property
    def forward(self) -> bool:
        """Where parts relax apart, every sample is an equilibrium with a past."""
        return self.options.relaxation == "parts" or self.within.forward

    @property
    def parts(self) -> tuple[str, ...]:
        """And the law of relaxation."""
        return (*self.within.parts, f"relaxing ({self.options.branches})")

    def needs(self, *, joints: bool) -> frozenset[str]:
        """And the numbers of the law."""
        return self.within.needs(joints=joints) | frozenset(self.numbers)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers of its relaxation."""
        return names(self.options.branches, parts=self.options.relaxation == "parts")

    def admits(self, curve: Record, size: Size, onset: float = 0.0) -> InputError | None:
        """As the level within, and by a time that runs."""
        cure = (
            "name its column ([data] columns, time = ...) and take loading = 'record', or "
            "relaxation = 'off'"
        )
        if curve.time is None:
            return InputError("no time, which a force that relaxes is a function of", cure=cure)
        if np.any(np.diff(curve.time) < 0) or not curve.time[-1] > curve.time[0]:
            return InputError("its time does not run from the first sample to the last", cure=cure)
        return self.within.admits(curve, size, onset)

    def material(self, values: Mapping[str, Array]) -> Lasting:
        """Values by name."""
        return Lasting(self.within.material(values), self.relaxation(values))

    def relaxation(self, values: Mapping[str, Array]) -> Relaxation:
        """See `relaxation_laws.relaxation`."""
        word, parts = self.options.branches, self.options.relaxation == "parts"
        return relaxation(word, values, self.options.span, parts=parts)

    def response(self, tube: Geometry, material: Lasting, motion: Motion) -> Response:
        """Of a line `press_in_time`, else the elastic force of the level within, which relaxes.

        Raises:
            ValueError: no time.
        """
        if motion.time is None:
            raise ValueError("motion.time is None; a force that relaxes needs the time")
        if self.within.closed is not None:
            found = press_in_time(
                tube, material.elastic, motion.s_c, motion.time, motion.displacement,
                material.relaxation, self.options, onset=motion.onset, blend=motion.blend,
            )  # fmt: skip
            return Response(found.force, found.joints, found.status, reactions=found.reactions)
        found, local = (
            self.within.response(tube, material.elastic, motion),
            material.relaxation.local,
        )
        unilateral = self.options.contact == "unilateral"
        force = relax(motion.time, found.force, local, unilateral).force
        side = found.side_force
        if side is not None:
            side = relax(motion.time, side, local, False).force
        lost = has_solution(found.status) & ~jnp.isfinite(force)  # after one without a solution
        status = jnp.where(lost, PressStatus.NON_FINITE, found.status).astype(found.status.dtype)
        return found._replace(force=force, side_force=side, status=status)
