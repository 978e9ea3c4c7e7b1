"""Independent samples that correlated residuals are worth, and by what intervals grow for it.

With a correlation r of neighbours, falling by r from sample to sample (AR(1)), n samples tell a
mean as well as n (1 - r) / (1 + r) independent ones (Bayley and Hammersley 1946,
doi:10.2307/2983560; Thiebaux and Zwiers 1984, doi:10.1175/1520-0450(1984)023<0800:TIAEOE>2.0.CO;2).
The same holds for the unknowns of smooth curves, whose derivatives change little between
neighbours: noise that changes slowly is averaged by no number of samples. With P unknowns and
estimated noise, variances grow by (n - P) / (n_eff - P), and Student's t has n_eff - P degrees of
freedom. With given noise the part of its variance that the residuals have, u = chi^2 / (n - P) or
1, counts as alike and the rest as independent: variances grow by 1 + u (n / n_eff - 1), and by
chi^2 / (n - P) where the residuals are larger than that noise (`misfit`). A correlation that
independent noise often has by chance is taken for none.

r is that of the residuals. The fit has made it smaller than that of the noise, by about
(1 + 4 r) / n and more with many unknowns. An error of the model is correlated as well: the interval
then says what noise of that size and slowness would do. Where less than one independent sample is
left over the unknowns, nothing is said at all (`Effective.misses`). Errors of coarse rounding are
alike from curve to curve, where none is alike along one: see `rounding`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea._memory import in_blocks
from jaxtrachea.fitting.information import fixed_count, unknown_count
from jaxtrachea.fitting.misfit import Residuals, misfit
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.rounding import GROWTH, rounding

#: Correlation of neighbouring residuals from which reports speak of it.
CORRELATED = 0.3
#: Pairs of neighbours from which a correlation is taken.
MIN_PAIRS = 10
#: Times 1 / sqrt(pairs): correlation that independent noise exceeds in 5 % of all records.
CHANCE = 1.645
#: Independent samples that must be left over the unknowns for an interval.
MIN_FREEDOM = 1.0


class Effective(NamedTuple):
    """Worth of the samples of every lane; all lanes of a joint fit count together.

    Attributes:
        correlation: of neighbouring force residuals; NaN with fewer than `MIN_PAIRS`; (lanes,).
        samples: independent samples that all observed ones are worth; NaN likewise; (lanes,).
        share: of them in all observed ones; NaN likewise; (lanes,).
        factor: growth of standard errors, 1 or more; inf where `misses`; (lanes,).
        quantile: half of a 95 % interval in standard errors (Student's t); inf likewise; (lanes,).
        growth: of the length of 95 % intervals against those of independent residuals; inf
            likewise; (lanes,).
        rounding: step of forces that are rounded more coarsely than their noise, N, for which
            `factor` has grown; NaN where they are not; (lanes,).
        misses: less than one independent sample is left over the unknowns: the model misses the
            curve; (lanes,).
    """

    correlation: Float[np.ndarray, " lanes"]
    samples: Float[np.ndarray, " lanes"]
    share: Float[np.ndarray, " lanes"]
    factor: Float[np.ndarray, " lanes"]
    quantile: Float[np.ndarray, " lanes"]
    growth: Float[np.ndarray, " lanes"]
    rounding: Float[np.ndarray, " lanes"]
    misses: Bool[np.ndarray, " lanes"]


def lag_correlation(residual: Float[np.ndarray, "lanes trials samples"]) -> np.ndarray:
    """Correlation of neighbouring residuals along the curves of each lane; (lanes,).

    About 0 for independent noise, near 1 where the model misses the shape of the curves; NaN with
    fewer than `MIN_PAIRS` pairs. Not centred: a residual of one sign is correlated, too.
    """
    return in_blocks(_lag_correlation, residual)


def _lag_correlation(residual: Float[np.ndarray, "lanes trials samples"]) -> np.ndarray:
    r = np.nan_to_num(residual)
    pair = np.isfinite(residual[..., 1:]) & np.isfinite(residual[..., :-1])
    both = np.sum(r[..., 1:] * r[..., :-1] * pair, axis=(1, 2))
    ends = 0.5 * np.sum((r[..., 1:] ** 2 + r[..., :-1] ** 2) * pair, axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.sum(pair, axis=(1, 2)) >= MIN_PAIRS, both / ends, np.nan)


def share_independent(
    correlation: Float[np.ndarray, "*l"], pairs: Int[np.ndarray, "*l"]
) -> Float[np.ndarray, "*l"]:
    """n_eff / n of AR(1) noise; 1 where independent noise has so large a correlation by chance."""
    with np.errstate(divide="ignore"):
        by_chance = correlation < CHANCE / np.sqrt(pairs)
    r = np.where(by_chance, 0.0, np.clip(correlation, 0, 1))
    return (1 - r) / (1 + r)


def effective_samples(seen: Prediction) -> Float[np.ndarray, " lanes"]:
    """Independent samples that the forces, and the markers of each ring, are worth; (lanes,)."""
    of_forces = _share(seen["force"])
    total = np.zeros(len(of_forces))
    for name, found in seen.items():
        lanes, trials, samples = found.shape[:3]
        rows = np.moveaxis(found.reshape(lanes, trials, samples, -1), -1, 2)
        residual = rows.reshape(lanes, -1, samples)
        count = np.sum(np.isfinite(residual), axis=(1, 2))
        share = of_forces if name == "force" else _share(residual)
        # Too few neighbours of one kind, or no residual at all: taken for as alike as the forces.
        share = np.where(np.isnan(share), of_forces, share)
        total += np.where(count > 0, count * share, 0)
    return total


def _share(residual: Float[np.ndarray, "lanes trials samples"]) -> Float[np.ndarray, " lanes"]:
    known = np.isfinite(residual)
    pairs = np.sum(known[..., 1:] & known[..., :-1], axis=(1, 2))
    return share_independent(lag_correlation(residual), pairs)


def _together(of: Residuals) -> Prediction:
    """Residuals of all specimens of a joint fit as the trials of one."""
    alive = {name: v[of.succeeded] for name, v in of.seen.items()}
    return {name: v.reshape(1, -1, *v.shape[2:]) for name, v in alive.items()}


def effective(of: Residuals, plain: Float[np.ndarray, " lanes"]) -> Effective:
    """Worth of the samples of all lanes by their residuals.

    Args:
        of: residuals of the fit.
        plain: half of a 95 % interval in standard errors, of independent residuals; (lanes,).
    """
    from scipy.special import stdtrit

    study, lanes = of.study, of.study.lanes
    n = np.asarray(of.samples, float)
    worth = effective_samples(_together(of) if study.joint else of.seen)
    held = of.at_bound | ~(lanes.active > 0)
    unknowns = np.sum(~held, axis=1).astype(float)
    if study.joint:
        alive = of.succeeded
        P = unknown_count(study, alive) - fixed_count(study, held, alive)
        unknowns = np.full(len(n), float(P))
        n, worth = np.full(len(n), np.sum(n[alive])), np.full(len(n), worth[0])
    against = misfit(of)
    excess = against.growth
    seen_part = np.nan_to_num(np.fmin(np.fmax(*against.ratio.T), 1.0), nan=1.0) ** 2
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        left = worth - unknowns
        # A given noise that covers the residuals limits what they can hide.
        misses = (left < MIN_FREEDOM) & (worth < n) & (~study.noise_known | (excess > 1))
        factor = np.sqrt(np.maximum((n - unknowns) / left, 1))
        quantile = stdtrit(np.maximum(left, MIN_FREEDOM), 0.975)
        alike = 1 + seen_part * (np.maximum(n / worth, 1) - 1)
        factor = np.where(study.noise_known, excess * np.sqrt(alike), factor)
        quantile = np.where(study.noise_known, plain, quantile)
    # Residuals too few for a correlation are taken for independent.
    few = np.isnan(worth)
    factor, quantile = np.where(few, excess, factor), np.where(few, plain, quantile)
    steps = rounding(np.asarray(lanes.force), of.seen["force"])
    if study.joint and np.isfinite(steps[alive]).any():  # one interval of what lanes share
        steps = np.full(len(n), np.nanmedian(steps[alive]))
    factor = np.where(np.isnan(steps), factor, GROWTH * factor)
    factor, quantile = (np.where(misses, np.inf, v) for v in (factor, quantile))
    with np.errstate(invalid="ignore", divide="ignore"):
        growth = np.where(misses, np.inf, np.maximum(factor * quantile / plain, 1))
        share = worth / n
    seen = lag_correlation(of.seen["force"])
    return Effective(seen, worth, share, factor, quantile, growth, steps, misses)
