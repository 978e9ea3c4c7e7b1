"""A lane: the arrays of all that is fitted together, and what of them is observed.

The residual of a trial is one row: the force, other numbers of a sample, then what rings show, in
the order of `FITTED`. What is not in `Lane.others` is not in the row.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea.measurements.observed import FITTED


class Seen(NamedTuple):
    """Values of one kind of observation in its unit, and the precision of each."""

    data: Any
    precision: Any


class Lane(NamedTuple):
    """Everything of one lane (or, with a leading axis, of many); T trials of N samples.

    `index` says for each trial and free column which unknown it reads (-1: keeps `value`). Weights
    are square roots of what multiplies a squared residual; zero marks padding and missing samples.

    Attributes:
        s_c: contact position, mm; (T,).
        displacement: mm; (T, N).
        force: N; (T, N).
        precision: 1 / sigma of each force sample, or 1 where the noise is estimated; (T, N).
        others: what is observed beside the force, by field of `Response` (`FITTED`), (T, N) and
            the shape of a sample, see there; what no curve has is not in it.
        balance: weight of each trial against the others; (T,).
        blend: smooth first touch of each trial, mm, see `first_touch`; (T,); None where no onset is
            fitted.
        value: value of every model parameter, used where it is not free; (T, J).
        index: (T, J).
        lower: bounds of the unknowns in scaled coordinates; (P,).
        upper: (P,).
        active: whether the unknown exists in this lane; (P,).
        time: of every sample, s, from the first on; (T, N); padding repeats the last. None: the
            model has no time.
        rising: which samples are of the first loading, 1 or 0; (T, N); with `time`.
        phi_c: contact angle, rad; (T,); None where all trials of the study press along the normal
            on the midline.
        direction: of the tool along the inward normal and the circumference; (T, 2); with `phi_c`.
    """

    s_c: Float[Array, "*l T"]
    displacement: Float[Array, "*l T N"]
    force: Float[Array, "*l T N"]
    precision: Float[Array, "*l T N"]
    others: dict[str, Seen]
    balance: Float[Array, "*l T"]
    blend: Float[Array, "*l T"] | None
    value: Float[Array, "*l T J"]
    index: Int[Array, "*l T J"]
    lower: Float[Array, "*l P"]
    upper: Float[Array, "*l P"]
    active: Float[Array, "*l P"]
    time: Float[Array, "*l T N"] | None = None
    rising: Float[Array, "*l T N"] | None = None
    phi_c: Float[Array, "*l T"] | None = None
    direction: Float[Array, "*l T 2"] | None = None


class Observed(NamedTuple):
    """One kind of observation of a lane, or of many.

    Attributes:
        name: field of the `Lane`.
        data: in N or mm.
        precision: of the same shape.
        places: how many entries a sample has (static): 1, the rings, or four times the rings.
    """

    name: str
    data: Any
    precision: Any
    places: int


def forces(lane: Lane) -> list[Observed]:
    """Forces that a lane observes, in the order of the residual's row."""
    force = Observed("force", lane.force, lane.precision, 1)
    return [force, *_others(lane, of_rings=False)]


def markers(lane: Lane) -> list[Observed]:
    """Motions of rings that a lane may observe, likewise."""
    return _others(lane, of_rings=True)


def _others(lane: Lane, *, of_rings: bool) -> list[Observed]:
    axes, out = lane.force.ndim, []
    for name, parts in FITTED.items():
        if name in lane.others and (parts[0].rings is not None) == of_rings:
            data, precision = lane.others[name]
            out.append(Observed(name, data, precision, math.prod(data.shape[axes:])))
    return out


def with_observed(
    lane: Lane, data: Mapping[str, Any] | None = None, precision: Mapping[str, Any] | None = None
) -> Lane:
    """The lane, or lanes, with other values or precisions of some kinds, by name."""
    data, precision = dict(data or {}), dict(precision or {})
    own = {"force": data.pop("force", lane.force)}
    own["precision"] = precision.pop("force", lane.precision)
    others = {
        name: Seen(data.get(name, seen.data), precision.get(name, seen.precision))
        for name, seen in lane.others.items()
    }
    return lane._replace(others=others, **own)


def peaks(kinds: list[Observed]) -> Float[np.ndarray, " lanes"]:
    """Largest size of an observation of these kinds, N or mm, of every lane; numpy.

    0 without observations; NaN where one is NaN.
    """
    flat = [kind.data.reshape(len(kind.data), -1) for kind in kinds]
    # Not of the absolute values: these would be another array of all observations.
    ends = [(v.max(axis=1, initial=0), -v.min(axis=1, initial=0)) for v in flat]
    return np.max(ends, axis=(0, 1))


def force_entries(lane: Lane) -> int:
    """Entries of the residual of a trial that are forces (static); they come first."""
    return lane.force.shape[-1] * len(forces(lane))


def size(lane: Lane) -> int:
    """Entries of the residual per trial (static)."""
    return lane.force.shape[-1] * sum(kind.places for kind in forces(lane) + markers(lane))


def observations(lane: Lane) -> tuple[Float[Array, "*l T m"], int]:
    """Which entries of the residual are observed (1 or 0), and how many of them are forces."""
    return (precisions(lane) > 0).astype(lane.force.dtype), force_entries(lane)


def precisions(lane: Lane) -> Float[Array, "*l T m"]:
    """Precision of every entry of the residual."""
    rows = lane.force.shape[:-1]
    kinds = forces(lane) + markers(lane)
    return jnp.concatenate([kind.precision.reshape(*rows, -1) for kind in kinds], axis=-1)


def weighted(v: Float[Array, "*n"], precision: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Observed entries over their standard deviation, exact zeros elsewhere."""
    return jnp.where(precision > 0, v, 0) * precision


def data_weight(lane: Lane, sigma: Any) -> Any:
    """Half the weighted sum of squares of measured forces, of one lane or many; numpy or JAX.

    Args:
        lane: without or with leading axes.
        sigma: of force and markers in units of the lane's precision; (*leading axes, 2).
    """
    weight = lane.balance[..., None] / sigma[..., :1, None]
    parts = [kind.data * kind.precision * weight for kind in forces(lane)]
    return 0.5 * sum((z * z).sum(axis=(-2, -1)) for z in parts)


def without_data(lane: Lane, hidden: Any) -> Lane:
    """The lane, or lanes, with the trials `hidden` (of the shape of `s_c`) unobserved; numpy."""
    blind = {}
    for kind in forces(lane) + markers(lane):
        over = hidden.reshape(*hidden.shape, *[1] * (kind.precision.ndim - hidden.ndim))
        blind[kind.name] = np.where(over, 0, kind.precision)
    return with_observed(lane, precision=blind)
