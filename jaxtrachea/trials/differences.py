"""Trials at one position that differ by more than their noise: many positions at once.

They are compared over the displacements that all have (`polynomials`). Trials with air before the
touch are moved to where they are most alike.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.whole_record import speed_of
from jaxtrachea.trials.polynomials import Stack, compare

#: Halves of what may be air, as shares of the travel, and the share of its force that a trial gains
#: in air from one to the other at most; share of the force from which trials from air are compared;
#: rounds of moving them.
_AIR, _RISES, _LEVEL, _MOVES = 0.05, 0.01, 0.06, 4
#: Samples of a trial in air from which its touch is known well enough to say that trials differ.
_FEWEST = 40
#: Samples that are looked at together.
_BLOCK = 2**18


class Difference(NamedTuple):
    """Trials at one position that differ.

    Attributes:
        trials: the curves.
        share: root mean square of the span of their forces over that of the smallest.
        noise: standard deviation of a sample about its own curve, over the largest force.
        force: (T,) force of each, as a share of their mean.
    """

    trials: tuple[Curve, ...]
    share: float
    noise: float
    force: Float[np.ndarray, " T"]


def differing_trials(curves: Sequence[Curve]) -> list[Difference]:
    """Positions whose trials differ by more than `polynomials.DIFFERS` and more than their noise.

    Args:
        curves: of any number of specimens and positions; those alone at theirs, or without one,
            are passed over. Whole records are compared in their first loading, with others as
            quick.

    Returns:
        The largest difference first.
    """
    groups: dict[tuple, list[Curve]] = {}
    for c in curves:
        if c.s_c is None:
            continue
        place = round(c.s_c, 1), round(c.phi_c, 3), c.direction, _pace(c)
        groups.setdefault((c.specimen, *place), []).append(c.rising)
    several = [g for g in groups.values() if len(g) > 1]
    found = []
    for block in _blocks(several):
        seen = compare(Stack.of(block))
        which = np.flatnonzero(seen.differs)
        if not which.size:
            continue
        odd = [block[k] for k in which.tolist()]
        raw = compare(stack := Stack.of(odd))
        stack, in_air = _from_touch(stack, raw.noise * raw.peak)
        moved = compare(stack)
        few = np.array([min(c.force.size for c in g) < _FEWEST for g in odd])
        # What a factor explains better than a shift is no air of another length.
        scaled = raw.scaled < np.maximum(moved.apart, 1)
        for k in range(len(odd)):
            seen = raw if scaled[k] else moved
            if seen.differs[k] and not (in_air[k] and few[k]):
                numbers = float(seen.share[k]), float(seen.noise[k]), seen.force[k]
                found.append(Difference(tuple(odd[k]), *numbers))
    return sorted(found, key=lambda d: -d.share)


def _pace(curve: Curve) -> int | None:
    """Speed of the first loading of a whole record, which its force follows; in steps of 20 %."""
    if curve.rise is None or curve.time is None:
        return None
    first = curve.rising
    assert first.time is not None
    speed = speed_of(first.time, first.displacement)
    return round(np.log(speed) / 0.2) if speed > 0 else None


def _blocks(groups: Sequence[list[Curve]]) -> Iterator[list[list[Curve]]]:
    """Groups some at a time, so that their samples stay in the cache."""
    picked, count = [], 0
    for g in groups:
        picked.append(g)
        count += sum(c.force.size for c in g)
        if count >= _BLOCK:
            yield picked
            picked, count = [], 0
    if picked:
        yield picked


def _from_touch(stack: Stack, noise: np.ndarray) -> tuple[Stack, np.ndarray]:
    """Trials that begin in air, moved to where they are most alike; others stay as they are.

    A trial begins in air, or as softly, where its force hardly grows over the first tenth of its
    travel. It is counted from where its force leaves that of the air, and only beyond.

    Returns:
        The trials, and which groups have some in air.
    """
    starts, first = stack.starts, stack.first
    low = np.minimum.reduceat(stack.displacement, starts)
    span = np.maximum.reduceat(stack.displacement, starts) - low
    share = (stack.displacement - stack.by_sample(low)) / stack.by_sample(
        np.where(span > 0, span, 1)
    )
    zero, _ = _mean(stack, share <= _AIR)
    force = stack.force - stack.by_sample(zero)
    top = np.maximum.reduceat(force, starts)
    rise, count = _mean(stack._replace(force=force), (share > _AIR) & (share <= 2 * _AIR))
    error = stack.by_trial(noise) * np.sqrt(2 / np.maximum(count, 1))
    surely = np.logical_or.reduceat(rise < _RISES * top, first)
    air = (rise < _RISES * top + 2 * error) & stack.by_trial(surely)
    in_air = np.logical_or.reduceat(air, first)
    if not in_air.any():
        return stack, in_air
    lowest = np.minimum.reduceat(top, first)
    level = stack.by_trial(np.minimum(np.maximum(_LEVEL * lowest, 5 * noise), 0.3 * lowest))
    below = np.where(force < stack.by_sample(level), stack.displacement, -np.inf)
    reached = np.maximum(np.maximum.reduceat(below, starts), low)
    others = np.add.reduceat(np.where(air, 0.0, reached), first)
    count = np.add.reduceat((~air).astype(float), first)
    reference = np.where(count > 0, others / np.maximum(count, 1), 0.0)
    least = np.where(in_air, reference, -np.inf)
    shift = np.where(air, reached - stack.by_trial(reference), 0.0)
    offset = np.where(air, zero, 0.0)
    begin, moved = shift, stack
    reach = (_AIR + 4 * stack.by_trial(noise) / top) * span
    for _ in range(_MOVES):
        moved = stack._replace(
            displacement=stack.displacement - stack.by_sample(shift),
            force=stack.force - stack.by_sample(offset),
            least=least,
        )
        found = compare(moved)
        shift = np.clip(shift + np.where(air, found.shift, 0), begin - reach, begin + reach)
        offset = offset + np.where(air, found.offset, 0)
    return moved, in_air


def _mean(stack: Stack, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean force of some samples of each trial, N, 0 of none, and how many they are."""
    count = np.add.reduceat(which.astype(float), stack.starts)
    total = np.add.reduceat(np.where(which, stack.force, 0), stack.starts)
    return total / np.maximum(count, 1), count
