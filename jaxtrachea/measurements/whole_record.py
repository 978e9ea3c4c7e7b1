"""A record as it went, with holds, cycles and unloading: what a force that relaxes is fitted to.

An elastic fit wants one loading. A force that relaxes remembers all that was before, so that such
a fit reads the record from rest before first touch to its end, by its time.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64, Int

from jaxtrachea.measurements.curve import Curve, Fault
from jaxtrachea.measurements.holds import FEWEST, SLOWER, Hold
from jaxtrachea.measurements.parts import Segment
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
#: Blocks of a part of the record at least, and of a ramp: in 40 the mean force of one lies within
#: 0.1 % of the peak on the curve.
LEAST_BLOCKS, LEAST_OF_RAMP = 4, 40
#: Times since the tool stopped at the end and the beginning of a block, at most: the mean of a
#: force that decays lies within 0.05 % of what decays on the curve, at its mean time.
LONGEST = 1.15


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


def block_edges(
    found: Segments,
    displacement: Float64[np.ndarray, " n"],
    time: Float64[np.ndarray, " n"],
    most: int,
) -> Int[np.ndarray, " b"]:
    """First samples of blocks that a record is averaged in, about `most` in all.

    As many in each part of the record: of one duration in ramps, whose ends stay as they are, and
    in holds in proportion to the time since the tool stopped. There are more than `most` where
    the mean force of a block would lie off the curve (`LEAST_OF_RAMP`, `LONGEST`).
    """
    parts = list(_ramps_and_holds(found, displacement, time))
    share = max(most // len(parts), LEAST_BLOCKS)
    short = sum(max(share - (part.stop - part.start), 0) for part in parts)
    longer = sum(part.stop - part.start > share for part in parts)
    share += short // max(longer, 1)
    edges = []
    for part in parts:
        since = time[part.start : part.stop] - time[max(part.start - 1, 0)]
        n, last = len(since), since[-1]
        if n <= share or not last > since[0]:
            own = np.arange(n)
        elif part.kind == "hold":
            first = since[since > 0][0]
            least = np.ceil(np.log(last / first) / np.log(LONGEST)) + 1
            at = np.geomspace(first, last, max(share, int(least)))
            if part.stop < time.size:  # where within its last samples the tool goes on
                halves = np.arange(1, np.log2(last / first) + 1)
                at = np.append(at, last - (last - since[0]) / 2**halves)
            own = np.interp(at, since, np.arange(n))
        else:
            blocks = share if part.kind == "rest" else max(share, LEAST_OF_RAMP)
            own = np.interp(np.linspace(since[1], last, blocks - 1), since, np.arange(n))
        edges.append(part.start + np.append(0, np.round(own).astype(int)))
    return np.unique(np.concatenate(edges))


def _ramps_and_holds(
    found: Segments, displacement: np.ndarray, time: np.ndarray
) -> Iterator[Segment]:
    """Parts of the record, cut where the tool stops or goes on within them.

    A "rest" is the one that the record begins with; all others are holds.
    """
    for part in found.parts:
        at, stop = part.start, min(part.stop, displacement.size)
        if part.kind == "rest" and at > 0:
            yield Segment("hold", at, stop)
            continue
        holds = [(max(hold.start, at), min(hold.stop, stop)) for hold in found.steps]
        if part.kind in ("load", "unload"):
            holds += _still_ends(at, stop, displacement, time, found.tolerance)
        for start, end in sorted(holds):
            if at <= start < end:
                yield from (Segment(part.kind, at, start),) if at < start else ()
                yield Segment("hold", start, end)
                at = end
        if at < stop:
            yield Segment(part.kind, at, stop)


def _still_ends(
    start: int, stop: int, displacement: np.ndarray, time: np.ndarray, tolerance: float
) -> Iterator[tuple[int, int]]:
    """Samples at the beginning and the end of a leg where the tool stands still."""
    way, clock = displacement[start:stop], time[start:stop]
    share = SLOWER * tolerance / max(abs(way[-1] - way[0]), tolerance)
    if share < 1:
        leaves = int(np.argmax(np.abs(way - way[0]) > tolerance))
        arrives = way.size - int(np.argmax(np.abs(way - way[-1])[::-1] > tolerance))
        if clock[leaves] - clock[0] > share * (clock[-1] - clock[0]):
            yield start, start + leaves
        if clock[-1] - clock[arrives - 1] > share * (clock[-1] - clock[0]):
            yield start + arrives, stop


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
