"""Segments of a record: rest, approach, loading, hold, unloading, cycles; numpy only, no model.

A press machine records more than one loading: it waits, touches, turns back a little, goes through
preconditioning cycles, holds the deepest point and unloads. An elastic fit wants one loading, from
its foot to its peak. What counts as turning back follows from the noise of the displacement itself,
what counts as standing still from the speed of the loading itself; neither needs a time column.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64

from jaxtrachea.measurements.holds import BAND, FEWEST, Hold, Rise, holds, may_hold
from jaxtrachea.measurements.parts import Segment, contact_index, legs_of, parts_of
from jaxtrachea.measurements.turning import loadings, noise, turned_back, turning_points

#: A reversal of less than this share of the loading is jitter of the machine, noise or not.
JITTER = 0.01
#: Standard deviations of the displacement that a reversal must exceed to be one.
SIGMAS = 6.0
#: Noise never hides reversals larger than this share of the loading.
MOST_NOISE = 0.15
#: A loading is full from this share of the largest on.
FULL = 0.8
#: A record without a loading over this share of its travel only unloads.
LEAST_TRAVEL = 1 / 3
#: Share of the force range from which the tool touches, and how much farther than the contact is
#: deep travel counts, since force grows slowly at first.
TOUCH, FARTHER = 0.05, 1.25
#: Parts of the way that count apart there.
PLACES = 1000
#: Holds on the way up from which a protocol is stepwise, and keeps them all.
STEPS = 2
#: A hold at the peak is one more step if it lasts at most this many times as long as they do.
MOST_STEP = 3.0
#: Samples between which slow wander is looked for, if the loading has this many such pieces.
_LAG, _LEGS = 8, 32


@dataclass(frozen=True, eq=False)
class Segments:
    """What a record consists of.

    Attributes:
        direction: 1 pressed inward, -1 drawn outward.
        tolerance: reversal from which the tool counts as turning back, mm.
        foot: first sample of the loading chosen.
        stop: first sample after it, without its hold.
        keep: (N,) samples of the loading chosen.
        parts: all samples in order, in segments.
        loadings: number of all loadings, full or not.
        full: number of full ones.
        chosen: which of the full ones is meant, counted from 1.
        last_share: height of the last loading as a share of the largest.
        cycles: foot and peak of the full loadings.
        hold: at the peak, or None.
        steps: holds on the way up.
        stepwise: whether holds are part of the loading.
        left_out: cause -> samples.
    """

    direction: int
    tolerance: float
    foot: int
    stop: int
    keep: Bool[np.ndarray, " n"]
    parts: tuple[Segment, ...]
    loadings: int = 1
    full: int = 1
    chosen: int = 1
    last_share: float = 1.0
    cycles: tuple[tuple[int, int], ...] = ()
    hold: Hold | None = None
    steps: tuple[Hold, ...] = ()
    stepwise: bool = False
    left_out: dict[str, int] = field(default_factory=dict)


class NoLoading(ValueError):
    """The record only unloads; `start` and `end` are its first and last displacement, mm."""


def segment(
    displacement: Float64[np.ndarray, " n"],
    force: Float64[np.ndarray, " n"],
    time: Float64[np.ndarray, " n"] | None = None,
    *,
    first: bool = False,
) -> Segments:
    """Find the last full loading of a record, from its foot to its peak, without its hold.

    A loading ends where the tool returns over half the way it came; it is full from 80 % of the
    largest on. Travel in air counts only as far as the contact is deep. Samples within a loading
    that turn back by more than the tolerance, max(6 sigma, 1 %), are left out until the tool is
    back where it was. A hold is slower than a sixth of the loading (per sample without `time`),
    longer than a tenth of it, and its force does not rise. Two holds or more on the way up are
    steps of the loading and stay in it.

    Args:
        displacement: mm, positive inward; finite, at least two different values.
        force: N, positive resisting.
        time: s, never falling, or None.
        first: take the first full loading instead of the last.

    Raises:
        NoLoading: the record only unloads.
    """
    sign = direction(displacement, force)
    travel = sign * displacement
    if time is not None and not time[-1] > time[0]:
        time = None
    even = time is None or _even(time)
    if (travel[1:] >= travel[:-1]).all() and even and not may_hold(travel):
        return _plain(sign, travel)
    clock = np.arange(travel.size, dtype=np.float64) if time is None else time
    return _of_many(sign, travel, sign * force, clock, first)


def _even(time: np.ndarray) -> bool:
    """Whether samples follow each other in about equal times."""
    longest = float((time[1:] - time[:-1]).max())
    return longest * (time.size - 1) <= 2 * float(time[-1] - time[0])


def direction(displacement: Float64[np.ndarray, " n"], force: Float64[np.ndarray, " n"]) -> int:
    """-1 if the record draws outward: it falls more than it rises, beyond zero; so does F."""
    low, high, start = displacement.min(), displacement.max(), displacement[0]
    if start - low <= high - start or -low <= abs(high):
        return 1
    return -1 if force[0] - force.min() > force.max() - force[0] else 1


def _plain(sign: int, travel: np.ndarray) -> Segments:
    """A record that only rises, at no time slowly."""
    return Segments(
        direction=sign,
        tolerance=JITTER * float(travel[-1] - travel[0]),
        foot=0,
        stop=travel.size,
        keep=np.ones(travel.shape, bool),
        parts=(Segment("load", 0, travel.size),),
    )


def _contact(travel: np.ndarray, force: np.ndarray) -> float:
    """Displacement from which travel counts: shortly before the tool touches.

    A place counts once, however many samples a hold has there.
    """
    low, high = float(force.min()), float(force.max())
    lowest, top = float(travel.min()), float(travel.max())
    touching = np.sort(travel[force > low + TOUCH * (high - low)])
    bins = np.floor((touching - lowest) / (top - lowest) * PLACES)
    places = touching[np.unique(bins, return_index=True)[1]]
    if places.size < FEWEST:
        return lowest
    return max(lowest, top - FARTHER * (top - float(np.quantile(places, TOUCH))))


def _of_many(
    sign: int, travel: np.ndarray, force: np.ndarray, clock: np.ndarray, first: bool
) -> Segments:
    """The general case: find all loadings, choose one, look at it."""
    contact = _contact(travel, force)
    height = float(travel.max()) - contact
    sigma = min(noise(travel), MOST_NOISE * height / SIGMAS)
    tolerance = max(JITTER * height, SIGMAS * sigma)
    clipped = np.maximum(travel, contact)
    points = turning_points(clipped, tolerance)
    found = loadings(clipped, points)
    heights = np.array([clipped[peak] - clipped[foot] for foot, peak in found])
    if not found or heights.max() < LEAST_TRAVEL * height:
        raise NoLoading(sign * travel[0], sign * travel[-1])
    full = np.flatnonzero(heights >= FULL * heights.max())
    pick = int(full[0] if first else full[-1])
    corners = turning_points(travel, tolerance)
    start, peak = found[pick]
    start += int(np.flatnonzero(clipped[start : peak + 1] <= clipped[start])[-1])
    foot = _foot(travel, points, corners, start)
    begin, until, wander = _around(travel, foot, peak, sigma, float(heights[pick]))
    rise = Rise(
        travel=travel[begin:until],
        force=force[begin:until],
        clock=clock[begin:until],
        height=float(heights[pick]),
        sigma=wander,
    )
    whole = Segments(
        direction=sign,
        tolerance=tolerance,
        foot=foot,
        stop=peak + 1,
        keep=np.zeros(travel.shape, bool),
        parts=(),
        loadings=len(found),
        full=len(full),
        chosen=int(np.searchsorted(full, pick)) + 1,
        last_share=float(heights[-1] / heights.max()),
        cycles=tuple(found[k] for k in full.tolist()),
    )
    legs = tuple(legs_of(travel, corners, tolerance))
    return _held(whole, rise, legs, begin)


def _foot(travel: np.ndarray, points: list[int], corners: list[int], foot: int) -> int:
    """Where a loading begins in air: its last return there, else the lowest place since.

    Args:
        points: turning points of what counts of it.
        corners: its own turning points.
        foot: where what counts of the loading begins.
    """
    before = max((p for p in points if p < foot), default=0)
    returns = [start for start, _ in loadings(travel, corners) if before < start <= foot]
    if returns:
        return returns[-1]
    return foot - int(np.argmin(travel[before : foot + 1][::-1]))


def _around(
    travel: np.ndarray, foot: int, peak: int, sigma: float, height: float
) -> tuple[int, int, float]:
    """A loading with all that stays near its foot and its peak, and the noise within it.

    Returns:
        First sample, first sample after it, and standard deviation of the displacement, mm, slow
        wander included.
    """
    lag = min(_LAG, (peak - foot) // _LEGS)
    if lag > 1 and sigma > 0:
        sigma = max(sigma, min(noise(travel[foot : peak + 1], lag), MOST_NOISE * height / SIGMAS))
    near = 2 * max(BAND * height, SIGMAS * sigma)
    above = np.flatnonzero(travel[:foot] > travel[foot] + max(0.1 * near, SIGMAS * sigma))
    left = np.flatnonzero(travel[peak:] < travel[peak] - near)
    begin = int(above[-1]) + 1 if above.size else 0
    return begin, peak + int(left[0]) if left.size else travel.size, sigma


def _held(whole: Segments, rise: Rise, legs: Sequence[Segment], start: int) -> Segments:
    """With holds, the samples to keep, all segments, and what is left out and why."""
    size = whole.keep.size
    rest, steps, top = holds(rise)
    # Noise puts foot and peak anywhere on the first and last samples: those of a record that begins
    # or ends there are kept.
    if rest == 0 and start > 0:
        rest = whole.foot - start
    peak = rise.travel.size if start + rise.travel.size == size else whole.stop - start
    last = peak if top is None else top.start
    keep = np.zeros(rise.travel.shape, bool)
    keep[rest:last] = True
    for hold in steps:
        keep[hold.start : hold.stop] = False
    stepwise = len(steps) >= STEPS or bool(keep.sum() < FEWEST <= keep.size)
    if stepwise:
        if top is not None and _alike(steps, top):
            last, steps, top = top.stop, (*steps, top), None
        keep[rest:last] = True
    back = np.zeros(last, bool)
    back[rest:] = turned_back(rise.travel[rest:last], whole.tolerance)
    keep[:last] &= ~back
    after = last if top is None else top.stop
    resting = all(leg.kind == "rest" for leg in legs if leg.start < start)
    counts = {
        "before": 0 if resting else start,
        "rest": rest + (start if resting else 0),
        "hold": int((~keep[rest:after]).sum() - back.sum()),
        "turning back": int(back.sum()),
        "after": size - start - after,
    }
    kept = whole.keep.copy()
    kept[start : start + keep.size] = keep
    places = (start, start + rest, start + last, start + after)
    return replace(
        whole,
        foot=places[1],
        stop=places[2],
        keep=kept,
        parts=tuple(parts_of(legs, places, contact_index(rise, rest, last) + start)),
        hold=None if top is None else _shifted(top, start),
        steps=tuple(_shifted(hold, start) for hold in steps),
        stepwise=stepwise and len(steps) > 0,
        left_out={cause: n for cause, n in counts.items() if n},
    )


def _shifted(hold: Hold, by: int) -> Hold:
    """A hold of the whole record."""
    return replace(hold, start=hold.start + by, stop=hold.stop + by)


def _alike(steps: tuple[Hold, ...], top: Hold) -> bool:
    """Whether the hold at the peak is one more step."""
    return not steps or top.duration <= MOST_STEP * float(np.median([h.duration for h in steps]))
