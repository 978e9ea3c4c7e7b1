"""The checks of many curves at once, on whole arrays.

Most curves of a study only rise: every sample is used and no check finds anything. These a few
reductions over all samples tell; every other curve goes through `checks.finish` by itself, which
alone writes messages and cuts records. What comes out is the same, bit by bit.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxtrachea.measurements.checks import MIN_CORRELATION, finish, position
from jaxtrachea.measurements.curve import BadCurve, Curve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.holds import rises_evenly
from jaxtrachea.measurements.observed import FURTHER_FIELDS
from jaxtrachea.measurements.parts import Segment
from jaxtrachea.measurements.plausible import implausible_extent
from jaxtrachea.measurements.record_faults import suspicious
from jaxtrachea.measurements.usage import Usage
from jaxtrachea.measurements.vectors import (
    check_vector_shapes,
    check_vector_sizes,
    unit_direction,
    vectors_of,
)
from jaxtrachea.measurements.whole_record import SPEEDS, speed_of

#: Samples that are looked at together: their arrays stay in the cache of a processor.
BLOCK = 2**17
#: Correlation of force and displacement is rounded otherwise here; nearer to its limit than this,
#: the curve is looked at by itself.
_MARGIN = 0.1


def finish_all(
    records: Sequence[RawCurve | BadCurve], options: ReadOptions
) -> list[Curve | BadCurve]:
    """Turn what a reader found into usable curves, or into reasons why they are none.

    Args:
        records: curves as read, in mm, N, rad; what is bad already stays as it is.
        options: signs, loading rule, window and limits.
    """
    done: list[Curve | BadCurve | None] = [None] * len(records)
    # Noise of the force is one of the displacement then; a whole record has its own way.
    if options.compliance_mm_N > 0 or options.loading == "record":
        return [r if isinstance(r, BadCurve) else finish(r, options) for r in records]
    common = (options.s_mm, options.phi_rad)
    for picked in _blocks(records):
        raws = [record for i in picked if isinstance(record := records[i], RawCurve)]
        block = _measured(raws, options)
        for k in np.flatnonzero(block.plain).tolist():
            done[picked[k]] = _curve(raws[k], block, k, common, options)
    for i, record in enumerate(records):
        if done[i] is None:
            done[i] = record if isinstance(record, BadCurve) else finish(record, options)
    return [curve for curve in done if curve is not None]


def _blocks(records: Sequence[RawCurve | BadCurve]) -> Iterator[list[int]]:
    """Places of the curves whose arrays can stand end to end, some at a time."""
    picked, count = [], 0
    for i, record in enumerate(records):
        if isinstance(record, BadCurve) or not _stackable(record):
            continue
        picked.append(i)
        count += record.displacement.size
        if count >= BLOCK:
            yield picked
            picked, count = [], 0
    if picked:
        yield picked


def _stackable(raw: RawCurve) -> bool:
    """Whether there are two samples or more, of one number each, in arrays of one length."""
    first = raw.displacement
    if first.ndim != 1 or first.size < 2:
        return False
    return all(
        values is None or (values.shape == first.shape and values.dtype == np.float64)
        for values in (first, raw.force, raw.sigma, raw.time)
    )


class _Block(NamedTuple):
    """Curves end to end, and what was measured of each of them.

    Attributes:
        displacement: (S,) mm, with the sign of the options.
        force: (S,) N, likewise.
        edges: (C + 1,) first sample of each curve, and the end of the last.
        plain: (C,) curves that only rise and pass all checks of these arrays.
        low, high: (C,) smallest and largest displacement, mm.
        peak: (C,) range of the force, N.
    """

    displacement: np.ndarray
    force: np.ndarray
    edges: list[int]
    plain: np.ndarray
    low: list[float]
    high: list[float]
    peak: list[float]


def _measured(raws: Sequence[RawCurve], options: ReadOptions) -> _Block:
    sizes = np.array([raw.displacement.size for raw in raws])
    edges = np.concatenate([[0], np.cumsum(sizes)])
    starts = edges[:-1]
    displacement = options.displacement_sign * np.concatenate([raw.displacement for raw in raws])
    force = options.force_sign * np.concatenate([raw.force for raw in raws])
    with np.errstate(all="ignore"):  # what is not finite is no plain curve
        low, high = _range(displacement, starts)
        least, most = _range(force, starts)
        extent, peak = high - low, most - least
        plain = _within(low, high, options.max_displacement)
        plain &= _within(least, most, options.max_force)
        plain &= (sizes >= options.min_points) & (extent >= options.min_range) & (peak > 0)
        if options.displacement_min is not None:
            plain &= low >= options.displacement_min
        if options.displacement_max is not None:
            plain &= high <= options.displacement_max
        # A record that nowhere falls is a press: it begins at its lowest.
        plain &= _rises(displacement, edges) & rises_evenly(displacement, edges)
        plain &= _along(displacement, force, edges) >= MIN_CORRELATION + _MARGIN
        plain &= _noise_is_sound(raws, edges) & _time_is_even(raws, edges)
        plain &= ~suspicious(force, edges)
    lists = (low.tolist(), high.tolist(), peak.tolist())
    return _Block(displacement, force, edges.tolist(), plain, *lists)


def _range(values: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest value of each curve, NaN if any is."""
    return np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)


