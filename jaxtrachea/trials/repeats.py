"""What is said of trials at one position that differ, and which condition goes along with it."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from jaxtrachea.measurements.curve import Curve
from jaxtrachea.trials.differences import Difference, differing_trials
from jaxtrachea.trials.uneven_noise import uneven_noise

#: Correlation of force and a condition, within positions, from which they go along.
ALONG = 0.9
#: Positions that are named.
_NAMED = 3
_NUMBER = re.compile(r"\d+")
_NUMBER_OF_TRIAL = "the number of the trial"
#: Conditions that vary by less, as a share of their size, are one.
_SAME = 0.01


def trial_sentences(
    curves: Sequence[Curve],
    *,
    found: Sequence[Difference] | None = None,
    weighed: bool = False,
) -> list[str]:
    """What a fit says of its curves against each other.

    Args:
        found: their `differing_trials`, where these are known.
        weighed: whether each counts by its own noise, so that noise that differs is no matter.
    """
    found = differing_trials(curves) if found is None else found
    return [*repeat_sentences(found), *(() if weighed else uneven_noise(curves))]


def repeat_sentences(found: Sequence[Difference]) -> Iterator[str]:
    """What is said of trials that differ, with the conditions that go along with it."""
    if not found:
        return
    cause = _cause(found)
    places = "; ".join(
        f"{_place(d.trials[0])} differ by {_percent(d.share)}, their noise is {_percent(d.noise)}"
        for d in found[:_NAMED]
    )
    more = f"; and at {len(found) - _NAMED} more positions" if len(found) > _NAMED else ""
    yield (
        f"{places}{more}{cause}: unknowns that they share are those of their mean, and no interval "
        "covers the difference"
    )


def trial_remarks(found: Sequence[Difference]) -> dict[tuple[str, str], str]:
    """What curves.csv says of every trial that differs from another, by specimen and trial."""
    cause = _cause(found)
    return {
        (c.specimen, c.trial): f"trials at its position differ by {_percent(d.share)}{cause}"
        for d in found
        for c in d.trials
    }


def _cause(found: Sequence[Difference]) -> str:
    """Conditions that go along with the differences, as the end of a sentence; "": none."""
    along = conditions_along(found)
    return f"; the force goes along with {' and '.join(along)}" if along else ""


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "more than 100 %"


def _place(curve: Curve) -> str:
    """``trials of T01 at s = 40 mm``."""
    where = "" if curve.s_c is None else f" at s = {curve.s_c:.4g} mm"
    around = f", phi = {np.degrees(curve.phi_c):.3g} deg" if curve.phi_c else ""
    return f"trials of {curve.specimen}{where}{around}"


def conditions_along(found: Sequence[Difference]) -> list[str]:
    """Conditions that grow or fall with the force of trials, with their range.

    Numbers of the files that have no other role, the speed where there is a time, and last the
    number of the trial; within positions, each against its mean.
    """
    names = dict.fromkeys(name for d in found for c in d.trials for name in conditions_of(c))
    texts = []
    for name in sorted(names, key=_NUMBER_OF_TRIAL.__eq__):
        x, y, seen = [], [], []
        for d in found:
            values = np.array([conditions_of(c).get(name, np.nan) for c in d.trials])
            known = np.isfinite(values)
            span = float(np.ptp(values[known])) if known.any() else 0.0
            if span > _SAME * float(np.abs(values[known]).max(initial=0)):
                x += ((values[known] - values[known].mean()) / span).tolist()
                y += (d.force[known] - d.force[known].mean()).tolist()
                seen += values[known].tolist()
        correlation = float(np.corrcoef(x, y)[0, 1]) if x else 0.0
        if abs(correlation) >= ALONG:
            way = "grows" if correlation > 0 else "falls"
            texts.append(f"{name} ({min(seen):.4g} to {max(seen):.4g}, with which it {way})")
    return texts


def conditions_of(curve: Curve) -> dict[str, float]:
    """What is known of a trial besides its curve: its conditions, its speed, its number."""
    known = dict(curve.conditions)
    first = curve.rising
    if first.time is not None and first.time.size > 1 and first.time[-1] > first.time[0]:
        way = float(np.ptp(first.displacement))
        known["speed [mm/s]"] = way / float(first.time[-1] - first.time[0])
    if numbers := _NUMBER.findall(curve.trial):
        known[_NUMBER_OF_TRIAL] = float(numbers[-1])
    return known
