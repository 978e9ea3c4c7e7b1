"""Whether chains deserve trust, and what they say of each unknown."""

import contextlib
import importlib

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.result import FitResult

#: What good chains reach, and what makes draws useless: R-hat, effective draws, share divergent.
GOOD, POOR = (1.01, 400, 0.0), (1.05, 100, 0.02)


def grade(rhat: float, ess: float, share: float) -> str:
    """`good`, `doubtful` or `poor`, by the largest R-hat, fewest draws, share divergent."""
    found = np.array([rhat, -ess, share])

    def within(bar):
        return np.all(found <= (bar[0], -bar[1], bar[2]))

    if within(GOOD):
        return "good"
    return "doubtful" if within(POOR) else "poor"


@contextlib.contextmanager
def lenient():
    """Blackjax mixes dtypes and ranks; a caller's strictness is for the caller's code."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def mixing(
    theta: Float[np.ndarray, "C D P"],
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """R-hat and effective sample size of every unknown; NaN for those not drawn."""
    diagnostics = importlib.import_module("blackjax.diagnostics")
    rhat, ess = (np.full(theta.shape[-1], np.nan) for _ in range(2))
    known = np.isfinite(theta).all(axis=(0, 1))
    with lenient():
        draws = jnp.asarray(theta[..., known])
        rhat[known] = diagnostics.rhat(draws)
        tail = np.asarray(diagnostics.ess_tail(draws))
        ess[known] = np.minimum(diagnostics.ess_bulk(draws), tail)
    return rhat, ess


def quantiles(
    result: FitResult, lane: int, theta: Float[np.ndarray, "C D P"]
) -> Float[np.ndarray, "3 P"]:
    """Median and 95 % interval of every unknown in its unit; (3, P)."""
    out = np.full((3, theta.shape[-1]), np.nan)
    for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
        if np.isfinite(theta[..., i]).all():
            out[:, i] = p.from_scaled(np.quantile(theta[..., i], [0.5, 0.025, 0.975]))
    return out
