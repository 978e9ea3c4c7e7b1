"""Where the chains of `posterior` begin, and the coordinates in which they move.

The posterior is brought near to a standard normal: x = centre + root y, with x the unknowns on the
real line and y what the sampler moves. `root` is that of the fit's covariance at the first, that of
the draws themselves where these were poor.
"""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings

#: Nearest that the centre comes to a bound, as a share of the width: what float64 can tell.
_EDGE = 1e-12
#: Correlations are drawn in by this, so that the covariance of what is undetermined has a root.
_SHRINK = 1e-6


class Start(NamedTuple):
    """Of one lane: x = centre + root y; Q unknowns and logarithms of noise on the real line.

    In y the posterior is about standard normal, as the adaptation of mass matrices presumes.
    """

    centre: Float[np.ndarray, " Q"]
    root: Float[np.ndarray, "Q Q"]
    y: Float[np.ndarray, "C Q"]


def to_line(theta, lower, upper):
    """From inside the bounds to the real line."""
    share = (theta - lower) / (upper - lower)
    return np.log(share) - np.log1p(-share)


def mode(result: FitResult) -> FitResult:
    """The fit whose cost is that of the posterior: every sample at its own weight.

    The chains begin there; with curve weights the estimate can lie many standard errors away. A
    lane that does not converge so keeps the estimate that it has.
    """
    study = result.study
    if np.all(study.lanes.balance == 1) or study.joint:
        return result
    flat = study.lanes._replace(balance=np.ones_like(study.lanes.balance))
    settings = Settings(starts=1, more_starts=0)
    again = fit(dataclasses.replace(study, lanes=flat), settings, starts=result.theta)
    worse = ~again.succeeded

    def keep(new, old):
        return np.where(worse.reshape(-1, *[1] * (new.ndim - 1)), old, new)

    return dataclasses.replace(
        result,
        theta=keep(again.theta, result.theta),
        sigma=keep(again.sigma, result.sigma),
        uncertainty=jax.tree.map(keep, again.uncertainty, result.uncertainty),
    )


def around_the_fit(
    result: FitResult, lane: int, noise_sampled: tuple[bool, bool], chains: int, seed: int
) -> Start:
    """The estimate and its covariance on the real line; chains scattered by one of it.

    An estimate nearer to a bound than its standard error, or on it, is centred one standard error
    away, where half of the posterior's mass is about.
    """
    lanes, u = result.study.lanes, result.uncertainty
    P, active = result.study.size, lanes.active[lane] > 0
    width = np.where(active, lanes.upper[lane] - lanes.lower[lane], 1)
    low = np.where(active, lanes.lower[lane], -0.5)
    se = np.where(np.isfinite(u.se[lane]), u.se[lane], _conditional(result, lane, width))
    edge = np.clip(se / width, _EDGE, 0.25)
    share = np.clip((result.theta[lane] - low) / width, edge, 1 - edge)
    slope = width * share * (1 - share)
    deviation = np.where(active, np.clip(se / slope, 1e-8, 2), 1)
    finite, correlation = np.isfinite(u.se[lane]), u.correlation[lane]
    known = np.isfinite(correlation) & finite[:, None] & finite
    correlation = np.where(known, (1 - _SHRINK) * np.clip(correlation, -1, 1), 0)
    np.fill_diagonal(correlation, 1)
    Q = P + sum(noise_sampled)
    covariance = np.eye(Q) / max(2 * result.samples[lane], 1)
    covariance[:P, :P] = correlation * np.outer(deviation, deviation)
    centre = np.append(np.where(active, to_line(share, 0, 1), 0), np.zeros(Q - P))
    scattered = np.random.default_rng([seed, lane]).normal(size=(chains, Q))
    return Start(centre, _root(covariance), scattered)


def _conditional(result: FitResult, lane: int, width: np.ndarray) -> np.ndarray:
    """Stands for a standard error that is not there: of an unknown on its bound, or undetermined.

    On a bound that of the others is no guide to it: a hundredth of a relative change of 1, or of
    the width of the bounds, whichever is less; undetermined: 0.3 of the width.
    """
    theta = result.theta[lane]
    on_bound = np.minimum(0.01 * np.maximum(np.abs(theta), 1), 0.01 * width)
    return np.where(result.at_bound[lane], on_bound, 0.3 * width)


def around_the_draws(x: Float[np.ndarray, "C D Q"]) -> Start:
    """Centre and covariance of draws, and their ends as the places to go on from."""
    flat = x.reshape(-1, x.shape[-1])
    centre, covariance = flat.mean(axis=0), np.cov(flat.T).reshape(x.shape[-1], x.shape[-1])
    # Draws that moved little along some direction say little of it: none is taken for exact.
    root = _root(covariance + 1e-10 * np.eye(len(centre)))
    y = np.linalg.solve(root, (x[:, -1] - centre).T).T
    return Start(centre, root, np.clip(y, -4, 4))


def _root(covariance: np.ndarray) -> np.ndarray:
    """A square root of a covariance, columns along its axes; none of length zero."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 1e-14 * np.max(values)))
