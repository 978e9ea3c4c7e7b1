"""Measured curves against what a finished fit predicts for them."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Taken, Weighting, takes
from jaxtrachea.fitting.model import columns_of
from jaxtrachea.fitting.onset import onset_is_sought
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.refusals import Size, refusal
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.zero_messages import UNITS, zeros_against
from jaxtrachea.fitting.zeros import resolved
from jaxtrachea.measurements.observed import WITHOUT_VECTORS
from jaxtrachea.measurements.read import BadCurve, Curve
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.optimisation.programs import program
from jaxtrachea.prediction.core import force_and_slope
from jaxtrachea.prediction.curves import CurvePrediction, predict_sources
from jaxtrachea.prediction.model_error import model_errors
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.prediction.sources import CurveParameters, source_of, value_of
from jaxtrachea.status import FitStatus, PredictionStatus

#: Standard deviations of the noise from which a force counts in the share that a band holds.
NOISE_LEVELS = 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class Compared:
    """One measured curve and its prediction.

    Attributes:
        curve: as read.
        prediction: at its displacements.
        in_fit: "yes" if the fit has used these samples; "changed" if it has used others under the
            same name; else "no".
        offset: force without contact, N, as it is predicted.
    """

    curve: Curve
    prediction: CurvePrediction
    in_fit: str
    offset: float = 0.0

    @property
    def residual(self) -> np.ndarray:
        """Predicted minus measured force, N; (N,)."""
        return self.prediction.force - self.curve.force

    def other_residual(self, name: str) -> np.ndarray:
        """Predicted minus measured `name` of `FITTED_NUMBERS`; NaN where there is none; (N,)."""
        predicted, measured = self.prediction.others[name][0], getattr(self.curve, name)
        return np.full(len(predicted), np.nan) if measured is None else predicted - measured

    @property
    def with_force(self) -> np.ndarray:
        """Which samples have a force above the noise: the others are 0 in model and record; (N,).

        By the prediction, so that no sample is chosen for what its noise makes of it.
        """
        p = self.prediction
        return np.abs(p.force - self.offset) > NOISE_LEVELS * p.sigma

    @property
    def covered(self) -> np.ndarray:
        """Which samples lie in the 95 % band of a new sample; (N,)."""
        p = self.prediction
        return (p.low95 <= self.curve.force) & (self.curve.force <= p.high95)

    def joint_residual(self, tool_radius: float | None, rings: np.ndarray) -> np.ndarray:
        """Predicted minus measured marker displacement, mm, NaN under the tool; (N, M)."""
        curve = self.curve
        if curve.joint_displacement is None or curve.joint_rings is None:
            return np.zeros((len(curve.force), 0))
        found = self.prediction.joints[:, curve.joint_rings] - curve.joint_displacement
        if tool_radius is not None and curve.s_c is not None:
            found[:, np.abs(rings[curve.joint_rings] - curve.s_c) <= tool_radius] = np.nan
        return found


def pressable(stored: FitResult, curves: Sequence[Curve]) -> tuple[list[Curve], list[BadCurve]]:
    """Curves that the model of the fit can press, and the others with the reason."""
    good, bad = [], []
    model, parameters = stored.study.model, stored.study.parameters
    size = Size.of(model.geometry)
    for curve in curves:
        refused = refusal(curve, size, model.options, parameters)
        if refused is None:
            good.append(curve)
            continue
        text = str(InputError.like(refused.error, place=""))
        cure = "correct the file; tube and model are those of the fit"
        bad.append(BadCurve(curve.specimen, curve.trial, curve.source, refused.kind, text, cure))
    return good, bad


def compare(
    stored: FitResult, curves: Sequence[Curve], *, as_specimen: str | None = None
) -> list[Compared]:
    """Predict measured curves.

    A curve that the fit has used is predicted with its own parameters of the fit. A new one has its
    own (those of scope `trial`, such as onset) fitted to it, everything else kept. Where an onset
    was fitted, its corner is rounded as the fit does it.

    Args:
        curves: from `pressable`.
        as_specimen: of the fit, in the place of one that it does not know.
    """
    if not curves:
        return []
    used = {(c.specimen, c.trial): c for c in pressed(stored).curves}
    fitted, (stored, taken) = stored, _with_zeros(stored, curves)
    sources, words = [], []
    for curve in curves:
        word = _in_fit(used.get((curve.specimen, curve.trial)), curve)
        trial = curve.trial if word == "yes" else None
        source = source_of(
            stored, curve.specimen, trial, as_specimen=as_specimen, measured=True
        )  # fmt: skip
        own = tuple(f for f in source.own if takes(stored.study.free[f], curve, taken))
        sources.append(dataclasses.replace(source, trial=curve.trial, own=own))
        words.append(word)
    # The error between positions is that of the fit, whose unknowns these are.
    pressed(stored).errors.update(model_errors(fitted, [source.lane for source in sources]))
    sigmas = [_sigma(stored, c, source) for c, source in zip(curves, sources, strict=True)]
    rounded = zip(sources, measured_corners(stored, curves, sigmas), words, strict=True)
    sources = [
        source if word == "yes" else dataclasses.replace(source, blend=blend)
        for source, blend, word in rounded
    ]
    sources = with_own(stored, sources, curves, sigmas)
    s = [np.nan if c.s_c is None else c.s_c for c in curves]
    aside = None
    if stored.study.model.level.off_midline:
        aside = [(c.phi_c, (c.direction[0], c.direction[1])) for c in curves]
    depths = [c.displacement for c in curves]
    times = [np.asarray(c.time) for c in curves] if stored.study.model.relaxes else None
    found = predict_sources(stored, sources, s, depths, sigmas, aside=aside, times=times)
    found = _with_other_zeros(fitted.study, curves, words, found)
    offsets = [value_of(stored, source, "force_offset") for source in sources]
    return [Compared(*row) for row in zip(curves, found, words, offsets, strict=True)]


def _with_other_zeros(
    study: Study, curves: Sequence[Curve], words: Sequence[str], found: list[CurvePrediction]
) -> list[CurvePrediction]:
    """The predictions; of records that show what the fit holds at 0 with that word."""
    against, out = zeros_against(study, curves), []
    for k, (word, p) in enumerate(zip(words, found, strict=True)):
        said = [
            f"{name} is held at 0 in the fit, where this record shows {shown[k]:.3g} {UNITS[name]}"
            for name, shown in against.items()
            if word != "yes" and np.isfinite(shown[k])
        ]
        if said and p.status.predicts:
            status = max(p.status, PredictionStatus.OTHER_ZERO)
            head = p.message.removeprefix(p.status.message)
            p = dataclasses.replace(
                p, status=status, message="; ".join([f"{status.message}{head}", *said])
            )
        out.append(p)
    return out


def _with_zeros(stored: FitResult, curves: Sequence[Curve]) -> tuple[FitResult, Taken]:
    """The fit with columns for all zeros that are `auto` and that a curve's own record shows.

    Also such as no curve of the fit takes; and which of them each curve takes.
    """
    study = stored.study
    held = [dataclasses.replace(p, fixed=True) if p.auto else p for p in study.parameters]
    if not any(p.auto for p in held):
        return stored, {}
    if stored.origin.reading.get("baseline") == "none":
        held.append(dataclasses.replace(DEFAULTS["force_slope"], auto=False))
    own = resolved(held, curves, study.model.options)
    shown = {p.name for p in own.parameters if p.auto and not p.fixed}
    known = {p.name for p in study.parameters}
    table = [dataclasses.replace(p, fixed=p.fixed and p.name not in shown)
             for p in study.parameters]  # fmt: skip
    table += [p for p in own.parameters if p.name not in known]
    model = dataclasses.replace(study.model, columns=columns_of(table))
    more = [p.value for p in table[len(study.parameters) :]]
    lanes, shape = study.lanes, (*study.lanes.s_c.shape, len(more))
    lanes = lanes._replace(  # that no curve of the fit takes them
        value=np.concatenate([lanes.value, np.broadcast_to(more, shape)], axis=2),
        index=np.concatenate([lanes.index, np.full(shape, -1, np.int32)], axis=2),
    )
    study = dataclasses.replace(study, parameters=tuple(table), model=model, lanes=lanes)
    return dataclasses.replace(stored, study=study), own.taken


def _in_fit(used: Curve | None, curve: Curve) -> str:
    if used is None:
        return "no"
    same = np.array_equal(used.force, curve.force)
    same = same and np.array_equal(used.displacement, curve.displacement)
    same = same and (used.s_c == curve.s_c)
    if used.time is not None and curve.time is not None:
        same = same and np.array_equal(used.time, curve.time)
    same = same and used.phi_c == curve.phi_c and tuple(used.direction) == tuple(curve.direction)
    return "yes" if same else "changed"


def _sigma(stored: FitResult, curve: Curve, source: CurveParameters) -> np.ndarray:
    """Noise of a curve's samples, N: its own where that of the fit was given, else the fit's.

    Without the share of the force that it may have beside it.
    """
    if curve.sigma is not None and stored.study.noise_given[0]:
        return np.asarray(curve.sigma)
    return np.full(len(curve.force), source.sigma[0])


def with_own(
    stored: FitResult,
    sources: Sequence[CurveParameters],
    curves: Sequence[Curve],
    sigmas: Sequence[np.ndarray],
) -> list[CurveParameters]:
    """Sources whose own parameters are fitted to their curves, all others kept as they are.

    The covariance of what is kept and of what is fitted follows to first order: d own / d kept is
    that of the least-squares solution, and the noise of the curve comes on top.
    """
    out = list(sources)
    groups: dict[tuple[int, ...], list[int]] = {}
    for k, source in enumerate(sources):
        if source.own and source.status.predicts:
            groups.setdefault(source.own, []).append(k)
    for own, members in groups.items():
        own_study = _own_study(stored, own, [(sources[k], curves[k], sigmas[k]) for k in members])
        result = fit(own_study, Settings(verify=False))
        theta = result.theta[:, : len(own)] * _steps(stored.study, own_study, own)
        slopes = _slopes(stored, own, [sources[k] for k in members], theta, own_study)
        for row, k in enumerate(members):
            status = FitStatus(int(result.status[row]))
            held = result.at_bound[row, : len(own)]
            estimate = _Own(own, theta[row], status, held, slopes[row], sigmas[k])
            out[k] = _merged(stored, sources[k], estimate)
    return out


def measured_corners(
    stored: FitResult, curves: Sequence[Curve], sigmas: Sequence[np.ndarray]
) -> list[float]:
    """Rounded corner at the onset of new curves, mm, as the fit has its own; NaN without an onset.

    Args:
        curves: new ones, alone or of any specimen.
        sigmas: noise of their samples; counts where that of the fit was given.
    """
    study = stored.study
    if not onset_is_sought(study.parameters, study.model.options):
        return [np.nan] * len(curves)
    given = study.noise_given[0]
    alone = [
        _apart(c, i, s if given else None)
        for i, (c, s) in enumerate(zip(curves, sigmas, strict=True))
    ]
    own_study = build_study(alone, study.model.geometry, study.model.options, study.parameters)
    return [] if own_study.lanes.blend is None else np.ravel(own_study.lanes.blend).tolist()


def _apart(curve: Curve, i: int, sigma: np.ndarray | None) -> Curve:
    """A curve with a name of its own, so that curves of equal name stay apart; force alone."""
    return dataclasses.replace(
        curve,
        specimen=f"{i}",
        trial="",
        sigma=sigma,
        joint_rings=None,
        joint_displacement=None,
        **WITHOUT_VECTORS,
    )


def _own_study(stored: FitResult, own, members) -> Study:
    """One lane per curve, whose unknowns are the own columns."""
    study = stored.study
    names = {study.free[f].name for f in own}
    known = np.stack([_values(stored, source) for source, _, _ in members])
    # The values serve where starts are sought; what is kept has that of its curve, below.
    table = [
        dataclasses.replace(p, auto=False)
        if p.name in names
        else dataclasses.replace(p, fixed=True, auto=False, value=float(value))
        for p, value in zip(study.parameters, np.median(known, axis=0), strict=True)
    ]
    curves = [_apart(c, i, s) for i, (_, c, s) in enumerate(members)]
    model = study.model
    own_study = build_study(
        curves, model.geometry, model.options, table,
        weighting=Weighting("sample", model.loss, model.loss_scale),
    )  # fmt: skip
    blend = np.array([[source.blend] for source, _, _ in members])
    lanes = own_study.lanes._replace(
        value=known[:, None], blend=None if np.isnan(blend).all() else blend
    )
    return dataclasses.replace(own_study, lanes=lanes)


def _steps(study: Study, own_study: Study, own) -> np.ndarray:
    """Steps of the own columns in the study over those in the fit: each follows its own presses."""
    pairs = zip(own_study.free, (study.free[f] for f in own), strict=True)
    return np.array([1.0 if q.scale == "log" else p.step / q.step for p, q in pairs])


def _values(stored: FitResult, source: CurveParameters) -> np.ndarray:
    """All parameters in their units, the free ones as estimated; (J,)."""
    value = source.value.copy()
    for f, j in enumerate(stored.study.free_columns):
        if f not in source.own:
            value[j] = stored.study.parameters[j].from_scaled(float(source.free[f]))
    return value


def _slopes(stored: FitResult, own, sources, theta, own_study: Study) -> list[np.ndarray]:
    """Derivative of the forces by all free columns, at the fitted own ones; (F, N) each.

    In the steps of the fit, as `theta` of the own columns.
    """
    free = np.stack([source.free for source in sources])
    free[:, list(own)] = np.where(np.isfinite(theta), theta, 0.0)
    lanes = own_study.lanes
    run = program(force_and_slope, stored.study.model)
    value = np.stack([source.value for source in sources])

    def first(name) -> Any:
        found = getattr(lanes, name)
        return None if found is None else found[:, 0]

    motion = Motion(onset=None, **{n: first(n) for n in Motion._fields if n != "onset"})
    _, slopes = run(*jax.tree.map(jnp.asarray, (free, value, motion)))
    return [np.asarray(slopes[k])[:, lanes.precision[k, 0] > 0] for k in range(len(sources))]


class _Own(NamedTuple):
    """What a curve's own parameters came to; `slopes`: (F, N)."""

    columns: tuple[int, ...]
    theta: np.ndarray
    status: FitStatus
    held: np.ndarray
    slopes: np.ndarray
    sigma: np.ndarray


