"""Noise of a force sample with a share of the force: sqrt(sigma^2 + (share F)^2).

What a model misses in a deep press grows with the force; one sigma for all depths lets the deep
samples outvote the shallow ones. The share is given, or estimated with sigma from the residuals
of a fit by maximum likelihood, in turns with the fit. F is the force that the fit predicts.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.glitches import glitches
from jaxtrachea.fitting.lane import forces, with_observed
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Shares, Study

#: Gain in -2 ln L from which a share is taken; of noise without one 1 in 700 gains as much.
WORTH = 9.0
#: Fits in turns with the estimate, at most, and the relative change of sigma and share that ends.
MAX_ITERATIONS, SHARE_TOLERANCE = 8, 0.02
#: Least sigma over the largest force, so that no sample of hardly any force counts alone.
LEAST = 2e-4
#: Shares over sigma, times the largest force, that are tried, one in so many before those beside.
_RATIOS, _COARSE = np.geomspace(1e-2, 1 / LEAST, 121), 4


class Levels(NamedTuple):
    """Of every lane: sigma of a sample without force, N, and share; (lanes,)."""

    sigma: Float[np.ndarray, " lanes"]
    share: Float[np.ndarray, " lanes"]

    def take(self, rows: Int[np.ndarray, " n"]) -> "Levels":
        """Those of some lanes."""
        return Levels(*(v[rows] for v in self))

    def replaced(self, rows: Int[np.ndarray, " n"], by: "Levels") -> "Levels":
        """With other rows."""
        return Levels(*(_replaced(old, rows, new) for old, new in zip(self, by, strict=True)))


def with_levels(study: Study, levels: Levels, force: Float[np.ndarray, "lanes T N"]) -> Study:
    """The study with forces weighed by sigma and share; `force` without offset, N."""
    before = study.shares
    plain = np.asarray(study.lanes.precision) if before is None else before.plain
    given = study.noise_given[0]
    share = levels.share[:, None, None] * np.abs(force)
    # In units of an estimated sigma; of given ones beside each.
    sigma = np.where(levels.share > 0, levels.sigma, first_sigma(_plain(study))[:, 0])
    grown = share * plain if given else share / sigma[:, None, None]
    shares = Shares(levels.share, None if given else sigma, plain)
    return with_shares(study, shares, plain / np.hypot(1, grown))


def _plain(study: Study) -> Study:
    """The study as if nothing were found yet."""
    return dataclasses.replace(study, shares=None)


def as_weighed(study: Study) -> Study:
    """The study with `shares`: all 0 where none has been found."""
    if study.shares is not None:
        return study
    sigma = None if study.noise_given[0] else first_sigma(study)[:, 0]
    none = np.zeros(len(study.unknowns))
    shares = Shares(none, sigma, np.asarray(study.lanes.precision))
    return dataclasses.replace(study, shares=shares)


def with_shares(study: Study, shares: Shares, precision: Float[np.ndarray, "lanes T N"]) -> Study:
    """The study with shares, and the precision of the forces that they made."""
    changed = {
        kind.name: np.where(kind.precision > 0, precision, 0) for kind in forces(study.lanes)[1:]
    }
    lanes = with_observed(study.lanes, precision=changed | {"force": precision})
    return dataclasses.replace(study, lanes=lanes, shares=shares)


def with_found_shares(
    study: Study, before: Study, rows: Int[np.ndarray, " n"], new: Study
) -> Study:
    """The study with the shares of its fit: of lanes `rows` those of `new`, else those of `before`.

    Args:
        study: as it was built, without shares.
        before: of all its lanes, as a fit left it.
        rows: lanes of `new`.
        new: of these lanes, as a fit left it.
    """
    if before.shares is None and new.shares is None:
        # Not a copy where nothing was looked for: that would have no recipe.
        wanted = study.force_share is not None
        return dataclasses.replace(study, force_share=None) if wanted else study
    old, other = as_weighed(before), as_weighed(new)
    assert old.shares is not None
    assert other.shares is not None
    sigma = old.shares.sigma
    if sigma is not None:
        sigma = _replaced(sigma, rows, other.shares.sigma)
    share = _replaced(old.shares.share, rows, other.shares.share)
    precision = _replaced(old.lanes.precision, rows, other.lanes.precision)
    return with_shares(study, Shares(share, sigma, np.asarray(study.lanes.precision)), precision)


def _replaced(values, rows: Int[np.ndarray, " n"], by) -> np.ndarray:
    """The values with other rows."""
    out = np.array(values)
    out[rows] = by
    return out


def next_levels(
    result: FitResult, lanes: Int[np.ndarray, " n"]
) -> tuple[Levels, Float[np.ndarray, "n T N"]]:
    """Sigma and share by the residuals of a fit, and the forces that it predicts without offset.

    A share that is given is kept; one that gains less than `WORTH` is 0.

    Args:
        result: of the fit.
        lanes: whose levels are sought; all of a joint study.
    """
    study = result.study
    residual = result.residuals["force"][lanes]
    zero = offsets(study, result.theta)[lanes, :, None]
    force = np.asarray(study.lanes.force)[lanes] - zero
    force = np.where(np.isfinite(residual), force + residual, force)
    plain = (study.lanes.precision if study.shares is None else study.shares.plain)[lanes]
    rows = range(len(lanes))
    groups = [list(rows)] if study.joint else [[k] for k in rows]
    sigma, share = np.ones(len(lanes)), np.zeros(len(lanes))
    for group in groups:
        group = [k for k in group if result.succeeded[lanes[k]]]
        of = lanes[group]
        measured, precision = (
            np.asarray(v)[of] for v in (study.lanes.force, study.lanes.precision)
        )
        # Glitches are no noise that grows: a few large ones at large forces look like a share.
        left_out = glitches(residual[group], measured, precision).ravel()
        r, F, p = (v[group].ravel() for v in (residual, force, plain))
        seen = np.isfinite(r) & (p > 0) & ~left_out
        if not seen.any():
            continue
        left = 1 - np.sum(study.lanes.active[of]) / max(np.sum(result.samples[of]), 1)
        r, F, p = r[seen] / np.sqrt(max(left, 0.05)), np.abs(F[seen]), p[seen]
        wanted = study.force_share
        given = None if isinstance(wanted, str) or wanted is None else float(wanted)
        sigma[group], share[group] = _most_likely(r, F, p, study.noise_given[0], given)
    return Levels(sigma, share), force


def offsets(study: Study, theta: Float[np.ndarray, "lanes P"]) -> Float[np.ndarray, "lanes T"]:
    """Force without contact of every trial, N: fixed, or as `theta` has it."""
    column = [p.name for p in study.parameters].index("force_offset")
    p: Parameter = study.parameters[column]
    if p.fixed:
        return np.full(study.lanes.s_c.shape, p.value)
    index = np.asarray(study.lanes.index)[:, :, column]
    scaled = np.take_along_axis(theta, np.maximum(index, 0), axis=1)
    return np.where(index >= 0, p.from_scaled(scaled), p.value)


def _most_likely(r, F, p, sigma_given: bool, share: float | None) -> tuple[float, float]:
    """Sigma (1 where it is given) and share of one lane.

    Args:
        r: residuals, N.
        F: forces, N.
        p: precision without a share: 1 / sigma where that is given, else 1.
        sigma_given: whether it is.
        share: where it is given.
    """
    peak = float(np.max(F, initial=0))
    if peak == 0:
        return 1.0 if sigma_given else max(float(np.std(r)), 1e-300), 0.0
    if share is not None and sigma_given:
        return 1.0, share
    if share is not None:
        sigmas = peak * np.geomspace(LEAST, 1, 121)
        variance = sigmas[:, None] ** 2 + (share * F) ** 2
        cost = np.sum(r**2 / variance + np.log(variance), axis=1)
        return float(sigmas[np.argmin(cost)]), share
    squares = np.square([r, F])

    def given(shares):
        variance = 1 / p**2 + (shares**2)[:, None] * squares[1]
        return np.sum(squares[0] / variance + np.log(variance), axis=1)

    def estimated(ratios):
        grown = 1 + (ratios**2)[:, None] * squares[1]
        squared = np.maximum(np.mean(squares[0] / grown, axis=1), 1e-300)
        return len(r) * np.log(squared) + np.sum(np.log(grown), axis=1)

    if sigma_given:
        return 1.0, _worth(given, _RATIOS * LEAST)
    best = _worth(estimated, _RATIOS / peak)
    sigma = np.sqrt(max(np.mean(squares[0] / (1 + best**2 * squares[1])), 1e-300))
    return float(max(sigma, LEAST * peak if best else 0.0)), best * float(sigma)


def _worth(cost: Callable, ratios: np.ndarray) -> float:
    """The ratio of least cost, 0 unless that gains `WORTH`; found on every fourth, then beside."""
    first = np.arange(0, len(ratios), _COARSE)
    none, *coarse = cost(np.concatenate([[0.0], ratios[first]]))
    middle = first[np.argmin(coarse)]
    beside = ratios[max(middle - _COARSE + 1, 0) : middle + _COARSE]
    fine = cost(beside)
    best = int(np.argmin(fine))
    return float(beside[best]) if none - fine[best] > WORTH else 0.0


def changed(before: Levels | None, after: Levels) -> Int[np.ndarray, " n"]:
    """Lanes that another fit is worth its time for; of none that never had a share."""
    if before is None:
        return np.flatnonzero(after.share > 0)
    pairs = zip(before, after, strict=True)
    moved = [np.abs(b - a) > SHARE_TOLERANCE * np.maximum(a, b) for a, b in pairs]
    return np.flatnonzero(np.any(moved, axis=0) & ((before.share > 0) | (after.share > 0)))
