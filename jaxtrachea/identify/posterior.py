"""Draws from the posterior by the No-U-Turn sampler of blackjax (extra `bayes`).

log posterior = -cost of the fit, every sample at its own weight (weights of curves are no noise),
with priors uniform in scaled coordinates (scale `log`: 1 / p) between the bounds. An estimated
sigma is sampled with the others, prior 1 / sigma: -n log sigma joins the cost, which holds for a
robust loss as well, read as the density exp(-rho / 2). Bounds are mapped to the real line by a
logistic function (Carpenter et al. 2017, doi:10.18637/jss.v076.i01); the chains start around the
estimate, in coordinates whitened by its covariance, and adapt mass matrix and step in Stan's
windows. R-hat and effective sample sizes are rank-normalised (Vehtari et al. 2021,
doi:10.1214/20-BA1221).
"""

import contextlib
import dataclasses
import functools
import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea.identify.cost import weights
from jaxtrachea.identify.fit import FitResult
from jaxtrachea.identify.problem import Lane, Problem
from jaxtrachea.identify.residual import observations, residual_value
from jaxtrachea.identify.results import succeeded
from jaxtrachea.identify.solve import chunk_size

#: Steps of each chain before its draws count.
_WARM_UP = 500
_ACCEPTANCE = 0.9
#: What good chains reach, and what makes draws useless: R-hat, effective draws, share divergent.
GOOD, POOR = (1.01, 400, 0.0), (1.05, 100, 0.02)