def _within(low: np.ndarray, high: np.ndarray, limit: float) -> np.ndarray:
    """Whether all values of a curve are finite and at most so large."""
    return (low >= -limit) & (high <= limit)


def _rises(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Whether each curve nowhere falls."""
    rising = np.ones(values.shape, bool)
    rising[:-1] = values[1:] >= values[:-1]
    rising[edges[1:] - 1] = True  # the next sample is another curve's
    return np.logical_and.reduceat(rising, edges[:-1])


def _along(displacement: np.ndarray, force: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Correlation of force and displacement of each curve."""
    starts, sizes = edges[:-1], np.diff(edges)
    centred = []
    for values in (displacement, force):
        mean = np.add.reduceat(values, starts) / sizes
        low, high = _range(values, starts)
        centred.append((values - np.repeat(mean, sizes)) / np.repeat(high - low, sizes))
    d, f = centred
    products = (np.add.reduceat(a * b, starts) for a, b in ((d, f), (d, d), (f, f)))
    both, first, second = products
    return both / np.sqrt(first * second)


def _stacked(raws: Sequence[RawCurve], name: str, filler: np.ndarray) -> np.ndarray | None:
    """A quantity that some curves have, end to end, `filler` for the others; None: none has it."""
    kept = [getattr(raw, name) for raw in raws]
    if all(values is None for values in kept):
        return None
    sizes = (raw.displacement.size for raw in raws)
    return np.concatenate(
        [filler[:n] if v is None else v for v, n in zip(kept, sizes, strict=True)]
    )


def _noise_is_sound(raws: Sequence[RawCurve], edges: np.ndarray) -> np.ndarray:
    """Whether the standard deviations of each curve are positive and finite."""
    sigma = _stacked(raws, "sigma", np.ones(np.diff(edges).max()))
    if sigma is None:
        return np.ones(len(raws), bool)
    low, high = _range(sigma, edges[:-1])
    return (low > 0) & (high < np.inf)


def _time_is_even(raws: Sequence[RawCurve], edges: np.ndarray) -> np.ndarray:
    """Whether samples of each curve follow each other in about equal times, or in no time."""
    time = _stacked(raws, "time", np.arange(float(np.diff(edges).max())))
    if time is None:
        return np.ones(len(raws), bool)
    starts, ends = edges[:-1], edges[1:] - 1
    steps = np.zeros(time.shape)
    steps[:-1] = time[1:] - time[:-1]
    steps[ends] = 0.0
    lapse = time[ends] - time[starts]
    even = np.maximum.reduceat(steps, starts) * (ends - starts) <= 2 * lapse
    finite = np.logical_and.reduceat(np.isfinite(time), starts)
    return finite & _rises(time, edges) & (even | ~(lapse > 0))


def _curve(
    raw: RawCurve,
    block: _Block,
    k: int,
    common: tuple[float | None, float | None],
    options: ReadOptions,
) -> Curve | None:
    """The curve of a plain record; None if its position, direction, vectors or speed are odd."""
    some = any(getattr(raw, name) is not None for name in FURTHER_FIELDS)
    start, stop = block.edges[k : k + 2]
    size = stop - start
    try:
        if some:
            check_vector_shapes(raw)
            check_vector_sizes(raw, options)
        s_c = position("s", raw.s, common[0], "mm")
        phi_c = position("phi", raw.phi, common[1], "rad") or 0.0
        direction = (1.0, 0.0) if raw.direction == (1.0, 0.0) else unit_direction(raw)
    except Fault:
        return None
    if abs(phi_c) > 2 * math.pi:
        return None
    speed = 0.0 if raw.time is None else speed_of(raw.time, block.displacement[start:stop])
    if speed > 0 and not SPEEDS[0] <= speed <= SPEEDS[1]:
        return None
    low, high = block.low[k], block.high[k]
    doubtful = implausible_extent(high - low, block.peak[k])
    return Curve(
        specimen=raw.specimen,
        trial=raw.trial,
        s_c=s_c,
        phi_c=float(phi_c),
        displacement=block.displacement[start:stop].copy(),
        force=block.force[start:stop].copy(),
        sigma=None if raw.sigma is None else raw.sigma.copy(),
        source=raw.source,
        usage=Usage(
            recorded=size,
            used=size,
            low=low,
            high=high,
            parts=(Segment("load", 0, size),),
            remarks=() if doubtful is None else (doubtful,),
        ),
        direction=direction,
        time=None if raw.time is None else raw.time.copy(),
        conditions=raw.conditions,
        **(vectors_of(raw, np.ones(size, bool), options) if some else {}),
    )
