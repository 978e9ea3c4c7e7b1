"""The forward model: the only place that knows the order of the rooms."""

import dataclasses
import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, check_record, check_word, real, shaped
from jaxtrachea._numerics import centred_hinge, positive_part, scaled
from jaxtrachea.mechanics import beam as _beam
from jaxtrachea.mechanics import equilibrium, force_law, punch
from jaxtrachea.mechanics.admission import (
    admit,
    check_place,
    check_shapes,
    float_type,
    hide,
    status_of,
)
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


@dataclasses.dataclass(frozen=True)
class Options:
    """What the model includes; static, it selects the program that is compiled.

    Attributes:
        coupling: `series` (tool displacement = local indentation + skeleton deflection) or `total`
            (as printed: the local law takes the whole displacement).
        split: `continuous` (deflection and rotation agree at C) or `independent` (paper eq. 3).
        form: `recursion`, or `reactions` for the paper's dense force method.
        shear: the ligament also deforms in shear (needs `Material.GA_L`).
        local: one law everywhere (`uniform`), or `two-material`: a law of its own on the rings
            (needs `Material.k_1_ring`; `k_3_ring` and `k_5_ring` where they differ there too).
        contact: `unilateral` (no force before first touch, and no pull: PULLS) or `bonded` (press
            or draw, odd law).
        onset_width: width of the smooth first touch, mm; no force before touch, none changed after.
        transition: distance from a ring's centre at which the ligament's own local law is reached,
            mm; None: half the smallest distance between two rings, of one ring that to the nearer
            end of the tube.
        half_width: of a flat punch along s, mm, which holds the ligament level over twice that and
            whose local law is the mean over it (pi/4 of the radius of a cylinder's end; needs
            `recursion` and `continuous`). All of it has to lie on the tube, else OFF_TUBE. 0: the
            tool touches at a point.
        skeleton: `linear`, or `softening` for deep presses: it yields more the further it moves
            (needs `Material.e_1` and `e_2`, and `series`); or `sections`, in fits: deforming
            cross-sections, anywhere on the rings and at finite strain (`bonded`; no other option
            but `half_width` applies). `press_sections` presses that one.
    """

    coupling: Literal["series", "total"] = "series"
    split: _beam.Split = "continuous"
    form: _beam.Form = "recursion"
    shear: bool = False
    local: Literal["uniform", "two-material"] = "uniform"
    contact: Literal["unilateral", "bonded"] = "unilateral"
    onset_width: float = 1e-3
    transition: float | None = None
    half_width: float = 0.0
    skeleton: Literal["linear", "softening", "sections"] = "linear"

    def __post_init__(self):
        """Refuse words and numbers that no model has, and options that exclude each other.

        Raises:
            ValueError: naming the option, what was found and what is expected.
        """
        check_record(self, onset_width=0.0, half_width=0.0)
        if self.transition is not None and self.transition <= 0:
            raise ValueError(f"transition is {self.transition:g} mm; expected more than 0, or None")
        if self.half_width > 0 and (self.form, self.split) != ("recursion", "continuous"):
            raise ValueError(
                f"half_width is {self.half_width:g} mm; a tool with a width needs "
                "form='recursion' and split='continuous'"
            )
        if self.skeleton == "softening" and self.coupling != "series":
            raise ValueError(
                "skeleton='softening' needs coupling='series': with 'total' the force does not "
                "depend on the skeleton"
            )
        if self.deforms_sections:
            _check_sections(self)

    @property
    def deforms_sections(self) -> bool:
        """Whether rings change their shape: pressed by `press_sections`, and no line of joints."""
        return self.skeleton == "sections"

    def places(self, length: float) -> tuple[float, float]:
        """Lowest and highest contact position, mm, at which all of the tool lies on the tube."""
        return self.half_width, length - self.half_width


#: Depth to which a skeleton was compared with finite elements, in radii of the tube
#: (docs/virtual_trachea.md). At a tenth that specimen yields 13 % more than a linear skeleton; the
#: others were pressed to half.
TESTED = {"linear": 0.1, "softening": 0.5, "sections": 0.5}

