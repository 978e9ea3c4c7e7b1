"""What a study gets where the displacement at first touch is fitted, or the zero of the force.

Steps as large as the presses, a rounded corner for each curve, bounds within reach of the samples.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.lanes import Taken, takes
from jaxtrachea.fitting.parameters import DEFAULTS, OF_THE_PRESS, Parameter
from jaxtrachea.measurements.first_touch import FirstTouch, blend_widths, first_touch
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options


def natural_steps(
    parameters: Sequence[Parameter],
    curves: Sequence[Curve],
    recorded: Taken | None = None,
    taken: Taken | None = None,
) -> tuple[Parameter, ...]:
    """The table with the steps of a free onset, offset and slope as large as the presses.

    A power of ten, not above the median over the curves that have one: studies alike share compiled
    programs. Where records show one, over these alone: what fits take beyond does not change it.

    Args:
        recorded: what each curve takes by its own record; None: all.
        taken: what it takes at all, where no record shows one.
    """

    def scaled(p: Parameter) -> Parameter:
        if p.fixed or p.name not in OF_THE_PRESS or p.step != DEFAULTS[p.name].step:
            return p
        own = [c for c in curves if takes(p, c, recorded)] or [
            c for c in curves if takes(p, c, taken)
        ]
        span, peak = (
            np.median([np.ptp(c.displacement) for c in own]),
            np.median([np.max(np.abs(c.force)) for c in own]),
        )
        size = float({"onset": span, "force_offset": peak}.get(p.name, peak / max(span, 1e-300)))
        step = 10.0 ** math.floor(math.log10(size)) if size > 0 else p.step
        return dataclasses.replace(p, step=step)

    return tuple(map(scaled, parameters))


def onset_is_sought(parameters: Sequence[Parameter], options: Options) -> bool:
    """Whether the displacement at first touch is fitted, and is a corner of the curves."""
    free = any(p.name == "onset" and not p.fixed for p in parameters)
    return free and options.contact == "unilateral"


def touches(
    lanes: Lane,
    parameters: Sequence[Parameter],
    slope: Float[np.ndarray, "lanes T"] | None = None,
) -> FirstTouch:
    """Change point of every trial with an onset or an offset, see `first_touch`; (lanes, T) each.

    NaN of others. Of a whole record the first loading shows it. `slope`: of the force without
    contact, which is taken off, N/mm; NaN: 0.
    """
    shape, samples = lanes.s_c.shape, lanes.force.shape[-1]
    precision = lanes.precision if lanes.rising is None else lanes.precision * lanes.rising
    displacement, force, precision = (
        np.reshape(v, (-1, samples)) for v in (lanes.displacement, lanes.force, precision)
    )
    without = np.zeros(shape) if slope is None else np.nan_to_num(slope)
    column = {p.name: j for j, p in enumerate(parameters)}
    index = np.asarray(lanes.index).reshape(-1, len(parameters))
    own = index[:, column["force_offset"]] >= 0
    held = (index[:, column["onset"]] >= 0) & ~own
    out = [np.full(len(force), np.nan) for _ in FirstTouch._fields]
    for rows, known in ((np.flatnonzero(own), None), (np.flatnonzero(held), "force_offset")):
        if len(rows):
            offset = None
            if known is not None:
                offset = np.full(len(rows), parameters[column[known]].value)
            way = displacement[rows]
            rest = force[rows] - without.reshape(-1, 1)[rows] * way
            found = first_touch(way, rest, precision[rows] > 0, offset)
            for whole, part in zip(out, found, strict=True):
                whole[rows] = part
    return FirstTouch(*(v.reshape(shape) for v in out))


def first_touches(
    lanes: Lane,
    parameters: Sequence[Parameter],
    value: Float[np.ndarray, "lanes P"] | None = None,
) -> Float[np.ndarray, "lanes T"]:
    """Displacement at first touch of every trial, mm, from which depths are counted.

    The number at which it is held, or its estimate.

    Args:
        value: estimates in the parameters' units; None: the first guess in their place.
    """
    column = next(j for j, p in enumerate(parameters) if p.name == "onset")
    known, index = np.asarray(lanes.value)[:, :, column], np.asarray(lanes.index)[:, :, column]
    if value is None or not value.size:
        return known
    found = np.take_along_axis(value, np.maximum(index, 0), axis=1)
    return np.where(index >= 0, found, known)


def counted_from(parameters: Sequence[Parameter]) -> str:
    """What a depth in a message is counted from, in words; "" where records begin at first touch.

    That is where the onset is held at 0.
    """
    onset = next(p for p in parameters if p.name == "onset")
    return "" if onset.fixed and onset.value == 0 else " from first touch"


def blends(
    touch: FirstTouch,
    curves: Sequence[Sequence[Curve]],
    sigma_force: float | None,
    options: Options,
) -> Float[np.ndarray, "lanes T"]:
    """Width of the rounded corner of every trial, mm.

    Args:
        touch: from `touches`.
        curves: of each lane.
        sigma_force: given standard deviation, N; a curve's own comes before it; None: estimated.
        options: `onset_width` is the least width.
    """
    given = np.full(touch.onset.shape, np.nan)
    for row, lane in zip(given, curves, strict=True):
        sigma = [sigma_force if c.sigma is None else np.median(c.sigma) for c in lane]
        row[: len(lane)] = [np.nan if v is None else v for v in sigma]
    return blend_widths(touch, given, options.onset_width)


def where_sought(
    p: Parameter, parameters: Sequence[Parameter], options: Options
) -> tuple[str, str]:
    """Initial value and bounds of a free parameter in words, as the fit has them.

    An onset or offset without an initial value starts where its curve shows it, and an onset
    without bounds has those of `within_reach`.
    """
    initial, bounds = f"{p.value:g}", f"{p.lower:g} … {p.upper:g}"
    if p.name not in OF_THE_PRESS or p.scale == "log":
        return initial, bounds
    usual = DEFAULTS[p.name]
    if options.contact == "unilateral" and p.value == usual.value:
        initial = "change point of the curve" if p.name == "onset" else "force before first touch"
    near = p.name == "onset" and onset_is_sought(parameters, options)
    if near and (p.lower, p.upper) == (usual.lower, usual.upper):
        bounds = "from its samples"
    return initial, bounds


def within_reach(lanes: Lane, parameters: Sequence[Parameter]) -> Lane:
    """Lanes whose onset, where its bounds are the default, lies within reach of the samples.

    From one range of displacement before the first sample to the last one. A curve that does not
    show its first touch is otherwise fitted with one anywhere before it.
    """
    column = next(j for j, p in enumerate(parameters) if p.name == "onset")
    p, usual = parameters[column], DEFAULTS["onset"]
    if p.scale != "linear" or (p.lower, p.upper) != (usual.lower, usual.upper):
        return lanes
    seen = lanes.precision > 0
    first = np.min(lanes.displacement, axis=2, where=seen, initial=np.inf)
    last = np.max(lanes.displacement, axis=2, where=seen, initial=-np.inf)
    lower, upper = lanes.lower.copy(), lanes.upper.copy()
    for lane, row in enumerate(lanes.index[:, :, column]):
        for i in np.unique(row[row >= 0]):
            low, high = np.min(first[lane][row == i]), np.max(last[lane][row == i])
            if high > low:
                lower[lane, i] = max(lower[lane, i], p.to_scaled(min(2 * low - high, p.value)))
                upper[lane, i] = min(upper[lane, i], p.to_scaled(max(high, p.value)))
    return lanes._replace(lower=lower, upper=upper)
