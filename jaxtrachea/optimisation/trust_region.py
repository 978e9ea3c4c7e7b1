"""One iteration of Levenberg-Marquardt inside a box, of one start; pure functions.

MINPACK's tests of convergence and trust region (More 1978, doi:10.1007/BFb0067700): a step is as
long as the radius allows, in coordinates that are scaled already. Each step bends along the curve
that a second directional derivative predicts (geodesic acceleration, Transtrum and Sethna 2012,
arXiv:1201.5885): the valleys of this model are narrow and curved, since stiffness of skeleton and
contact nearly trade off, and straight steps crawl in them. The matrix of a step is that of
Gauss-Newton, with what that leaves out where it foretells better (`curvature`). Bounds by an active
set: an unknown on its bound whose gradient points outwards is held; one that a step would carry
over its bound stops on it exactly, and the others go to where that leaves their minimum.

What is minimised is an `Objective`.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon, largest, solve_spd
from jaxtrachea.optimisation import curvature
from jaxtrachea.optimisation.curvature import Rest
from jaxtrachea.status import FitStatus

RUNNING = -1
#: First radius of the trust region, in scaled coordinates (log: a factor of 7).
FIRST_RADIUS = 2.0


@runtime_checkable
class Point(Protocol):
    """What an objective gives at a point; it may carry more, for its `ahead`."""

    @property
    def cost(self) -> Any:
        """Half a sum of squares, or what stands for it; scalar."""

    @property
    def gradient(self) -> Any:
        """Of the cost; (P,)."""

    @property
    def hessian(self) -> Any:
        """Gauss-Newton matrix, positive semidefinite; (P, P)."""


@runtime_checkable
class Box(Protocol):
    """Bounds of the unknowns, and which of them exist."""

    @property
    def lower(self) -> Any:
        """(P,)."""

    @property
    def upper(self) -> Any:
        """(P,)."""

    @property
    def active(self) -> Any:
        """1, or 0 where the unknown does not exist or is held; (P,)."""


@runtime_checkable
class Objective(Box, Protocol):
    """What is minimised inside a box: a record of arrays (`eqx.Module`), pure methods of one lane.

    The solver stacks records along a leading axis, casts them and maps over them; what is static
    is compared by value.
    """

    def evaluate(self, theta: Float[Array, " P"]) -> Any:
        """The `Point` at theta."""
        ...

    def ahead(self, point: Any, theta: Any, step: Any) -> Float[Array, " P"]:
        """J^T times the second derivative of the residual along `step`, at `theta`, (P,).

        From a residual a part of the step ahead, say, and the `point` at theta; zeros give straight
        steps.
        """
        ...

    def cross_gradient(self, point: Any, other: Any) -> Float[Array, " P"]:
        """J^T of one `Point` times the residual of another, (P,)."""
        ...

    def blank(self) -> Any:
        """A point of the shapes and dtypes that `evaluate` gives, of any content."""
        ...

    def rounding(self) -> Float[Array, ""]:
        """Cost that is rounding alone."""
        ...


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
    """One lane under way; `radius` bounds the length of the next step, `rest` mends its matrix."""

    theta: Float[Array, " P"]
    point: Any
    radius: Float[Array, ""]
    iteration: Int[Array, ""]
    status: Int[Array, ""]
    rest: Rest


def initial_state(theta: Float[Array, " P"], objective: Objective) -> State:
    """A start of one lane, not yet evaluated."""
    unknowns = theta.shape[0]
    rest = Rest(jnp.zeros((unknowns, unknowns), theta.dtype), jnp.asarray(False))
    radius = jnp.full((), FIRST_RADIUS, theta.dtype)
    return State(theta, objective.blank(), radius, jnp.int32(0), jnp.int8(RUNNING), rest)


class _Step(NamedTuple):
    """A proposed step: where it leads, the way there, its straight part and what that promises."""

    trial: Float[Array, " P"]
    delta: Float[Array, " P"]
    straight: Float[Array, ""]
    predicted: Float[Array, ""]


def bound_rounding(bound, dtype=None):
    """Distance to a bound that is rounding, at most."""
    return 8 * epsilon(bound.dtype if dtype is None else dtype) * (1 + abs(bound))


def active_set(theta, gradient, box: Box):
    """Unknowns that do not move: absent, or on a bound that the gradient pushes against."""
    low = (theta - box.lower <= bound_rounding(box.lower)) & (gradient > 0)
    high = (box.upper - theta <= bound_rounding(box.upper)) & (gradient < 0)
    return low | high | (box.active == 0)


def promise(theta, point: Point, box: Box):
    """Fall of the residual's norm that each unknown alone still promises inside its bounds; (P,).

    Inside the box |g_i| / sqrt(H_ii): over the norm of the residual, the cosine between it and a
    column of the Jacobian. On a bound that the gradient pushes against it is 0.
    """
    diagonal = jnp.diagonal(point.hessian)
    moves = (diagonal > 0) & (box.active > 0)
    own = jnp.where(moves, diagonal, 1)
    newton = jnp.clip(theta - point.gradient / own, box.lower, box.upper) - theta
    return jnp.where(moves, jnp.abs(newton) * jnp.sqrt(own), 0)


def trust_region_step(radius, hessian, gradient, free):
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


def _onto_bounds(theta, straight, damped, g, H, free, radius, box: Box):
    """Step with what would leave the box on its bound, the others minimal given that.

    Returns:
        The step, and which unknowns stop on a bound by it.
    """
    ahead = theta + straight
    stops = free & ((ahead < box.lower) | (ahead > box.upper))
    onto = jnp.where(stops, jnp.clip(ahead, box.lower, box.upper) - theta, 0)
    moves = free & ~stops
    matrix = jnp.where(moves[:, None] & moves[None], damped, jnp.eye(len(g), dtype=g.dtype))
    pull = g + jnp.sum(H * onto[None], axis=1)
    rest = solve_spd(matrix, jnp.where(moves, -pull, 0))
    rest = rest * jnp.minimum(1, 1.2 * radius / _length(rest))
    return jnp.where(jnp.any(stops), jnp.where(stops, onto, rest), straight), stops


def _length(v):
    """Euclidean length, not below the smallest normal number."""
    return jnp.sqrt(jnp.maximum(jnp.sum(v * v), jnp.finfo(v.dtype).tiny))


def _step(objective: Objective, state: State) -> _Step:
    """Step of the trust region inside the box, bent by the residual's curvature along it."""
    point, theta = state.point, state.theta
    g = point.gradient
    free = ~active_set(theta, g, objective)
    H = curvature.hessian(point, state.rest, free)
    straight, damped = trust_region_step(state.radius, H, g, free)
    straight, stops = _onto_bounds(theta, straight, damped, g, H, free, state.radius, objective)

    def clip(theta):
        return jnp.clip(theta, objective.lower, objective.upper)

    straight = clip(theta + straight) - theta
    predicted = -jnp.sum(straight * (g + 0.5 * jnp.sum(H * straight[None], axis=1)))
    pull = objective.ahead(point, theta, straight)
    bend = 0.5 * solve_spd(damped, jnp.where(free & ~stops, -pull, 0))
    # Of no use where the expansion fails, nor where the step is so short that its difference is
    # rounding.
    length = _length(straight)
    useful = (_length(bend) <= 0.375 * length) & (length > epsilon(g.dtype) ** 0.25)
    bend = jnp.where(useful & ~stops & jnp.all(jnp.isfinite(bend)), bend, 0)
    # Not by the difference: theta + (bound - theta) may miss the bound by a rounding.
    bound = jnp.where(straight > 0, objective.upper, objective.lower)
    trial = jnp.where(stops & (straight != 0), bound, clip(theta + straight + bend))
    return _Step(trial, trial - theta, length, predicted)