#: Options that a skeleton of deforming cross-sections has: no others apply to it.
_OF_SECTIONS = {
    "coupling": "series", "split": "continuous", "form": "recursion", "shear": False,
    "local": "uniform", "transition": None, "contact": "bonded", "onset_width": 1e-3,
}  # fmt: skip


def _check_sections(options: Options) -> None:
    """Refuse options of the line of joints.

    Raises:
        ValueError: naming the option and the value that it must have.
    """
    for name, only in _OF_SECTIONS.items():
        if (value := getattr(options, name)) != only:
            why = "the tool sticks to the wall" if name == "contact" else "no other applies to it"
            raise ValueError(f"skeleton='sections' needs {name}={only!r}, found {value!r}: {why}")


def check_line(options: Options, what: str) -> None:
    """Refuse a skeleton of deforming cross-sections where a line of joints is pressed.

    Raises:
        ValueError: naming what was called and the cure; or no `Options`.
    """
    check_word("options", options, Options)
    if options.deforms_sections:
        raise ValueError(
            f"{what} presses a line of joints, not skeleton='sections'; use press_sections"
        )


class Press(NamedTuple):
    """A normal press at one contact position, along any number of tool displacements.

    Attributes:
        force: contact force, N; shape of the displacement.
        depth: local indentation, mm; same shape.
        skeleton: deflection of C by the skeleton, mm; same shape.
        joints: deflection of the ligament at each ring, mm; shape (*n, rings).
        reactions: force of each ring against the load, N; shape (*n, rings).
        compliance: deflection of C per unit force, mm/N, at small strain; scalar.
        status: a `PressStatus` per displacement.
    """

    force: Float[Array, "*n"]
    depth: Float[Array, "*n"]
    skeleton: Float[Array, "*n"]
    joints: Float[Array, "*n rings"]
    reactions: Float[Array, "*n rings"]
    compliance: Float[Array, ""]
    status: Int[Array, "*n"]


def ligament_beam(geometry: Geometry, material: Material, options: Options) -> _beam.Beam:
    """The ligament as a `Beam` on the rings, scalars spread over spans and rings.

    Raises:
        ValueError: `options.shear` without `material.GA_L`.
    """
    x = geometry.ring_positions
    spans = (x.shape[0] + 1,)
    GA = None
    if options.shear:
        if material.GA_L is None:
            raise ValueError("options.shear needs Material.GA_L (N); it is None")
        GA = jnp.broadcast_to(material.GA_L, spans)
    EI, k = jnp.broadcast_to(material.EI_L, spans), jnp.broadcast_to(material.k_M, x.shape)
    return _beam.Beam(x, geometry.length, EI, k, GA)


def local_law(
    geometry: Geometry, material: Material, s_c: Float[Array, ""], options: Options
) -> force_law.Law:
    """The local contact law at s_c.

    Raises:
        ValueError: `two-material` without `material.k_1_ring`.
    """
    ligament = force_law.of_ligament(material)
    if options.local == "uniform":
        return ligament
    if material.k_1_ring is None:
        raise ValueError("options.local='two-material' needs Material.k_1_ring (N/mm); it is None")
    x = geometry.ring_positions
    if options.transition is not None:
        transition = jnp.asarray(options.transition, x.dtype)
    else:
        transition = default_transition(geometry)
    if options.half_width > 0:
        weight = punch.mean_ring_weight(s_c, x, transition, options.half_width)
    else:
        weight = force_law.ring_weight(s_c, x, transition)
    return force_law.blend(ligament, force_law.of_ring(material), weight)


def default_transition(geometry: Geometry) -> Float[Array, ""]:
    """`Options.transition` where it is None, mm."""
    x = geometry.ring_positions
    if x.shape[0] == 1:
        return jnp.minimum(x[0], geometry.length - x[0])
    return jnp.min(jnp.diff(x)) / 2


