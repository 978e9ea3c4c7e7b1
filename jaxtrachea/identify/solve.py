"""Batched Levenberg-Marquardt: lanes x starts in one compiled program, refilled as lanes finish.

MINPACK's tests of convergence (More 1978, doi:10.1007/BFb0067700), Nielsen's damping
(IMM-REP-1999-05) of equal strength in all unknowns, whose coordinates are scaled already (in the
curved valleys of this model it converges where Marquardt's running diagonal stalls), and an active
set for bounds: an unknown on its bound whose gradient points outwards is held, steps are clipped to
the box. A robust loss enters as a reweighting by rho'(r^2).

A chunk of lanes takes a few iterations at a time; lanes that are done leave and waiting ones take
their place, so that a slow lane holds up nobody and one program serves any number of lanes. Each
lane is computed from its own data alone.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon, solve_spd
from jaxtrachea.identify.problem import Lane, Problem, observations, residual
from jaxtrachea.status import FitStatus

RUNNING = -1


class Tolerances(NamedTuple):
    """When a lane is done; all relative.

    Attributes:
        cost: predicted and actual reduction of the cost in one step.
        step: step against the size of the unknowns.
        gradient: cosine between the residual and any column of the Jacobian.
        iterations: at most.
    """

    cost: float = 1e-10
    step: float = 1e-10
    gradient: float = 1e-10
    iterations: int = 100


class Normal(NamedTuple):
    """Cost and normal equations of one lane: gradient (P,), Gauss-Newton Hessian (P, P)."""

    cost: Float[Array, ""]
    gradient: Float[Array, " P"]
    hessian: Float[Array, "P P"]


class State(NamedTuple):
    """One lane under way."""

    theta: Float[Array, " P"]
    normal: Normal
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    scale: Float[Array, ""]
    iteration: Int[Array, ""]
    status: Int[Array, ""]


class Solved(NamedTuple):
    """Outcome of many lanes, numpy, leading axis = jobs in the order given.

    Attributes:
        theta: unknowns in scaled coordinates; (jobs, P).
        cost: half the weighted sum of rho(residual^2); (jobs,).
        status: `FitStatus`; (jobs,).
        iterations: (jobs,).
    """

    theta: np.ndarray
    cost: np.ndarray
    status: np.ndarray
    iterations: np.ndarray


def robust(name: str, z2: Float[Array, "*n"], scale: float) -> tuple[Array, Array]:
    """rho(z^2) and rho'(z^2) of a loss, quadratic up to about `scale` standard deviations."""
    s2 = scale * scale
    u = z2 / s2
    if name == "linear":
        return z2, jnp.ones_like(z2)
    if name == "huber":
        root = jnp.sqrt(jnp.maximum(u, 1))
        return s2 * jnp.where(u <= 1, u, 2 * root - 1), 1 / root
    if name == "soft_l1":
        root = jnp.sqrt(1 + u)
        return s2 * 2 * (root - 1), 1 / root
    if name == "cauchy":
        return s2 * jnp.log1p(u), 1 / (1 + u)
    raise ValueError(f"loss is {name!r}; expected linear, huber, soft_l1 or cauchy")


def entry_scale(lane: Lane, sigma: Float[Array, "2"]) -> Float[Array, " m"]:
    """1 / sigma of each residual entry: forces by sigma[0], markers by sigma[1]."""
    _, forces = observations(lane)
    count = residual_size(lane)
    return jnp.where(jnp.arange(count) < forces, 1 / sigma[0], 1 / sigma[1])


def residual_size(lane: Lane) -> int:
    """Entries of the residual per trial (static)."""
    size = lane.force.shape[-1]
    return size if lane.joints is None else size * (1 + lane.joints.shape[-1])


def normal_equations(
    problem: Problem, theta: Float[Array, " P"], lane: Lane, sigma: Float[Array, "2"]
) -> Normal:
    """Cost, gradient and Gauss-Newton Hessian of one lane; cost O(trials) in the Jacobian."""
    # The barrier keeps XLA from computing the residual anew inside each sum below.
    r = jax.lax.optimization_barrier(residual(problem, theta, lane))
    scale = entry_scale(lane, sigma)
    z = r.value * scale[None]
    rho, slope = robust(problem.loss, z * z, problem.loss_scale)
    b2 = r.weight * r.weight
    J = r.jacobian * scale[None, None]
    weighted = J * (b2 * slope)[:, None]
    gradient = jnp.sum(weighted * z[:, None], axis=-1)
    hessian = jnp.einsum("tim,tjm->tij", weighted, J)
    index = lane.index[:, problem.free_columns]
    return Normal(
        cost=0.5 * jnp.sum(b2 * rho),
        gradient=assemble(gradient, index, theta.shape[0]),
        hessian=assemble(hessian, index, theta.shape[0]),
    )