class MissingSampler(ImportError):
    """Blackjax is not installed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior:
    """Draws of every lane; C chains of D draws; NaN for lanes without an estimate.

    Attributes:
        result: the fit they started from.
        theta: scaled coordinates; (lanes, C, D, P).
        sigma: of force (N) and markers (mm), drawn or given; (lanes, C, D, 2).
        divergent: transitions that failed; (lanes, C, D).
        rhat: rank-normalised, split; (lanes, P).
        ess: effective draws, the smaller of bulk and tail; (lanes, P).
        median: in the parameter's unit; (lanes, P).
        lower: 2.5 % quantile; (lanes, P).
        upper: 97.5 % quantile; (lanes, P).
    """

    result: FitResult
    theta: Float[np.ndarray, "lanes C D P"]
    sigma: Float[np.ndarray, "lanes C D 2"]
    divergent: Bool[np.ndarray, "lanes C D"]
    rhat: Float[np.ndarray, "lanes P"]
    ess: Float[np.ndarray, "lanes P"]
    median: Float[np.ndarray, "lanes P"]
    lower: Float[np.ndarray, "lanes P"]
    upper: Float[np.ndarray, "lanes P"]

    def verdict(self, lane: int) -> str:
        """`good`, `doubtful` or `poor`, with the reason; `no draws` without an estimate."""
        if not np.isfinite(self.theta[lane]).any():
            return "no draws"
        rhat, ess = np.nanmax(self.rhat[lane]), np.nanmin(self.ess[lane])
        share = float(self.divergent[lane].mean())
        says = f"R-hat {rhat:.3f}, {ess:.0f} effective draws, {100 * share:.2g} % divergent"
        found = np.array([rhat, -ess, share])
        beyond = lambda bar: not np.all(found <= (bar[0], -bar[1], bar[2]))  # noqa: E731
        if not beyond(GOOD):
            return f"good: {says}"
        return f"poor: {says}" if beyond(POOR) else f"doubtful: {says}"


class _Start(NamedTuple):
    """Of one lane: x = centre + root y; Q unknowns and logarithms of noise on the real line.

    In y the posterior is about standard normal, as the adaptation of mass matrices presumes.
    """

    centre: Float[np.ndarray, " Q"]
    root: Float[np.ndarray, "Q Q"]
    y: Float[np.ndarray, "C Q"]


def sampler() -> Any:
    """The module blackjax.

    Raises:
        MissingSampler: it is not installed.
    """
    try:
        return importlib.import_module("blackjax")
    except ImportError:
        raise MissingSampler(
            "drawing from the posterior needs blackjax; pip install 'jaxtrachea[bayes]'"
        ) from None


def to_line(theta, lower, upper):
    """From inside the bounds to the real line."""
    share = (theta - lower) / (upper - lower)
    return np.log(share) - np.log1p(-share)


def from_line(x: Float[Array, " P"], lane: Lane) -> Float[Array, " P"]:
    """From the real line to inside the bounds."""
    return lane.lower + (lane.upper - lane.lower) * jax.nn.sigmoid(x)


def log_density(
    problem: Problem, drawn: tuple[bool, bool], lane: Lane, sigma: Float[Array, "2"], x: Array
) -> Float[Array, ""]:
    """Log posterior on the real line, up to a constant.

    Args:
        problem: static description.
        drawn: whether sigma of forces and of markers is unknown.
        lane: the lane's arrays.
        sigma: as for `evaluate`; where it is unknown, what the drawn one is relative to.
        x: (Q,) unknowns, then logarithms of the relative noise drawn.
    """
    P = lane.lower.shape[0]
    u, log_noise = x[:P], _spread(drawn, x[P:])
    lane = lane._replace(balance=jnp.ones_like(lane.balance))
    value = residual_value(problem, from_line(u, lane), lane)
    rho, _ = weights(problem, value, lane, sigma * jnp.exp(log_noise))
    seen, forces = observations(lane)
    counts = jnp.stack([jnp.sum(seen[:, :forces]), jnp.sum(seen[:, forces:])])
    volume = jax.nn.log_sigmoid(u) + jax.nn.log_sigmoid(-u)
    prior = jnp.sum(jnp.where(lane.active > 0, volume, -0.5 * u * u))
    density = prior - 0.5 * jnp.sum(rho) - jnp.sum(counts * log_noise)
    return jnp.where(jnp.isfinite(density), density, -jnp.inf)


def _spread(drawn: tuple[bool, bool], values: Array) -> Float[Array, "2"]:
    """Drawn numbers at their places among (force, markers), 0 elsewhere."""
    out = jnp.zeros(2, values.dtype)
    return out.at[jnp.flatnonzero(jnp.array(drawn), size=sum(drawn))].set(values)


def _chain(problem: Problem, drawn, draws: int, lane: Lane, sigma, centre, root, y, key):
    """Warm-up and draws of one chain: (D, Q) and whether each diverged."""
    blackjax = sampler()
    to_x = lambda y: centre + jnp.sum(root * y[None], axis=1)  # noqa: E731
    density = lambda y: log_density(problem, drawn, lane, sigma, to_x(y))  # noqa: E731
    warm, steps = jax.random.split(key)
    adaptation = blackjax.window_adaptation(
        blackjax.nuts, density, is_mass_matrix_diagonal=False,
        target_acceptance_rate=_ACCEPTANCE, adaptation_info_fn=lambda *_: None,
    )  # fmt: skip
    (state, tuned), _ = adaptation.run(warm, y, num_steps=_WARM_UP)
    kernel = blackjax.nuts(density, **tuned)

    def step(state, key):
        state, info = kernel.step(key, state)
        return state, (to_x(state.position), info.is_divergent)

    return jax.lax.scan(step, state, jax.random.split(steps, draws))[1]


@contextlib.contextmanager
def _lenient():
    """Blackjax mixes dtypes and ranks; a caller's strictness is for the caller's code."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@functools.lru_cache(maxsize=8)
def _compiled(problem: Problem, drawn: tuple[bool, bool], draws: int):
    chain = functools.partial(_chain, problem, drawn, draws)
    chains = jax.vmap(chain, (None, None, None, None, 0, 0))
    return jax.jit(jax.vmap(chains))


