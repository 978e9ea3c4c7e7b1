"""Standard errors of what follows from the estimates, by the delta method; pure, for `jit`."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import full_precision

#: Slope along a direction of the null space, over what its terms add up to, from which it counts.
_ACTS = 1e-6


class Estimate(NamedTuple):
    """What a fit knows of the free parameters of one curve, scaled coordinates.

    Attributes:
        free: estimates; (F,).
        value: all parameters in their units, used where they are not free; (J,).
        covariance: of `free`; 0 for what is held; (F, F).
        null_space: rows: directions of `free` that the fit leaves undetermined; (B, F).
        half_width: of a 95 % interval in standard errors.
    """

    free: Float[Array, " F"]
    value: Float[Array, " J"]
    covariance: Float[Array, "F F"]
    null_space: Float[Array, "B F"]
    half_width: Float[Array, ""]


@full_precision
def standard_errors(
    slope: Float[Array, "F ..."],
    covariance: Float[Array, "F F"],
    null_space: Float[Array, "B F"],
    unseen: Float[Array, "..."] | None = None,
) -> Float[Array, "..."]:
    """Delta method: sqrt(J C J^T), inf where a direction of the null space changes the quantity.

    By more than `unseen`, the slope that the fit could not tell from zero there; None: 0.
    """
    variance = jnp.einsum("f...,fg,g...->...", slope, covariance, slope)
    along = jnp.abs(jnp.einsum("bf,f...->b...", null_space, slope))
    terms = jnp.einsum("bf,f...->b...", jnp.abs(null_space), jnp.abs(slope))
    least = max(_ACTS, 100 * float(jnp.finfo(slope.dtype).eps))
    least = least * terms if unseen is None else jnp.maximum(least * terms, unseen[None])
    undetermined = jnp.any(along > least, axis=0)
    return jnp.where(undetermined, jnp.inf, jnp.sqrt(jnp.maximum(variance, 0)))
