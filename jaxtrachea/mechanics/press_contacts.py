"""Several tools that press one trachea on the midline, each of which feels the others."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike, last_axis, shaped
from jaxtrachea._numerics import product_of_rows
from jaxtrachea.mechanics.contacts import solve
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.influence import influence, level_influence
from jaxtrachea.mechanics.levels.options import Options, check_line
from jaxtrachea.mechanics.press import ligament_beam, local_law, read_values
from jaxtrachea.mechanics.validation import (
    check_shapes,
    float_type,
    mark_deep,
    mask,
    status_of,
    validate,
)
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

#: Contacts that one call takes at most.
MOST_CONTACTS = 16


class Contacts(NamedTuple):
    """Normal presses at m contacts, along any number of rows of tool displacements.

    Attributes:
        force: contact forces, N; shape of the displacement.
        depth: local indentation, mm; same shape. Negative: the gap between tool and wall.
        skeleton: deflection of each contact by the skeleton under all forces, mm; same shape.
        joints: deflection of the ligament at each ring, mm; shape (*n, rings).
        reactions: force of each ring against the loads, N; shape (*n, rings).
        compliance: deflection of contact i per unit force at contact j, mm/N; shape (m, m).
        status: a `PressStatus` for each displacement.
    """

    force: Float[Array, "*n m"]
    depth: Float[Array, "*n m"]
    skeleton: Float[Array, "*n m"]
    joints: Float[Array, "*n rings"]
    reactions: Float[Array, "*n rings"]
    compliance: Float[Array, "m m"]
    status: Int[Array, "*n m"]


def press_contacts(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    displacement: ArrayLike,
    options: Options = Options(),
    *,
    onset: ArrayLike | None = None,
    present: ArrayLike | None = None,
    bonded: ArrayLike | None = None,
) -> Contacts:
    """Press with m tools along the inward normals at (s_j, phi = 0) and solve for all forces.

    Each tool deflects the skeleton for all others, and may lift the wall off another (LIFTED).
    `press` is m = 1. First touch is rounded by the local indentation here, over
    `options.onset_width`, and there by the displacement: within the rounding forces differ, by
    2e-5 N where it is 1e-3 mm and k_1 0.3 N/mm. A law that softens is followed to its own peak, as
    in `contacts.solve`.

    Args:
        geometry: the tube at rest.
        material: as for `press`.
        s_c: contact positions, mm, 1 to 16 of them in any order; shape (m,). Two may be equal.
        displacement: of each tool along the inward normal, mm; shape (*n, m). Negative: the tool
            is that far from the wall at rest.
        options: what is modelled (static). `half_width` is that of every tool. Not with
            `coupling = "total"`, where contacts do not feel one another, nor with a skeleton that
            softens or deforms in cross-section, `split`, `form` and `relaxation`.
        onset: displacement of each tool at first touch, mm; shape (m,). 0 if None.
        present: which tools are there, to press with fewer in the same program; shape (m,). One
            that is not has no force, whatever its place and displacement. All if None.
        bonded: which tools are glued (forceps, a suture) beside others that are not; shape (m,).
            None: all as `options.contact` says.

    Returns:
        The `Contacts`. Where one number of a row is no number, or one contact of it has no
        solution, all numbers of this row are NaN, with the status; other rows are untouched. A
        contact off the tube (OFF_TUBE), a negative stiffness (BAD_MATERIAL), and a place or a
        stiffness that is no number (NON_FINITE) are NaN throughout.

    Raises:
        ValueError: too many contacts, a displacement of another number of them, an option that one
            contact alone has, and as `press`.
    """
    check_shapes(geometry, material)
    check_contact_options(options, "press_contacts")
    asked = checked_contacts(geometry, s_c, displacement, onset, present)
    if bonded is not None:
        asked = asked._replace(bonded=_truths("bonded", bonded, asked.s_c.shape[0]))
        options = dataclasses.replace(options, contact="unilateral")
    return _press_contacts(geometry, material, options, asked)


class Asked(NamedTuple):
    """What several contacts are asked, as arrays; as the arguments of `press_contacts`."""

    s_c: Float[Array, " m"]
    displacement: Float[Array, "*n m"]
    onset: Float[Array, " m"]
    present: Bool[Array, " m"]
    bonded: Bool[Array, " m"] | None = None


def checked_contacts(
    geometry: Geometry,
    s_c: ArrayLike,
    displacement: ArrayLike,
    onset: ArrayLike | None,
    present: ArrayLike | None,
) -> Asked:
    """The arguments of several contacts as arrays.

    Raises:
        ValueError: too many contacts, or arrays that do not fit their number.
    """
    s_c = checked_places(geometry, s_c)
    m, dtype = s_c.shape[0], s_c.dtype
    displacement = last_axis("displacement", displacement, m, dtype)
    onset = shaped("onset", jnp.zeros_like(s_c) if onset is None else onset, (m,), dtype=dtype)
    there = _truths("present", True if present is None else present, m)
    return Asked(s_c, displacement, onset, there)


def _truths(name: str, given: ArrayLike, m: int) -> Bool[Array, " m"]:
    """One truth value of each contact."""
    given = jnp.asarray(given)
    if given.dtype != bool or given.shape not in ((), (m,)):
        raise ValueError(
            f"{name} has shape {given.shape} of {given.dtype}; expected ({m},) of True and False"
        )
    return jnp.broadcast_to(given, (m,))


def checked_places(geometry: Geometry, s_c: ArrayLike) -> Float[Array, " m"]:
    """Positions of several contacts as an array.

    Raises:
        ValueError: too many contacts, or none.
    """
    s_c = shaped("s_c", s_c, ("any number of",), dtype=float_type(geometry))
    if not 1 <= s_c.shape[0] <= MOST_CONTACTS:
        raise ValueError(f"s_c has {s_c.shape[0]} contacts; expected 1 to {MOST_CONTACTS}")
    return s_c


def check_contact_options(options: Options, name: str) -> None:
    """Refuse what is derived for one contact alone.

    Raises:
        ValueError: naming the option and the cure.
    """
    check_line(options, name)
    why = {
        "coupling": ("series", "contacts do not feel one another with it; press each by itself"),
        "skeleton": ("linear", "its softening is that of one contact; press each by itself"),
        "split": ("continuous", "the paper's split has no motion of one contact by another"),
        "form": ("recursion", "it has the same answer"),
    }
    for field, (only, reason) in why.items():
        if (value := getattr(options, field)) != only:
            raise ValueError(f"{name} needs {field}={only!r}, found {value!r}: {reason}")


@functools.partial(jax.jit, static_argnames="options", inline=True)
def _press_contacts(
    geometry: Geometry,
    material: Material,
    options: Options,
    asked: Asked,
) -> Contacts:
    """`press_contacts`, of arguments that are checked."""
    used, half = read_values(options), options.half_width
    s_c = jnp.where(asked.present, asked.s_c, geometry.length / 2)
    s_c, refused = jax.vmap(lambda s: validate(geometry, material, s, used, reach=half)[1:])(s_c)
    material = validate(geometry, material, s_c[0], used).material
    refused = jnp.max(refused)
    beam = ligament_beam(geometry, material, options)
    unit = influence(beam, s_c) if half == 0 else level_influence(beam, s_c, half)
    law = jax.vmap(lambda s: local_law(geometry, material, s, options))(s_c)
    force, depth, status = solve_rows(asked, unit.compliance, law, options, geometry.radius)
    unit, force, depth = mask(refused, unit, force, depth)
    return Contacts(
        force=force,
        depth=depth,
        skeleton=product_of_rows(force, unit.compliance),
        joints=product_of_rows(force, unit.joints),
        reactions=product_of_rows(force, unit.reactions),
        compliance=unit.compliance,
        status=status_of(refused, status),
    )


def solve_rows(
    asked: Asked,
    compliance: Float[Array, "m m"],
    law: Law,
    options: Options,
    radius: Float[Array, ""],
) -> tuple[Float[Array, "*n m"], Float[Array, "*n m"], Int[Array, "*n m"]]:
    """Forces, N, local indentations, mm, and statuses of contacts on a skeleton that is known."""
    # The loop of `solve` keeps its dtype: float32 arguments meet a float64 tube here.
    dtype = jnp.result_type(asked.displacement, compliance, *jax.tree.leaves(law))
    displacement = asked.displacement.astype(dtype)
    onset = jnp.where(asked.present, asked.onset, 0)
    width = None
    if options.contact == "unilateral":
        width = jnp.asarray(options.onset_width, displacement.dtype)

    def row(D):
        there, glued = asked.present, asked.bonded
        return solve(D - onset, compliance, law, width=width, present=there, bonded=glued)

    solved = jax.vmap(row)(displacement.reshape(-1, displacement.shape[-1]))
    force, depth, status = (
        v.reshape(displacement.shape) for v in (solved.force, solved.depth, solved.status)
    )
    moved = displacement - jnp.broadcast_to(onset, displacement.shape).astype(displacement.dtype)
    return force, depth, mark_deep(status, moved, radius)
