"""Algebra of 2x2 matrices written out entry by entry: the two transverse planes of a beam.

Under `vmap` these are elementwise programs over all lanes, where a library call would be made per
lane. Matrices have shape (2, 2), vectors (2,); sums of positive definite matrices are formed
without subtraction wherever that is possible.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Matrix = Float[Array, "2 2"]
Vector = Float[Array, "2"]

_SIGNS = np.array([[1, -1], [-1, 1]])


def mul(A: Matrix, B: Matrix) -> Matrix:
    """Product A B."""
    return A[:, :1] * B[:1, :] + A[:, 1:] * B[1:, :]


def apply(A: Matrix, v: Vector) -> Vector:
    """Product A v."""
    return A[:, 0] * v[0] + A[:, 1] * v[1]


def det(A: Matrix) -> Float[Array, ""]:
    """Determinant."""
    return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


def adj(A: Matrix) -> Matrix:
    """Adjugate: det(A) times the inverse of A."""
    return A[::-1, ::-1].T * jnp.asarray(_SIGNS, A.dtype)


def trace(A: Matrix) -> Float[Array, ""]:
    """Sum of the diagonal."""
    return A[0, 0] + A[1, 1]


def congruent(A: Matrix, S: Matrix) -> Matrix:
    """A^T S A for a symmetric S, kept symmetric."""
    product = mul(A.T, mul(S, A))
    return (product + product.T) / 2


def diagonal(d: Vector) -> Matrix:
    """Matrix with `d` on its diagonal."""
    return jnp.eye(2, dtype=d.dtype) * d[:, None]


def solve(A: Matrix, B: Matrix) -> Matrix:
    """A^-1 B for a positive definite A, scaled by its trace to stay within the range of float32.

    A = 0 (a clamp or a rigid ring, where B is 0 as well) gives B.
    """
    size = trace(A)
    scale = jnp.where(size > 0, size, 1)
    A = jnp.where(size > 0, A / scale, jnp.eye(2, dtype=A.dtype))
    return mul(adj(A), B / scale) / det(A)


def parallel(C: Matrix, W: Matrix, factor=1.0) -> Matrix:
    """(W^-1 + factor C^-1)^-1 for positive semi-definite C and W (C + factor W definite).

    (factor det(W) C + det(C) W) / det(C + factor W): a sum of positive definite matrices. C = 0,
    W = 0 and factor = 0 are ordinary values.
    """
    scale = trace(C) + factor * trace(W)
    C, W = C / scale, W / scale
    return (scale / det(C + factor * W)) * (factor * det(W) * C + det(C) * W)
