"""Leaving out all curves of a position, or of a trial: what a model says of places not seen."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.cross_validation import refitted
from jaxtrachea.inference.holdout_groups import companions
from jaxtrachea.inference.residuals import rms
from jaxtrachea.measurements.read import Curve


class Worst(NamedTuple):
    """The part of a lane that was predicted worst by a fit without it.

    Attributes:
        error: root mean square force residual of its curves, over the lane's largest force.
        place: in words: contact position with its angle, trial or specimen.
    """

    error: float
    place: str


class Missed(NamedTuple):
    """Errors of what was left out of each lane, and what became of the refits behind them.

    Attributes:
        error: root mean square force residual of the curves left out, over the lane's largest
            force; NaN where nothing can be left out or a refit predicts nothing; (lanes,).
        refits: fits without a part of the lane; (lanes,).
        unconverged: of them, those that did not converge (`FitStatus`) or left the onset or offset
            of a curve left out so, yet predict: their best point counts; (lanes,).
        lost: of them, those without a finite prediction of all that they left out; (lanes,).
        worst: of each lane; None where `error` is NaN; empty where nothing was left out.
    """

    error: Float[np.ndarray, " lanes"]
    refits: Int[np.ndarray, " lanes"]
    unconverged: Int[np.ndarray, " lanes"]
    lost: Int[np.ndarray, " lanes"]
    worst: tuple[Worst | None, ...] = ()


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

    Contact positions where a specimen has several (repeats of a position go together, and so do
    positions of trials that `Study.together` names), else its trials; where all unknowns are
    shared, a specimen of one curve as a whole. None where a stiffness belongs to a single curve: no
    other tells of it. (Its onset and offset are fitted.)
    """
    free = [p for p in study.parameters if not p.fixed]
    width = study.lanes.s_c.shape[1]
    lanes, held, kinds = [], [], []
    own = any(p.scope == "trial" and p.name not in OF_THE_PRESS for p in free)
    shared = all(p.scope == "shared" or p.name in OF_THE_PRESS for p in free)
    for lane, curves in enumerate(() if own else study.curves):
        for kind, groups in _groups(curves, study.holdout_groups, shared=shared):
            for group in groups:
                row = np.zeros(width, bool)
                row[group] = True
                lanes.append(lane)
                held.append(row)
                kinds.append(kind)
    return Repeats(
        np.array(lanes, int), np.array(held, bool).reshape(len(held), width), tuple(kinds)
    )


def _groups(
    curves: tuple[Curve, ...], holdout_groups: Sequence[Sequence[str]], *, shared: bool
) -> list[tuple[str, list[list[int]]]]:
    """For each specimen of a lane, what is left out and the trials of each."""
    twins = companions(curves, holdout_groups)
    specimens: dict[str, list[int]] = {}
    for t, curve in enumerate(curves):
        specimens.setdefault(curve.specimen, []).append(t)
    out = []
    for trials in specimens.values():
        places: dict[tuple[object, ...], list[int]] = {}
        for t in trials:
            curve = curves[t]
            place = curve.s_c, curve.phi_c, tuple(curve.direction)
            places.setdefault(place, []).append(t)
        kind, parts = "positions", list(places.values())
        if len(parts) == 1:
            kind, parts = "trials", [[t] for t in trials]
        parts = _merged(parts, twins)
        if len(parts) > 1:
            out.append((kind, parts))
        elif shared and len(specimens) > 1:
            out.append(("specimens", [trials]))
    return out


def _merged(parts: list[list[int]], twins: list[list[int]]) -> list[list[int]]:
    """Parts with those that hold twins made one."""
    out: list[list[int]] = []
    for part in parts:
        near = {twin for t in part for twin in twins[t]}
        joined = [other for other in out if near.intersection(other)]
        out = [other for other in out if other not in joined]
        out.append(sorted({t for other in (*joined, part) for t in other}))
    return sorted(out)


def leave_repeats_out(
    whole: FitResult, settings: Settings, progress: Callable[[int, int], None] | None = None
) -> Missed:
    """Fit every lane without each of its `repeats` and predict the curves left out.

    The onset and the force offset of a curve left out are fitted to it, all else kept. A refit that
    does not converge predicts from its best point, and is counted: to leave it out would spare a
    model the curves that it does worst on. One that predicts nothing makes its lane NaN.

    Args:
        whole: the fit of all curves.
        settings: as for `fit`; every refit also starts from the estimate of the whole fit.
        progress: as for `fit`.

    Returns:
        The `Missed` of all lanes.

    Raises:
        ValueError: no `FitResult` or `Settings`.
    """
    check_word("whole", whole, FitResult)
    check_word("settings", settings, Settings)
    study = whole.study
    count = len(study.curves)
    lanes, held, kinds = repeats(study)
    if not len(lanes):
        none = np.zeros(count, int)
        return Missed(np.full(count, np.nan), none, none, none)
    chosen = study.take(lanes)
    result, touched, seen = refitted(chosen, held, whole.theta[lanes], settings, progress)
    seen = seen.force
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
    worst: list[Worst | None] = [None] * count
    for lane in np.flatnonzero((missed.refits > 0) & (missed.lost == 0)):
        rows = np.flatnonzero(lanes == lane)
        peak = np.max(np.abs(study.lanes.force[lane]))
        missed.error[lane] = float(rms(seen[rows][observed[rows]])) / peak
        each = [float(rms(seen[row][observed[row]])) / peak for row in rows]
        row = rows[int(np.argmax(each))]
        curves = [study.curves[lane][t] for t in np.flatnonzero(held[row])]
        worst[lane] = Worst(max(each), _place(curves, kinds[row]))
    return missed._replace(worst=tuple(worst))


def _place(curves: Sequence[Curve], kind: str) -> str:
    """What was left out, in words."""
    if kind != "positions":
        names = [c.trial if kind == "trials" else c.specimen for c in curves]
        return ", ".join(dict.fromkeys(names))
    words = []
    for c in curves:
        aside = "" if c.phi_c == 0 else f" at {np.degrees(c.phi_c):.4g} deg"
        words.append("no position" if c.s_c is None else f"s = {c.s_c:g} mm{aside}")
    return ", ".join(dict.fromkeys(words))
