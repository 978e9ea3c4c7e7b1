"""Batched Levenberg-Marquardt: lanes x starts in one compiled program, refilled as lanes finish.

MINPACK's tests of convergence and trust region (More 1978, doi:10.1007/BFb0067700): a step is as
long as the radius allows, in coordinates that are scaled already. Each step bends along the curve
that a second directional derivative predicts (geodesic acceleration, Transtrum and Sethna 2012,
arXiv:1201.5885): the valleys of this model are narrow and curved, since stiffness of skeleton and
contact nearly trade off, and straight steps crawl in them. Bounds by an active set: an unknown on
its bound whose gradient points outwards is held; one that a step would carry over its bound stops
on it exactly, and the others go to where that leaves their minimum. A robust loss enters as a
reweighting by rho'(r^2).

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
from jaxtrachea.fit.cost import Point, assemble, entry_scale, evaluate, weights
from jaxtrachea.fit.lane import Lane
from jaxtrachea.fit.model import FitModel
from jaxtrachea.fit.residual import of_trials, residual_value, size
from jaxtrachea.fit.study import Study
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

RUNNING = -1
#: First radius of the trust region, in scaled coordinates (log: a factor of 7).
FIRST_RADIUS = 2.0
#: Part of the step after which the residual's curvature along it is looked up.
_LOOK = 0.1


class Tolerances(NamedTuple):
    """When a lane is done; all relative.

    Attributes:
        cost: predicted and actual change of the cost in one step; or a hundredth of it still to
            be gained by a Gauss-Newton step.
        step: step against the size of the unknowns.
        gradient: cosine between the residual and any column of the Jacobian.
        iterations: at most.
    """

    cost: float = 1e-10
    step: float = 1e-10
    gradient: float = 1e-10
    iterations: int = 200


class State(NamedTuple):
    """One lane under way; `radius` bounds the length of the next step."""

    theta: Float[Array, " P"]
    point: Point
    radius: Float[Array, ""]
    iteration: Int[Array, ""]
    status: Int[Array, ""]


class _Step(NamedTuple):
    """A proposed step: where it leads, the way there, its straight part and what that promises."""

    trial: Float[Array, " P"]
    delta: Float[Array, " P"]
    straight: Float[Array, ""]
    predicted: Float[Array, ""]


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


def _rounding(bound, dtype=None):
    """Distance to a bound that is rounding, at most."""
    return 8 * epsilon(bound.dtype if dtype is None else dtype) * (1 + abs(bound))


def held(theta, gradient, lane: Lane):
    """Unknowns that do not move: absent, or on a bound that the gradient pushes against."""
    low = (theta - lane.lower <= _rounding(lane.lower)) & (gradient > 0)
    high = (lane.upper - theta <= _rounding(lane.upper)) & (gradient < 0)
    return low | high | (lane.active == 0)


def promise(theta, point: Point, lane: Lane):
    """Fall of the residual's norm that each unknown alone still promises inside its bounds; (P,).

    Inside the box |g_i| / sqrt(H_ii): over the norm of the residual, the cosine between it and a
    column of the Jacobian. On a bound that the gradient pushes against it is 0.
    """
    diagonal = jnp.diagonal(point.hessian)
    moves = (diagonal > 0) & (lane.active > 0)
    curvature = jnp.where(moves, diagonal, 1)
    newton = jnp.clip(theta - point.gradient / curvature, lane.lower, lane.upper) - theta
    return jnp.where(moves, jnp.abs(newton) * jnp.sqrt(curvature), 0)


def rounding_cost(lane: Lane, sigma: Float[Array, "2"]) -> Float[Array, ""]:
    """Cost that rounding alone leaves: ten roundings of every force."""
    scale = entry_scale(lane, sigma)[: lane.force.shape[-1]]
    data = jnp.sum((lane.force * lane.precision * lane.balance[:, None] * scale[None]) ** 2)
    return 0.5 * data * (10 * epsilon(lane.force.dtype)) ** 2


def _within(radius, hessian, gradient, free):
    """Step of the trust region, |step| <= radius up to 20 %, and the damped matrix behind it.

    Three Newton steps on 1 / |step(damping)| = 1 / radius (Hebden, More): from below, without
    overshoot, and near enough.
    """
    eye = jnp.eye(gradient.shape[0], dtype=gradient.dtype)
    matrix = jnp.where(free[:, None] & free[None], hessian, eye)
    rhs = jnp.where(free, -gradient, 0)
    largest = jnp.max(jnp.where(free, jnp.diagonal(hessian), 0))
    floor = 64 * epsilon(gradient.dtype) * jnp.where(largest > 0, largest, 1)
    damping = floor
    for _ in range(3):
        damped = matrix + damping * eye
        step = solve_spd(damped, rhs)
        squared = jnp.sum(step * step)
        bend = jnp.sum(step * solve_spd(damped, step))
        length = jnp.sqrt(squared)
        newton = damping + squared / bend * (length / radius - 1)
        # Not positive definite to rounding: damp more.
        newton = jnp.where(jnp.isfinite(newton), newton, 100 * damping)
        damping = jnp.where(length <= 1.05 * radius, damping, jnp.maximum(newton, floor))
    damped = matrix + damping * eye
    step = solve_spd(damped, rhs)
    return step * jnp.minimum(1, 1.2 * radius / _length(step)), damped


def _onto_bounds(theta, straight, damped, point: Point, free, radius, lane: Lane):
    """Step with what would leave the box on its bound, the others minimal given that.

    Returns:
        The step, and which unknowns stop on a bound by it.
    """
    g, H = point.gradient, point.hessian
    ahead = theta + straight
    stops = free & ((ahead < lane.lower) | (ahead > lane.upper))
    onto = jnp.where(stops, jnp.clip(ahead, lane.lower, lane.upper) - theta, 0)
    moves = free & ~stops
    matrix = jnp.where(moves[:, None] & moves[None], damped, jnp.eye(len(g), dtype=g.dtype))
    pull = g + jnp.sum(H * onto[None], axis=1)
    rest = solve_spd(matrix, jnp.where(moves, -pull, 0))
    rest = rest * jnp.minimum(1, 1.2 * radius / _length(rest))
    return jnp.where(jnp.any(stops), jnp.where(stops, onto, rest), straight), stops


def _length(v):
    """Euclidean length, not below the smallest normal number."""
    return jnp.sqrt(jnp.maximum(jnp.sum(v * v), jnp.finfo(v.dtype).tiny))


def _step(model: FitModel, state: State, lane: Lane, sigma, geometry=None) -> _Step:
    """Step of the trust region inside the box, bent by the residual's curvature along it."""
    point, theta = state.point, state.theta
    g, H = point.gradient, point.hessian
    free = ~held(theta, g, lane)
    straight, damped = _within(state.radius, H, g, free)
    straight, stops = _onto_bounds(theta, straight, damped, point, free, state.radius, lane)
    box = lambda theta: jnp.clip(theta, lane.lower, lane.upper)  # noqa: E731
    straight = box(theta + straight) - theta
    predicted = -jnp.sum(straight * (g + 0.5 * jnp.sum(H * straight[None], axis=1)))
    along = of_trials(model, straight, lane)
    ahead = residual_value(model, theta + _LOOK * straight, lane, geometry)
    _, root = weights(model, point.value, lane, sigma)
    linear = jnp.einsum("tim,ti->tm", point.jacobian, along)
    curvature = 2 / _LOOK * ((ahead - point.value) / _LOOK * root - linear)
    pull = assemble(model, jnp.einsum("tim,tm->ti", point.jacobian, curvature), lane)
    bend = 0.5 * solve_spd(damped, jnp.where(free & ~stops, -pull, 0))
    # Of no use where the expansion fails, nor where the step is so short that its difference is
    # rounding.
    length = _length(straight)
    useful = (_length(bend) <= 0.375 * length) & (length > epsilon(g.dtype) ** 0.25)
    bend = jnp.where(useful & ~stops & jnp.all(jnp.isfinite(bend)), bend, 0)
    # Not by the difference: theta + (bound - theta) may miss the bound by a rounding.
    bound = jnp.where(straight > 0, lane.upper, lane.lower)
    trial = jnp.where(stops & (straight != 0), bound, box(theta + straight + bend))
    return _Step(trial, trial - theta, length, predicted)


