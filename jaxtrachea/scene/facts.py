"""The facts of a scene and its path, that its plan is made from (concrete numbers)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxtrachea.contact.patches import Touch
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.approach import first_touch
from jaxtrachea.scene.curve import frame_at
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.effects import given_values
from jaxtrachea.scene.lumen import in_lumen
from jaxtrachea.scene.stage import (
    COVERED,
    Poses,
    Presses,
    Scene,
    contact_point_path,
    touch_tube,
)
from jaxtrachea.surface import local
from jaxtrachea.trachea.material import Material


def facts_of(scene: Scene, material: Material, path: Poses | Presses) -> SceneFacts:
    """What the rules need to know of a scene and its path; rows in the lumen touch nothing.

    Args:
        scene: its plan is not read.
        material: read only for which optional values are there.
        path: what the plan is made for.
    """
    curved = scene.mesh is not None and scene.mesh.frames is not None
    if isinstance(path, Poses):
        plan = dataclasses.replace(scene.plan, curved=curved)
        seen, touching, row = _touched(dataclasses.replace(scene, plan=plan), path)
        s, phi = (np.asarray(v, float) for v in (seen.s, seen.phi))
        touching, row = np.asarray(touching), int(row)
        frame = None
        if curved and scene.tube is not None:
            frame = frame_at(scene.tube.line, seen.s[row])
        inward = local_frame(seen.phi[row])[0]
        moved = contact_point_path(path, seen, jnp.asarray(row), inward, frame)
        moved, at = np.asarray(moved, float), slice(row, row + 1)
    else:
        s, phi, moved = (np.asarray(v, float) for v in (path.s, path.phi, path.displacement))
        touching, at = np.ones(len(s), bool), slice(None)
    here = np.broadcast_to(phi[at], s.shape)
    across = np.abs(moved[:, 2] * np.cos(here) - moved[:, 1] * np.sin(here))
    along, way = np.abs(moved[:, 0]), np.sqrt((moved**2).sum(axis=1))
    whole = max(way[touching].max(initial=0), 1e-9)  # not what the tool goes before it touches

    def share(v):
        return float(v.max(initial=0) / whole)

    def keep(v):
        return v if v > COVERED else 0.0

    angles = np.abs(phi[touching])
    slip = np.hypot(along, across)[touching].max(initial=0)
    x = np.asarray(scene.geometry.ring_positions, float)
    return SceneFacts(
        poses=isinstance(path, Poses),
        angle=keep(float(angles.max(initial=0))),
        several_points=bool(np.ptp(s[touching]) + np.ptp(phi[touching]) > COVERED * whole)
        if touching.any() else False,
        along=keep(share(along[touching])),
        across=keep(share(across[touching])),
        slip=float(slip) if slip > COVERED * whole else 0.0,
        spacing=float(np.diff(x).min()) if len(x) > 1 else float(scene.geometry.length),
        friction=scene.friction is not None,
        known=given_values(material),
        mesh=scene.mesh is not None,
        curved=curved,
        near=_near(scene, s, phi),
    )  # fmt: skip


@jax.jit
def _touched(scene: Scene, path: Poses) -> tuple[Touch, Bool[Array, " rows"], Int[Array, ""]]:
    """Contact of every row, whether it is one with the outside, and the row of first touch."""
    seen = touch_tube(scene, path)
    return seen, *first_touch(seen, in_lumen(scene, path, seen))


def _near(scene: Scene, s, phi) -> bool:
    """Whether a vertex lies within the reach of a dent at any of the contacts."""
    if scene.mesh is None:
        return False
    r = float(scene.radius)
    C = np.stack([s, r * np.cos(phi), r * np.sin(phi)], axis=1)
    points, reach = np.asarray(scene.mesh.straight, float), local.REACH * float(scene.footprint)
    return any(bool((np.sum((points - c) ** 2, axis=1) < reach**2).any()) for c in C)
