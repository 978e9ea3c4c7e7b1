"""What a fit does where the force relaxes: its press by the time, bounds and starts by the records.

Equations and derivatives are those of `relaxation.filter`.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fitting.parameters import DEFAULTS, Parameter
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.whole_record import ramp_speed
from jaxtrachea.mechanics.equilibrium import Equilibrium
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press import Contact
from jaxtrachea.mechanics.relaxation_parts import (
    Directions,
    relax_parts_with_derivatives,
    way_of,
)
from jaxtrachea.relaxation.filter import Relaxation, relax, relax_with_derivatives
from jaxtrachea.relaxation.laws import LAWS, OF_SKELETON, Span
from jaxtrachea.relaxation.laws import names as names_of
from jaxtrachea.relaxation.steps import Branches
from jaxtrachea.trachea.material import OF_TIME

#: Relaxation times are sought from this share of the shortest step to so many longest records.
SHORTER, LONGER = 1 / 3, 3.0
#: Laws whose branches depend on the span of the records.
_OF_SPAN = ("power",)
#: Ratio of speeds up to which they are the same.
SAME_SPEED = 1.1


def span_of(curves: Sequence[Curve]) -> Span:
    """The shortest step and the longest record, s; each curve has its time."""
    steps, longest = [], 0.0
    for curve in curves:
        assert curve.time is not None
        step = np.diff(curve.time)
        steps.append(float(np.min(step[step > 0], initial=math.inf)))
        longest = max(longest, float(curve.time[-1] - curve.time[0]))
    return Span(min(steps), longest)


def beyond_ramps(curves: Sequence[Curve], speed: float, way: float) -> str:
    """Whether a ramp is faster than all of the records, in words; "" if not.

    It is if it takes less time by more than the step of their samples, and by a tenth.

    Args:
        curves: at least one; each has its time.
        speed: of the ramp, mm/s.
        way: of the ramp, mm.
    """
    times = ((c.time, c.displacement) for c in curves if c.time is not None)
    fastest = max(ramp_speed(*record) for record in times)
    if fastest == 0 or speed <= SAME_SPEED * fastest:
        return ""
    if way / fastest - way / speed <= span_of(curves).shortest:
        return ""
    return f"extrapolated from ramps of at most {fastest:.3g} mm/s"


def with_span(options: Options, span: Span) -> Options:
    """The options with the span of the records: in half decades, where the law reads it.

    Studies alike share programs.
    """
    if options.branches not in _OF_SPAN:
        return options
    low, high = (math.log10(v) * 2 for v in span)
    shortest, longest = math.floor(low + 1e-9) / 2, math.ceil(high - 1e-9) / 2
    return dataclasses.replace(options, shortest=10**shortest, longest=10**longest)


def by_records(
    parameters: Sequence[Parameter], options: Options, span: Span
) -> tuple[Parameter, ...]:
    """The table with times within reach of the records, where the user has not said otherwise.

    Times of branches begin evenly in the logarithm of the time.
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
        name = p.name.removesuffix(OF_SKELETON)
        if p.fixed or name not in begins:
            out.append(p)
            continue
        value, lower, upper = begins[name]
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
    names = names_of(model.options.branches, parts=model.options.relaxation == "parts")
    return jnp.stack([values[name] for name in names])


def _relaxation(model: FitModel, values: dict[str, Array]) -> Relaxation:
    found = model.level.relaxation(values)
    assert found is not None
    return found


