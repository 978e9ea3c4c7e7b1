"""Model minus data of a lane whose level has no closed form: `Level.response`, trial by trial.

Every trial is pressed along its own path, on a CPU one after the other: called alone, parts of a
step are a kernel each, and no path waits for a longer one. The Jacobian is that of the equilibria
by the free columns, in forward mode: one path for all columns. A sample without equilibrium is NaN,
which makes the cost infinite wherever that sample is observed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.lane import Lane, forces, markers, weighted
from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fusion import one_by_one
from jaxtrachea.mechanics.levels.level import Motion, Response
from jaxtrachea.mechanics.validation import has_solution
from jaxtrachea.trachea.geometry import Geometry


@full_precision
def answer(
    model: FitModel,
    free: Float[Array, " Jf"],
    value: Float[Array, " J"],
    motion: Motion,
    tube: Geometry,
) -> Response:
    """What the model shows in one trial, its force as the load cell records it.

    Args:
        free: free parameters, scaled coordinates.
        value: all parameters in their units, used where they are not free.
        motion: of the tool; its onset is that of the parameters.
    """
    values = values_of(model, free, value)
    moved = motion._replace(onset=values["onset"])
    found = model.level.response(tube, model.level.material(values), moved)
    force = found.force + values["force_offset"]
    if "force_slope" in values:
        force = force + values["force_slope"] * motion.displacement
    return found._replace(force=force)


def residual(
    model: FitModel, free: Float[Array, "T Jf"], trials: Lane, tube: Geometry
) -> tuple[Float[Array, "T m"], Float[Array, "T Jf m"]]:
    """Whitened differences of all trials, and their derivative by the free columns.

    Args:
        free: of every trial, scaled coordinates.
        trials: the arrays of a lane that have a trial axis.
    """
    eye = jnp.eye(free.shape[1], dtype=free.dtype)

    def one(free, trial):
        def push(tangent):
            return jax.jvp(lambda free: _seen(model, free, trial, tube), (free,), (tangent,))

        seen, slopes = jax.vmap(push, out_axes=(None, 0))(eye)
        return _row(seen, trial), jax.vmap(lambda slope: _whitened(slope, trial))(slopes)

    return one_by_one(one, free, trials)


def residual_value(
    model: FitModel, free: Float[Array, "T Jf"], trials: Lane, tube: Geometry
) -> Float[Array, "T m"]:
    """`residual` without its Jacobian."""

    def one(free, trial):
        return _row(_seen(model, free, trial, tube), trial)

    return one_by_one(one, free, trials)


def force_jacobian(
    model: FitModel,
    free: Float[Array, " Jf"],
    value: Float[Array, " J"],
    motion: Motion,
    tube: Geometry,
    names: tuple[str, ...],
) -> Float[Array, "Jf m"]:
    """Derivative of the force, and of `names`, by the free columns, of a press without data.

    Of one after the other. NaN at samples without equilibrium, and too deep.
    """

    def at(free):
        found = answer(model, free, value, motion, tube)
        seen = [found.force, *(getattr(found, name) for name in names)]
        return jnp.concatenate(seen), jnp.concatenate([found.status] * len(seen))

    def push(tangent):
        _, slope, status = jax.jvp(at, (free,), (tangent,), has_aux=True)
        return jnp.where(has_solution(status), slope, jnp.nan)

    return jax.vmap(push)(jnp.eye(free.shape[0], dtype=free.dtype))


def _seen(model: FitModel, free, trial: Lane, tube: Geometry) -> list[Array]:
    """What the model shows of every kind of observation of a trial, in the order of the row.

    Samples that nothing observes are not pressed, but where the force relaxes: the tool stays at
    rest.
    """
    kinds = forces(trial) + markers(trial)
    looked = jnp.any(
        jnp.stack([(k.precision > 0).reshape(len(trial.force), -1).any(1) for k in kinds]), axis=0
    )
    onset = values_of(model, free, trial.value)["onset"]
    D = jnp.where(looked, trial.displacement, onset)
    D = D if trial.time is None else trial.displacement  # what follows remembers it
    motion = Motion(
        trial.s_c, D, blend=trial.blend, phi_c=trial.phi_c, direction=trial.direction,
        time=trial.time,
    )  # fmt: skip
    found = answer(model, free, trial.value, motion, tube)
    return [getattr(found, kind.name) for kind in kinds]


def _row(seen: list[Array], trial: Lane) -> Float[Array, " m"]:
    """Differences to the data over their standard deviation."""
    kinds = forces(trial) + markers(trial)
    return _whitened([v - kind.data for v, kind in zip(seen, kinds, strict=True)], trial)


def _whitened(parts: list[Array], trial: Lane) -> Float[Array, " m"]:
    """Observed entries over their standard deviation in one row."""
    kinds = forces(trial) + markers(trial)
    rows = [weighted(v, kind.precision).ravel() for v, kind in zip(parts, kinds, strict=True)]
    return jnp.concatenate(rows)
