"""What a fit does where the force relaxes: its press by the time, bounds and starts by the records.

Equations and derivatives are those of `mechanics.relaxation`.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fitting.parameters import DEFAULTS, Parameter
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.levels.relaxing import ANY_SPAN
from jaxtrachea.mechanics.relaxation import Branches, relax, relax_with_derivatives
from jaxtrachea.mechanics.relaxation_laws import LAWS, Span
from jaxtrachea.trachea.material import OF_TIME

#: Relaxation times are sought from this share of the shortest step to so many longest records.
SHORTER, LONGER = 1 / 3, 3.0
#: Laws whose branches depend on the span of the records.
_OF_SPAN = ("power",)


def span_of(curves: Sequence[Curve]) -> Span:
    """The shortest step and the longest record, s; each curve has its time."""
    steps, longest = [], 0.0
    for curve in curves:
        assert curve.time is not None
        step = np.diff(curve.time)
        steps.append(float(np.min(step[step > 0], initial=math.inf)))
        longest = max(longest, float(curve.time[-1] - curve.time[0]))
    return Span(min(steps), longest)


def static_span(options: Options, span: Span) -> Span:
    """The span that chooses the program: in half decades, and only where a law reads it."""
    if options.branches not in _OF_SPAN:
        return ANY_SPAN
    low, high = (math.log10(v) * 2 for v in span)
    return Span(10 ** (math.floor(low + 1e-9) / 2), 10 ** (math.ceil(high - 1e-9) / 2))


def by_records(
    parameters: Sequence[Parameter], options: Options, span: Span
) -> tuple[Parameter, ...]:
    """The table with times within reach of the records, where the user has not said otherwise.

    Times of branches begin evenly in the logarithm of the time.

    Args:
        parameters: the table.
        options: of the model.
        span: of the records.
    """
    count = sum(name.startswith("tau") for name in LAWS[options.branches].names)
    ratio = span.longest / span.shortest
    low, high = SHORTER * span.shortest, LONGER * span.longest
    between = max(ratio ** (1 / max(count, 1)), 2.5)
    begins = {
        "tau_1": (span.shortest * ratio ** (0.5 / max(count, 1)), low, high),
        "tau_2": (high / LONGER, low, high),
        **{f"tau_ratio_{b}": (between, 2.0, max(high / low, 10.0)) for b in range(2, 5)},
    }
    out = []
    for p in parameters:
        usual = DEFAULTS[p.name]
        if p.fixed or p.name not in begins:
            out.append(p)
            continue
        value, lower, upper = begins[p.name]
        bounds = {} if (p.lower, p.upper) != (usual.lower, usual.upper) else {
            "lower": min(lower, value), "upper": max(upper, value),
        }  # fmt: skip
        if p.value == usual.value:
            least, most = bounds.get("lower", p.lower), bounds.get("upper", p.upper)
            bounds["value"] = min(max(value, least), most)
        elif bounds:
            bounds = {"lower": min(lower, p.value), "upper": max(upper, p.value)}
        out.append(dataclasses.replace(p, **bounds))
    return tuple(out)


def numbers(model: FitModel, values: dict[str, Array]) -> Float[Array, " K"]:
    """Numbers of the law of relaxation, of the values of one trial."""
    return jnp.stack([values[name] for name in LAWS[model.options.branches].names])


def relaxed_value(
    model: FitModel, values: dict[str, Array], time: Float[Array, " N"], force, load
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Force of a press that relaxes, and the load that its rings follow, N.

    Args:
        model: what is fitted (static).
        values: every parameter of the trial by name.
        time: s.
        force: of the elastic level.
        load: that the rings would follow there.
    """
    branches = model.level.branches(values)
    assert branches is not None
    relaxed = relax(time, force, branches, _lets_go(model))
    return relaxed.force, jnp.where(relaxed.elastic == force, load, relaxed.elastic)


def relaxed_press(
    model: FitModel, free: Float[Array, " Jf"], value, time: Float[Array, " N"], pressed: Any
) -> Any:
    """A press as its force relaxes: `residual.Pressed` anew, with its derivatives.

    Args:
        model: what is fitted (static).
        free: free parameters, scaled coordinates.
        value: all parameters in their units.
        time: s.
        pressed: of the elastic level; derivatives by the numbers of the relaxation are 0 there.
    """
    of_time = [i for i, p in enumerate(model.free) if p.name in OF_TIME]
    elastic = [i for i, p in enumerate(model.free) if p.name not in OF_TIME]

    def at(free) -> Branches:
        found = model.level.branches(values_of(model, free, value))
        assert found is not None
        return found

    def push(tangent):
        return jax.jvp(at, (free,), (tangent,))

    tangents = jnp.asarray(np.eye(len(model.free))[of_time], free.dtype)
    branches, along = jax.vmap(push, out_axes=(None, 0))(tangents)
    columns = pressed.d_force[np.array(elastic, int)]
    if pressed.corner is not None:  # linear in the force like its derivatives
        columns = jnp.concatenate([columns, pressed.corner[None]])
    marked = pressed.d_joints is not None
    relaxed, slopes = relax_with_derivatives(
        time, pressed.force, columns, branches, _lets_go(model), along, surface=marked
    )
    last = len(elastic) + (pressed.corner is not None)
    order = np.argsort([*elastic, *of_time], kind="stable")

    def in_order(v):
        return jnp.concatenate([v[: len(elastic)], v[last:]])[order]

    load, d_load = pressed.load, pressed.d_load
    if marked:
        left = relaxed.elastic != pressed.force
        load = jnp.where(left, relaxed.elastic, load)
        assert slopes.elastic is not None
        d_load = jnp.where(left[None], in_order(slopes.elastic), d_load)
    return pressed._replace(
        force=relaxed.force, d_force=in_order(slopes.force), load=load, d_load=d_load,
        corner=None if pressed.corner is None else slopes.force[len(elastic)],
    )  # fmt: skip


def _lets_go(model: FitModel) -> bool:
    return model.options.contact == "unilateral"