def assemble(parts: Array, index: Int[Array, "trials columns"], size: int) -> Array:
    """Sum what each trial gives for its columns into the unknowns they read.

    Args:
        parts: (T, Jf) or (T, Jf, Jf).
        index: unknown of each column, -1 where it reads none; (T, Jf).
        size: number of unknowns.
    """
    place = jnp.where(index >= 0, index, size)
    if parts.ndim == 2:
        return jnp.zeros(size, parts.dtype).at[place].add(parts, mode="drop")
    zero = jnp.zeros((size, size), parts.dtype)
    return zero.at[place[:, :, None], place[:, None, :]].add(parts, mode="drop")


def _held(theta, gradient, lane: Lane):
    """Unknowns that do not move: absent, or on a bound that the gradient pushes against."""
    low = (theta <= lane.lower) & (gradient > 0)
    high = (theta >= lane.upper) & (gradient < 0)
    return low | high | (lane.active == 0)


def _step(state: State, lane: Lane):
    """Damped Gauss-Newton step inside the box, and the reduction it predicts."""
    g, H = state.normal.gradient, state.normal.hessian
    held = _held(state.theta, g, lane)
    damped = H + state.damping * state.scale * jnp.eye(g.shape[0], dtype=g.dtype)
    free = ~held
    system = jnp.where(free[:, None] & free[None], damped, jnp.eye(g.shape[0], dtype=g.dtype))
    delta = solve_spd(system, jnp.where(free, -g, 0))
    trial = jnp.clip(state.theta + delta, lane.lower, lane.upper)
    delta = trial - state.theta
    predicted = -jnp.sum(delta * (g + 0.5 * jnp.sum(H * delta[None], axis=1)))
    return trial, delta, predicted


def iterate(
    problem: Problem, tolerances: Tolerances, state: State, lane: Lane, sigma: Float[Array, "2"]
) -> State:
    """One iteration of one lane. The first one only evaluates the start (cost is inf before)."""
    fresh = jnp.isinf(state.normal.cost)
    trial, delta, predicted = _step(state, lane)
    trial = jnp.where(fresh, state.theta, trial)
    new = normal_equations(problem, trial, lane, sigma)
    finite = jnp.isfinite(new.cost) & jnp.all(jnp.isfinite(new.hessian))
    finite &= jnp.all(jnp.isfinite(new.gradient))
    actual = state.normal.cost - new.cost
    accept = finite & (fresh | (actual > 0))
    ratio = jnp.where(accept & ~fresh, actual / jnp.where(predicted > 0, predicted, 1), 0)
    shrink = jnp.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2)
    damping = jnp.where(accept, state.damping * jnp.where(fresh, 1, shrink), state.damping)
    damping = jnp.where(accept, damping, damping * state.growth)
    growth = jnp.where(accept, 2, state.growth * 2)
    pick = lambda a, b: jnp.where(accept, a, b)  # noqa: E731
    normal = jax.tree.map(pick, new, state.normal)
    theta = pick(trial, state.theta)
    scale = jnp.max(jnp.diagonal(normal.hessian))
    scale = jnp.where(scale > 0, scale, 1)
    moved = State(theta, normal, damping, growth, scale, state.iteration + 1, state.status)
    done = _status(tolerances, state, moved, lane, sigma, fresh, accept, delta, actual, predicted)
    running = state.status == RUNNING
    moved = moved._replace(status=done)
    return jax.tree.map(lambda a, b: jnp.where(running, a, b).astype(b.dtype), moved, state)


def _status(tolerances, old, new, lane, sigma, fresh, accept, delta, actual, predicted):
    """RUNNING, or why this lane is done."""
    dtype = new.theta.dtype
    small = lambda tolerance: max(tolerance, 4 * epsilon(dtype))  # noqa: E731
    cost = new.normal.cost
    g, diagonal = new.normal.gradient, jnp.diagonal(new.normal.hessian)
    free = ~_held(new.theta, g, lane)
    cosine = jnp.where(
        free & (diagonal > 0), jnp.abs(g) / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1)), 0
    )
    flat = jnp.max(cosine) <= small(tolerances.gradient) * jnp.sqrt(2 * cost)
    scale = entry_scale(lane, sigma)[: lane.force.shape[-1]]
    data = jnp.sum((lane.force * lane.precision * lane.balance[:, None] * scale[None]) ** 2)
    exact = cost <= 0.5 * data * (10 * epsilon(dtype)) ** 2
    tiny = small(tolerances.cost) * old.normal.cost
    settled = accept & ~fresh & (actual <= tiny) & (predicted <= tiny)
    length = jnp.sqrt(jnp.sum(delta**2))
    short = ~fresh & (length <= small(tolerances.step) * jnp.sqrt(jnp.sum(new.theta**2) + 1))
    nearly_flat = jnp.max(cosine) <= 1e3 * small(tolerances.gradient) ** 0.5 * jnp.sqrt(2 * cost)
    converged = flat | exact | settled | (short & nearly_flat)
    status = jnp.where(converged, FitStatus.CONVERGED, RUNNING)
    status = jnp.where(~converged & short, FitStatus.STALLED, status)
    out = (status == RUNNING) & (new.iteration >= tolerances.iterations)
    status = jnp.where(out, FitStatus.MAX_ITERATIONS, status)
    return jnp.where(fresh & ~accept, FitStatus.INFEASIBLE_START, status).astype(jnp.int8)


