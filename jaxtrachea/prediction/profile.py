"""How far a band by the delta method is from the profile likelihood of the force that it is of.

The ends of the band are put as forces: the fit is made again under the condition that the model
gives that force, and what its cost has risen by tells how far out the true end of the band lies
(Kreutz, Raue and Timmer 2012, Likelihood based observability analysis and confidence intervals for
predictions of dynamic models, doi:10.1186/1752-0509-6-120). A straight walk from the estimates
along their covariance leaves the valley of the fit where that is curved, and says nothing of it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.prediction.core import Predicted
from jaxtrachea.prediction.model_error import ModelError, over_unknowns, rows_of
from jaxtrachea.prediction.sources import CurveParameters

#: Error of the linear band at its ends, in half-widths, from which it is called bent.
BENT = 0.5
#: Steps of the way to the end of a band, and of the constrained fit in all.
WAY, STEPS = 20, 40
#: Change of its cost, over that of the band's end, and distance from its force, over the
#: half-width, at which it has ended; longest step, relative or in standard errors.
SETTLED, REACHED, FAR = 0.02, 0.01, 0.5
#: Singular values of the scaled Jacobian, over the largest, that determine nothing.
_SINGULAR = 1e-8

#: Of unknowns moved by rows (n, P): by how much the forces at the deepest displacement change, N,
#: (n,), and their derivatives by the unknowns, (n, P).
Force = Callable[[Float[np.ndarray, "n P"]], tuple[np.ndarray, np.ndarray]]


def errors_of_bands(
    stored: FitResult,
    sources: Sequence[CurveParameters],
    displacements: Sequence[np.ndarray],
    parts: Sequence[Predicted],
    errors: Mapping[int, ModelError],
    answers: Callable[[np.ndarray, np.ndarray], Predicted],
) -> Float[np.ndarray, " curves"]:
    """Error of each linear band at its ends, at the deepest displacement, in half-widths.

    By a straight walk along the covariance of the estimates, and where that says that it is bent
    by the profile of the force, which takes longer. What the curve's own parameters take up does
    not count: they are fitted to it.

    Args:
        stored: the fit.
        sources: of each curve, with covariances as its band has them.
        displacements: of each, mm.
        parts: what is predicted of each.
        errors: of the model, by lane.
        answers: what is predicted of some curves with other free parameters, a row each.
    """
    bends = np.zeros(len(sources))
    slopes, doubts = {}, []
    for k, (source, part) in enumerate(zip(sources, parts, strict=True)):
        n, deepest = len(displacements[k]), int(part.deepest)
        half = float(source.half_width * part.se["force"][deepest])
        if not (np.isfinite(half) and half > 0 and np.isfinite(part.value["force"][deepest])):
            continue
        worst = np.max(np.abs(_without_own(source, part.bend[:, :n])[:, deepest])) / half
        # No solution within the band (past a fold): as bent as can be.
        bends[k] = worst if np.isfinite(worst) else np.inf
        slopes[k] = _without_own(source, part.slope[:, :n])[:, deepest]
        if bends[k] > BENT and slopes[k] @ source.covariance @ slopes[k] > 0:
            doubts.append(k)
    if not (doubts and _has_profile(stored)):
        return bends
    rows = np.repeat(doubts, 2)
    columns = [_unknowns_of(stored, sources[k]) for k in rows]

    def force(moved):
        free = np.stack(
            [sources[k].free + M @ by for k, M, by in zip(rows, columns, moved, strict=True)]
        )
        part, changes, by_unknowns = answers(rows, free), [], []
        for i, k in enumerate(rows):
            n, deepest = len(displacements[k]), int(part.deepest[i])
            change = part.value["force"][i, :n] - parts[k].value["force"][:n]
            changes.append(_without_own(sources[k], change)[deepest])
            slope = _without_own(sources[k], part.slope[i, :, :n])[:, deepest]
            by_unknowns.append(columns[i].T @ slope)
        return np.array(changes), np.stack(by_unknowns)

    lanes = np.array([sources[k].lane for k in rows])
    growth = np.array([errors[lane].growth for lane in lanes])
    half = np.array([sources[k].half_width for k in rows])
    pulls = np.array([slopes[k] @ sources[k].covariance @ slopes[k] for k in rows])
    target = np.tile([1.0, -1.0], len(doubts)) * half * np.sqrt(pulls)
    expected = (half * np.where(np.isfinite(growth), growth, 1.0)) ** 2
    found = _error_of_ends(stored, lanes, force, target, expected)
    worst = np.max(found.reshape(-1, 2), axis=1)  # NaN stays
    bends[doubts] = np.where(np.isnan(worst), bends[doubts], worst)
    return bends


def _without_own(source: CurveParameters, change: Any) -> np.ndarray:
    """A change of the force, (..., N), less what the curve's own parameters take up of it."""
    if source.refitted_own is None:
        return change
    slope, gain = source.refitted_own
    return change - (change @ gain.T) @ slope.T


