"""The model's answer and its standard errors, as pure functions for `jit` and `vmap`.

Standard errors by the delta method: covariance of the estimates through the exact Jacobian. What it
cannot do is said in `prediction.predict`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.delta_method import Estimate, standard_errors
from jaxtrachea.fitting.forward_residual import answer
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.mechanics.levels.level import Motion

#: What is predicted of a `levels.level.Response`, by its field, the force at the load cell; an axis
#: of displacements first. What the level does not have, and the motion of ring ends, is not there.
Values = dict[str, Any]


class Predicted(NamedTuple):
    """A response with standard errors from the parameters alone; inf where undetermined.

    Attributes:
        value: what is predicted.
        se: its standard errors.
        status: `PressStatus` of every displacement; (N,).
        bend: how far the force leaves its tangent where the parameters move to either end of the
            band at the deepest displacement, N; (2, N).
        deepest: index of that displacement.
        slope: derivative of the force by the free columns, N; (free, N).
    """

    value: Values
    se: Values
    status: Int[Array, "*n"]
    bend: Float[Array, "2 ..."]
    deepest: Int[Array, ""]
    slope: Float[Array, "free ..."]


def respond(
    model: FitModel, free: Float[Array, " F"], value: Float[Array, " J"], motion: Motion
) -> tuple[Values, Int[Array, " N"]]:
    """The fitted model at one position: response and `PressStatus`; pure.

    Args:
        free: free parameters, scaled coordinates.
        value: all parameters in their units, used where they are not free.
        motion: of the tool; its onset is that of the parameters. Where the force relaxes it has
            its time.
    """
    tube = jax.tree.map(lambda v: jnp.asarray(v, free.dtype), model.geometry)
    found = answer(model, free, value, motion, tube)
    values = found._replace(ends=None)._asdict()
    return {n: v for n, v in values.items() if n != "status" and v is not None}, found.status


def jacobian(model: FitModel, free, value, motion: Motion):
    """`respond`, its statuses, and its derivative by every free column, a leading axis (F, ...)."""

    def push(tangent):
        def at(free):
            return respond(model, free, value, motion)

        out, moved, status = jax.jvp(at, (free,), (tangent,), has_aux=True)
        return out, status, moved

    if not len(free):
        out, status = respond(model, free, value, motion)
        return out, status, jax.tree.map(lambda v: jnp.zeros((0, *v.shape), v.dtype), out)
    eye = jnp.eye(free.shape[0], dtype=free.dtype)
    return jax.vmap(push, out_axes=(None, None, 0))(eye)


def _unseen(slope: Float[Array, "F N"], slack: Float[Array, "N F"]) -> Float[Array, " N"]:
    """Slope along the null space that the fit could not tell from zero, see `predicted`.

    A direction belongs to the null space where the sum of squares of its slopes over the samples of
    the fit is a tiny share of that of all slopes. Where the same place is pressed no deeper, its
    slope is at most that share, however it compares with its own terms: a direction of one unknown
    has but one.
    """
    size = jnp.linalg.norm(slope.T * slack, axis=1)
    known = jnp.where(jnp.isfinite(size), size, 0)  # a sample without a solution has no slope
    return jnp.where(jnp.any(slack > 0, axis=1), jnp.max(known), 0)


@full_precision
def predicted(
    model: FitModel,
    estimate: Estimate,
    motion: Motion,
    slack: Float[Array, "N F"] | None = None,
) -> Predicted:
    """One curve with its standard errors; pure, for `jit` and `vmap`, float32 and float64.

    Args:
        estimate: with its uncertainty.
        motion: see `respond`; of one displacement at least.
        slack: where the fit has pressed, how far it sees slopes: its least ratio of singular values
            times the root of its samples, times the size of each unknown; elsewhere 0; None: 0.
    """
    free, value, covariance, null_space, half_width = estimate
    out, status, slopes = jacobian(model, free, value, motion)
    se = jax.tree.map(lambda slope: standard_errors(slope, covariance, null_space), slopes)
    if slack is not None:
        unseen = _unseen(slopes["force"], slack)
        se["force"] = standard_errors(slopes["force"], covariance, null_space, unseen)
    deepest = jnp.argmax(jnp.abs(motion.displacement))
    pull = covariance @ slopes["force"][:, deepest]
    along = jnp.sqrt(jnp.maximum(slopes["force"][:, deepest] @ pull, 0))
    known = (along > 0) & jnp.isfinite(half_width)
    step = jnp.where(known, half_width / jnp.where(along > 0, along, 1), 0) * pull
    straight = jnp.einsum("f...,f->...", slopes["force"], step)

    def bend(sign):
        end, _ = respond(model, free + sign * step, value, motion)
        return end["force"] - out["force"] - sign * straight

    if model.level.iterates:  # one program for both: it is long to compile
        bends = jax.vmap(bend)(jnp.asarray([1.0, -1.0], free.dtype))
    else:
        bends = jnp.stack([bend(1.0), bend(-1.0)])
    return Predicted(out, se, status, bends, deepest, slopes["force"])


def force_and_slope(model: FitModel, free, value, motion: Motion):
    """Force of one curve and its derivative by the free columns; (N,) and (F, N)."""
    out, _, slopes = jacobian(model, free, value, motion)
    return out["force"], slopes["force"]
