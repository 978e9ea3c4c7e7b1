"""A record as it went, with holds, cycles and unloading: what a force that relaxes is fitted to.

An elastic fit wants one loading. A force that relaxes remembers all that was before, so that such
a fit reads the record from rest before first touch to its end, by its time.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64, Int

from jaxtrachea.measurements.curve import Curve, Fault
from jaxtrachea.measurements.holds import FEWEST, Hold
from jaxtrachea.measurements.segments import Segments, segment
from jaxtrachea.measurements.usage import RELAXED

#: Cure of a record that cannot be read with its time.
ELASTIC = 'or fit one loading without its time (loading = "last")'
#: Share of the samples that may have the time of the one before.
MOST_AT_ONCE = 0.5
#: Speeds of a ramp that are plausible, mm/s; 1 mm/s with its ms read as s is below.
SPEEDS = 1.1e-3, 1e3
#: Share of the largest force that a record may begin with where no rest shows its zero.
FIRST_FORCE = 0.05
#: Of the loading, within which the tool rests at the beginning.
STILL = 0.01
#: Standard deviations of a trend before first touch that noise does not have.
TREND = 5.0
#: Blocks of a part of the record at least.
LEAST_BLOCKS = 4


def check_clock(time: Float64[np.ndarray, " n"] | None) -> None:
    """Refuse a record without time, or with one that stands still.

    Raises:
        Fault: "time".
    """
    if time is None:
        raise Fault(
            "time",
            'there is no time, which loading = "record" needs',
            f"name its column ([data] columns, time = ...), {ELASTIC}",
        )
    still = int(np.count_nonzero(np.diff(time) == 0))
    if still > MOST_AT_ONCE * (time.size - 1):
        raise Fault(
            "time",
            f"time stands still in {still} of {time.size - 1} steps",
            f"export it with more digits, {ELASTIC}",
        )


def kept(broken: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Samples up to the first of these: what follows depends on what happened there."""
    return ~np.logical_or.accumulate(broken)


def rise_of(found: Segments, stop: int) -> tuple[int, int]:
    """First sample of the first loading, with the rest before it, and first after it."""
    return 0 if found.loadings == 1 else found.foot, min(found.stop, stop)