def fresh_state(theta: Float[Array, " P"]) -> State:
    """A lane before its first evaluation."""
    size, dtype = theta.shape[0], theta.dtype
    one = jnp.ones((), dtype)
    normal = Normal(
        jnp.full((), jnp.inf, dtype), jnp.zeros(size, dtype), jnp.eye(size, dtype=dtype)
    )
    status = jnp.asarray(RUNNING, jnp.int8)
    return State(theta, normal, 1e-3 * one, 2 * one, one, jnp.asarray(0, jnp.int32), status)


def _advance(problem, tolerances, rounds, lanes, jobs, sigma, start, refill, state):
    """Put fresh lanes where asked, then up to `rounds` iterations of the whole chunk."""
    lane = jax.tree.map(lambda v: v[jobs], lanes)
    new = jax.vmap(fresh_state)(start)
    put = lambda a, b: jnp.where(refill.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
    state = jax.tree.map(put, new, state)
    one = jax.vmap(functools.partial(iterate, problem, tolerances))

    def body(carry):
        i, state = carry
        return i + 1, one(state, lane, sigma)

    def go(carry):
        i, state = carry
        return (i < rounds) & jnp.any(state.status == RUNNING)

    return jax.lax.while_loop(go, body, (0, state))[1]


def levenberg_marquardt(
    problem: Problem,
    jobs: np.ndarray,
    starts: np.ndarray,
    sigma: np.ndarray,
    *,
    tolerances: Tolerances = Tolerances(),  # noqa: B008 (immutable)
    chunk: int = 256,
    rounds: int = 8,
    progress: Callable[[int], None] | None = None,
    dtype=np.float64,
) -> Solved:
    """Fit every job: a lane from one start.

    Args:
        problem: the study.
        jobs: lane of each job, int; (jobs,).
        starts: start of each job, scaled coordinates; (jobs, P).
        sigma: standard deviation of (force, markers) of each job in units of the lane's precision
            (1 where noise is given); (jobs, 2).
        tolerances: when a lane is done.
        chunk: lanes computed together.
        rounds: iterations between two looks at which lanes are done.
        progress: called with the number of jobs that finished since the last call.
        dtype: of the computation.

    Returns:
        The `Solved` jobs, in order. Failed jobs are rows with a status; they touch no other row.
    """
    total = len(jobs)
    chunk = min(chunk, 1 << max(0, (total - 1).bit_length()))
    cast = lambda v: v if np.issubdtype(v.dtype, np.integer) else v.astype(dtype)  # noqa: E731
    lanes = jax.device_put(jax.tree.map(cast, problem.lanes))
    advance = _compiled(problem, tolerances, rounds)
    state = jax.vmap(fresh_state)(jnp.zeros((chunk, problem.size), dtype))
    state = state._replace(status=jnp.full(chunk, FitStatus.CONVERGED, jnp.int8))
    out = Solved(
        np.zeros((total, problem.size)), np.full(total, np.inf), np.zeros(total, int),
        np.zeros(total, int),
    )  # fmt: skip
    owner = np.full(chunk, -1)
    waiting = 0
    while True:
        refill = owner < 0
        slots = np.flatnonzero(refill)[: total - waiting]
        owner[slots] = np.arange(waiting, waiting + len(slots))
        waiting += len(slots)
        refill &= owner >= 0
        if np.all(owner < 0):
            return out
        of = np.maximum(owner, 0)
        state = advance(
            lanes, jobs[of].astype(np.int32), sigma[of].astype(dtype), starts[of].astype(dtype),
            refill, state,
        )  # fmt: skip
        status = np.asarray(state.status)
        done = (owner >= 0) & (status != RUNNING)
        rows = owner[done]
        if len(rows):
            out.theta[rows] = np.asarray(state.theta)[done]
            out.cost[rows] = np.asarray(state.normal.cost)[done]
            out.status[rows] = status[done]
            out.iterations[rows] = np.asarray(state.iteration)[done]
            owner[done] = -1
        if progress is not None:
            progress(len(rows))


@functools.lru_cache(maxsize=32)
def _compiled(problem: Problem, tolerances: Tolerances, rounds: int):
    return jax.jit(functools.partial(_advance, problem, tolerances, rounds))