def iterate(tolerances: Tolerances, objective: Objective, state: State) -> State:
    """One iteration of one start. The first one only evaluates it.

    Whatever point came with a fresh start has an infinite cost, which stays where the start cannot
    be evaluated: neither the content of a blank point nor the minimum of another start is taken
    for its own.
    """
    fresh = state.iteration == 0
    before = jnp.where(fresh, jnp.inf, state.point.cost)
    old = eqx.tree_at(lambda point: point.cost, state.point, before)
    step = _step(objective, state)
    trial = jnp.where(fresh, state.theta, step.trial)
    new = objective.evaluate(trial)
    finite = jnp.isfinite(new.cost) & jnp.all(jnp.isfinite(new.hessian))
    finite &= jnp.all(jnp.isfinite(new.gradient))
    actual = old.cost - new.cost
    accept = finite & (fresh | (actual > 0))
    ratio = jnp.where(accept, actual / jnp.where(step.predicted > 0, step.predicted, jnp.inf), 0)
    shorter = jnp.where(finite, 0.25, 0.1) * jnp.minimum(state.radius, step.straight)
    longer = jnp.maximum(state.radius, 2 * step.straight)
    radius = jnp.where(ratio < 0.25, shorter, jnp.where(ratio > 0.75, longer, state.radius))

    def pick(a, b):
        return jnp.where(accept, a, b)

    point = jax.tree.map(pick, new, old)
    theta = pick(trial, state.theta)
    radius = jnp.where(fresh, state.radius, radius)
    cross = objective.cross_gradient(old, new)
    rest = curvature.secant_update(state.rest, old, new, cross, step.delta)
    rest = Rest(jnp.where(fresh, 0, rest.matrix), rest.trusted & ~fresh)
    moved = State(theta, point, radius, state.iteration + 1, state.status, rest)
    done = _status(tolerances, old.cost, moved, objective, fresh, finite, step, actual)
    running = state.status == RUNNING
    moved = moved._replace(status=done)
    return jax.tree.map(lambda a, b: jnp.where(running, a, b).astype(b.dtype), moved, state)


def _status(tolerances, old_cost, new, objective, fresh, finite, step, actual):
    """RUNNING, or why this lane is done."""
    dtype = new.theta.dtype

    def small(tolerance):
        return max(tolerance, 4 * epsilon(dtype))

    cost, g = new.point.cost, new.point.gradient
    free = ~active_set(new.theta, g, objective)
    steepest = largest(promise(new.theta, new.point, objective))
    flat = steepest <= small(tolerances.gradient) * jnp.sqrt(2 * cost)
    exact = cost <= objective.rounding()
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
