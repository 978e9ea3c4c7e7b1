"""Samples of a press in time: which of them count, and from which on there is no history."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea.mechanics.validation import has_solution
from jaxtrachea.status import PressStatus


def in_order(
    time: Float[Array, " N"], displacement: Float[Array, " N"]
) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
    """Times that never fall, and BACK_IN_TIME, NON_FINITE (no place) or OK for each sample.

    A sample that is not OK is at the time of the last one before that is: it takes none.
    """
    timed, placed = jnp.isfinite(time), jnp.isfinite(displacement)
    counts = timed & placed
    latest = jax.lax.cummax(jnp.where(counts, time, -jnp.inf))
    back = ~timed | (time < latest)
    start = jnp.min(jnp.where(counts, time, jnp.inf))  # of samples before the first that counts
    latest = jnp.maximum(latest, jnp.where(jnp.isfinite(start), start, 0))
    status = jnp.where(back, PressStatus.BACK_IN_TIME, PressStatus.OK)
    status = jnp.where(placed | back, status, PressStatus.NON_FINITE)
    return jnp.where(back | ~placed, jax.lax.stop_gradient(latest), time), status.astype(jnp.int8)


def as_before(v: Float[Array, " N"], skipped: Bool[Array, " N"]) -> Float[Array, " N"]:
    """Each entry that is skipped as the last one before that is not; 0 without such a one."""
    last = jax.lax.cummax(jnp.where(skipped, -1, jnp.arange(v.shape[0])))
    return jnp.where(last >= 0, v[jnp.maximum(last, 0)], 0)


def no_history(
    status: Int[Array, " N"], skipped: Bool[Array, " N"], folded: Bool[Array, " N"] | None = None
) -> tuple[Bool[Array, " N"], Int[Array, " N"]]:
    """From the first sample without a solution on: which those are, all with its status."""
    failed = ~has_solution(status)
    if folded is not None:
        status = jnp.where(folded & ~failed, PressStatus.PAST_FOLD, status)
        failed = failed | folded
    failed = failed & ~skipped
    lost = jnp.cumsum(failed) > 0
    return lost, jnp.where(lost, status[jnp.argmax(failed)], status).astype(jnp.int8)
