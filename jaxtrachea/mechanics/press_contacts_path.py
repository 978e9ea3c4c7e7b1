"""Several tools with friction on one trachea, each of which feels what the others drag along."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike, check_word, shaped
from jaxtrachea.mechanics import skeleton
from jaxtrachea.mechanics.contacts_friction import slide_paths
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.influence_vector import by_all, influence_vector, own_contacts
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.press import indentation, local_law, read_values
from jaxtrachea.mechanics.press_contacts import checked_places
from jaxtrachea.mechanics.press_contacts_oblique import check_off_midline, places_of
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.mechanics.validation import check_shapes, mark_deep, mask, status_of
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material


class ContactsPath(NamedTuple):
    """Presses of m tools side by side along a path with friction; vectors are x, y, z of the tube.

    Attributes:
        force: contact forces on the tube, N; shape (steps, m, 3).
        depth: local indentation, mm; (steps, m, 3).
        skeleton: displacement of each contact by the skeleton under all forces, mm; (steps, m, 3).
        joints: displacement of the ligament at each ring, of the line of joints on the meridian of
            each contact, mm; (steps, m, rings, 3).
        end_U: displacement of each ring's end at phi = -alpha, mm; (steps, rings, 3).
        end_V: that at phi = +alpha.
        slip: way each tool has slid over the surface, mm; (steps, m, 3).
        dissipated: work lost to friction in each step, N mm; (steps, m).
        sliding: whether each tool slides in the step; (steps, m).
        compliance: motion of contact i per unit force at contact j, mm/N, both in (inward, along,
            round the tube); (m, 3, m, 3).
        status: a `PressStatus` of each tool in each step.
    """

    force: Float[Array, "steps m 3"]
    depth: Float[Array, "steps m 3"]
    skeleton: Float[Array, "steps m 3"]
    joints: Float[Array, "steps m rings 3"]
    end_U: Float[Array, "steps rings 3"]
    end_V: Float[Array, "steps rings 3"]
    slip: Float[Array, "steps m 3"]
    dissipated: Float[Array, "steps m"]
    sliding: Bool[Array, "steps m"]
    compliance: Float[Array, "m 3 m 3"]
    status: Int[Array, "steps m"]


def press_contacts_path(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    displacement: ArrayLike,
    friction: Coulomb,
    options: ObliqueOptions = ObliqueOptions(),
) -> ContactsPath:
    """Lead m tools side by side; each sticks and slides by Coulomb's law as in `press_path`.

    Each arrives at a wall that the forces of all others move (`contacts_friction`); the skeleton is
    that of `influence_vector`. Of one tool it is `press_path`. Every contact keeps its place: for
    slips small against the ring distance. High friction (mu beyond 1) with strong coupling of
    normal and tangent may have more than one solution.

    Args:
        geometry: the tube at rest.
        material: as for `press_oblique`.
        s_c: contact positions, mm, 1 to 16 of them in any order; shape (m,).
        phi_c: their angles from the anterior midline, rad, in [-alpha, alpha]; shape (m,).
        displacement: of the tools at the end of each step, x, y, z, mm, from where each just
            touches the wall at rest; shape (steps, m, 3).
        friction: between each tool and the surface; `mu` a number or of shape (m,); 0: it slides
            freely.
        options: as for `press_contacts_oblique`, and `axial`: the ligament stretches.

    Returns:
        The `ContactsPath`. A step in which one tool has no solution is NaN for all, with its
        status; the next one goes on from before it. OFF_TUBE, BEHIND_GAP, BAD_MATERIAL (also: a
        negative mu) and NON_FINITE where it is of the material, a place or mu are NaN throughout.

    Raises:
        ValueError: an option that is not derived for several contacts off the midline, a missing
            value of the material, or arrays that do not fit.
    """
    check_shapes(geometry, material)
    check_word("options", options, ObliqueOptions)
    check_word("friction", friction, Coulomb)
    check_off_midline(options, "press_contacts_path")
    s_c = checked_places(geometry, s_c)
    m, dtype = s_c.shape[0], s_c.dtype
    phi_c = shaped("phi_c", phi_c, (m,), dtype=dtype)
    displacement = shaped("displacement", displacement, ("steps", m, 3), dtype=dtype)
    mu = jnp.asarray(friction.mu, dtype)
    mu = shaped("friction", jnp.broadcast_to(mu, (m,)) if mu.ndim == 0 else mu, (m,), dtype=dtype)
    friction = Coulomb(mu, friction.rounding)
    return _press_contacts_path(geometry, material, options, s_c, phi_c, displacement, friction)


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press_contacts_path(
    geometry: Geometry,
    material: Material,
    options: ObliqueOptions,
    s_c: Float[Array, " m"],
    phi_c: Float[Array, " m"],
    displacement: Float[Array, "steps m 3"],
    friction: Coulomb,
) -> ContactsPath:
    """`press_contacts_path`, of arguments that are checked."""
    press, m, mu = options.press, s_c.shape[0], jnp.asarray(friction.mu)
    levels = {"rings": options.rings, "shear": press.shear, "axial": options.axial}
    used = (*read_values(press), *skeleton.read_values(**levels))
    there = jnp.ones(m, bool)
    s, phi, material, refused = places_of(geometry, material, s_c, phi_c, there, used)
    refused = jnp.where(jnp.any(mu < 0), PressStatus.BAD_MATERIAL, refused)
    refused = jnp.where(jnp.any(jnp.isnan(mu)), PressStatus.NON_FINITE, refused).astype(jnp.int8)
    unit = influence_vector(geometry, material, s, phi, tangential=True, **levels)
    law = jax.vmap(lambda at: local_law(geometry, material, at, press))(s)
    frames, C = jax.vmap(local_frame)(phi), unit.compliance.reshape(m, 3, m, 3)
    D = smooth_touch(_turned(displacement, jnp.swapaxes(frames, 1, 2)), press)
    friction = Coulomb(jnp.where(mu >= 0, mu, 0), friction.rounding)
    slid = slide_paths(D, C, law, friction)
    status = mark_deep(slid.status, jnp.sqrt(jnp.sum(displacement**2, -1)), geometry.radius)
    unit, force, slid = mask(refused, unit, slid.force, slid)
    flat = force.reshape(len(force), -1)
    return ContactsPath(
        force=_turned(force, frames),
        depth=_turned(slid.depth, frames),
        skeleton=by_all(flat, own_contacts(unit)),
        joints=by_all(flat, unit.joints),
        end_U=by_all(flat, unit.end_U),
        end_V=by_all(flat, unit.end_V),
        slip=_turned(slid.slip, frames[:, 1:]),
        dissipated=slid.dissipated,
        sliding=slid.sliding & (refused == PressStatus.OK),
        compliance=mask(refused, C),
        status=status_of(refused, status),
    )


def smooth_touch(displacement: Float[Array, "*n 3"], options: Options) -> Float[Array, "*n 3"]:
    """(Inward, tangent, tangent) with the smooth first touch that one tool by itself has, mm."""
    inward, onset = displacement[..., 0], jnp.zeros((), displacement.dtype)
    inward = jnp.where(inward < 0, inward, indentation(inward, onset, options))
    return jnp.concatenate([inward[..., None], displacement[..., 1:]], -1)


def _turned(v, frames):
    return jnp.einsum("nmk,mkx->nmx", v, frames, precision="highest")
