"""Presses in any direction, anywhere on the rings: the companion of `model.press`.

Contact force, local indentation and skeleton in one; with friction along a path. All vectors are in
the frame of the tube: x along s towards the larynx, y anterior, z to the side of positive phi.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike, check_record, check_word, last_axis, shaped
from jaxtrachea._numerics import product, product_of_rows, turned
from jaxtrachea.mechanics import friction as _friction
from jaxtrachea.mechanics import skeleton, vector_equilibrium
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb, Slide
from jaxtrachea.mechanics.press import Options, check_line, indentation, local_law, read_values
from jaxtrachea.mechanics.skeleton import Rings, Skeleton, local_frame
from jaxtrachea.mechanics.validation import (
    IN_TWO_PLANES,
    Validated,
    check_place,
    float_type,
    mark_deep,
    mask,
    status_of,
    validate,
)
from jaxtrachea.status import PressStatus, RingStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


class ObliquePress(NamedTuple):
    """A press at one contact position along any number of tool displacements; mm and N.

    `force`, `depth` (local indentation), `skeleton` (displacement of C): shape (*n, 3); the other
    fields as in `Skeleton`, times the force; `status`: a `PressStatus` each.
    """

    force: Float[Array, "*n 3"]
    depth: Float[Array, "*n 3"]
    skeleton: Float[Array, "*n 3"]
    slope_C: Float[Array, "*n 2"]
    joints: Float[Array, "*n rings 3"]
    slopes: Float[Array, "*n rings 2"]
    loads: Float[Array, "*n rings 3"]
    end_U: Float[Array, "*n rings 3"]
    end_V: Float[Array, "*n rings 3"]
    clamps: Float[Array, "*n 2 3"]
    status: Int[Array, "*n"]


class ObliquePath(NamedTuple):
    """A press along a path with friction.

    Attributes:
        press: one entry per step.
        slip: way the tool has slid over the surface, mm; shape (steps, 3).
        dissipated: work lost to friction in each step, N mm.
        sliding: whether each step slides.
    """

    press: ObliquePress
    slip: Float[Array, "steps 3"]
    dissipated: Float[Array, " steps"]
    sliding: Bool[Array, " steps"]


def _only_default(options: Options):
    check_line(options, "an oblique press")
    if options.half_width != 0 or options.skeleton != "linear":
        raise ValueError(
            "oblique presses need options.half_width=0 and options.skeleton='linear': a tool with "
            "a width and a skeleton that softens are for normal presses on the midline (`press`)"
        )
    if options.split != "continuous" or options.form != "recursion":
        raise ValueError("oblique presses need options.split='continuous' and form='recursion'")


@dataclasses.dataclass(frozen=True)
class ObliqueOptions:
    """What the model of presses in any direction includes; static.

    Attributes:
        press: as for `press`; `split`, `form`, `half_width` and `skeleton` have no other choice
            than their defaults here.
        rings: see `skeleton_response`.
        axial: see `skeleton_response`.
    """

    press: Options = Options()
    rings: Rings = "arch2"
    axial: bool = True

    def __post_init__(self):
        """Refuse words that mean nothing, and options of normal presses alone (`ValueError`)."""
        check_record(self)
        _only_default(self.press)


class Place(NamedTuple):
    """A contact position, and what a press there needs of tube and material.

    Attributes:
        asked: checked position and material.
        unit: what the skeleton does per unit force.
        law: local law.
        phi_c: contact angle, rad.
        onset: inward displacement at first touch, mm.
    """

    asked: Validated
    unit: Skeleton
    law: Law
    phi_c: Float[Array, ""]
    onset: Float[Array, ""]


def press_oblique(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    displacement: ArrayLike,
    options: ObliqueOptions = ObliqueOptions(),
    *,
    onset: ArrayLike | None = None,
) -> ObliquePress:
    """Move the tool, stuck to the surface at (s_c, phi_c), by a vector.

    `bonded` contact presses or draws in any direction. `unilateral` holds on while it presses: the
    tool comes from rest in a straight line and first touches at `onset`; where holding on would
    need a pull the row is NaN with PULLS. Small deflections, linear skeleton, no torsion.

    Args:
        geometry: the tube at rest.
        material: as for `skeleton_response`, and the local law.
        s_c: contact position, mm, in [0, length].
        phi_c: contact angle from the anterior midline, rad, in [-alpha, alpha].
        displacement: of the tool, x, y, z, mm; inward along the normal: (0, -cos phi, -sin phi).
        options: what is modelled (static).
        onset: inward displacement at first touch, mm; 0 if None.

    Returns:
        The `ObliquePress`; NaN, and TOO_DEEP, as for `press`.

    Raises:
        ValueError: a missing value of the material, an argument that is no number, or an array of
            a wrong length.
    """
    where = _checked(geometry, material, s_c, phi_c, options, onset)
    displacement = last_axis("displacement", displacement, 3, float_type(geometry))
    return _press_oblique(geometry, material, *where, displacement, options)


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press_oblique(
    geometry: Geometry,
    material: Material,
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    onset: Float[Array, ""],
    displacement: Float[Array, "*n 3"],
    options: ObliqueOptions,
) -> ObliquePress:
    """`press_oblique`, of arguments that are checked."""
    place = place_at(geometry, material, s_c, phi_c, options, onset=onset)
    press = press_at(place, displacement, options.press)
    return press._replace(status=_mark_deep(place, displacement, press.status, geometry))


def press_at(place: Place, displacement: Float[Array, "*n 3"], options: Options) -> ObliquePress:
    """As `press_oblique`, on a place that is known; however far the wall moves."""
    force, depth, status = elastic_at(place, displacement, options)
    refused = place.asked.refused
    unit, force, depth = mask(refused, place.unit, force, depth)
    return assemble(unit, force, depth, status_of(refused, status))


def elastic_at(place: Place, displacement: Float[Array, "*n 3"], options: Options):
    """Force, N, and local indentation, mm, (*n, 3), and the status of the press."""
    normal = local_frame(place.phi_c)[0]
    # Rows that are no numbers say nothing of place and onset.
    known = jnp.isfinite(jnp.sum(displacement, axis=-1, keepdims=True))
    given = jnp.where(known, displacement, 0)
    inward = product(given, normal)
    if options.contact == "bonded":
        moved = given - place.onset * jnp.broadcast_to(normal, given.shape)
    else:
        share = indentation(inward, place.onset, options) / jnp.where(inward > 0, inward, 1)
        moved = given * share[..., None]
    moved = jnp.where(known, moved, displacement)
    solve = {
        "series": vector_equilibrium.press_vector,
        "total": vector_equilibrium.press_vector_total,
    }[options.coupling]
    flat = moved.reshape(-1, 3)
    solved = jax.vmap(solve, (0, None, None))(flat, place.unit.compliance, place.law)
    force, depth = (v.reshape(displacement.shape) for v in (solved.force, solved.depth))
    status = solved.status.reshape(displacement.shape[:-1])
    if options.contact == "unilateral":
        pulls = product(force, normal) < 0
        force, depth = (jnp.where(pulls[..., None], jnp.nan, v) for v in (force, depth))
        status = jnp.where(pulls, PressStatus.PULLS, status)
    return force, depth, status


def press_path(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    displacement: ArrayLike,
    friction: Coulomb,
    options: ObliqueOptions = ObliqueOptions(),
    *,
    onset: ArrayLike | None = None,
) -> ObliquePath:
    """Lead the tool along a path; it sticks and slides by Coulomb's law (unilateral, `series`).

    The contact keeps its place (s_c, phi_c): for slips small against the ring distance. From rest
    and from step to step the tool goes in straight lines. What it does along the surface before it
    touches, at `onset`, is no slip and no force, then and after it has lifted off.

    Args:
        geometry: as for `press_oblique`, like all that is not named here.
        displacement: of the tool at the end of each step, from rest, mm; (steps, 3).
        friction: between tool and surface.

    Returns:
        The `ObliquePath`; OFF_TUBE, BAD_MATERIAL (also: a negative mu) and NON_FINITE where it is
        of the material, the place or mu are NaN throughout.

    Raises:
        ValueError: as `press_oblique`; another contact or coupling.
    """
    check_word("options", options, ObliqueOptions)
    check_word("friction", friction, Coulomb)
    if options.press.contact != "unilateral" or options.press.coupling != "series":
        raise ValueError(
            "friction needs options.contact='unilateral' and options.coupling='series'"
        )
    dtype = float_type(geometry)
    displacement = shaped("displacement", displacement, ("steps", 3), dtype=dtype)
    where = _checked(geometry, material, s_c, phi_c, options, onset)
    mu = shaped("friction", friction.mu, (), dtype=dtype)
    friction = Coulomb(mu, friction.rounding)
    return _press_path(geometry, material, *where, displacement, friction, options)


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press_path(
    geometry: Geometry,
    material: Material,
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    onset: Float[Array, ""],
    displacement: Float[Array, "steps 3"],
    friction: Coulomb,
    options: ObliqueOptions,
) -> ObliquePath:
    """`press_path`, of arguments that are checked."""
    place = place_at(geometry, material, s_c, phi_c, options, onset=onset)
    path = path_at(place, displacement, friction, options)
    status = _mark_deep(place, displacement, path.press.status, geometry)
    return path._replace(press=path.press._replace(status=status))


def path_at(
    place: Place, displacement: Float[Array, "steps 3"], friction: Coulomb, options: ObliqueOptions
) -> ObliquePath:
    """As `press_path`, on a place that is known; however far the wall moves."""
    D, C, friction, refused = _rubbed(place, displacement, friction, options)
    height = jnp.where(place.onset >= 0, place.onset, 0)
    return _path_of(place, _friction.slide_path(D, C, place.law, friction, height=height), refused)


def slide_at(
    place: Place, displacement: Float[Array, "3"], friction: Coulomb, options: ObliqueOptions
) -> tuple[ObliquePath, Float[Array, "2"]]:
    """One step of `press_path` on a place that is known, by a tool that has not slid yet.

    Returns:
        The step, with a leading axis of 1, and the slip along the tube and round it, mm.
    """
    D, C, friction, refused = _rubbed(place, displacement[None], friction, options)
    slid = _friction.slide(D[0], C, place.law, friction, jnp.zeros_like(D[0, 1:]))
    return _path_of(place, jax.tree.map(lambda v: v[None], slid), refused), slid.slip


def _rubbed(place: Place, displacement: Float[Array, "n 3"], friction: Coulomb, options):
    """Displacements and compliance in the contact's frame, friction to compute with, refusals."""
    mu = jnp.asarray(friction.mu)
    friction = Coulomb(jnp.where(mu >= 0, mu, 0), friction.rounding)
    refused = jnp.where(jnp.isnan(mu), PressStatus.NON_FINITE, place.asked.refused)
    refused = jnp.where(mu < 0, PressStatus.BAD_MATERIAL, refused).astype(jnp.int8)
    frame, onset = local_frame(place.phi_c), place.onset
    D = product(displacement, frame.T)
    inward = D[:, :1]
    inward = jnp.where(inward < onset, inward - onset, indentation(inward, onset, options.press))
    D = jnp.concatenate([inward, D[:, 1:]], axis=1)
    return D, turned(place.unit.compliance, frame.T), friction, refused


