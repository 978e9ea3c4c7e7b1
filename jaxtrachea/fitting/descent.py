"""The same cost by optax: L-BFGS or Adam, for users who put the model into a larger loss.

`cost` is the scalar to embed; `descend` runs it by itself, with the box kept by projection. Slower
than `levenberg_marquardt` for a plain fit; use it where the loss is not a sum of squares.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._arguments import check_record
from jaxtrachea._numerics import largest
from jaxtrachea.fitting.cost import entry_scale, evaluate, robust, rounding_cost
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.optimisation.trust_region import Tolerances, active_set, promise
from jaxtrachea.status import FitStatus

#: Cosine between residual and Jacobian up to which a point counts as a minimum.
NEARLY_FLAT = 1e-2


def cost(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, sigma: Float[Array, "2"]
) -> Float[Array, ""]:
    """Half the weighted sum of rho(residual^2) of one lane; differentiable in all arrays.

    Args:
        theta: unknowns in scaled coordinates (`Parameter.to_scaled`).
        lane: arrays of the lane.
        sigma: standard deviation of force and markers in units of the lane's precision.
    """
    z = residual_value(model, theta, lane) * entry_scale(lane, sigma)[None]
    rho, _ = robust(model.loss, z * z, model.loss_scale)
    return 0.5 * jnp.sum(rho * (lane.balance * lane.balance)[:, None])


@dataclasses.dataclass(frozen=True)
class Descent:
    """How to descend, and when a start is done.

    Attributes:
        method: of optax.
        tolerances: `iterations` counts tens of steps for L-BFGS and hundreds for Adam; a start is
            done when the relative change of its cost over such a block is below `cost` per step.
        learning_rate: of Adam; L-BFGS searches along its line.
    """

    method: Literal["lbfgs", "adam"] = "lbfgs"
    tolerances: Tolerances = Tolerances()
    learning_rate: float = 0.03

    def __post_init__(self):
        """Refuse words and numbers that mean nothing (`ValueError`)."""
        check_record(self)

    @property
    def block(self) -> int:
        """Steps between two looks at the cost."""
        return {"lbfgs": 10, "adam": 100}[self.method]


def descend(
    study: Study,
    rows: np.ndarray,
    starts: np.ndarray,
    sigma: np.ndarray,
    descent: Descent = Descent(),
    *,
    batch: int = 256,
    progress: Callable[[int], None] | None = None,
    dtype=np.float64,
) -> Solved:
    """Minimise from every start by a first-order method; results as `levenberg_marquardt`.

    `rows`: lane of each start; `sigma`: of each lane. The other arguments are those of
    `levenberg_marquardt`.

    Where an unknown alone could still lower the residual's norm by more than `NEARLY_FLAT`, it has
    stalled.

    Raises:
        ValueError: a skeleton of deforming cross-sections.
    """
    study.refuse_sections(f"fit.method = {descent.method!r}")
    # optax mixes integer widths in its counters
    with jax.numpy_dtype_promotion("standard"):
        outcome = map_lanes(
            _descend, study, starts, sigma[rows], rows=rows, batch=min(batch, len(rows)),
            static=(descent,), dtype=dtype, progress=progress,
            unoptimised=study.unoptimised(len(rows)),
        )  # fmt: skip
    theta, value, status, iterations = outcome
    return Solved(theta, value, status.astype(int), iterations)


def _descend(model, descent: Descent, start, lane, sigma):
    """One start: blocks of steps until the cost settles."""
    import optax

    method, tolerances, block = descent.method, descent.tolerances, descent.block

    def loss(theta):
        return cost(model, theta, lane, sigma)

    def box(theta):
        return jnp.clip(theta, lane.lower, lane.upper)

    optimiser = optax.lbfgs() if method == "lbfgs" else optax.adam(descent.learning_rate)

    def step(_, carry):
        theta, state = carry
        value, gradient = jax.value_and_grad(loss)(theta)
        # What a bound holds does not move, and the others do not count on it.
        gradient = jnp.where(active_set(theta, gradient, lane), 0, gradient)
        extra = {"value": value, "grad": gradient, "value_fn": loss} if method == "lbfgs" else {}
        updates, state = optimiser.update(gradient, state, theta, **extra)
        return box(optax.apply_updates(theta, updates)), state

    def more(carry):
        _, _, value, previous, blocks = carry
        change = jnp.abs(previous - value) > block * tolerances.cost * jnp.abs(value)
        return (blocks < tolerances.iterations) & jnp.isfinite(value) & (change | (blocks == 0))

    def advance(carry):
        theta, state, value, _, blocks = carry
        theta, state = jax.lax.fori_loop(0, block, step, (theta, state))
        return theta, state, loss(theta), value, blocks + 1

    theta = box(start)
    value = loss(theta)
    first = (theta, optimiser.init(theta), value, value, jnp.asarray(0))
    theta, _, value, _, blocks = jax.lax.while_loop(more, advance, first)
    status = jnp.where(
        blocks >= tolerances.iterations, FitStatus.MAX_ITERATIONS, FitStatus.CONVERGED
    )
    point = evaluate(model, theta, lane, sigma)
    left = largest(promise(theta, point, lane))
    steep = left > NEARLY_FLAT * jnp.sqrt(2 * point.cost)
    steep &= (status == FitStatus.CONVERGED) & (value > rounding_cost(model, lane, sigma))
    status = jnp.where(steep, FitStatus.STALLED, status)
    bad = jnp.where(blocks == 0, FitStatus.INFEASIBLE_START, FitStatus.NON_FINITE)
    # A column of the Jacobian that is no number promises nothing: `promise` takes it for absent.
    finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(point.gradient))
    finite &= jnp.all(jnp.isfinite(point.hessian))
    return theta, value, jnp.where(finite, status, bad), block * blocks
