"""Symmetric block-tridiagonal systems: elimination from both ends, with the inertia of the matrix.

O(n) for n blocks; both ends at a time, so that half as many operations wait for each other. No
pivots are exchanged: for positive definite matrices none need be, and of others the signs of the
pivots are wanted (Sylvester: as many negative as eigenvalues).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.fusion import fuse


class Factors(NamedTuple):
    """An eliminated matrix: two chains of nodes, from either end, and the node between.

    The second chain begins with a node of its own that is coupled to nothing where the number of
    nodes is even.

    Attributes:
        inverse: of each block's rest after the elimination of those before it in its chain.
        gain: that times the block to the next node of the chain.
        centre: the inverse for the node between.
        negative: number of negative pivots.
    """

    inverse: Float[Array, "half 2 m m"]
    gain: Float[Array, "half 2 m m"]
    centre: Float[Array, "m m"]
    negative: Int[Array, ""]


def invert(matrix: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Int[Array, ""]]:
    """Inverse by Gauss-Jordan without exchange of pivots, and the number of negative ones.

    Each pivot is the first entry; its row and column then go behind all others, so that after m of
    them all are in their places. A loop: its body is vectorised, and compiled once.

    Args:
        matrix: no leading part of it is singular.
    """

    def eliminate(carry, _):
        A, negative = carry
        pivot, column = A[0, 0], A[1:, 0]
        row = A[0, 1:] / pivot
        rest = A[1:, 1:] - column[:, None] * row[None]
        A = jnp.block([[rest, -(column / pivot)[:, None]], [row[None], 1 / pivot[None, None]]])
        return (A, negative + (pivot < 0).astype(jnp.int32)), None

    begin = matrix, jnp.zeros((), jnp.int32)
    return jax.lax.scan(eliminate, begin, length=matrix.shape[0])[0]


def _chains(nodes, fill):
    """Entries of nodes in the order of both chains, (half, 2, ...), and that of the centre."""
    half = nodes.shape[0] // 2
    right = nodes[:half:-1]
    if nodes.shape[0] % 2 == 0:
        right = jnp.concatenate([fill[None], right])
    return jnp.stack([nodes[:half], right], 1), nodes[half]


def factor(diagonal: Float[Array, "n m m"], upper: Float[Array, "n m m"]) -> Factors:
    """Eliminate the first block and the last, then the next of either.

    Args:
        diagonal: blocks [i, i], symmetric.
        upper: blocks [i, i + 1]; the last is zero.
    """
    eye = jnp.eye(diagonal.shape[1], dtype=diagonal.dtype)
    D, centre = _chains(diagonal, eye)
    half = D.shape[0]
    lower = upper[half:-1].transpose(0, 2, 1)[::-1]
    if lower.shape[0] < half:
        lower = jnp.concatenate([jnp.zeros_like(eye)[None], lower])
    U = jnp.stack([upper[:half], lower], 1)

    both = fuse(jax.vmap(invert))

    def step(carry, blocks):
        D, U = blocks
        inverse, negative = both(D - carry)
        gain = inverse @ U
        return U.transpose(0, 2, 1) @ gain, (inverse, gain, negative)

    carry, (inverse, gain, negative) = jax.lax.scan(step, jnp.zeros_like(D[0]), (D, U))
    middle, own = fuse(invert)(centre - carry[0] - carry[1])
    return Factors(inverse, gain, middle, jnp.sum(negative, dtype=jnp.int32) + own)


def solve(factors: Factors, rhs: Float[Array, "n m k"]) -> Float[Array, "n m k"]:
    """Solution for k right-hand sides."""
    n = rhs.shape[0]
    sides, centre = _chains(rhs, jnp.zeros_like(rhs[0]))

    def down(taken, node):
        gain, r = node
        r = r - taken
        return gain.transpose(0, 2, 1) @ r, r

    def back(x, node):
        gain, own = node
        x = own - gain @ x
        return x, x

    taken, left = jax.lax.scan(down, jnp.zeros_like(sides[0]), (factors.gain, sides))
    x = (factors.centre @ (centre - taken[0] - taken[1]))[None]
    inverse = factors.inverse.reshape(-1, *factors.centre.shape)
    own = (inverse @ left.reshape(-1, *centre.shape)).reshape(left.shape)
    start = jnp.broadcast_to(x, sides[0].shape)
    sides = jax.lax.scan(back, start, (factors.gain, own), reverse=True)[1]
    right = sides[::-1, 1][: n - n // 2 - 1]
    return jnp.concatenate([sides[:, 0], x, right])
