"""Cross-validation: curves, contact positions or trials predicted by a fit without them."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lane import without_data
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.predictions import Prediction, predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import draw_starts
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.holdout_groups import companions
from jaxtrachea.inference.residuals import rms


@dataclasses.dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of curves that took no part in the fit that predicts them.

    Attributes:
        lane: lane of each, in the original study.
        trial: index of the left-out trial.
        force: rms force residual over the curve's peak force.
        joints: rms of marker residual over tool displacement (beyond half the largest one); NaN
            without markers.
        ratio: measured over predicted force in the least-squares sense, minus 1 (for linear data:
            the relative error of the compliance).
        study: the study.
        result: the fits, one lane per left-out curve.
        residual: model - data of the force of each curve left out, N; NaN where not observed or not
            predicted; (K, samples).
        converged: whether that fit converged, and the onset and offset of the curve left out; else
            the errors are those of its best point, NaN where it predicts nothing.
    """

    lane: np.ndarray
    trial: np.ndarray
    force: np.ndarray
    joints: np.ndarray
    ratio: np.ndarray
    study: Study
    result: FitResult
    residual: np.ndarray
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


def curves_to_leave_out(study: Study) -> list[tuple[int, int]]:
    """Lane and trial of every curve that the others of its lane can predict.

    Those that are left out together with it (`Study.together`) are no others.

    Raises:
        ValueError: no lane has two curves, or an unknown other than onset and offset belongs to a
            trial (a curve left out could then not be predicted).
    """
    study.refuse_joint("leaving curves out")
    own = [p.name for p in study.free if p.scope == "trial" and p.name not in OF_THE_PRESS]
    if own:
        raise ValueError(
            f"{', '.join(own)} belongs to single trials, which no other curve can tell; fix it, or "
            "give it the scope 'specimen' or 'shared'"
        )
    pairs = [
        (k, t)
        for k, curves in enumerate(study.curves)
        for t, out in enumerate(companions(curves, study.holdout_groups))
        if len(out) < len(curves)
    ]
    if not pairs:
        apart = ", not all left out together" if study.holdout_groups else ""
        raise ValueError(
            f"needs at least two curves that share their parameters{apart}; found none"
        )
    return pairs


