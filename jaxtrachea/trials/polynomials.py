"""Trials of many positions at once: one polynomial for all of a position against one for each.

Over the displacements that all trials of a position have, each is a cubic with noise (least
squares), and all of them are one, weighed by the noise of each: the F test of one cubic against one
for each says whether they differ, the cubics by how much.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxtrachea.measurements.curve import Curve

#: Share of the force from which trials differ, and probability of such an F by chance.
DIFFERS, CHANCE = 0.02, 1e-5
#: Terms of the polynomial, samples of a trial beyond them, and overlap as a share of the deepest.
_TERMS, _MORE, _OVERLAP = 4, 2, 0.3
#: Places at which trials are compared, as shares of what they have in common.
_AT = np.linspace(0.4, 1.0, 7)


class Stack(NamedTuple):
    """Samples of trials end to end.

    Attributes:
        displacement: (S,) mm.
        force: (S,) N.
        starts: (C,) first sample of each trial.
        first: (G,) first trial of each group.
        least: (G,) displacement from which samples of a group count, mm.
    """

    displacement: np.ndarray
    force: np.ndarray
    starts: np.ndarray
    first: np.ndarray
    least: np.ndarray

    @classmethod
    def of(cls, groups: Sequence[Sequence[Curve]]) -> "Stack":
        """The trials of some groups as recorded."""
        curves = [c for g in groups for c in g]
        sizes, counts = np.array([c.force.size for c in curves]), np.array([*map(len, groups)])
        D, F = (np.concatenate([getattr(c, n) for c in curves]) for n in ("displacement", "force"))
        first = np.cumsum(counts) - counts
        return cls(D, F, np.cumsum(sizes) - sizes, first, np.full(len(groups), -np.inf))

    def by_sample(self, of_trial: np.ndarray) -> np.ndarray:
        """A number of each trial, for each of its samples."""
        return np.repeat(of_trial, np.diff([*self.starts, self.force.size]))

    def by_trial(self, of_group: np.ndarray) -> np.ndarray:
        """A number of each group, for each of its trials."""
        counts = np.diff([*self.first, self.starts.size])
        return np.repeat(of_group, counts, axis=0)


class Comparison(NamedTuple):
    """Groups compared.

    Attributes:
        differs: (G,) whether trials differ.
        share, noise: (G,) see `Difference`.
        peak: (G,) largest force, N.
        apart, scaled: (G,) squared distance of trials from their mean, and from their mean times a
            factor of each, over what noise makes of it.
        force: of each group, see `Difference`.
        shift: (C,) mm by which each trial lies behind the mean of its group at most likeness.
        offset: (C,) N by which it then lies above.
    """

    differs: np.ndarray
    share: np.ndarray
    noise: np.ndarray
    peak: np.ndarray
    apart: np.ndarray
    scaled: np.ndarray
    force: list[np.ndarray]
    shift: np.ndarray
    offset: np.ndarray


def compare(stack: Stack) -> Comparison:
    """Trials of each group against each other, over the displacements that all have."""
    from scipy.special import fdtrc

    first, starts = stack.first, stack.starts
    low = np.minimum.reduceat(stack.displacement, starts)
    high = np.maximum.reduceat(stack.displacement, starts)
    begin = np.maximum(np.maximum.reduceat(low, first), stack.least)
    end = np.minimum.reduceat(high, first)
    common = end - begin > _OVERLAP * np.maximum.reduceat(high - low, first)
    width = np.where(common, end - begin, 1.0)
    t = (stack.displacement - stack.by_sample(stack.by_trial(begin))) / stack.by_sample(
        stack.by_trial(width)
    )
    gram, right, square, count = _moments(t, stack.force, starts)
    common &= np.minimum.reduceat(count, first) >= _TERMS + _MORE
    own, left = _solved(gram, right, square)
    free = np.maximum(count - _TERMS, 1)
    forces = own @ (_AT[:, None] ** np.arange(_TERMS)).T
    peak = np.maximum.reduceat(np.abs(forces).max(axis=1), first)
    variance = np.maximum(left / free, (1e-9 * stack.by_trial(peak)) ** 2)
    mean, together = _solved(
        *(np.add.reduceat(v / variance.reshape(-1, *[1] * (v.ndim - 1)), first, axis=0)
          for v in (gram, right, square))
    )  # fmt: skip
    trials = np.add.reduceat(np.ones(starts.size), first)
    more = _TERMS * (trials - 1)
    apart = together - np.add.reduceat(left / variance, first)
    span = np.maximum.reduceat(forces, first) - np.minimum.reduceat(forces, first)
    least = np.minimum.reduceat(np.abs(forces), first)
    least = np.maximum(np.sqrt(np.mean(least**2, axis=1)), 1e-3 * peak)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.sqrt(np.mean(span**2, axis=1)) / least
        noise = np.sqrt(np.add.reduceat(left, first) / np.add.reduceat(free, first)) / peak
        chance = fdtrc(more, trials / np.add.reduceat(1 / free, first), apart / more)
    usual = np.add.reduceat(forces.mean(axis=1), first) / trials
    usual = stack.by_trial(np.where(usual == 0, 1, usual))
    mean = stack.by_trial(mean)
    rest = _quadratic(gram, own - _factor(gram, own, mean)[:, None] * mean)
    shift, offset = _aligned(gram, own, mean)
    return Comparison(
        differs=common & (share > DIFFERS) & (chance < CHANCE),
        share=share,
        noise=noise,
        peak=peak,
        apart=apart / more,
        scaled=np.add.reduceat(rest / variance, first) / (more - trials + 1),
        force=np.split(forces.mean(axis=1) / usual, first[1:]),
        shift=shift * stack.by_trial(width),
        offset=offset,
    )


def _quadratic(gram: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Squared size of a polynomial over the samples of each trial."""
    return np.einsum("ci,cij,cj->c", v, gram, v)


