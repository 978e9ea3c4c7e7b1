"""The next presses, one by one: what each candidate adds, and the criteria that compare them."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea.inference.design.candidates import Candidates
from jaxtrachea.inference.design.press import (
    Guess,
    Place,
    index_of_presses,
    marginal,
    press_informations,
)
from jaxtrachea.inference.design.situation import Situation

Criterion = Literal["D", "A", "E"]


#: Numbers of the matrices that are inverted together.
_NUMBERS = 1 << 20


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """Points chosen one after the other.

    Attributes:
        chosen: candidate of each step; (n,).
        score: of every candidate at each step, mean over guesses, larger is better; see `scores`;
            (n, C).
        error: relative standard error of every unknown before and after each step, as the fit has
            it and a refit would have it, root mean square over guesses; (n + 1, P).
    """

    chosen: Int[np.ndarray, " n"]
    score: Float[np.ndarray, "n C"]
    error: Float[np.ndarray, "m P"]


def gains(known: Situation, candidates: Candidates) -> Float[np.ndarray, "G C Q Q"]:
    """What a press at every candidate adds to the bread of what it shares, for every guess.

    Its information times the weight of its curve, in relative coordinates; what the press has of
    its own is eliminated. A candidate without equilibrium at some sample tells nothing: zeros.

    Raises:
        ValueError: angles for a skeleton that is pressed on the midline alone; a force that relaxes
            without speeds and holds, or these without such a force.
    """
    study = known.study
    if candidates.phi is not None and not study.model.level.off_midline:
        raise ValueError("presses off the midline need the skeleton 'sections'; leave phi out")
    if study.model.relaxes != (candidates.speed is not None and candidates.hold is not None):
        raise ValueError("presses have a speed and a hold where the force relaxes, and only there")
    parts = []
    curve = np.zeros(len(candidates.s), int) if candidates.curve is None else candidates.curve
    for g, k in enumerate(known.lane):
        blend = None if known.blend is None else known.blend[g]
        guess = Guess(known.theta[g], study.lanes.value[k, 0], blend, known.approach[k])
        index = index_of_presses(study, int(k), curve)
        of = candidates
        place = Place(of.s, of.depth, of.phi, index, of.speed, of.hold)
        matrix = press_informations(study, known.samples, guess, place)
        matrix = matrix * (known.weight[g] / known.sigma[g] ** 2)
        matrix = np.nan_to_num(matrix, posinf=0.0, neginf=0.0)
        parts.append(matrix * known.relative[g][:, None] * known.relative[g])
    added = np.stack(parts)
    if known.kept.shape[1] == added.shape[-1]:
        return added
    # What a press brings of its own is known no better than its bounds say.
    for matrix, own, prior in zip(added, known.own, known.prior, strict=True):
        matrix[:, own, own] += prior[own]
    rows = np.concatenate([known.kept, known.own], axis=1)
    of_press = np.stack([m[:, r[:, None], r[None]] for m, r in zip(added, rows, strict=True)])
    shared = np.tile(np.arange(known.kept.shape[1]), (len(rows), 1))
    return marginal(of_press, of_press, shared)[0]


def scores(
    bread: Float[np.ndarray, "G C P P"], meat: Float[np.ndarray, "G C P P"], criterion: Criterion
) -> Float[np.ndarray, " C"]:
    """What is to be made large, of the covariance V = bread^-1 meat bread^-1 of the estimates.

    Minus its mean log determinant over guesses (D), minus the log of its mean variance (A), minus
    the mean log of its largest eigenvalue (E).
    """
    check_word("criterion", criterion, Criterion)
    if criterion == "D":
        logs = 2 * np.linalg.slogdet(bread)[1] - np.linalg.slogdet(meat)[1]
        return np.mean(logs, axis=0)
    variance = covariance(bread, meat)
    if criterion == "A":
        mean = np.mean(np.diagonal(variance, axis1=-2, axis2=-1), axis=-1)
        return -np.log(np.mean(mean, axis=0))
    return -np.mean(np.log(np.linalg.eigvalsh(variance)[..., -1]), axis=0)


def covariance(bread: np.ndarray, meat: np.ndarray) -> np.ndarray:
    """The sandwich, of many matrices (..., P, P)."""
    inverse = np.linalg.inv(bread)
    return inverse @ meat @ inverse


def scores_after(
    known: Situation, added: Float[np.ndarray, "G C Q Q"], criterion: Criterion
) -> Float[np.ndarray, " C"]:
    """`scores` after a press at every candidate, so many at a time that they take no memory."""
    check_word("criterion", criterion, Criterion)
    guesses, count, size, _ = added.shape
    together = max(_NUMBERS // max(guesses * size * size, 1), 1)
    parts = []
    for first in range(0, count, together):
        part = added[:, first : first + together]
        meat = known.meat[:, None] + known.factor[:, None, None, None] * part
        parts.append(scores(known.base[:, None] + part, meat, criterion))
    return np.concatenate(parts)


def next_points(
    known: Situation,
    candidates: Candidates,
    count: int = 1,
    criterion: Criterion = "D",
    added: Float[np.ndarray, "G C Q Q"] | None = None,
) -> Choice:
    """Choose presses one by one, each the best after those before it; one may come twice.

    Args:
        known: from `situation`.
        candidates: reachable presses.
        count: how many to choose.
        criterion: D (volume of the error ellipsoid), A (mean variance) or E (worst combination).
        added: the `gains`, where they are known; None: computed.
    """
    check_word("criterion", criterion, Criterion)
    added = gains(known, candidates) if added is None else added
    # A press that tells nothing takes nothing away either, where weights let others do so.
    telling = np.any(np.diagonal(added, axis1=-2, axis2=-1) > 0, axis=(0, 2))
    telling = np.asarray(telling if np.any(telling) else ~telling, bool)
    chosen, table, errors = [], [], [_errors(known)]
    for _ in range(count):
        table.append(scores_after(known, added, criterion))
        chosen.append(int(np.argmax(np.where(telling, table[-1], -np.inf))))
        known = known.with_press(added[:, chosen[-1]])
        errors.append(_errors(known))
    return Choice(np.array(chosen), np.stack(table), np.stack(errors))


def _errors(known: Situation) -> np.ndarray:
    variance = np.diagonal(covariance(known.base, known.meat), axis1=-2, axis2=-1)
    return np.sqrt(np.mean(variance, axis=0))
