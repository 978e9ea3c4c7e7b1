"""Crests along a tube: each looked for in many rays, so that holes and noise in a few move none.

`rows` (stations, rays) is what stands out there: the relief of the wall in mm, NaN where the wall
is not seen, or 1 where a ray meets cartilage and 0 elsewhere. Lengths in mm, arrays in float64.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.centreline import Shape
from jaxtrachea.trachea.holes import FRONT
from jaxtrachea.trachea.sections import ANGLES, RAYS

#: The rays of the arc on which rings are looked for.
ARC = np.abs(ANGLES) < FRONT
#: Sectors of that arc in each of which a crest is looked for, and their middles, rad.
SECTORS = np.array_split(np.flatnonzero(ARC), 9)
MIDDLES = np.array([ANGLES[rays].mean() for rays in SECTORS])
#: Share of the arc that has to be seen for a station to count.
SEEN = 0.5
#: Length over which the profile is smoothed, and which it may be bridged where it is not seen, mm.
SMOOTH = 1.2
#: Where a contour that is steep along the tube is smaller than this, over the mean, it is a lid.
SHUT = 0.9
#: Share by which waves that turn with phi outweigh level ones: a thread.
THREAD = 1.5


class Crests(NamedTuple):
    """Crests of a row, each along the first axis.

    Attributes:
        positions: on the midline, mm.
        errors: standard errors of these, from how far the sectors of the arc agree, mm.
        shares: of the sectors in which the crest stands out.
        sideways: way along the tube per unit of sin phi, mm: of a plane that leans to the side.
        forwards: the same per unit of cos phi: of one that leans forwards.
    """

    positions: np.ndarray
    errors: np.ndarray
    shares: np.ndarray
    sideways: np.ndarray
    forwards: np.ndarray


def relief(shape: Shape, to_ends: bool = False) -> np.ndarray:
    """How far the contour stands out of its surroundings along s, mm; NaN where it is not seen.

    The surroundings: the mean over a window as long as the radius, of which half has to be seen.
    Within half a window of an end the relief is NaN, or else they are continued straight, so that a
    ring there is seen too; NaN then where the contour runs into a lid.
    """
    step = shape.s[1] - shape.s[0]
    span = max(5, int(np.nanmean(shape.radius) / step) | 1)
    out = np.full_like(shape.radius, np.nan)
    if len(shape.s) <= 2 * span:
        return out
    half, seen = span // 2, np.isfinite(shape.radius)
    count = _window(seen.astype(float), span)
    level = _window(np.nan_to_num(shape.radius), span) / np.maximum(count, 1)
    level[count < span / 2] = np.nan
    out[half:-half] = shape.radius[half:-half] - level
    if not to_ends:
        return out
    i = np.arange(half)[:, None]

    def slope(first, last):
        return (last - first) / (span - 1)

    out[:half] = shape.radius[:half] - level[0] + slope(level[0], level[span - 1]) * (half - i)
    out[-half:] = shape.radius[-half:] - level[-1] - slope(level[-span], level[-1]) * (i + 1)
    both = seen[1:] & seen[:-1]
    rise = np.where(both, np.abs(np.diff(shape.radius, axis=0)), 0).sum(axis=1)
    wide = np.nan_to_num(shape.radius).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    shut = np.minimum(wide[1:], wide[:-1]) < SHUT * np.nanmean(shape.radius)
    steep = (rise > step * both.sum(axis=1)) & shut  # a lid: more than 45 deg
    low, high = np.flatnonzero(steep[:half]), np.flatnonzero(steep[-half:])
    out[: low[-1] + 1 if len(low) else 0] = np.nan
    out[len(out) - half + high[0] if len(high) else len(out) :] = np.nan
    return out


def _window(rows, span):
    """Sums over `span` stations."""
    return np.stack([np.convolve(v, np.ones(span), "valid") for v in rows.T], axis=1)


def profile_of(rows: np.ndarray) -> np.ndarray:
    """Mean of the middle half of what the arc's rays see at each station, or NaN."""
    ordered = np.sort(rows[:, ARC], axis=1)  # NaN last
    count = np.isfinite(ordered).sum(axis=1, keepdims=True)
    at = np.arange(ordered.shape[1])
    middle = (at >= count // 4) & (at < count - count // 4)
    mean = np.where(middle, ordered, 0).sum(axis=1) / np.maximum(middle.sum(axis=1), 1)
    return np.where(count[:, 0] >= SEEN * ordered.shape[1], mean, np.nan)


def smoothed(profile: np.ndarray, step: float) -> np.ndarray:
    """Running mean over `SMOOTH`; what is not seen is bridged straight."""
    seen = np.flatnonzero(np.isfinite(profile))
    profile = np.interp(np.arange(len(profile)), seen, profile[seen]) if len(seen) else 0 * profile
    n = max(1, round(SMOOTH / step))
    padded = np.pad(profile, (n // 2, n - 1 - n // 2), "edge")
    return np.convolve(padded, np.ones(n) / n, "valid")


def peaks(profile: np.ndarray, fall: float) -> np.ndarray:
    """Stations of the waves of `profile` that rise and fall by more than `fall`."""
    found, high, low, rising = [], 0, 0, False
    for i, value in enumerate(profile):
        if value > profile[high]:
            high = i
        if value < profile[low]:
            low = i
        if rising and value < profile[high] - fall:
            found, low, rising = [*found, high], i, False
        elif not rising and value > profile[low] + fall:
            high, rising = i, True
    return np.array(found, int)


def crests_at(s: np.ndarray, rows: np.ndarray, profile, tops: np.ndarray, fall: float) -> Crests:
    """The crests near the stations `tops`: centroids of `profile` there, and how sure these are.

    Args:
        s: of the stations, mm.
        rows: what stands out there; shape (stations, rays).
        profile: over the whole arc, smoothed.
        tops: stations, one for each crest, rising.
        fall: least height of a crest.
    """
    if not len(tops):
        return Crests(*np.empty((5, 0)))
    step = s[1] - s[0]
    lines = [_mean(rows[:, rays]) for rays in SECTORS]
    edges = (tops[1:] + tops[:-1]) / 2
    wide = np.median(np.diff(tops)) / 2 if len(tops) > 1 else len(s) / 2
    low = np.concatenate([[tops[0] - wide], edges]).clip(0).astype(int)
    high = np.concatenate([edges, [tops[-1] + wide]]).clip(0, len(s) - 1).astype(int) + 1
    found = []
    for top, a, b in zip(tops, low, high, strict=True):
        of_sectors = [
            _centre(s[a:b], smoothed(v[a:b], step), fall)
            if np.isfinite(v[a:b]).mean() > 0.8
            else math.nan
            for v in lines
        ]
        at = _centre(s[a:b], profile[a:b], 0.0, top - a)
        found.append([at, *_agreement(of_sectors)])
    return Crests(*np.array(found, float).reshape(-1, 5).T)


def _mean(rows):
    """Of what is seen at each station; NaN where less than half is."""
    seen = np.isfinite(rows)
    count = seen.sum(axis=1)
    mean = np.where(seen, rows, 0).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= SEEN * rows.shape[1], mean, np.nan)


def _centre(s, line, fall, top=None) -> float:
    """Centroid of what is above half the height of the crest in this stretch, or NaN."""
    top = int(np.argmax(line)) if top is None else top
    foot = max(line[: top + 1].min(), line[top:].min())
    if line[top] - foot < fall:
        return math.nan
    over = line - (line[top] + foot) / 2
    below = np.flatnonzero(over < 0)
    first, last = below[below < top].max(initial=-1) + 1, below[below > top].min(initial=len(s))
    weight = over[first:last]
    return float(weight @ s[first:last] / weight.sum()) if weight.sum() > 0 else float(s[top])


def _agreement(centres) -> tuple[float, float, float, float]:
    """Standard error of a crest, share of the sectors that have it, and how its plane leans."""
    centres = np.array(centres)
    seen = np.isfinite(centres)
    share = float(seen.mean())
    if seen.sum() < 4:
        return math.inf, share, math.nan, math.nan
    phi = MIDDLES[seen]
    x = np.stack([np.ones_like(phi), np.sin(phi), np.cos(phi)], axis=1)
    fit, *_ = np.linalg.lstsq(x, centres[seen], rcond=None)
    rest = centres[seen] - x @ fit
    error = math.sqrt(float(rest @ rest) / (len(phi) - 3) / len(phi))
    return error, share, float(fit[1]), float(fit[2])


def starts(s: np.ndarray, rows: np.ndarray, positions: np.ndarray) -> int:
    """How many crests further a crest comes out that is followed once round the tube; 0: rings.

    From the waves' phase round the tube: that of a thread turns with phi. Rings whose planes lean
    by so much that their sides are nearer to the next ring's plane count as a thread, too.
    """
    between = (s >= positions[0]) & (s <= positions[-1])
    phase = 2 * math.pi * np.interp(s[between], positions, np.arange(len(positions)))
    waves = np.exp(-1j * phase) @ np.nan_to_num(rows[between])
    turns = np.abs(np.fft.fft(waves))
    most = int(np.argmax(turns[: RAYS // 4])), int(np.argmax(turns[-RAYS // 4 :])) - RAYS // 4
    best = max(most, key=lambda m: turns[m])
    return best if turns[best] > THREAD * turns[0] else 0
