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

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.mechanics.energy import StraightPress, gradient
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.programs import Moved
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.trachea.material import Material


def force_by_pose(
    scene: Scene, material: Material, path: Poses, used: Presses, moved: Moved, made: Approach
) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
    """Force on the tube and its moment about the tool's origin: dE/dpose, row by row.

    Args:
        scene: -
        material: values that are not negative.
        path: of the tool.
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
    force = poses.translation
    # An infinitesimal turn w of R moves its columns r by w x r.
    moment = jnp.sum(jnp.cross(path.rotation, poses.rotation, axis=1), axis=2)
    if made.frame is not None:
        force, moment = (jnp.einsum("ri,rij->rj", v, made.frame) for v in (force, moment))
    return force, moment
