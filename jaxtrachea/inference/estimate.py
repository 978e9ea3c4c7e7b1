"""The estimate as a differentiable function of the data: derivatives by the implicit function.

At the minimum the gradient of the cost vanishes, g(theta, data) = 0, hence
d theta = -H^-1 (dg / d data) d data with the full Hessian H, curvature of the model included. An
unknown on its bound moves with the bound alone. Forward and reverse mode, any order, `jit`, `vmap`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.fitting.cost import LaneCost, evaluate
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.trust_region import RUNNING, State, Tolerances, begun, iterate
from jaxtrachea.trachea.geometry import Geometry


class Estimate(NamedTuple):
    """Estimate of one lane.

    Attributes:
        theta: unknowns in scaled coordinates; (P,).
        status: `FitStatus`; where it is not CONVERGED, derivatives mean nothing.
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
        model: of the fit.
        start: scaled coordinates, as `FitResult.theta`.
        lane: data, contact positions, bounds; see `lane_of`.
        sigma: of forces and markers, as `FitResult.whitened_sigma`.
        geometry: the tube; None: of the model.
        tolerances: when the fit is done.
    """
    tube = jax.tree.map(jnp.asarray, model.geometry if geometry is None else geometry)
    data = (lane, sigma, tube)
    state = _solve(model, tolerances, *jax.lax.stop_gradient((start, data)))
    return Estimate(_implicit(model, state.theta, data), state.status)


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
        begun(start, objective),
    )


def _gradient(model: FitModel, theta, data):
    return gradient(model, theta, *data)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _implicit(model: FitModel, theta: Float[Array, " P"], data: Any) -> Float[Array, " P"]:
    """Theta itself, with the derivative of the minimum by the data."""
    return theta


@_implicit.defjvp
def _implicit_jvp(model: FitModel, primals, tangents):
    theta, data = _implicit(model, *primals), primals[1]
    tangent = tangents[1]
    lane, d_lane = data[0], tangent[0]
    g, d_g = jax.jvp(lambda data: _gradient(model, theta, data), (data,), (tangent,))
    H = jax.jacfwd(lambda theta: _gradient(model, theta, data))(theta)
    low = (theta <= lane.lower) & (g > 0)
    high = (theta >= lane.upper) & (g < 0)
    free = ~low & ~high & (lane.active > 0)
    pushed = jnp.where(low, d_lane.lower, jnp.where(high, d_lane.upper, 0))
    rhs = jnp.where(free, -d_g - jnp.sum(H * pushed[None], axis=1), pushed)
    both = free[:, None] & free[None]
    matrix = jnp.where(both, H, jnp.eye(len(theta), dtype=H.dtype))
    return theta, jnp.linalg.solve(matrix, rhs)
