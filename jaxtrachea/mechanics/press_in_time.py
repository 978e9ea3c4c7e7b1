"""A press in time: what a normal press of a line of joints becomes where its force relaxes."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike, real, shaped
from jaxtrachea._numerics import scaled
from jaxtrachea.mechanics import press as _press
from jaxtrachea.mechanics.admission import (
    admit,
    check_place,
    float_type,
    has_solution,
    hide,
    status_of,
)
from jaxtrachea.mechanics.equilibrium import Equilibrium
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.levels.options import Options, check_line
from jaxtrachea.mechanics.press import Press
from jaxtrachea.mechanics.relaxation import Relaxation, relax
from jaxtrachea.mechanics.relaxation_parts import relax_parts
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


def press_in_time(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    time: ArrayLike,
    displacement: ArrayLike,
    relaxation: Relaxation,
    options: Options,
    *,
    onset: ArrayLike | None = None,
    blend: ArrayLike | None = None,
) -> Press:
    """`press.press` of a tool that moves in time, from rest before the first sample.

    With `options.relaxation` `uniform` all of the organ relaxes alike, so that its shape is the
    elastic one and the force a filter of the elastic force (`mechanics.relaxation`); with `parts`
    local law and skeleton relax apart (`mechanics.relaxation_parts`). The values of the material
    are those of the long run. Softening is geometry, which remembers nothing: the force of small
    strain relaxes, times the softening of the present displacement.

    Args:
        geometry: the tube at rest.
        material: stiffness values in the long run.
        s_c: contact position, mm, as in `press`.
        time: s; (N,). A sample before an earlier one, or at no time, is BACK_IN_TIME and NaN; all
            others are as if it were not there.
        displacement: of the tool along the inward normal, mm; (N,). A sample at no place is
            NON_FINITE and NaN, and likewise passed over.
        relaxation: the branches, see `relaxation_laws.relaxation`.
        options: what is modelled (static).
        onset: tool displacement at first touch, mm; 0 if None.
        blend: as in `press`.

    Returns:
        The `Press`; where the tool has left, the status is NO_CONTACT and depth, skeleton and
        joints are those of the surface, which recovers by itself. After a sample without a solution
        the history is unknown: all later ones are NaN with its status.

    Raises:
        ValueError: as `press`; options without a relaxation; branches that do not fit them.
    """
    check_line(options, "press_in_time", timed=True)
    _check(options, relaxation)
    displacement = real("displacement", displacement, float_type(geometry))
    shaped("displacement", displacement, ("any number of",))
    time = shaped("time", time, displacement.shape, dtype=displacement.dtype)
    onset = shaped("onset", 0.0 if onset is None else onset, (), dtype=displacement.dtype)
    if blend is not None:
        blend = shaped("blend", blend, (), dtype=displacement.dtype)
    s_c = check_place(geometry, material, s_c)
    given = geometry, material, s_c, time, displacement, relaxation
    return _press_in_time(*given, options, onset, blend)


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
    s_c: Float[Array, ""],
    time: Float[Array, " N"],
    displacement: Float[Array, " N"],
    relaxation: Relaxation,
    options: Options,
    onset: Float[Array, ""],
    blend: Float[Array, ""] | None,
) -> Press:
    """`press_in_time`, of arguments that are checked."""
    material, s_c, refused = admit(
        geometry, material, s_c, _press.read_values(options), reach=options.half_width
    )
    beam = _press.ligament_beam(geometry, material, options)
    unit = _press.unit_deflection(beam, s_c, options)
    law = _press.local_law(geometry, material, s_c, options)
    softening = _press.softening_of(material, options)
    contact = _press.Contact(law, onset, blend, softening)
    elastic = _press.respond(displacement, unit.w_C, contact, options)
    moved = _press.touch(displacement, onset, options, blend)
    known = jnp.isfinite(displacement)
    time, back = in_order(time, known)
    relaxation, refused = _validated(relaxation, refused)
    solved = _in_time(time, moved, back | ~known, unit.w_C, law, relaxation, elastic, options)
    status = jnp.where(back, PressStatus.BACK_IN_TIME, solved.status)
    status = jnp.where(known | back, status, PressStatus.NON_FINITE)
    if softening is not None:
        ratio = softening.ratio(jnp.where(jnp.isfinite(solved.force), moved, 0))
        solved = solved._replace(force=ratio * solved.force)
    unit, solved = hide(refused, unit, solved)
    load = solved.load

    def per_ring(factor, v):
        return scaled(factor[:, None], jnp.broadcast_to(v, (*factor.shape, *v.shape)))

    return Press(
        force=solved.force,
        depth=solved.depth,
        skeleton=scaled(load, jnp.broadcast_to(unit.w_C, load.shape)),
        joints=per_ring(load, unit.w),
        reactions=per_ring(solved.force, unit.reaction),
        compliance=unit.w_C,
        status=status_of(refused, status),
    )


def _validated(relaxation: Relaxation, refused):
    """The branches, of numbers that cannot be none of them; and why the press is refused."""
    leaves = jax.tree.leaves(relaxation)
    unknown = jnp.any(jnp.stack([jnp.any(jnp.isnan(v)) for v in leaves]))
    negative = jnp.any(jnp.stack([jnp.any(v < 0) for v in leaves]))
    why = jnp.where(negative, PressStatus.BAD_MATERIAL, PressStatus.OK)
    why = jnp.where(unknown, PressStatus.NON_FINITE, why)
    safe = jax.tree.map(lambda v: jnp.where(v >= 0, v, 0), relaxation)
    return safe, jnp.where(refused != PressStatus.OK, refused, why).astype(jnp.int8)


def in_order(
    time: Float[Array, " N"], known: Bool[Array, " N"]
) -> tuple[Float[Array, " N"], Bool[Array, " N"]]:
    """Times that never fall, and which samples are before an earlier one or at no time.

    Those, and samples that are not `known`, are at the time of the last one before that counts.
    """
    timed = jnp.isfinite(time)
    counts = timed & known
    latest = jax.lax.cummax(jnp.where(counts, time, -jnp.inf))
    back = ~timed | (time < latest)
    start = jnp.min(jnp.where(counts, time, jnp.inf))  # of samples before the first that counts
    latest = jnp.maximum(latest, jnp.where(jnp.isfinite(start), start, 0))
    return jnp.where(back | ~known, jax.lax.stop_gradient(latest), time), back


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
    failed = ~has_solution(elastic.status)
    # The tool stays where it was.
    moved, load, failed = (_as_before(v, skipped) for v in (moved, load, failed))
    lost = jnp.cumsum(failed) > 0
    unilateral = options.contact == "unilateral"
    safe = jnp.where(lost, 0, moved)
    if relaxation.skeleton is None:
        force, surface = relax(time, jnp.where(lost, 0, load), relaxation.local, unilateral)
        depth = safe - compliance * surface
        if unilateral:
            left = surface != jnp.where(lost, 0, load)
            alone = law.root(jnp.where(left, surface, 0), jnp.ones_like(surface), 0.0)
            depth = jnp.where(left, alone, depth)
    else:
        branches = relaxation.local, relaxation.skeleton
        found = relax_parts(time, safe, compliance, law, *branches, unilateral)
        force, depth, surface = found.force, found.depth, found.load
        failed, lost = failed | found.folded, lost | (jnp.cumsum(found.folded) > 0)
    status = _status(elastic.status, force, failed, lost, unilateral)
    hidden = lost | skipped
    force, depth, surface = (jnp.where(hidden, jnp.nan, v) for v in (force, depth, surface))
    return Equilibrium(depth, force, status, surface)


def _as_before(v, skipped):
    """Each entry that is skipped as the last one before that is not; 0 without such a one."""
    place = jnp.arange(v.shape[0])
    last = jax.lax.cummax(jnp.where(skipped, -1, place))
    return jnp.where(last >= 0, v[jnp.maximum(last, 0)], jnp.zeros_like(v))


def _status(status, force, failed, lost, unilateral: bool) -> Int[Array, " N"]:
    """Of samples in contact OK, off it NO_CONTACT; after the first that failed the reason of it."""
    first = jnp.argmax(failed)
    why = jnp.where(
        has_solution(status[first]), jnp.asarray(PressStatus.PAST_FOLD, jnp.int8), status[first]
    )
    touches = force > 0 if unilateral else force != 0
    plain = jnp.where(touches, PressStatus.OK, PressStatus.NO_CONTACT)
    plain = jnp.where(status == PressStatus.NEGATIVE_LOCAL, status, plain)
    return jnp.where(lost, why, plain).astype(jnp.int8)
