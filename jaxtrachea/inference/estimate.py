"""The estimate as a differentiable function of the data: derivatives by the implicit function.

At the minimum the gradient of the cost vanishes, g(theta, data) = 0, hence
d theta = -H^-1 (dg / d data) d data with the full Hessian H, curvature of the model included. An
unknown on its bound moves with the bound alone. Along what the data leave open H is singular: the
fit does not move there, nor does its derivative. Forward and reverse mode, any order, `jit`,
`vmap`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon
from jaxtrachea.fitting.cost import LaneCost, evaluate
from jaxtrachea.fitting.covariance import SINGULAR
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.trust_region import (
    RUNNING,
    State,
    Tolerances,
    active_set,
    initial_state,
    iterate,
)
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry


class Estimate(NamedTuple):
    """Estimate of one lane.

    Attributes:
        theta: unknowns in scaled coordinates; (P,).
        status: `FitStatus`; UNIDENTIFIABLE where the data leave a combination of unknowns open: it
            stays where the start has it, and its derivative is 0. Where it is neither this nor
            CONVERGED, derivatives mean nothing.
    """

    theta: Float[Array, " P"]
    status: Int[Array, ""]


def lane_of(study: Study, lane: int) -> Lane:
    """Arrays of one lane, for `estimate`."""
    return jax.tree.map(lambda v: jnp.asarray(v[lane]), study.lanes)


def estimate(
    model: FitModel,
    start: Float[Array, " P"],
    lane: Lane,
    sigma: Float[Array, "2"],
    geometry: Geometry | None = None,
    tolerances: Tolerances = Tolerances(),
) -> Estimate:
    """Fit one lane from one start; differentiable by everything but start, model, tolerances.

    Sigma is held where it is estimated; with forces alone and a linear loss the estimate does not
    depend on it.

    Args:
        start: scaled coordinates, as `FitResult.theta`.
        lane: data, contact positions, bounds; see `lane_of`.
        sigma: of forces and markers, as `FitResult.whitened_sigma`.
        geometry: the tube; None: of the model.
        tolerances: when the fit is done.
    """
    tube = jax.tree.map(jnp.asarray, model.geometry if geometry is None else geometry)
    data = (lane, sigma, tube)
    state = _solve(model, tolerances, *jax.lax.stop_gradient((start, data)))
    return Estimate(_implicit(model, state.theta, data), _status(state, lane))


def gradient(
    model: FitModel,
    theta: Float[Array, " P"],
    lane: Lane,
    sigma: Float[Array, "2"],
    geometry: Geometry | None = None,
) -> Float[Array, " P"]:
    """Of the cost."""
    return evaluate(model, theta, lane, sigma, geometry).gradient


def hessian(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, sigma: Float[Array, "2"]
) -> Float[Array, "P P"]:
    """Of the cost, with the curvature of the model that Gauss-Newton leaves out."""
    return jax.jacfwd(functools.partial(gradient, model))(theta, lane, sigma)


def _solve(model: FitModel, tolerances: Tolerances, start, data) -> State:
    """Levenberg-Marquardt of one lane, as a loop inside the program."""
    objective = LaneCost(model, *data)
    return jax.lax.while_loop(
        lambda state: state.status == RUNNING,
        lambda state: iterate(tolerances, objective, state),
        initial_state(start, objective),
    )


@functools.partial(jax.jit, static_argnums=0)
def _gradient(model: FitModel, theta, data):
    """`gradient`, as one program: outside of `jit` its derivatives were thousands of small ones."""
    return gradient(model, theta, *data)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _implicit(model: FitModel, theta: Float[Array, " P"], data: Any) -> Float[Array, " P"]:
    """Theta itself, with the derivative of the minimum by the data."""
    return theta


def _implicit_jvp(model: FitModel, primals, tangents):
    """The rule: what is not moved costs nothing, forces alone no second derivative of a press."""
    theta, data = _implicit(model, *primals), primals[1]
    leaves, structure = jax.tree.flatten(data)
    tangent = structure.flatten_up_to(tangents[1])
    moved = [i for i, v in enumerate(tangent) if not isinstance(v, SymbolicZero)]

    def of_moved(values):
        changed = dict(zip(moved, values, strict=True))
        new = [changed.get(i, v) for i, v in enumerate(leaves)]
        return _gradient(model, theta, jax.tree.unflatten(structure, new))

    given, along = [leaves[i] for i in moved], [tangent[i] for i in moved]
    g, d_g = jax.jvp(of_moved, (given,), (along,))
    H = jax.jacfwd(lambda theta: _gradient(model, theta, data))(theta)
    lane, d_lane = data[0], tangents[1][0]
    low = (theta <= lane.lower) & (g > 0)
    high = (theta >= lane.upper) & (g < 0)
    free = ~low & ~high & (lane.active > 0)
    lower, upper = _instance(d_lane.lower, lane.lower), _instance(d_lane.upper, lane.upper)
    pushed = jnp.where(low, lower, jnp.where(high, upper, 0))
    rhs = jnp.where(free, -d_g - jnp.sum(H * pushed[None], axis=1), pushed)
    both = free[:, None] & free[None]
    matrix = jnp.where(both, H, jnp.eye(len(theta), dtype=H.dtype))
    opened = _left_open(H, free)
    return theta, jnp.linalg.solve(matrix + opened, rhs - opened @ rhs)


@jax.jit
def _status(state: State, lane: Lane) -> Int[Array, ""]:
    """That of the solver, or UNIDENTIFIABLE."""
    held = active_set(state.theta, state.point.gradient, lane)
    opened = jnp.any(_left_open(state.point.hessian, ~held) != 0)
    lost = opened & (state.status == FitStatus.CONVERGED)
    return jnp.where(lost, jnp.int8(FitStatus.UNIDENTIFIABLE), state.status)


@jax.jit
def _left_open(H: Float[Array, "P P"], free) -> Float[Array, "P P"]:
    """Projection onto combinations of what is free that the curvature does not tell from a plane.

    A constant to derivatives, as the eigenvectors of a matrix with equal eigenvalues have none.
    """
    H = jax.lax.stop_gradient(H)
    H = jnp.where(free[:, None] & free[None], H, 0)
    top = jnp.max(jnp.abs(jnp.diagonal(H)))
    held = jnp.where(free, 0, jnp.where(top > 0, top, 1))
    values, vectors = jnp.linalg.eigh(H + jnp.diag(held))
    size = jnp.abs(values)
    flat = size <= max(SINGULAR**2, 8 * epsilon(H.dtype)) * jnp.max(size)
    opened = jnp.where(flat[None], vectors, 0)
    return opened @ opened.T


_implicit.defjvp(_implicit_jvp, symbolic_zeros=True)


def _instance(tangent: Any, of: Array) -> Array:
    """The tangent of an array, zeros where it does not move."""
    return jnp.zeros_like(of) if isinstance(tangent, SymbolicZero) else tangent
