"""Symmetric block-tridiagonal systems: elimination from one end, with the inertia of the matrix.

O(n) for n blocks. No pivots are exchanged: for positive definite matrices none need be, and
of others the signs of the pivots are wanted (Sylvester: as many negative as eigenvalues).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Factors(NamedTuple):
    """An eliminated matrix.

    Attributes:
        inverse: of each block's rest after the elimination of those before it.
        upper: blocks [i, i + 1] of the matrix; that of the last node is zero.
        negative: number of negative pivots.
    """

    inverse: Float[Array, "n m m"]
    upper: Float[Array, "n m m"]
    negative: Int[Array, ""]


def invert(matrix: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Int[Array, ""]]:
    """Inverse by Gauss-Jordan without exchange, and the number of negative pivots."""
    order = jnp.arange(matrix.shape[0])

    def eliminate(k, state):
        A, negative = state
        here = order == k
        row = jnp.sum(jnp.where(here[:, None], A, 0), 0)
        pivot = jnp.sum(jnp.where(here, row, 0))
        row = jnp.where(here, 1, row) / pivot
        column = jnp.sum(jnp.where(here[None], A, 0), 1)
        A = jnp.where(here[None], 0, A) - column[:, None] * row[None]
        return jnp.where(here[:, None], row[None], A), negative + (pivot < 0).astype(jnp.int32)

    start = matrix, jnp.zeros((), jnp.int32)
    return jax.lax.fori_loop(0, matrix.shape[0], eliminate, start)


def factor(diagonal: Float[Array, "n m m"], upper: Float[Array, "n m m"]) -> Factors:
    """Eliminate the first block, then the next.

    Args:
        diagonal: blocks [i, i], symmetric.
        upper: blocks [i, i + 1]; the last is zero.
    """

    def step(carry, blocks):
        D, U = blocks
        inverse, negative = invert(D - carry)
        return U.T @ inverse @ U, (inverse, negative)

    _, (inverse, negative) = jax.lax.scan(step, jnp.zeros_like(diagonal[0]), (diagonal, upper))
    return Factors(inverse, upper, jnp.sum(negative))


def solve(factors: Factors, rhs: Float[Array, "n m k"]) -> Float[Array, "n m k"]:
    """Solution for k right-hand sides."""

    def down(carry, node):
        inverse, U, r = node
        r = r - carry
        return U.T @ (inverse @ r), r

    def back(x, node):
        inverse, U, r = node
        x = inverse @ (r - U @ x)
        return x, x

    none = jnp.zeros_like(rhs[0])
    _, left = jax.lax.scan(down, none, (factors.inverse, factors.upper, rhs))
    nodes = factors.inverse, factors.upper, left
    return jax.lax.scan(back, none, nodes, reverse=True)[1]
