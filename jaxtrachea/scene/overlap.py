"""Whether tools overlap one another in space, row by row."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxtrachea.contact.distance import signed_distance
from jaxtrachea.contact.pose import Pose, relative
from jaxtrachea.contact.search import FAST
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.scene.stage import Poses


def overlapping(tools: Sequence[Shape], paths: Sequence[Poses]) -> Bool[Array, "rows m"]:
    """Rows and tools where an upper bound of the signed distance to another tool is negative.

    Args:
        tools: their shapes.
        paths: where each stands; all of as many rows.
    """
    most = max(tool.vertices.shape[1] for tool in tools)

    def padded(tool: Shape) -> Shape:
        """As many corners as any, the last one repeated: the same hull."""
        more = most - tool.vertices.shape[1]
        return Shape(jnp.pad(tool.vertices, ((0, 0), (0, more)), mode="edge"), tool.radius)

    first, second = np.triu_indices(len(tools), 1)
    shapes = jax.tree.map(lambda *v: jnp.stack(v), *map(padded, tools))
    R, T = (jnp.stack(v) for v in zip(*((p.rotation, p.translation) for p in paths), strict=True))

    def pair(i, j):
        a = jax.tree.map(lambda v: v[i], shapes)
        b = jax.tree.map(lambda v: v[j], shapes)

        def distance(*poses):
            between = relative(Pose(*poses[:2]), Pose(*poses[2:]))
            return signed_distance(a, b, between, FAST).upper

        return jax.vmap(distance)(R[i], T[i], R[j], T[j]) < 0

    found = jax.lax.stop_gradient(jax.vmap(pair)(first, second))
    m = np.arange(len(tools))
    takes_part = (first[:, None] == m) | (second[:, None] == m)
    return jnp.any(found[:, :, None] & takes_part[:, None], axis=0)