def _merged(stored: FitResult, source: CurveParameters, own: _Own) -> CurveParameters:
    """The source with its own parameters and the covariance of all."""
    columns = list(own.columns)
    names = ", ".join(stored.study.free[f].name for f in columns)
    said = "; ".join(filter(None, [source.message, f"{names} fitted to this curve"]))
    if not own.status.succeeded:
        word = f"{names}: {own.status.message}"
        return dataclasses.replace(source, status=PredictionStatus.NO_OWN, message=word)
    free = source.free.copy()
    free[columns] = own.theta
    moving = [f for f, held in zip(columns, own.held, strict=True) if not held]
    A = (own.slopes[moving] / own.sigma).T
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-14, hermitian=True)
    follow = np.eye(len(free))  # rows: how all columns move with each
    kept = [f for f in range(len(free)) if f not in columns]
    follow[moving] = 0.0
    B = (own.slopes[kept] / own.sigma).T
    follow[np.ix_(moving, kept)] = -inverse @ (A.T @ B)
    covariance = follow @ source.covariance @ follow.T
    covariance[np.ix_(moving, moving)] += inverse
    return dataclasses.replace(
        source,
        free=free,
        covariance=covariance,
        null_space=source.null_space @ follow.T,
        status=max(source.status, _own_status(own)),
        message=said,
        refitted_own=(own.slopes[moving].T, inverse @ (A / own.sigma[:, None]).T),
    )


def _own_status(own: _Own) -> PredictionStatus:
    if own.status == FitStatus.UNIDENTIFIABLE:
        return PredictionStatus.UNDETERMINED
    return PredictionStatus.AT_BOUND if own.held.any() else PredictionStatus.OK