def relaxed_value(
    model: FitModel, values: dict[str, Array], time: Float[Array, " N"], elastic: Equilibrium
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Force of a press that relaxes, and the load that its rings follow, N.

    Of a skeleton that softens the force of small strain relaxes (`press_in_time`).

    Args:
        values: every parameter of the trial by name.
        time: s.
        elastic: press.
    """
    branches, lets_go = _relaxation(model, values).local, _lets_go(model)
    if elastic.load is None:
        return relax(time, elastic.force, branches, lets_go)
    force, load = relax(time, elastic.load, branches, lets_go)
    return _ratio(elastic.force, elastic.load) * force, load


def _ratio(force, load):
    """How much less a skeleton that softens bears; 1 without a load."""
    return jnp.where(load == 0, 1, force / jnp.where(load == 0, 1, load))


def relaxed_press(
    model: FitModel, free: Float[Array, " Jf"], value, time: Float[Array, " N"], pressed: Any
) -> Any:
    """A press as its force relaxes, see `relaxed_value`, with its derivatives.

    Args:
        free: free parameters, scaled coordinates.
        value: all parameters in their units.
        time: s.
        pressed: `residual._Pressed` of the elastic level; derivatives by the numbers of the
            relaxation are 0 there.
    """
    of_time = [i for i, p in enumerate(model.free) if p.name in OF_TIME]
    elastic = [i for i, p in enumerate(model.free) if p.name not in OF_TIME]

    def at(free) -> Branches:
        return _relaxation(model, values_of(model, free, value)).local

    def push(tangent):
        return jax.jvp(at, (free,), (tangent,))

    tangents = jnp.asarray(np.eye(len(model.free))[of_time], free.dtype)
    branches, along = jax.vmap(push, out_axes=(None, 0))(tangents)
    columns = pressed.d_load[np.array(elastic, int)]
    softens, load = pressed.load is not pressed.force, pressed.load
    ratio = _ratio(pressed.force, load)
    if pressed.corner is not None:  # linear in the load like its derivatives
        corner = pressed.corner / ratio if softens else pressed.corner
        columns = jnp.concatenate([columns, corner[None]])
    relaxed, slopes = relax_with_derivatives(
        time, pressed.load, columns, branches, _lets_go(model), along,
        surface=pressed.d_joints is not None,
    )  # fmt: skip
    last = len(elastic) + (pressed.corner is not None)
    order = np.argsort([*elastic, *of_time], kind="stable")

    def in_order(v) -> Any:
        return None if v is None else jnp.concatenate([v[: len(elastic)], v[last:]])[order]

    force, d_force = relaxed.force, in_order(slopes.force)
    corner = None if pressed.corner is None else slopes.force[len(elastic)]
    if softens:
        divisor = jnp.where(load == 0, 1, load)[None]
        d_ratio = (pressed.d_force - ratio[None] * pressed.d_load) / divisor
        d_ratio = jnp.where((load == 0)[None], 0, d_ratio)
        d_force = ratio[None] * d_force + d_ratio * force[None]
        force, corner = ratio * force, None if corner is None else ratio * corner
    return pressed._replace(
        force=force, d_force=d_force, load=relaxed.elastic, d_load=in_order(slopes.elastic),
        corner=corner,
    )  # fmt: skip


class Way(NamedTuple):
    """What a press follows from, with derivatives by the Jf free columns in front.

    Attributes:
        moved: of the tool after first touch, mm; (N,).
        compliance: of the skeleton, mm/N.
        contact: law and softening.
    """

    moved: Float[Array, "*Jf N"]
    compliance: Float[Array, "*Jf"]
    contact: Contact


def parts_press(
    model: FitModel, free: Float[Array, " Jf"], value, time, pressed: Any, way: Way, d_way: Way
) -> Any:
    """A press whose local law and skeleton relax apart, with its derivatives.

    Args:
        free: free parameters, scaled coordinates.
        value: all parameters in their units.
        time: s.
        pressed: `residual._Pressed` of the elastic level, of which offset and joints are taken.
        way: of the tool, skeleton and contact.
        d_way: their derivatives.
    """

    def branches(free) -> tuple[Branches, Branches]:
        found = _relaxation(model, values_of(model, free, value))
        local, skeleton = found.local, found.skeleton
        assert skeleton is not None
        return local, skeleton

    def push(tangent):
        return jax.jvp(branches, (free,), (tangent,))

    parts, d_parts = jax.vmap(push, out_axes=(None, 0))(jnp.eye(len(free), dtype=free.dtype))
    law, softening, c = way.contact.law, way.contact.softening, way.compliance
    found, d_force, d_load = relax_parts_with_derivatives(
        time, way.moved, c, law, parts,
        Directions(d_way.moved, d_way.compliance, d_way.contact.law, *d_parts), _lets_go(model),
    )  # fmt: skip
    force, load = found.force, found.load

    def bent(force, load, c, law, softening):
        way = way_of(load, c, law)
        folded = ~jnp.isfinite(way) | softening.past_peak(way)
        return jnp.where(folded, jnp.nan, softening.ratio(jnp.where(folded, 0, way)) * force)

    if softening is not None:
        at = force, load, c, law, softening

        def along(d_force, d_load, *changes):
            return jax.jvp(bent, at, (d_force, d_load, *changes))

        changes = d_way.compliance, d_way.contact.law, d_way.contact.softening
        force, d_force = jax.vmap(along, out_axes=(None, 0))(d_force, d_load, *changes)
    return pressed._replace(force=force, d_force=d_force, load=load, d_load=d_load, corner=None)


def _lets_go(model: FitModel) -> bool:
    return model.options.contact == "unilateral"
