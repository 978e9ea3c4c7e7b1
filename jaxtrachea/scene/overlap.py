"""Whether tools overlap one another in space, row by row."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxtrachea.contact.distance import approach
from jaxtrachea.contact.pose import Pose, relative
from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.scene.stage import Poses

#: Of the distance, 1/mm: it is too small by at most log(N_A N_B) over it, 0.04 mm of two boxes.
SHARPNESS = 100.0


def overlapping(tools: Sequence[Shape], paths: Sequence[Poses]) -> Bool[Array, "rows m"]:
    """Rows and tools where an upper bound of the signed distance to another tool is negative.

    Args:
        tools: their shapes, each convex or of convex parts.
        paths: where each stands; all of as many rows.
    """
    bodies = [(i, part) for i, tool in enumerate(tools) for part in parts_of(tool)]
    owner = np.array([i for i, _ in bodies])
    most = max(body.vertices.shape[1] for _, body in bodies)

    def padded(body: Shape) -> Shape:
        """As many corners as any, the last one repeated: the same hull."""
        corners = [body.vertices, *[body.vertices[:, -1:]] * (most - body.vertices.shape[1])]
        return Shape(jnp.concatenate(corners, axis=1), body.radius)

    first, second = np.nonzero(owner[:, None] < owner)
    shapes = jax.tree.map(lambda *v: jnp.stack(v), *(padded(body) for _, body in bodies))
    R, T = (jnp.stack(v) for v in zip(*((p.rotation, p.translation) for p in paths), strict=True))

    def pair(at):
        a, b = (jax.tree.map(lambda v, k=k: v[k], shapes) for k in at[:2])

        def distance(*poses):
            between = relative(Pose(*poses[:2]), Pose(*poses[2:]))
            found = approach(a, b, between, beta=jnp.asarray(SHARPNESS, R.dtype))
            return jnp.minimum(found.upper, found.distance + 2 * math.log(most) / SHARPNESS)

        of_i, of_j = at[2:]
        return jax.vmap(distance)(R[of_i], T[of_i], R[of_j], T[of_j]) < 0

    owners = owner[first], owner[second]
    found = jax.lax.stop_gradient(jax.lax.map(pair, jnp.stack([first, second, *owners], axis=1)))
    m = np.arange(len(tools))
    takes_part = (owners[0][:, None] == m) | (owners[1][:, None] == m)
    return jnp.any(found[:, :, None] & takes_part[:, None], axis=0)
