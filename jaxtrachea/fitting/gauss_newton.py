"""The minimum of a stream, followed by Gauss-Newton steps inside the bounds while samples come.

One step a sample, on the quadratics of all blocks. It is taken along the directions that are known
to better than 100 %: what the samples do not tell yet stays where it is, and there the quadratic
would lead astray. Unknowns that the positions leave open are held, as in `fit`.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea._numerics import epsilon
from jaxtrachea.fitting.covariance import SINGULAR, Uncertainty, analyse
from jaxtrachea.fitting.needs_review import natural_sizes
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.stream import Stream
from jaxtrachea.fitting.structure import nothing_open, null_spaces, structure_of, suspicious
from jaxtrachea.fitting.study import Study

#: Longest step, in natural sizes of the unknowns (1: 100 %).
LONGEST = 1.0
#: Steps of `settle` at most, and the one with which it ends, in standard errors.
STEPS, SETTLED = 50, 1e-8


class GaussNewton:
    """Estimate of the unknowns of a `Stream`.

    Attributes:
        stream: the samples.
        theta: estimate, scaled coordinates; (P,).
        sums: the quadratic of all samples about it.
        relative: as `FitResult.relative` has it there; (1, P).
        natural: natural sizes of the unknowns there, see `natural_sizes`; (1, P).
        finite: whether the model had an equilibrium at every sample at the last estimate.
        structure: what the positions leave open.
    """

    def __init__(self, study: Study, dtype: np.dtype):
        """No sample yet; compiles what is needed later.

        Args:
            study: as for `Stream`.
            dtype: likewise.
        """
        self._empty(study, dtype)
        self.begin(float(study.lanes.s_c[0, 0]))
        self.append(study.lanes.displacement[0, 0], study.lanes.force[0, 0])
        self.uncertainty()
        self._empty(study, dtype)

    def _empty(self, study: Study, dtype: np.dtype) -> None:
        theta = study.of_unknowns(lambda p: p.to_scaled(p.value), 0.0)[0]
        self.stream, self._rounding = Stream(study, theta, dtype), epsilon(dtype)
        self.structure, self.finite = nothing_open(study), True
        self._move_to(theta)

    @property
    def at_bound(self) -> Bool[np.ndarray, "1 P"]:
        """Unknowns that a bound holds."""
        lanes, g = self.stream.study.lanes, self.sums.gradient
        low = (self.theta <= lanes.lower) & (g > 0)
        return low | ((self.theta >= lanes.upper) & (g < 0))

    def begin(self, s_c: float) -> None:
        """Begin a curve, mm, and see what the positions leave open, this one included."""
        self.stream.begin(s_c)
        lanes = self.stream.study.lanes
        begun = np.arange(lanes.s_c.shape[1]) < len(self.stream.lengths)
        observed = lanes._replace(precision=np.where(begun[None, :, None], 1.0, lanes.precision))
        self._pressed = dataclasses.replace(self.stream.study, lanes=observed)
        self.structure = structure_of(self._pressed, suspicious(self._pressed))

    def append(self, displacement: Float[np.ndarray, " n"], force: Float[np.ndarray, " n"]) -> None:
        """Take samples, mm and N, and one step."""
        self.stream.append(displacement, force)
        self.finite = self.stream.advance(self.theta)
        self._move_to(self.stream.point)
        self._move_to(self.theta + self._step(known=1.0))

    def settle(self) -> bool:
        """Linearise all samples at the estimate and step, until it stays: whether it does."""
        lowest, best = np.inf, self.theta
        # What rounding leaves, in standard errors.
        lanes = self.stream.study.lanes
        rounding = self._rounding * float(np.linalg.norm(lanes.force * lanes.precision))
        for _ in range(STEPS):
            self.finite = self.stream.sweep(self.theta)
            self._move_to(self.theta)
            if not self.finite or self.sums.cost > lowest + rounding * (1 + lowest):
                self._move_to(0.5 * (best + self.theta))  # further than the quadratic holds
                continue
            lowest, best = self.sums.cost, self.theta
            step = self._step(known=None)
            if step @ self.sums.hessian @ step <= max(SETTLED, rounding) ** 2:
                return True
            self._move_to(self.theta + step)
        self.stream.sweep(best)
        self._move_to(best)
        return False

    def uncertainty(self) -> Uncertainty:
        """Errors of the estimate, as a fit has them."""
        study, nullity = self.stream.study, self.structure.nullity
        open_ = np.zeros((1, study.size, study.size))
        if nullity.any():
            (rows,) = null_spaces(self._pressed, np.zeros(1, int), self.theta[None], nullity)
            open_[0, : len(rows)] = rows
        return analyse(
            self.stream.information(self.sums), self.relative, self.at_bound,
            noise_given=study.noise_given, noise_known=study.noise_known, structural=open_,
        )  # fmt: skip

    def _step(self, *, known: float | None) -> Float[np.ndarray, " P"]:
        """To the minimum of the quadratic within the bounds, along directions known so well.

        Args:
            known: information from which on a direction is taken, in natural sizes; None: all that
                are not singular.
        """
        lanes, free = self.stream.study.lanes, ~(self.at_bound | self.structure.pinned)[0]
        unit = self.natural[0] * free
        values, vectors = np.linalg.eigh(self.sums.hessian * unit[:, None] * unit)
        taken = values > (SINGULAR**2 * values[-1] if known is None else known)
        ways, values = vectors[:, taken], values[taken]
        step = -ways @ (ways.T @ (unit * self.sums.gradient) / values)
        step = step * LONGEST / max(LONGEST, float(np.linalg.norm(step)))
        ahead: np.ndarray = np.clip(self.theta + unit * step, lanes.lower[0], lanes.upper[0])
        return ahead - self.theta

    def _move_to(self, theta: Float[np.ndarray, " P"]) -> None:
        study, self.theta, self.sums = self.stream.study, theta, self.stream.sums(theta)
        self.relative = relative_change(study, theta[None])
        self.natural = natural_sizes(study, self.relative, study.first_touch)