def posterior(
    result: FitResult,
    *,
    draws: int = 1000,
    chains: int = 4,
    seed: int = 0,
    chunk: int = 16,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Draw from the posterior of every lane that has an estimate.

    What a lane draws depends on the seed and its place alone.

    Args:
        result: the fit.
        draws: of each chain, after 500 steps of warm-up.
        chains: of each lane, 2 or more.
        seed: of the drawing.
        chunk: lanes computed together.
        progress: called with (lanes done since the last call, lanes in all).

    Raises:
        ValueError: too few draws or chains.
        MissingSampler: blackjax is not installed.
    """
    if draws < 100 or chains < 2:
        raise ValueError(f"{draws} draws of {chains} chains; expected 100 of 2, or more")
    sampler()
    problem, P = result.problem, result.problem.size
    markers = problem.lanes.joints is not None
    drawn = (not problem.noise_given[0], markers and not problem.noise_given[1])
    good = np.array([k for k in range(result.lanes) if succeeded(result, k)], int)
    shape = (result.lanes, chains, draws)
    theta, sigma = np.full((*shape, P), np.nan), np.full((*shape, 2), np.nan)
    divergent = np.zeros(shape, bool)
    chunk = chunk_size(max(len(good), 1), chunk)
    run = _compiled(problem.program, drawn, draws)
    for first in range(0, len(good), chunk):
        left = len(good) - first
        of = good[np.minimum(np.arange(first, first + chunk), len(good) - 1)]
        lane = jax.tree.map(lambda v, of=of: v[of], problem.lanes)
        starts = [_start(result, int(k), drawn, chains, seed) for k in of]
        keys = [jax.random.split(jax.random.fold_in(jax.random.key(seed), k), chains) for k in of]
        with _lenient():
            x, lost = run(
                lane, result.whitened_sigma[of], *map(np.stack, zip(*starts, strict=True)),
                jnp.stack(keys),
            )  # fmt: skip
        of, x, lost = of[:left], np.asarray(x)[:left], np.asarray(lost)[:left]
        low, high = (v[of][:, None, None] for v in (problem.lanes.lower, problem.lanes.upper))
        theta[of] = low + (high - low) / (1 + np.exp(-x[..., :P]))
        noise = np.zeros((*x.shape[:-1], 2))
        noise[..., np.flatnonzero(drawn)] = x[..., P:]
        sigma[of] = result.sigma[of][:, None, None] * np.exp(noise)
        divergent[of] = lost
        if progress is not None:
            progress(len(of), len(good))
    theta = np.where((problem.lanes.active > 0)[:, None, None], theta, np.nan)
    return Posterior(result, theta, sigma, divergent, *_mixing(theta), *_quantiles(result, theta))


def _start(result: FitResult, lane: int, drawn, chains: int, seed: int) -> _Start:
    """Around the estimate, its covariance on the real line, inside the bounds."""
    lanes, u = result.problem.lanes, result.uncertainty[lane]
    P, active = result.problem.size, lanes.active[lane] > 0
    width = np.where(active, lanes.upper[lane] - lanes.lower[lane], 1)
    low = np.where(active, lanes.lower[lane], -0.5)
    share = np.clip((result.theta[lane] - low) / width, 1e-3, 1 - 1e-3)
    se = np.where(np.isfinite(u.se), u.se, 0.3 * width)
    slope = width * share * (1 - share)
    deviation = np.where(active, np.clip(se / slope, 1e-8, 2), 1)
    known = np.isfinite(u.correlation) & np.isfinite(u.se)[:, None] & np.isfinite(u.se)
    correlation = np.where(known, 0.99 * np.clip(u.correlation, -1, 1), 0)
    np.fill_diagonal(correlation, 1)
    Q = P + sum(drawn)
    covariance = np.eye(Q) / max(2 * result.samples[lane], 1)
    covariance[:P, :P] = correlation * np.outer(deviation, deviation)
    centre = np.append(np.where(active, to_line(share, 0, 1), 0), np.zeros(Q - P))
    rng = np.random.default_rng([seed, lane])
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    return _Start(centre, root, rng.normal(size=(chains, Q)))


def _mixing(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R-hat and effective sample size of every unknown; (lanes, P) each."""
    diagnostics = importlib.import_module("blackjax.diagnostics")
    rhat, ess = (np.full((theta.shape[0], theta.shape[-1]), np.nan) for _ in range(2))
    with _lenient():
        for lane in np.flatnonzero(np.isfinite(theta).any(axis=(1, 2, 3))):
            known = np.isfinite(theta[lane]).all(axis=(0, 1))
            draws = jnp.asarray(theta[lane][..., known])
            rhat[lane, known] = diagnostics.rhat(draws)
            tail = np.asarray(diagnostics.ess_tail(draws))
            ess[lane, known] = np.minimum(diagnostics.ess_bulk(draws), tail)
    return rhat, ess


def _quantiles(result: FitResult, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median and 95 % interval in the unit of each parameter."""
    middle, lower, upper = (np.full(result.theta.shape, np.nan) for _ in range(3))
    for lane, unknowns in enumerate(result.problem.unknowns):
        for i, (p, _, _) in enumerate(unknowns):
            if np.isfinite(theta[lane, ..., i]).all():
                ends = np.quantile(theta[lane, ..., i], [0.5, 0.025, 0.975])
                values = (p.from_scaled(float(v)) for v in ends)
                middle[lane, i], lower[lane, i], upper[lane, i] = values
    return middle, lower, upper
