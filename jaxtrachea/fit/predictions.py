"""The fitted model at the measured points, for plots, residual tables and cross-validation."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea.fit.fit import FitResult, Settings, fit
from jaxtrachea.fit.parameters import OF_THE_PRESS
from jaxtrachea.fit.problem import Lane, Problem
from jaxtrachea.fit.residual import residual_value
from jaxtrachea.fit.starts import draw_starts


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """Model minus data in units; NaN where nothing was observed.

    Attributes:
        force: N; (lanes, trials, samples).
        joints: mm; (lanes, trials, samples, rings), or None.
    """

    force: np.ndarray
    joints: np.ndarray | None

    def worst(self, result: FitResult) -> str:
        """The largest force residual in words."""
        size = np.where(np.isfinite(self.force), np.abs(self.force), -1)
        lane, trial, sample = np.unravel_index(np.argmax(size), size.shape)
        curves = result.problem.curves[lane]
        if size[lane, trial, sample] < 0:
            return "none, no finite prediction"
        curve = curves[trial]
        value = self.force[lane, trial, sample]
        return (
            f"{value:+.3g} N at {curve.displacement[sample]:.3g} mm in {curve.specimen} "
            f"{curve.trial}, where {curve.force[sample]:.4g} N were measured"
        )


def lag_correlation(prediction: Prediction) -> np.ndarray:
    """Correlation of neighbouring force residuals along the curves of each lane; (lanes,).

    About 0 for independent noise, near 1 where the model misses the shape of the curves; NaN with
    fewer than 10 pairs. Not centred: a residual of one sign is correlated, too.
    """
    r = np.nan_to_num(prediction.force)
    pair = np.isfinite(prediction.force[..., 1:]) & np.isfinite(prediction.force[..., :-1])
    both = np.sum(r[..., 1:] * r[..., :-1] * pair, axis=(1, 2))
    ends = 0.5 * np.sum((r[..., 1:] ** 2 + r[..., :-1] ** 2) * pair, axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.sum(pair, axis=(1, 2)) >= 10, both / ends, np.nan)


def predictions(problem: Problem, theta: np.ndarray, chunk: int = 256) -> Prediction:
    """Residuals of all lanes at `theta` (lanes, P), in N and mm."""
    run = _compiled(problem.program)
    count = len(theta)
    parts = []
    for first in range(0, count, chunk):
        of = np.arange(first, min(first + chunk, count))
        lane = jax.tree.map(lambda v, of=of: v[of], problem.lanes)
        parts.append(np.asarray(run(jnp.asarray(theta[of]), lane)))
    value = np.concatenate(parts)
    lanes = problem.lanes
    samples = lanes.force.shape[-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        force = np.where(lanes.precision > 0, value[..., :samples] / lanes.precision, np.nan)
        joints = None
        if lanes.joints is not None and lanes.joint_precision is not None:
            markers = value[..., samples:].reshape(lanes.joints.shape) / lanes.joint_precision
            joints = np.where(lanes.joint_precision > 0, markers, np.nan)
    return Prediction(force, joints)


@functools.lru_cache(maxsize=8)
def _compiled(problem: Problem):
    def value(theta, lane: Lane):
        return residual_value(problem, theta, lane)

    return jax.jit(jax.vmap(value))


@dataclasses.dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of curves that took no part in the fit that predicts them.

    Attributes:
        lane: lane of each, in the original problem.
        trial: index of the left-out trial.
        force: rms force residual over the curve's peak force.
        joints: rms of marker residual over tool displacement (beyond half the largest one); NaN
            without markers.
        ratio: measured over predicted force in the least-squares sense, minus 1 (for linear data:
            the relative error of the compliance).
        result: the fits, one lane per left-out curve.
        converged: whether that fit converged, and the onset and offset of the curve left out; else
            the errors are those of its best point, NaN where it predicts nothing.
    """

    lane: np.ndarray
    trial: np.ndarray
    force: np.ndarray
    joints: np.ndarray
    ratio: np.ndarray
    result: FitResult
    converged: np.ndarray

    @property
    def sentence(self) -> str:
        """What of the fits did not converge or predicts nothing, in words; "" if all is well."""
        lost = np.isnan(self.force)
        return refits_sentence(len(lost), int(np.sum(~self.converged & ~lost)), int(np.sum(lost)))


def refits_sentence(refits: int, unconverged: int, lost: int) -> str:
    """What became of fits without a part of the data, in words; "" if all is well.

    Args:
        refits: in all.
        unconverged: did not converge, yet predict.
        lost: give no finite prediction of what they left out, converged or not.
    """
    said = []
    if unconverged:
        said.append(f"{unconverged} of {refits} refits did not converge; their best points count")
    if lost:
        said.append(f"{lost} of {refits} refits give no finite prediction of what they left out")
    return "; ".join(said)


def curves_to_leave_out(problem: Problem) -> list[tuple[int, int]]:
    """Lane and trial of every curve that the others of its lane can predict.

    Raises:
        ValueError: no lane has two curves, or an unknown other than onset and offset belongs to a
            trial (a curve left out could then not be predicted).
    """
    problem.refuse_joint("leaving curves out")
    own = [p.name for p in problem.free if p.scope == "trial" and p.name not in OF_THE_PRESS]
    if own:
        raise ValueError(
            f"{', '.join(own)} belongs to single trials, which no other curve can tell; fix it, or "
            "give it the scope 'specimen' or 'shared'"
        )
    pairs = [(k, t) for k, c in enumerate(problem.curves) if len(c) > 1 for t in range(len(c))]
    if not pairs:
        raise ValueError("needs at least two curves that share their parameters; found none")
    return pairs


