"""Air that records hide behind a soft beginning, which the fit of their specimen does not see.

A record by itself cannot tell some air from a press whose law begins soft: it then takes no onset.
Where that is wrong the whole specimen is: the other curves follow, and the fit ends in a minimum
from which no small change asks for an onset, or from which an offset seems to be missing
(`omitted_zeros`). So a specimen whose residuals are correlated, and larger than the noise of its
records or asking for a zero, is fitted with the onsets of all curves that may begin in air, and
with offsets, too.
Where either explains its curves to their noise, the likelihood gains more than so many unknowns do
by chance, and onsets lie where air may be, there are two readings. A law that is missing from the
model may look like air. So the zeros are taken where witnesses agree: two other records that show
air and whose onsets stay there, or markers, which stand still in air. Else the fit stays as it is,
and its intervals hold those of the other reading (`assessment`).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.build import with_zeros
from jaxtrachea.fitting.omitted_zeros import ZEROS, Asked, able_zeros, asking, near_estimates
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.record_zeros import EVIDENCE, flat_until

#: Relative error of the noise of n samples, as a record tells it, times sqrt(n).
_SPREAD = 1.2
#: Such errors by which residuals exceed the noise where another fit is worth its time, and up to
#: which they may where it explains the curves.
_MISSES, _EXPLAINS = 1.5, 3.0
#: Standard errors by which neighbouring residuals are correlated there.
_FOLLOW = 2.0
#: Gain in -2 ln L of each further zero beside `EVIDENCE`.
_EACH = 4.0
#: Records of a specimen that must show air, share of it by which their onsets may move, and
#: standard deviations of markers that stand still.
_WITNESSES, _STAYS, _STILL = 2, 0.15, 2.0
#: Share of a record that may be hidden air.
_HIDDEN = 0.2
#: Ratio from which noise hides no air.
_FAR = 6.0
_ONSET = ZEROS.index("onset")
#: By specimen and trial, mm.
Onsets = Mapping[tuple[str, str], float]


#: Ends of 95 % intervals by name, specimen and trial; and these of lanes.
Intervals = dict[tuple[str, str, str], tuple[float, float]]
Doubts = dict[int, Intervals]


class Found(NamedTuple):
    """What hidden air does to lanes.

    Attributes:
        asked: zeros that are taken.
        doubts: what comes out of lanes that air explains, too, but nothing else speaks for.
    """

    asked: Asked
    doubts: Doubts


class Noise(NamedTuple):
    """Forces of every lane against the noise of their records; (lanes,)."""

    ratio: Float[np.ndarray, " lanes"]
    error: Float[np.ndarray, " lanes"]


def hidden_air(
    study: Study, result: FitResult, asked: Asked, fit: Callable[[Study, np.ndarray], FitResult]
) -> Found:
    """Onsets and offsets without which lanes are not explained, and those that cannot be told.

    Args:
        study: with a recipe, whose records were looked at.
        result: of it.
        asked: zeros that its residuals ask for.
        fit: of some lanes, without scrutiny, from a start near what they were and another.
    """
    out = Found(Asked(dict(asked.names), dict(asked.value)), {})
    if study.recipe is None or study.recipe.zeros is None:
        return out
    able = able_zeros(result)
    noise = _against_records(study, result)
    misses = noise.ratio > 1 + _MISSES * noise.error
    misses[asking(study, asked)] = True
    # What chance adds to residuals does not follow from sample to sample; what a model misses does.
    samples = np.sum(study.lanes.precision > 0, axis=(1, 2))
    misses &= np.nan_to_num(result.effective.correlation) * np.sqrt(samples) > _FOLLOW
    lanes = np.flatnonzero(able[:, _ONSET].any(axis=1) & misses & (noise.ratio < _FAR))
    ends = np.full(able.shape[::2], np.nan)
    for k in lanes.tolist():
        for t, c in enumerate(study.curves[k]):
            if able[k, _ONSET, t]:
                ends[k, t] = _latest(c)
    best = {}
    for zeros in (ZEROS[:1], ZEROS) if len(lanes) else ():
        taken = able & np.isin(ZEROS, zeros)[:, None]
        names = {
            (c.specimen, c.trial): {ZEROS[z] for z in np.flatnonzero(taken[k, :, t])}
            for k in lanes.tolist()
            for t, c in enumerate(study.curves[k])
            if taken[k, :, t].any()
        }
        part = with_zeros(study, names, lanes)
        tried = fit(part, near_estimates(result, part, Asked({}, {}), lanes))
        gain = _gain(study, result, lanes, tried, noise) - _EACH * taken[lanes].sum(axis=(1, 2))
        for row, lane in enumerate(lanes.tolist()):
            least = best[lane].gain if lane in best else EVIDENCE
            if gain[row] > least and _in_air(study, lane, ends[lane], tried, row):
                best[lane] = _Reading(float(gain[row]), names, tried, row)
    for lane, (_, names, tried, row) in best.items():
        if not _witnessed(study, lane, tried, row):
            out.doubts[lane] = _intervals(tried, row)
            continue
        for key in [(c.specimen, c.trial) for c in study.curves[lane]]:
            out.asked.names.pop(key, None)
            out.asked.names.update({key: names[key]} if key in names else {})
        for (p, *of), value in zip(tried.study.unknowns[row], tried.value[row], strict=False):
            out.asked.value[of[0], of[1], p.name] = float(value)
    return out


class _Reading(NamedTuple):
    """Zeros that explain a lane: what they gain, and row `row` of the fit with them."""

    gain: float
    names: Mapping[tuple[str, str], set[str]]
    tried: FitResult
    row: int


def with_doubts(result: FitResult, doubts: Doubts) -> FitResult:
    """A fit that knows the intervals of lanes with air (`FitResult.with_air`)."""
    with_air = result.with_air.copy()
    for lane, found in doubts.items():
        for i, (p, name, trial) in enumerate(result.study.unknowns[lane]):
            none = (p.value, p.value) if p.auto else (np.nan, np.nan)
            with_air[lane, i] = found.get((p.name, name, trial), none)
    return dataclasses.replace(result, with_air=with_air) if doubts else result


def _intervals(tried: FitResult, row: int) -> Intervals:
    """95 % intervals of a lane; without ends where it does not know them."""
    out = {}
    for i, (p, name, trial) in enumerate(tried.study.unknowns[row]):
        found = assess(tried, row, i)
        known = np.isfinite([found.low, found.high]).all()
        out[p.name, name, trial] = (found.low, found.high) if known else (-np.inf, np.inf)
    return out


def _latest(curve: Curve) -> float:
    """Where a hidden air of a curve may end, mm: its flat beginning, or `_HIDDEN` of it."""
    D = curve.rising.displacement
    end = flat_until(D, curve.rising.force)
    return end if np.isfinite(end) else float(np.min(D) + _HIDDEN * np.ptp(D))


def _against_records(study: Study, result: FitResult) -> Noise:
    """Root mean square of the forces' residuals over the noise that records show."""
    assert study.recipe is not None
    assert study.recipe.zeros is not None
    count = np.sum(study.lanes.precision > 0, axis=2)
    trials = np.array([len(lane) for lane in study.curves])
    noise = np.zeros(count.shape)
    noise[np.arange(count.shape[1]) < trials[:, None]] = study.recipe.zeros.noise
    count = np.where(np.isnan(noise), 0, count)  # too few samples to tell theirs
    square, total = np.nansum(count * noise**2, axis=1), np.sum(count, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Noise(result.rms[:, 0] / np.sqrt(square / total), _SPREAD / np.sqrt(total))


def _onsets(result: FitResult, lane: int) -> Onsets:
    """Onsets that curves of a lane have taken."""
    rows = zip(result.study.unknowns[lane], result.value[lane].tolist(), strict=False)
    return {(name, trial): value for (p, name, trial), value in rows if p.name == "onset"}


def _span(curve: Curve) -> tuple[float, float]:
    """First displacement of a loading, and from sample to sample, mm."""
    D = curve.rising.displacement
    return float(np.min(D)), float(np.ptp(D)) / max(len(D) - 1, 1)


def _stay(study: Study, lane: int, onset: Onsets) -> list[bool]:
    """Of records of a lane that show air: whether these onsets are where they show them."""
    out = []
    for t, c in enumerate(study.curves[lane] if study.record_zeros is not None else ()):
        first, step = _span(c)
        assert study.record_zeros is not None
        shown = float(study.record_zeros[lane, t, 0])
        if shown > first:
            off = abs(onset.get((c.specimen, c.trial), first) - shown)
            out.append(off <= _STAYS * (shown - first) + step)
    return out


def _in_air(
    study: Study, lane: int, ends: Float[np.ndarray, " T"], tried: FitResult, row: int
) -> bool:
    """Whether onsets that are added lie between the first sample and where air may end (`ends`)."""
    onset = _onsets(tried, row)
    for c, end in zip(study.curves[lane], ends.tolist(), strict=False):
        first, step = _span(c)
        if np.isfinite(end) and not first - step <= onset[c.specimen, c.trial] <= end + step:
            return False
    return True


def _witnessed(study: Study, lane: int, tried: FitResult, row: int) -> bool:
    """Whether onsets of a lane, tried in `row`, are what its witnesses say.

    Those that records show are where these show them: where all move together, they stand for a law
    that is missing. Without such records markers stand still in all of the air.
    """
    onset = _onsets(tried, row)
    stay = _stay(study, lane, onset)
    if len(stay) >= _WITNESSES:
        return all(stay)
    return _markers_stand_still(study.curves[lane], onset, float(tried.rms[row, 1]))


def _markers_stand_still(curves: Sequence[Curve], onset: Onsets, noise: float) -> bool:
    """Whether markers do not move before the onsets, by more than twice their residuals."""
    still = []
    for c in curves:
        if c.joint_displacement is not None and (c.specimen, c.trial) in onset:
            before = c.joint_displacement[c.displacement < onset[c.specimen, c.trial]]
            seen = np.isfinite(before).any()
            still.append(float(np.sqrt(np.nanmean(before**2))) if seen else np.inf)
    return bool(still) and max(still) < _STILL * noise


def _gain(
    study: Study, result: FitResult, lanes: Int[np.ndarray, " n"], tried: FitResult, noise: Noise
) -> Float[np.ndarray, " n"]:
    """Gain in -2 ln L of lanes by a fit with more zeros; -inf where these do not explain them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = tried.rms / result.rms[lanes]
        explains = noise.ratio[lanes] * ratio[:, 0] < 1 + _EXPLAINS * noise.error[lanes]
        forces = np.sum(study.lanes.precision[lanes] > 0, axis=(1, 2))
        counts = np.stack([forces, result.samples[lanes] - forces], axis=1)
        gain = -2 * np.nansum(counts * np.log(ratio), axis=1)
    if study.noise_given[0]:
        gain = 2 * (result.cost[lanes] - tried.cost)
    return np.where(tried.succeeded & explains, gain, -np.inf)
