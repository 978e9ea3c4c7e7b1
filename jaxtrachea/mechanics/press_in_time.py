"""A press in time: what a normal press of a line of joints becomes where its force relaxes."""

import functools

import jax
import jax.numpy as jnp

from jaxtrachea._arguments import real, shaped
from jaxtrachea.mechanics import press as _press
from jaxtrachea.mechanics.equilibrium import Equilibrium
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.mechanics.levels.options import Options, check_line
from jaxtrachea.mechanics.press import Press
from jaxtrachea.mechanics.relaxation_parts import relax_parts, way_of
from jaxtrachea.mechanics.samples import as_before, in_order, no_history
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.mechanics.validation import (
    check_place,
    float_type,
    mark_deep,
    validate,
)
from jaxtrachea.relaxation.filter import Relaxation, relax
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


def press_in_time(
    geometry: Geometry,
    material: Material,
    motion: Motion,
    relaxation: Relaxation,
    options: Options,
) -> Press:
    """`press.press` of a tool that moves in time, from rest before the first sample.

    With `options.relaxation` `uniform` all of the organ relaxes alike, so that its shape is the
    elastic one and the force a filter of the elastic force (`relaxation.filter`); with `parts`
    local law and skeleton relax apart (`mechanics.relaxation_parts`). The values of the material
    are those of the long run. Softening is geometry, which remembers nothing: the force of small
    strain relaxes, times the softening of the present displacement; where parts relax apart, of the
    way at which the skeleton of an elastic press would be as deflected as it is.

    Args:
        geometry: the tube at rest.
        material: stiffness values in the long run.
        motion: place, time and displacement of every sample, (N,), onset and blend as in `press`;
            numbers of any kind. A sample before an earlier one, or at no time, is BACK_IN_TIME, one
            at no displacement NON_FINITE: NaN, and all others are as if it were not there.
        relaxation: the branches, see `relaxation_laws.relaxation`.
        options: what is modelled (static).

    Returns:
        The `Press`; where the tool has left, the status is NO_CONTACT and depth, skeleton and
        joints are those of the surface, which recovers by itself. After a sample without a solution
        the history is unknown: all later ones are NaN with its status.

    Raises:
        ValueError: as `press`; options without a relaxation; branches that do not fit them; a
            motion without time, or off the midline or the normal.
    """
    check_line(options, "press_in_time", timed=True)
    _check(options, relaxation)
    if motion.phi_c is not None or motion.direction is not None:
        raise ValueError(
            "press_in_time presses on the midline along the normal; leave phi_c and direction out"
        )
    if motion.time is None:
        raise ValueError("the motion has no time; expected one for each displacement")
    displacement = real("displacement", motion.displacement, float_type(geometry))
    shaped("displacement", displacement, ("any number of",))
    dtype, onset, blend = displacement.dtype, motion.onset, motion.blend
    motion = Motion(
        s_c=check_place(geometry, material, motion.s_c),
        displacement=displacement,
        onset=shaped("onset", 0.0 if onset is None else onset, (), dtype=dtype),
        blend=None if blend is None else shaped("blend", blend, (), dtype=dtype),
        time=shaped("time", motion.time, displacement.shape, dtype=dtype),
    )
    return _press_in_time(geometry, material, motion, relaxation, options)


