"""Where a curve first touches, before any fit: a change point, in closed form for every candidate.

A force that is constant and then a cubic in h = max(D - onset, 0), F = f + a h + b h^2 + c h^3, is
linear in f, a, b, c: for each candidate onset the best sum of squares is a 4 x 4 system, made of
sums of powers over the samples beyond it. A scan over candidates, then a finer one around the best,
all curves at once. It serves as a start, and with the noise of the samples as the width over which
a fit rounds the corner at the onset.

A sharp corner makes the cost of a fit kinked wherever the onset passes a sample. The kinks are as
high as the noise; a corner rounded over the distance in which the force grows by the noise removes
them. It is rounded with equal integral on both sides (`_numerics.centred_hinge`), so that estimates
do not move by more than a small part of their standard error (docs/read_a_fit.md).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

#: Candidates of the two scans, and how far before the first sample they begin (share of the range).
_COARSE, _FINE, _BEFORE = 40, 16, 0.2
#: Samples in a window for the noise, and the degree that is taken out of it.
_WINDOW, _DEGREE = 9, 3
#: Windows of a curve that are looked at, at most.
_MOST_WINDOWS = 400
#: Share of the span behind the onset over which the slope there is taken.
_BEHIND = 0.2
#: Force grows by this many standard deviations of the noise within the rounded corner, which takes
#: at most this share of the press.
_STANDARD_DEVIATIONS, _LARGEST = 1.0, 0.05


class FirstTouch(NamedTuple):
    """Change points of C curves; NaN where fewer than 4 samples are seen, or all at one place.

    Attributes:
        onset: displacement at first touch, mm.
        force_offset: force before it, N.
        slope: of the force over the next fifth of the span, N/mm; positive.
        noise: standard deviation of a force sample against its neighbours, N.
        span: largest less smallest displacement, mm.
        peak: largest force less the offset, absolute, N.
    """

    onset: Float[np.ndarray, "*C"]
    force_offset: Float[np.ndarray, "*C"]
    slope: Float[np.ndarray, "*C"]
    noise: Float[np.ndarray, "*C"]
    span: Float[np.ndarray, "*C"]
    peak: Float[np.ndarray, "*C"]


def first_touch(
    displacement: Float[np.ndarray, "C N"],
    force: Float[np.ndarray, "C N"],
    seen: Bool[np.ndarray, "C N"],
    force_offset: Float[np.ndarray, "*C"] | None = None,
) -> FirstTouch:
    """Change point of every curve.

    Args:
        displacement: mm.
        force: N.
        seen: which samples count.
        force_offset: of the load cell, N, where it is known; None: sought with the onset.
    """
    low = np.min(np.where(seen, displacement, np.inf), axis=1)
    span = np.max(np.where(seen, displacement, -np.inf), axis=1) - low
    with np.errstate(invalid="ignore"):
        usable = (seen.sum(axis=1) >= 4) & (span > 0) & np.isfinite(span)
    seen = seen & usable[:, None]
    unit, zero = np.where(usable, span, 1.0), np.where(usable, low, 0.0)
    x = np.where(seen, (displacement - zero[:, None]) / unit[:, None], 2.0)
    curves = _Moments(x, force, seen, force_offset)
    scan = np.broadcast_to(np.linspace(-_BEFORE, 0.9, _COARSE), (len(x), _COARSE))
    step = scan[0, 1] - scan[0, 0]
    around = np.linspace(-step, step, _FINE + 1)
    best = curves.best(curves.best(scan).onset[:, None] + around[None])
    peak = np.max(np.where(seen, np.abs(force - best.offset[:, None]), 0), axis=1)

    def hide(v):
        return np.where(usable, v, np.nan)

    return FirstTouch(
        onset=hide(zero + best.onset * unit),
        force_offset=hide(best.offset),
        slope=hide(np.maximum(best.slope, 0.05 * peak) / unit),
        noise=hide(noise_of(displacement, force, seen)),
        span=hide(span),
        peak=hide(peak),
    )


class _Best(NamedTuple):
    """The best candidate of every curve: onset in shares of the span, offset (N), slope (N)."""

    onset: np.ndarray
    offset: np.ndarray
    slope: np.ndarray


class _Moments:
    """Sums of powers of the displacement (in shares of the span) over the last samples of C curves.

    Row j of a sum is over the samples from the j-th on, in order of displacement.
    """

    def __init__(self, x, force, seen, force_offset):
        """`x` of samples that are not seen is beyond all others."""
        order = np.argsort(x, axis=1, kind="stable")
        x, F, w = (np.take_along_axis(v, order, axis=1) for v in (x, force, seen.astype(float)))
        self.known = force_offset
        self.base = np.zeros(len(x)) if force_offset is None else force_offset
        if force_offset is None:  # sums of squares are then free of what the offset takes out
            self.base = np.sum(w * F, axis=1) / np.maximum(np.sum(w, axis=1), 1)
        F = w * (F - self.base[:, None])
        self.x = x
        powers = np.where(w > 0, x, 0)[..., None] ** np.arange(7) * w[..., None]
        self.powers, self.forces = (
            _sums_behind(powers),
            _sums_behind(powers[..., :4] * F[..., None]),
        )
        self.count, self.total = np.sum(w, axis=1), np.sum(F, axis=1)

    def best(self, onset: Float[np.ndarray, "C K"]) -> _Best:
        """The candidate with the largest fall of the sum of squares."""
        rows = np.arange(len(onset))
        first = np.stack([np.searchsorted(x, o) for x, o in zip(self.x, onset, strict=True)])
        reach = 1 - onset
        powers = _shifted(self.powers[rows[:, None], first], onset, reach)
        forces = _shifted(self.forces[rows[:, None], first], onset, reach)
        gram = powers[..., np.add.outer(np.arange(4), np.arange(4))]
        gram[..., 0, 0], forces[..., 0] = self.count[:, None], self.total[:, None]
        if self.known is not None:
            gram, forces = gram[..., 1:, 1:], forces[..., 1:]
        top = np.maximum(np.trace(gram, axis1=-2, axis2=-1), 1e-300)[..., None, None]
        found = np.linalg.solve(gram + 1e-9 * top * np.eye(gram.shape[-1]), forces[..., None])[
            ..., 0
        ]
        fall = np.sum(found * forces, axis=-1)
        a, b, c = np.moveaxis(found[..., -3:], -1, 0)
        part = _BEHIND / reach
        slope = (a + b * part + c * part**2) / reach
        # A force that falls as it is touched is no touch.
        chosen = np.argmax(np.where(a > 0, fall, -1 / np.maximum(fall, 1e-300)), axis=1)
        offset = 0.0 if self.known is not None else found[rows, chosen, 0]
        return _Best(onset[rows, chosen], self.base + offset, slope[rows, chosen])


def _sums_behind(v: Float[np.ndarray, "C N k"]) -> Float[np.ndarray, "C M k"]:
    """Sums from each sample to the last; one more row of zeros, M = N + 1."""
    sums = np.cumsum(v[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([sums, np.zeros_like(v[:, :1])], axis=1)


def _shifted(sums, onset, reach):
    """From sums of x^m to sums of ((x - onset) / reach)^m."""
    out = np.zeros_like(sums)
    for k in range(sums.shape[-1]):
        for m in range(k + 1):
            out[..., k] += math.comb(k, m) * sums[..., m] * (-onset) ** (k - m)
    return out / reach[..., None] ** np.arange(sums.shape[-1])


def noise_of(
    displacement: Float[np.ndarray, "C N"],
    force: Float[np.ndarray, "C N"],
    seen: Bool[np.ndarray, "C N"],
) -> Float[np.ndarray, "*C"]:
    """Standard deviation of the samples about a cubic through their neighbours, robust, N.

    The neighbours are those in displacement. Steps of the curve as a whole (its corner) lie in few
    windows and do not count; a curve of fewer than 9 samples has noise 0.
    """
    out = np.zeros(len(force))
    for c in range(len(force)):
        D, F = displacement[c][seen[c]], force[c][seen[c]]
        if len(D) < _WINDOW:
            continue
        order = np.argsort(D, kind="stable")
        D, F = (np.lib.stride_tricks.sliding_window_view(v[order], _WINDOW) for v in (D, F))
        every = -(-len(D) // _MOST_WINDOWS)
        D, F = D[::every], F[::every]
        middle = D[:, _WINDOW // 2]
        reach = np.maximum(np.max(np.abs(D - middle[:, None]), axis=1), 1e-300)
        t = (D - middle[:, None]) / reach[:, None]
        A = t[:, :, None] ** np.arange(_DEGREE + 1)
        gram = np.swapaxes(A, 1, 2) @ A + 1e-12 * np.eye(_DEGREE + 1)
        fitted = np.linalg.solve(gram, np.swapaxes(A, 1, 2))
        hat = A @ fitted
        r = F - (hat @ F[..., None])[..., 0]
        own = 1 - np.clip(hat[:, _WINDOW // 2, _WINDOW // 2], 0, 0.9)
        out[c] = 1.4826 * np.median(np.abs(r[:, _WINDOW // 2]) / np.sqrt(own))
    return out


def blend_widths(
    touch: FirstTouch, noise: Float[np.ndarray, "*C"], least: float
) -> Float[np.ndarray, "*C"]:
    """Half the width of the rounded corner at the onset of every curve, mm.

    Args:
        touch: the change points.
        noise: standard deviation of a force sample, N, where it is given; NaN: as `touch` has it.
        least: mm; where there is no noise, or no change point.
    """
    level = np.where(np.isnan(noise), touch.noise, noise)
    with np.errstate(divide="ignore", invalid="ignore"):  # a force that stays has no slope
        width = np.minimum(_STANDARD_DEVIATIONS * level / touch.slope, _LARGEST * touch.span)
    return np.where(np.isfinite(width), np.maximum(width, least), least)
