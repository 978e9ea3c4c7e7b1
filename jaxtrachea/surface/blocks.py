"""Vertices in blocks of one patch each: what a patch has in common is read once for a block.

A block is a row of at most `WIDEST` vertices that lie between the same two nodes. Functions of a
vertex and its patch then need no index for each vertex, and going back, what the vertices of a
patch add up to is a sum along rows. The last block of a patch is filled up by its first vertex.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Shaped

#: Most vertices in a block.
WIDEST = 32
#: Least blocks to a patch, on average: so at most a quarter of the places is filled up.
LEAST = 4


class Blocks(eqx.Module):
    """Which vertex stands where.

    Attributes:
        vertex: of each place; beyond the number of vertices where it is only filled up.
        place: of each vertex, counted row by row.
    """

    vertex: Int[Array, "blocks width"]
    place: Int[Array, " vertices"]


def in_blocks(patch: Int[Array, " vertices"], patches: int) -> Blocks | None:
    """Group vertices by their patch.

    The shape depends on the numbers of vertices and patches alone.

    Args:
        patch: of each vertex, in [0, patches).
        patches: number of patches.

    Returns:
        The blocks; None if each vertex is to be its own: patches are traced, or have few vertices.
    """
    vertices = len(patch)
    width = min(WIDEST, vertices // (LEAST * patches))
    if isinstance(patch, Tracer) or width < 2:
        return None
    count = (vertices + patches * (width - 1)) // width
    at = np.asarray(patch)
    order = np.argsort(at, kind="stable")
    inside = np.bincount(at, minlength=patches)
    first = np.cumsum(inside) - inside
    used = -(-inside // width)
    row = np.cumsum(used) - used
    place = np.empty(vertices, np.int32)
    place[order] = (row * width - first)[at[order]] + np.arange(vertices)
    vertex = vertices + np.arange(count * width, dtype=np.int32)
    vertex[place] = np.arange(vertices)
    return Blocks(jnp.asarray(vertex.reshape(count, width)), jnp.asarray(place))


def to_blocks(
    values: Shaped[Array, " vertices"], blocks: Blocks | None
) -> Shaped[Array, "blocks width"]:
    """Values of the vertices, row by row of the blocks."""
    if blocks is None:
        return values[:, None]
    vertex, count = blocks.vertex, len(values)
    first = jnp.where(vertex[:, :1] < count, vertex[:, :1], 0)
    return values[jnp.where(vertex < count, vertex, first)]


def to_vertices(
    values: Float[Array, "blocks components width"], blocks: Blocks | None
) -> Float[Array, "vertices components"]:
    """Back to the order of the vertices; what stands in places filled up is left out."""
    flat = values.swapaxes(1, 2).reshape(-1, values.shape[1])
    return flat if blocks is None else _pick(flat, blocks)


@jax.custom_jvp
def _pick(values, blocks: Blocks):
    return values.at[blocks.place].get(mode="promise_in_bounds", unique_indices=True)


@_pick.defjvp
def _pick_jvp(primals, tangents):
    # The same as a scatter, because the transpose of that is a gather, and no scatter.
    (values, blocks), change = primals, tangents[0]
    out = _pick(values, blocks)
    put = jnp.zeros_like(out).at[blocks.vertex.ravel()]
    return out, put.add(change, mode="drop", unique_indices=True)