def check_rest(displacement: np.ndarray, force: np.ndarray, found: Segments) -> None:
    """Refuse a record whose force moves before the tool does, or begins under a load.

    Raises:
        Fault: "baseline".
    """
    height = float(np.ptp(displacement))
    peak = float(np.max(np.abs(force)))
    moved = np.flatnonzero(np.abs(displacement - displacement[0]) > STILL * height)
    rest = force[: int(moved[0]) if moved.size else force.size]
    cure = f"record from before first touch on, {ELASTIC}"
    if rest.size < FEWEST:
        if abs(force[0]) > FIRST_FORCE * peak:
            raise Fault(
                "baseline",
                f"the record begins with {force[0]:.3g} N of at most {peak:.3g} N, and no rest "
                "before it shows the zero: what relaxes from before is not known",
                cure,
            )
        return
    third = max(rest.size // 3, 1)
    change = float(rest[-third:].mean() - rest[:third].mean())
    noise = float(np.std(np.diff(rest))) / np.sqrt(2) * np.sqrt(2 / third)
    if abs(change) > max(TREND * noise, STILL * peak):
        raise Fault(
            "baseline",
            f"the force moves by {change:.3g} N before the tool does: the record does not begin at "
            "rest",
            cure,
        )


def remarks_of(
    time: np.ndarray, displacement: np.ndarray, found: Segments, *, whole: bool
) -> Iterator[str]:
    """Speeds of ramps, and what holds mean for an elastic fit.

    Args:
        time: s.
        displacement: mm, of the record.
        whole: the record is used as it went.
    """
    speeds = {
        p: v
        for p in found.parts
        if p.kind in ("load", "unload")
        and (v := speed_of(time[p.start : p.stop], displacement[p.start : p.stop])) > 0
    }
    if not speeds:
        return
    low, high = min(speeds.values()), max(speeds.values())
    named = f"{high:.2g} mm/s" if high < 1.1 * low else f"{low:.2g} to {high:.2g} mm/s"
    if whole:
        yield f"ramps of {named}"
    if low < SPEEDS[0] or high > SPEEDS[1]:
        yield f"ramps of {named}: is the unit of time right?"
    holds: tuple[Hold, ...] = (*found.steps, *(() if found.hold is None else (found.hold,)))
    most = max((hold.relaxed for hold in holds), default=0.0)
    if most >= RELAXED and whole:
        longest = max(hold.duration for hold in holds)
        yield f"in holds of up to {longest:.3g} s the force falls by up to {100 * most:.2g} %"
    elif most >= RELAXED:
        used = [v for p, v in speeds.items() if p.start < found.stop <= p.stop]
        at = f"{used[0] if used else high:.2g} mm/s"
        yield f"k_1 is that of {at}: in the hold the force falls by {100 * most:.2g} %"


def speed_of(time: np.ndarray, displacement: np.ndarray) -> float:
    """Of a ramp, mm/s, from a tenth to nine tenths of its way; 0 where it is too short."""
    way = np.abs(displacement - displacement[0])
    within = np.flatnonzero((way > 0.1 * way.max()) & (way < 0.9 * way.max()))
    if within.size < FEWEST or not time[within[-1]] > time[within[0]]:
        return 0.0
    return float((way[within[-1]] - way[within[0]]) / (time[within[-1]] - time[within[0]]))


def ramp_speed(time: np.ndarray, displacement: np.ndarray) -> float:
    """Speed that the tool has over most of its way to its peak, mm/s, however few samples that has.

    The median over the way, so that holds do not count; 0 where the tool does not move, infinite
    where it jumps.
    """
    way = np.abs(displacement - displacement[0])
    stop = int(np.argmax(way)) + 1
    gone, took = np.diff(np.maximum.accumulate(way[:stop])), np.diff(time[:stop])
    gone, took = gone[gone > 0], took[gone > 0]
    if not gone.size:
        return 0.0
    with np.errstate(divide="ignore"):
        speed = gone / took
    order = np.argsort(speed)
    far = np.cumsum(gone[order])
    return float(speed[order][np.searchsorted(far, far[-1] / 2)])


def longest_hold(curve: Curve) -> Hold | None:
    """Of a whole record; None: it has none, or the curve is no whole record."""
    if curve.rise is None or curve.time is None:
        return None
    found = segment(curve.displacement, curve.force, curve.time, first=True)
    held = (*found.steps, *(() if found.hold is None else (found.hold,)))
    return max(held, key=lambda hold: hold.duration, default=None)


def second_half_of_hold(curve: Curve) -> slice | None:
    """Samples of the later half of the longest hold of a whole record, by time.

    Of a record without a hold, all that follows its first loading. None: nothing follows, or the
    curve is no whole record.
    """
    if curve.rise is None or curve.time is None:
        return None
    start, stop = curve.rise[1], curve.force.size
    if (hold := longest_hold(curve)) is not None:
        middle = curve.time[hold.start - 1] + hold.duration / 2
        start, stop = int(np.searchsorted(curve.time, middle)), hold.stop
    return slice(start, stop) if start < stop else None


def loading_speed(curve: Curve) -> float:
    """Speed of the first loading, mm/s, as `speed_of`; 0 where there is no time."""
    rise = curve.rising
    return 0.0 if rise.time is None else speed_of(rise.time, rise.displacement)


def block_edges(found: Segments, size: int, most: int) -> Int[np.ndarray, " b"]:
    """First samples of blocks that a record is averaged in, about `most` in all.

    As many in each part of the record: even in ramps, whose ends stay as they are, and shorter at
    the beginning of a hold, where the force changes quickly.
    """
    parts = [(p.kind, p.start, min(p.stop, size)) for p in found.parts if p.start < size]
    share = max(most // len(parts), LEAST_BLOCKS)
    short = sum(max(share - (stop - start), 0) for _, start, stop in parts)
    longer = sum(stop - start > share for _, start, stop in parts)
    share += short // max(longer, 1)
    edges = []
    for kind, start, stop in parts:
        n = stop - start
        if n <= share:
            own = np.arange(n)
        elif kind == "hold" or (kind == "rest" and start > 0):
            own = np.unique(np.round(np.geomspace(1, n, share)).astype(int)) - 1
        else:
            own = np.concatenate([[0], np.round(np.linspace(1, n - 1, share - 1)).astype(int)])
        edges.append(start + own[own < n])
    return np.unique(np.concatenate(edges))


def averaged(
    values: Float64[np.ndarray, "*n"], edges: Int[np.ndarray, " b"]
) -> Float64[np.ndarray, "*b"]:
    """Means of blocks; one with a sample that is not observed is not observed."""
    count = np.diff(np.append(edges, len(values)))
    return np.add.reduceat(values, edges, axis=0) / count.reshape(-1, *[1] * (values.ndim - 1))


def averaged_noise(
    sigma: Float64[np.ndarray, " n"], edges: Int[np.ndarray, " b"]
) -> Float64[np.ndarray, " b"]:
    """Standard deviation of the mean of each block."""
    count = np.diff(np.append(edges, len(sigma)))
    return np.sqrt(averaged(sigma**2, edges) / count)
