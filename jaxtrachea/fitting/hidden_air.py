"""Air that records hide behind a soft beginning, of specimens whose fit misses their curves.

A record by itself cannot tell some air from a press whose law begins soft: it then takes no onset.
Where that is wrong the whole specimen is: the other curves follow, and the fit ends in a minimum
from which no small change asks for an onset (`omitted_zeros`). So a specimen whose residuals are
larger than the noise of its records, and whose curves may begin in air, is fitted once more with
the onsets of these curves, and then with offsets, too. They are taken where the curves are then
explained to their noise, the likelihood gains more than so many unknowns do by chance, and
something beside the shape of these curves speaks for air, since a law that is missing from the
model may look the same: the record of another curve that shows it, or markers that stand still.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.build import with_zeros
from jaxtrachea.fitting.omitted_zeros import ZEROS, Asked, able_zeros
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.record_zeros import EVIDENCE, begins_flat

#: Relative error of the noise of n samples, as a record tells it, times sqrt(n).
_SPREAD = 1.2
#: Such errors by which residuals exceed the noise where another fit is worth its time, and up to
#: which they may where it explains the curves.
_MISSES, _EXPLAINS = 2.0, 3.0
#: Gain in -2 ln L of each further zero beside `EVIDENCE`.
_EACH = 4.0
_ONSET = ZEROS.index("onset")


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
    shown = _shown(study)
    misses &= shown | (result.samples > np.sum(study.lanes.precision > 0, axis=(1, 2)))
    lanes = np.flatnonzero(able[:, _ONSET].any(axis=1) & misses)
    flat = np.zeros(able.shape[::2], bool)
    for k in lanes.tolist():
        flat[k] = able[k, _ONSET] & _begin_flat(study, k)
    able &= flat[:, None]
    lanes = lanes[flat[lanes].any(axis=1)]
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
        better = _better(study, result, lanes, tried, noise, added, shown[lanes])
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
    trials = np.array([len(lane) for lane in study.curves])
    count = np.sum(study.lanes.precision > 0, axis=2)
    of = np.repeat(np.arange(len(trials)), trials)
    each = count[of, np.arange(len(of)) - np.repeat(np.cumsum(trials) - trials, trials)]
    square = np.bincount(of, each * study.recipe.zeros.noise**2, len(trials))
    total = np.bincount(of, each, len(trials))
    with np.errstate(divide="ignore", invalid="ignore"):
        return Noise(result.rms[:, 0] / np.sqrt(square / total), _SPREAD / np.sqrt(total))


def _shown(study: Study) -> Bool[np.ndarray, " lanes"]:
    """Lanes of which a record shows air."""
    if study.record_zeros is None:
        return np.zeros(len(study.curves), bool)
    seen = study.lanes.precision > 0
    first = np.min(np.where(seen, study.lanes.displacement, np.inf), axis=2)
    return np.any(study.record_zeros[..., 0] > first, axis=1)


def _begin_flat(study: Study, lane: int) -> Bool[np.ndarray, " T"]:
    """Curves of a lane that may begin in air."""
    out = np.zeros(study.lanes.s_c.shape[1], bool)
    for t, c in enumerate(study.curves[lane]):
        rising = c.rising
        out[t] = begins_flat(np.asarray(rising.displacement), np.asarray(rising.force))
    return out


def _better(
    study: Study,
    result: FitResult,
    lanes: Int[np.ndarray, " n"],
    tried: FitResult,
    noise: Noise,
    added: Int[np.ndarray, " n"],
    shown: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Lanes that are explained with `added` zeros and gain enough, and whose air is `shown`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = tried.rms / result.rms[lanes]
        explains = noise.ratio[lanes] * ratio[:, 0] < 1 + _EXPLAINS * noise.error[lanes]
        forces = np.sum(study.lanes.precision[lanes] > 0, axis=(1, 2))
        counts = np.stack([forces, result.samples[lanes] - forces], axis=1)
        each = np.nan_to_num(-2 * counts * np.log(ratio))
        gain = np.sum(each, axis=1)
    if study.noise_given[0]:
        gain = 2 * (result.cost[lanes] - tried.cost)
    shown = shown | (each[:, 1] > EVIDENCE)
    return tried.succeeded & explains & shown & (gain > EVIDENCE + _EACH * added)
