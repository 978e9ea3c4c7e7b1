"""Specimens with known truth, pressed by an independent beam: the truth behind the verdicts.

The skeleton is `beam_fem` (a stiffness method in high precision), the contact a scalar equation
solved by bisection; nothing of it comes from the package.
"""

from typing import NamedTuple

import beam_fem
import numpy as np

#: Names, lower and upper end of the box that truths are drawn from (log-uniform).
NAMES = ("EI_L", "k_M", "k_1", "k_3")
BOX = np.array([[100.0, 3000.0], [0.1, 2.0], [1.0, 30.0], [0.01, 1.0]])
#: The case of the 20 specimens: stiff contact on a soft skeleton (compliance 0.35 to 0.6 mm/N).
STIFF_CONTACT = np.array([[800.0, 1000.0], [0.52, 1.0], [11.0, 12.0], [0.05, 0.2]])
#: Contact positions, mm; a study of n positions takes the first n.
POSITIONS = (75.0, 22.0, 48.0, 130.0)
DEPTHS = np.linspace(0.15, 6.0, 40)


class Specimens(NamedTuple):
    """M specimens pressed at T positions to N depths.

    Attributes:
        truth: in the order of `NAMES`; (M, 4).
        compliance: of the skeleton at each position, mm/N; (M, T).
        force: N; (M, T, N).
        joints: motion of every ring, mm; (M, T, N, rings).
    """

    truth: np.ndarray
    compliance: np.ndarray
    force: np.ndarray
    joints: np.ndarray


def draw(seed: int, count: int, box: np.ndarray = BOX) -> np.ndarray:
    """Truths, log-uniform in the box; (count, 4)."""
    unit = np.random.default_rng(seed).uniform(size=(count, 4))
    return box[:, 0] * (box[:, 1] / box[:, 0]) ** unit


def press(truth, rings, length, positions=POSITIONS, depths=DEPTHS, digits=30) -> Specimens:
    """Press every specimen at every position.

    Args:
        truth: (M, 4).
        rings: positions of the rings, mm.
        length: of the tube, mm.
        positions: of contact, mm.
        depths: tool displacement, mm.
        digits: of the beam's arithmetic.
    """
    before, beam_fem.DIGITS = beam_fem.DIGITS, digits
    try:
        solved = [[_unit(EI, k, rings, length, s) for s in positions] for EI, k, _, _ in truth]
    finally:
        beam_fem.DIGITS = before
    compliance = np.array([[c for c, _ in row] for row in solved])
    motion = np.array([[w for _, w in row] for row in solved])
    k_1, k_3 = truth[:, 2, None, None], truth[:, 3, None, None]
    low = np.zeros((*compliance.shape, len(depths)))
    high = np.broadcast_to(depths, low.shape).copy()
    for _ in range(60):
        middle = (low + high) / 2
        force = k_1 * middle + k_3 * middle**3
        deep = middle + compliance[:, :, None] * force > depths
        high, low = np.where(deep, middle, high), np.where(deep, low, middle)
    force = k_1 * low + k_3 * low**3
    return Specimens(truth, compliance, force, force[..., None] * motion[:, :, None])


def _unit(EI, k, rings, length, s) -> tuple[float, list[float]]:
    """Deflection under a unit force at s, there and at every ring."""
    solved = beam_fem.solve(rings, length, [EI] * (len(rings) + 1), [k] * len(rings), s, 1.0)
    return float(solved.w_C), [float(w) for w in solved.w]


def noisy(clean: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """With normal noise of `share` of the largest value of each specimen (leading axis)."""
    peak = np.abs(clean).reshape(len(clean), -1).max(axis=1)
    return clean + share * peak.reshape(-1, *[1] * (clean.ndim - 1)) * rng.normal(size=clean.shape)
