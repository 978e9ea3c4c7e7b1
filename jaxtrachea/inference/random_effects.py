r"""Mean and spread of a population behind estimates of unequal precision, in numbers alone.

Estimates \hat\theta_i ~ N(\theta_i, C_i) of \theta_i ~ N(\mu, diag(\tau^2)). \tau^2 maximises the
restricted likelihood (REML; Patterson and Thompson 1971, doi:10.1093/biomet/58.3.545), by Fisher
scoring with bounds at zero; \mu is then the generalised least-squares mean.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

#: Specimens below which no spread is estimated.
FEWEST = 3
#: Stands for "not known" beside the variances of estimates, in units of the largest.
_UNKNOWN = 1e8


class Effects(NamedTuple):
    """Random effects of m specimens in q coordinates.

    Attributes:
        mean: of the population; (q,).
        mean_se: its standard error, tau taken as known; (q,).
        dof: degrees of freedom of `mean_se`, at most m - 1; (q,).
        sd: between specimens, tau; (q,).
        sd_se: its standard error (delta method on tau^2); NaN at tau = 0; (q,).
        sd_low: 95 % interval of tau; (q,).
        sd_high: (q,).
        shrunk: mean of each specimen given its estimate and the population; (m, q).
        shrunk_sd: standard deviation, that of the mean included, tau taken as known; (m, q).
    """

    mean: Float[np.ndarray, " q"]
    mean_se: Float[np.ndarray, " q"]
    dof: Float[np.ndarray, " q"]
    sd: Float[np.ndarray, " q"]
    sd_se: Float[np.ndarray, " q"]
    sd_low: Float[np.ndarray, " q"]
    sd_high: Float[np.ndarray, " q"]
    shrunk: Float[np.ndarray, "m q"]
    shrunk_sd: Float[np.ndarray, "m q"]


class Common(NamedTuple):
    """What the errors of all specimens have in common: those of k shared unknowns.

    Attributes:
        follow: how the estimates of each specimen follow the shared unknowns; (m, q, k).
        covariance: of the shared unknowns; (k, k).
    """

    follow: Float[np.ndarray, "m q k"]
    covariance: Float[np.ndarray, "k k"]


class _Restricted(NamedTuple):
    """Restricted likelihood at tau^2: its value, slope and expected information, and the mean."""

    value: float
    slope: Float[np.ndarray, " q"]
    information: Float[np.ndarray, "q q"]
    weight: Float[np.ndarray, "m q q"]
    mean: Float[np.ndarray, " q"]
    mean_covariance: Float[np.ndarray, "q q"]


def _restricted(tau2, estimate, covariance) -> _Restricted:
    """Everything at one tau^2; with W_i = (diag(tau^2) + C_i)^-1 and Q = (sum W_i)^-1."""
    W = np.linalg.inv(covariance + np.diag(tau2))
    Q = np.linalg.inv(W.sum(axis=0))
    mean = Q @ np.einsum("mij,mj->i", W, estimate)
    r = estimate - mean
    Wr = np.einsum("mij,mj->mi", W, r)
    value = 0.5 * np.sum(np.linalg.slogdet(W)[1]) - 0.5 * np.sum(r * Wr)
    value += 0.5 * np.linalg.slogdet(Q)[1]
    inner = W - W @ Q @ W
    slope = 0.5 * np.sum(Wr**2, axis=0) - 0.5 * np.einsum("mjj->j", inner)
    # tr(P A_j P A_k) / 2, P = W - W 1 Q 1' W the projected weight and A_j of coordinate j.
    information = np.sum(W * W - 2 * W * (W @ Q @ W), axis=0)
    F = np.einsum("maj,mjb->jab", W, W)
    information = 0.5 * (information + np.einsum("ab,jbc,cd,kda->jk", Q, F, Q, F))
    return _Restricted(float(value), slope, information, W, mean, Q)


def random_effects(
    estimate: Float[np.ndarray, "m q"],
    covariance: Float[np.ndarray, "m q q"],
    known: Bool[np.ndarray, "m q"] | None = None,
    common: Common | None = None,
) -> Effects:
    """Mean and spread behind estimates of unequal precision.

    The interval of tau is exact where all specimens are known equally well (chi^2 of m - 1 degrees
    of freedom for tau^2 + C, less C); else C stands for what gives tau^2 its information, and the
    degrees of freedom are those of the mean's variance, as estimated: 2 V^2 / var(V) by the delta
    method (Satterthwaite 1946, doi:10.2307/3002019). Specimens of which little is known add none.

    Args:
        estimate: of each specimen.
        covariance: of its errors, without what they have in common.
        known: which estimates exist; None: all.
        common: None: the errors are independent.

    Raises:
        ValueError: fewer than three specimens have an estimate of some coordinate.
    """
    known = np.ones(estimate.shape, bool) if known is None else known
    count = known.sum(axis=0)
    if np.any(count < FEWEST):
        raise ValueError(f"a population needs {FEWEST} specimens, found {count.min()}")
    both = known[:, :, None] & known[:, None]
    covariance = np.where(both, covariance, 0)
    typical = np.array([np.median(estimate[k, j]) for j, k in enumerate(known.T)])
    spread = np.array([np.var(estimate[k, j], ddof=1) for j, k in enumerate(known.T)])
    largest = np.maximum(np.diagonal(covariance, axis1=1, axis2=2).max(axis=0), spread)
    largest = np.where(largest > 0, largest, 1)
    absent = np.where(known, 0, _UNKNOWN * largest)
    covariance = covariance + absent[:, :, None] * np.eye(len(count))
    estimate = np.where(known, estimate, typical)
    # Where all is equal and exact, a variance of rounding keeps matrices regular.
    tau2, here = _maximum(spread, estimate, covariance, 1e-24 * largest)
    variance = 1 / np.diagonal(here.information)
    free = tau2 > 0
    if free.sum() > 1:
        inverse = np.linalg.inv(here.information[np.ix_(free, free)])
        variance[free] = np.diagonal(inverse)
    sd = np.sqrt(tau2)
    with np.errstate(divide="ignore", invalid="ignore"):
        sd_se = np.where(free, 0.5 * np.sqrt(variance) / sd, np.nan)
    dof = _freedom(here, count)
    low, high = _interval(tau2, variance, dof)
    follow = np.zeros((*estimate.shape, 0)) if common is None else known[:, :, None] * common.follow
    shared = np.zeros((0, 0)) if common is None else common.covariance
    shrunk, shrunk_sd, mean_se = _posterior(tau2, here, estimate, follow, shared)
    return Effects(here.mean, mean_se, dof, sd, sd_se, low, high, shrunk, shrunk_sd)


def _freedom(here: _Restricted, count) -> np.ndarray:
    """Degrees of freedom of the mean's variance; see `random_effects`."""
    Q = here.mean_covariance
    slope = np.sum((Q @ here.weight) ** 2, axis=0)  # of Q_jj by tau_k^2
    error = np.einsum("jk,kl,jl->j", slope, np.linalg.inv(here.information), slope)
    return np.clip(2 * np.diagonal(Q) ** 2 / error, 1, count - 1)


