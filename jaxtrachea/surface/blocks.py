"""Vertices in blocks of one patch each: what a patch has in common is read once for a block.

A block is a row of at most `WIDEST` vertices that lie between the same two nodes. Functions of a
vertex and its patch then need no index for each vertex, and going back, what the vertices of a
patch add up to is a sum along rows. A row that is not full is filled up by its first vertex. The
number of rows is that of the worst case: it does not depend on where the nodes are.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Shaped

from jaxtrachea._arguments import without_program

#: Most vertices in a block.
WIDEST = 32
#: Least blocks to a patch, on average; filled up are at most a quarter of the number of vertices.
LEAST = 4


class Blocks(eqx.Module):
    """Which vertex stands where.

    Attributes:
        vertex: of each place; beyond the number of vertices where it is only filled up.
        place: of each vertex, counted row by row.
        order: vertices along the tube.
        rank: of each vertex in this order.
    """

    vertex: Int[Array, "blocks width"]
    place: Int[Array, " vertices"]
    order: Int[Array, " vertices"]
    rank: Int[Array, " vertices"]


def in_blocks(
    s: Float[Array, " vertices"],
    patch: Int[Array, " vertices"],
    patches: int,
    known: Blocks | None = None,
) -> Blocks | None:
    """Group vertices by their patch; everything may be traced.

    Args:
        s: position of each vertex along the tube.
        patch: of each vertex, in [0, patches), rising with s.
        patches: number of patches.
        known: blocks of the same vertices between other nodes, whose order is kept (so that a
            traced program need not sort).

    Returns:
        The blocks; None if each vertex is to be its own: there are few to a patch.
    """
    vertices = len(patch)
    width = min(WIDEST, vertices // (LEAST * patches))
    if width < 2:
        return None
    # Concrete numbers by numpy: nothing is compiled for them.
    given = jax.tree.leaves((s, patch, known))
    xp = jnp if any(isinstance(v, Tracer) for v in given) else np
    at = xp.asarray(patch, np.int32)

    def to(n):
        return xp.arange(n, dtype=np.int32)

    if known is None:
        order = jnp.argsort(s) if xp is jnp else np.argsort(np.asarray(s), kind="stable")
        order, rank = (xp.asarray(v, np.int32) for v in (order, xp.argsort(order)))
    else:
        order, rank = xp.asarray(known.order), xp.asarray(known.rank)
    count = (vertices + patches * (width - 1)) // width
    bounds = xp.searchsorted(at[order], to(patches + 1))
    first, rows = bounds[:-1], -(-xp.diff(bounds) // width)
    below = xp.cumsum(rows)
    place = ((below - rows) * width - first)[at] + rank
    # Spare rows come last, as if they were of the last patch.
    row = to(count)
    owner = xp.minimum(xp.searchsorted(below, row, side="right"), patches - 1)
    start = first[owner] + (row - (below - rows)[owner]) * width
    ranks = start[:, None] + to(width)[None]
    filled = vertices + to(count * width).reshape(count, width)
    real = ranks < bounds[owner + 1][:, None]
    vertex = xp.where(real, order[xp.minimum(ranks, vertices - 1)], filled)
    return Blocks(*(without_program(xp.asarray(v, np.int32)) for v in (vertex, place, order, rank)))


def to_blocks(
    values: Shaped[Array | np.ndarray, " vertices"], blocks: Blocks | None
) -> Shaped[Array | np.ndarray, "blocks width"]:
    """Values of the vertices, row by row of the blocks; by numpy where they are its own."""
    if blocks is None:
        return values[:, None]
    xp = np if isinstance(values, np.ndarray) else jnp
    vertex, count = xp.asarray(blocks.vertex), len(values)
    first = xp.where(vertex[:, :1] < count, vertex[:, :1], 0)
    return values[xp.where(vertex < count, vertex, first)]


def to_vertices(
    values: Float[Array, "blocks components width"], blocks: Blocks | None
) -> Float[Array, "vertices components"]:
    """Back to the order of the vertices; what stands in places filled up is left out."""
    flat = values.swapaxes(1, 2).reshape(-1, values.shape[1])
    return flat if blocks is None else _pick(flat, blocks)


@jax.custom_jvp
def _pick(values, blocks: Blocks):
    return values.at[blocks.place].get(mode="promise_in_bounds")


@_pick.defjvp
def _pick_jvp(primals, tangents):
    # The same as a scatter, because the transpose of that is a gather, and no scatter.
    (values, blocks), change = primals, tangents[0]
    out = _pick(values, blocks)
    put = jnp.zeros_like(out).at[blocks.vertex.ravel()]
    return out, put.add(change, mode="drop", unique_indices=True)
