"""A beam on ring springs under a punch, by dense finite elements: two points held at 1 mm."""

from typing import NamedTuple

import numpy as np


class Held(NamedTuple):
    """What two points held alike do, per unit of the sum of their forces.

    `w_C`: of both, mm/N; `w`: at every ring; `reaction`: of every ring; `share`: part of the force
    at each point; `edges`: rotation there, 1/N; `line`: deflection where asked for, mm/N.
    """

    w_C: float
    w: np.ndarray
    reaction: np.ndarray
    share: np.ndarray
    edges: np.ndarray
    line: np.ndarray


def held(x, length, EI, k, s, half, GA=None, at=()) -> Held:
    """Rings at `x` on springs `k`; `EI` (and `GA`) of each span; both ends clamped.

    Elements are cubic, exact for the beam with and without shear; nodes stand wherever something is
    read.
    """
    ends = [s - half, s + half]
    nodes = np.unique(np.concatenate([[0.0, length], x, ends, at]))
    stiffness = np.zeros((2 * len(nodes),) * 2)
    for i, h in enumerate(np.diff(nodes)):
        span = np.searchsorted(x, (nodes[i] + nodes[i + 1]) / 2)
        P = 12 * EI[span] / (GA[span] * h * h) if GA is not None else 0.0
        element = np.array([
            [12, 6 * h, -12, 6 * h],
            [6 * h, (4 + P) * h * h, -6 * h, (2 - P) * h * h],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, (2 - P) * h * h, -6 * h, (4 + P) * h * h],
        ])  # fmt: skip
        stiffness[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += EI[span] / ((1 + P) * h**3) * element
    ring = 2 * np.searchsorted(nodes, x)
    stiffness[ring, ring] += k
    fixed = 2 * np.searchsorted(nodes, ends)
    free = np.setdiff1d(np.arange(2, len(stiffness) - 2), fixed)
    w = np.zeros(len(stiffness))
    w[fixed] = 1
    w[free] = np.linalg.solve(stiffness[np.ix_(free, free)], -stiffness[np.ix_(free, fixed)].sum(1))
    forces = stiffness[fixed] @ w
    w /= (force := forces.sum())
    line = w[2 * np.searchsorted(nodes, np.asarray(at, float))]
    return Held(1 / force, w[ring], k * w[ring], forces / force, w[fixed + 1], line)
