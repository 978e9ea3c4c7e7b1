"""What a press may be asked: shapes that fit the tube, a place on it, stiffnesses it can be of.

Shapes are static and end in a `ValueError`; places and stiffnesses may be traced and end in a
status. Refused values are replaced *before* they are used and the results hidden after, so that
derivatives of other rows stay finite.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike, check_fits, check_word, shaped
from jaxtrachea._errors import InputError
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import VALUES, Material, meaningless

#: What skeletons of two planes divide by on top of `Declaration.divides`.
IN_TWO_PLANES = ("k_M",)


class Validated(NamedTuple):
    """What a press is computed with.

    Attributes:
        material: with 1 in place of values that it cannot have, or that are not finite.
        s_c: contact position, mm; the middle of the tube in place of one where it is refused.
        refused: `PressStatus`: OK, OFF_TUBE, NON_FINITE or BAD_MATERIAL.
    """

    material: Material
    s_c: Float[Array, ""]
    refused: Int[Array, ""]


def validate(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    used: Iterable[str],
    *,
    reach: float = 0.0,
    divided: Iterable[str] = (),
) -> Validated:
    """Check what a press is asked.

    Args:
        material: its shapes are checked, all of them.
        s_c: contact position, mm.
        used: names of the values of the material that the model reads and that must not be
            negative; None values are passed over.
        reach: how far the tool extends along s from s_c, mm: none of it may lie off the tube.
        divided: see `without_negative`.

    Raises:
        ValueError: a value of the material that is neither a scalar nor one for each span or ring,
            or a contact position that is no scalar.
    """
    s_c, length, used = check_place(geometry, material, s_c), geometry.length, tuple(used)
    on = (s_c >= reach) & (s_c <= length - reach)
    material, bad = without_negative(material, used, divided)
    material, lost = _replaced(material, used, lambda value: ~jnp.isfinite(value))
    refused = jnp.where(on, PressStatus.OK, PressStatus.OFF_TUBE)
    refused = jnp.where(~lost & ~jnp.isnan(s_c), refused, PressStatus.NON_FINITE)
    refused = jnp.where(bad, PressStatus.BAD_MATERIAL, refused).astype(jnp.int8)
    return Validated(material, jnp.where(on, s_c, length / 2), refused)


def check_place(geometry: Geometry, material: Material, s_c: ArrayLike) -> Float[Array, ""]:
    """The contact position, mm, as an array, where tube, material and position are of their shapes.

    Raises:
        ValueError: as `check_shapes`, or a contact position that is no scalar.
    """
    check_shapes(geometry, material)
    dtype = geometry.length.dtype
    return shaped("s_c", s_c, (), dtype=dtype, why="; use jax.vmap for many positions")


def float_type(geometry: Geometry) -> jnp.dtype:
    """The floating dtype of a tube.

    Raises:
        ValueError: it is none.
    """
    check_word("geometry", geometry, Geometry)
    return geometry.length.dtype


def check_shapes(geometry: Geometry, material: Material) -> None:
    """Refuse arrays of a wrong length, and values that mean nothing without one that is missing.

    Raises:
        ValueError: the argument, its length and the expected one; or what it is missing; no tube or
            no material.
    """
    check_word("geometry", geometry, Geometry)
    check_word("material", material, Material)
    for name in ("length", "radius", "half_angle", "ring_height"):
        shaped(f"Geometry.{name}", getattr(geometry, name), (), why="; use jax.vmap for many")
    shaped("Geometry.ring_positions", geometry.ring_positions, ("any number of",))
    rings = geometry.rings
    for field in dataclasses.fields(material):
        value, name = getattr(material, field.name), f"Material.{field.name}"
        if value is None:
            continue
        if VALUES[field.name].varies_by == "span":
            why = f" ({rings} rings make {rings + 1} spans)"
            shaped(name, value, (), (rings + 1,), why=why)
        elif VALUES[field.name].varies_by == "ring":
            shaped(name, value, (), (rings,), why=" (one for each ring)")
        else:
            shaped(name, value, ())
    given = (name for name in VALUES if getattr(material, name) is not None)
    for name, other in meaningless(given).items():
        raise InputError(
            f"given without Material.{other}, and would be ignored", key=f"Material.{name}",
            cure=f"give Material.{other} too, or leave it out",
        )  # fmt: skip


def check_alike(material: Material, like: Any, cure: str) -> None:
    """Refuse a material that a program compiled for one `like` this cannot take.

    Args:
        material: its shapes fit the tube (`check_shapes`).
        like: a `Material` of arrays or of their shapes and dtypes.
        cure: what else to do, for the message.

    Raises:
        ValueError: a value that is missing or was not there, of another shape or dtype. A single
            number fits any shape, one from Python any dtype.
    """
    for name in VALUES:
        value, known, key = getattr(material, name), getattr(like, name), f"Material.{name}"
        if value is not None and known is not None:
            check_fits(key, value, known, cure, spread=True)
        elif value is not known:
            found, was = ("missing", "with") if value is None else ("given", "without")
            raise InputError(f"is {found}; the program was compiled {was} it", key=key,
                             joint=" ", cure=f"give the same values, or {cure}")  # fmt: skip


def without_negative(
    material: Material, used: Iterable[str], divided: Iterable[str] = ()
) -> tuple[Material, Array]:
    """The material with 1 in place of negative values, and whether there were any.

    And of zeros where a model divides: `Declaration.divides`, and `divided`, of this one alone.
    """
    used = tuple(used)
    never = {name for name in used if VALUES[name].divides} | set(divided)
    material, bad = _replaced(material, never, lambda value: value <= 0)
    material, negative = _replaced(material, set(used) - never, lambda value: value < 0)
    return material, bad | negative


def _replaced(
    material: Material, used: Iterable[str], wrong: Callable[[Array], Array]
) -> tuple[Material, Array]:
    """The material with 1 in place of values that are `wrong`, and whether there were any."""
    safe, found = {}, jnp.zeros((), bool)
    for name in used:
        if (value := getattr(material, name)) is not None:
            bad = wrong(value)
            safe[name] = jnp.where(bad, 1, value)
            found = found | jnp.any(bad)
    return dataclasses.replace(material, **safe), found


def has_solution(status: Int[Array, "*n"]) -> Bool[Array, "*n"]:
    """Where a row holds a solution, with a warning or without (`PressStatus.solved`)."""
    return functools.reduce(operator.or_, (status == s for s in PressStatus if s.solved))


def mask(refused: Int[Array, ""], *arrays: Any) -> Any:
    """NaN for every number of a refused press.

    Where products of several of these are returned, hiding the factors is enough, and cheaper:
    `where` passes no derivative, not even NaN, to what it hides.

    Returns:
        The same, one for each argument (of one argument: itself).
    """
    off = refused != PressStatus.OK

    def floating(v):
        return jnp.issubdtype(v.dtype, jnp.floating)

    hidden = jax.tree.map(lambda v: jnp.where(off, jnp.nan, v) if floating(v) else v, arrays)
    return hidden[0] if len(hidden) == 1 else hidden


def mark_deep(
    status: Int[Array, "*n"], moved: Float[Array, "*n"], radius: Float[Array, ""]
) -> Int[Array, "*n"]:
    """TOO_DEEP in the place of OK where the wall has moved further than the tube's radius.

    Args:
        status: a `PressStatus` each.
        moved: motion of the wall at the contact, mm.
        radius: of the tube, mm.
    """
    far = jnp.abs(moved) > jnp.asarray(radius, moved.dtype)
    deep = (status == PressStatus.OK) & far
    return jnp.where(deep, PressStatus.TOO_DEEP, status).astype(jnp.int8)


def status_of(
    refused: Int[Array, ""], status: Int[Array, "*n"], own: Int[Array, ""] | None = None
) -> Int[Array, "*n"]:
    """The status of a press, or why it was refused (`own`: in the words of another enumeration)."""
    return jnp.where(refused != PressStatus.OK, refused if own is None else own, status).astype(
        jnp.int8
    )
