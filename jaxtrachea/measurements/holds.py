"""Where the tool of a record stands still: before the loading, on the way up, at the peak."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from jaxtrachea.measurements.turning import noise

#: Band, as a share of the loading, within which the tool stands still.
BAND = 0.005
#: A hold lasts this share of the loading at least, takes its band this many times as long as the
#: loading does, and has this many samples.
LEAST_HOLD, SLOWER, FEWEST = 0.05, 6.0, 5
#: One that lasts less than this share of the loading counts only where its force falls by at least
#: this share: the tool of a gentle press slows down towards its end.
SHORT, FALLS = 0.2, 0.02
#: One that lasts this share of the longest that counts is one of several like it, and counts too.
ALIKE = 2 / 3
#: Of a force that rises in proportion to the displacement, what tells slow loading from a hold.
RISING = 0.3
#: Shares of the loading between which its speed is taken, in so many parts.
_UPPER, _ALL = np.linspace(0.45, 0.95, 11), np.array([0.05, 0.95])
#: Bands on each side of a knee that are looked at to place it.
_AROUND = 3


@dataclass(frozen=True)
class Hold:
    """A tool that stands still while the force relaxes, or creeps under a constant force.

    Attributes:
        start: first sample after the loading before it.
        stop: first sample after it.
        duration: s, or samples where there is no time.
        relaxed: fall of the force within it, as a share of the force at its start above the foot.
    """

    start: int
    stop: int
    duration: float
    relaxed: float


@dataclass(frozen=True, eq=False)
class Rise:
    """A record from the foot of a loading to the end of its peak.

    Attributes:
        travel: (M,) mm, growing.
        force: (M,) N.
        clock: (M,) s or sample numbers, never falling.
        height: of the loading in contact, mm.
        sigma: noise of the travel, mm.
    """

    travel: Float64[np.ndarray, " m"]
    force: Float64[np.ndarray, " m"]
    clock: Float64[np.ndarray, " m"]
    height: float
    sigma: float

    @property
    def band(self) -> float:
        """Within it the tool stands still, mm."""
        return max(BAND * self.height, 6 * self.sigma)

    @property
    def still(self) -> float:
        """From the level of a hold, within it the tool has arrived, mm."""
        return max(0.3 * BAND * self.height, 2 * self.sigma)


def may_hold(travel: Float64[np.ndarray, " n"]) -> bool:
    """Whether a rising record could hold anywhere: a cheap look, for records sampled evenly.

    A hold of a tenth of the loading is 9 % of a record that is nothing else but this loading; so
    are two of them, less a step.
    """
    lag = max(2, int(0.07 * travel.size))
    if travel.size <= FEWEST + 1:
        return False
    least = float((travel[lag:] - travel[:-lag]).min())
    return least < 0.25 * lag / travel.size * float(travel[-1] - travel[0])


def rises_evenly(travel: Float64[np.ndarray, " s"], edges: np.ndarray) -> np.ndarray:
    """Of many rising records end to end, which can nowhere hold: `may_hold` is False.

    Args:
        travel: the records, mm.
        edges: (C + 1,) first sample of each, and the end of the last.

    Returns:
        (C,) bool.
    """
    starts, sizes = edges[:-1], np.diff(edges)
    lag = np.maximum(2, (0.07 * sizes).astype(np.int64))
    later = np.arange(travel.size) + np.repeat(lag, sizes)
    inside = later < np.repeat(edges[1:], sizes)
    gain = np.where(inside, travel[np.minimum(later, travel.size - 1)] - travel, np.inf)
    least = np.minimum.reduceat(gain, starts)
    usual = 0.25 * lag / sizes * (travel[edges[1:] - 1] - travel[starts])
    return (sizes <= FEWEST + 1) | ~(least < usual)


def holds(rise: Rise) -> tuple[int, tuple[Hold, ...], Hold | None]:
    """Where the tool stands still.

    Returns:
        Samples of rest before the loading begins, holds on the way up, and the hold at the peak.
    """
    envelope = np.maximum.accumulate(rise.travel)
    least, short = _durations(rise, envelope)
    size = envelope.size
    until = np.searchsorted(envelope, envelope + rise.band, side="right")
    long = rise.clock[until - 1] - rise.clock >= least
    slow = np.flatnonzero(long & (until - np.arange(size) >= FEWEST))
    spread = float(np.ptp(rise.force))
    scatter = 3 * noise(rise.force) / spread if spread > 0 else 0.0
    rest, found = 0, []
    for start, stop in _runs(slow, until):
        if envelope[start] <= envelope[0] + rise.band:
            last = _leaves(rise, envelope, start, stop, least)
            if rise.clock[last] - rise.clock[0] >= short:
                rest = max(rest, last)
            continue
        first = _arrives(rise, envelope, start, stop, least)
        last = stop if stop >= size else _leaves(rise, envelope, start, stop, least) + 1
        dip = float((envelope[first:last] - rise.travel[first:last]).max(initial=0.0))
        if last - first < FEWEST or dip > 2 * rise.band or _rises(rise, first, last):
            continue
        hold = _hold(rise, _where_force_stops(rise, first), last)
        found.append((hold, stop >= size))
    sure = [h.duration >= short or h.relaxed >= max(FALLS, scatter) for h, _ in found]
    longest = max(
        (h.duration for (h, _), yes in zip(found, sure, strict=True) if yes), default=np.inf
    )
    kept = [
        (h, at_top)
        for (h, at_top), yes in zip(found, sure, strict=True)
        if yes or h.duration >= ALIKE * longest
    ]
    steps = tuple(h for h, at_top in kept if not at_top)
    return rest, steps, next((h for h, at_top in kept if at_top), None)


def _durations(rise: Rise, envelope: np.ndarray) -> tuple[float, float]:
    """Of the shortest hold, and of one that needs no further sign, in the unit of the clock."""
    top = float(rise.travel.max())
    passed = np.interp(top - rise.height * (1 - _UPPER), envelope, rise.clock)
    ends = np.interp(top - rise.height * (1 - _ALL), envelope, rise.clock)
    usual = float(np.median(np.diff(passed))) / float(_UPPER[1] - _UPPER[0])
    whole = float(ends[1] - ends[0]) / float(_ALL[1] - _ALL[0])
    passing = SLOWER * rise.band / rise.height * usual
    return max(LEAST_HOLD * whole, passing), max(SHORT * whole, passing)


def _runs(slow: np.ndarray, until: np.ndarray) -> list[tuple[int, int]]:
    """Runs of samples from which the band lasts long, each with the end of its last band."""
    if slow.size == 0:
        return []
    breaks = np.flatnonzero(slow[1:] >= until[slow[:-1]]) + 1
    groups = np.split(slow, breaks)
    return [(int(group[0]), int(until[group[-1]])) for group in groups]


def _arrives(rise: Rise, envelope: np.ndarray, start: int, stop: int, least: float) -> int:
    """First sample after a loading ends in a hold."""
    low = int(np.searchsorted(envelope, envelope[start] - _AROUND * rise.band))
    level = _level(rise, start, stop)
    if level is not None:
        return low + int(np.argmax(rise.travel[low:stop] >= level - rise.still)) + 1
    high = int(np.searchsorted(rise.clock, rise.clock[start] + least, side="right"))
    high = max(min(high, stop) - 1, start + 1)
    return low + int(np.argmax(_above_chord(rise, low, high))) + 1


def _leaves(rise: Rise, envelope: np.ndarray, start: int, stop: int, least: float) -> int:
    """Last sample of a hold before a loading begins."""
    level = _level(rise, start, stop)
    if level is not None:
        return start + int(np.flatnonzero(rise.travel[start:stop] <= level + rise.still)[-1])
    low = int(np.searchsorted(rise.clock, rise.clock[stop - 1] - least))
    low = min(max(low, start), stop - 2)
    above = envelope[stop - 1] + _AROUND * rise.band
    high = min(int(np.searchsorted(envelope, above, side="right")), envelope.size - 1)
    return low + int(np.argmin(_above_chord(rise, low, high)))


def _level(rise: Rise, start: int, stop: int) -> float | None:
    """Displacement of a hold, mm; None where it creeps."""
    quarter = (stop - start) // 4
    middle = rise.travel[start + quarter : stop - quarter]
    third = max(middle.size // 3, 1)
    if abs(float(middle[-third:].mean() - middle[:third].mean())) > rise.still:
        return None
    return float(np.median(middle))


def _above_chord(rise: Rise, low: int, high: int) -> np.ndarray:
    """Travel above the straight line between two samples, mm."""
    clock, travel = rise.clock[low : high + 1], rise.travel[low : high + 1]
    lapse = float(clock[-1] - clock[0])
    share = (clock - clock[0]) / lapse if lapse > 0 else np.linspace(0, 1, clock.size)
    return travel - travel[0] - share * (travel[-1] - travel[0])


def _rises(rise: Rise, start: int, stop: int) -> bool:
    """Whether the force grows with the displacement as it does in a loading."""
    third = max((stop - start) // 3, 1)
    travel, force = rise.travel[start:stop], rise.force[start:stop]
    far = float(travel[-third:].mean() - travel[:third].mean())
    more = float(force[-third:].mean() - force[:third].mean())
    scatter = noise(force) * np.sqrt(2 / third)
    usual = float(np.ptp(rise.force)) / rise.height
    return bool(far > 0.5 * rise.band and more > max(RISING * usual * far, 3 * scatter))


def _where_force_stops(rise: Rise, start: int) -> int:
    """First sample of a hold that creeps fast at first: from where its force no longer grows."""
    few = max(start // 50, 1)
    smooth = np.convolve(rise.force[: start + few], np.full(few, 1 / few), "valid")
    spread = max(2 * noise(rise.force) / few**0.5, 0.005 * float(np.ptp(rise.force)))
    first = int(np.argmax(smooth >= smooth.max() - spread)) + few // 2 + 1
    if first > start - FEWEST or _rises(rise, first, start):
        return start
    before = int(np.searchsorted(rise.travel[:first], rise.travel[first] - 0.2 * rise.height))
    usual = _speed(rise, min(before, first - 1), first)
    return first if _speed(rise, first, start) < 0.5 * usual else start


def _speed(rise: Rise, start: int, stop: int) -> float:
    """Of the tool between two samples, mm per unit of the clock."""
    lapse = float(rise.clock[stop] - rise.clock[start])
    return float(rise.travel[stop] - rise.travel[start]) / lapse if lapse > 0 else np.inf


def _hold(rise: Rise, start: int, stop: int) -> Hold:
    """The record of a hold."""
    few = max((stop - start) // 20, 1)
    begins, ends = float(rise.force[start - 1]), float(rise.force[stop - few : stop].mean())
    begins = max(begins, float(rise.force[start : start + few].mean()))
    over = begins - float(rise.force[0])
    return Hold(
        start=start,
        stop=stop,
        duration=float(rise.clock[stop - 1] - rise.clock[start - 1]),
        relaxed=(begins - ends) / over if over > 0 else 0.0,
    )
