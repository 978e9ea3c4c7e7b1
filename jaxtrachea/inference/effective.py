"""Intervals for residuals whose neighbours are correlated: as many samples as are worth having.

With a correlation r of neighbours, falling by r from sample to sample (AR(1)), n samples tell a
mean as well as n (1 - r) / (1 + r) independent ones (Bayley and Hammersley 1946,
doi:10.2307/2983560; Thiebaux and Zwiers 1984, doi:10.1175/1520-0450(1984)023<0800:TIAEOE>2.0.CO;2),
and so it is for the unknowns of smooth curves, whose derivatives change little between neighbours:
nothing is gained from noise of slow change. With P unknowns and estimated noise, the variances grow
by (n - P) / (n_eff - P), and Student's t has n_eff - P degrees of freedom; with given noise they
grow by n / n_eff.

r is that of the residuals, which the fit has made smaller than that of the noise, by about
(1 + 4 r) / n and more with many unknowns. What the model misses is correlated, too: then the
intervals say what noise of that size and slowness would do, no more.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from jaxtrachea.fitting.joint_information import held_count, unknown_count
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.result import FitResult, interval95, within_bounds
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.residuals import lag_correlation

#: Correlation of neighbouring residuals from which the report doubts plain standard errors.
CORRELATED = 0.3


class Effective(NamedTuple):
    """Of every lane; NaN where residuals are too few for a correlation.

    Attributes:
        result: the fit they belong to.
        correlation: of neighbouring force residuals; (lanes,).
        samples: how many independent ones the samples are worth; (lanes,).
        factor: by which standard errors grow; inf where no more than the unknowns; (lanes,).
        lower: widened 95 % interval, in the parameter's unit, within its bounds and nowhere inside
            the plain one (`judgement`); the bound where open; (lanes, P).
        upper: (lanes, P).
    """

    result: FitResult
    correlation: Float[np.ndarray, " lanes"]
    samples: Float[np.ndarray, " lanes"]
    factor: Float[np.ndarray, " lanes"]
    lower: Float[np.ndarray, "lanes P"]
    upper: Float[np.ndarray, "lanes P"]


def share_independent(correlation: Float[np.ndarray, "*l"]) -> Float[np.ndarray, "*l"]:
    """n_eff / n of AR(1) noise; 1 for negative correlations."""
    r = np.clip(correlation, 0, 1)
    return (1 - r) / (1 + r)


def effective_samples(seen: Prediction) -> Float[np.ndarray, " lanes"]:
    """Independent samples that the forces, and the markers of each ring, are worth; (lanes,)."""
    kinds = [seen.force]
    for more in (seen.side_force, seen.joints, seen.joint_side, seen.ends):
        if more is not None:
            lanes, trials, samples = more.shape[:3]
            rows = np.moveaxis(more.reshape(lanes, trials, samples, -1), -1, 2)
            kinds.append(rows.reshape(lanes, -1, samples))
    total = np.zeros(len(seen.force))
    of_forces = share_independent(lag_correlation(Prediction(seen.force, None)))
    for residual in kinds:
        count = np.sum(np.isfinite(residual), axis=(1, 2))
        share = share_independent(lag_correlation(Prediction(residual, None)))
        # Too few neighbours of one kind, or no residual at all: taken for as alike as the forces.
        share = np.where(np.isnan(share), of_forces, share)
        total += np.where(count > 0, count * share, 0)
    return total


def effective(result: FitResult, seen: Prediction, profiles: Profiles | None = None) -> Effective:
    """Widened intervals of all lanes; in a joint fit the samples of all lanes count together.

    Each side of the plain interval, by profile and other minima where there is such evidence, is
    drawn out from the estimate on the scaled coordinate, by what the half width of the local one
    grows.

    Args:
        result: the fit.
        seen: its residuals.
        profiles: those on which the plain intervals rest.
    """
    study, lanes = result.study, result.study.lanes
    n, worth = np.asarray(result.samples, float), effective_samples(seen)
    present = lanes.active > 0
    held = result.at_bound | ~present
    unknowns = np.sum(~held, axis=1).astype(float)
    if study.joint:
        alive = result.succeeded
        P = unknown_count(study, alive) - held_count(study, held, alive)
        unknowns = np.full(len(n), float(P))
        n, worth = (np.full(len(n), np.nansum(v[alive])) for v in (n, worth))
    plain = result.uncertainty.half_width
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        left = worth - unknowns
        factor = np.where(left > 0, np.sqrt(np.maximum((n - unknowns) / left, 1)), np.inf)
        half = np.where(left > 0, stdtrit(np.maximum(left, 1e-2), 0.975), plain)
        factor = np.where(study.noise_known, np.sqrt(np.maximum(n / worth, 1)), factor)
        half = np.where(study.noise_known, plain, half)
        factor = np.where(np.isnan(worth), np.nan, factor)
        growth = np.maximum(half * factor / plain, 1)
    lower, upper = _drawn_out(result, growth, profiles)
    return Effective(result, lag_correlation(seen), worth, factor, lower, upper)


def _drawn_out(
    result: FitResult, growth: Float[np.ndarray, " lanes"], profiles: Profiles | None
) -> tuple[Float[np.ndarray, "lanes P"], Float[np.ndarray, "lanes P"]]:
    """Plain intervals with their sides `growth` times as long on the scaled coordinate."""
    study = result.study
    plain = np.full((2, *result.theta.shape), np.nan)
    for lane, unknowns in enumerate(study.unknowns):
        for i in range(len(unknowns)):
            *plain[:, lane, i], _ = interval95(result, lane, i, profiles)
    log = study.of_unknowns(lambda p: p.scale == "log", False)
    step = study.of_unknowns(lambda p: p.step, 1.0)
    sign, growth = np.array([-1.0, 1.0])[:, None, None], growth[:, None]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        side = np.abs(np.where(log, np.log(plain), plain / step) - result.theta)
        # A side of no length, of an estimate on its bound, has no limit either where none has.
        theta = result.theta + sign * np.where(np.isinf(growth), growth, side * growth)
        wide = np.where(log, np.exp(theta), theta * step)
    wide = np.stack([np.minimum(wide[0], plain[0]), np.maximum(wide[1], plain[1])])
    for lane, unknowns in enumerate(study.unknowns):
        for i in range(len(unknowns)):
            wide[:, lane, i] = within_bounds(result, lane, i, *map(float, wide[:, lane, i]))
    return wide[0], wide[1]
