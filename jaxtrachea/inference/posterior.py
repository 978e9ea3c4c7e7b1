"""Draws from the posterior by the No-U-Turn sampler of blackjax (extra `bayes`).

log posterior = -cost of the fit, every sample at its own weight (weights of curves are no noise),
with priors uniform in scaled coordinates (scale `log`: 1 / p) between the bounds. An estimated
sigma is sampled with the others, prior 1 / sigma: -n log sigma joins the cost, which holds for a
robust loss as well, read as the density exp(-rho / 2). Bounds are mapped to the real line by a
logistic function (Carpenter et al. 2017, doi:10.18637/jss.v076.i01); the chains start around the
estimate, in coordinates whitened by its covariance, and adapt mass matrix and step in Stan's
windows. Lanes whose chains are not good go on by themselves, from where they are, whitened by the
covariance of their own draws, adapted anew, with twice and then four times the draws; what they
drew before is dropped. R-hat and effective sample sizes are rank-normalised (Vehtari et al. 2021,
doi:10.1214/20-BA1221).
"""

import dataclasses
import functools
import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.cost import weights
from jaxtrachea.fitting.lane import Lane, observations
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.chains import grade, lenient, mixing, quantiles
from jaxtrachea.inference.labels import succeeded
from jaxtrachea.inference.posterior_start import Start, around_the_draws, around_the_fit, mode
from jaxtrachea.optimisation.batching import batch_size
from jaxtrachea.optimisation.programs import program

#: Steps of each chain before its draws count.
_WARM_UP = 500
#: Acceptance that the step is adapted to, by round: divergences ask for shorter ones.
_ACCEPTANCE = (0.9, 0.97, 0.99)
#: Draws of a lane whose chains are not good yet, in those asked for.
_AGAIN = (2, 4)
#: Doublings of a trajectory: well-whitened posteriors need 2 to 4; a limit to hopeless ones.
_DOUBLINGS = 8


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
        steps: of each chain that count; of more than D, D equally spaced ones are kept; (lanes,).
        lost: share of them that failed; (lanes,).
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
    steps: Int[np.ndarray, " lanes"]
    lost: Float[np.ndarray, " lanes"]
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
        share = float(self.lost[lane])
        says = f"R-hat {rhat:.3f}, {ess:.0f} effective draws, {100 * share:.2g} % divergent"
        return f"{grade(rhat, ess, share)}: {says}"


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


def from_line(x: Float[Array, " P"], lane: Lane) -> Float[Array, " P"]:
    """From the real line to inside the bounds."""
    return lane.lower + (lane.upper - lane.lower) * jax.nn.sigmoid(x)


def log_density(
    model: FitModel,
    noise_sampled: tuple[bool, bool],
    lane: Lane,
    sigma: Float[Array, "2"],
    x: Array,
) -> Float[Array, ""]:
    """Log posterior on the real line, up to a constant.

    Args:
        noise_sampled: whether sigma of forces and of markers is unknown.
        lane: the lane's arrays.
        sigma: as for `evaluate`; where it is unknown, what the drawn one is relative to.
        x: (Q,) unknowns, then logarithms of the relative noise drawn.
    """
    P = lane.lower.shape[0]
    u, log_noise = x[:P], _spread(noise_sampled, x[P:])
    lane = lane._replace(balance=jnp.ones_like(lane.balance))
    value = residual_value(model, from_line(u, lane), lane)
    rho, _ = weights(model, value, lane, sigma * jnp.exp(log_noise))
    seen, forces = observations(lane)
    counts = jnp.stack([jnp.sum(seen[:, :forces]), jnp.sum(seen[:, forces:])])
    volume = jax.nn.log_sigmoid(u) + jax.nn.log_sigmoid(-u)
    prior = jnp.sum(jnp.where(lane.active > 0, volume, -0.5 * u * u))
    density = prior - 0.5 * jnp.sum(rho) - jnp.sum(counts * log_noise)
    return jnp.where(jnp.isfinite(density), density, -jnp.inf)