def iterate(
    model: FitModel,
    tolerances: Tolerances,
    state: State,
    lane: Lane,
    sigma: Float[Array, "2"],
    geometry: Geometry | None = None,
) -> State:
    """One iteration of one lane. The first one only evaluates the start (cost is inf before)."""
    old = state.point
    fresh = jnp.isinf(old.cost)
    step = _step(model, state, lane, sigma, geometry)
    trial = jnp.where(fresh, state.theta, step.trial)
    new = evaluate(model, trial, lane, sigma, geometry)
    finite = jnp.isfinite(new.cost) & jnp.all(jnp.isfinite(new.hessian))
    finite &= jnp.all(jnp.isfinite(new.gradient))
    actual = old.cost - new.cost
    accept = finite & (fresh | (actual > 0))
    ratio = jnp.where(accept, actual / jnp.where(step.predicted > 0, step.predicted, jnp.inf), 0)
    shorter = jnp.where(finite, 0.25, 0.1) * jnp.minimum(state.radius, step.straight)
    longer = jnp.maximum(state.radius, 2 * step.straight)
    radius = jnp.where(ratio < 0.25, shorter, jnp.where(ratio > 0.75, longer, state.radius))
    pick = lambda a, b: jnp.where(accept, a, b)  # noqa: E731
    point = jax.tree.map(pick, new, old)
    theta = pick(trial, state.theta)
    radius = jnp.where(fresh, state.radius, radius)
    moved = State(theta, point, radius, state.iteration + 1, state.status)
    done = _status(tolerances, old.cost, moved, lane, sigma, fresh, finite, step, actual)
    running = state.status == RUNNING
    moved = moved._replace(status=done)
    return jax.tree.map(lambda a, b: jnp.where(running, a, b).astype(b.dtype), moved, state)


