"""The skeleton under a force in any direction at (s_c, phi_c): ligament, rings and ends together.

All vectors are in the frame of the tube: x along s towards the larynx, y anterior, z to the side of
positive phi. The ligament beam runs through C parallel to the axis, J_i = (s_i, phi_c). It bends in
two planes and stretches; at phi_c each ring answers with its own compliance.
"""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, check_word, shaped
from jaxtrachea._numerics import turned
from jaxtrachea.mechanics import axial as _axial
from jaxtrachea.mechanics import ring as _ring
from jaxtrachea.mechanics import spatial_beam
from jaxtrachea.mechanics._matrix2 import mul
from jaxtrachea.mechanics.validation import (
    IN_TWO_PLANES,
    check_place,
    float_type,
    mask,
    status_of,
    validate,
)
from jaxtrachea.status import PressStatus, RingStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

Rings = Literal["mat", "arch", "arch2"]


class Skeleton(NamedTuple):
    """What the skeleton does per unit force at C; the last axis is the force's x, y, z.

    Attributes:
        compliance: displacement of C, mm/N; symmetric.
        slope_C: dw/ds of C in y and z, 1/N (with shear: rotation of the section).
        joints: displacement of each joint J_i, mm/N.
        slopes: rotation there, as `slope_C`, 1/N.
        loads: y, z: force of the ligament on each ring, its joint load P_i. x: axial force that
            passes the joint on its way to the clamp; the rings take none of it.
        end_U: displacement of each ring's end at phi = -alpha, mm/N.
        end_V: that at phi = +alpha.
        clamps: displacement of the ends A and B of the tube on their axial springs, mm/N.
        status: a `RingStatus` as int8.
    """

    compliance: Float[Array, "3 3"]
    slope_C: Float[Array, "2 3"]
    joints: Float[Array, "rings 3 3"]
    slopes: Float[Array, "rings 2 3"]
    loads: Float[Array, "rings 3 3"]
    end_U: Float[Array, "rings 3 3"]
    end_V: Float[Array, "rings 3 3"]
    clamps: Float[Array, "2 3 3"]
    status: Int[Array, ""]