def _spread(noise_sampled: tuple[bool, bool], values: Array) -> Float[Array, "2"]:
    """Drawn numbers at their places among (force, markers), 0 elsewhere."""
    out = jnp.zeros(2, values.dtype)
    return out.at[jnp.flatnonzero(jnp.array(noise_sampled), size=sum(noise_sampled))].set(values)


class _Target(NamedTuple):
    """A lane with its noise, and the affine map from where the sampler moves to the real line."""

    lane: Lane
    sigma: Any
    centre: Any
    root: Any


def _density(model: FitModel, noise_sampled, target: _Target):
    """Log posterior where the sampler moves, and the way from there to the real line."""

    def to_x(y):
        return target.centre + jnp.sum(target.root * y[None], axis=1)

    return lambda y: log_density(model, noise_sampled, target.lane, target.sigma, to_x(y)), to_x


def _warm_up(model: FitModel, noise_sampled, acceptance, target: _Target, y, key):
    """Place, step and inverse mass matrix of one chain after its warm-up."""
    blackjax = sampler()
    density, _ = _density(model, noise_sampled, target)
    adaptation = blackjax.window_adaptation(
        blackjax.nuts, density, is_mass_matrix_diagonal=False, max_num_doublings=_DOUBLINGS,
        target_acceptance_rate=acceptance, adaptation_info_fn=lambda *_: None,
    )  # fmt: skip
    (state, tuned), _ = adaptation.run(key, y, num_steps=_WARM_UP)
    return state.position, tuned["step_size"], tuned["inverse_mass_matrix"]


def _draw(model: FitModel, noise_sampled, draws: int, target: _Target, warm, key):
    """Draws of one chain on the real line, (D, Q), whether each diverged, and its last place."""
    blackjax = sampler()
    density, to_x = _density(model, noise_sampled, target)
    y, step_size, inverse_mass = warm
    kernel = blackjax.nuts(density, step_size, inverse_mass, max_num_doublings=_DOUBLINGS)

    def step(state, key):
        state, info = kernel.step(key, state)
        return state, (to_x(state.position), info.is_divergent)

    state, (x, lost) = jax.lax.scan(step, kernel.init(y), jax.random.split(key, draws))
    return x, lost, state.position


def _warm_up_chains(model: FitModel, noise_sampled, acceptance, target: _Target, y, keys):
    """`_warm_up` of all chains of one lane."""
    one = functools.partial(_warm_up, model, noise_sampled, acceptance, target)
    return jax.vmap(one)(y, keys)


def _draw_chains(model: FitModel, noise_sampled, draws, target: _Target, warm, keys):
    """`_draw` of all chains of one lane."""
    one = functools.partial(_draw, model, noise_sampled, draws, target)
    return jax.vmap(one)(warm, keys)


