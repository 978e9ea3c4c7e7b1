"""What a fit gives: estimates and errors of every lane, as arrays, a table or a dataset."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxtrachea.files.table import Table
from jaxtrachea.fitting.assessment import (
    Assessment,
    Intervals,
    assess,
    estimate_rows,
    unknown_label,
)
from jaxtrachea.fitting.covariance import NORMAL, Uncertainty
from jaxtrachea.fitting.criteria import Criteria
from jaxtrachea.fitting.effective import Effective, effective
from jaxtrachea.fitting.misfit import Misfit, Residuals, misfit
from jaxtrachea.fitting.noise import precision_unit
from jaxtrachea.fitting.onset import first_touches
from jaxtrachea.fitting.predictions import Prediction, predictions
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.study import Study
from jaxtrachea.status import FitStatus

if TYPE_CHECKING:
    import xarray


#: Fields of a result whose second axis is that of a lane's unknowns.
OF_UNKNOWNS = (
    "theta", "value", "standard_error", "lower", "upper", "relative_se", "at_bound",
    "undetermined", "unexamined", "evidence_low", "evidence_high", "evidence_end", "with_air",
)  # fmt: skip


class Origin(NamedTuple):
    """Where a fit was read from; empty for one of this process.

    Attributes:
        path: of its results.h5.
        reading: how the data were read, as in the [data] section.
        files: SHA-256 by name of the files of data.
    """

    path: Path = Path()
    reading: Mapping[str, Any] = {}
    files: Mapping[str, str] = {}


@dataclasses.dataclass(frozen=True, eq=False)
class FitResult:
    """Estimates of every lane; leading axis = lanes of the study, P unknowns each.

    Attributes:
        study: what was fitted.
        theta: estimate in scaled coordinates; (lanes, P).
        value: estimate in the parameter's unit; (lanes, P).
        standard_error: of independent residuals, in the parameter's unit (delta method); times
            `effective.factor` it is that of the tables; (lanes, P).
        lower: 95 % interval of independent residuals, transformed from scaled coordinates;
            (lanes, P).
        upper: (lanes, P).
        relative_se: `standard_error` over the value (scale `log`: of the logarithm; onset and
            offset: over range and largest force of the press); (lanes, P).
        at_bound: (lanes, P).
        status: `FitStatus`; (lanes,).
        iterations: of the best start; (lanes,).
        cost: half the weighted sum of squares (or of rho); (lanes,).
        converged_starts: starts that ended in the best minimum; of many long curves (`few_samples`)
            those that came together on a few samples went there as one; (lanes,).
        tried: starts in all; (lanes,).
        start_costs: the 24 lowest costs that starts of a lane ended at, with the noise that fits
            begin with, lowest first; NaN where there are no more; (lanes, 24).
        sigma: standard deviation of force (N) and markers (mm), given (the median of the lane's
            samples) or estimated; (lanes, 2).
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
        with_air: 95 % interval of the fit with air that curves may hide and nothing else speaks
            for (`hidden_air`), in the parameter's unit, as `assess` gives it there: verdicts and
            intervals hold it, too; NaN where there is no such fit; (lanes, P, 2).
        minima: minima that fit within the likelihood's threshold, the best one included; those
            that differ from it in an unknown that the structure does not leave open; (lanes,).
        origin: where it was read from.
        stored_residuals: of a fit that was read, so that the model is not evaluated again.
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
    start_costs: np.ndarray
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
    with_air: np.ndarray
    minima: np.ndarray
    origin: Origin = Origin()
    stored_residuals: Prediction | None = None

    def __repr__(self) -> str:
        """One line: what was fitted to what."""
        free = ", ".join(p.name for p in self.study.free) or "nothing"
        curves = [c for lane in self.study.curves for c in lane]
        read = f"{str(self.origin.path)!r}: " if self.origin.path != Path() else ""
        return (
            f"FitResult({read}{free} fitted to {len(curves)} curves of "
            f"{len({c.specimen for c in curves})} specimen(s))"
        )

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return len(self.status)

    @functools.cached_property
    def succeeded(self) -> np.ndarray:
        """Lanes that have an estimate; (lanes,)."""
        return self.status <= FitStatus.UNIDENTIFIABLE

    @property
    def force_share(self) -> np.ndarray:
        """Share of the force that its noise has beside `sigma`, see `Noise`; (lanes,)."""
        shares = self.study.shares
        return np.zeros(self.lanes) if shares is None else shares.share

    @property
    def whitened_sigma(self) -> np.ndarray:
        """`sigma` in units of the lanes' precision, as `evaluate` wants it; (lanes, 2)."""
        return self.sigma / precision_unit(self.study)

    @property
    def observed_sigma(self) -> np.ndarray:
        """`sigma`; NaN where a lane has no samples of the kind, such as no markers; (lanes, 2)."""
        return np.where(np.isnan(self.rms), np.nan, self.sigma)

    @property
    def half_width(self) -> np.ndarray:
        """Half of a 95 % interval in standard errors, for predictions; (lanes,).

        Infinite where noise is to be estimated and no sample is left to do it from: the normal
        quantile stands there (`covariance.analyse`), which Student's t never reaches.
        """
        half = self.uncertainty.half_width
        return np.where((half == NORMAL) & (not self.study.noise_given[0]), np.inf, half)

    @functools.cached_property
    def relative(self) -> np.ndarray:
        """Change of each scaled coordinate that makes a relative change of 1; (lanes, P)."""
        return relative_change(self.study, self.theta)

    @functools.cached_property
    def first_touch(self) -> np.ndarray:
        """Displacement at first touch of every trial, mm, estimated or held; (lanes, T)."""
        return first_touches(self.study.lanes, self.study.parameters, self.value)

    @functools.cached_property
    def residuals(self) -> Prediction:
        """Model minus data at the estimates; as large as the data."""
        if self.stored_residuals is not None:
            return self.stored_residuals
        return predictions(self.study, self.theta)

    @functools.cached_property
    def effective(self) -> Effective:
        """Independent samples that those of each lane are worth, and what intervals grow by."""
        return effective(self._counted, self.uncertainty.half_width)

    @functools.cached_property
    def misfit(self) -> Misfit:
        """Residuals of each lane against the noise that was given."""
        return misfit(self._counted)

    @property
    def _counted(self) -> Residuals:
        """The residuals with what they are counted by."""
        return Residuals(self.study, self.residuals, self.samples, self.at_bound, self.succeeded)

    @functools.cached_property
    def assessments(self) -> dict[tuple[int, int], Assessment]:
        """Kept by `assess`: those without further profiles, by lane and unknown."""
        return {}

    def table(self, profiles: Intervals | None = None) -> Table:
        """One row per unknown: estimate, standard error, 95 % interval and verdict, with units.

        Args:
            profiles: further intervals (`jaxtrachea.profiles`), which come on top.

        Returns:
            A `Table`: prints as text, shows as HTML in a notebook, `rows` are dictionaries. What
            the lanes of a joint fit share has one row.
        """
        return Table(estimate_rows(self, profiles))

    def to_dataset(self, profiles: Intervals | None = None) -> "xarray.Dataset":
        """The estimates with dimensions `lane` and `unknown`, as an xarray Dataset.

        `parameter` and `unit` say what each unknown is; statuses and verdicts are words. Lanes with
        fewer unknowns than others are filled up with NaN and "". Where an unknown lies on its bound
        (`at_bound`) its standard error is NaN, and so is its interval without a profile. Errors and
        intervals are those of the tables (`assess`).

        Args:
            profiles: further intervals, as for `table`.

        Raises:
            ImportError: xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise ImportError(
                "xarray is not installed; install it with pip install 'jaxtrachea[dataset]'"
            ) from None
        study, names = self.study, [self.study.lane_name(k) for k in range(self.lanes)]
        both, per_lane, size = ("lane", "unknown"), ("lane",), self.theta.shape[1]

        def filled(value, blank):
            return [
                [value(k, i) if i < len(unknowns) else blank for i in range(size)]
                for k, unknowns in enumerate(study.unknowns)
            ]

        def assessed(name, blank: Any = np.nan):
            return both, [[blank if j is None else getattr(j, name) for j in row] for row in every]

        labels = filled(lambda k, i: unknown_label(self, k, i), "")
        every = filled(lambda k, i: assess(self, k, i, profiles), None)
        data = {
            "parameter": (both, labels),
            "unit": (both, filled(lambda k, i: study.unknowns[k][i][0].unit, "")),
            "value": (both, self.value),
            "standard_error": assessed("standard_error"),
            "low95": assessed("low"),
            "high95": assessed("high"),
            "verdict": assessed("verdict", ""),
            "at_bound": (both, self.at_bound),
            "status": (per_lane, [FitStatus(int(v)).name.lower() for v in self.status]),
            "iterations": (per_lane, self.iterations),
            "cost": (per_lane, self.cost),
            "samples": (per_lane, self.samples),
            "rms": (("lane", "kind"), self.rms, {"unit": "N, mm"}),
            "sigma": (("lane", "kind"), self.observed_sigma, {"unit": "N, mm"}),
        }
        same = all(row == labels[0] for row in labels)
        coords = {
            "specimen": (per_lane, [name for name, _ in names]),
            "trial": (per_lane, [trial for _, trial in names]),
            "kind": ["force", "joints"],
            "unknown": labels[0] if same and labels else np.arange(size),
        }
        return xarray.Dataset(data, coords)