def _path_of(place: Place, slid: Slide, refused) -> ObliquePath:
    """Steps in the frame of the tube."""
    frame = local_frame(place.phi_c)
    unit, slid = mask(refused, place.unit, slid)
    status = status_of(refused, slid.status)
    press = assemble(unit, product(slid.force, frame), product(slid.depth, frame), status)
    sliding = slid.sliding & (refused == PressStatus.OK)
    return ObliquePath(press, product(slid.slip, frame[1:]), slid.dissipated, sliding)


def _mark_deep(place: Place, displacement: Float[Array, "*n 3"], status, geometry: Geometry):
    """As `mark_deep`, of vectors from rest."""
    touch = jnp.broadcast_to(place.onset * local_frame(place.phi_c)[0], displacement.shape)
    moved = displacement - touch.astype(displacement.dtype)
    return mark_deep(status, jnp.sum(moved * moved, axis=-1), geometry.radius**2)


def place_at(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    options: ObliqueOptions,
    *,
    onset: ArrayLike | None = None,
) -> Place:
    """Checked arguments, and the skeleton and the local law at the contact."""
    check_word("options", options, ObliqueOptions)
    s_c, phi_c, onset = _checked(geometry, material, s_c, phi_c, options, onset)
    rings, levels = options.rings, {"axial": options.axial, "shear": options.press.shear}
    used = (*read_values(options.press), *skeleton.read_values(rings, **levels))
    asked = validate(geometry, material, s_c, dict.fromkeys(used), divided=IN_TWO_PLANES)
    unit = skeleton.respond(geometry, asked.material, asked.s_c, phi_c, rings=rings, **levels)
    law = local_law(geometry, asked.material, asked.s_c, options.press)
    return Place(asked=asked, unit=unit, law=law, phi_c=phi_c, onset=onset)


