"""Symmetric block-tridiagonal systems: elimination from one end, with the inertia of the matrix.

O(n) for n blocks. No pivots are exchanged: for positive definite matrices none need be, and
of others the signs of the pivots are wanted (Sylvester: as many negative as eigenvalues).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Factors(NamedTuple):
    """An eliminated matrix.

    Attributes:
        inverse: of each block's rest after the elimination of those before it.
        gain: `inverse` times the blocks [i, i + 1] of the matrix; that of the last node is zero.
        negative: number of negative pivots.
    """

    inverse: Float[Array, "n m m"]
    gain: Float[Array, "n m m"]
    negative: Int[Array, ""]


def invert(matrix: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Int[Array, ""]]:
    """Inverse by Gauss-Jordan without exchange, and the number of negative pivots.

    Two pivots at a time, with the inverse of their 2 x 2 block in closed form: half as many
    operations that wait for each other.
    """
    m = matrix.shape[0]
    A, negative = matrix, jnp.zeros((), jnp.int32)
    for k in range(0, m - 1, 2):
        a, b, c, d = A[k, k], A[k, k + 1], A[k + 1, k], A[k + 1, k + 1]
        det = a * d - b * c
        pivots = (a < 0).astype(jnp.int32) + ((det < 0) != (a < 0)).astype(jnp.int32)
        negative = negative + pivots
        first, second = (d * A[k] - b * A[k + 1]) / det, (a * A[k + 1] - c * A[k]) / det
        here = np.arange(m)
        own = np.asarray(here == k), np.asarray(here == k + 1)
        first = jnp.where(own[0], d / det, jnp.where(own[1], -b / det, first))
        second = jnp.where(own[0], -c / det, jnp.where(own[1], a / det, second))
        either = own[0] | own[1]
        rest = jnp.where(either[None], 0, A)
        rest = rest - A[:, k, None] * first[None] - A[:, k + 1, None] * second[None]
        A = jnp.where(own[0][:, None], first, jnp.where(own[1][:, None], second, rest))
    if m % 2:
        p, last = A[-1, -1], np.arange(m) == m - 1
        negative = negative + (p < 0).astype(jnp.int32)
        row = jnp.where(last, 1, A[-1]) / p
        rest = jnp.where(last[None], 0, A) - A[:, -1, None] * row[None]
        A = jnp.where(last[:, None], row, rest)
    return A, negative


def factor(diagonal: Float[Array, "n m m"], upper: Float[Array, "n m m"]) -> Factors:
    """Eliminate the first block, then the next.

    Args:
        diagonal: blocks [i, i], symmetric.
        upper: blocks [i, i + 1]; the last is zero.
    """

    def step(carry, blocks):
        D, U = blocks
        inverse, negative = invert(D - carry)
        gain = inverse @ U
        return U.T @ gain, (inverse, gain, negative)

    _, (inverse, gain, negative) = jax.lax.scan(
        step, jnp.zeros_like(diagonal[0]), (diagonal, upper)
    )
    return Factors(inverse, gain, jnp.sum(negative))


def solve(factors: Factors, rhs: Float[Array, "n m k"]) -> Float[Array, "n m k"]:
    """Solution for k right-hand sides."""

    def down(r, node):
        gain, next_r = node
        r = next_r - jnp.sum(gain[:, :, None] * r[:, None], 0)
        return r, r

    def back(x, node):
        gain, own = node
        x = own - jnp.sum(gain[:, :, None] * x[None], 1)
        return x, x

    first, gain = rhs[0], factors.gain[:-1]
    rest = jax.lax.scan(down, first, (gain, rhs[1:]))[1]
    own = factors.inverse @ jnp.concatenate([first[None], rest])
    x = jax.lax.scan(back, own[-1], (gain, own[:-1]), reverse=True)[1]
    return jnp.concatenate([x, own[-1:]])
