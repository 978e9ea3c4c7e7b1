"""The deformed surface under several tools.

It follows the lines of joints on which contacts are nodes (`lines`), with the dents of all
(`dents`); with friction a dent goes with the slip of its tool (`trail`).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import added, full_precision
from jaxtrachea.fusion import one_by_one
from jaxtrachea.scene import dents, lines, trail
from jaxtrachea.scene.instruments import views
from jaxtrachea.scene.refusals import mask_rows
from jaxtrachea.scene.stage import Poses, Scene
from jaxtrachea.scene.together import Together
from jaxtrachea.surface import local
from jaxtrachea.trachea.mesh import place


@full_precision
def deform_together(scene: Scene, moved: Together) -> Float[Array, "rows vertices 3"] | None:
    """Deformed vertices, NaN in the rows that were refused; None: the plan has no surface."""
    plan, mesh, binding, half = scene.plan, scene.mesh, scene.binding, scene.plan.options.half_width
    if plan.surface is None or plan.surface == "sections":
        return None
    if mesh is None or binding is None:
        raise ValueError("scene.mesh or scene.binding is None; the plan has a surface")
    method, straight, runs = plan.surface, mesh.straight, scene.runs
    places = moved.s if half == 0 else jnp.concatenate([moved.s - half, moved.s + half])
    weights = lines.weigh(binding, moved.phi, moved.lines.joints.shape[1])
    each, laid = views(scene), None
    if plan.dent:
        laid = dents.lay_out(each, moved.s, moved.phi, moved.paths, moved.made)
    by_row = moved.inward is not None and moved.inward.ndim == 3
    led = None
    if plan.friction and all(isinstance(path, Poses) for path in moved.paths):
        led = list(moved.paths)

    def one(row):
        depth, of_row, inward, slip, poses = row
        u = lines.interpolate(binding, weights, places, of_row, method)
        if laid is None or runs is None:
            return place(mesh, u)
        found = dents.fit(laid, depth, inward if by_row else moved.inward)
        if slip is None:
            for dent, s in zip(found, moved.s, strict=True):
                u = local.add_correction(u, dent, straight, runs, s)
            return place(mesh, u)
        return _slid(scene, moved, laid, found, u, slip, poses)

    rows = moved.depth, moved.lines, moved.inward if by_row else None, moved.slip, led
    return mask_rows(moved.hidden, one_by_one(one, rows))


def _slid(scene: Scene, moved: Together, laid: dents.Dents, found, u, slip, poses):
    """The surface of one row with the dents where the tools have slid to, see `trail`.

    Each is scaled until the surface touches its tool, beside the dents of the others as they are.
    """
    mesh, runs, none = scene.mesh, scene.runs, jnp.zeros_like(u)
    assert mesh is not None
    assert runs is not None
    own = []
    for j, dent in enumerate(found):
        s, phi = moved.s[j], moved.phi[j]
        there, turned = trail.slid(s, phi, laid.radii[j], slip[j])
        dent = trail.lay_at(dent, there - s, turned - phi)
        own.append((dent, local.add_correction(none, dent, mesh.straight, runs, there)))
    whole = u + added([v for _, v in own])
    if poses is None:
        return place(mesh, whole)
    dented, scaled_up = place(mesh, whole), u
    for view, pose, (dent, v) in zip(views(scene), poses, own, strict=True):
        near = jnp.sum((mesh.straight - dent.centres[:1]) ** 2, axis=1)
        assert view.tool is not None
        scale = trail.scale_to_touch(view.tool, pose, near, place(mesh, whole - v), dented)
        scaled_up = scaled_up + scale * v
    return place(mesh, scaled_up)
