"""A level whose force relaxes: any other level, and a filter of its force by the time.

If all parts of the organ relax alike, its shape is the elastic one at every instant and the force
is that of `mechanics.relaxation`. Parameters of the level within are those that last.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.admission import has_solution
from jaxtrachea.mechanics.levels.level import Closed, Level, Motion, Record, Response, Size
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.relaxation import Branches, Relaxed, relax
from jaxtrachea.mechanics.relaxation_laws import LAWS, Span, branches
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import OF_TIME

#: Times that branches reach over where no records are known, s.
ANY_SPAN = Span(1e-4, 1e5)


class Relaxing(NamedTuple):
    """Values of a level that relaxes: of the level within, and the branches."""

    elastic: Any
    branches: Branches


def _of_within(name: str) -> Any:
    """An attribute that the level within has."""
    return property(lambda self: getattr(self.within, name))


@dataclasses.dataclass(frozen=True)
class Relaxation(Level):
    """A level whose force relaxes.

    Attributes:
        within: the elastic level.
        options: that asked for it.
        span: times of the records, s (static).
    """

    within: Level
    options: Options
    span: Span = ANY_SPAN

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
    def parts(self) -> tuple[str, ...]:
        """And the law of relaxation."""
        return (*self.within.parts, f"relaxing ({self.options.branches})")

    def needs(self, *, joints: bool) -> frozenset[str]:
        """And the numbers of the law."""
        return self.within.needs(joints=joints) | frozenset(LAWS[self.options.branches].names)

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

    def material(self, values: Mapping[str, Array]) -> Relaxing:
        """Values by name."""
        return Relaxing(self.within.material(values), self.branches(values))

    def branches(self, values: Mapping[str, Array]) -> Branches:
        """See `relaxation_laws.branches`."""
        return branches(self.options.branches, values, self.span)

    @property
    def unilateral(self) -> bool:
        """Whether the tool lets go."""
        return self.options.contact == "unilateral"

    def response(self, tube: Geometry, material: Relaxing, motion: Motion) -> Response:
        """See `relax`; the rings follow the shape, what they bear the force.

        Raises:
            ValueError: no time.
        """
        if motion.time is None:
            raise ValueError("motion.time is None; a force that relaxes needs the time")
        found = self.within.response(tube, material.elastic, motion)
        relaxed = relax(motion.time, found.force, material.branches, self.unilateral)
        side = found.side_force
        if side is not None:
            side = relax(motion.time, side, material.branches, False).force
        lost = has_solution(found.status) & ~jnp.isfinite(relaxed.force)
        status = jnp.where(lost, PressStatus.NON_FINITE, found.status)
        joints, reactions = found.joints, found.reactions
        if self.unilateral:
            left = left_behind(found.force, relaxed)
            joints = jnp.where(
                left[:, None], _per_force(found.force, joints, relaxed.elastic), joints
            )
        if reactions is not None:
            reactions = _per_force(found.force, reactions, relaxed.force)
        return found._replace(
            force=relaxed.force, side_force=side, joints=joints, reactions=reactions,
            status=status.astype(found.status.dtype),
        )  # fmt: skip


def left_behind(elastic: Float[Array, " N"], relaxed: Relaxed) -> Bool[Array, " N"]:
    """Where the tool has left the surface, which recovers by itself."""
    return relaxed.elastic != elastic


def _per_force(elastic, v, force):
    """What goes with a force, as it went with the largest elastic one."""
    at = jnp.argmax(jnp.abs(elastic))
    unit = v[at] / jnp.where(elastic[at] == 0, 1, elastic[at])
    return force[:, None] * unit[None]