def leave_one_out(problem: Problem, settings: Settings, progress=None) -> LeftOut:
    """Fit every lane once without each of its curves, and predict that curve.

    A curve left out fits an onset or an offset of its own, all other unknowns kept.

    Args:
        problem: lanes with two curves or more are used.
        settings: as for `fit`.
        progress: as for `fit`.

    Raises:
        ValueError: as `curves_to_leave_out`.
    """
    lane, trial = (np.array(v) for v in zip(*curves_to_leave_out(problem), strict=True))
    chosen = problem.take(lane)
    lanes = chosen.lanes
    rows = np.arange(len(lane))
    held = np.zeros(lanes.s_c.shape, bool)
    held[rows, trial] = True
    plain = dataclasses.replace(settings, scrutiny=False)
    result = fit(without(chosen, held), plain, progress)
    touched = with_own_touch(chosen, held, result.theta, plain)
    seen = predictions(chosen, touched.theta)
    force, data = seen.force[rows, trial], lanes.force[rows, trial]
    observed = lanes.precision[rows, trial] > 0
    lost = np.any(observed & ~np.isfinite(force), axis=1)
    model = np.where(observed, data + force, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sum(data * model, axis=1) / np.sum(model * model, axis=1) - 1
        peak = np.asarray(rms(force)) / np.max(np.abs(data), axis=1)
    joints = np.full(len(lane), np.nan)
    if seen.joints is not None:
        D = np.abs(lanes.displacement[rows, trial])
        moved = D > 0.5 * np.max(D, axis=1, keepdims=True)
        share = seen.joints[rows, trial] / np.where(moved, D, np.nan)[:, :, None]
        joints = np.asarray(rms(share.reshape(len(lane), -1)))
    return LeftOut(
        lane=lane,
        trial=trial,
        force=np.where(lost, np.nan, peak),
        joints=np.where(lost, np.nan, joints),
        ratio=np.where(lost, np.nan, ratio),
        result=result,
        converged=result.succeeded & touched.converged,
    )


def without(problem: Problem, held: Bool[np.ndarray, "lanes T"]) -> Problem:
    """The same lanes, blind to the trials held back; what these alone read is no unknown."""
    blind = lambda v: None if v is None else np.where(held[:, :, *[None] * (v.ndim - 2)], 0, v)  # noqa: E731
    lanes = problem.lanes
    seen = lanes._replace(
        precision=blind(lanes.precision), joint_precision=blind(lanes.joint_precision)
    )
    own = own_unknowns(problem, held)
    if own.any():
        seen = seen._replace(active=np.where(own, 0, seen.active))
    return dataclasses.replace(problem, lanes=seen)


def own_unknowns(
    problem: Problem, held: Bool[np.ndarray, "lanes T"]
) -> Bool[np.ndarray, "lanes P"]:
    """Unknowns of single trials that none but the trials `held` read."""
    own = np.zeros(problem.lanes.lower.shape, bool)
    columns = [j for j in problem.free_columns if problem.parameters[j].scope == "trial"]
    for lane, trial in np.argwhere(held) if columns else ():
        own[lane, [i for i in problem.lanes.index[lane, trial, columns] if i >= 0]] = True
    return own


class OwnTouch(NamedTuple):
    """Estimates with the onset and offset of curves left out.

    Attributes:
        theta: scaled coordinates; (lanes, P).
        converged: whether the fit of these converged; true where there are none; (lanes,).
    """

    theta: Float[np.ndarray, "lanes P"]
    converged: Bool[np.ndarray, " lanes"]


def with_own_touch(
    problem: Problem,
    held: Bool[np.ndarray, "lanes T"],
    theta: Float[np.ndarray, "lanes P"],
    settings: Settings,
) -> OwnTouch:
    """Theta with onset and offset of the trials `held` fitted to them, all other unknowns kept.

    Where the trials have none of their own, `theta` itself.

    Args:
        problem: the study, with all its data.
        held: trials that took no part in the fit; at least one of each lane.
        theta: the fit without them, scaled coordinates.
        settings: of the fit; one that does not converge keeps its best point.
    """
    own = own_unknowns(problem, held)
    if not own.any():
        return OwnTouch(theta, np.ones(len(theta), bool))
    alone = without(problem, ~held)
    alone = dataclasses.replace(
        alone, lanes=alone.lanes._replace(active=np.where(own, problem.lanes.active, 0))
    )
    starts = draw_starts(alone, settings)
    kept = np.repeat(np.where(own, np.nan, theta), settings.starts, axis=0)
    starts = np.where(np.isnan(kept), starts, kept)
    found = fit(alone, settings, starts=starts)
    return OwnTouch(found.theta, found.succeeded | ~own.any(axis=1))


def rms(values: np.ndarray) -> np.ndarray | np.floating:
    """Root mean square along the last axis over what is not NaN; NaN if nothing is left."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(known, values**2, 0).sum(axis=-1) / known.sum(axis=-1))