def softening_of(material: Material, options: Options) -> Softening | None:
    """How the skeleton softens; None where it is linear.

    Raises:
        ValueError: `softening` without `material.e_1` or `e_2`.
    """
    if options.skeleton != "softening":
        return None
    values = {name: getattr(material, name) for name in Softening._fields}
    for name, value in values.items():
        if value is None:
            raise ValueError(f"options.skeleton='softening' needs Material.{name}; it is None")
    return Softening(**values)


def touch(
    displacement: Float[Array, "*n"],
    onset: Float[Array, ""],
    options: Options,
    blend: Float[Array, ""] | None = None,
) -> Float[Array, "*n"]:
    """Displacement after first touch: exactly 0 before it if unilateral, then smooth.

    Args:
        displacement: mm; any shape.
        onset: displacement at first touch, mm.
        options: the kind of contact, and the width of the smooth touch.
        blend: mm; where the onset itself is sought: the touch is smooth from `blend` before it to
            `blend` after it, see `centred_hinge` (slightly negative before it).

    Returns:
        Of the shape of `displacement`; what is not finite stays, and says nothing of the onset.
    """
    if options.contact == "bonded":
        return displacement - onset
    known = jnp.isfinite(displacement)
    moved = jnp.where(known, displacement, 0) - onset
    if blend is not None:
        touched = centred_hinge(moved, blend)
    else:
        width = jnp.asarray(options.onset_width, displacement.dtype)
        touched = positive_part(moved, width)
    return jnp.where(known, touched, displacement)


def compliance(
    geometry: Geometry, material: Material, s_c: ArrayLike, options: Options
) -> Float[Array, "*m"]:
    """Deflection of C per unit force at C, mm/N, at one or many contact positions.

    Far cheaper than `press` where the joints are not asked for: many positions share one sweep
    over the rings. NaN where C, or a part of a tool with a width, lies off the tube.

    Raises:
        ValueError: as `press`.
    """
    check_line(options, "compliance")
    check_shapes(geometry, material)
    return _compliance(geometry, material, real("s_c", s_c, float_type(geometry)), options)


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _compliance(
    geometry: Geometry, material: Material, s_c: Float[Array, "*m"], options: Options
) -> Float[Array, "*m"]:
    """`compliance`, of arguments that are checked."""
    beam = ligament_beam(geometry, material, options)
    if options.form == "recursion" and options.half_width == 0:
        return _beam.contact_compliance(beam, s_c, split=options.split)
    half = options.half_width
    on = (s_c >= half) & (s_c <= geometry.length - half)
    place = jnp.where(on, s_c, geometry.length / 2)
    w_C = jnp.vectorize(lambda s: unit_deflection(beam, s, options).w_C)(place)
    return jnp.where(on, w_C, jnp.nan)


def unit_deflection(
    beam: _beam.Beam, s_c: Float[Array, ""], options: Options
) -> punch.UnitDeflection:
    """Everything that moves under a unit force at C."""
    if options.half_width > 0:
        return punch.punch_deflection(beam, s_c, options.half_width)
    unit = _beam.deflect_on(beam, s_c, jnp.ones_like(s_c), options.split, options.form)
    return punch.UnitDeflection(unit.w_C, unit.theta_C, unit.w, unit.theta, unit.reaction)


def respond(
    displacement: Float[Array, "*n"],
    onset: Float[Array, ""],
    compliance: Float[Array, ""],
    law: force_law.Law,
    options: Options,
    blend: Float[Array, ""] | None = None,
    softening: Softening | None = None,
) -> equilibrium.Equilibrium:
    """Force and local indentation for a skeleton of known compliance; `blend`: see `touch`.

    NaN and PULLS where unilateral contact would pull: past the zero of a law that softens, which a
    stiff skeleton reaches before the fold. (A total coupling ends at the law's own fold before it.)
    """
    moved = touch(displacement, onset, options, blend)
    if options.coupling == "total":
        return equilibrium.press_total(moved, compliance, law)
    if softening is not None:  # which ends at the law's own fold, too
        return equilibrium.press_softening(moved, compliance, law, softening)
    solved = equilibrium.press_series(moved, compliance, law)
    if options.contact == "bonded":
        return solved
    pulls = (moved > 0) & (solved.force < 0)  # a rounded corner is below 0 by itself
    return equilibrium.Equilibrium(
        depth=jnp.where(pulls, jnp.nan, solved.depth),
        force=jnp.where(pulls, jnp.nan, solved.force),
        status=jnp.where(pulls, PressStatus.PULLS, solved.status).astype(jnp.int8),
    )


