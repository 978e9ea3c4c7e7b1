"""The forward model: the only place that knows the order of the rooms."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, real, shaped
from jaxtrachea._numerics import centred_hinge, positive_part, scaled
from jaxtrachea.mechanics import beam as _beam
from jaxtrachea.mechanics import equilibrium, force_law, punch
from jaxtrachea.mechanics.levels.options import Options, check_line
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.mechanics.validation import (
    check_place,
    check_shapes,
    float_type,
    mark_deep,
    mask,
    status_of,
    validate,
)
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


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


def indentation(
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
    check_line(options, "compliance", timed=True)  # of the long run
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


class Contact(NamedTuple):
    """What the force at one contact depends on, beside the skeleton's compliance.

    Attributes:
        law: of the local indentation.
        onset: displacement at first touch, mm.
        blend: rounded corner of a curve whose onset was fitted, mm, see `indentation`; None: that
            of the options.
        softening: of the skeleton; None where it is linear.
    """

    law: force_law.Law
    onset: Float[Array, "*T"]
    blend: Float[Array, "*T"] | None = None
    softening: Softening | None = None


def respond(
    displacement: Float[Array, "*n"],
    compliance: Float[Array, ""],
    contact: Contact,
    options: Options,
) -> equilibrium.Equilibrium:
    """Force and local indentation for a skeleton of known compliance.

    NaN and PULLS where unilateral contact would pull: past the zero of a law that softens, which a
    stiff skeleton reaches before the fold. (A total coupling ends at the law's own fold before it.)
    """
    law, softening = contact.law, contact.softening
    moved = indentation(displacement, contact.onset, options, contact.blend)
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
            `options.onset_width`, see `indentation`.

    Returns:
        The `Press`; rows without a stable solution are NaN with a status, others are untouched.
        Rows where the wall moves further than the tube's radius are TOO_DEEP: solved, but beyond
        what ring and ligament are linear for (15 % at a quarter of it, docs/validity.md).
        A contact off the tube (OFF_TUBE), a negative stiffness (BAD_MATERIAL) and one or a place
        that is no number (NON_FINITE) are NaN throughout; k_M, k_1 and k_3 of zero are the limits
        of small ones, a ligament of zero is BAD_MATERIAL.

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
    material, s_c, refused = validate(
        geometry, material, s_c, read_values(options), reach=options.half_width
    )
    unit = unit_deflection(ligament_beam(geometry, material, options), s_c, options)
    law = local_law(geometry, material, s_c, options)
    contact = Contact(law, onset, blend, softening_of(material, options))
    solved = respond(displacement, unit.w_C, contact, options)
    status = mark_deep(solved.status, displacement - onset, geometry.radius)
    return pressed(unit, solved, status, refused)


def pressed(
    unit: punch.UnitDeflection, solved: equilibrium.Equilibrium, status: Int[Array, "*n"], refused
) -> Press:
    """The press where the contact is in equilibrium; NaN where it is refused."""
    unit, solved = mask(refused, unit, solved)

    def per_ring(factor, v):
        return scaled(factor[..., None], jnp.broadcast_to(v, (*factor.shape, *v.shape)))

    load = solved.force if solved.load is None else solved.load
    return Press(
        force=solved.force,
        depth=solved.depth,
        skeleton=scaled(load, jnp.broadcast_to(unit.w_C, load.shape)),
        joints=per_ring(load, unit.w),
        reactions=per_ring(solved.force, unit.reaction),
        compliance=unit.w_C,
        status=status_of(refused, status),
    )
