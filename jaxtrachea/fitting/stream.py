"""Curves that grow sample by sample, and the normal equations of what they hold so far.

The samples lie in blocks, each with its normal equations at a point of its own. A new sample, and
an estimate that has moved, cost as much whether there are ten samples or ten thousand: a few blocks
are evaluated anew, those that changed and those whose points are farthest from the estimate. The
sum of all blocks is the quadratic whose minimum a Gauss-Newton step finds; with every block at the
estimate it is that of a whole fit. One program evaluates blocks, however many there are.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.cost import evaluate
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.programs import cast, program

#: Samples of a block, and blocks that are evaluated together.
BLOCK, TOGETHER = 32, 4
#: Fields of a lane with an axis of samples, and with one of trials alone.
_OF_SAMPLES = ("displacement", "force", "precision")
_OF_TRIALS = ("s_c", "balance", "value", "index")
_OF_UNKNOWNS = ("lower", "upper", "active")


class Sums(NamedTuple):
    """Half the sum of squared residuals over sigma about a point, as a quadratic.

    Attributes:
        cost: at the point.
        gradient: (P,).
        hessian: of Gauss-Newton; (P, P).
    """

    cost: float
    gradient: Float[np.ndarray, " P"]
    hessian: Float[np.ndarray, "P P"]


class _Blocks(NamedTuple):
    """All blocks, with room for more.

    Attributes:
        place: trial, and which block of it.
        changed: it has samples that were not evaluated yet.
        evaluated: it has normal equations.
        point: where these were taken, scaled coordinates.
        cost: there.
        gradient: -
        hessian: -
    """

    place: Int[np.ndarray, "B 2"]
    changed: Bool[np.ndarray, " B"]
    evaluated: Bool[np.ndarray, " B"]
    point: Float[np.ndarray, "B P"]
    cost: Float[np.ndarray, " B"]
    gradient: Float[np.ndarray, "B P"]
    hessian: Float[np.ndarray, "B P P"]


class Stream:
    """Growing curves of one specimen, each at one position, and their normal equations.

    Attributes:
        study: one lane with room for some trials and samples; what is not yet measured is padding.
            Its arrays are written in place, and it has no `curves`.
        lengths: samples of each curve that has begun.
        residual: model minus data where each sample was evaluated last, N; NaN in padding;
            (1, T, N).
    """

    def __init__(self, study: Study, dtype: np.dtype):
        """No curve yet.

        Args:
            study: of one curve of `BLOCK` samples with sigma given: model, unknowns and sigma.
            dtype: of the evaluation; sums are of float64.
        """
        self._dtype, self._sigma = dtype, 1 / float(study.lanes.precision[0, 0, 0])
        self._program = program(evaluate, study.model)
        blank = {name: np.zeros((1, 1, BLOCK)) for name in _OF_SAMPLES}
        lanes = study.lanes._replace(**blank)
        self.study = dataclasses.replace(study, lanes=lanes, curves=((),), change_points=None)
        self.lengths: list[int] = []
        self.residual = np.full((1, 1, BLOCK), np.nan)
        P, self._count, self._first = study.size, 0, 0
        self._blocks = _Blocks(
            np.zeros((64, 2), int), np.zeros(64, bool), np.zeros(64, bool), np.zeros((64, P)),
            np.zeros(64), np.zeros((64, P)), np.zeros((64, P, P)),
        )  # fmt: skip
        self._make_room(8, 4 * BLOCK)

    def _make_room(self, trials: int, samples: int) -> None:
        """More padding; nothing is compiled."""
        lanes = self.study.lanes
        more = [(0, 0), (0, trials - lanes.force.shape[1]), (0, samples - lanes.force.shape[2])]
        new = {k: np.pad(getattr(lanes, k), more) for k in _OF_SAMPLES}
        for name in _OF_TRIALS:
            array = getattr(lanes, name)
            new[name] = np.pad(array, [*more[:2], (0, 0)][: array.ndim], mode="edge")
        self.residual = np.pad(self.residual, more, constant_values=np.nan)
        self.study = dataclasses.replace(self.study, lanes=lanes._replace(**new))

    def begin(self, s_c: float) -> None:
        """The next curve, at a position, mm."""
        trials, samples = self.study.lanes.force.shape[1:]
        if len(self.lengths) == trials:
            self._make_room(2 * trials, samples)
        self.study.lanes.s_c[0, len(self.lengths)] = s_c
        self.lengths.append(0)
        self._first = self._count

    def append(self, displacement: Float[np.ndarray, " n"], force: Float[np.ndarray, " n"]) -> None:
        """Samples of the curve begun last, mm and N."""
        trials, samples = self.study.lanes.force.shape[1:]
        begin, end = self.lengths[-1], self.lengths[-1] + len(force)
        if end > samples:
            self._make_room(trials, 2 * BLOCK * -(-end // BLOCK))
        lanes, t, new = self.study.lanes, len(self.lengths) - 1, slice(begin, end)
        lanes.displacement[0, t, new], lanes.force[0, t, new] = displacement, force
        lanes.precision[0, t, new] = 1 / self._sigma
        self.lengths[-1] = end
        numbers = np.arange(begin // BLOCK, -(-end // BLOCK))
        self._count = self._first + int(numbers[-1]) + 1
        while self._count > len(self._blocks.cost):
            grown = (np.concatenate([v, np.zeros_like(v)]) for v in self._blocks)
            self._blocks = _Blocks(*grown)
        self._blocks.place[self._first + numbers] = np.stack([np.full_like(numbers, t), numbers], 1)
        self._blocks.changed[self._first + numbers] = True

    def evaluate(
        self,
        theta: Float[np.ndarray, " P"],
        unit: Float[np.ndarray, " P"],
        *,
        everything: bool = False,
    ) -> bool:
        """Take blocks anew at `theta`: all that changed, and of the others the farthest, or all.

        Args:
            theta: scaled coordinates.
            unit: of every unknown, in which distances are measured.
            everything: all blocks.

        Returns:
            Whether the model gave finite numbers; where not, blocks are as they were.
        """
        n = self._count
        changed = self._blocks.changed[:n]
        far = np.max(np.abs(self._blocks.point[:n] - theta) / unit, axis=1)
        order = np.argsort(np.where(changed, -np.inf, -far), kind="stable")
        least = n if everything else max(int(changed.sum()), 1)
        firsts = range(0, least, TOGETHER)
        return all([self._evaluate(order[i : i + TOGETHER], theta) for i in firsts])

    def _evaluate(self, chosen: Int[np.ndarray, " b"], theta: Float[np.ndarray, " P"]) -> bool:
        """At most `TOGETHER` blocks."""
        lanes, count = self.study.lanes, len(chosen)
        t, number = self._blocks.place[np.resize(chosen, TOGETHER)].T
        part = {k: getattr(lanes, k)[0, t][:, None] for k in _OF_TRIALS}
        part |= {k: self._by_block(getattr(lanes, k))[t, number][:, None] for k in _OF_SAMPLES}
        part |= {k: np.repeat(getattr(lanes, k), TOGETHER, 0) for k in _OF_UNKNOWNS}
        given = np.tile(theta, (TOGETHER, 1)), lanes._replace(**part), np.ones((TOGETHER, 2))
        point = self._program(*cast(given, self._dtype))
        found = (point.cost, point.gradient, point.hessian, point.value)
        cost, gradient, hessian, value = (np.asarray(v, np.float64)[:count] for v in found)
        if not (np.isfinite(cost).all() and np.isfinite(hessian).all()):
            return False
        blocks = self._blocks
        blocks.point[chosen], blocks.cost[chosen] = theta, cost
        blocks.gradient[chosen], blocks.hessian[chosen] = gradient, hessian
        blocks.changed[chosen], blocks.evaluated[chosen] = False, True
        value = np.where(part["precision"][:count, 0] > 0, value[:, 0] * self._sigma, np.nan)
        self._by_block(self.residual)[t[:count], number[:count]] = value
        return True

    @staticmethod
    def _by_block(array: Float[np.ndarray, "1 T N"]) -> Float[np.ndarray, "T blocks samples"]:
        """A view of samples, block by block."""
        return array[0].reshape(array.shape[1], -1, BLOCK)

    def sums(self, theta: Float[np.ndarray, " P"]) -> Sums:
        """The quadratics of all blocks, about `theta`."""
        # What was never evaluated is zeros.
        blocks = _Blocks(*(v[: self._count] for v in self._blocks))
        away = np.where(blocks.evaluated[:, None], theta - blocks.point, 0)
        bent = np.einsum("bij,bj->bi", blocks.hessian, away)
        cost = blocks.cost.sum() + np.sum(away * (blocks.gradient + 0.5 * bent))
        gradient = (blocks.gradient + bent).sum(axis=0)
        return Sums(float(cost), gradient, blocks.hessian.sum(axis=0))

    def information(self, sums: Sums) -> Information:
        """The same as a fit has it, of the one lane."""
        count, square = float(sum(self.lengths)), np.array([[2 * sums.cost, 0.0]])
        return Information(
            bread=sums.hessian[None], meat=sums.hessian[None], gradient=sums.gradient[None],
            squares=square, plain=square * self._sigma**2, counts=np.array([[count, 0.0]]),
            spread=np.zeros((1, 2)), psi2=square / max(count, 1.0), dpsi=np.ones(1),
        )  # fmt: skip
