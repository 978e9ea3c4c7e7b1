r"""The force of a tool whose contact point wanders: what changes the stored energy with its pose.

Every row is a press of its own, E(delta, s, phi), and depth and contact point are functions of the
pose. The force that the tool exerts is then dE/dpose,

    f = dE/d delta grad delta + dE/ds grad s + dE/dphi grad phi,

beside the normal force a force along the surface, because the wall is softer here than there
(`mechanics.energy`). grad delta is the normal of the patches; grad s and grad phi hold the
curvatures of tool and tube, as the nearest point moves (on a round tube of radius R under a ball of
radius r: one along the tube, and 1/(R + r - delta) round it). All three together are one reverse
derivative of the search for the contact, at the pose where it stopped. So the work over a closed
loop of poses is zero.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.mechanics.energy import StraightPress, gradient
from jaxtrachea.mechanics.press import local_law
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.instruments import Pull
from jaxtrachea.scene.programs import Moved
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.trachea.material import Material


def force_by_pose(
    scene: Scene, material: Material, path: Poses, used: Presses, moved: Moved, made: Approach
) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
    """Force on the tube and its moment about the tool's origin: dE/dpose, row by row.

    Args:
        material: values that are not negative.
        used: presses as computed, straight in; NaN where refused.
        moved: what they do.
        made: the tool's way, with its `pull`.

    Returns:
        N and N mm, along the axes that forces are reported in; shape (rows, 3).

    Raises:
        ValueError: the way has no `pull`.
    """
    if made.pull is None:
        raise ValueError("made.pull is None; the plan needs contact_point 'per_step'")
    plan = scene.plan

    def one(*press):
        return gradient(
            scene.geometry, material, StraightPress(*press), plan.options, rings=plan.rings,
            axial=plan.axial, one_plane=not plan.second_plane,
        )  # fmt: skip

    inward = jnp.sum(used.displacement * made.inward, axis=1)
    by = jax.vmap(one)(
        used.s, used.phi, inward, moved.force, moved.depth, moved.slope_C, moved.loads
    )
    (poses,) = made.pull(Presses(by.s, by.phi, by.inward[:, None] * made.inward))
    return _by_pose(path, poses, made.frame)


def _by_pose(path: Poses, by: Poses, frame):
    """Force and moment of derivatives by the poses, along the axes that forces are reported in."""
    # An infinitesimal turn w of R moves its columns r by w x r.
    moment = jnp.sum(jnp.cross(path.rotation, by.rotation, axis=1), axis=2)
    if frame is None:
        return by.translation, moment
    force, moment = (jnp.einsum("ri,rij->rj", v, frame) for v in (by.translation, moment))
    return force, moment


class Contacts(NamedTuple):
    """Several solved presses along the inward normals, in one row.

    Attributes:
        s: contact positions, mm.
        phi: contact angles, rad.
        force: along the normals, N.
        depth: local indentations, mm.
    """

    s: Float[Array, " m"]
    phi: Float[Array, " m"]
    force: Float[Array, "1 m"]
    depth: Float[Array, "1 m"]


def forces_by_poses(
    scene: Scene,
    material: Material,
    solved: Contacts,
    compliance: Callable[..., Float[Array, "m m"]],
    ways: Sequence[tuple[Poses, Approach]],
    pull: Pull,
) -> dict[str, Float[Array, "1 m 3"]]:
    """`force` and `moment` of tools that feel each other: dE/dpose of the energy of all.

    With the displacements held it changes with the places by -F . dC F / 2 + dW, see
    `mechanics.energy`.

    Args:
        material: values that are not negative.
        compliance: what contacts feel of each other, mm/N, from their places and angles.
        ways: the poses of every tool, and what they are to the wall.
        pull: to derivatives by the poses.
    """
    F, options = solved.force[0], scene.plan.options

    def stored(s, phi):
        energy = -F @ (compliance(s, phi) @ F) / 2
        if options.local == "two-material":
            law = jax.vmap(lambda at: local_law(scene.geometry, material, at, options))(s)
            energy += jnp.sum(jax.vmap(lambda law, d: law.energy(d * d))(law, solved.depth[0]))
        return energy

    by_s, by_phi = jax.grad(stored, (0, 1))(solved.s, solved.phi)
    poses = pull([(one[:1], one[1:2], one[2:]) for one in jnp.stack([by_s, by_phi, -F], axis=1)])
    each = zip(ways, poses, strict=True)
    found = [_by_pose(path, by, made.frame) for (path, made), by in each]
    force, moment = (jnp.stack(v, axis=1) for v in zip(*found, strict=True))
    return {"force": force, "moment": moment}
