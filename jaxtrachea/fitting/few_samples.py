"""A few samples of every curve: where the many starts of many long curves lead, in less time."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from jaxtrachea.fitting.lane import FORCES, MARKERS, Lane
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.status import FitStatus

#: Samples kept of a curve, and how many times as many the longest of a study has at least.
KEPT, TIMES = 48, 2
#: Distance in scaled coordinates below which two starts of a lane have come to the same point.
SAME = 1e-3


def serves(study: Study, settings: Settings, starts: int) -> bool:
    """Whether so many starts take less time by a few samples of each curve first.

    Not of short curves, nor where compilation is what takes the time (`Study.quick`). Nor where the
    few do not tell: the samples next to a fitted onset, the outliers of a robust loss. Nor where
    nothing looks for other minima afterwards: what is one minimum of the few may be two of all.
    Joint studies, deforming cross-sections, single precision and other solvers go their own way.
    """
    lanes = study.lanes
    of_kind = settings.method == "levenberg-marquardt" and not settings.float32
    of_kind = of_kind and not study.joint and not study.one_at_a_time
    tells = study.model.loss == "linear" and lanes.blend is None and settings.scrutiny
    return of_kind and tells and lanes.force.shape[-1] >= TIMES * KEPT and not study.quick(starts)


def few_samples(study: Study) -> Study:
    """The study with at most `KEPT` samples of each curve, in equal steps from its first to last.

    A curve keeps its weight against the others. What is fitted to a few samples is a start for the
    whole study, no estimate. `Study.curves` are still whole.
    """
    lanes = study.lanes
    seen = _observed(lanes)
    count = seen.sum(axis=-1)
    kept = np.minimum(count, KEPT)
    # How manieth of the observed samples each of the kept ones is, and where that stands.
    last = (np.maximum(count, 1) - 1)[..., None]
    number = np.arange(KEPT) * last // (np.maximum(kept, 2) - 1)[..., None]
    order = np.argsort(~seen, axis=-1, kind="stable")
    place = np.take_along_axis(order, np.minimum(number, last), axis=-1)
    there = np.arange(KEPT) < kept[..., None]
    balance = lanes.balance * np.sqrt(count / np.maximum(kept, 1))
    few = _taken(lanes, place, there)._replace(balance=balance)
    return dataclasses.replace(study, lanes=few)


def _observed(lanes: Lane) -> Bool[np.ndarray, "lanes T N"]:
    """Which samples of each trial have anything that is observed."""
    seen = np.zeros(lanes.force.shape, bool)
    for _, name in FORCES + MARKERS:
        if (precision := getattr(lanes, name)) is not None:
            seen |= (precision > 0).reshape(*seen.shape, -1).any(axis=-1)
    return seen


def _taken(lanes: Lane, place, there) -> Lane:
    """The samples at `place` of each trial, with no weight where none is `there`."""

    def at(v):
        return np.take_along_axis(v, place.reshape(*place.shape, *[1] * (v.ndim - 3)), axis=2)

    new = {"displacement": at(lanes.displacement)}
    for name, weight in FORCES + MARKERS:
        data, precision = getattr(lanes, name), getattr(lanes, weight)
        if data is not None and precision is not None:
            here = there.reshape(*there.shape, *[1] * (data.ndim - 3))
            new |= {name: at(data), weight: np.where(here, at(precision), 0)}
    return lanes._replace(**new)


def same_ends(
    rows: Int[np.ndarray, " starts"], solved: Solved
) -> tuple[Int[np.ndarray, " ends"], Int[np.ndarray, " starts"]]:
    """Starts that ended apart, one of each lane and end, and which of them each start ended with.

    Args:
        rows: lane of each start.
        solved: where they ended; one that did not converge ended by itself.
    """
    own = np.where(solved.status == FitStatus.CONVERGED, 0, 1 + np.arange(len(rows)))
    cells = np.column_stack([rows, own, np.round(solved.theta / SAME)])
    _, first, of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return first, of.reshape(-1)
