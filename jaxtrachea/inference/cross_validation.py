"""Cross-validation: curves, contact positions or trials predicted by a fit without them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import draw_starts
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.residuals import rms
from jaxtrachea.measurements.read import Curve


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
    pairs = [(k, t) for k, c in enumerate(study.curves) if len(c) > 1 for t in range(len(c))]
    if not pairs:
        raise ValueError("needs at least two curves that share their parameters; found none")
    return pairs


def leave_one_out(study: Study, settings: Settings, progress=None) -> LeftOut:
    """Fit every lane once without each of its curves, and predict that curve.

    A curve left out fits an onset or an offset of its own, all other unknowns kept.

    Args:
        study: lanes with two curves or more are used.
        settings: as for `fit`.
        progress: as for `fit`.

    Raises:
        ValueError: as `curves_to_leave_out`.
    """
    lane, trial = (np.array(v) for v in zip(*curves_to_leave_out(study), strict=True))
    chosen = study.take(lane)
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
        study=study,
        result=result,
        converged=result.succeeded & touched.converged,
    )


def without(study: Study, held: Bool[np.ndarray, "lanes T"]) -> Study:
    """The same lanes, blind to the trials held back; what these alone read is no unknown."""

    def blind(v):
        return None if v is None else np.where(held[:, :, *[None] * (v.ndim - 2)], 0, v)

    lanes = study.lanes
    seen = lanes._replace(
        precision=blind(lanes.precision), joint_precision=blind(lanes.joint_precision)
    )
    own = own_unknowns(study, held)
    if own.any():
        seen = seen._replace(active=np.where(own, 0, seen.active))
    return dataclasses.replace(study, lanes=seen)


def own_unknowns(study: Study, held: Bool[np.ndarray, "lanes T"]) -> Bool[np.ndarray, "lanes P"]:
    """Unknowns of single trials that none but the trials `held` read."""
    own = np.zeros(study.lanes.lower.shape, bool)
    columns = [j for j in study.free_columns if study.parameters[j].scope == "trial"]
    for lane, trial in np.argwhere(held) if columns else ():
        own[lane, [i for i in study.lanes.index[lane, trial, columns] if i >= 0]] = True
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
    study: Study,
    held: Bool[np.ndarray, "lanes T"],
    theta: Float[np.ndarray, "lanes P"],
    settings: Settings,
) -> OwnTouch:
    """Theta with onset and offset of the trials `held` fitted to them, all other unknowns kept.

    Where the trials have none of their own, `theta` itself.

    Args:
        study: the study, with all its data.
        held: trials that took no part in the fit; at least one of each lane.
        theta: the fit without them, scaled coordinates.
        settings: of the fit; one that does not converge keeps its best point.
    """
    own = own_unknowns(study, held)
    if not own.any():
        return OwnTouch(theta, np.ones(len(theta), bool))
    alone = without(study, ~held)
    alone = dataclasses.replace(
        alone, lanes=alone.lanes._replace(active=np.where(own, study.lanes.active, 0))
    )
    starts = draw_starts(alone, settings)
    kept = np.repeat(np.where(own, np.nan, theta), settings.starts, axis=0)
    starts = np.where(np.isnan(kept), starts, kept)
    found = fit(alone, settings, starts=starts)
    return OwnTouch(found.theta, found.succeeded | ~own.any(axis=1))


class Missed(NamedTuple):
    """Errors of what was left out of each lane, and what became of the refits behind them.

    Attributes:
        error: root mean square force residual of the curves left out, over the lane's largest
            force; NaN where nothing can be left out or a refit predicts nothing; (lanes,).
        refits: fits without a part of the lane; (lanes,).
        unconverged: of them, those that did not converge (`FitStatus`) or left the onset or offset
            of a curve left out so, yet predict: their best point counts; (lanes,).
        lost: of them, those without a finite prediction of all that they left out; (lanes,).
    """

    error: Float[np.ndarray, " lanes"]
    refits: Int[np.ndarray, " lanes"]
    unconverged: Int[np.ndarray, " lanes"]
    lost: Int[np.ndarray, " lanes"]


class Repeats(NamedTuple):
    """What can be left out, one entry for each fit.

    Attributes:
        lanes: whose; (rows,).
        held: which trials; (rows, T).
        kinds: `positions`, `trials` or `specimens`; (rows,).
    """

    lanes: Int[np.ndarray, " rows"]
    held: Bool[np.ndarray, "rows T"]
    kinds: tuple[str, ...]

    @property
    def words(self) -> str:
        """What is left out, in words."""
        order = ("positions", "trials", "specimens")
        return " and ".join(kind for kind in order if kind in self.kinds)


def repeats(study: Study) -> Repeats:
    """What each specimen repeats, within every lane.

    Contact positions where a specimen has several (repeats of a position go together), else its
    trials; where all unknowns are shared, a specimen of one curve as a whole. None where a
    stiffness belongs to a single curve: no other tells of it. (Its onset and offset are fitted.)
    """
    free = [p for p in study.parameters if not p.fixed]
    width = study.lanes.s_c.shape[1]
    lanes, held, kinds = [], [], []
    own = any(p.scope == "trial" and p.name not in OF_THE_PRESS for p in free)
    shared = all(p.scope == "shared" or p.name in OF_THE_PRESS for p in free)
    for lane, curves in enumerate(() if own else study.curves):
        for kind, groups in _groups(curves, shared=shared):
            for group in groups:
                row = np.zeros(width, bool)
                row[group] = True
                lanes.append(lane)
                held.append(row)
                kinds.append(kind)
    return Repeats(
        np.array(lanes, int), np.array(held, bool).reshape(len(held), width), tuple(kinds)
    )


def _groups(curves: tuple[Curve, ...], *, shared: bool) -> list[tuple[str, list[list[int]]]]:
    """For each specimen of a lane, what is left out and the trials of each."""
    specimens: dict[str, list[int]] = {}
    for t, curve in enumerate(curves):
        specimens.setdefault(curve.specimen, []).append(t)
    out = []
    for trials in specimens.values():
        places: dict[float | None, list[int]] = {}
        for t in trials:
            places.setdefault(curves[t].s_c, []).append(t)
        if len(places) > 1:
            out.append(("positions", list(places.values())))
        elif len(trials) > 1:
            out.append(("trials", [[t] for t in trials]))
        elif shared and len(specimens) > 1:
            out.append(("specimens", [trials]))
    return out


def leave_repeats_out(
    study: Study, settings: Settings, progress: Callable[[int, int], None] | None = None
) -> Missed:
    """Fit every lane without each of its `repeats` and predict the curves left out.

    The onset and the force offset of a curve left out are fitted to it, all else kept. A refit that
    does not converge predicts from its best point, and is counted: to leave it out would spare a
    model the curves that it does worst on. One that predicts nothing makes its lane NaN.

    Args:
        study: the study.
        settings: as for `fit`.
        progress: as for `fit`.

    Returns:
        The `Missed` of all lanes.
    """
    count = len(study.curves)
    lanes, held, _ = repeats(study)
    if not len(lanes):
        return Missed(np.full(count, np.nan), *np.zeros((3, count), int))
    chosen = study.take(lanes)
    plain = dataclasses.replace(settings, scrutiny=False)
    result = fit(without(chosen, held), plain, progress)
    touched = with_own_touch(chosen, held, result.theta, plain)
    seen = predictions(chosen, touched.theta).force
    observed = held[:, :, None] & (chosen.lanes.precision > 0)
    lost = np.any(observed & ~np.isfinite(seen), axis=(1, 2))
    converged = result.succeeded & touched.converged

    def of_lane(rows):
        return np.bincount(lanes[rows], minlength=count)

    missed = Missed(
        error=np.full(count, np.nan),
        refits=of_lane(np.ones(len(lanes), bool)),
        unconverged=of_lane(~converged & ~lost),
        lost=of_lane(lost),
    )
    for lane in np.flatnonzero((missed.refits > 0) & (missed.lost == 0)):
        rows = lanes == lane
        peak = np.max(np.abs(study.lanes.force[lane]))
        missed.error[lane] = float(rms(seen[rows][observed[rows]])) / peak
    return missed