def leave_one_out(whole: FitResult, settings: Settings, progress=None) -> LeftOut:
    """Fit every lane once without each of its curves, and predict that curve.

    Those that are left out together with it (`Study.together`) take no part, either. A curve left
    out fits an onset or an offset of its own, all other unknowns kept.

    Args:
        whole: the fit of all curves; lanes with two curves or more are used.
        settings: as for `fit`; every refit also starts from the estimate of the whole fit.
        progress: as for `fit`.

    Raises:
        ValueError: no `FitResult` or `Settings`; as `curves_to_leave_out`.
    """
    check_word("whole", whole, FitResult)
    check_word("settings", settings, Settings)
    study = whole.study
    lane, trial = (np.array(v) for v in zip(*curves_to_leave_out(study), strict=True))
    chosen = study.take(lane)
    lanes = chosen.lanes
    rows = np.arange(len(lane))
    held = np.zeros(lanes.s_c.shape, bool)
    for row, (k, t) in enumerate(zip(lane, trial, strict=True)):
        held[row, companions(study.curves[k], study.holdout_groups)[t]] = True
    result, touched, seen = refitted(chosen, held, whole.theta[lane], settings, progress)
    force, data = seen["force"][rows, trial], lanes.force[rows, trial]
    observed = lanes.precision[rows, trial] > 0
    lost = np.any(observed & ~np.isfinite(force), axis=1)
    model = np.where(observed, data + force, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sum(data * model, axis=1) / np.sum(model * model, axis=1) - 1
        peak = np.asarray(rms(force)) / np.max(np.abs(data), axis=1)
    joints = np.full(len(lane), np.nan)
    if "joints" in seen:
        D = lanes.displacement[rows, trial] - whole.first_touch[lane, trial][:, None]
        D = np.where(observed, np.abs(D), 0)
        moved = D > 0.5 * np.max(D, axis=1, keepdims=True)
        share = seen["joints"][rows, trial] / np.where(moved, D, np.nan)[:, :, None]
        joints = np.asarray(rms(share.reshape(len(lane), -1)))
    return LeftOut(
        lane=lane,
        trial=trial,
        force=np.where(lost, np.nan, peak),
        joints=np.where(lost, np.nan, joints),
        ratio=np.where(lost, np.nan, ratio),
        study=study,
        result=result,
        residual=np.where(observed, force, np.nan),
        converged=result.succeeded & touched.converged,
    )


def without(study: Study, held: Bool[np.ndarray, "lanes T *n"]) -> Study:
    """The same lanes, blind to the trials or samples held back.

    What the trials that are held back as a whole alone read is no unknown.
    """
    seen = without_data(study.lanes, held)
    own = own_unknowns(study, held)
    if own.any():
        seen = seen._replace(active=np.where(own, 0, seen.active))
    return dataclasses.replace(study, lanes=seen)


def own_unknowns(study: Study, held: Bool[np.ndarray, "lanes T *n"]) -> Bool[np.ndarray, "lanes P"]:
    """Unknowns of single trials that none but the trials `held` read, held as a whole."""
    own = np.zeros(study.lanes.lower.shape, bool)
    whole = np.all(held.reshape(*held.shape[:2], -1), axis=2)
    columns = [j for j in study.free_columns if study.parameters[j].scope == "trial"]
    for lane, trial in np.argwhere(whole) if columns else ():
        own[lane, [i for i in study.lanes.index[lane, trial, columns] if i >= 0]] = True
    return own


class OwnOnset(NamedTuple):
    """Estimates with the onset and offset of curves left out.

    Attributes:
        theta: scaled coordinates; (lanes, P).
        converged: whether the fit of these converged; true where there are none; (lanes,).
    """

    theta: Float[np.ndarray, "lanes P"]
    converged: Bool[np.ndarray, " lanes"]


def with_own_onset(
    study: Study,
    held: Bool[np.ndarray, "lanes T *n"],
    theta: Float[np.ndarray, "lanes P"],
    settings: Settings,
) -> OwnOnset:
    """Theta with onset and offset of the trials `held` fitted to them, all other unknowns kept.

    Where the trials have none of their own, `theta` itself.

    Args:
        held: trials, or samples of them, that took no part in the fit; some of each lane.
        theta: the fit without them, scaled coordinates.
        settings: of the fit; one that does not converge keeps its best point.
    """
    own = own_unknowns(study, held)
    if not own.any():
        return OwnOnset(theta, np.ones(len(theta), bool))
    alone = without(study, ~held)
    alone = dataclasses.replace(
        alone, lanes=alone.lanes._replace(active=np.where(own, study.lanes.active, 0))
    )
    starts = draw_starts(alone, settings)
    kept = np.repeat(np.where(own, np.nan, theta), settings.starts, axis=0)
    starts = np.where(np.isnan(kept), starts, kept)
    found = fit(alone, settings, starts=starts)
    return OwnOnset(found.theta, found.succeeded | ~own.any(axis=1))


def refitted(
    study: Study,
    held: Bool[np.ndarray, "lanes T *n"],
    estimate: Float[np.ndarray, "lanes P"],
    settings: Settings,
    progress,
) -> tuple[FitResult, OwnOnset, Prediction]:
    """Every lane fitted without the trials or samples `held`, and what it says of all its trials.

    Besides the starts of a fit one is the estimate of all data, so that no refit ends in a minimum
    which that fit has left behind (it followed up its doubts, a refit does not).

    Args:
        held: trials left out, or samples of them; (lanes, T) or (lanes, T, N).
        estimate: of the lanes with all their data, scaled coordinates; NaN where there is none.
        settings: as for `fit`; no doubt is followed up.
        progress: as for `fit`.

    Returns:
        The fit, onsets and offsets of the trials left out, and residuals of all trials.
    """
    plain = dataclasses.replace(settings, verify=False)
    result = fit(without(study, held), plain, progress, beside=estimate)
    touched = with_own_onset(study, held, result.theta, plain)
    return result, touched, predictions(study, touched.theta)