def _factor(gram: np.ndarray, own: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Factor by which a mean curve comes closest to each."""
    along = np.einsum("ci,cij,cj->c", mean, gram, own)
    size = _quadratic(gram, mean)
    return along / np.where(size > 0, size, 1)


def _aligned(gram: np.ndarray, own: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shift (share of the width) and offset (N) by which a mean curve comes closest to each."""
    slope = np.zeros_like(mean)
    slope[:, :-1] = mean[:, 1:] * np.arange(1, _TERMS)
    constant = np.zeros_like(mean)
    constant[:, 0] = 1
    basis = np.stack([-slope, constant], axis=-1)
    weighted = np.swapaxes(basis, 1, 2) @ gram
    normal = weighted @ basis
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    normal += 1e-300 * np.eye(2)
    found = np.linalg.solve(normal, weighted @ (own - mean)[..., None])[..., 0]
    return np.clip(found[:, 0], -0.1, 0.1), found[:, 1]


def _moments(
    t: np.ndarray, F: np.ndarray, starts: Int[np.ndarray, " C"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Normal equations of a polynomial in t for each curve, of its samples from 0 to 1."""
    inside = ((t >= 0) & (t <= 1)).astype(float)
    force = F * inside
    powers, shifted, power = [], [], inside
    for k in range(2 * _TERMS - 1):
        powers.append(np.add.reduceat(power, starts))
        if k < _TERMS:
            shifted.append(np.add.reduceat(power * F, starts))
        power = power * t
    sums = np.stack(powers, axis=1)
    gram = sums[:, np.add.outer(np.arange(_TERMS), np.arange(_TERMS))]
    square = np.add.reduceat(force * F, starts)
    return gram, np.stack(shifted, axis=1), square, sums[:, 0]


def _solved(
    gram: np.ndarray, right: np.ndarray, square: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of least squares, and what is left of the squares."""
    ridge = 1e-12 * np.maximum(gram[:, :1, :1], 1) * np.eye(_TERMS)
    found = np.linalg.solve(gram + ridge, right[..., None])[..., 0]
    return found, np.maximum(square - np.sum(found * right, axis=1), 0)
