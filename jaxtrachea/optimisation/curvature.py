"""What the Gauss-Newton matrix leaves out of the Hessian, learned from the steps taken.

The sum of residuals times their second derivatives counts where the residual at the minimum is
large against what an unknown determines: across a flat, curved valley the Gauss-Newton matrix is
then wrong by a factor, steps undershoot or overshoot, and a fit creeps. A secant update keeps that
part (Dennis, Gay and Welsch 1981, NL2SOL, doi:10.1145/355958.355965); it is used after a step
that it foretold better than Gauss-Newton did.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import solve_spd


class Rest(NamedTuple):
    """Of the Hessian, beside the Gauss-Newton matrix.

    Attributes:
        matrix: symmetric; (P, P).
        trusted: whether the next step counts it in.
    """

    matrix: Float[Array, "P P"]
    trusted: Bool[Array, ""]


def hessian(point: Any, rest: Rest, free: Bool[Array, " P"]) -> Float[Array, "P P"]:
    """What a step is computed with: positive semidefinite among the unknowns that are free."""
    whole = point.hessian + rest.matrix
    among = jnp.where(free[:, None] & free[None], whole, jnp.eye(len(free), dtype=whole.dtype))
    definite = jnp.all(jnp.isfinite(solve_spd(among, point.gradient)))
    return jnp.where(rest.trusted & definite, whole, point.hessian)


def secant_update(rest: Rest, old: Any, new: Any, cross: Float[Array, " P"], step) -> Rest:
    """The rest after a step.

    Args:
        rest: before it.
        old: `Point` before it.
        new: `Point` after it.
        cross: J^T of `old` times the residual of `new`; (P,).
        step: (P,).
    """
    promised = -_dot(step, old.gradient + 0.5 * _times(old.hessian, step))
    along = _times(rest.matrix, step)
    actual = old.cost - new.cost
    error = jnp.abs(promised - actual)
    nearer = jnp.abs(promised - 0.5 * _dot(step, along) - actual) < error
    # Where Gauss-Newton foretells well, and where the residual vanishes, its steps are the best.
    nearer &= (error > 0.1 * jnp.abs(promised)) & (2 * new.cost > old.cost)
    seen, change = new.gradient - cross, new.gradient - old.gradient
    # What was learned far away is made smaller before it is mended along the step.
    have = _dot(step, along)
    size = jnp.minimum(1, jnp.abs(_dot(step, seen)) / jnp.where(have == 0, 1, jnp.abs(have)))
    matrix = jnp.where(have == 0, 1, size) * rest.matrix
    missing = seen - _times(matrix, step)
    rise = _dot(change, step)
    change = change / jnp.where(rise > 0, rise, 1)
    outer = missing[:, None] * change[None]
    matrix = matrix + outer + outer.T - _dot(missing, step) * (change[:, None] * change[None])
    good = (rise > 0) & (actual > 0) & jnp.all(jnp.isfinite(matrix))
    return Rest(jnp.where(good, matrix, rest.matrix), nearer)


def _dot(a, b):
    return jnp.sum(a * b)


def _times(matrix, v):
    return jnp.sum(matrix * v[None], axis=1)