def _status(tolerances, old_cost, new, lane, sigma, fresh, finite, step, actual):
    """RUNNING, or why this lane is done."""
    dtype = new.theta.dtype
    small = lambda tolerance: max(tolerance, 4 * epsilon(dtype))  # noqa: E731
    cost, g = new.point.cost, new.point.gradient
    free = ~held(new.theta, g, lane)
    steepest = jnp.max(promise(new.theta, new.point, lane))
    flat = steepest <= small(tolerances.gradient) * jnp.sqrt(2 * cost)
    exact = cost <= rounding_cost(lane, sigma)
    tiny = small(tolerances.cost) * old_cost
    settled = finite & ~fresh & (jnp.abs(actual) <= tiny) & (step.predicted <= tiny)
    # A whole Gauss-Newton step promises more than any unknown alone: a short one proves nothing.
    settled &= 0.5 * steepest**2 <= 100 * tiny
    # Nor is there anything left: what a whole Gauss-Newton step from here would gain.
    downhill = jnp.where(free, g, 0)
    H = jnp.where(free[:, None] & free[None], new.point.hessian, jnp.eye(len(g), dtype=dtype))
    left = 0.5 * jnp.sum(downhill * solve_spd(H, downhill))
    settled |= finite & (left <= 0.01 * small(tolerances.cost) * cost)
    length = jnp.sqrt(jnp.sum(step.delta**2))
    short = ~fresh & (length <= small(tolerances.step) * jnp.sqrt(jnp.sum(new.theta**2) + 1))
    nearly_flat = steepest <= 1e3 * small(tolerances.gradient) ** 0.5 * jnp.sqrt(2 * cost)
    converged = flat | exact | settled | (short & nearly_flat)
    status = jnp.where(converged, FitStatus.CONVERGED, RUNNING)
    status = jnp.where(~converged & short, FitStatus.STALLED, status)
    out = (status == RUNNING) & (new.iteration >= tolerances.iterations)
    status = jnp.where(out, FitStatus.MAX_ITERATIONS, status)
    return jnp.where(fresh & ~finite, FitStatus.INFEASIBLE_START, status).astype(jnp.int8)


