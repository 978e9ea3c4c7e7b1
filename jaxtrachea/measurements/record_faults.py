"""Faults of a record that an engineer sees: a break, a flat top, a moved zero, a softer cycle.

Each is looked for on the samples of the loading that is used, or (zero and cycles) on the whole
record; numpy only, no model. What noise does is in `tests/test_record_faults.py`.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from jaxtrachea.measurements.holds import Hold
from jaxtrachea.measurements.returns import drift, softer
from jaxtrachea.measurements.segments import Segments
from jaxtrachea.measurements.turning import rough_noise, white_noise

#: A fall of the force while the tool advances is a break from this share of the peak, and from so
#: many standard deviations of its noise, on.
FALL, FALL_SIGMAS = 0.05, 10.0
#: A smaller one, from this share on, is a slip: it is said, and the loading goes on.
SLIP = 0.01
#: The tool advances where it takes at least this share of its usual way from sample to sample.
ADVANCES = 0.3
#: Samples of a flat top, at least; with noise, and as a share of the travel.
FLAT, FLAT_NOISY, FLAT_TRAVEL = 4, 8, 0.05
#: Slope of a flat top as a share of the slope before it, and its certainty in standard errors.
FLAT_SLOPE, FLAT_SIGMAS = 0.2, 6.0
#: Share of the travel that counts as one place.
_NEAR = 0.01


class Faults(NamedTuple):
    """What is wrong with a record.

    Attributes:
        broken: (N,) samples after a break.
        saturated: (N,) samples of a flat top.
        remarks: one sentence each.
    """

    broken: Bool[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]
    remarks: tuple[str, ...] = ()


class _Loading(NamedTuple):
    """Samples of a loading, pressed inward: where they stand in the record, mm, N, noise in N."""

    at: np.ndarray
    travel: np.ndarray
    force: np.ndarray
    sigma: float


def faults(
    displacement: Float64[np.ndarray, " n"],
    force: Float64[np.ndarray, " n"],
    keep: Bool[np.ndarray, " n"],
    found: Segments,
) -> Faults:
    """Look for a break, a flat top, a zero that has moved and a softer last cycle.

    Args:
        displacement: mm, of the record.
        force: N.
        keep: samples of the loading to look at; few of them find nothing.

    Returns:
        Samples of `keep` after a break or on a flat top, and sentences.
    """
    none = np.zeros(keep.shape, bool)
    at = np.flatnonzero(keep)
    remarks: list[str] = []
    broken, saturated = none, none
    values = found.direction * force[at]
    if at.size > FLAT and bool(suspicious(values, np.array([0, at.size]))[0]):
        part = _Loading(at, found.direction * displacement[at], values, white_noise(values))
        last, said = _break(part, found)
        if last is not None:
            broken, remarks = none.copy(), [*remarks, said]
            broken[at[last + 1 :]] = True
            part = _Loading(at[: last + 1], part.travel[: last + 1], values[: last + 1], part.sigma)
        elif said:
            remarks = [*remarks, said]
        flat, said = _flat_top(part)
        if flat is not None:
            saturated, remarks = none.copy(), [*remarks, said]
            saturated[part.at[flat]] = True
    remarks += [s for s in (drift(displacement, force, found), softer(displacement, force, found))
                if s is not None]  # fmt: skip
    return Faults(broken, saturated, tuple(remarks))


def _break(part: _Loading, found: Segments) -> tuple[int | None, str]:
    """Place of the last sample before the force falls though the tool advances, and a sentence.

    None and a sentence: it slips; None and "": neither.
    """
    smooth = _median(part.force)
    peak = float(np.ptp(smooth))
    for share in (FALL, SLIP):
        for i, fall in _falls(part, found, smooth, share * peak):
            noise = part.sigma > 1e-9 * peak
            noises = f", {fall / part.sigma:.0f} times its noise" if noise else ""
            falls = (
                f"the force falls by {100 * fall / peak:.2g} % of its peak{noises}, at "
                f"{found.direction * part.travel[i]:.3g} mm while the tool goes on"
            )
            if share == FALL:
                return i, f"{falls} (a break, slip or buckling): the loading ends there"
            if fall < FALL * peak:
                return None, (
                    f"{falls} (a slip): unknowns fitted across it are off; "
                    "data.displacement_max ends records before it"
                )
    return None, ""


def _falls(
    part: _Loading, found: Segments, smooth: np.ndarray, least: float
) -> Iterator[tuple[int, float]]:
    """Last samples before the force falls by more than `least` and its noise, and how far, N."""
    travel = part.travel
    # So few samples do not tell their own noise well.
    least = max(least, FALL_SIGMAS * (1 + 3 / part.force.size) * part.sigma)
    step = float(np.ptp(travel)) / (travel.size - 1)
    for start, stop in _pieces(part.at, found.steps):
        piece = smooth[start:stop]
        top = np.maximum.accumulate(piece)
        fallen = np.flatnonzero(top - piece > least)
        # Where the force first falls so far from each of its peaks: how it comes back is no fall.
        firsts = fallen[np.unique(top[fallen], return_index=True)[1]]
        for j in firsts.tolist():
            i = int(np.argmax(piece[: j + 1]))
            advance = float(travel[start + j] - travel[start + i])
            rise = float(piece[i] - piece[: i + 1].min())
            if advance < ADVANCES * (j - i) * step or rise < 0.5 * least:
                continue
            low = float(piece[i : min(stop - start, j + travel.size // 10 + 2)].min())
            yield start + i, float(piece[i]) - low


def _pieces(at: np.ndarray, steps: tuple[Hold, ...]) -> list[tuple[int, int]]:
    """Runs of samples without a hold or a gap in between, of three samples or more."""
    inside = np.zeros(at.shape, bool)
    for hold in steps:
        inside |= (at >= hold.start) & (at < hold.stop)
    cuts = np.flatnonzero((np.diff(at) > 1) | (np.diff(inside.astype(int)) != 0)) + 1
    edges = [0, *cuts.tolist(), at.size]
    pairs = zip(edges[:-1], edges[1:], strict=True)
    return [(a, b) for a, b in pairs if b - a > 2 and not inside[a]]


def _median(force: np.ndarray) -> np.ndarray:
    """Running median of three, of many samples of five, towards the ends of fewer.

    No outlier of one sample, or of two, is a fall then.
    """
    if force.size < 8:
        return force
    out = force.copy()
    for width in (3, 5) if force.size >= 40 else (3,):
        windows = np.lib.stride_tricks.sliding_window_view(force, width)
        out[width // 2 : -(width // 2)] = np.median(windows, axis=1)
    out[0] = min(out[0], out[1])
    return out


def _flat_top(part: _Loading) -> tuple[np.ndarray | None, str]:
    """Samples of a top at which the force stays though the tool advances, and a sentence."""
    span = float(np.ptp(part.travel))
    low, high = float(part.force.min()), float(part.force.max())
    if not span > 0 or not high > low:
        return None, ""
    first = _same_tops(part, span, low, high)
    cause = "the load cell saturates"
    if first is None and part.force.size >= 3 * FLAT_NOISY:
        first = _noisy_top(part, span, low, high)
        cause = "the load cell saturates, or the wall gives way"
    if first is None:
        return None, ""
    flat = part.travel >= first
    share = (part.travel[flat].max() - first) / span
    level = float(np.median(part.force[flat]))
    return flat, (
        f"the force stays at {level:.3g} N over the last {100 * share:.2g} % of the travel, from "
        f"{first:.3g} mm on: {cause}; these {np.count_nonzero(flat)} samples are no forces"
    )


def _same_tops(part: _Loading, span: float, low: float, high: float) -> float | None:
    """Travel from which the force is its largest value again and again; None: it is not.

    A coarse resolution repeats values, too: over as much travel before, the force must have risen
    by more than a few of its steps.
    """
    same = part.force >= high - 1e-6 * (high - low)
    count = int(np.count_nonzero(same))
    if count < FLAT:
        return None
    first, last = part.travel[same].min(), part.travel[same].max()
    reach = float(last - first)
    beyond = part.travel >= first
    if (
        count < 0.5 * np.count_nonzero(beyond)
        or part.travel.max() - last > 0.2 * reach + 0.01 * span
    ):
        return None
    if reach < ADVANCES * (count - 1) * span / (part.travel.size - 1):
        return None
    before = part.force[(part.travel < first) & (part.travel >= first - reach)]
    levels = np.diff(np.unique(part.force))
    step = float(levels[levels > 1e-9 * (high - low)].min(initial=high - low))
    rise = high - float(before.min()) if before.size else 0.0
    return float(first) if before.size and rise > max(4 * step, 3 * part.sigma) else None


def _noisy_top(part: _Loading, span: float, low: float, high: float) -> float | None:
    """Travel from which the force is constant within its noise where it rose before; None: not."""
    order = np.argsort(part.travel, kind="stable")
    travel, force = part.travel[order], part.force[order]
    shares = np.arange(0.3, 1 - FLAT_TRAVEL + 1e-9, 0.05)
    corners = travel[0] + shares * span
    width = np.minimum((1 - shares) * span, 0.25 * span)
    start, middle = np.searchsorted(travel, corners - width), np.searchsorted(travel, corners)
    moments = _Sums(travel - travel[0], force)
    flat, flat_error = moments.slopes(middle, np.full(middle.shape, travel.size), part.sigma)
    rise, rise_error = moments.slopes(start, middle, part.sigma)
    enough = np.minimum(middle - start, travel.size - middle) >= FLAT_NOISY
    bends = rise - flat > FLAT_SIGMAS * np.hypot(flat_error, rise_error)
    level = (rise > 0.5 * (high - low) / span) & (np.abs(flat) + 2 * flat_error < FLAT_SLOPE * rise)
    found = np.flatnonzero(enough & bends & level)
    if not found.size:
        return None
    k = int(found[0])
    top = float(np.median(force[middle[k] :])) - 2 * part.sigma
    reached = np.flatnonzero(_median(force)[start[k] :] >= top)
    return float(travel[start[k] + reached[0]])


class _Sums:
    """Sums of powers over the first samples of a record, for lines through any run of them."""

    def __init__(self, x: np.ndarray, y: np.ndarray):
        """Displacement from the first, mm, and force, N."""
        powers = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
        self.sums = np.concatenate([np.zeros((6, 1)), np.cumsum(powers, axis=1)], axis=1)

    def slopes(
        self, start: np.ndarray, stop: np.ndarray, sigma: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Slopes of lines through runs of samples, N/mm, and standard errors; inf of too few."""
        n, x, y, xx, xy, yy = self.sums[:, stop] - self.sums[:, start]
        with np.errstate(divide="ignore", invalid="ignore"):
            square = xx - x * x / n
            slope = (xy - x * y / n) / square
            rest = np.maximum(yy - y * y / n - slope * slope * square, 0) / (n - 2)
            error = np.sqrt(np.maximum(rest, sigma * sigma) / square)
        known = (n > 2) & (square > 0)
        return np.where(known, slope, 0.0), np.where(known, error, np.inf)


