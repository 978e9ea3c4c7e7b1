"""Gauss-Newton steps of many lanes from near their minima, by the program of the standard errors.

A fit has that program compiled in any case; the one of the solver takes 10 s for every shape.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.cost import rounding_cost
from jaxtrachea.fitting.information import Information, informations
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.optimisation.trust_region import Tolerances, active_set
from jaxtrachea.status import FitStatus

#: Evaluations of a lane at most, and the part of the largest eigenvalue that is rounding.
MOST, ROUNDING = 24, 1e-14


class _Box(NamedTuple):
    """Bounds of the unknowns of each point, and which of them exist; (n, P) each."""

    lower: Float[np.ndarray, "n P"]
    upper: Float[np.ndarray, "n P"]
    active: Float[np.ndarray, "n P"]


def gauss_newton(
    study: Study,
    rows: Int[np.ndarray, " n"],
    theta: Float[np.ndarray, "n P"],
    sigma: Float[np.ndarray, "lanes 2"],
    tolerances: Tolerances,
) -> Solved:
    """The minimum near each point, where plain steps lead to it in a few.

    Linear loss, no fitted onset: else the matrix is another.

    Args:
        study: the study.
        rows: lane of each point.
        theta: the points, scaled coordinates.
        sigma: of every lane.
        tolerances: a lane has converged where the solver would say so for the same reason: less
            than a hundredth of `cost` is left to be gained.

    Returns:
        Outcomes in order: `CONVERGED`, or `STALLED` where whole and halved steps do not lead there
        (narrow, bent valleys): such a lane is for the solver, from where it has come.
    """
    lanes: Any = study.lanes
    noise = sigma[rows]
    box = _Box(lanes.lower[rows], lanes.upper[rows], lanes.active[rows])
    exact = rounding_cost(study.model, lanes, sigma)[rows]
    theta, cost = theta.copy(), np.full(len(rows), np.inf)
    step, part = np.zeros_like(theta), np.ones(len(rows))
    status, iterations = np.full(len(rows), FitStatus.STALLED), np.zeros(len(rows), int)
    left = np.arange(len(rows))
    for _ in range(MOST):
        here = _Box(*(v[left] for v in box))
        trial = np.clip(theta[left] + part[left, None] * step[left], here.lower, here.upper)
        info = informations(study, rows[left], trial, noise[left], together=len(lanes.lower))
        iterations[left] += 1
        new = 0.5 * np.sum(info.weighted / noise[left] ** 2, axis=1)
        ahead, gain = _step(trial, info, here)
        better = (new < cost[left]) & np.isfinite(gain)
        went = left[better]
        theta[went], cost[went], step[went] = trial[better], new[better], ahead[better]
        part[left] = np.where(better, 1, part[left] / 2)
        done = better & ((gain <= 0.01 * tolerances.cost * new) | (new <= exact[left]))
        status[left[done]] = FitStatus.CONVERGED
        left = left[~done & np.isfinite(cost[left])]
        if not len(left):
            break
    return Solved(theta, cost, status, iterations)


def _step(
    theta: Float[np.ndarray, "n P"], info: Information, box: _Box
) -> tuple[Float[np.ndarray, "n P"], Float[np.ndarray, " n"]]:
    """Step of the unknowns that may move, and how much less the cost is where it is linear.

    What is promised is NaN where a lane cannot be evaluated.
    """
    gradient: Any = info.gradient
    free: Any = ~active_set(theta, gradient, box)
    usable = np.isfinite(info.bread).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
    both = free[:, :, None] & free[:, None] & usable[:, None, None]
    matrix = np.where(both, info.bread, np.eye(theta.shape[1]))
    size = np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1e-300))
    downhill = np.where(free & usable[:, None], -gradient, 0) / size
    scaled = matrix / size[:, :, None] / size[:, None]
    inverse = np.linalg.pinv(scaled, rcond=ROUNDING, hermitian=True)
    step = np.einsum("nij,nj->ni", inverse, downhill)
    gain = 0.5 * np.sum(step * downhill, axis=1)
    return step / size, np.where(usable & (gain >= 0), gain, np.nan)
