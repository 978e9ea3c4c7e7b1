"""Rigid motions: a rotation matrix and a translation, with parametrisations smooth at rest.

Products are written row by row: they fuse into the loop around them, and no accelerator replaces
float32 by a shorter format inside a matrix product.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import epsilon


class Pose(eqx.Module):
    """x -> rotation x + translation.

    Attributes:
        rotation: orthogonal with determinant 1 (not checked); shape (3, 3).
        translation: mm; shape (3,).
    """

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]


def transform(pose: Pose, points: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Images of points (columns), mm."""
    return rotate(pose.rotation, points) + pose.translation[:, None]


def rotate(rotation: Float[Array, "3 3"], vectors: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Rotated vectors (columns)."""
    x, y, z = vectors
    return jnp.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation])


def compose(outer: Pose, inner: Pose) -> Pose:
    """The motion `inner` followed by `outer`."""
    translation = transform(outer, inner.translation[:, None])[:, 0]
    return Pose(rotate(outer.rotation, inner.rotation), translation)


def inverse(pose: Pose) -> Pose:
    """The motion back."""
    back = pose.rotation.T
    return Pose(back, -rotate(back, pose.translation[:, None])[:, 0])


def relative(a: Pose, b: Pose) -> Pose:
    """Frame of B seen from frame A, for two poses given in one world frame."""
    back = a.rotation.T
    shift = rotate(back, (b.translation - a.translation)[:, None])[:, 0]
    return Pose(rotate(back, b.rotation), shift)


def pose_from_vector(rotation: Float[Array, "3"], translation: Float[Array, "3"]) -> Pose:
    """Pose from a rotation vector, by Rodrigues' formula.

    exp([w]) = I + sin(t)/t [w] + (1 - cos t)/t^2 [w]^2 with t = |w|; below t^2 = sqrt(eps) by the
    series, so that every derivative is finite at w = 0.

    Args:
        rotation: axis times angle, rad; shape (3,).
        translation: mm; shape (3,).
    """
    x, y, z = rotation
    square = x * x + y * y + z * z
    near = square < epsilon(square.dtype) ** 0.5
    angle = jnp.sqrt(jnp.where(near, 1, square))
    half = jnp.sin(angle / 2) / angle
    first = jnp.where(near, 1 - square / 6 * (1 - square / 20), jnp.sin(angle) / angle)
    second = jnp.where(near, 0.5 - square / 24 * (1 - square / 30), 2 * half * half)
    zero = jnp.zeros_like(x)
    skew = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    matrix = jnp.eye(3, dtype=square.dtype) + first * skew + second * rotate(skew, skew)
    return Pose(matrix, translation)


def pose_from_quaternion(quaternion: Float[Array, "4"], translation: Float[Array, "3"]) -> Pose:
    """Pose from a quaternion (w, x, y, z), normalised here; a zero quaternion gives NaN.

    Args:
        quaternion: real part first, any length but zero; shape (4,).
        translation: mm; shape (3,).
    """
    w, x, y, z = quaternion
    k = 2 / (w * w + x * x + y * y + z * z)
    rows = [
        [1 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y)],
        [k * (x * y + w * z), 1 - k * (x * x + z * z), k * (y * z - w * x)],
        [k * (x * z - w * y), k * (y * z + w * x), 1 - k * (x * x + y * y)],
    ]
    return Pose(jnp.stack([jnp.stack(row) for row in rows]), translation)
