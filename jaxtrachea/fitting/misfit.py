"""Residuals against the noise that was given: how many times as large they are.

Standard errors with a given sigma rest on it. If it is right, the sum of squared residuals in units
of it is chi^2 with n - P degrees of freedom; much more says that the sigma is too small or that the
model misses the curves, much less that it is too large.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.information import fixed_count, unknown_count
from jaxtrachea.fitting.lane import Observed, forces, markers
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.study import Study

#: Ratio, or its inverse, from which it is told; and the probability of such a chi^2 by chance.
BEYOND, CHANCE = 1.5, 1e-3
#: Share of n independent samples that the median of absolute residuals is worth (normal noise).
MEDIAN = 0.37


class Residuals(NamedTuple):
    """Residuals of a fit, and what they are counted by.

    Attributes:
        study: the data and the model.
        seen: model minus data.
        samples: observed entries; (lanes,).
        at_bound: unknowns on a bound; (lanes, P).
        succeeded: lanes with an estimate; (lanes,).
    """

    study: Study
    seen: Prediction
    samples: Int[np.ndarray, " lanes"]
    at_bound: Bool[np.ndarray, "lanes P"]
    succeeded: Bool[np.ndarray, " lanes"]


class Misfit(NamedTuple):
    """Of every lane; forces, markers.

    Attributes:
        ratio: of the residuals to the sigma given: root of chi^2 / (n - P), with a robust loss
            1.4826 times the median of their sizes; NaN where no sigma is given or nothing is left
            over; (lanes, 2).
        flagged: whether it is beyond `BEYOND`, and not by chance; of markers only where residuals
            are larger: what a model may miss in them is given on purpose; (lanes, 2).
    """

    ratio: Float[np.ndarray, "lanes 2"]
    flagged: Bool[np.ndarray, "lanes 2"]

    @property
    def growth(self) -> Float[np.ndarray, " lanes"]:
        """Growth of standard errors for residuals beyond the noise given; 1 or more; (lanes,)."""
        return np.max(np.where(self.flagged & (self.ratio > 1), self.ratio, 1.0), axis=1)


def misfit(of: Residuals) -> Misfit:
    """Residuals against the noise given; in a joint fit of all lanes together."""
    study, lanes = of.study, of.study.lanes
    shape = (len(of.samples), 2)
    ratio, flagged = np.full(shape, np.nan), np.zeros(shape, bool)
    for k, (kinds, given) in enumerate(
        zip((forces(lanes), markers(lanes)), study.noise_given, strict=True)
    ):
        if given and kinds:
            ratio[:, k], flagged[:, k] = _against_noise(of, kinds)
    flagged[:, 1] &= ratio[:, 1] > 1
    return Misfit(ratio, flagged)


def _against_noise(of: Residuals, kinds: list[Observed]):
    """Ratio of some kinds of residuals to their sigma, and whether it is told; (lanes,) each."""
    from scipy.special import chdtr, chdtrc

    study, lanes = of.study, of.study.lanes
    sizes = []
    for kind in kinds:
        residual = of.seen[kind.name]
        known = np.isfinite(residual) & (kind.precision > 0)
        z = np.where(known, residual * kind.precision, np.nan)
        sizes.append(np.abs(z).reshape(len(of.samples), -1))
    size = np.concatenate(sizes, axis=1)
    count = np.sum(np.isfinite(size), axis=1).astype(float)
    unknowns = np.sum((lanes.active > 0) & ~of.at_bound, axis=1).astype(float)
    total, square = np.asarray(of.samples, float), np.nansum(size**2, axis=1)
    if study.joint:
        alive, held = of.succeeded, of.at_bound | (lanes.active <= 0)
        unknowns = np.array([unknown_count(study, alive) - fixed_count(study, held, alive)])
        count, total, square = (np.sum(v[alive], keepdims=True) for v in (count, total, square))
        size = size[alive].reshape(1, -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        left = count * (1 - unknowns / total)
        left = np.where(left > 0.5, left, np.nan)
        if study.model.loss == "linear":
            ratio = np.sqrt(square / left)
        else:
            middle = [np.nanmedian(v) if np.isfinite(v).any() else np.nan for v in size]
            ratio, left = np.where(left > 0, 1.4826 * np.array(middle), np.nan), MEDIAN * left
        statistic = ratio**2 * left
        chance = np.minimum(chdtrc(left, statistic), chdtr(left, statistic))
        flagged = ((ratio > BEYOND) | (ratio < 1 / BEYOND)) & (chance < CHANCE)
    return (np.broadcast_to(v, (len(of.samples),)) for v in (ratio, flagged))
