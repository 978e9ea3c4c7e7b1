"""Rows that are refused, and the status of every row."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.ring import on_ring
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.mechanics.skeleton import read_values as skeleton_values
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.lumen import off_the_end
from jaxtrachea.scene.ranges import DEEPEST, outside_plan
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.status import ContactStatus, PressStatus

#: Statuses of rows that are refused; of several that a row could have, the last.
REFUSALS = (PressStatus.OFF_TUBE, PressStatus.OFF_PLAN, PressStatus.BEHIND_GAP,
            PressStatus.IN_LUMEN, PressStatus.NON_FINITE, PressStatus.BAD_MATERIAL)  # fmt: skip


def without_negative_values(scene: Scene, material: AnyMaterial) -> tuple[Any, Bool[Array, ""]]:
    """The material with 1 in place of negative values that the plan reads, and whether it had any.

    A negative coefficient of friction counts as well (`press_path` puts 0 in its place).
    """
    plan = scene.plan
    skeleton = skeleton_values(plan.rings, axial=plan.axial, shear=plan.options.shear)
    also = skeleton if plan.second_plane else ()
    material, bad = plan.mechanics.without_negative(material, also)
    if plan.friction and scene.friction is not None:
        bad = bad | (scene.friction < 0)
    return material, bad


def refuse(scene: Scene, material: AnyMaterial, path: Presses | None, made: Approach | None, bad):
    """The presses, NaN where refused; the same as computed; inward normals; refusals by status.

    A row that does not press needs nothing of the plan, the rings and the tube: off the plan or
    behind the ends of the rings it is computed as no motion, on the midline; off the tube at its
    end. Refused rows of a line of joints are computed as no motion, too, and their results hidden
    (`mask_rows`): by 0 times NaN they would reach the derivatives of other rows by the geometry.
    With friction they are NaN, since what follows goes on from them; a level may see to it itself.
    """
    presses = path if made is None else made.presses
    assert presses is not None
    D, phi = presses.displacement, presses.phi
    inward = jax.vmap(local_frame)(phi)[:, 0] if made is None else made.inward
    pressing = ~(jnp.sum(D * inward, axis=1) <= 0)
    acting = pressing
    if scene.plan.options.contact == "bonded":
        acting = ~jnp.all(D == 0, axis=1)
    s, mid, behind = on_the_tube(scene, presses.s, phi)
    refused = beyond(scene, material, presses, made, behind, pressing, acting)
    if made is not None:
        refused[PressStatus.IN_LUMEN] = made.inside
    number = jnp.sum(D, axis=1) + presses.s + phi
    if made is None and scene.plan.contact_point == "fixed":
        number = number + (presses.s[0] + phi[0])  # the place that all rows press
    if scene.plan.friction and scene.friction is not None:
        number = number + scene.friction
    refused[PressStatus.NON_FINITE] = jnp.isnan(number)
    refused[PressStatus.BAD_MATERIAL] = jnp.broadcast_to(bad, presses.s.shape)
    hidden = functools.reduce(jnp.logical_or, refused.values())
    D = jnp.where(hidden[:, None], jnp.nan, D)
    idle = (behind if scene.plan.second_plane else True) & ~acting
    if at_rest(scene):
        idle = idle | hidden
        s, mid = (jnp.where(jnp.isnan(v), 0, v) for v in (s, mid))
    used = Presses(s, mid, jnp.where(idle[:, None], jnp.zeros_like(D), D))
    return Presses(presses.s, phi, D), used, inward, refused


def beyond(
    scene: Scene, material: AnyMaterial, presses: Presses, made: Approach | None,
    behind: Bool[Array, " rows"], pressing: Bool[Array, " rows"], acting: Bool[Array, " rows"],
) -> dict[PressStatus, Bool[Array, " rows"]]:  # fmt: skip
    """Rows that press where there is no tube or no ring, or need what the plan has not, by status.

    Args:
        scene: -
        material: -
        presses: of every row.
        made: how a tool comes to them; None: they are given, and off the tube pressing or not.
        behind: which rows lie between the ends of the rings (`on_the_tube`).
        pressing: which rows press.
        acting: which press or draw.
    """
    low, high = _places(scene)
    outside = ~((presses.s >= low) & (presses.s <= high))
    if made is not None:
        outside = pressing & (outside | off_the_end(scene, made.own))
    refused = {PressStatus.OFF_TUBE: outside}
    unlike = outside_plan(scene, material, presses, acting)
    if unlike is not None:
        refused[PressStatus.OFF_PLAN] = unlike
    refused[PressStatus.BEHIND_GAP] = behind & acting
    return refused


def at_rest(scene: Scene) -> bool:
    """Whether refused rows are computed as no motion, see `refuse`."""
    return not (scene.plan.friction or scene.plan.mechanics.hides_refused)


def hidden_rows(
    scene: Scene, refused: dict[PressStatus, Bool[Array, "*n"]]
) -> Bool[Array, "*n"] | None:
    """Rows that were refused and computed as no motion; None: no row is (`at_rest`)."""
    return functools.reduce(jnp.logical_or, refused.values()) if at_rest(scene) else None


def mask_rows(hidden: Bool[Array, "*n"] | None, results: Any) -> Any:
    """The results, NaN in the `hidden_rows`; arrays with rows first, of any structure."""
    if hidden is None:
        return results

    def of_rows(v):
        return jnp.where(hidden.reshape(-1, *[1] * (v.ndim - 1)), jnp.nan, v)

    return jax.tree.map(of_rows, results)


def on_the_tube(scene: Scene, s: Float[Array, "*n"], phi: Float[Array, "*n"]):
    """Contact positions to compute with (an end, the midline in place of none); who is behind.

    The end is the last place at which all of the tool lies on the tube.
    """
    geometry = scene.geometry
    low, high = _places(scene)
    behind = ~on_ring(geometry.half_angle, phi)[0] & ~jnp.isnan(phi)
    s = jnp.where(s < low, low, jnp.where(s > high, high, s))
    return s, jnp.where(behind, 0, phi), behind


def _places(scene: Scene):
    """Lowest and highest contact position, mm, at which all of the tool lies on the tube."""
    half, length = scene.plan.options.half_width, scene.geometry.length
    return (half, length - half) if half > 0 else (0, length)


def status_of(status, share, made: Approach | None, refused: dict[PressStatus, Bool[Array, "*n"]]):
    """That of the press; of depth and contact where they are in doubt; of the rows refused."""
    status = jnp.where((status == PressStatus.OK) & (share > DEEPEST), PressStatus.TOO_DEEP, status)
    if made is not None:
        seen = made.own.status
        if made.first is not None:
            seen = jnp.maximum(seen, made.seen.status[made.first])
        unsure = (seen > ContactStatus.FLAT) & (status == PressStatus.OK)
        status = jnp.where(unsure, PressStatus.CONTACT_UNCERTAIN, status)
    for code in (*REFUSALS, PressStatus.BACK_IN_TIME):
        if code in refused:
            status = jnp.where(refused[code], code, status)
    return status.astype(jnp.int8)
