"""Cross-validation of a model on what an experiment repeats: contact positions, else trials."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.identify.fit import Settings, fit
from jaxtrachea.identify.measurements import Curve
from jaxtrachea.identify.parameters import OF_THE_PRESS
from jaxtrachea.identify.predictions import predictions, rms, with_own_touch, without
from jaxtrachea.identify.problem import Problem


class Repeats(NamedTuple):
    """What can be left out, one entry for each fit.

    Attributes:
        lanes: whose; (jobs,).
        held: which trials; (jobs, T).
        kinds: `positions`, `trials` or `specimens`; (jobs,).
    """

    lanes: Int[np.ndarray, " jobs"]
    held: Bool[np.ndarray, "jobs T"]
    kinds: tuple[str, ...]

    @property
    def words(self) -> str:
        """What is left out, in words."""
        order = ("positions", "trials", "specimens")
        return " and ".join(kind for kind in order if kind in self.kinds)


def repeats(problem: Problem) -> Repeats:
    """What each specimen repeats, within every lane.

    Contact positions where a specimen has several (repeats of a position go together), else its
    trials; where all unknowns are shared, a specimen of one curve as a whole. None where a
    stiffness belongs to a single curve: no other tells of it. (Its onset and offset are fitted.)
    """
    free = [p for p in problem.parameters if not p.fixed]
    width = problem.lanes.s_c.shape[1]
    lanes, held, kinds = [], [], []
    own = any(p.scope == "trial" and p.name not in OF_THE_PRESS for p in free)
    shared = all(p.scope == "shared" or p.name in OF_THE_PRESS for p in free)
    for lane, curves in enumerate(() if own else problem.curves):
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
    problem: Problem, settings: Settings, progress: Callable[[int, int], None] | None = None
) -> Float[np.ndarray, " lanes"]:
    """Fit every lane without each of its `repeats` and predict the curves left out.

    Args:
        problem: the study.
        settings: as for `fit`.
        progress: as for `fit`.

    Returns:
        Root mean square force residual of the curves left out, over the lane's largest force;
        (lanes,), NaN where nothing can be left out or a fit failed. The onset and the force offset
        of a curve left out are fitted to it, all else kept.
    """
    error = np.full(len(problem.curves), np.nan)
    lanes, held, _ = repeats(problem)
    if not len(lanes):
        return error
    chosen = problem.take(lanes)
    plain = dataclasses.replace(settings, scrutiny=False)
    result = fit(without(chosen, held), plain, progress)
    seen = predictions(chosen, with_own_touch(chosen, held, result.theta, plain)).force
    solved = result.succeeded
    missed = np.where((held & solved[:, None])[:, :, None], seen, np.nan)
    for lane in np.unique(lanes):
        mine = lanes == lane
        if solved[mine].all():
            peak = np.max(np.abs(problem.lanes.force[lane]))
            error[lane] = float(rms(missed[mine].ravel())) / peak
    return error
