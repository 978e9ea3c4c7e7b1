"""Where records have their zeros: first touch, force without contact, a line below the force.

Every record decides for itself whether a press that touches at displacement 0 with force 0 explains
it. Most are decided in closed form: a beginning that runs through the origin, one under load, air
with a sharp end. The others are fitted with and without an onset and an offset (`press_shape`), so
that a soft beginning is not taken for air: what is taken must lower the sum of squares by
`EVIDENCE` times the variance of the noise. Without air a preload and an offset of the load cell
look alike: unless the shape of the record tells them apart, or the force is below 0, it takes both,
and the curves of other positions may tell.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.measurements import press_shape

#: Fall of the sum of squares, in variances of the noise, that an onset or an offset must bring, and
#: that must lie between the two for a record to tell which of them it is.
EVIDENCE, TOLD_APART = 16.0, 9.0
#: Standard deviations by which a force before the touch, or its slope, must differ from 0.
CLEAR = 4.0
#: Samples before the touch at least for a line.
LINE = 5
#: Mean square residual, in variances of the noise, from which fits say nothing of a short air.
_MISSED = 3.0
#: Standard deviations of the force where a record begins that preload and offset need.
SHOWN = 2.5
#: Standard deviations from which no fit is needed to see it.
_OBVIOUS = 6.0
#: Samples of a record at least, and means of neighbouring samples that it becomes at most.
_FEWEST, _MEANS = 6, 48
#: Standard deviations by which the force may rise within the air, and noise at least for that.
_RISING, _ROUNDING = 6.0, 1e-5
#: Share of the record that a line needs; shares of the mean stiffness that it rises and falls by at
#: most (a press does not fall), and by which the force rises at once where the tool touches.
_LONG, _FLAT, _FALLING, _AT_ONCE = 0.04, 0.2, 1.0, 0.5
#: Noise at least, share of the largest force: no model of a press is meant to be closer.
LEAST_NOISE = 5e-4
#: Part of the air before the corner that is left out of its mean and line.
_MARGIN = 0.15
#: Part of the record, and samples at least, that must run through the origin.
_BEGINNING, _FIRST = 0.4, 8
#: Shapes that fits start from: log k_1, log k_3, log c, in shares of the record.
_SHAPES = ((0.2, -2.0, -2.0), (-3.0, 2.0, -0.7))
_SHAPE = ("k_1", "k_3", "c", "q")
#: Fall of the sum of squares that the linearised press must promise for a record to be fitted on,
#: and samples by which a short record's evidence must be the larger.
_HINT, FEW = 12.0, 6
#: Samples from which the noise of a record is known well.
_LONG_RECORD = 40
#: Samples looked at, and records fitted, together.
_TOGETHER, _FITTED_TOGETHER = 1 << 20, 512


class Zeros(NamedTuple):
    """What C records take, and what they show; mm, N.

    Attributes:
        onset: whether first touch is elsewhere than at displacement 0.
        force_offset: whether the force without contact is not 0.
        force_slope: whether the force before the touch lies on a sloping line.
        touch: displacement at first touch; of a record that begins under load, a guess before it.
        offset: force without contact at displacement 0; 0 where it is not taken.
        slope: of the force before the touch, N/mm; NaN where they are fewer than `LINE`, lie
            close together, or rise as a press does.
        slope_error: its standard error.
        air: samples before first touch.
        first: force of the first sample.
        noise: standard deviation of a sample.
    """

    onset: Bool[np.ndarray, " C"]
    force_offset: Bool[np.ndarray, " C"]
    force_slope: Bool[np.ndarray, " C"]
    touch: Float[np.ndarray, " C"]
    offset: Float[np.ndarray, " C"]
    slope: Float[np.ndarray, " C"]
    slope_error: Float[np.ndarray, " C"]
    air: Int[np.ndarray, " C"]
    first: Float[np.ndarray, " C"]
    noise: Float[np.ndarray, " C"]


def record_zeros(
    displacement: Sequence[np.ndarray],
    force: Sequence[np.ndarray],
    sigma: Float[np.ndarray, " C"] | None = None,
) -> Zeros:
    """What every record takes; nothing where it has fewer than 6 samples.

    Args:
        displacement: of each record, mm; (N,).
        force: likewise, N.
        sigma: standard deviation of a force sample, N; NaN or None: by neighbouring samples.
    """
    count = len(displacement)
    given = np.full(count, np.nan) if sigma is None else np.asarray(sigma, float)
    taken, zero, unknown = np.zeros(count, bool), np.zeros(count), np.full(count, np.nan)
    out = Zeros(
        onset=taken, force_offset=taken.copy(), force_slope=taken.copy(),
        touch=zero, offset=zero.copy(), slope=unknown, slope_error=unknown.copy(),
        air=np.zeros(count, int), first=unknown.copy(), noise=unknown.copy(),
    )  # fmt: skip
    lengths = np.array([len(d) for d in displacement], int)
    for length in np.unique(lengths):
        every, together = np.flatnonzero(lengths == length), max(1, _TOGETHER // max(length, 1))
        for begin in range(0, len(every) if length >= _FEWEST else 0, together):
            rows = every[begin : begin + together]
            D, F = (np.stack([v[i] for i in rows]) for v in (displacement, force))
            part = _of_equal_length(D, F, given[rows])
            for whole, values in zip(out, part, strict=True):
                whole[rows] = values
    return out


def flat_until(displacement: Float[np.ndarray, " N"], force: Float[np.ndarray, " N"]) -> float:
    """Displacement to which a force stays within its noise, so that there may be air; else NaN.

    Args:
        displacement: mm, in any order.
        force: N.
    """
    order = np.argsort(displacement, kind="stable")
    D, F = displacement[order][None], force[order][None]
    span, peak = float(D[0, -1] - D[0, 0]), float(np.max(np.abs(F)))
    if D.shape[1] < _FEWEST or not (span > 0 and peak > 0):
        return np.nan
    noise = np.maximum(_noise(D, F), LEAST_NOISE * peak)
    records = _Records(D / span, F / peak, np.full(D.shape, peak / noise))
    end = float(_change_points(records)[0]) * span
    flat = int(np.sum(D <= end)) > LINE and end - float(D[0, 0]) > _LONG * span
    return end if flat else np.nan


class _Records(NamedTuple):
    """Means of neighbouring samples, in shares of the range of displacement and the largest force.

    `weight`: 1 / standard deviation of each mean.
    """

    x: Float[np.ndarray, "C n"]
    y: Float[np.ndarray, "C n"]
    weight: Float[np.ndarray, "C n"]

    def take(self, rows) -> "_Records":
        return _Records(*(v[rows] for v in self))


class _Taken(NamedTuple):
    """Which zeros C records take, and where, in shares of the record; `fitted`: whose by fits.

    `missed`: of which no fit comes close to the record. `sloping`: the force before the touch lies
    on a line beyond doubt.
    """

    onset: Bool[np.ndarray, " C"]
    offset: Bool[np.ndarray, " C"]
    touch: Float[np.ndarray, " C"]
    level: Float[np.ndarray, " C"]
    fitted: Bool[np.ndarray, " C"]
    missed: Bool[np.ndarray, " C"]
    sloping: Bool[np.ndarray, " C"]


def _of_equal_length(D, F, given) -> Zeros:
    order = np.argsort(D, axis=1, kind="stable")
    D, F = np.take_along_axis(D, order, 1), np.take_along_axis(F, order, 1)
    span, peak = D[:, -1] - D[:, 0], np.max(np.abs(F), axis=1)
    usable = (span > 0) & (peak > 0)
    span, peak = np.where(usable, span, 1.0), np.where(usable, peak, 1.0)
    measured = np.where(np.isnan(given), _noise(D, F), given)
    noise = np.maximum(measured, LEAST_NOISE * peak)
    ends = np.linspace(0, D.shape[1], min(D.shape[1], _MEANS) + 1).astype(int)
    held = np.diff(ends)
    x, y = (np.add.reduceat(v, ends[:-1], axis=1) / held for v in (D, F))
    weight = np.sqrt(held) * (peak / noise)[:, None]
    taken = _decided(_Records(x / span[:, None], y / peak[:, None], weight), usable)
    touch, level = taken.touch * span, taken.level * peak
    air = _air(D, F, noise, touch, peak / span)
    rises = air.rise > _RISING * np.maximum(measured, _ROUNDING * peak)
    rises |= taken.missed & (touch > D[:, 0]) & (air.count < LINE)
    rises |= (touch <= D[:, 0]) & (F[:, 0] < SHOWN * noise)  # nor a load where there is none
    rises &= taken.onset & ~taken.sloping
    for v in (taken.onset, taken.offset, touch, level):  # no air where the force rises
        v[rises] = 0
    air = _air(D, F, noise, touch, peak / span)
    clear = (air.count >= 2) & (np.abs(air.mean) > CLEAR * air.mean_error)
    offset = taken.offset | clear & ~taken.fitted
    sloping = (np.abs(air.slope) > CLEAR * air.slope_error) & ~taken.fitted & air.fit_for_line
    level = np.where(sloping, air.at_zero, np.where(air.count >= 2, air.mean, level))
    offset = (offset | sloping) & usable
    return Zeros(
        onset=taken.onset, force_offset=offset, force_slope=sloping & usable,
        touch=touch, offset=np.where(offset, level, 0.0),
        slope=np.where(air.fit_for_line, air.slope, np.nan),
        slope_error=air.slope_error, air=air.count, first=F[:, 0], noise=noise,
    )  # fmt: skip


def _noise(D, F) -> Float[np.ndarray, " C"]:
    """Standard deviation of samples about the cubic through two neighbours on each side, robust."""
    n = D.shape[1]
    x, r = D[:, 2:-2], F[:, 2:-2].copy()
    others = [slice(i, n - 4 + i) for i in (0, 1, 3, 4)]
    gain = np.ones_like(r)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for j in others:
            part = np.ones_like(r)
            for k in others:
                if k != j:
                    part = part * (x - D[:, k]) / (D[:, j] - D[:, k])
            r, gain = r - part * F[:, j], gain + part * part
        size = np.abs(r) / np.sqrt(gain)
    known = np.isfinite(size)  # neighbours at one place say nothing
    size = np.sort(np.where(known, size, np.inf), axis=1)
    count = known.sum(axis=1)
    rows = np.arange(len(size))
    low, high = np.maximum(count - 1, 0) // 2, count // 2 * (count > 1)
    return np.where(count > 0, 1.4826 * 0.5 * (size[rows, low] + size[rows, high]), 0.0)


class _Air(NamedTuple):
    """Force before first touch: samples, mean and line; errors inf or NaN with too few.

    `rise`: from the first half to the second, over what a unit of noise gives. `fit_for_line`: long
    enough for a line through the whole record, and so flat that it is none of the press itself.
    """

    count: Int[np.ndarray, " C"]
    mean: Float[np.ndarray, " C"]
    mean_error: Float[np.ndarray, " C"]
    slope: Float[np.ndarray, " C"]
    slope_error: Float[np.ndarray, " C"]
    at_zero: Float[np.ndarray, " C"]
    rise: Float[np.ndarray, " C"]
    fit_for_line: Bool[np.ndarray, " C"]


def _air(D, F, noise, touch, stiffness) -> _Air:
    end = touch - _MARGIN * np.maximum(touch - D[:, 0], 0)
    there = (D < end[:, None]) & (np.arange(D.shape[1]) < D.shape[1] - 3)
    count = there.sum(axis=1)
    n = np.maximum(count, 1)
    mean = np.sum(F, axis=1, where=there) / n
    middle = np.sum(D, axis=1, where=there) / n
    u = np.where(there, D - middle[:, None], 0)
    square = np.sum(u * u, axis=1)
    enough = (count >= LINE) & (square > 0)
    slope = np.sum(u * F, axis=1) / np.where(enough, square, 1)
    line = np.where(enough, slope, np.nan)
    error = np.where(enough, noise / np.sqrt(np.where(enough, square, 1)), np.nan)
    mean_error = np.where(count > 0, noise / np.sqrt(n), np.inf)
    early = there & (np.cumsum(there, axis=1) <= count[:, None] // 2)
    a, b = early.sum(axis=1), count - early.sum(axis=1)
    rise = np.sum(F, axis=1, where=there & ~early) / np.maximum(b, 1)
    rise = rise - np.sum(F, axis=1, where=early) / np.maximum(a, 1)
    rise = np.where(count >= LINE, rise / np.sqrt(1 / np.maximum(a, 1) + 1 / np.maximum(b, 1)), 0)
    able = (end - D[:, 0] > _LONG * (D[:, -1] - D[:, 0])) & (slope < _FLAT * stiffness)
    able &= slope > -_FALLING * stiffness
    return _Air(count, mean, mean_error, line, error, mean - slope * middle, rise, able)


def _decided(records: _Records, usable) -> _Taken:
    """What every record takes: in closed form where that suffices, else by fits."""
    x, y, weight = records
    count = len(x)
    taken = _nothing(count)
    corner, sloped = _sharp_corner(records), _sloping_corner(records)
    taken.sloping[:] = usable & np.isfinite(sloped)
    corner = np.where(taken.sloping, sloped, corner)
    air = usable & np.isfinite(corner)
    taken.onset[air], taken.touch[air] = True, corner[air]
    rest = np.flatnonzero(usable & ~air & ~_through_origin(records))
    for first in range(0, len(rest), _FITTED_TOGETHER):
        rows = rest[first : first + _FITTED_TOGETHER]
        for whole, part in zip(taken, _by_fits(records.take(rows)), strict=True):
            whole[rows] = part
    return taken


def _nothing(count: int) -> _Taken:
    none, zero = np.zeros(count, bool), np.zeros(count)
    return _Taken(none, none.copy(), zero, zero.copy(), none.copy(), none.copy(), none.copy())


def _line_of_first(records: _Records, count: int):
    """Force at the first displacement and slope, of a line through the first means."""
    x, y = records.x[:, :count], records.y[:, :count]
    u = x - x.mean(axis=1, keepdims=True)
    slope = np.sum(u * y, axis=1) / np.maximum(np.sum(u * u, axis=1), 1e-300)
    return y.mean(axis=1) + slope * u[:, 0], slope


def _through_origin(records: _Records) -> Bool[np.ndarray, " C"]:
    """Records whose first part is a parabola that rises from (0, 0), within the noise."""
    x, y, weight = records
    part = (x - x[:, :1] <= _BEGINNING) | (np.arange(x.shape[1]) < _FIRST)
    w = np.where(part, weight, 0)
    A = (x[..., None] ** np.arange(3)) * w[..., None]
    gram = np.swapaxes(A, 1, 2) @ A + 1e-12 * np.eye(3)
    covariance = np.linalg.inv(gram)
    found = (covariance @ (np.swapaxes(A, 1, 2) @ (y * w)[..., None]))[..., 0]
    r = y * w - (A @ found[..., None])[..., 0]
    spread = np.maximum(np.sum(r * r, axis=1) / np.maximum(part.sum(axis=1) - 3, 1), 1)
    error = np.sqrt(np.einsum("cii->ci", covariance) * spread[:, None])
    level, slope = found[:, 0], found[:, 1]
    most, loose = (
        (3.0, 2.0) if x.shape[1] >= _LONG_RECORD else (2.0, 1.4)
    )  # few samples bend as they like
    near = (np.abs(level) < most * error[:, 0]) & (slope > _OBVIOUS * error[:, 1])
    return near & (spread < loose) & (np.abs(x[:, 0]) < 0.05)


def _sharp_corner(records: _Records) -> Float[np.ndarray, " C"]:
    """End of the air where it is beyond doubt; else NaN.

    A press that touches at 0 grows from there no faster than with the cube of the displacement
    (k_1 = 0, and a skeleton only slows it). Its force at x* then says how much it must have risen
    between the first and the second half of what looks like air.
    """
    x, y, weight = records
    count, n = x.shape
    start = np.mean(y[:, :3], axis=1, keepdims=True)
    above = (y - start) * weight > 4
    first = np.where(above.all(axis=1), 0, n - np.argmax(~above[:, ::-1], axis=1))
    place = np.arange(n)
    early, late = place < first[:, None] // 2, place < first[:, None]
    late = late & ~early
    few = (first < 4) | (first > n - 3)
    u = np.maximum(x, 0) ** 3
    ends = np.where(place >= first[:, None], u, np.inf)

    def mean(v, part):
        return np.sum(v, axis=1, where=part) / np.maximum(part.sum(axis=1), 1)

    low = mean(y, early)
    grown = np.max((y - low[:, None]) / np.where(ends > 0, ends, np.inf), axis=1)
    expected = grown * (mean(u, late) - mean(u, early))
    spread = np.sqrt(1 / np.maximum(early.sum(1), 1) + 1 / np.maximum(late.sum(1), 1))
    missing = (expected - (mean(y, late) - low)) * np.median(weight, axis=1) / spread
    rows = np.arange(count)
    at = np.minimum(first, n - 2)
    # Where the line through the first two samples of contact meets the force before it.
    rise = (y[rows, at + 1] - y[rows, at]) / np.maximum(x[rows, at + 1] - x[rows, at], 1e-9)
    back = x[rows, at] - (y[rows, at] - low) / np.maximum(rise, 1e-9)
    corner = np.clip(back, x[rows, np.maximum(at - 1, 0)], x[rows, at])
    return np.where(few | ~(missing > _OBVIOUS), np.nan, corner)


def _sloping_corner(records: _Records) -> Float[np.ndarray, " C"]:
    """End of an air whose force lies on a sloping line, where it is beyond doubt; else NaN.

    The line is the longest beginning of the record that is straight within the noise. Beside it,
    too, a press that touches at 0 grows no faster than with the cube of the displacement: what the
    record has become says how much the line must be bent. And the force rises at once where the
    tool touches. Of 16,000 random presses without air none is taken for one.
    """
    x, y, weight = records
    count, n = x.shape
    length = np.arange(1, n + 1)
    fit = _Line.of_beginnings(x, y, weight)
    loose = length - 2 + 4 * np.sqrt(2 * np.maximum(length - 2, 1))
    straight = np.where((length >= LINE) & (fit.misfit <= loose), length, 0).max(axis=1)
    held = np.maximum(LINE, np.floor((1 - _MARGIN) * straight).astype(int))
    rows, at = np.arange(count), np.minimum(held, n) - 1
    slope, level = fit.slope[rows, at], fit.level[rows, at]
    error = 1 / np.sqrt(fit.spread[rows, at])
    beside = y - level[:, None] - slope[:, None] * x
    above = beside * weight > 4
    first = np.where(above.all(axis=1), 0, n - np.argmax(~above[:, ::-1], axis=1))
    few = (straight < LINE) | (first < held) | (first > n - 4)
    first = np.clip(first, 1, n - 4)
    # The cube beside its own line through the same samples.
    cube = _Line.of_beginnings(x, x**3, weight)
    bend = x**3 - cube.level[rows, at][:, None] - cube.slope[rows, at][:, None] * x
    later = (length - 1 > first[:, None]) & (bend > 0)
    grown = np.max(np.where(later, beside / np.where(later, bend, 1), 0), axis=1)
    part = np.where(length - 1 < held[:, None], bend * weight, 0)
    size = np.sqrt(np.sum(part**2, axis=1))
    there = np.sum(part * beside * weight, axis=1) / np.maximum(size, 1e-300)
    touch, k = x[rows, first], first + 2
    rise = (y[rows, k] - y[rows, first - 1]) / np.maximum(x[rows, k] - x[rows, first - 1], 1e-9)
    whole = (y[:, -1] - y[rows, first - 1]) / np.maximum(x[:, -1] - x[rows, first - 1], 1e-9)
    sharp = (rise - slope > _AT_ONCE * whole) & (slope < _FLAT * whole)
    known = np.abs(slope) > CLEAR * error
    found = ~few & sharp & known & (grown * size - there > CLEAR)
    corner = touch - beside[rows, first] / np.maximum(rise - slope, 1e-9)
    return np.where(found, np.clip(corner, x[rows, first - 1], touch), np.nan)


class _Line(NamedTuple):
    """Lines through the first 1, 2, ... n means of C records; (C, n).

    `misfit`: sum of squares over the variances; `spread`: 1 / variance of the slope.
    """

    slope: Float[np.ndarray, "C n"]
    level: Float[np.ndarray, "C n"]
    misfit: Float[np.ndarray, "C n"]
    spread: Float[np.ndarray, "C n"]

    @classmethod
    def of_beginnings(cls, x, y, weight) -> "_Line":
        w = weight**2
        # About the first mean, so that sums do not cancel.
        u, v = x - x[:, :1], y - y[:, :1]
        n, a, b, aa, ab, bb = (
            np.cumsum(w * part, axis=1) for part in (1, u, v, u * u, u * v, v * v)
        )
        spread = np.maximum(aa - a * a / n, 0)
        slope = np.where(spread > 0, (ab - a * b / n) / np.where(spread > 0, spread, 1), 0)
        level = (b - slope * a) / n
        misfit = np.maximum(bb - b * b / n - slope**2 * spread, 0)
        return cls(slope, level + y[:, :1] - slope * x[:, :1], misfit, np.maximum(spread, 1e-300))


def _by_fits(records: _Records) -> _Taken:
    """What the least squares of a press with and without onset and offset say."""
    count = len(records.x)
    out = _nothing(count)
    hard, soft = _starts(count, (0.0, 0.0))
    bare, rss = _best(records, _SHAPE, hard)
    n = records.x.shape[1]
    poor = np.flatnonzero(rss > n)
    if len(poor):
        found, less = _best(records.take(poor), _SHAPE, bare[poor], soft[poor])
        bare[poor], rss[poor] = found, less
    hint = press_shape.fall(*records, bare, _columns((*_SHAPE, "onset", "force_offset")))
    rows = np.flatnonzero((hint > _HINT) | (rss > _HINT + 2 * n))
    if len(rows):
        found = _separable(records.take(rows), bare[rows], rss[rows])
        for whole, part in zip(out, found, strict=True):
            whole[rows] = part
    return out


def _separable(records: _Records, bare, rss) -> _Taken:
    """An onset, an offset or both, where they bring enough beside the best press without."""
    x, y, weight = records
    count, n = x.shape
    touch = _change_points(records)
    level, rise = _line_of_first(records, max(3, n // 8))
    before = np.clip(x[:, 0] - np.maximum(level, 0) / np.maximum(rise, 0.05), -0.9, 0.5)
    at_touch, at_before, at_level = bare.copy(), bare.copy(), bare.copy()
    at_touch[:, 4], at_before[:, 4], at_level[:, 5] = touch, before, y[:, 0]
    starts = bare, at_touch, at_before, *_starts(count, (touch, 0.0))
    moved, rss_moved = _best(records, (*_SHAPE, "onset"), *starts)
    raised, rss_raised = _best(records, (*_SHAPE, "force_offset"), bare, at_level)
    starts = moved, raised, *_starts(count, (touch, level))
    both, rss_both = _best(records, (*_SHAPE, "onset", "force_offset"), *starts)
    # What has more parameters may have found a better minimum: those with fewer begin there too.
    without = [v * [1, 1, 1, 1, 0, 0, 0] for v in (moved, raised, both)]
    rss = np.minimum(rss, _best(records, _SHAPE, *without)[1])
    starts = moved, both * [1, 1, 1, 1, 1, 0, 0]
    moved, rss_moved = _best(records, (*_SHAPE, "onset"), *starts)
    at_level = np.where(_columns(_SHAPE), moved, at_level)
    starts = raised, at_level, *_starts(count, (0.0, y[:, 0]))
    raised, rss_raised = _best(records, (*_SHAPE, "force_offset"), *starts)
    unit = np.maximum(rss_both / max(n - 6, 1), 1)
    by_onset, by_offset, by_both = ((rss - v) / unit for v in (rss_moved, rss_raised, rss_both))
    pulls = y[:, 0] * weight[:, 0] < -SHOWN  # no tool does where it touches: an offset
    single = np.where(pulls, by_offset, np.maximum(by_onset, by_offset))
    least = EVIDENCE * (1 + FEW / n)
    taken = (single > least) | (by_both > least + TOLD_APART)
    together = by_both - single > least
    # Nothing before the record without a force where it begins.
    shown = np.abs(level - rise * x[:, 0]) * weight[:, 0] > SHOWN
    taken &= shown | (np.where(together, both[:, 4], moved[:, 4]) > x[:, 0])
    together &= ~pulls | (both[:, 4] > x[:, 0])
    unsure = ~pulls & ~together & (np.abs(by_offset - by_onset) < TOLD_APART)
    onset = taken & (together | unsure | (~pulls & (by_onset > by_offset)))
    offset = taken & (together | unsure | ~onset)
    best = np.where(together[:, None], both, np.where(onset[:, None], moved, raised))
    touch, level = np.where(onset, best[:, 4], 0), np.where(offset, best[:, 5], 0)
    missed = (rss_both > _MISSED * max(n - 6, 1)) & (n >= _LONG_RECORD)
    return _Taken(onset, offset, touch, level, onset | offset, missed, np.zeros(count, bool))


def _columns(names) -> np.ndarray:
    return np.array([name in names for name in press_shape.NAMES])


def _starts(count: int, *zeros):
    """Both shapes, with each of these onsets and offsets."""
    for onset, offset in zeros:
        for shape in _SHAPES:
            start = np.zeros((count, len(press_shape.NAMES)))
            start[:, :3], start[:, 4], start[:, 5] = shape, onset, offset
            yield start


def _best(records: _Records, names, *starts):
    """Parameters and sum of squares of the best of several starts."""
    count, tries = len(records.x), len(starts)
    x, y, weight = (np.concatenate([v] * tries) for v in records)
    found = press_shape.fitted(x, y, weight, np.concatenate(starts), _columns(names))
    rss = found.rss.reshape(tries, count)
    rows, best = np.arange(count), np.argmin(rss, axis=0)
    return found.parameters.reshape(tries, count, -1)[best, rows], rss[best, rows]


def _change_points(records: _Records) -> Float[np.ndarray, " C"]:
    """Displacement from which on the force is above the noise for good."""
    start = np.minimum(np.mean(records.y[:, :3], axis=1, keepdims=True), records.y[:, :1] + 0.02)
    above = (records.y - start) * records.weight > 3
    n = above.shape[1]
    first = np.where(above.all(axis=1), 0, n - np.argmax(~above[:, ::-1], axis=1))
    return records.x[np.arange(len(above)), np.clip(first - 1, 0, n - 4)]
