"""Identification while the tool presses: after every sample estimate, errors, verdict, next place.

Gauss-Newton on accumulated normal equations (`fitting.stream`): a sample is one step, with a few
blocks of samples linearised anew. It follows one minimum from the first guess; that there is no
other, and intervals beyond the local error, are for `fitting.fit.fit` of `Online.study`.
"""

import jax
import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from jaxtrachea._arguments import check_word
from jaxtrachea._errors import InputError
from jaxtrachea.fitting.build import Table
from jaxtrachea.fitting.covariance import Uncertainty
from jaxtrachea.fitting.effective import Effective, effective
from jaxtrachea.fitting.fit import final_status
from jaxtrachea.fitting.gauss_newton import GaussNewton
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.misfit import Residuals
from jaxtrachea.fitting.needs_review import local_doubt
from jaxtrachea.fitting.refusals import Size, check_curve, refusal
from jaxtrachea.fitting.settings import Settings, check_precision
from jaxtrachea.fitting.starts import scales
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.verdict import verdict
from jaxtrachea.fitting.zeros import resolved
from jaxtrachea.inference.design.choice import Criterion, gains, scores_after
from jaxtrachea.inference.design.situation import Situation, of_bounds
from jaxtrachea.inference.online_model import (
    CURE,
    SPECIMEN,
    OnlineState,
    blank_study,
    check,
    deepest,
    places_of,
    study_of,
)
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

#: Move of the estimate from which on the gains of presses are computed anew, in natural sizes of
#: the unknowns (1: 100 %).
MOVED = 0.02


