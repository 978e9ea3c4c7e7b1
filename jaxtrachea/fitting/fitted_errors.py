"""How well a fit knows its own curves: standard errors of what it says at the measured points."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.lane import forces, markers
from jaxtrachea.fitting.predictions import Prediction, predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study

#: Step of the difference quotients, as a relative change of an unknown: their error is of the order
#: of its square.
STEP = 1e-4
#: Part of the noise's variance that a residual must keep: one that keeps less is fitted exactly.
_KEPT = 1e-3


class FittedErrors(NamedTuple):
    """Of some lanes of a fit, in their order; shapes as `Prediction`, NaN where not observed.

    Attributes:
        fitted: standard error of each fitted value by the noise of the data, N or mm. It is known
            whatever the unknowns: a combination that the data leave open moves no fitted value.
        studentised: residual, model - data, over its standard deviation sqrt(sigma^2 - fitted^2)
            (Cook and Weisberg 1982, Residuals and Influence in Regression, section 2.2.1); NaN
            where the fit follows the sample exactly. It is that of `influence` where samples weigh
            by their noise; of curves weighed otherwise the estimates count as if they were as good
            as the noise allows.
    """

    fitted: Prediction
    studentised: Prediction


def fitted_errors(result: FitResult, lanes: Int[np.ndarray, " n"]) -> FittedErrors:
    """Standard errors of the fitted values, and residuals over their standard deviation."""
    study = result.study
    slopes, covariance = _slopes(result, lanes), _covariance(result, lanes)
    fitted, studentised = {}, {}
    for k, kinds in enumerate((forces(study.lanes), markers(study.lanes))):
        for kind in kinds:
            residual = result.residuals[kind.name][lanes]
            error = _error(slopes[kind.name], covariance) if slopes else np.zeros(residual.shape)
            sigma = result.whitened_sigma[lanes, k].reshape(-1, *(1,) * (residual.ndim - 1))
            with np.errstate(divide="ignore", invalid="ignore"):
                noise = sigma / kind.precision[lanes]
                kept = 1 - (error / noise) ** 2
                over = residual / noise / np.sqrt(np.where(kept > _KEPT, kept, np.nan))
            fitted[kind.name] = np.where(np.isfinite(residual), error, np.nan)
            studentised[kind.name] = over
    return FittedErrors(fitted, studentised)


def _columns(study: Study, lanes) -> tuple[np.ndarray, np.ndarray]:
    """Which unknown each curve reads of each free column, and whether it reads one; (n, T, F)."""
    index = np.asarray(study.lanes.index)[lanes][:, :, list(study.free_columns)]
    return np.maximum(index, 0), index >= 0


def _slopes(result: FitResult, lanes) -> dict[str, Float[np.ndarray, "F n T ..."]]:
    """Slope of what is fitted along each free column, scaled coordinates; {} without columns.

    Central differences of the program that gave the residuals, so that nothing new is compiled. A
    curve reads one unknown of a column, so that one pair serves all unknowns of it.
    """
    study, rows = result.study, np.arange(len(lanes))[:, None]
    place, read = _columns(study, lanes)
    count = place.shape[2]
    if not count:
        return {}
    step = STEP * result.relative[lanes]
    width = 2 * np.where(read, step[rows[..., None], place], 1)
    kinds = forces(study.lanes) + markers(study.lanes)
    twice, slopes = study.take(np.tile(lanes, 2)), {kind.name: [] for kind in kinds}
    for f in range(count):
        move = np.where(study.unknown_columns[lanes] == f, step, 0)
        ends = np.concatenate([result.theta[lanes] + move, result.theta[lanes] - move])
        found = predictions(twice, ends, like=result.lanes)
        for name, parts in slopes.items():
            up, down = np.split(found[name], 2)
            parts.append(
                (up - down) / width[..., f].reshape(*place.shape[:2], *[1] * (up.ndim - 2))
            )
    return {name: np.stack(parts) for name, parts in slopes.items()}


def _covariance(result: FitResult, lanes) -> Float[np.ndarray, "n T F F"]:
    """Of what each curve reads of the free columns; 0 where it reads nothing."""
    place, read = _columns(result.study, lanes)
    rows = np.arange(len(lanes)).reshape(-1, 1, 1, 1)
    found = result.uncertainty.covariance[lanes][rows, place[..., :, None], place[..., None, :]]
    return np.where(read[..., :, None] & read[..., None, :], found, 0)


def _error(slope: Float[np.ndarray, "F n T ..."], covariance) -> Float[np.ndarray, "n T ..."]:
    """Delta method: sqrt(J C J^T)."""
    moved = np.einsum("ntfg,gnt...->fnt...", covariance, slope)
    return np.sqrt(np.maximum(np.sum(slope * moved, axis=0), 0))
