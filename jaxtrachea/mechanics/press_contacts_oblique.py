"""Several tools that press one trachea anywhere on its rings, each of which feels the others."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, check_word, shaped
from jaxtrachea._numerics import scaled
from jaxtrachea.mechanics import skeleton
from jaxtrachea.mechanics.influence_vector import by_all, influence_vector, own_contacts
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.press import local_law, read_values
from jaxtrachea.mechanics.press_contacts import (
    Asked,
    check_contact_options,
    checked_contacts,
    solve_rows,
)
from jaxtrachea.mechanics.ring import on_ring
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.mechanics.validation import (
    IN_TWO_PLANES,
    check_shapes,
    mask,
    status_of,
    validate,
)
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


class ObliqueContacts(NamedTuple):
    """Normal presses at m contacts anywhere on the rings, along rows of tool displacements.

    Vectors are x, y, z in the frame of the tube. Every contact has a line of joints, on its own
    meridian.

    Attributes:
        force: contact forces on the tube, along the inward normals, N; shape (*n, m, 3).
        depth: local indentation, mm; shape (*n, m). Negative: the gap between tool and wall.
        skeleton: displacement of each contact by the skeleton under all forces, mm; (*n, m, 3).
        joints: displacement of the ligament at each ring, mm; shape (*n, m, rings, 3).
        loads: force of each contact's ligament on each ring, N; shape (*n, m, rings, 3).
        end_U: displacement of each ring's end at phi = -alpha, mm; shape (*n, rings, 3).
        end_V: that at phi = +alpha.
        compliance: inward motion of contact i per unit force at contact j, mm/N; shape (m, m).
        status: a `PressStatus` for each displacement.
    """

    force: Float[Array, "*n m 3"]
    depth: Float[Array, "*n m"]
    skeleton: Float[Array, "*n m 3"]
    joints: Float[Array, "*n m rings 3"]
    loads: Float[Array, "*n m rings 3"]
    end_U: Float[Array, "*n rings 3"]
    end_V: Float[Array, "*n rings 3"]
    compliance: Float[Array, "m m"]
    status: Int[Array, "*n m"]


def press_contacts_oblique(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    displacement: ArrayLike,
    options: ObliqueOptions = ObliqueOptions(),
    *,
    onset: ArrayLike | None = None,
    present: ArrayLike | None = None,
) -> ObliqueContacts:
    """Press with m tools along the inward normals at (s_j, phi_j) and solve for all forces.

    A pinch, say: two tools on opposite sides, or one at the side and one in front. Tools slide on
    the wall without friction, so that all forces are normal. Each moves the skeleton for all
    others: it may lift the wall off another (LIFTED) or bring it against one that waits. The
    skeleton is that of `influence_vector`: each contact presses the ligament of its own meridian,
    and the rings couple them. Small deflections, linear skeleton, as `press_oblique`. On the
    midline with rings `mat` the answer is that of `press_contacts`.

    Args:
        geometry: the tube at rest.
        material: as for `press`, and what the rings need: EI_C and k_t for `arch2`.
        s_c: contact positions, mm, 1 to 16 of them in any order; shape (m,). Two may be equal.
        phi_c: their angles from the anterior midline, rad, in [-alpha, alpha]; shape (m,).
            Derivatives have a kink where two are equal.
        displacement: of each tool along its inward normal, mm; shape (*n, m). Negative: the tool
            is that far from the wall at rest.
        options: what is modelled (static): `press` as for `press_contacts`, `unilateral` and
            without a width; `rings` `arch2`, or `mat`, on which every ring moves without bending.
            `axial` is not read: no force is along the tube.
        onset: displacement of each tool at first touch, mm; shape (m,). 0 if None.
        present: which tools are there; shape (m,). All if None. See `press_contacts`.

    Returns:
        The `ObliqueContacts`; NaN as for `press_contacts`, and BEHIND_GAP where a contact lies
        behind the ends of the rings.

    Raises:
        ValueError: an option that is not derived for several contacts off the midline, a missing
            value of the material, and as `press_contacts`.
    """
    check_shapes(geometry, material)
    check_word("options", options, ObliqueOptions)
    check_off_midline(options, "press_contacts_oblique")
    asked = checked_contacts(geometry, s_c, displacement, onset, present)
    phi_c = shaped("phi_c", phi_c, asked.s_c.shape, dtype=asked.s_c.dtype)
    return _press_contacts_oblique(geometry, material, options, phi_c, asked)


def check_off_midline(options: ObliqueOptions, name: str) -> None:
    """Refuse what the function of this name has not for several contacts off the midline.

    Raises:
        ValueError: naming the option and the cure.
    """
    check_contact_options(options.press, name)
    if options.press.contact == "bonded":
        raise ValueError(
            f"{name} needs contact='unilateral', found 'bonded': a tool that is glued holds the "
            "wall along the surface, too; press by `press_oblique`"
        )
    if options.rings == "arch":
        raise ValueError(
            f"{name} needs rings='arch2' or 'mat', found 'arch': it has no motion of a ring at one "
            "angle by a load at another"
        )


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press_contacts_oblique(
    geometry: Geometry,
    material: Material,
    options: ObliqueOptions,
    phi_c: Float[Array, " m"],
    asked: Asked,
) -> ObliqueContacts:
    """`press_contacts_oblique`, of arguments that are checked."""
    press, levels = options.press, {"rings": options.rings, "shear": options.press.shear}
    used = (*read_values(press), *skeleton.read_values(**levels, axial=False))
    s_c, at, material, refused = places_of(
        geometry, material, asked.s_c, phi_c, asked.present, used
    )
    unit = influence_vector(geometry, material, s_c, at, **levels)
    law = jax.vmap(lambda s: local_law(geometry, material, s, press))(s_c)
    force, depth, status = solve_rows(asked, unit.compliance, law, press, geometry.radius)
    unit, force, depth = mask(refused, unit, force, depth)

    def each(v):
        """What each force does by itself."""
        more = v.ndim - 1
        v = v.reshape(*[1] * (force.ndim - 1), *v.shape)
        return scaled(force.reshape(*force.shape, *[1] * more), v)

    return ObliqueContacts(
        force=each(jax.vmap(local_frame)(at)[:, 0]),
        depth=depth,
        skeleton=by_all(force, own_contacts(unit)),
        joints=by_all(force, unit.joints),
        loads=each(unit.loads),
        end_U=by_all(force, unit.end_U),
        end_V=by_all(force, unit.end_V),
        compliance=unit.compliance,
        status=status_of(refused, status),
    )


def places_of(geometry: Geometry, material: Material, s_c, phi_c, present, used: tuple[str, ...]):
    """Places and material to compute with, and the refusal of all contacts, or OK.

    Args:
        s_c: positions, mm; shape (m,).
        phi_c: angles, rad.
        present: which contacts are there.
        used: values of the material that are read.
    """
    s_c = jnp.where(present, s_c, geometry.length / 2)
    admitted = functools.partial(validate, geometry, material, used=used, divided=IN_TWO_PLANES)
    s_c, refused = jax.vmap(lambda s: admitted(s)[1:])(s_c)
    material = admitted(s_c[0]).material
    on, at = on_ring(geometry.half_angle, phi_c)
    why = jnp.where(jnp.isnan(phi_c), PressStatus.NON_FINITE, PressStatus.BEHIND_GAP)
    on = on | ~present | (refused != PressStatus.OK)
    return s_c, at, material, jnp.max(jnp.where(on, refused, why)).astype(jnp.int8)
