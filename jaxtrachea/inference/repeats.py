"""Leaving out all curves of a position, a trial, a speed, or what comes later in each record.

What a model says of places, speeds and times that it has not seen.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

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
from jaxtrachea.measurements.whole_record import loading_speed, second_half_of_hold

#: What is left out: see `repeats`.
LeaveOut = Literal["positions", "speeds", "holds"]
#: Ramps whose speeds differ by less than this factor have one speed.
_ONE_SPEED = 1.2
#: What is left out, in words and in the order of reports, by the kind of its groups.
_WORDS = {
    "positions": "positions",
    "trials": "trials",
    "specimens": "specimens",
    "speeds": "speeds",
    "holds": "the second half of holds",
}


class Worst(NamedTuple):
    """The part of a lane that was predicted worst by a fit without it.

    Attributes:
        error: root mean square force residual of its curves, over the lane's largest force.
        place: in words: contact position with its angle, speed, trial or specimen.
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
        held: which trials; (rows, T). With `holds` which samples; (rows, T, N).
        kinds: `positions`, `trials`, `specimens`, `speeds` or `holds`; (rows,).
        scored: which of those that are held are predicted; as `held`.
    """

    lanes: Int[np.ndarray, " rows"]
    held: Bool[np.ndarray, "rows T *n"]
    kinds: tuple[str, ...]
    scored: Bool[np.ndarray, "rows T *n"]

    @property
    def words(self) -> str:
        """What is left out, in words."""
        return " and ".join(word for kind, word in _WORDS.items() if kind in self.kinds)


def repeats(study: Study, leave_out: LeaveOut = "positions") -> Repeats:
    """What can be left out of every lane.

    `holds`: of all records of a lane at once, what follows the middle of the longest hold; its
    second half is predicted. Of a record without a hold all after its loading.

    `speeds`: within each specimen all records whose loading has one speed.

    `positions`: what each specimen repeats. Contact positions where it has several (repeats of a
    position go together, and so do positions of trials that `Study.together` names), else its
    trials; where all unknowns are shared, a specimen of one curve as a whole.

    Of positions and speeds none where a stiffness belongs to a single curve: no other tells of it.
    (Its onset and offset are fitted.)
    """
    check_word("leave_out", leave_out, LeaveOut)
    if leave_out == "holds":
        return _later_halves(study)
    free = [p for p in study.parameters if not p.fixed]
    width = study.lanes.s_c.shape[1]
    lanes, held, kinds = [], [], []
    own = any(p.scope == "trial" and p.name not in OF_THE_PRESS for p in free)
    shared = all(p.scope == "shared" or p.name in OF_THE_PRESS for p in free)
    for lane, curves in enumerate(() if own else study.curves):
        found = _groups(curves, study.holdout_groups, shared=shared)
        if leave_out == "speeds":
            found = _speeds(curves, study.holdout_groups)
        for kind, groups in found:
            for group in groups:
                row = np.zeros(width, bool)
                row[group] = True
                lanes.append(lane)
                held.append(row)
                kinds.append(kind)
    rows = np.array(held, bool).reshape(len(held), width)
    return Repeats(np.array(lanes, int), rows, tuple(kinds), rows)


def _later_halves(study: Study) -> Repeats:
    """`repeats` by time: one row for every lane that has a whole record."""
    held = np.zeros(study.lanes.force.shape, bool)
    scored = held.copy()
    for lane, curves in enumerate(study.curves):
        for t, curve in enumerate(curves):
            later = second_half_of_hold(curve)
            if later is not None:
                held[lane, t, later.start :] = True
                scored[lane, t, later] = True
    lanes = np.flatnonzero(held.any(axis=(1, 2)))
    return Repeats(lanes, held[lanes], ("holds",) * len(lanes), scored[lanes])


def _speeds(
    curves: tuple[Curve, ...], holdout_groups: Sequence[Sequence[str]]
) -> Iterator[tuple[str, list[list[int]]]]:
    """As `_groups`, of specimens whose records all have a speed, by the speed."""
    twins = companions(curves, holdout_groups)
    for specimen in dict.fromkeys(c.specimen for c in curves):
        found = [(loading_speed(c), t) for t, c in enumerate(curves) if c.specimen == specimen]
        found.sort()
        if found[0][0] == 0:
            continue
        parts = [[found[0][1]]]
        for (before, _), (speed, t) in zip(found[:-1], found[1:], strict=True):
            if speed < _ONE_SPEED * before:
                parts[-1].append(t)
            else:
                parts.append([t])
        parts = _merged(parts, twins)
        if len(parts) > 1:
            yield "speeds", parts


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
    whole: FitResult,
    settings: Settings,
    progress: Callable[[int, int], None] | None = None,
    leave_out: LeaveOut = "positions",
) -> Missed:
    """Fit every lane without each of its `repeats` and predict what is left out.

    The onset and the force offset of a curve left out are fitted to it, all else kept. A refit that
    does not converge predicts from its best point, and is counted: to leave it out would spare a
    model the curves that it does worst on. One that predicts nothing makes its lane NaN.

    Args:
        whole: the fit of all curves.
        settings: as for `fit`; every refit also starts from the estimate of the whole fit.
        progress: as for `fit`.
        leave_out: see `repeats`.

    Raises:
        ValueError: no `FitResult` or `Settings`, or a word that is none.
    """
    check_word("leave_out", leave_out, LeaveOut)
    check_word("whole", whole, FitResult)
    check_word("settings", settings, Settings)
    study = whole.study
    count = len(study.curves)
    lanes, held, kinds, scored = repeats(study, leave_out)
    if not len(lanes):
        none = np.zeros(count, int)
        return Missed(np.full(count, np.nan), none, none, none)
    chosen = study.take(lanes)
    result, touched, seen = refitted(chosen, held, whole.theta[lanes], settings, progress)
    seen = seen["force"]
    predicted = scored.reshape(*scored.shape[:2], -1)
    observed = predicted & (chosen.lanes.precision > 0)
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
        parts = [(row, np.flatnonzero(observed[row].any(axis=1)).tolist()) for row in rows]
        if leave_out == "holds":  # each record is a part
            parts = [(row, [t]) for row, trials in parts for t in trials]
        each = [float(rms(seen[row, t][observed[row, t]])) / peak for row, t in parts]
        row, trials = parts[int(np.argmax(each))]
        worst[lane] = Worst(max(each), _place([study.curves[lane][t] for t in trials], kinds[row]))
    return missed._replace(worst=tuple(worst))


def _place(curves: Sequence[Curve], kind: str) -> str:
    """What was left out, in words."""
    if kind == "speeds":
        return f"{np.mean([loading_speed(c) for c in curves]):.3g} mm/s"
    if kind != "positions":
        names = [c.specimen if kind == "specimens" else c.trial for c in curves]
        return ", ".join(dict.fromkeys(names))
    words = []
    for c in curves:
        aside = "" if c.phi_c == 0 else f" at {np.degrees(c.phi_c):.4g} deg"
        words.append("no position" if c.s_c is None else f"s = {c.s_c:g} mm{aside}")
    return ", ".join(dict.fromkeys(words))
