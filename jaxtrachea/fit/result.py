"""How a fit is solved and what it gives: estimates, errors and verdict of every lane."""

import dataclasses
from typing import Literal

import numpy as np

from jaxtrachea._arguments import check_record
from jaxtrachea.fit.covariance import Uncertainty
from jaxtrachea.fit.criteria import Criteria
from jaxtrachea.fit.levenberg_marquardt import Tolerances
from jaxtrachea.fit.noise import precision_unit
from jaxtrachea.fit.press_scale import relative_change
from jaxtrachea.fit.study import Study
from jaxtrachea.status import FitStatus


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        method: `levenberg-marquardt`, or optax's `lbfgs` / `adam` on the same cost.
        starts: starts per lane; the first is the initial guess, the others are drawn around it.
        decades: starts are drawn up to this many decades from the guess (log scale; with linear
            scale up to this many times 10 steps), inside the bounds.
        seed: of the drawn starts.
        more_starts: added to lanes in doubt: no start converged, or one of several alone came
            lowest. With them infeasible starts are drawn anew. 0: neither.
        batch: lanes computed together.
        tolerances: when a lane is done.
        float32: compute in single precision (results are float64 all the same).
        scrutiny: look for other minima and profile where an estimate gives cause; False: verdicts
            rest on structure and local standard errors alone (for refits of which no one reads
            the verdicts).
    """

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    starts: int = 4
    decades: float = 1.0
    seed: int = 0
    more_starts: int = 8
    batch: int = 128
    tolerances: Tolerances = Tolerances()
    float32: bool = False
    scrutiny: bool = True

    def __post_init__(self):
        """Refuse words and numbers that mean nothing.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self, starts=1.0, decades=0.0, seed=0.0, more_starts=0.0, batch=1.0)
        check_record(self.tolerances, cost=0.0, step=0.0, gradient=0.0, iterations=1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class FitResult:
    """Estimates of every lane; leading axis = lanes of the study, P unknowns each.

    Attributes:
        study: what was fitted.
        theta: estimate in scaled coordinates; (lanes, P).
        value: estimate in the parameter's unit; (lanes, P).
        standard_error: in the parameter's unit (delta method); (lanes, P).
        lower: 95 % interval, transformed from scaled coordinates; (lanes, P).
        upper: (lanes, P).
        relative_se: standard error over the value (scale `log`: of the logarithm; onset and offset:
            over range and largest force of the press); (lanes, P).
        at_bound: (lanes, P).
        status: `FitStatus`; (lanes,).
        iterations: of the best start; (lanes,).
        cost: half the weighted sum of squares (or of rho); (lanes,).
        converged_starts: starts that ended in the best minimum; (lanes,).
        tried: starts in all; (lanes,).
        sigma: standard deviation of force (N) and markers (mm), given or estimated; (lanes, 2).
        rms: root mean square residual of force (N) and markers (mm); (lanes, 2).
        samples: observed entries; (lanes,).
        criteria: AIC, AICc, BIC of all lanes.
        uncertainty: local one of all lanes.
        undetermined: unknowns that the structure leaves open (`structure`); (lanes, P).
        unexamined: unknowns that gave cause to look further than the local error, and nobody did:
            in a joint fit, or without scrutiny; (lanes, P).
        evidence_low: 95 % interval by profile and other minima, in the parameter's unit: -inf
            (scale `log`: 0) where open, NaN where there was no cause to look; where an end is
            `FAILED`, as far as the cost is known to stay below the threshold; (lanes, P).
        evidence_high: (lanes, P).
        evidence_end: `ProfileEnd` of its lower and upper end, -1 where there is none;
            (lanes, P, 2).
        minima: minima that fit within the likelihood's threshold, the best one included; those
            that differ from it in an unknown that the structure does not leave open; (lanes,).
    """

    study: Study
    theta: np.ndarray
    value: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    relative_se: np.ndarray
    at_bound: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray
    converged_starts: np.ndarray
    tried: np.ndarray
    sigma: np.ndarray
    rms: np.ndarray
    samples: np.ndarray
    criteria: Criteria
    uncertainty: Uncertainty
    undetermined: np.ndarray
    unexamined: np.ndarray
    evidence_low: np.ndarray
    evidence_high: np.ndarray
    evidence_end: np.ndarray
    minima: np.ndarray

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return len(self.status)

    @property
    def succeeded(self) -> np.ndarray:
        """Lanes that have an estimate; (lanes,)."""
        return self.status <= FitStatus.UNIDENTIFIABLE

    @property
    def whitened_sigma(self) -> np.ndarray:
        """`sigma` in units of the lanes' precision, as `evaluate` wants it; (lanes, 2)."""
        return self.sigma / precision_unit(self.study)

    @property
    def relative(self) -> np.ndarray:
        """Change of each scaled coordinate that makes a relative change of 1; (lanes, P)."""
        return relative_change(self.study, self.theta)