def _maximum(tau2, estimate, covariance, floor) -> tuple[np.ndarray, _Restricted]:
    """Fisher scoring: a spread that the likelihood pushes below zero stays at zero."""
    exact = np.diagonal(covariance, axis1=1, axis2=2).min(axis=0) <= 0
    least = np.where(exact, floor, 0)
    tau2 = np.maximum(tau2, least)
    here = _restricted(tau2, estimate, covariance)
    for _ in range(200):
        free = (tau2 > least) | (here.slope > 0)
        step = np.zeros_like(tau2)
        block = here.information[np.ix_(free, free)]
        step[free] = np.linalg.solve(block, here.slope[free])
        part = 1.0
        while True:
            trial = np.maximum(tau2 + part * step, least)
            there = _restricted(trial, estimate, covariance)
            if there.value >= here.value or part < 1e-10:
                break
            part *= 0.5
        moved = np.max(np.abs(trial - tau2) / np.sqrt(1 / np.diagonal(here.information)))
        if there.value >= here.value:
            tau2, here = trial, there
        if moved < 1e-10 or part < 1e-10:
            break
    return np.where(tau2 > least, tau2, 0), here


def _interval(tau2, variance, dof) -> tuple[np.ndarray, np.ndarray]:
    """95 % interval of tau; see `random_effects`."""
    from scipy.special import chdtri

    total = np.maximum(np.sqrt(0.5 * variance * dof), tau2)
    error = total - tau2
    ends = [total * dof / chdtri(dof, p) - error for p in (0.025, 0.975)]
    low, high = (np.sqrt(np.maximum(v, 0)) for v in ends)
    return low, high


def _posterior(tau2, here: _Restricted, estimate, follow, shared):
    """Mean and standard deviation of every specimen given all estimates, and that of the mean."""
    prior = np.diag(tau2)
    pull = prior @ here.weight
    shrunk = here.mean + np.einsum("mij,mj->mi", pull, estimate - here.mean)
    rest = np.eye(len(tau2)) - pull
    moves = here.mean_covariance @ np.sum(here.weight @ follow, axis=0)
    of_mean = here.mean_covariance + moves @ shared @ moves.T
    moves = pull @ follow + rest @ moves
    covariance = prior - pull @ prior + moves @ shared @ np.swapaxes(moves, 1, 2)
    covariance = covariance + rest @ here.mean_covariance @ np.swapaxes(rest, 1, 2)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return shrunk, np.sqrt(np.maximum(variance, 0)), np.sqrt(np.diagonal(of_mean))