def press(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    displacement: ArrayLike,
    options: Options = Options(),
    *,
    onset: ArrayLike | None = None,
    blend: ArrayLike | None = None,
) -> Press:
    """Press the tool along the inward normal at (s_c, phi = 0) and solve for force and skeleton.

    Rings are springs k_M (paper: the cartilage is taken as rigid against the muscle). The skeleton
    is linear, for small deflections, unless `options.skeleton` lets it soften: the arch of the wall
    flattens in a deep press (docs/model.md). Off the midline or oblique: not in this function.

    Args:
        geometry: the tube at rest.
        material: stiffness values; floating dtype of the result follows the arrays, that of Python
            numbers and lists the geometry.
        s_c: contact position, mm, in [0, length], `options.half_width` off both ends; a scalar.
        displacement: tool displacement along the inward normal, mm; any shape.
        options: what is modelled (static).
        onset: tool displacement at first touch, mm; 0 if None.
        blend: mm, a scalar: the rounded corner of a curve whose onset was fitted, in the place of
            `options.onset_width`, see `touch`.

    Returns:
        The `Press`; rows without a stable solution are NaN with a status, others are untouched.
        A contact off the tube (OFF_TUBE), a negative stiffness (BAD_MATERIAL) and one or a place
        that is no number (NON_FINITE) are NaN throughout; a stiffness of zero is the limit of a
        small one where that exists.

    Raises:
        ValueError: an argument that is no number, an array of a length that does not fit the tube,
            a value of the material that the options need, or the skeleton `sections`.
    """
    check_line(options, "press")
    displacement = real("displacement", displacement, float_type(geometry))
    onset = shaped("onset", 0.0 if onset is None else onset, (), dtype=displacement.dtype)
    if blend is not None:
        blend = shaped("blend", blend, (), dtype=displacement.dtype)
    s_c = check_place(geometry, material, s_c)
    return _press(geometry, material, s_c, displacement, options, onset, blend)


def read_values(options: Options) -> tuple[str, ...]:
    """Values of the material that a press reads and that must not be negative."""
    names = ("EI_L", "k_M", "k_1")
    names += ("GA_L",) if options.shear else ()
    return names + (("k_1_ring",) if options.local == "two-material" else ())


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press(
    geometry: Geometry,
    material: Material,
    s_c: Float[Array, ""],
    displacement: Float[Array, "*n"],
    options: Options,
    onset: Float[Array, ""],
    blend: Float[Array, ""] | None = None,
) -> Press:
    """`press`, of arguments that are checked."""
    material, s_c, refused = admit(
        geometry, material, s_c, read_values(options), reach=options.half_width
    )
    unit = unit_deflection(ligament_beam(geometry, material, options), s_c, options)
    law = local_law(geometry, material, s_c, options)
    softening = softening_of(material, options)
    solved = respond(displacement, onset, unit.w_C, law, options, blend, softening)
    unit, solved = hide(refused, unit, solved)

    def per_ring(factor, v):
        return scaled(factor[..., None], jnp.broadcast_to(v, (*displacement.shape, *v.shape)))

    load = solved.force if solved.load is None else solved.load
    return Press(
        force=solved.force,
        depth=solved.depth,
        skeleton=scaled(load, jnp.broadcast_to(unit.w_C, load.shape)),
        joints=per_ring(load, unit.w),
        reactions=per_ring(solved.force, unit.reaction),
        compliance=unit.w_C,
        status=status_of(refused, solved.status),
    )
