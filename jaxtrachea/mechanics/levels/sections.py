"""The level of deforming cross-sections: anywhere on the rings, at finite strain, tool stuck."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea._errors import InputError
from jaxtrachea._numerics import full_precision
from jaxtrachea.mechanics.levels.level import Level, Motion, Record, Response, Size
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.sections.material import SECTION_VALUES, SectionMaterial, check_sections
from jaxtrachea.mechanics.sections.press import (
    SectionOptions,
    press_sections,
    safe_values,
    validated_angle,
)
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import OF_PRESS

#: Depth to which it was compared with finite elements, in radii (docs/evidence/off_midline.md).
VALIDATED_DEPTH = 0.5


@dataclasses.dataclass(frozen=True)
class Sections(Level):
    """A wall of cross-sections that deform; see `sections.press.press_sections`.

    Attributes:
        options: `Options` leaves no choice here.
    """

    options: Options
    observes: ClassVar = frozenset({"force", "side_force", "joints", "joint_side", "ends"})
    declares: ClassVar = SECTION_VALUES
    material_type: ClassVar = SectionMaterial
    iterates: ClassVar = True
    roundings: ClassVar = 100.0
    reads_wall: ClassVar = True
    follows_axial: ClassVar = False
    hangs_on_rings: ClassVar = False
    hides_refused: ClassVar = True
    stepwise: ClassVar = False

    @property
    def name(self) -> str:
        """`sections`."""
        return self.options.skeleton

    @property
    def validated_depth(self) -> float:
        """See `VALIDATED_DEPTH`."""
        return VALIDATED_DEPTH

    def validated_angle(self, half_angle: float) -> float:
        """See `press.validated_angle`, with what rounding takes."""
        return float(validated_angle(half_angle)) + 1e-6

    def deepest(self, radius: float) -> float:
        """The tube has no more room than its radius."""
        return radius

    @classmethod
    def wall_radius(cls, tube: Geometry, outer: Any) -> Any:
        """That of the wall's mid-line."""
        return tube.radius

    @classmethod
    def thickness(cls, material: SectionMaterial) -> Any:
        """Twice the distance of its outside from its mid-line."""
        return 2 * material.offset

    @classmethod
    def check(cls, tube: Geometry, material: SectionMaterial) -> None:
        """See `check_sections`."""
        check_sections(tube, material)

    def without_negative(
        self, material: SectionMaterial, also: Iterable[str]
    ) -> tuple[SectionMaterial, Bool[Array, ""]]:
        """The material as it is: a press sees to its own values."""
        return material, safe_values(material)[1]

    def needs(self, *, joints: bool) -> frozenset[str]:
        """Whatever there is to see."""
        return frozenset(SECTION_VALUES) | (frozenset(OF_PRESS) - {"force_slope"})

    def admits(self, curve: Record, size: Size, onset: float = 0.0) -> InputError | None:
        """On the cartilage, within the tested angle, and no deeper than the radius."""
        at = f"contact at phi = {np.degrees(curve.phi_c):.3g} deg, expected"
        if not abs(curve.phi_c) <= size.half_angle:
            return InputError(
                f"{at} on the cartilage, within {np.degrees(size.half_angle):.3g} deg of the "
                "midline"
            )
        if not abs(curve.phi_c) <= (most := self.validated_angle(size.half_angle)):
            return InputError(
                f"{at} within {np.degrees(most):.3g} deg of the midline: nearer to the ends of the "
                "rings deforming cross-sections are too stiff",
                cure="leave the curve out",
            )
        if (deepest := float(np.max(np.abs(curve.displacement - onset)))) > size.radius:
            return InputError(
                f"pressed {deepest:.3g} mm deep, expected no more than the radius, "
                f"{size.radius:g} mm",
                cure="cut the curve off (displacement_max) or leave it out",
            )
        return None

    def material(self, values: Mapping[str, Array]) -> SectionMaterial:
        """Results of a fit made before a parameter was there have its default in its place."""
        names = [f.name for f in dataclasses.fields(SectionMaterial) if f.name in values]
        return SectionMaterial(**{name: values[name] for name in names})

    @full_precision
    def response(self, tube: Geometry, material: SectionMaterial, motion: Motion) -> Response:
        """See `press_sections`; the program is that of the midline where no angle is given."""
        dtype = motion.displacement.dtype
        plain = motion.phi_c is None or motion.direction is None
        phi_c = jnp.zeros_like(motion.s_c) if motion.phi_c is None else motion.phi_c
        along = jnp.asarray([1.0, 0.0], dtype) if motion.direction is None else motion.direction
        D = motion.displacement
        moved = D if motion.onset is None else D - motion.onset
        options = SectionOptions(plain, self.options.half_width)
        pressed = press_sections(tube, material, motion.s_c, phi_c, moved, along, options=options)
        frame = local_frame(phi_c)[::2]  # inward normal, circumference
        force, joints = pressed.force @ frame.T, pressed.joints @ frame.T
        across: Float[Array, 2] = jnp.stack([-along[1], along[0]])
        return Response(
            force=force @ along,
            joints=joints[..., 0],
            status=pressed.status,
            side_force=force @ across,
            joint_side=joints[..., 1],
            ends=jnp.stack([pressed.end_U[..., 1:], pressed.end_V[..., 1:]], axis=2),
        )
