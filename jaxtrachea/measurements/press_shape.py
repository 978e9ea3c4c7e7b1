"""Least squares of a press's shape and zeros, many records at once, numpy only.

The shape is that of a local law k_1 d + k_3 d^3 on a skeleton of compliance c, D = d + c F, and a
quadratic term q D^2 for skeletons that soften; the zeros are the onset and a line of the force.
The shape serves to tell a soft beginning from air before first touch: it is no estimate.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

#: Parameters, in this order; the first three are logarithms. Everything is in shares of the record.
NAMES = ("k_1", "k_3", "c", "q", "onset", "force_offset", "force_slope")
_LOW = np.array([-8.0, -8.0, -8.0, -3.0, -1.0, -1.0, -1.0])
_HIGH = np.array([5.0, 12.0, 1.0, 3.0, 0.9, 1.0, 1.0])
#: Steps at most, fall of the sum of squares below which a record is done, and damping beyond which.
_STEPS, _DONE, _STUCK = 25, 0.02, 1e3


class Fitted(NamedTuple):
    """Best parameters of C records and their weighted sums of squares."""

    parameters: Float[np.ndarray, "C 7"]
    rss: Float[np.ndarray, " C"]


def fitted(
    x: Float[np.ndarray, "C n"],
    y: Float[np.ndarray, "C n"],
    weight: Float[np.ndarray, "C n"],
    start: Float[np.ndarray, "C 7"],
    free: Bool[np.ndarray, " 7"],
) -> Fitted:
    """Levenberg-Marquardt from one start of each record.

    Args:
        x: displacement over its range.
        y: force over its largest size.
        weight: 1 / standard deviation of each sample.
        start: parameters; those that are not free stay.
        free: which parameters move.
    """
    columns = np.flatnonzero(free)
    theta = np.clip(start, _LOW, _HIGH)
    theta[:, ~free] = start[:, ~free]
    rss = _rss(x, y, weight, theta)
    best, out = theta.copy(), rss.copy()
    damping = np.full(len(x), 1e-2)
    rows = np.arange(len(x))
    for _ in range(_STEPS):
        if not len(rows):
            break
        part = best[rows]
        value, J = _shape(x[rows], part, columns)
        J = J * weight[rows, :, None]
        r = (value - y[rows]) * weight[rows]
        A, g = np.swapaxes(J, 1, 2) @ J, (r[:, None] @ J)[:, 0]
        diagonal = np.einsum("cii->ci", A)
        A = A + (damping[rows, None] * diagonal + 1e-12)[:, :, None] * np.eye(len(columns))
        step = np.linalg.solve(A, g[..., None])[..., 0]
        trial = part.copy()
        trial[:, columns] -= np.clip(step, -2.0, 2.0)
        trial = np.where(free, np.clip(trial, _LOW, _HIGH), trial)
        after = _rss(x[rows], y[rows], weight[rows], trial)
        before = out[rows]
        better = after < before
        best[rows[better]], out[rows[better]] = trial[better], after[better]
        damping[rows] = np.where(better, damping[rows] / 5, damping[rows] * 5)
        small = (np.einsum("ci,ci->c", g, step) <= _DONE) & (damping[rows] <= 1)
        done = (better & (before - after <= _DONE)) | small | (damping[rows] > _STUCK)
        rows = rows[~done]
    return Fitted(best, out)


def fall(
    x: Float[np.ndarray, "C n"],
    y: Float[np.ndarray, "C n"],
    weight: Float[np.ndarray, "C n"],
    parameters: Float[np.ndarray, "C 7"],
    free: Bool[np.ndarray, " 7"],
) -> Float[np.ndarray, " C"]:
    """How far the sum of squares would fall if these parameters moved, of the linearised press."""
    value, J = _shape(x, parameters, np.flatnonzero(free))
    J, r = J * weight[..., None], (value - y) * weight
    A, g = np.swapaxes(J, 1, 2) @ J, (r[:, None] @ J)[:, 0]
    A = A + (1e-6 * np.einsum("cii->ci", A) + 1e-9)[:, :, None] * np.eye(J.shape[2])
    return np.einsum("ci,ci->c", g, np.linalg.solve(A, g[..., None])[..., 0])


def _rss(x, y, weight, theta) -> Float[np.ndarray, " C"]:
    r = (_shape(x, theta, None)[0] - y) * weight
    return np.einsum("cn,cn->c", r, r)


def _shape(x, theta, columns):
    """Force of every sample, and its derivative by these columns (none: None)."""
    logs = np.exp(theta[:, :3, None])
    k_1, k_3, c = logs[:, 0], logs[:, 1], logs[:, 2]
    q, onset, offset, slope = (theta[:, i, None] for i in range(3, 7))
    h = np.maximum(x - onset, 0)
    d = _indentation(h, k_1, k_3, c)
    bare = k_1 * d + k_3 * d**3
    force = bare + q * h * h + offset + slope * x
    if columns is None:
        return force, None
    own = k_1 + 3 * k_3 * d * d
    share = 1 / (1 + c * own)
    parts = (
        k_1 * d * share, k_3 * d**3 * share, -c * bare * own * share, h * h,
        -np.where(h > 0, own * share + 2 * q * h, 0), np.ones_like(x), x,
    )  # fmt: skip
    return force, np.stack([parts[i] for i in columns], axis=-1)


def _indentation(h, k_1, k_3, c):
    """The real root d of c k_3 d^3 + (1 + c k_1) d = h, in closed form."""
    p = (1 + c * k_1) / (c * k_3)
    root = np.sqrt(p / 3)
    return 2 * root * np.sinh(np.arcsinh(1.5 * h / (c * k_3) / (p * root)) / 3)
