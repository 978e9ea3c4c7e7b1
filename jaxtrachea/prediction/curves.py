"""Force, joints and reactions that a finished fit predicts, with 95 % bands.

Two bands: of the curve itself (covariance of the parameters, through the exact Jacobian: the delta
method; between the positions of the fit with the error of the model there, `model_error`) and of a
new sample (with the noise). The covariance is widened by what alike residuals are worth less. The
delta method is linear. It stops being valid where
the band is so wide that the model bends within it, where an unknown is held on its bound (its own
uncertainty is left out) and where the data leave a combination of unknowns undetermined (the band
is then infinite wherever that combination acts): each has a `PredictionStatus`.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.onset import counted_from
from jaxtrachea.fitting.parameters import DECLARED
from jaxtrachea.fitting.refusals import depths, unvalidated
from jaxtrachea.fitting.relaxing import beyond_ramps, span_of
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.measurements.vectors import tilt_of
from jaxtrachea.measurements.whole_record import ramp_speed
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.optimisation.programs import program
from jaxtrachea.prediction.core import Estimate, Predicted, Values, predicted
from jaxtrachea.prediction.model_error import ModelError, model_errors
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.prediction.profile import BENT, errors_of_bands
from jaxtrachea.prediction.sources import (
    CurveParameters,
    detection_limit,
    onset_of,
    value_of,
)
from jaxtrachea.status import PredictionStatus, PressStatus

#: Parts of parameters that say nothing of a skeleton.
AT_CONTACT = ("contact", "time", "press")
#: What a prediction has fields of its own for.
OWN = ("force", "joints", "reactions")


@dataclasses.dataclass(frozen=True, eq=False)
class CurvePrediction:
    """What a fit predicts for one curve of N displacements; numpy, float64.

    Bands are 95 %: `curve_*` of the curve itself, from the covariance of the parameters and the
    error of the model; the others of a new sample, with the noise.

    Attributes:
        specimen: name.
        trial: name, or "".
        s: contact position, mm; NaN if the model needs none.
        displacement: mm; (N,).
        force: N; NaN where there is none.
        se: standard error of the force from the parameters, N: widened by alike residuals, but
            where `model_se` has what these say.
        half_width: of the intervals, in standard errors.
        sigma: standard deviation of a force sample, N; (N,).
        joints: deflection at each ring, mm; (N, rings), NaN where the skeleton is not in the model.
        joints_se: from the parameters.
        reactions: of each ring, N; (N, rings).
        reactions_se: from the parameters.
        joint_sigma: standard deviation of a marker, mm; NaN if the fit had none; (N,).
        status: the worst there is to say.
        message: in words.
        press_status: `PressStatus`; (N,).
        phi: contact angle, rad.
        direction: of the tool along the inward normal and the circumference.
        others: what the model has beside, by field of `levels.level.Response`: value, and standard
            error from the parameters.
        model_se: standard deviation of the error of the model between the positions of the fit, N;
            (N,); 0 at one of them, and where too few tell it.
        model_quantile: of a 95 % interval in `model_se`.
        time: s; (N,); None where the force does not relax.
    """

    specimen: str
    trial: str
    s: float
    displacement: np.ndarray
    force: np.ndarray
    se: np.ndarray
    half_width: float
    sigma: np.ndarray
    joints: np.ndarray
    joints_se: np.ndarray
    reactions: np.ndarray
    reactions_se: np.ndarray
    joint_sigma: np.ndarray
    status: PredictionStatus
    message: str
    press_status: np.ndarray
    phi: float = 0.0
    direction: tuple[float, float] = (1.0, 0.0)
    others: dict[str, tuple[np.ndarray, np.ndarray]] = dataclasses.field(default_factory=dict)
    model_se: np.ndarray | float = 0.0
    model_quantile: float = 0.0
    time: np.ndarray | None = None

    def _half(self, sigma: np.ndarray | float) -> np.ndarray:
        """Half of a band with noise of a standard deviation, N; (N,)."""
        known = self.half_width * np.hypot(self.se, sigma)
        return np.hypot(known, self.model_quantile * self.model_se)

    @property
    def has_skeleton(self) -> bool:
        """Whether joints and reactions are predicted."""
        return bool(np.isfinite(self.joints).any())

    @property
    def curve_low95(self) -> np.ndarray:
        """Lower end of the band of the curve itself, N."""
        return self.force - self._half(0.0)

    @property
    def curve_high95(self) -> np.ndarray:
        """Upper end of the band of the curve itself, N."""
        return self.force + self._half(0.0)

    @property
    def low95(self) -> np.ndarray:
        """Lower end of the band of a new sample, N."""
        return self.force - self._half(self.sigma)

    @property
    def high95(self) -> np.ndarray:
        """Upper end of the band of a new sample, N."""
        return self.force + self._half(self.sigma)


def predict_sources(
    stored: FitResult,
    sources: list[CurveParameters],
    s: list[float],
    displacements: list[np.ndarray],
    sigmas: Sequence[np.ndarray | None] | None = None,
    batch: int = 64,
    aside: Sequence[tuple[float, tuple[float, float]]] | None = None,
    times: Sequence[np.ndarray] | None = None,
) -> list[CurvePrediction]:
    """Predictions for many curves in one program.

    Args:
        sources: with which parameters each curve is predicted.
        s: contact position of each, mm; NaN without one.
        displacements: of each, mm.
        sigmas: noise of each sample, N, where it is not that of the fit.
        batch: curves computed together.
        aside: contact angle, rad, and direction of the tool of each; None: on the midline, along
            the normal.
        times: of every displacement of each, s, where the force relaxes.
    """
    turned = [(0.0, (1.0, 0.0))] * len(s) if aside is None else list(aside)
    errors = model_errors(stored, [source.lane for source in sources])
    sources = [_widened(source, errors.get(source.lane)) for source in sources]
    most = _rounded(max(map(len, displacements)), 32)

    def pad(rows) -> Any:
        return np.stack([np.pad(v, (0, most - len(v)), mode="edge") for v in rows])

    padded = pad(displacements)
    places: Any = np.where(np.isnan(s), float(stored.study.model.geometry.length) / 2, s)

    def stack(name):
        return np.stack([getattr(source, name) for source in sources])

    estimates = Estimate._make(map(stack, Estimate._fields))
    presses = zip(sources, s, padded, strict=True)
    slack = np.stack(
        [
            detection_limit(stored, source, (float(at), *how), D)
            for (source, at, D), how in zip(presses, turned, strict=True)
        ]
    )
    time = None if times is None else jnp.asarray(pad(times))
    motion = Motion(jnp.asarray(places), jnp.asarray(padded), time=time)
    if any(how != (0.0, (1.0, 0.0)) for how in turned):
        phis, ways = zip(*turned, strict=True)
        phi_c, direction = (jnp.asarray(np.array(v, float)) for v in (phis, ways))
        motion = motion._replace(phi_c=phi_c, direction=direction)
    blend = stack("blend")

    arrays = _Asked(estimates, motion, slack, blend)
    answers = functools.partial(_answered, program(predicted, stored.study.model), arrays, batch)
    every = answers(np.arange(len(sources)), np.asarray(estimates.free))
    parts = [jax.tree.map(lambda v, k=k: v[k], every) for k in range(len(sources))]
    bends = errors_of_bands(stored, sources, displacements, parts, errors, answers)
    out = []
    for k, (source, part, bend) in enumerate(zip(sources, parts, bends, strict=True)):
        sigma = None if sigmas is None else sigmas[k]
        where = (s[k], *turned[k])
        found = _on_host(stored, source, where, displacements[k], part, sigma, bend)
        if times is not None:
            found = _in_time(stored, source, found, np.asarray(times[k], np.float64))
        out.append(_with_misfit(stored, source, errors.get(source.lane), found))
    return out


class _Asked(NamedTuple):
    """What is asked of every curve; `blend`: rounded corner, NaN: none."""

    estimates: Estimate
    motion: Motion
    slack: np.ndarray
    blend: np.ndarray


def _answered(run, asked: _Asked, batch: int, rows: np.ndarray, free: np.ndarray) -> Any:
    """`Predicted` of curves `rows`, numpy, their free parameters given; one row each."""
    out = None
    # A rounded corner is another program; mostly all curves have one, or none.
    for rounded in (False, True):
        alike = np.isnan(asked.blend) != rounded
        members = np.flatnonzero(alike[rows])
        motion = asked.motion._replace(blend=asked.blend if rounded else None)
        size = min(batch, _rounded(max(int(alike.sum()), 1), 8))
        for first in range(0, len(members), size):
            at = members[first : first + size]
            full = np.pad(at, (0, size - len(at)), mode="edge")
            estimates, motion_of, slack = jax.tree.map(
                lambda v, full=full: jnp.asarray(v[rows[full]]),
                (asked.estimates, motion, asked.slack),
            )
            estimates = estimates._replace(free=jnp.asarray(free[full]))
            part = jax.tree.map(np.asarray, run(estimates, motion_of, slack))
            if out is None:
                out = jax.tree.map(lambda v: np.empty((len(rows), *v.shape[1:]), v.dtype), part)
            for whole, some in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
                whole[at] = some[: len(at)]
    return out


def _widened(source: CurveParameters, error: ModelError | None) -> CurveParameters:
    """The source with the covariance that alike residuals leave."""
    if error is None or error.growth == 1:
        return source
    if np.isfinite(error.growth):
        return dataclasses.replace(source, covariance=source.covariance * error.growth**2)
    half = source.half_width if error.known else np.asarray(np.inf)
    return dataclasses.replace(source, half_width=half)


def _with_misfit(
    stored: FitResult, source: CurveParameters, error: ModelError | None, found: CurvePrediction
) -> CurvePrediction:
    """The prediction with what the model misses, and why its bands are as wide as they are.

    Between the positions of the fit that is the error which leaving positions out has shown. It is
    in the place of what widens the errors of the parameters and of the noise's share of the force,
    which are guesses at the same: together they would count it twice.
    """
    if error is None or not found.status.predicts:
        return found
    options = stored.study.model.options
    placeless = options.coupling == "total" and options.local == "uniform"
    between = not placeless and not error.at_pressed(found.s)
    force = np.abs(found.force - value_of(stored, source, "force_offset"))
    share = float(stored.force_share[source.lane])
    if between and error.known:
        depth = np.abs(depths(found.displacement, onset_of(stored, source), options))
        plain = found.se / (error.growth if np.isfinite(error.growth) else 1.0)
        return dataclasses.replace(
            found,
            message="; ".join(filter(None, [found.message, error.message])),
            se=plain,
            model_se=np.maximum(error.share_at(depth), share) * np.nan_to_num(force),
            model_quantile=error.quantile,
        )
    sigma, status = np.hypot(found.sigma, share * force), found.status
    said = [found.message, error.growth_message]
    if between:
        status = max(status, PredictionStatus.FEW_POSITIONS)
        head = found.message.removeprefix(found.status.message)
        said = [f"{status.message}{head}", error.message, error.growth_message]
    message = "; ".join(filter(None, said))
    return dataclasses.replace(found, sigma=sigma, status=status, message=message)


def _rounded(count: int, least: int) -> int:
    """The next power of two, so that few sizes are compiled."""
    return max(least, 1 << (count - 1).bit_length())


def _on_host(
    stored: FitResult, source: CurveParameters, where, displacement, part: Predicted, sigma, bend
):
    """One curve at `where` (s, angle, direction), cut to its length, with its status."""
    n = len(displacement)
    s, phi, direction = where

    def cut(v):
        return np.asarray(v[:n], np.float64)

    value, se = jax.tree.map(cut, part.value), jax.tree.map(cut, part.se)
    usable = source.status.predicts

    def hide(v) -> Any:
        return v if usable else np.full_like(v, np.nan)

    skeleton = any(DECLARED[p.name].part not in AT_CONTACT for p in stored.study.parameters)

    def show(v) -> Any:
        return hide(v) if skeleton and v is not None else np.full_like(value["joints"], np.nan)

    presses = np.asarray(part.status[:n])
    outside, foreign = _outside(stored, source, where, displacement) if usable else ([], [])
    status, message = _verdict(source, value, se, presses, bend, foreign)
    return CurvePrediction(
        specimen=source.specimen,
        trial=source.trial,
        s=float(s),
        displacement=np.asarray(displacement, np.float64),
        force=hide(value["force"]),
        se=hide(se["force"]),
        half_width=float(source.half_width),
        sigma=np.full(n, source.sigma[0]) if sigma is None else sigma,
        joints=show(value["joints"]),
        joints_se=show(se["joints"]),
        reactions=show(value.get("reactions")),
        reactions_se=show(se.get("reactions")),
        joint_sigma=_marker_sigma(stored, source, displacement),
        status=status,
        message="; ".join(filter(None, [message, *outside])),
        press_status=presses,
        phi=float(phi),
        direction=direction,
        others={name: (hide(v), hide(se[name])) for name, v in value.items() if name not in OWN},
    )


def _outside(
    stored: FitResult, source: CurveParameters, where, displacement
) -> tuple[list[str], list[str]]:
    """What of a press the data do not hold, in words; the values of another tube it rests on."""
    s, phi, direction = where
    fitted, lane = pressed(stored), source.lane
    aside = (
        (fitted.angles[lane], phi, "phi"), (fitted.tilts[lane], tilt_of(direction), "tilt"),
    )  # fmt: skip
    model, counted = stored.study.model, counted_from(stored.study.parameters)
    depth = depths(displacement, onset_of(stored, source), model.options)
    deepest = float(np.max(np.abs(depth)))
    words = [
        _beyond(fitted.spans[lane], float(s), depth, aside, counted),
        unvalidated(model.options, float(model.geometry.radius), deepest, counted),
    ]
    foreign = [p.name for p in stored.study.parameters if p.foreign]
    if foreign and deepest <= fitted.reached(lane, float(s), phi, direction) + 1e-9:
        foreign = []  # the fit has seen such a press
    return words, foreign


def _marker_sigma(stored: FitResult, source: CurveParameters, displacement) -> np.ndarray:
    """Standard deviation of a marker at each displacement, mm; NaN if the fit had none."""
    given = stored.study.marker_noise
    if given is None or np.isnan(source.sigma[1]):
        return np.full(len(displacement), source.sigma[1])
    depth = depths(displacement, onset_of(stored, source), stored.study.model.options)
    return 1 / Noise(joints=given[0], joints_share=given[1]).joints_precision(depth)


def _beyond(spans: np.ndarray, s: float, depth: np.ndarray, aside=(), counted: str = "") -> str:
    """What of a curve lies outside the data of its lane, in words; "" if nothing does.

    Args:
        spans: of depth and position, mm; (4,).
        s: mm.
        depth: mm from first touch; (N,).
        aside: of each angle: the range of the data, rad, that of the curve, and its name.
        counted: see `counted_from`.
    """
    low, high, first, last = spans
    words = []
    if depth.max() > high + 1e-9 or depth.min() < min(low, 0.0) - 1e-9:
        words.append(f"D = {low:.3g} to {high:.3g} mm{counted}")
    known = first <= last  # else no curve of the lane says where it was pressed
    if known and (s < first - 1e-9 or s > last + 1e-9):
        words.append(f"s = {first:.4g} to {last:.4g} mm")
    for (left, right), angle, name in aside:
        if angle < left - 1e-9 or angle > right + 1e-9:
            words.append(f"{name} = {np.degrees(left):.3g} to {np.degrees(right):.3g} deg")
    return f"extrapolated from data at {' and '.join(words)}" if words else ""


def _verdict(
    source: CurveParameters, value: Values, se: Values, presses, bend: float,
    foreign: Sequence[str] = (),
):  # fmt: skip
    """The worst that is to be said of a predicted curve, and everything in words.

    `foreign`: parameters at another tube's values, where the fit has seen no such press.
    """
    found = [(source.status, source.message)]
    if source.status.predicts:
        lost = ~np.isfinite(value["force"])
        if lost.any():
            word = PressStatus(int(presses[lost][0])).message
            found.append((PredictionStatus.NO_SOLUTION, f"{int(lost.sum())} samples: {word}"))
        if (deep := presses == PressStatus.TOO_DEEP).any():
            word = f"{int(deep.sum())} samples: {PressStatus.TOO_DEEP.message}"
            found.append((PredictionStatus.TOO_DEEP, word))
        if np.isinf(se["force"]).any() or np.isinf(source.half_width):
            found.append((PredictionStatus.UNDETERMINED, ""))
        if foreign:
            found.append((PredictionStatus.EXTRAPOLATED, f"fixed: {', '.join(foreign)}"))
        if bend > BENT:
            word = f"off by {bend:.2g} half-widths at the deepest"
            if np.isinf(bend):
                word = "at the deepest the model has no solution at an end of the band"
            found.append((PredictionStatus.BENT, word))
    worst = max(status for status, _ in found)
    said = [m for status, m in found if m] or []
    return worst, "; ".join(dict.fromkeys([worst.message, *said]))


def _in_time(
    stored: FitResult, source: CurveParameters, found: CurvePrediction, time: np.ndarray
) -> CurvePrediction:
    """The prediction with its time, and what of that no record of the fit has."""
    fitted, said = pressed(stored), [found.message]
    curves = [c for c, k in zip(fitted.curves, fitted.lane, strict=True) if k == source.lane]
    if found.status.predicts:
        if time[-1] - time[0] > (longest := span_of(curves).longest) * (1 + 1e-9):
            said.append(f"extrapolated from records of at most {longest:.3g} s")
        way = float(np.max(np.abs(found.displacement - found.displacement[0])))
        said.append(beyond_ramps(curves, ramp_speed(time, found.displacement), way))
    return dataclasses.replace(found, time=time, message="; ".join(filter(None, said)))
