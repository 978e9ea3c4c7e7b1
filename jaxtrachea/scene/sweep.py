"""Normal presses at many contact points."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, check_word, shaped
from jaxtrachea._numerics import full_precision
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.mechanics.oblique import place_at, press_at
from jaxtrachea.mechanics.press import press
from jaxtrachea.mechanics.ring import on_ring
from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.needs import off_midline
from jaxtrachea.scene.ranges import deep, depth_share, lacking
from jaxtrachea.scene.refusals import REFUSALS, on_the_tube, status_of
from jaxtrachea.scene.stage import Scene, check_kind, check_material
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.material import Material


class Sweep(NamedTuple):
    """Normal presses at many contact points.

    Attributes:
        force: normal contact force, N; shape (points,).
        indentation: local, along the normal, mm.
        compliance: of the skeleton along the normal, mm/N: of one that softens, its deflection
            over the force; NaN where nothing moves.
        depth_share: as in `Simulation`.
        status: a `PressStatus` each.
    """

    force: Float[Array, " points"]
    indentation: Float[Array, " points"]
    compliance: Float[Array, " points"]
    depth_share: Float[Array, " points"]
    status: Int[Array, " points"]


def sweep(
    scene: Scene,
    material: AnyMaterial,
    s: ArrayLike,
    phi: ArrayLike,
    depth: ArrayLike,
    *,
    chunk: int = 256,
) -> Sweep:
    """Press along the normal at many contact points, `chunk` of them at a time.

    Args:
        scene: its geometry and the level of rings, skeleton, shear and laws of its plan are used;
            OFF_PLAN where a point presses and the material gives more than the plan has (as in
            `simulate`), or off the midline with a tool's width or on a skeleton that softens or has
            one plane.
        s: mm.
        phi: rad, within the half-angle of the rings; else BEHIND_GAP where it presses.
        depth: of the tool along the inward normal, mm; 0 and less: NO_CONTACT (see `Options`).
        chunk: points computed together, at least 1.

    Raises:
        ValueError: arrays of different lengths, or no numbers; the material of another skeleton, or
            of arrays that do not fit the tube; no scene; a `chunk` that is no number of points.
    """
    check_word("scene", scene, Scene)
    check_kind(scene, material)
    check_material(scene.geometry, material)
    check_word("chunk", chunk, int)
    if chunk < 1:
        raise ValueError(f"chunk is {chunk}; expected a whole number of points, 1 or more")
    dtype = scene.geometry.length.dtype
    s = shaped("s", s, ("points",), dtype=dtype)
    phi, depth = (
        shaped(name, value, s.shape, dtype=dtype, why=" (as s has)")
        for name, value in (("phi", phi), ("depth", depth))
    )
    return _sweep(scene, material, s, phi, depth, chunk)


@functools.partial(jax.jit, static_argnames="chunk", inline=True)
@full_precision
def _sweep(
    scene: Scene,
    material: AnyMaterial,
    s: Float[Array, " points"],
    phi: Float[Array, " points"],
    depth: Float[Array, " points"],
    chunk: int,
) -> Sweep:
    """`sweep`, of arguments that are checked."""
    unlike = set(lacking(scene, material)) - {"axial"}
    lasting = long_run(material)
    straight_in = scene.plan.has("skeleton") or scene.plan.has("width")
    flat = straight_in and not scene.plan.second_plane
    kind = "width" if scene.plan.has("width") else scene.plan.options.skeleton
    pressed = _PRESSED[kind]

    def one(at):
        s_c, phi_at, d = at
        acting = d != 0 if scene.plan.options.contact == "bonded" else ~(d <= 0)
        behind = on_the_tube(scene, s_c, phi_at)[2] & ~acting
        phi_c, d = (jnp.where(behind, 0, v) for v in (phi_at, d))  # needs nothing of the rings
        inward = local_frame(phi_c)[0]
        found = pressed(scene, lasting, s_c, phi_c, d)
        force, way, depth = (v @ inward for v in (found.force, found.skeleton, found.depth))
        free = ~(force != 0)
        softness = jnp.where(free, jnp.nan, way / jnp.where(free, 1, force))
        share = depth_share(scene, found.depth, found.skeleton, inward)
        refused = {PressStatus.NON_FINITE: jnp.isnan(s_c + phi_at + d)}
        if unlike or flat:
            off = acting
            if flat and not unlike:
                off = acting & off_midline(phi_at)
            elif unlike == {"skeleton"}:
                off = acting & deep(scene, lasting, d)
            refused = {code: refused.get(code, False) | (found.status == code) for code in REFUSALS}
            refused[PressStatus.OFF_PLAN] = off
            force, depth, softness = (jnp.where(off, jnp.nan, v) for v in (force, depth, softness))
        status = status_of(found.status, share, None, refused)
        return Sweep(
            force=force, indentation=depth, compliance=softness, depth_share=share, status=status
        )

    return jax.lax.map(one, (s, phi, depth), batch_size=chunk)


class _Pressed(NamedTuple):
    """A press along the normal: fields as in `ObliquePress`."""

    force: Float[Array, "3"]
    depth: Float[Array, "3"]
    skeleton: Float[Array, "3"]
    status: Int[Array, ""]


def _vectors(scene: Scene, material: Material, s_c, phi_c, depth) -> _Pressed:
    """On a linear skeleton, anywhere on the rings."""
    straight = dataclasses.replace(scene.plan.oblique, axial=False)  # along the normal
    D = depth * local_frame(phi_c)[0]
    press = press_at(place_at(scene.geometry, material, s_c, phi_c, straight), D, straight.press)
    return _Pressed(press.force, press.depth, press.skeleton, press.status)


def _on_the_midline(scene: Scene, material: Material, s_c, phi_c, depth) -> _Pressed:
    """By a tool with a width or on a skeleton that softens, whatever the angle on the rings."""
    inward = local_frame(phi_c)[0]
    on = on_ring(scene.geometry.half_angle, phi_c)[0]
    found = press(scene.geometry, material, s_c, depth, scene.plan.options)
    status = jnp.where(on, found.status, PressStatus.BEHIND_GAP)
    force, depth, skeleton = (v * inward for v in (found.force, found.depth, found.skeleton))
    return _Pressed(force, depth, skeleton, status)


def _sections(scene: Scene, material: SectionMaterial, s_c, phi_c, depth) -> _Pressed:
    """On deforming cross-sections, anywhere on the rings; with one plane on the midline."""
    flat = not scene.plan.second_plane
    inward = local_frame(phi_c)[0]
    on = on_ring(scene.geometry.half_angle, phi_c)[0]
    at = jnp.zeros_like(phi_c) if flat else phi_c
    found = press_sections(
        scene.geometry, material, s_c, at, depth[None],
        options=SectionOptions(flat, scene.plan.options.half_width),
    )  # fmt: skip
    status = jnp.where(on, found.status[0], PressStatus.BEHIND_GAP)
    normal = local_frame(at)[0]
    force, way, skeleton = (
        jnp.sum(v[0] * normal) * inward for v in (found.force, found.depth, found.skeleton)
    )
    return _Pressed(force, way, skeleton, status)


_PRESSED = {"linear": _vectors, "width": _on_the_midline, "softening": _on_the_midline,
            "sections": _sections}  # fmt: skip
