"""Curves that grow sample by sample, and the normal equations of what they hold so far.

The samples lie in blocks, each with its normal equations. The sum of all is the quadratic whose
minimum a Gauss-Newton step finds. All blocks are linearised at one point: at several points each
would leave another combination undetermined, and their sum none. A sweep over the blocks to the
newest estimate is always under way, a few of them with every sample; when it is through and has
lowered the cost, that is the point. So a sample costs as much whether it is the tenth or the
ten-thousandth. One program evaluates blocks, however many there are.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxtrachea._numerics import epsilon
from jaxtrachea.fitting.cost import evaluate
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.programs import cast, program

#: Samples of a block, and blocks that are evaluated together.
BLOCK, TOGETHER = 32, 4
#: Fields of a lane with an axis of samples, and with one of trials alone.
_OF_SAMPLES = ("displacement", "force", "precision")
_OF_TRIALS = ("s_c", "balance", "value", "index")


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


class _Equations:
    """Normal equations of all blocks at one point, with room for more.

    Attributes:
        point: scaled coordinates; (P,).
        fresh: blocks of which all samples are in; (B,).
        cost: (B,).
        gradient: (B, P).
        hessian: (B, P, P).
        residual: model minus data, N; NaN where there is no sample; (B, `BLOCK`).
    """

    def __init__(self, point: Float[np.ndarray, " P"], size: int = 64):
        P, self.point, self.fresh = len(point), point, np.zeros(size, bool)
        self.cost, self.gradient = np.zeros(size), np.zeros((size, P))
        self.hessian, self.residual = np.zeros((size, P, P)), np.full((size, BLOCK), np.nan)

    def double(self) -> None:
        """Room for twice as many blocks."""
        more = _Equations(self.point, len(self.cost))
        for name in ("fresh", "cost", "gradient", "hessian", "residual"):
            setattr(self, name, np.concatenate([getattr(self, name), getattr(more, name)]))


class Stream:
    """Growing curves of one specimen, each at one position, and their normal equations.

    Attributes:
        study: one lane with room for some trials and samples; what is not yet measured is padding.
            Its arrays are written in place, and it has no `curves`.
        lengths: samples of each curve that has begun.
        sweeps: that have ended.
    """

    def __init__(self, study: Study, theta: Float[np.ndarray, " P"], dtype: np.dtype):
        """No curve yet.

        Args:
            study: of one curve of `BLOCK` samples with sigma given: model, unknowns and sigma.
            theta: first point, scaled coordinates.
            dtype: of the evaluation; sums are of float64.
        """
        self._dtype, self._sigma = dtype, 1 / float(study.lanes.precision[0, 0, 0])
        self._program = program(evaluate, study.model)
        blank = {name: np.zeros((1, 1, BLOCK)) for name in _OF_SAMPLES}
        lanes = study.lanes._replace(**blank)
        self.study = dataclasses.replace(study, lanes=lanes, curves=((),), change_points=None)
        # What all blocks have in common lies on the device.
        blocks = jax.tree.map(lambda v: np.repeat(v, TOGETHER, 0), lanes)
        self._blocks = jax.tree.map(jnp.asarray, cast(blocks, dtype))
        self._ones = jnp.ones((TOGETHER, 2), dtype)
        self.lengths: list[int] = []
        self._make_room(8, 4 * BLOCK)
        # Trial of every block, and which of its blocks; those of the last curve begin at `_first`.
        self._place, self._count, self._first = np.zeros((64, 2), int), 0, 0
        self._now, self._next = _Equations(theta), _Equations(theta)
        self.sweeps, self._sweeping, self._square = 0, False, 0.0

    def _make_room(self, trials: int, samples: int) -> None:
        """More padding; nothing is compiled."""
        lanes = self.study.lanes
        more = [(0, 0), (0, trials - lanes.force.shape[1]), (0, samples - lanes.force.shape[2])]
        new = {k: np.pad(getattr(lanes, k), more) for k in _OF_SAMPLES}
        for name in _OF_TRIALS:
            array = getattr(lanes, name)
            new[name] = np.pad(array, [*more[:2], (0, 0)][: array.ndim], mode="edge")
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
        self.lengths[-1], self._square = end, self._square + np.sum((force / self._sigma) ** 2)
        numbers = np.arange(begin // BLOCK, -(-end // BLOCK))
        self._count = self._first + int(numbers[-1]) + 1
        while self._count > len(self._place):
            self._place = np.concatenate([self._place, np.zeros_like(self._place)])
            self._now.double()
            self._next.double()
        at = self._first + numbers
        self._place[at] = np.stack([np.full_like(numbers, t), numbers], 1)
        self._now.fresh[at] = self._next.fresh[at] = False

    @property
    def point(self) -> Float[np.ndarray, " P"]:
        """Where all blocks are linearised, scaled coordinates."""
        return self._now.point

    @property
    def rounding(self) -> float:
        """Move of the estimate that rounding of the forces alone makes, in standard errors."""
        return epsilon(self._dtype) * float(np.sqrt(self._square))

    @property
    def residual(self) -> Float[np.ndarray, "1 T N"]:
        """Model minus data at the point, N; NaN in padding."""
        out = np.full(self.study.lanes.force.shape, np.nan)
        self._by_block(out)[tuple(self._place[: self._count].T)] = self._now.residual[: self._count]
        return out

    def advance(self, theta: Float[np.ndarray, " P"]) -> bool | None:
        """Take in new samples, and go on with the sweep; with a new one to `theta` if none is on.

        Returns:
            Whether a sweep ended that has lowered the cost, and all blocks are linearised anew, or
            one that has not, and all stays; None: none has ended.
        """
        if not self._sweeping:
            self._begin_sweep(theta)
        both = self._now, self._next
        new, left = (np.flatnonzero(~e.fresh[: self._count]).tolist() for e in both)
        slots = TOGETHER * (len(new) // TOGETHER + 1) - len(new)
        jobs = [(self._now, b) for b in new] + [(self._next, b) for b in left[:slots]]
        for first in range(0, len(jobs), TOGETHER):
            self._evaluate(jobs[first : first + TOGETHER])
        failed = not self._next.fresh[left[:slots]].all()
        return self._end_sweep() if failed or self._next.fresh[: self._count].all() else None

    def sweep(self, theta: Float[np.ndarray, " P"]) -> bool:
        """All of a sweep to `theta` at once: whether it has lowered the cost."""
        self._begin_sweep(theta)
        for first in range(0, self._count, TOGETHER):
            blocks = range(first, min(first + TOGETHER, self._count))
            self._evaluate([(self._next, b) for b in blocks])
        return self._end_sweep()

    def _begin_sweep(self, theta: Float[np.ndarray, " P"]) -> None:
        self._next.point, self._sweeping = theta, True
        self._next.fresh[:] = False

    def _end_sweep(self) -> bool:
        """Take the new point, or not: where the model is not finite or the cost is higher."""
        now, new, self._sweeping = self._now, self._next, False
        self.sweeps += 1
        cost = now.cost.sum()
        slack = 4 * self.rounding * np.sqrt(2 * cost)
        lower = not self.finite or new.cost.sum() <= cost + slack
        accepted = bool(new.fresh[: self._count].all() and lower)
        if accepted:
            self._now, self._next = new, now
        return accepted

    @property
    def finite(self) -> bool:
        """Whether the model gives finite numbers for all samples at the point."""
        return bool(self._now.fresh[: self._count].all())

    def _evaluate(self, jobs: list[tuple[_Equations, int]]) -> None:
        """At most `TOGETHER` blocks, each at the point of its equations; finite ones are put in."""
        lanes, full = self.study.lanes, [jobs[i % len(jobs)] for i in range(TOGETHER)]
        t, number = self._place[[b for _, b in full]].T
        arrays: dict[str, Any] = {
            k: self._by_block(getattr(lanes, k))[t, number] for k in _OF_SAMPLES
        }
        seen, arrays["s_c"] = arrays["precision"] > 0, lanes.s_c[0, t]
        part = {k: v[:, None].astype(self._dtype) for k, v in arrays.items()}
        theta = np.array([equations.point for equations, _ in full], self._dtype)
        point = self._program(theta, self._blocks._replace(**part), self._ones)
        found = (point.cost, point.gradient, point.hessian, point.value)
        cost, gradient, hessian, value = (np.asarray(v, np.float64) for v in found)
        residual = np.where(seen, value[:, 0] * self._sigma, np.nan)
        finite = np.isfinite(cost) & np.isfinite(hessian).all(axis=(1, 2))
        for i, (equations, b) in enumerate(jobs):
            if finite[i]:
                equations.cost[b], equations.gradient[b] = cost[i], gradient[i]
                equations.hessian[b], equations.fresh[b] = hessian[i], True
                equations.residual[b] = residual[i]

    @staticmethod
    def _by_block(array: Float[np.ndarray, "1 T N"]) -> Float[np.ndarray, "T blocks samples"]:
        """A view of samples, block by block."""
        return array[0].reshape(array.shape[1], -1, BLOCK)

    def sums(self, theta: Float[np.ndarray, " P"]) -> Sums:
        """The quadratic of all blocks, about `theta`."""
        # What was never evaluated is zeros.
        own, away = self._now, theta - self._now.point
        gradient, hessian = own.gradient.sum(axis=0), own.hessian.sum(axis=0)
        bent = hessian @ away
        cost = own.cost.sum() + away @ (gradient + 0.5 * bent)
        return Sums(float(cost), gradient + bent, hessian)

    def information(self, sums: Sums) -> Information:
        """The same as a fit has it, of the one lane."""
        count, square = float(sum(self.lengths)), np.array([[2 * sums.cost, 0.0]])
        found: dict[str, Any] = {
            "bread": sums.hessian[None],
            "meat": sums.hessian[None],
            "gradient": sums.gradient[None],
            "squares": square,
            "plain": square * self._sigma**2,
            "counts": np.array([[count, 0.0]]),
            "spread": np.zeros((1, 2)),
            "psi2": square / max(count, 1.0),
            "dpsi": np.ones(1),
        }
        return Information(**found)