def _unknowns_of(stored: FitResult, source: CurveParameters) -> np.ndarray:
    """Derivative of the free columns of a curve by the unknowns of its lane; (F, P)."""
    out = np.zeros((len(source.free), stored.theta.shape[1]))
    known = np.flatnonzero(source.index >= 0)
    out[known, source.index[known]] = 1
    return out


def _has_profile(stored: FitResult) -> bool:
    """Whether the cost of one lane is the sum of squares that its standard errors are of."""
    return not stored.study.joint and stored.study.model.loss == "linear"


def _error_of_ends(
    stored: FitResult,
    lanes: np.ndarray,
    force: Force,
    target: Float[np.ndarray, " n"],
    expected: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Error of ends of bands, in half-widths; NaN where the constrained fit does not end.

    The cost that a quadratic one would have risen by at the end is known; the true end is taken to
    lie where it would be if the cost were quadratic through the one that is found.

    Args:
        lanes: of the fit, one of each end.
        force: of the prediction.
        target: force at the end of the band less that of the estimates, N.
        expected: twice the cost that it is at by the covariance of the estimates.
    """
    theta = stored.theta[lanes]

    def rows(moved):
        study, value, jacobian, _ = rows_of(stored, lanes, theta + moved)
        of_lanes = (
            over_unknowns(study, k, jacobian[k], stored.at_bound[lane])
            for k, lane in enumerate(lanes)
        )
        X = np.stack([np.moveaxis(x, 1, 2).reshape(-1, theta.shape[1]) for x in of_lanes])
        return value.reshape(len(lanes), -1), X

    moved, before = np.zeros_like(theta), np.zeros_like(theta)
    far = FAR * np.maximum(stored.relative[lanes], stored.uncertainty.se[lanes])
    ended, cost, least = np.zeros(len(lanes), bool), np.zeros(len(lanes)), None
    for k in range(STEPS):
        (r, X), (now, slope) = rows(moved), force(moved)
        square = np.sum(r**2, axis=1)
        least = square if least is None else least
        last, cost = cost, square - least
        there = np.abs(target - now) <= REACHED * np.abs(target)
        ended |= there & (np.abs(cost - last) <= SETTLED * expected)
        goes = ~ended & np.isfinite(cost) & np.isfinite(slope).all(axis=1)
        if not goes.any():
            break
        off = min((k + 1) / WAY, 1) * target - now
        for i in np.flatnonzero(goes):
            step = _step(r[i], X[i], slope[i], off[i])
            step /= max(1.0, np.max(np.abs(step) / far[i], initial=0))
            if (step / far[i]) @ (before[i] / far[i]) < 0:
                step /= 2  # to and fro across a curved valley
            moved[i] += step
            before[i] = step
    with np.errstate(divide="ignore"):
        error = np.abs(1 / np.sqrt(np.maximum(cost / expected, 0)) - 1)
    return np.where(ended, error, np.nan)


def _step(r, X, slope, off: float) -> np.ndarray:
    """Least squares of r + X d under slope . d = off, by the null space of the condition."""
    size = np.linalg.norm(X, axis=0)
    size = np.where(size > 0, size, 1)  # a held unknown stays
    A, g = X / size, slope / size
    g = np.where(np.any(X != 0, axis=0), g, 0)
    first = g * (off / (g @ g)) if g @ g > 0 else np.zeros_like(g)
    basis = np.linalg.svd(g[None])[2][1:].T
    along = np.linalg.lstsq(A @ basis, -(r + A @ first), rcond=_SINGULAR)[0]
    return (first + basis @ along) / size
