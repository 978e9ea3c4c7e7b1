"""Symmetric block-tridiagonal systems: elimination from both ends, with the inertia of the matrix.

O(n) for n blocks; both ends at a time, so that half as many operations wait for each other. No
pivots are exchanged: for positive definite matrices none need be, and of others the signs of the
pivots are wanted (Sylvester: as many negative as eigenvalues).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

#: Largest matrix that `invert` eliminates entry by entry: a node of the midline.
LEAF = 7


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


def invert(
    matrix: Float[Array, "m m"], *, symmetric: bool = False
) -> tuple[Float[Array, "m m"], Int[Array, ""]]:
    """Inverse without exchange of pivots, and the number of negative ones.

    By halves down to `LEAF`: products of matrices are quicker than the elimination of a large one.
    What an inverse of the first half gives has errors of its condition number times those of an
    elimination; one correction by the residual takes them off again. Without it the pivots of the
    second half lose the square of the condition number, and with them their signs.

    Args:
        matrix: no leading part of it is singular.
        symmetric: it is its own transpose up to rounding, and so is the inverse.
    """
    m = matrix.shape[0]
    if m <= LEAF:
        return _eliminate(matrix)
    k = (m + 1) // 2
    upper, right, left = matrix[:k, :k], matrix[:k, k:], matrix[k:, :k]
    first, negative = invert(upper, symmetric=symmetric)
    gain = first @ right
    gain = gain + first @ (right - upper @ gain)
    rows = gain.T if symmetric else left @ first
    last, more = invert(matrix[k:, k:] - left @ gain, symmetric=symmetric)
    side = gain @ last
    below = side.T if symmetric else last @ rows
    return jnp.block([[first + side @ rows, -side], [-below, last]]), negative + more


def _eliminate(matrix: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Int[Array, ""]]:
    """`invert` by Gauss-Jordan.

    Two pivots at a time, so that half as many operations wait for each other. The second is what
    the first leaves of it: the closed inverse of the 2 x 2 block, by its determinant, would lose
    the square of its condition number.
    """
    m = matrix.shape[0]
    A, pivots, places = matrix, [], np.arange(m)
    for k in range(0, m - 1, 2):
        a, b, c, d = A[k, k], A[k, k + 1], A[k + 1, k], A[k + 1, k + 1]
        one_over, share = 1 / a, c / a
        pivot = d - share * b
        pivots += [a, pivot]
        one, two = places == k, places == k + 1
        row = jnp.where(one, 1, jnp.where(two, 0, A[k]))
        other = jnp.where(two, 1, jnp.where(one, 0, A[k + 1]))
        second = (other - share * row) * (1 / pivot)
        first = (row - b * second) * one_over
        rest = jnp.where((one | two)[None], 0, A)
        rest = rest - A[:, k, None] * first[None] - A[:, k + 1, None] * second[None]
        A = jnp.where(one[:, None], first[None], jnp.where(two[:, None], second[None], rest))
        # XLA would compute every step again for each element of the next.
        A = jax.lax.optimization_barrier(A)
    if m % 2:
        p, last = A[-1, -1], places == m - 1
        pivots.append(p)
        row = jnp.where(last, 1, A[-1]) / p
        rest = jnp.where(last[None], 0, A) - A[:, -1, None] * row[None]
        A = jnp.where(last[:, None], row[None], rest)
    return A, jnp.sum((jnp.stack(pivots) < 0).astype(jnp.int32))


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

    def step(carry, blocks):
        D, U = blocks
        inverse, negative = jax.vmap(functools.partial(invert, symmetric=True))(D - carry)
        gain = inverse @ U
        return U.transpose(0, 2, 1) @ gain, (inverse, gain, negative)

    carry, (inverse, gain, negative) = jax.lax.scan(step, jnp.zeros_like(D[0]), (D, U))
    middle, own = invert(centre - carry[0] - carry[1], symmetric=True)
    return Factors(inverse, gain, middle, jnp.sum(negative) + own)


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