def suspicious(
    force: Float64[np.ndarray, " s"],
    edges: np.ndarray,
) -> Bool[np.ndarray, " c"]:
    """Of many loadings end to end, which may have a break or a flat top: a cheap look.

    Args:
        force: of the loadings, N, positive resisting; finite, else the answer is of no use.
        edges: (C + 1,) first sample of each, and the end of the last.
    """
    starts, sizes = edges[:-1], np.diff(edges)
    least = np.minimum.reduceat(force, starts)
    peak = np.maximum.reduceat(force, starts) - least
    unit = np.where(peak > 0, peak, 1.0)
    share = (force - np.repeat(least, sizes)) / np.repeat(unit, sizes)
    raised = share + 2.0 * np.repeat(np.arange(sizes.size), sizes)  # no record reaches the next
    fall = np.maximum.reduceat(np.maximum.accumulate(raised) - raised, starts)
    falls = fall > SLIP
    if falls.any():
        falls &= fall > 0.6 * FALL_SIGMAS * rough_noise(share, edges)
    flat = np.add.reduceat((share >= 1 - 1e-6).astype(np.int64), starts) >= FLAT
    return (sizes > FLAT) & (falls | flat | _ends_flat(share, edges))


def _ends_flat(share: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Whether the last twentieth of each record rises much less than a record does on average."""
    starts, sizes = edges[:-1], np.diff(edges)
    few = np.maximum(sizes // 20, 1)
    known = sizes >= 3 * FLAT_NOISY
    bounds = np.stack([starts, edges[1:] - 2 * few, edges[1:] - few], axis=1)
    bounds = np.where(known[:, None], bounds, starts[:, None])
    _, before, last = np.add.reduceat(share, bounds.ravel()).reshape(-1, 3).T
    return known & ((last - before) / few < 0.35 * few / sizes)
