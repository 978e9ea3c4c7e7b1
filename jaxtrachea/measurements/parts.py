"""Names for the parts of a record."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from jaxtrachea.measurements.holds import Rise

#: Share of the force range up to which a tool is said to approach.
APPROACH = 0.02


@dataclass(frozen=True)
class Segment:
    """Samples `start` up to, not including, `stop`; kind: rest, approach, load, hold, unload."""

    kind: str
    start: int
    stop: int


def legs_of(travel: np.ndarray, points: Sequence[int], tolerance: float) -> Iterator[Segment]:
    """The record from turning point to turning point."""
    ends = sorted({0, *points, travel.size - 1})
    for start, stop in zip(ends[:-1], ends[1:], strict=True):
        way = float(travel[stop] - travel[start])
        kind = "rest" if abs(way) <= tolerance else "load" if way > 0 else "unload"
        yield Segment(kind, start, stop + (stop == travel.size - 1))


def contact_index(rise: Rise, foot: int, last: int) -> int:
    """First sample of a loading after which the force stays above a small share of its range."""
    force = rise.force[foot:last]
    low = float(force.min())
    below = np.flatnonzero(force <= low + APPROACH * (float(force.max()) - low))
    return foot + (int(below[-1]) + 1 if below.size and below[-1] < force.size - 1 else 0)


def parts_of(
    legs: Sequence[Segment], places: tuple[int, int, int, int], touched: int
) -> Iterator[Segment]:
    """All samples in order: legs before and after, the rest, the loading and its hold."""
    start, foot, last, after = places
    named = (
        *(Segment(leg.kind, leg.start, min(leg.stop, start)) for leg in legs),
        Segment("rest", start, foot),
        Segment("approach", foot, touched),
        Segment("load", max(foot, touched), last),
        Segment("hold", last, after),
        *(Segment(leg.kind, max(leg.start, after), leg.stop) for leg in legs),
    )
    yield from (part for part in named if part.start < part.stop)
