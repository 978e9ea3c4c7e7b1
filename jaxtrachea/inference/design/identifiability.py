"""How well presses along the tube tell the unknowns apart."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.inference.design.candidates import Candidates
from jaxtrachea.inference.design.choice import gains
from jaxtrachea.inference.design.situation import Situation


class Map(NamedTuple):
    """How well curves at given positions tell the unknowns apart; means over guesses.

    Attributes:
        s: mm; (n,).
        phi: of all presses, rad.
        condition: after a press at s on top of the data; of the scaled Jacobian, as in a fit; (n,).
        weakest: unit vector of the least determined combination then, relative; (n, P).
        pairs: condition of a press at s and one at s', without any data, of the unknowns of the
            specimen that is pressed; (n, n).
        curve: a curve of that specimen, see `Candidates`.
    """

    s: Float[np.ndarray, " n"]
    phi: float
    condition: Float[np.ndarray, " n"]
    weakest: Float[np.ndarray, "n P"]
    pairs: Float[np.ndarray, "n n"]
    curve: int = 0


def identifiability(
    known: Situation,
    s: Float[np.ndarray, " n"],
    depth: float,
    phi: float = 0.0,
    curve: int = 0,
    pace: tuple[float, float] | None = None,
) -> Map:
    """Condition and weakest direction of presses to `depth` (mm) at every position (mm).

    At one angle (rad), on the specimen of a curve, with one speed and hold where the force relaxes
    (see `Candidates`). Conditions are geometric
    means over the guesses, directions those of the first guess.
    """
    angles = np.full(len(s), phi) if phi else None
    curves = np.full(len(s), curve) if curve else None
    timed = () if pace is None else (np.full(len(s), v) for v in pace)
    added = gains(known, Candidates(s, np.full(len(s), depth), angles, curves, *timed))
    values, vectors = np.linalg.eigh(known.base[:, None] + added)
    condition = np.exp(np.mean(0.5 * np.log(values[..., -1] / values[..., 0]), axis=0))
    weakest = vectors[0, :, :, 0]
    largest = np.take_along_axis(weakest, np.argmax(np.abs(weakest), axis=1)[:, None], axis=1)
    total = 0.0
    index = known.study.lanes.index
    for matrix, kept, k in zip(added, known.kept, known.lane, strict=True):
        read = np.flatnonzero(np.isin(kept, index[k, curve]))
        matrix = matrix[:, read[:, None], read[None]]
        values = np.linalg.eigvalsh(matrix[:, None] + matrix[None])
        low = np.maximum(values[..., 0], 1e-14 * values[..., -1])
        nothing = values[..., -1] <= 0  # neither press tells anything
        ratio = values[..., -1] / np.where(nothing, 1, low)
        total = total + np.where(nothing, np.inf, 0.5 * np.log(np.where(nothing, 1, ratio)))
    return Map(s, phi, condition, weakest * np.sign(largest), np.exp(total / len(added)), curve)