def _check(options: Options, relaxation: Relaxation) -> None:
    if options.relaxation == "off":
        raise ValueError(
            "options.relaxation is 'off': no time enters; use press, or choose 'uniform' or 'parts'"
        )
    parts = relaxation.skeleton is not None
    if parts != (options.relaxation == "parts"):
        found = "branches of the skeleton" if parts else "no branches of the skeleton"
        raise ValueError(f"options.relaxation is {options.relaxation!r}, found {found}")


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press_in_time(
    geometry: Geometry,
    material: Material,
    motion: Motion,
    relaxation: Relaxation,
    options: Options,
) -> Press:
    """`press_in_time`, of arguments that are checked."""
    material, s_c, refused = validate(
        geometry, material, motion.s_c, _press.read_values(options), reach=options.half_width
    )
    beam = _press.ligament_beam(geometry, material, options)
    unit = _press.unit_deflection(beam, s_c, options)
    law = _press.local_law(geometry, material, s_c, options)
    softening = _press.softening_of(material, options)
    displacement, onset, blend = motion.displacement, motion.onset, motion.blend
    assert onset is not None
    assert motion.time is not None
    contact = _press.Contact(law, onset, blend, softening)
    elastic = _press.respond(displacement, unit.w_C, contact, options)
    moved = _press.indentation(displacement, onset, options, blend)
    time, order = in_order(motion.time, displacement)
    relaxation, refused = validated(relaxation, refused)
    skipped = order != PressStatus.OK
    solved = _in_time(time, moved, skipped, unit.w_C, law, relaxation, elastic, options)
    status = jnp.where(skipped, order, solved.status)
    assert solved.load is not None
    if softening is not None:
        apart = relaxation.skeleton is not None
        way = way_of(solved.load, unit.w_C, law) if apart else moved
        solved, status = softened(solved, status, softening, way)
    status = mark_deep(status, displacement - onset, geometry.radius)
    return _press.pressed(unit, solved, status, refused)


def softened(solved: Equilibrium, status, softening: Softening, way):
    """The press with the softening of a way; past the fold of that the sample is PAST_FOLD."""
    assert solved.load is not None
    there = jnp.isfinite(solved.force)
    folded = there & (~jnp.isfinite(way) | softening.past_peak(way))
    ratio = softening.ratio(jnp.where(there & ~folded, way, 0))
    force = jnp.where(folded, jnp.nan, ratio * solved.force)
    depth, load = (jnp.where(folded, jnp.nan, v) for v in (solved.depth, solved.load))
    status = jnp.where(folded, PressStatus.PAST_FOLD, status)
    return solved._replace(force=force, depth=depth, load=load), status


def validated(relaxation: Relaxation, refused):
    """The branches, of numbers that cannot be none of them; and why the press is refused."""
    leaves = jax.tree.leaves(relaxation)
    unknown = jnp.any(jnp.stack([jnp.any(jnp.isnan(v)) for v in leaves]))
    negative = jnp.any(jnp.stack([jnp.any(v < 0) for v in leaves]))
    why = jnp.where(negative, PressStatus.BAD_MATERIAL, PressStatus.OK)
    why = jnp.where(unknown, PressStatus.NON_FINITE, why)
    safe = jax.tree.map(lambda v: jnp.where(v >= 0, v, 0), relaxation)
    return safe, jnp.where(refused != PressStatus.OK, refused, why).astype(jnp.int8)


def _in_time(
    time,
    moved,
    skipped,
    compliance,
    law: Law,
    relaxation: Relaxation,
    elastic: Equilibrium,
    options,
) -> Equilibrium:
    """The press of small strain in time; `load` is the elastic force of the skeleton."""
    load = elastic.force if elastic.load is None else elastic.load
    lost, _ = no_history(elastic.status, skipped)
    # Where it is skipped the tool stays where it was; what is lost changes nothing before it.
    moved, load = (as_before(jnp.where(lost, 0, v), skipped) for v in (moved, load))
    unilateral = options.contact == "unilateral"
    folded = None
    if relaxation.skeleton is None:
        force, surface = relax(time, load, relaxation.local, unilateral)
        depth = moved - compliance * surface
        if unilateral:
            left = surface != load
            alone = law.under(jnp.where(left, surface, 0))
            depth = jnp.where(left, alone, depth)
    else:
        branches = relaxation.local, relaxation.skeleton
        force, depth, surface, folded = relax_parts(
            time, moved, compliance, law, *branches, unilateral
        )
    lost, status = no_history(elastic.status, skipped, folded)
    touches = force > 0 if unilateral else force != 0
    told = (status == PressStatus.OK) | (status == PressStatus.NO_CONTACT)
    plain = jnp.where(touches, PressStatus.OK, PressStatus.NO_CONTACT)
    status = jnp.where(told, plain, status).astype(jnp.int8)
    force, depth, surface = (jnp.where(lost | skipped, jnp.nan, v) for v in (force, depth, surface))
    return Equilibrium(depth, force, status, surface)
