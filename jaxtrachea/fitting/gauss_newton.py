"""The minimum of a stream, followed by Gauss-Newton steps inside the bounds while samples come.

One step a sample, from the point where the samples are linearised, no longer than a radius that
shrinks where a step has not lowered the cost (Levenberg-Marquardt, as More 1978,
doi:10.1007/BFb0067700). What the samples do not tell yet stays where it is: directions that are
known worse than to 100 %, as long as the samples do not ask for a move clearly. Unknowns that the
positions leave open are held, as in `fit`.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea.fitting.covariance import SINGULAR, Uncertainty, analyse
from jaxtrachea.fitting.needs_review import barely_determined, natural_sizes
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.stream import Stream
from jaxtrachea.fitting.structure import nothing_open, null_spaces, structure_of, suspicious
from jaxtrachea.fitting.study import Study

#: Longest step, in natural sizes of the unknowns (1: 100 %).
LONGEST = 1.0
#: Standard errors by which the samples ask for a move clearly.
CLEAR = 3.0
#: Steps of `settle` at most, and the one with which it ends, in standard errors.
STEPS, SETTLED = 200, 1e-8
#: Damping over the largest curvature that steps are tried with, least first.
_DAMPING = np.logspace(-14, 6, 81)


class GaussNewton:
    """Estimate of the unknowns of a `Stream`.

    Attributes:
        stream: the samples.
        theta: estimate, scaled coordinates; (P,).
        sums: the quadratic of all samples about it.
        relative: as `FitResult.relative` has it there; (1, P).
        natural: natural sizes of the unknowns there, see `natural_sizes`; (1, P).
        structure: what the positions leave open.
        barely_determined: see `needs_review.barely_determined`.
    """

    def __init__(self, study: Study, dtype: np.dtype):
        """No sample yet; compiles what is needed later."""
        self._empty(study, dtype)
        self.begin(float(study.lanes.s_c[0, 0]))
        self.append(*np.asarray([study.lanes.displacement[0, 0], study.lanes.force[0, 0]]))
        self.uncertainty()
        self._empty(study, dtype)

    def _empty(self, study: Study, dtype: np.dtype) -> None:
        theta = study.of_unknowns(lambda p: p.to_scaled(p.value), 0.0)[0]
        self.stream, self._radius = Stream(study, theta, dtype), LONGEST
        self.structure, self.barely_determined = nothing_open(study), True
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
        self.barely_determined = bool(barely_determined(self._pressed)[0])

    def append(self, displacement: Float[np.ndarray, " n"], force: Float[np.ndarray, " n"]) -> None:
        """Take samples, mm and N, and one step."""
        self.stream.append(displacement, force)
        self._adapt(self.stream.advance(self.theta))
        self.theta, self.sums = self.stream.point, self.stream.sums(self.stream.point)
        self._move_to(self.theta + self._step())

    def settle(self) -> bool:
        """Linearise all samples at the estimate and step, until it stays: whether it does."""
        for _ in range(STEPS):
            self._move_to(self.stream.point)
            step = self._step(everything=True)
            if step @ self.sums.hessian @ step <= max(SETTLED, self.stream.rounding) ** 2:
                return True
            self._adapt(self.stream.sweep(self.theta + step))
        return False

    def _adapt(self, accepted: bool | None) -> None:
        """The radius, after a sweep: longer or shorter."""
        if accepted is not None:
            self._radius = min(2 * self._radius, LONGEST) if accepted else 0.25 * self._radius

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

    def _step(self, *, everything: bool = False) -> Float[np.ndarray, " P"]:
        """To the minimum of the quadratic within radius and bounds.

        Args:
            everything: along directions that are known badly, too.
        """
        lanes, free = self.stream.study.lanes, ~(self.at_bound | self.structure.pinned)[0]
        unit = self.natural[0] * free
        values, vectors = np.linalg.eigh(self.sums.hessian * unit[:, None] * unit)
        slope = vectors.T @ (unit * self.sums.gradient)
        taken = values > SINGULAR**2 * values[-1]
        if not everything:
            taken &= (values > 1) | (slope**2 > CLEAR**2 * values)
        values, slope, ways = values[taken], slope[taken], vectors[:, taken]
        if not taken.any():
            return np.zeros(len(free))
        damping = np.append(0, values[-1] * _DAMPING)[:, None]
        steps = -slope / (values + damping)
        short = np.linalg.norm(steps, axis=1) <= self._radius
        step = unit * (ways @ steps[np.argmax(short) if short.any() else -1])
        ahead: np.ndarray = np.clip(self.theta + step, lanes.lower[0], lanes.upper[0])
        return ahead - self.theta

    def _move_to(self, theta: Float[np.ndarray, " P"]) -> None:
        study, self.theta, self.sums = self.stream.study, theta, self.stream.sums(theta)
        self.relative = relative_change(study, theta[None])
        self.natural = natural_sizes(study, self.relative, study.first_touch)
