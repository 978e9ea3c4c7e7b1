"""Rigid motions: a rotation matrix and a translation, with parametrisations smooth at rest.

Products are written row by row: they fuse into the loop around them, and no accelerator replaces
float32 by a shorter format inside a matrix product.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._errors import InputError
from jaxtrachea._numerics import epsilon, total

#: Largest |R^T R - 1| of a rotation. Lengths are off by half of it: 5 um of a tool of 100 mm.
#: Float32 rounds to 4e-7, 1,000 products of such matrices to some 1e-5; numbers written with 4
#: digits after the point are off by up to 2e-4, with 5 by 2e-5.
ORTHOGONAL = 1e-4
#: Least determinant of a mean of two rotations for which `nearest_rotation` is one: some 2.7 rad
#: between them.
TURNED_OVER = 0.05


class Pose(eqx.Module):
    """x -> rotation x + translation.

    Attributes:
        rotation: orthogonal with determinant 1 (not checked here: `check_rotations`); shape (3, 3).
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


def nearest_rotation(
    matrix: Float[Array, "3 3"], otherwise: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """The rotation next to a mean of two: its polar factor, by Newton's iteration.

    R <- (R + R^-T) / 2 (Higham 1986, doi:10.1137/0907079); five steps, to rounding for turns up to
    2 rad between the two, to 4e-6 for any that are taken.

    Args:
        matrix: of positive determinant.
        otherwise: taken where the determinant is below `TURNED_OVER`: the two rotations are nearly
            half a turn apart, and hardly any rotation is nearer to their mean than others.
    """
    x, y, z = matrix
    known = total(x * _cross(y, z)) > TURNED_OVER
    found = jnp.where(known, matrix, otherwise)
    for _ in range(5):
        x, y, z = found
        cofactors = jnp.stack([_cross(y, z), _cross(z, x), _cross(x, y)])
        found = (found + cofactors / total(x * cofactors[0])) / 2
    return jnp.where(known, found, otherwise)


def _cross(v, w):
    """Cross product of two vectors, written out."""
    (a, b, c), (d, e, f) = v, w
    return jnp.stack([b * f - c * e, c * d - a * f, a * e - b * d])


def is_rotation(rotation: Float[np.ndarray, "3 3"]) -> bool:
    """Whether a matrix is surely a rotation to `ORTHOGONAL`: if not, ask `check_rotations`.

    By plain numbers, for one matrix a call: numpy takes ten times as long. The first row is the
    cross product of the other two, which are of length 1 and orthogonal. What each of these may be
    off by adds up to nine times as much in R^T R - 1. One with NaN is none.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    t = ORTHOGONAL / 9
    return (
        -t <= e * i - f * h - a <= t and -t <= f * g - d * i - b <= t
        and -t <= d * h - e * g - c <= t and -t <= d * d + e * e + f * f - 1 <= t
        and -t <= g * g + h * h + i * i - 1 <= t and -t <= d * g + e * h + f * i <= t
    )  # fmt: skip


def check_rotations(name: str, rotations: Float[np.ndarray, "rows 3 3"]) -> None:
    """Refuse matrices that are no rotations; those that are not finite are left to statuses.

    Args:
        rotations: concrete numbers.

    Raises:
        ValueError: the first such row, how far it is off, and the cure.
    """
    R = np.asarray(rotations, float)
    R = np.where(np.isfinite(R).all(axis=(1, 2), keepdims=True), R, np.eye(3))
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
        determinant = np.linalg.det(R)
    bad = np.flatnonzero(~((off <= ORTHOGONAL) & (determinant > 0)))
    if len(bad):
        row = bad[0]
        raise InputError(
            f"row {row} (from 0) is no rotation: largest |R^T R - 1| is {off[row]:.3g}, the "
            f"determinant {determinant[row]:.3g}", key=name,
            expected=f"an orthogonal matrix with determinant +1, to {ORTHOGONAL:g}",
            cure="make it with contact.pose.pose_from_vector or pose_from_quaternion",
        )  # fmt: skip