def posterior(
    result: FitResult,
    *,
    draws: int = 1000,
    chains: int = 4,
    seed: int = 0,
    batch: int = 16,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Draw from the posterior of every lane that has an estimate.

    What a lane draws depends on the seed and its place alone.

    Args:
        draws: of each chain, after 500 steps of warm-up; more where the chains are not good.
        chains: of each lane, 2 or more.
        batch: lanes computed together.
        progress: called with (lanes done since the last call, lanes in all).

    Raises:
        ValueError: no `FitResult`, too few draws or chains, or a skeleton of deforming
            cross-sections.
        MissingSampler: blackjax is not installed.
    """
    check_word("result", result, FitResult)
    if draws < 100 or chains < 2:
        raise ValueError(f"{draws} draws of {chains} chains; expected 100 of 2, or more")
    result.study.refuse_sections("the posterior")
    sampler()
    study, base = result.study, mode(result)
    markers = "joints" in study.lanes.others
    noise_sampled = (not study.noise_given[0], markers and not study.noise_given[1])
    good = np.array([k for k in range(result.lanes) if succeeded(result, k)], int)
    found = _empty(result, chains, draws)
    batch = batch_size(max(len(good), 1), batch)
    for first in range(0, len(good), batch):
        of = good[first : first + batch]
        start = {int(k): around_the_fit(base, int(k), noise_sampled, chains, seed) for k in of}
        for again, times in enumerate((1, *_AGAIN)):
            if not start:
                break
            x, lost = _run(base, noise_sampled, draws, times, start, batch, (seed, again))
            start = _keep(found, base, noise_sampled, start, x, lost)
        if progress is not None:
            progress(len(of), len(good))
    return found


def _empty(result: FitResult, chains: int, draws: int) -> Posterior:
    """Nothing drawn yet."""
    lanes, P = result.theta.shape
    shape, nan = (lanes, chains, draws), np.full((lanes, P), np.nan)
    return Posterior(
        result=result, theta=np.full((*shape, P), np.nan), sigma=np.full((*shape, 2), np.nan),
        divergent=np.zeros(shape, bool), steps=np.zeros(lanes, int), lost=np.zeros(lanes),
        rhat=nan.copy(), ess=nan.copy(), median=nan.copy(), lower=nan.copy(), upper=nan.copy(),
    )  # fmt: skip


def _run(
    base: FitResult,
    noise_sampled,
    draws: int,
    times: int,
    start: dict[int, Start],
    batch: int,
    salt,
):
    """Warm up and draw `times` times: (lanes, C, times D, Q) on the real line, and what diverged.

    The lanes are filled up to `batch`, so that one program serves all rounds.
    """
    lanes = list(start)
    of = np.array(lanes + [lanes[-1]] * (batch - len(lanes)))
    lane = jax.tree.map(lambda v: v[of], base.study.lanes)
    chains, (seed, again) = len(start[lanes[0]].y), salt
    places = map(np.stack, zip(*(start[int(k)] for k in of), strict=True))
    centre, root, y = places
    model = base.study.model
    warm_up = program(_warm_up_chains, model, noise_sampled, axes=(None, 0, 0, 0))
    draw = program(_draw_chains, model, noise_sampled, draws)

    def keys(turn: int):
        key = jax.random.fold_in(jax.random.key(seed), again * 1000 + turn)
        return jnp.stack([jax.random.split(jax.random.fold_in(key, k), chains) for k in of])

    target, parts = _Target(lane, base.whitened_sigma[of], centre, root), []
    with lenient():
        warm = warm_up(_ACCEPTANCE[again], target, y, keys(0))
        for turn in range(times):
            x, lost, last = draw(target, warm, keys(1 + turn))
            warm = (last, *warm[1:])
            parts.append((np.asarray(x), np.asarray(lost)))
    whole = (np.concatenate(v, axis=2)[: len(lanes)] for v in zip(*parts, strict=True))
    return tuple(whole)


def _keep(found: Posterior, base: FitResult, noise_sampled, start, x, lost) -> dict[int, Start]:
    """Put the draws of some lanes in their places; returns where those not good go on."""
    lanes, P = base.study.lanes, base.study.size
    more = {}
    for lane, own, failed in zip(start, x, lost, strict=True):
        low, high = lanes.lower[lane], lanes.upper[lane]
        theta = low + (high - low) / (1 + np.exp(-own[..., :P]))
        theta = np.where(lanes.active[lane] > 0, theta, np.nan)
        noise = np.zeros((*own.shape[:-1], 2))
        noise[..., np.flatnonzero(noise_sampled)] = own[..., P:]
        times = own.shape[1] // found.theta.shape[2]
        found.theta[lane] = theta[:, times - 1 :: times]
        found.sigma[lane] = base.sigma[lane] * np.exp(noise[:, times - 1 :: times])
        found.divergent[lane] = failed[:, times - 1 :: times]
        found.steps[lane], found.lost[lane] = own.shape[1], failed.mean()
        found.rhat[lane], found.ess[lane] = mixing(theta)
        for name, values in zip(("median", "lower", "upper"), quantiles(base, lane, theta),
                                strict=True):  # fmt: skip
            getattr(found, name)[lane] = values
        if not found.verdict(lane).startswith("good"):
            more[lane] = around_the_draws(own)
    return more
