"""Air that records hide behind a soft beginning, of specimens whose fit misses their curves.

A record by itself cannot tell some air from a press whose law begins soft: it then takes no onset.
Where that is wrong the whole specimen is: the other curves follow, and the fit ends in a minimum
from which no small change asks for an onset (`omitted_zeros`). So a specimen is fitted once more
with the onsets of its curves that may begin in air, and then with offsets, too, where its residuals
are larger than the noise of its records and something speaks for air: two other records show it,
and the fit has moved an onset away from there, or it has markers, which stand still in air. A law
that is missing from the model may look the same otherwise. The onsets are taken where the curves
are then explained to their noise, the likelihood gains more than so many unknowns do by chance, and
these witnesses agree.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.build import with_zeros
from jaxtrachea.fitting.omitted_zeros import ZEROS, Asked, able_zeros
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.record_zeros import EVIDENCE, flat_until

#: Relative error of the noise of n samples, as a record tells it, times sqrt(n).
_SPREAD = 1.2
#: Such errors by which residuals exceed the noise where another fit is worth its time, and up to
#: which they may where it explains the curves.
_MISSES, _EXPLAINS = 2.0, 3.0
#: Gain in -2 ln L of each further zero beside `EVIDENCE`.
_EACH = 4.0
#: Records of a specimen that must show air, share of it by which their onsets may move, and
#: standard deviations of markers that stand still.
_WITNESSES, _STAYS, _STILL = 2, 0.15, 2.0
_ONSET = ZEROS.index("onset")
#: By specimen and trial, mm.
Onsets = Mapping[tuple[str, str], float]


class Noise(NamedTuple):
    """Forces of every lane against the noise of their records; (lanes,)."""

    ratio: Float[np.ndarray, " lanes"]
    error: Float[np.ndarray, " lanes"]


def hidden_air(study: Study, result: FitResult, fit: Callable[[Study], FitResult]) -> Asked:
    """Onsets and offsets without which lanes are not explained, and all that their fits find.

    Args:
        study: with a recipe, whose records were looked at.
        result: of it.
        fit: of some lanes, without scrutiny.
    """
    out = Asked({}, {})
    if study.recipe is None or study.recipe.zeros is None:
        return out
    able = able_zeros(result)
    noise = _against_records(study, result)
    misses = noise.ratio > 1 + _MISSES * noise.error
    marked = result.samples > np.sum(study.lanes.precision > 0, axis=(1, 2))
    lanes = np.flatnonzero(able[:, _ONSET].any(axis=1) & misses)
    stay = {k: _stay(study, k, _onsets(result, k)) for k in lanes.tolist()}
    moved = [k for k, v in stay.items() if False in v and len(v) >= _WITNESSES]
    lanes = lanes[marked[lanes] | np.isin(lanes, moved)]
    ends = np.full(able.shape[::2], np.nan)
    for k in lanes.tolist():
        for t, c in enumerate(study.curves[k]):
            if able[k, _ONSET, t]:
                ends[k, t] = flat_until(c.rising.displacement, c.rising.force)
    able &= np.isfinite(ends)[:, None]
    lanes = lanes[np.isfinite(ends[lanes]).any(axis=1)]
    for zeros in (ZEROS[:1], ZEROS):  # an offset, too, where an onset alone does not explain it
        if not len(lanes):
            break
        taken = able & np.isin(ZEROS, zeros)[:, None]
        names = {
            (c.specimen, c.trial): {ZEROS[z] for z in np.flatnonzero(taken[k, :, t])}
            for k in lanes.tolist()
            for t, c in enumerate(study.curves[k])
            if taken[k, :, t].any()
        }
        tried = fit(with_zeros(study, names, lanes))
        added = np.sum(taken[lanes], axis=(1, 2))
        better = _better(study, result, lanes, tried, noise, added)
        for row in np.flatnonzero(better).tolist():
            better[row] = _is_air(study, int(lanes[row]), ends[lanes[row]], tried, row)
        for row in np.flatnonzero(better).tolist():
            keys = [(c.specimen, c.trial) for c in study.curves[lanes[row]]]
            out.names.update({key: names[key] for key in keys if key in names})
            for (p, *of), value in zip(tried.study.unknowns[row], tried.value[row], strict=False):
                out.value[of[0], of[1], p.name] = float(value)
        lanes = lanes[~better]
    return out


def _against_records(study: Study, result: FitResult) -> Noise:
    """Root mean square of the forces' residuals over the noise that records show."""
    assert study.recipe is not None
    assert study.recipe.zeros is not None
    count = np.sum(study.lanes.precision > 0, axis=2)
    trials = np.array([len(lane) for lane in study.curves])
    noise = np.zeros(count.shape)
    noise[np.arange(count.shape[1]) < trials[:, None]] = study.recipe.zeros.noise
    square, total = np.sum(count * noise**2, axis=1), np.sum(count, axis=1)
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


def _is_air(
    study: Study, lane: int, ends: Float[np.ndarray, " T"], tried: FitResult, row: int
) -> bool:
    """Whether onsets of a lane, tried in `row`, are what its witnesses say.

    An onset that is added lies between the first sample and the end of its flat beginning (`ends`,
    NaN: not added). Those that records show are back where these show them: where all move
    together, they stand for a law that is missing. Without such records markers stand still in all
    of the air.
    """
    onset = _onsets(tried, row)
    for c, end in zip(study.curves[lane], ends.tolist(), strict=False):
        first, step = _span(c)
        if np.isfinite(end) and not first < onset[c.specimen, c.trial] <= end + step:
            return False
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


def _better(
    study: Study,
    result: FitResult,
    lanes: Int[np.ndarray, " n"],
    tried: FitResult,
    noise: Noise,
    added: Int[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Lanes that are explained with `added` zeros, and gain enough by them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = tried.rms / result.rms[lanes]
        explains = noise.ratio[lanes] * ratio[:, 0] < 1 + _EXPLAINS * noise.error[lanes]
        forces = np.sum(study.lanes.precision[lanes] > 0, axis=(1, 2))
        counts = np.stack([forces, result.samples[lanes] - forces], axis=1)
        gain = -2 * np.nansum(counts * np.log(ratio), axis=1)
    if study.noise_given[0]:
        gain = 2 * (result.cost[lanes] - tried.cost)
    return tried.succeeded & explains & (gain > EVIDENCE + _EACH * added)