def local_frame(phi_c: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rows: inward normal, axial (+s) and circumferential (+phi) direction at phi_c, as x, y, z."""
    zero, one, c, s = jnp.zeros_like(phi_c), jnp.ones_like(phi_c), jnp.cos(phi_c), jnp.sin(phi_c)
    return jnp.stack([jnp.stack(row) for row in ([zero, -c, -s], [one, zero, zero], [zero, -s, c])])


def skeleton_response(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    *,
    rings: Rings = "arch2",
    axial: bool = True,
    shear: bool = False,
) -> Skeleton:
    """Response of ligament and rings to a force at (s_c, phi_c).

    Args:
        geometry: the tube at rest.
        material: k_M, EI_L; `axial` needs EA_L, `shear` GA_L, the arches EI_C and k_t. A negative
            stiffness gives NaN and BAD_MATERIAL.
        s_c: mm, in [0, length]; beyond, NaN and OFF_TUBE.
        phi_c: rad, in [-alpha, alpha]; beyond, NaN and BEHIND_GAP.
        rings: `mat`: every ring moves on k_M alike in y and z, without turning (the paper);
            `arch`: alike too, with the stiffness of the arch along the normal at phi_c; `arch2`:
            the 2x2 compliance of the arch at phi_c.
        axial: the ligament also stretches; without, C does not move along x.
        shear: it also shears.

    Raises:
        ValueError: a missing value of the material, an array whose length does not fit the tube, or
            an unknown level of `rings`.
    """
    check_word("rings", rings, Rings)
    axial, shear = bool(axial), bool(shear)
    phi_c = shaped("phi_c", phi_c, (), dtype=float_type(geometry))
    s_c = check_place(geometry, material, s_c)
    return _response(geometry, material, s_c, phi_c, rings=rings, axial=axial, shear=shear)


@functools.partial(jax.jit, static_argnames=("rings", "axial", "shear"), inline=True)
def _response(
    geometry: Geometry,
    material: Material,
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    *,
    rings: Rings,
    axial: bool,
    shear: bool,
) -> Skeleton:
    """`skeleton_response`, of arguments that are checked."""
    used = read_values(rings, axial=axial, shear=shear)
    asked = validate(geometry, material, s_c, used, divided=IN_TWO_PLANES)
    levels = {"rings": rings, "axial": axial, "shear": shear}
    unit = respond(geometry, asked.material, asked.s_c, phi_c, **levels)
    off_tube = asked.refused == PressStatus.OFF_TUBE
    own = jnp.where(off_tube, RingStatus.OFF_TUBE, RingStatus.BAD_MATERIAL)
    status = status_of(asked.refused, unit.status, own)
    return mask(asked.refused, unit)._replace(status=status)


def read_values(rings: Rings, *, axial: bool, shear: bool) -> tuple[str, ...]:
    """Values of the material that the skeleton reads; none may be negative."""
    names = ("EI_L", "EI_side", "k_M")
    names += ("EA_L", "k_A", "k_B") if axial else ()
    names += ("GA_L", "GA_side") if shear else ()
    return names + (() if rings == "mat" else ("EI_C", "k_t"))


def respond(
    geometry: Geometry,
    material: Material,
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    *,
    rings: Rings,
    axial: bool,
    shear: bool,
) -> Skeleton:
    """As `skeleton_response`, at a place on the tube with stiffnesses that are not negative."""
    frame = local_frame(phi_c)[::2, 1:]  # rows: inward normal, circumferential; columns y, z
    C, per_load, status = _rings(geometry, material, phi_c, rings)
    x = geometry.ring_positions
    n = x.shape[0]
    EI = planes(material.EI_L, material.EI_side, n + 1)
    GA = planes(needed(material, "GA_L", "shear"), material.GA_side, n + 1) if shear else None
    beam = spatial_beam.SpatialBeam(x, geometry.length, EI, turned(C, frame.T), GA)
    unit = jax.vmap(spatial_beam.deflect, (None, None, 0), -1)(beam, s_c, jnp.eye(2, dtype=x.dtype))

    # To y and z: components on the left, the force's on the right.
    w_C, w, P = (turned(v, frame) for v in (unit.w_C, unit.w, unit.reaction))
    along = None
    if axial:
        EA = jnp.broadcast_to(needed(material, "EA_L", "axial"), (n + 1,))
        ends = {"k_A": material.k_A, "k_B": material.k_B}
        along = _axial.stretch(x, geometry.length, EA, s_c, jnp.ones_like(s_c), **ends)
    u_C, u, passed = jnp.zeros_like(s_c), jnp.zeros_like(x), jnp.zeros_like(x)
    u_clamps = jnp.zeros_like(x, shape=2)
    if along is not None:
        u_C, u, u_clamps = along.u_C, along.u, jnp.stack([along.u_A, along.u_B])
        passed = jnp.where(x <= s_c, along.force_A, along.force_B)
    U, V = (w, w) if per_load is None else (jax.vmap(mul)(end, P) for end in per_load)
    return Skeleton(
        compliance=_join(u_C, (w_C + w_C.T) / 2),
        slope_C=_widen(turned(unit.theta_C, frame)),
        joints=_join(u, w),
        slopes=_widen(turned(unit.theta, frame)),
        loads=_join(passed, P),
        end_U=_join(u, U),
        end_V=_join(u, V),
        clamps=_join(u_clamps, jnp.zeros_like(u_clamps, shape=(2, 2, 2))),
        status=status,
    )


def needed(material: Material, name: str, option: str) -> Array:
    """A value of the material.

    Raises:
        ValueError: it is None; naming the option that needs it.
    """
    value = getattr(material, name)
    if value is None:
        raise ValueError(f"{option} needs Material.{name}; it is None")
    return value


def planes(normal, side, spans: int) -> Float[Array, "spans 2"]:
    """Stiffness of each span in the planes of the normal and of the circumference."""
    pair = (normal, normal if side is None else side)
    return jnp.stack([jnp.broadcast_to(v, (spans,)) for v in pair], 1)


def turned_rings(
    geometry: Geometry, material: Material, phi_c: Float[Array, ""], rings: Rings
) -> Float[Array, "rings 2 2"]:
    """Compliance of each ring at phi_c along (inward normal, circumferential), mm/N."""
    frame = local_frame(phi_c)[::2, 1:]
    return turned(_rings(geometry, material, phi_c, rings)[0], frame.T)


def _rings(geometry: Geometry, material: Material, phi_c, level: Rings):
    """Compliance at phi_c (n, 2, 2), motion of the ends U and V per load (or None), and status."""
    k_M = jnp.broadcast_to(material.k_M, geometry.ring_positions.shape)
    eye = jnp.eye(2, dtype=geometry.radius.dtype)[None]
    if level == "mat":
        on, _ = _ring.on_ring(geometry.half_angle, phi_c)
        off = jnp.where(jnp.isnan(phi_c), RingStatus.NON_FINITE, RingStatus.BEHIND_GAP)
        status = jnp.where(on, RingStatus.OK, off).astype(jnp.int8)
        return eye / jnp.where(on, k_M, jnp.nan)[:, None, None], None, status
    EI, k_t = (needed(material, name, f"rings={level!r}") for name in ("EI_C", "k_t"))

    def one(k):
        ring = _ring.Ring(geometry.radius, geometry.half_angle, EI, k, k_t)
        C, status = _ring.ring_compliance(ring, phi_c)
        ends = -geometry.half_angle, geometry.half_angle
        return C, tuple(_ring.ring_influence(ring, end, phi_c) for end in ends), status

    if material.k_M.ndim == 0:

        def alike(v):
            return jnp.broadcast_to(v, (*k_M.shape, *v.shape))

        C, ends, status = jax.tree.map(alike, one(material.k_M))
    else:
        # Not vmap: XLA's CPU compiler (jaxlib 0.10.2) then gets wrong forward derivatives of many
        # arguments at once (tests/test_oblique.py: test_gradients).
        C, ends, status = jax.lax.map(one, k_M)
    if level == "arch":
        normal = jnp.stack([jnp.cos(phi_c), jnp.sin(phi_c)])
        C = turned(C, normal[:, None]) * eye
    return C, ends, jnp.max(status)


def _widen(v):
    """A column of zeros for the force's x."""
    return jnp.concatenate([jnp.zeros_like(v[..., :1]), v], -1)


def _join(axial, transverse):
    """Block diagonal of x and (y, z)."""
    x = jnp.concatenate([axial[..., None], jnp.zeros_like(transverse[..., 0])], -1)
    return jnp.concatenate([x[..., None, :], _widen(transverse)], -2)
