"""A study whose parameters are all fixed: no fit, but all else that a fit says of the data."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtrachea.fitting.cost import robust
from jaxtrachea.fitting.covariance import Uncertainty, half_widths
from jaxtrachea.fitting.criteria import criteria
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.lane import forces, markers
from jaxtrachea.fitting.minima import KEPT
from jaxtrachea.fitting.noise import first_sigma, next_sigma, precision_unit
from jaxtrachea.fitting.predictions import Prediction, predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.status import FitStatus


def evaluated(study: Study) -> FitResult:
    """Cost, residuals, noise and criteria of a study without unknowns.

    Returns:
        A `FitResult` with 0 unknowns and iterations; lanes without finite forces are NON_FINITE.
    """
    lanes = len(study.lanes.s_c)
    seen = predictions(study, np.zeros((lanes, 0)))
    info = _information(study, seen)
    sigma = next_sigma(study, info, first_sigma(study))
    unit = precision_unit(study)
    finite = np.asarray(np.isfinite(info.squares).all(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(info.plain / info.counts)
    total = np.sum(info.counts, axis=1)
    half = half_widths(total, noise_known=study.noise_known)
    none = np.zeros((lanes, 0))
    return FitResult(
        study=study, theta=none, value=none, standard_error=none, lower=none, upper=none,
        relative_se=none, at_bound=none.astype(bool),
        status=np.where(finite, FitStatus.CONVERGED, FitStatus.NON_FINITE).astype(int),
        cost=_cost(study, seen, sigma), converged_starts=finite.astype(int),
        start_costs=np.full((lanes, KEPT), np.nan),
        sigma=sigma * unit, rms=rms, samples=total, criteria=criteria(study, info, finite),
        uncertainty=_no_uncertainty(half), undetermined=none.astype(bool),
        unexamined=none.astype(bool),
        evidence_low=none, evidence_high=none, evidence_end=np.zeros((lanes, 0, 2), int),
        with_air=np.zeros((lanes, 0, 2)), minima=np.ones(lanes, int),
        iterations=np.zeros(lanes, int), tried=np.ones(lanes, int),
    )  # fmt: skip


def _whitened(study: Study, off: Prediction) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Residuals of forces and markers in units of their precision, and which are observed.

    Both with the trials first, (lanes, trials * entries of a trial).
    """
    lanes, parts, seen = study.lanes, [], []
    shape = (*lanes.s_c.shape, -1)
    for kinds in (forces(lanes), markers(lanes)):
        if not kinds:
            continue
        rows, there = [], []
        for kind in kinds:
            observed, residual = kind.precision > 0, off[kind.name]
            rows.append(np.where(observed, residual * kind.precision, 0).reshape(shape))
            there.append(observed.reshape(shape))
        parts.append(np.concatenate(rows, axis=2).reshape(len(lanes.s_c), -1))
        seen.append(np.concatenate(there, axis=2).reshape(len(lanes.s_c), -1))
    return parts, seen


def _information(study: Study, off: Prediction) -> Information:
    """Residual statistics; the matrices are empty."""
    parts, seen = _whitened(study, off)
    lanes, trials = study.lanes.s_c.shape
    zero = np.zeros(lanes)

    def both(values):
        return np.stack([*values, *[zero] * (2 - len(values))], axis=1)

    def plain(kinds):
        total = zero
        for kind in kinds:
            off_by = np.where(kind.precision > 0, off[kind.name], 0)
            total = total + np.sum(off_by**2, axis=tuple(range(1, off_by.ndim)))
        return total

    def spread(part, observed):
        if study.model.loss == "linear":
            return zero
        rows = [np.abs(v[o]) for v, o in zip(part, observed, strict=True)]
        return np.array([np.median(v) if len(v) else np.nan for v in rows])

    arrays: dict[str, Any] = dict(
        bread=np.zeros((lanes, 0, 0)),
        meat=np.zeros((lanes, 0, 0)),
        gradient=np.zeros((lanes, 0)),
        squares=both([np.sum(v**2, axis=1) for v in parts]),
        plain=both([plain(forces(study.lanes)), plain(markers(study.lanes))]),
        counts=both([np.sum(s, axis=1).astype(float) for s in seen]),
        spread=both([spread(*pair) for pair in zip(parts, seen, strict=True)]),
        psi2=np.ones((lanes, 2)),
        dpsi=np.ones(lanes),
    )
    return Information(**arrays)


def _cost(study: Study, seen, sigma: np.ndarray) -> np.ndarray:
    """Half the weighted sum of the loss."""
    parts, _ = _whitened(study, seen)
    trials, total = study.lanes.s_c.shape[1], np.zeros(len(sigma))
    for kind, part in enumerate(parts):
        weight = np.repeat(study.lanes.balance, part.shape[1] // trials, axis=1) ** 2
        z2 = jnp.asarray((part / sigma[:, kind, None]) ** 2)
        rho, _ = robust(study.model.loss, z2, study.model.loss_scale)
        total += 0.5 * np.sum(weight * np.asarray(rho), axis=1)
    return total


def _no_uncertainty(half: np.ndarray) -> Uncertainty:
    """Of no unknowns; only the width of an interval for the noise, (lanes,)."""
    none, square = np.zeros((len(half), 0)), np.zeros((len(half), 0, 0))
    nan = np.full(len(half), np.nan)
    return Uncertainty(
        se=none, correlation=square, condition=nan, weakest_direction=none,
        weakest_se=nan, structural_null_space=square,
        half_width=half, conditional_direction=square, dispersion=none, covariance=square,
        null_space=square,
    )  # fmt: skip