def _checked(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    options: ObliqueOptions,
    onset: ArrayLike | None,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Contact position, angle and displacement at first touch as arrays."""
    check_word("options", options, ObliqueOptions)
    dtype = float_type(geometry)
    phi_c = shaped("phi_c", phi_c, (), dtype=dtype)
    onset = shaped("onset", 0.0 if onset is None else onset, (), dtype=dtype)
    return check_place(geometry, material, s_c), phi_c, onset


def assemble(unit: Skeleton, force, depth, status, load=None) -> ObliquePress:
    """The skeleton's response times the forces; the ring's status where it has one.

    Args:
        force: of the contact, which the rings bear.
        depth: local indentation.
        load: elastic force that the shape follows; None: the force.
    """
    load = force if load is None else load

    def per_ring(v, force=load):
        rows = product_of_rows(force.reshape(-1, 3), v.reshape(-1, 3).T)
        return rows.reshape(*force.shape[:-1], *v.shape[:-1])

    behind = unit.status == RingStatus.BEHIND_GAP
    status = jnp.where(behind, PressStatus.BEHIND_GAP, status).astype(jnp.int8)
    return ObliquePress(
        force=force,
        depth=depth,
        skeleton=product_of_rows(load, unit.compliance.T),
        slope_C=product_of_rows(load, unit.slope_C.T),
        joints=per_ring(unit.joints),
        slopes=per_ring(unit.slopes),
        loads=per_ring(unit.loads, force),
        end_U=per_ring(unit.end_U),
        end_V=per_ring(unit.end_V),
        clamps=per_ring(unit.clamps),
        status=status,
    )
