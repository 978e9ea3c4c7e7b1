"""Normal equations of a joint fit: a block per lane, bordered by the unknowns that all lanes share.

Written out, the matrix is an arrow, and its cost would grow with the cube of the lanes. Given the
shared unknowns the lanes know nothing of each other: each eliminates its own and leaves a small
Schur complement, whose sum determines the shared step (Triggs et al. 2000, sec. 6,
doi:10.1007/3-540-44480-7_21). Everything is linear in the number of lanes, on the host, and summed
in the order of the lanes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

#: Eigenvalue, over the largest, of a lane's scaled matrix that counts as zero.
_SINGULAR = 1e-14


class Reduced(NamedTuple):
    """Lanes after the elimination of their own unknowns; P unknowns each, k of them shared.

    Attributes:
        step: Newton step of a lane's own unknowns where the shared ones stay, damped where it
            would be too long; 0 for the shared ones; (L, P).
        sensitivity: how all unknowns of a lane move with each shared one; (L, P, k).
        predicted_decrease: fall of each lane's cost by `step`, to second order; (L,).
        gradient: of each lane's cost by the shared unknowns, its own following; (L, k).
        hessian: Schur complement; (L, k, k).
    """

    step: Float[np.ndarray, "L P"]
    sensitivity: Float[np.ndarray, "L P k"]
    predicted_decrease: Float[np.ndarray, " L"]
    gradient: Float[np.ndarray, "L k"]
    hessian: Float[np.ndarray, "L k k"]


def eliminate(
    gradient: Float[np.ndarray, "L P"],
    hessian: Float[np.ndarray, "L P P"],
    shared: Int[np.ndarray, "L k"],
    free: Bool[np.ndarray, "L P"],
    longest: float = np.inf,
) -> Reduced:
    """Eliminate every lane's own unknowns; directions that change nothing do not move.

    Args:
        gradient: of the lane's cost.
        hessian: symmetric, not negative.
        shared: where the shared unknowns stand in each lane.
        free: unknowns that move; shared ones are not looked at.
        longest: step of a lane's own unknowns. Where the data have the best value of one at
            infinity, a Newton step may have any length, and brings nothing of what it promises.
    """
    select = selector(shared, hessian.shape[1])
    own = free & (select.sum(axis=2) == 0)
    inverse = pseudo_inverse(hessian, own)
    step = -np.einsum("lpq,lq->lp", inverse, gradient)
    for lane in np.flatnonzero(np.max(np.abs(step), axis=1, initial=0) > longest):
        inverse[lane] = _damped_inverse(longest, gradient[lane], hessian[lane], own[lane])
        step[lane] = -inverse[lane] @ gradient[lane]
    sensitivity = select - inverse @ hessian @ select
    curved = np.einsum("lp,lpq,lq->l", step, hessian, step)
    predicted_decrease = -np.sum(step * gradient * own, axis=1) - 0.5 * curved
    reduced = np.einsum("lpk,lp->lk", sensitivity, gradient)
    return Reduced(step, sensitivity, predicted_decrease, reduced, congruent(hessian, sensitivity))


def selector(shared: Int[np.ndarray, "L k"], size: int) -> Float[np.ndarray, "L size k"]:
    """Columns that put shared unknowns into their places in every lane."""
    return np.swapaxes(np.eye(size)[shared], 1, 2)


def congruent(matrix: Float[np.ndarray, "L P P"], sensitivity: Float[np.ndarray, "L P k"]):
    """sensitivity^T matrix sensitivity of every lane, symmetric to the last digit; (L, k, k)."""
    product = np.swapaxes(sensitivity, 1, 2) @ matrix @ sensitivity
    return 0.5 * (product + np.swapaxes(product, 1, 2))


def pseudo_inverse(
    matrix: Float[np.ndarray, "L P P"], free: Bool[np.ndarray, "L P"]
) -> Float[np.ndarray, "L P P"]:
    """Inverse of the free block of each lane, 0 elsewhere and along directions without weight."""
    diagonal = np.diagonal(matrix, axis1=1, axis2=2)
    scale = np.where(free & (diagonal > 0), 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 0)
    scaled = matrix * scale[:, :, None] * scale[:, None]
    values, vectors = np.linalg.eigh(scaled)
    keep = values > _SINGULAR * np.maximum(values[:, -1:], 1e-300)
    weight = np.where(keep, 1 / np.where(keep, values, 1), 0)
    inverse = (vectors * weight[:, None]) @ np.swapaxes(vectors, 1, 2)
    return inverse * scale[:, :, None] * scale[:, None]


def trust_region_step(
    radius: float, gradient: Float[np.ndarray, " k"], hessian: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, " k"]:
    """Minimum of the quadratic model in the ball of this radius."""
    values, vectors = np.linalg.eigh(hessian)
    along = vectors.T @ gradient
    return -vectors @ (along / (np.maximum(values, 0) + _damping(radius, along, values)))


def _damping(radius: float, along, values) -> float:
    """What is added to a matrix so that the step has this length, or next to 0 if it is shorter.

    By bisection of its logarithm, in the coordinates where the matrix is diagonal.
    """
    from scipy.linalg import norm  # of numbers whose squares overflow too

    top = max(values[-1], 1e-300)
    values = np.maximum(values, 0)

    def too_long(damping):  # both sides times the damping: no quotient is beyond float64
        added = np.exp(damping)
        return norm(along / (values / added + 1)) > radius * added

    low, high = np.log(_SINGULAR * top), np.log(top + norm(along) / radius)
    if too_long(low):
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if too_long(middle) else (low, middle)
        low = high
    return float(np.exp(low))


def _damped_inverse(longest: float, gradient, hessian, own):
    """Inverse of a lane's own block, 0 elsewhere, damped so that its step is as long as may be."""
    block = np.ix_(own, own)
    values, vectors = np.linalg.eigh(hessian[block])
    damping = _damping(longest, vectors.T @ gradient[own], values)
    inverse = np.zeros_like(hessian)
    inverse[block] = (vectors / (np.maximum(values, 0) + damping)) @ vectors.T
    return inverse


def eliminate_others(
    bread: Float[np.ndarray, "L P P"],
    meat: Float[np.ndarray, "L P P"],
    shared: Int[np.ndarray, "L k"],
    free: Bool[np.ndarray, "L P"],
) -> tuple[Float[np.ndarray, "L P P"], Float[np.ndarray, "L P P"]]:
    """Information of each lane's unknowns with those of all other lanes eliminated.

    With A the returned first and B the second matrix of a lane, A^-1 B A^-1 is the lane's block of
    the sandwich of the whole arrow, exactly: what other lanes know of the shared unknowns is the
    sum of their Schur complements, and the scores of lanes are independent.

    Args:
        bread: of each lane by itself.
        meat: of each lane by itself.
        shared: where the shared unknowns stand in each lane.
        free: unknowns that are not held on a bound.
    """
    reduced = eliminate(np.zeros(free.shape), bread, shared, free)
    select = selector(shared, free.shape[1])

    def with_others(matrix):
        schur = congruent(matrix, reduced.sensitivity)
        others = schur.sum(axis=0) - schur
        return matrix + select @ others @ np.swapaxes(select, 1, 2)

    return with_others(bread), with_others(meat)