def _advance(model, tolerances, rounds, lane, sigma, start, refill, state):
    """Put fresh lanes where asked, then up to `rounds` iterations of the whole chunk."""
    put = lambda new, old: jnp.where(refill.reshape(-1, *[1] * (old.ndim - 1)), new, old)  # noqa: E731
    # An infinite cost is the mark of a fresh lane; its point is evaluated before it is used.
    state = State(
        theta=put(start, state.theta),
        point=state.point._replace(cost=put(jnp.inf, state.point.cost)),
        radius=put(FIRST_RADIUS, state.radius),
        iteration=put(0, state.iteration),
        status=put(jnp.int8(RUNNING), state.status),
    )
    one = jax.vmap(functools.partial(iterate, model, tolerances))

    def body(carry):
        i, state = carry
        return i + 1, one(state, lane, sigma)

    def go(carry):
        i, state = carry
        return (i < rounds) & jnp.any(state.status == RUNNING)

    return jax.lax.while_loop(go, body, (0, state))[1]


def chunk_size(total: int, most: int) -> int:
    """Lanes computed together: few different sizes, so that few programs are compiled."""
    return 1 if total == 1 else min(most, max(16, 1 << (total - 1).bit_length()))


def levenberg_marquardt(
    study: Study,
    jobs: np.ndarray,
    starts: np.ndarray,
    sigma: np.ndarray,
    *,
    tolerances: Tolerances = Tolerances(),  # noqa: B008 (immutable)
    chunk: int = 128,
    rounds: int = 4,
    progress: Callable[[int], None] | None = None,
    dtype=np.float64,
) -> Solved:
    """Fit every job: a lane from one start.

    Args:
        study: the study.
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
    chunk = chunk_size(total, chunk)
    cast = lambda v: v if np.issubdtype(v.dtype, np.integer) else v.astype(dtype, copy=False)  # noqa: E731
    lanes = jax.tree.map(cast, study.lanes)
    advance = _compiled(study.model, tolerances, rounds)
    state = _idle(study, lanes, chunk, dtype)
    # What the lanes of the chunk compute with; rewritten only where a lane takes its place.
    seats = jax.tree.map(
        lambda v: np.repeat(v[:1], chunk, axis=0), (lanes, cast(sigma), cast(starts))
    )
    out = Solved(
        np.zeros((total, study.size)), np.full(total, np.inf), np.zeros(total, int),
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
        new = owner[slots]
        arrivals = jax.tree.map(lambda v, of=jobs[new]: v[of], lanes), sigma[new], starts[new]
        for seat, arrival in zip(jax.tree.leaves(seats), jax.tree.leaves(arrivals), strict=True):
            seat[slots] = arrival
        state = advance(*seats, refill, state)
        status = np.asarray(state.status)
        done = (owner >= 0) & (status != RUNNING)
        rows = owner[done]
        if len(rows):
            theta = np.asarray(state.theta)[done]
            out.theta[rows] = _on_bounds(theta, study.lanes, jobs[rows])
            out.cost[rows] = np.asarray(state.point.cost)[done]
            out.status[rows] = status[done]
            out.iterations[rows] = np.asarray(state.iteration)[done]
            owner[done] = -1
        if progress is not None:
            progress(len(rows))


def _on_bounds(theta, lanes: Lane, rows) -> np.ndarray:
    """Unknowns of the lanes `rows` in the box, on its bounds where rounding alone parts them."""
    lower, upper = lanes.lower[rows], lanes.upper[rows]
    inside = np.clip(np.asarray(theta, np.float64), lower, upper)
    inside = np.where(inside - lower <= _rounding(lower, theta.dtype), lower, inside)
    return np.where(upper - inside <= _rounding(upper, theta.dtype), upper, inside)


def _idle(study: Study, lanes: Lane, chunk: int, dtype) -> State:
    """A chunk of places nobody works at."""
    P, Jf, T, m = study.size, len(study.free), lanes.s_c.shape[1], size(lanes)
    zeros = lambda *shape: jnp.zeros((chunk, *shape), dtype)  # noqa: E731
    point = Point(zeros(T, m), zeros(T, Jf, m), zeros(), zeros(P), zeros(P, P))
    done = jnp.full(chunk, FitStatus.CONVERGED, jnp.int8)
    return State(zeros(P), point, zeros(), jnp.zeros(chunk, jnp.int32), done)


@functools.lru_cache(maxsize=32)
def _compiled(model: FitModel, tolerances: Tolerances, rounds: int):
    run = functools.partial(_advance, model, tolerances, rounds)
    return jax.jit(run, donate_argnums=4)


#: Lanes computed together at most, and the part of the free memory that they may take.
MOST_SEATS, PART_OF_MEMORY = 128, 0.5
