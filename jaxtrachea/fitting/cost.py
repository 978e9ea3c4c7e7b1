"""What is minimised: robust loss, weights of curves and noise, and the normal equations."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._numerics import epsilon, full_precision
from jaxtrachea.fitting.lane import Lane, data_weight, force_entries, size
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import of_trials, residual, residual_value
from jaxtrachea.trachea.geometry import Geometry

#: Part of a step after which the residual's curvature along it is probed.
PROBE = 0.1


class Point(NamedTuple):
    """One lane evaluated: whitened residual, cost and normal equations.

    Attributes:
        value: as `Residual.value`; (T, m).
        jacobian: sqrt(weight) d value / d (free columns); (T, Jf, m).
        cost: half the weighted sum of rho.
        gradient: of the cost; (P,).
        hessian: Gauss-Newton; (P, P).
    """

    value: Float[Array, "T m"]
    jacobian: Float[Array, "T Jf m"]
    cost: Float[Array, ""]
    gradient: Float[Array, " P"]
    hessian: Float[Array, "P P"]


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
    of_force = jnp.arange(size(lane)) < force_entries(lane)
    return jnp.where(of_force, 1 / sigma[0], 1 / sigma[1])


def weights(model: FitModel, value, lane: Lane, sigma: Float[Array, "2"]):
    """Weighted loss of each entry, and the root of the weight of its square; (T, m) each."""
    scale = entry_scale(lane, sigma)[None]
    balance = lane.balance[:, None]
    if model.loss == "linear":
        root = balance * scale
        return (root * value) ** 2, jnp.broadcast_to(root, value.shape)
    rho, slope = robust(model.loss, (value * scale) ** 2, model.loss_scale)
    return balance * balance * rho, balance * jnp.sqrt(slope) * scale


@full_precision
def evaluate(
    model: FitModel,
    theta: Float[Array, " P"],
    lane: Lane,
    sigma: Float[Array, "2"],
    geometry: Geometry | None = None,
) -> Point:
    """Residual, cost and normal equations of one lane; cost O(trials) in the Jacobian."""
    r = residual(model, theta, lane, geometry)
    rho, root = weights(model, r.value, lane, sigma)
    J, z = r.jacobian * root[:, None], r.value * root
    hessian = jnp.einsum("tim,tjm->tij", J, J)
    if r.bend is not None:
        hessian = hessian + _corner(model, jnp.sum(z * root * r.bend, axis=1), hessian)
    return Point(
        value=r.value,
        jacobian=J,
        cost=0.5 * jnp.sum(rho),
        gradient=assemble(model, jnp.einsum("tim,tm->ti", J, z), lane),
        hessian=assemble(model, hessian, lane),
    )


def _corner(model: FitModel, bend: Float[Array, " T"], hessian) -> Float[Array, "T Jf Jf"]:
    """What the corner at the onset adds to the Gauss-Newton matrix of each trial.

    The rounded corner is the one place where the model bends within the noise of a sample; left
    out, steps of the onset overshoot. Only where it stiffens: the matrix stays positive definite.
    """
    i = [p.name for p in model.free].index("onset")
    return jnp.zeros_like(hessian).at[:, i, i].set(jnp.maximum(bend, 0))


def assemble(model: FitModel, parts: Array, lane: Lane) -> Array:
    """Sum what each trial gives for its columns into the unknowns they read.

    Args:
        parts: (T, Jf) or (T, Jf, Jf).
        lane: tells which unknown each column reads.
    """
    if model.common == "all":
        return jnp.sum(parts, axis=0)
    size = lane.lower.shape[0]
    index = lane.index[:, model.free_columns]
    place = jnp.where(index >= 0, index, size)
    if parts.ndim == 2:
        return jnp.zeros(size, parts.dtype).at[place].add(parts, mode="drop")
    zero = jnp.zeros((size, size), parts.dtype)
    return zero.at[place[:, :, None], place[:, None, :]].add(parts, mode="drop")


def rounding_cost(model: FitModel, lane: Lane, sigma: Any, dtype: Any = None) -> Any:
    """Cost that rounding alone leaves in every force, of one lane or of many.

    An equilibrium found by iteration leaves more than a formula (`Level.roundings`).

    Args:
        lane: without or with leading axes.
        sigma: of (force, markers), likewise.
        dtype: of the computation; None: that of the lane.
    """
    of_one = model.level.roundings * epsilon(lane.force.dtype if dtype is None else dtype)
    return data_weight(lane, sigma) * of_one**2


class LaneCost(eqx.Module):
    """The cost of a lane, or with a leading axis of many, as `levenberg_marquardt` minimises it.

    Attributes:
        model: what is fitted (static).
        lane: arrays of the lane.
        sigma: standard deviation of (force, markers) in units of the lane's precision (1 where
            noise is given); (2,).
        geometry: the tube, may be traced; None: of the model.
    """

    model: FitModel = eqx.field(static=True)
    lane: Lane
    sigma: Any
    geometry: Geometry | None = None

    @property
    def lower(self):
        """Bounds in scaled coordinates; (P,)."""
        return self.lane.lower

    @property
    def upper(self):
        """Bounds in scaled coordinates; (P,)."""
        return self.lane.upper

    @property
    def active(self):
        """Whether the unknown exists in the lane; (P,)."""
        return self.lane.active

    def evaluate(self, theta: Float[Array, " P"]) -> Point:
        """Residual, cost and normal equations."""
        return evaluate(self.model, theta, self.lane, self.sigma, self.geometry)

    @full_precision
    def ahead(self, point: Point, theta, step) -> Float[Array, " P"]:
        """J^T times the residual's second derivative along the step, by a probe on the way.

        Of a level that iterates zeros: a probe costs as much as a step there, and twice the time to
        compile, and the steps are straight enough.
        """
        model, lane = self.model, self.lane
        if model.level.iterates:
            return jnp.zeros_like(theta)
        along = of_trials(model, step, lane)
        probe = residual_value(model, theta + PROBE * step, lane, self.geometry)
        _, root = weights(model, point.value, lane, self.sigma)
        linear = jnp.einsum("tim,ti->tm", point.jacobian, along)
        curvature = 2 / PROBE * ((probe - point.value) / PROBE * root - linear)
        return assemble(model, jnp.einsum("tim,tm->ti", point.jacobian, curvature), lane)

    @full_precision
    def cross_gradient(self, point: Point, other: Point) -> Float[Array, " P"]:
        """J^T of one point times the residual of another."""
        _, root = weights(self.model, other.value, self.lane, self.sigma)
        parts = jnp.einsum("tim,tm->ti", point.jacobian, other.value * root)
        return assemble(self.model, parts, self.lane)

    def blank(self) -> Point:
        """Zeros in the shapes of `evaluate`."""
        lane = self.lane
        P, Jf, T = lane.lower.shape[0], len(self.model.free), lane.s_c.shape[0]
        m, dtype = size(lane), lane.lower.dtype

        def zeros(*shape):
            return jnp.asarray(np.zeros(shape, dtype), dtype)  # nothing is compiled for it

        return Point(zeros(T, m), zeros(T, Jf, m), zeros(), zeros(P), zeros(P, P))

    def rounding(self) -> Float[Array, ""]:
        """See `rounding_cost`."""
        return rounding_cost(self.model, self.lane, self.sigma)
