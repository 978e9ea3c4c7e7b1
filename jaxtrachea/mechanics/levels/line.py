"""The beam levels: a line of joints on the rings, with softening, width and shear as its parts."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea._errors import InputError
from jaxtrachea.mechanics import press as _press
from jaxtrachea.mechanics.equilibrium import Equilibrium
from jaxtrachea.mechanics.levels.level import Level, Motion, Record, Response, Size
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press_in_time import press_in_time
from jaxtrachea.mechanics.validation import IN_TWO_PLANES, check_shapes, without_negative
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import DEEP, OF_PRESS, VALUES, Material, material_of

#: Depth to which a skeleton was compared with finite elements, in radii of the tube
#: (docs/evidence/virtual_trachea.md). At a tenth that specimen yields 13 % more than a linear
#: skeleton; the others were pressed to half.
VALIDATED_DEPTH = {"linear": 0.1, "softening": 0.5}
#: Parameters of the beam; all others of a line act at the contact.
OF_BEAM = tuple(
    name for name, p in VALUES.items()
    if p.fit is not None and p.part == "skeleton" and p.needs in ("", "shear")
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Line(Level):
    """The ligament as a beam on springs, pressed on the midline along the normal.

    Attributes:
        options: its parts, the local law and the contact.
    """

    options: Options
    observes: ClassVar = frozenset({"force", "joints"})
    declares: ClassVar = VALUES
    material_type: ClassVar = Material

    @property
    def name(self) -> str:
        """`linear` or `softening`."""
        return self.options.skeleton

    @property
    def validated_depth(self) -> float:
        """See `VALIDATED_DEPTH`; without limit where the force knows no skeleton."""
        return np.inf if self.options.coupling == "total" else VALIDATED_DEPTH[self.name]

    @property
    def closed(self) -> "Line":
        """Itself."""
        return self

    @property
    def parts(self) -> tuple[str, ...]:
        """Whether it shears."""
        return ("with shear" if self.options.shear else "without shear",)

    def needs(self, *, joints: bool) -> frozenset[str]:
        """With coupling `total` and no markers the skeleton does not enter.

        Force-displacement curves then see the local law alone.
        """
        o = self.options
        has = {"": True, "shear": o.shear, "two-material": o.local == "two-material",
               "softening": o.skeleton == "softening"}  # fmt: skip
        names = {n for n, p in (VALUES | OF_PRESS).items() if p.fit and has.get(p.needs, False)}
        if o.coupling == "total" and not joints:
            names -= set(OF_BEAM)
        if o.contact == "bonded":  # no record of it has air, where alone a line shows
            names -= {"force_slope"}
        return frozenset(names)

    def admits(self, curve: Record, size: Size, onset: float = 0.0) -> InputError | None:
        """All of the tool on the tube, on the midline and along the normal."""
        if curve.s_c is not None:
            low, high = self.options.places(size.length)
            if not low <= curve.s_c <= high:
                return self._off_the_end(curve.s_c, size.length)
        cure = "choose skeleton = 'sections' and contact = 'bonded', or leave the curve out"
        if self.options.coupling == "series" and abs(curve.phi_c) > 1e-6:
            return InputError(
                f"contact at phi = {np.degrees(curve.phi_c):.3g} deg; this model presses on the "
                "anterior midline (phi = 0) only",
                cure=cure,
            )
        if abs(curve.direction[1]) > 1e-6:
            shown = ", ".join(f"{v:.4g}" for v in curve.direction)
            return InputError(
                f"the tool moves in the direction ({shown}); this model presses along the inward "
                "normal (1, 0) only",
                cure=cure,
            )
        return None

    def _off_the_end(self, s_c: float, length: float) -> InputError:
        low, high = self.options.places(length)
        expected = f"s from {low:g} to {high:g} mm"
        if low > high:
            expected = f"a tool no wider than the tube is long, {length:g} mm"
        return InputError(
            f"contact at s = {s_c:g} mm, where a tool of half_width {self.options.half_width:g} mm "
            "reaches beyond an end of the tube",
            expected=expected,
            cure="leave the curve out, or make half_width smaller (0: the tool touches at a point)",
        )

    def material(self, values: Mapping[str, Array]) -> Material:
        """1 stands for a skeleton that is not part of the model."""
        one = jnp.ones((), values["onset"].dtype)
        return material_of({"EI_L": one, "k_M": one} | dict(values))

    def response(self, tube: Geometry, material: Material, motion: Motion) -> Response:
        """See `press.press`; angle and direction of the motion are not read."""
        found = _press.press(
            tube, material, motion.s_c, motion.displacement, self.options,
            onset=motion.onset, blend=motion.blend,
        )  # fmt: skip
        return Response(found.force, found.joints, found.status, reactions=found.reactions)

    @classmethod
    def check(cls, tube: Geometry, material: Material) -> None:
        """See `Level`; half of what a skeleton softens by is refused, too."""
        check_shapes(tube, material)
        given = {name: getattr(material, name) is not None for name in DEEP}
        if any(given.values()) and not all(given.values()):
            one, other = sorted(DEEP, key=given.__getitem__, reverse=True)
            raise InputError(
                f"given without Material.{other}, and would be ignored", key=f"Material.{one}",
                cure=f"give Material.{other} too (0 where the law has no such part), or leave it "
                "out",
            )  # fmt: skip

    def without_negative(
        self, material: Material, also: Iterable[str]
    ) -> tuple[Material, Bool[Array, ""]]:
        """1 in the place of negative values; others that the options do not read stay."""
        read, also = _press.read_values(self.options), tuple(also)
        divided = [name for name in IN_TWO_PLANES if name in also]
        return without_negative(material, dict.fromkeys((*read, *also)), divided)

    def relaxed(
        self, tube: Geometry, material: Material, motion: Motion, relaxation: Relaxation
    ) -> Response:
        """See `press_in_time`: a unilateral contact lets go."""
        motion = motion._replace(phi_c=None, direction=None)
        found = press_in_time(tube, material, motion, relaxation, self.options)
        return Response(found.force, found.joints, found.status, reactions=found.reactions)

    def skeleton(
        self, tube: Geometry, material: Material, s_c: Float[Array, "*m"], *, joints: bool
    ) -> tuple[Float[Array, "*m"], Float[Array, "*m rings"] | None]:
        """See `Closed`; with `joints` at one position."""
        if not joints:
            return _press.compliance(tube, material, s_c, self.options), None
        beam = _press.ligament_beam(tube, material, self.options)
        unit = _press.unit_deflection(beam, s_c, self.options)
        return unit.w_C, unit.w

    def contact(
        self, tube: Geometry, material: Material, s_c: Any, onset: Any, blend: Any = None
    ) -> _press.Contact:
        """See `Closed`."""
        law = _press.local_law(tube, material, s_c, self.options)
        return _press.Contact(law, onset, blend, _press.softening_of(material, self.options))

    def felt(self, compliance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """None with the paper's total coupling."""
        return compliance if self.options.coupling == "series" else jnp.zeros_like(compliance)

    def indentation(self, displacement: Any, onset: Any, blend: Any = None) -> Any:
        """See `press.touch`."""
        return _press.indentation(displacement, onset, self.options, blend)

    def respond(self, displacement: Any, compliance: Any, contact: _press.Contact) -> Equilibrium:
        """See `press.respond`."""
        return _press.respond(displacement, compliance, contact, self.options)