class Online:
    """Unknowns of one specimen, identified sample by sample while it is pressed on the midline.

    All is compiled when it is made; a sample compiles nothing (but where a ninth position, a
    seventeenth, ... leaves the structure in doubt), and takes about as long whether it is the tenth
    or the ten-thousandth (15 to 30 % more). Samples are evaluated in JAX's precision, sums and
    steps in float64; without `jax_enable_x64` estimates are rough, and a warning says so, as for
    `fit`.

    Every sample weighs the same, with the noise that is given. Zeros are those of the records: an
    `auto` onset or force offset stays at 0. When a press ends (`press`, `settle`) its record is
    looked at as a fit does; if it shows one, verdicts are inconclusive and `message` says so.

    After `settle` estimate and covariance are those of ``fit(online.study())``, as long as that
    finds no lower minimum and takes no zeros.
    """

    def __init__(
        self,
        geometry: Geometry,
        options: Options = Options(),
        parameters: Table | None = None,
        *,
        noise: Noise,
        depth: float,
        candidates: ArrayLike | None = None,
        samples: int = 50,
        criterion: Criterion = "D",
    ):
        """Compile.

        Args:
            geometry: the tube at rest.
            options: of an elastic line of joints.
            parameters: as for `build_study`; free ones belong to the specimen.
            noise: with `force`, N; nothing else.
            depth: to which the next press will go, mm from first touch.
            candidates: where it may be, mm; (C,). None: 25 places from the first to the last ring.
            samples: that it will have.
            criterion: by which its place is chosen, see `inference.design.choice.scores`.

        Raises:
            ValueError: an option, a noise or a parameter that only a fit of whole curves can treat;
                a candidate off the tube; a depth or a number of samples that is none.
        """
        check_precision(Settings())
        check_word("criterion", criterion, Criterion)
        if samples < 1:
            raise InputError(f"is {samples}", key="samples", expected="1 or more", joint=" ")
        check(options, noise)
        self._given = geometry, options, parameters, noise
        study, self._size = blank_study(*self._given), Size.of(geometry)
        self._candidates, self._deepest = places_of(study, candidates, depth), deepest(study)
        self._samples, self._scales = samples, [v[0] for v in scales(study)]
        self._criterion: Criterion = criterion
        dtype = np.dtype(jax.dtypes.canonicalize_dtype(np.float64))
        self._minimum = GaussNewton(study, dtype)
        self._counted, self._looked = (-1, 0), {}
        self._against: dict[str, str] = {}
        self._gains, self._gains_at = np.zeros(0), np.full(study.size, np.nan)
        self.state = self._known()

    def press(self, s: float) -> None:
        """Begin a press at a position, mm; the one before has ended.

        Raises:
            ValueError: off the tube, or where the tool does not lie on it.
        """
        trial = f"{len(self._minimum.stream.lengths) + 1}"
        curve = Curve(SPECIMEN, trial, float(s), 0.0, np.zeros(1), np.zeros(1))
        check_curve(curve, self._size, self._given[1])
        self._look_at_records()
        self._minimum.begin(float(s))

    def add(self, displacement: float | ArrayLike, force: float | ArrayLike) -> OnlineState:
        """Take samples of the present press.

        Args:
            displacement: of the tool from first touch, mm; one number or (n,).
            force: N; likewise.

        Raises:
            ValueError: no press has begun; numbers that are not finite, or not as many of both;
                deeper than the radius of the tube. The samples are not taken.
        """
        d, f = (np.atleast_1d(np.asarray(v, float)) for v in (displacement, force))
        if not self._minimum.stream.lengths:
            raise InputError("no press has begun", cure="call press(s) before the first sample")
        if d.shape != f.shape or d.ndim != 1 or not d.size:
            expected = "two numbers, or two arrays (n,)"
            found = f"{d.shape}, force {f.shape}"
            raise InputError(found, key="displacement", expected=expected)
        for name, v in (("displacement", d), ("force", f)):
            if not np.isfinite(v).all():
                found = f"is {v[~np.isfinite(v)][0]}"
                raise InputError(found, key=name, expected="finite numbers", joint=" ")
        if (most := np.max(np.abs(d))) > self._deepest:
            found, expected = f"is {most:g} mm", f"at most the radius, {self._deepest:g} mm"
            raise InputError(found, key="displacement", expected=expected, joint=" ")
        self._minimum.append(d, f)
        self.state = self._known()
        return self.state

    def settle(self) -> OnlineState:
        """Linearise all samples at the estimate until it stays, as at the end of a fit.

        It takes some evaluations of all samples. More may be added afterwards. Where the estimate
        does not stay the status is MAX_ITERATIONS.
        """
        self._look_at_records()
        stays = self._minimum.settle()
        self.state = self._known(FitStatus.CONVERGED if stays else FitStatus.MAX_ITERATIONS)
        return self.state

    @property
    def curves(self) -> list[Curve]:
        """The samples as curves of the specimen "online", trials "1", "2", ..."""
        lanes = self._minimum.stream.study.lanes
        s, D, F = (np.array(v[0]) for v in (lanes.s_c, lanes.displacement, lanes.force))
        return [
            Curve(SPECIMEN, f"{t + 1}", float(s[t]), 0.0, D[t, :n], F[t, :n])
            for t, n in enumerate(self._minimum.stream.lengths)
            if n
        ]

    def study(self) -> Study:
        """The samples as a study for `fit`, with the model and the noise of this stream."""
        return study_of(self.curves, *self._given)

    def _look_at_records(self) -> None:
        """What the records so far say against a fit with these zeros."""
        table = self._minimum.stream.study.parameters
        _, options, _, noise = self._given
        for curve in self.curves:
            if self._looked.get(curve.trial) == len(curve.force):
                continue
            self._looked[curve.trial], self._against[curve.trial] = len(curve.force), ""
            where = f"press {curve.trial} (s = {curve.s_c:g} mm)"
            if (refused := refusal(curve, self._size, options, table)) is not None:
                self._against[curve.trial] = f"{where}: {refused.error.found}"
                continue
            taken = resolved(table, [curve], options, noise.force).taken
            if names := sorted(taken.get((SPECIMEN, curve.trial), ())):
                shown = " and ".join(names)
                self._against[curve.trial] = f"{where} shows {shown}, held at 0 here; {CURE}"

    def _known(self, status: FitStatus = FitStatus.CONVERGED) -> OnlineState:
        """Errors, verdicts and the next place at the estimate."""
        minimum, stream = self._minimum, self._minimum.stream
        study, relative, at_bound = stream.study, minimum.relative, minimum.at_bound
        errors, count = minimum.uncertainty(), np.array([sum(stream.lengths)])
        worth = self._worth_of_samples(errors, count)
        code = np.array([status if stream.finite else FitStatus.NON_FINITE])
        status = FitStatus(int(final_status(code, errors, at_bound, count - np.sum(~at_bound))[0]))
        misses, open_ = bool(worth.misses[0]), minimum.structure.undetermined
        message, words = "; ".join(filter(None, self._against.values())), ["failed"] * study.size
        if status.succeeded:
            doubt = local_doubt(errors, minimum.natural, ~open_, at_bound)
            review = minimum.barely_determined or bool(message)
            columns = (errors.se / relative * worth.growth, open_, at_bound, doubt)
            words = [
                verdict(
                    float(error), structural=bool(o), held=bool(held), misses=misses,
                    unseen=bool(cause or review),
                )
                for error, o, held, cause in zip(*(v[0] for v in columns), strict=True)
            ]  # fmt: skip
        told = status.succeeded and not misses
        se = np.where(told & ~open_ & np.isfinite(errors.se), errors.se, np.nan)[0]
        se = se * (worth.factor[0] if told else np.nan)
        log, step = self._scales
        side = (errors.se * errors.half_width[0] * worth.growth[0])[0]
        side = np.where(open_[0], np.inf, side) if status.succeeded else np.nan
        theta, lower, upper = minimum.theta, study.lanes.lower[0], study.lanes.upper[0]
        ends = np.array([np.maximum(theta - side, lower), theta, np.minimum(theta + side, upper)])
        low, value, high = np.where(log, np.exp(np.where(log, ends, 0)), ends * step)
        return OnlineState(
            names=tuple(p.name for p, _, _ in study.unknowns[0]), value=value,
            standard_error=se * np.where(log, value, step), low=low, high=high,
            relative_error=se / relative[0],
            covariance=errors.covariance[0], verdict=tuple(words),
            next_point=self._next(float(worth.factor[0]) if told else 1.0),
            samples=int(count[0]), status=status, message=message,
        )  # fmt: skip

    def _worth_of_samples(self, errors: Uncertainty, count: Int[np.ndarray, "1"]) -> Effective:
        """As a fit has it of the residuals; kept until these or the samples have changed."""
        minimum, stream, (sweeps, before) = self._minimum, self._minimum.stream, self._counted
        # Residuals are those of the point; a tenth more samples may be correlated otherwise.
        if stream.sweeps != sweeps or count[0] > 1.1 * before:
            residual, solved = {"force": stream.residual}, np.ones(1, bool)
            seen = Residuals(stream.study, residual, count, minimum.at_bound, solved)
            self._worth = effective(seen, errors.half_width)
            self._counted = stream.sweeps, int(count[0])
        return self._worth

    def _next(self, factor: float) -> float:
        """The most telling place, given what is known; as `situation` of a fit."""
        minimum, study = self._minimum, self._minimum.stream.study
        theta, lane, relative = minimum.theta[None], np.zeros(1, int), minimum.relative
        prior = of_bounds(study, lane, relative)
        own = np.eye(study.size) * prior[:, :, None]
        data = minimum.sums.hessian * relative[:, :, None] * relative[:, None]
        known = Situation(
            study=study, lane=lane, theta=theta, relative=relative, base=own + data,
            meat=own + factor**2 * data, weight=np.ones(1), factor=np.full(1, factor**2),
            sigma=np.full(1, self._given[3].force), samples=self._samples,
            kept=np.arange(study.size)[None], own=np.zeros((1, 0), int), prior=prior, blend=None,
            approach=np.zeros(1), reach=(0.0, float(self._candidates.depth[0])),
        )  # fmt: skip
        moved = np.max(np.abs(minimum.theta - self._gains_at) / minimum.natural[0])
        if not moved <= MOVED:
            self._gains, self._gains_at = gains(known, self._candidates), minimum.theta
        score = scores_after(known, self._gains, self._criterion)
        return float(self._candidates.s[np.argmax(score)])
