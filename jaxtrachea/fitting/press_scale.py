"""Unknowns that are measured against the press: where it first touches, and the zero of the force.

A stiffness has a relative error; an onset of 0.001 mm or an offset of 0.002 N has none that means
anything. What counts there is the press: its range of displacement, its largest force. The same
sizes are the steps in which the solver moves them, so that an offset of 20 N is not 200 steps away.
"""

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.onset import touches
from jaxtrachea.fitting.parameters import DEFAULTS, OF_THE_PRESS
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.first_touch import FirstTouch

#: Half the width in which starts are drawn around a change point, of the press.
_REACH = 0.1


def sizes_of_press(study: Study) -> Float[np.ndarray, "lanes P"]:
    """Range of displacement (onset) and largest force (offset) of the presses that read an unknown.

    In scaled coordinates; NaN for all other unknowns, and where no sample is seen.
    """
    out = np.full(study.lanes.lower.shape, np.nan)
    columns = _columns(study)
    if not columns:
        return out
    seen = np.asarray(study.lanes.precision) > 0

    def ends(v):
        low = np.min(v, axis=2, where=seen, initial=np.inf)
        return low, np.max(v, axis=2, where=seen, initial=-np.inf)

    low, high = ends(np.asarray(study.lanes.displacement))
    span = high - low
    low, high = ends(np.asarray(study.lanes.force))
    peak = np.maximum(high, -low)
    slope = peak / np.where(span > 0, span, np.nan)
    sizes_of = {"onset": span, "force_offset": peak, "force_slope": slope}
    for name, column, step in columns:
        size = _of_unknowns(study, column, sizes_of[name] / step)
        out = np.where(size > 0, size, out)
    return out


def relative_change(
    study: Study, theta: Float[np.ndarray, "lanes P"]
) -> Float[np.ndarray, "lanes P"]:
    """Change of each scaled coordinate that counts as a relative change of 1.

    With scale `log` 1; for an onset or an offset the size of the press; else the value itself.
    """
    log = study.of_unknowns(lambda p: p.scale == "log", False)
    size = sizes_of_press(study)
    linear = np.where(np.isnan(size), np.maximum(np.abs(theta), 1e-3), size)
    return np.where(log, 1.0, linear)


def around_touch(study: Study, guess, low, high, decades: float):
    """The box of starts with onset and offset where the change point of each curve has them.

    Args:
        guess: first start, scaled coordinates; (lanes, P).
        low: lower end of the box; (lanes, P).
        high: (lanes, P).
        decades: 1: a tenth of the press to each side.

    Returns:
        `guess`, `low` and `high` anew; a guess that the user gave stays, and is in the box.
    """
    columns = _columns(study)
    if not columns or study.model.options.contact != "unilateral":
        return guess, low, high
    shown = study.record_zeros
    found = touches(study.lanes, study.parameters, None if shown is None else shown[..., 2])
    for name, column, step in columns:
        parameter = study.parameters[column]
        if parameter.scale == "log":
            continue
        estimate = _estimate(found, name)
        if shown is not None:
            own = shown[..., OF_THE_PRESS.index(name)]
            estimate = np.where(np.isnan(own), estimate, own)
        at = _of_unknowns(study, column, estimate / step, middle=True)
        size = {"onset": found.span, "force_offset": found.peak}.get(name, found.peak / found.span)
        reach = decades * _REACH * _of_unknowns(study, column, size / step)
        known = np.isfinite(at) & np.isfinite(reach)
        start = at if parameter.value == DEFAULTS[name].value else guess
        low = np.where(known, np.minimum(at - reach, start), low)
        high = np.where(known, np.maximum(at + reach, start), high)
        guess = np.where(known, start, guess)

    def inside(v):
        return np.clip(v, study.lanes.lower, study.lanes.upper)

    return inside(guess), inside(low), inside(high)


def _columns(study: Study) -> list[tuple[str, int, float]]:
    """Name, column and step of the free parameters that are measured against the press."""
    return [
        (p.name, j, p.step)
        for j, p in enumerate(study.parameters)
        if not p.fixed and p.name in OF_THE_PRESS
    ]


def _estimate(found: FirstTouch, name: str) -> Float[np.ndarray, "lanes T"]:
    if name == "force_slope":
        return np.zeros_like(found.onset)
    return found.onset if name == "onset" else found.force_offset


def _of_unknowns(study: Study, column: int, of_trial, *, middle: bool = False):
    """A number of the trials that read each unknown of a column: the largest, or the median."""
    index = study.lanes.index[:, :, column]
    out = np.full(study.lanes.lower.shape, np.nan)
    for lane, row in enumerate(index):
        for i in np.unique(row[row >= 0]):
            values = of_trial[lane][row == i]
            values = values[np.isfinite(values)]
            if len(values):
                out[lane, i] = np.median(values) if middle else np.max(values)
    return out
