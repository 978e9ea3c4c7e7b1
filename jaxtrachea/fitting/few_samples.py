"""A few samples of every curve: where the many starts of many long curves lead, in less time."""

import dataclasses

import numpy as np
from jaxtyping import Int

from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.batching import on_cpu
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.status import FitStatus

#: Samples kept of a curve, and of the longest of a study at least.
KEPT, LONG = 24, 96
#: Starts up to which compiling one more program takes longer than it saves in several runs.
MOST_WHOLE = 2048
#: Width of the cells, in scaled coordinates, in which starts of a lane have come to the same point.
SAME = 1e-3


def serves(study: Study, settings: Settings, starts: int) -> bool:
    """Whether so many starts take less time by a few samples of each curve first.

    Not of short curves, nor of so few starts that compiling takes longer. Nor where the few may not
    tell: a force that remembers what lies between them, markers (seen in some samples alone), the
    samples next to a fitted onset, the outliers of a robust loss. Nor where no doubt is followed up
    afterwards: what is one minimum of the few may be two of all. Joint studies, deforming
    cross-sections, single precision, other solvers and other devices than CPUs, where nothing was
    measured, go their own way.
    """
    lanes, model = study.lanes, study.model
    long = lanes.force.shape[-1] >= LONG and starts > MOST_WHOLE
    forces_alone = "joints" not in lanes.others and lanes.time is None and not model.level.iterates
    tells = forces_alone and lanes.blend is None and model.loss == "linear" and settings.verify
    solver = settings.method == "levenberg-marquardt" and not settings.float32
    return long and tells and solver and not study.joint and on_cpu()


def few_samples(study: Study) -> Study:
    """The study with at most `KEPT` forces of each curve, in equal steps from its first to last.

    A curve keeps its weight against the others. What is fitted to a few samples is a start for the
    whole study, no estimate. `Study.curves` are still whole.
    """
    lanes = study.lanes
    seen = np.asarray(lanes.precision) > 0
    count = seen.sum(axis=-1)
    kept = np.minimum(count, KEPT)
    # How manieth of the observed samples each of the kept ones is, and where that stands.
    last = (np.maximum(count, 1) - 1)[..., None]
    number = np.arange(KEPT) * last // (np.maximum(kept, 2) - 1)[..., None]
    order = np.argsort(~seen, axis=-1, kind="stable")
    place = np.take_along_axis(order, np.minimum(number, last), axis=-1)

    def at(v):
        return np.take_along_axis(v, place, axis=-1)

    there = np.arange(KEPT) < kept[..., None]
    few = lanes._replace(
        displacement=at(lanes.displacement),
        force=at(lanes.force),
        precision=np.where(there, at(lanes.precision), 0),
        balance=lanes.balance * np.sqrt(count / np.maximum(kept, 1)),
    )
    return dataclasses.replace(study, lanes=few)


def same_ends(
    rows: Int[np.ndarray, " starts"], solved: Solved
) -> tuple[Int[np.ndarray, " ends"], Int[np.ndarray, " starts"]]:
    """Starts that ended apart, one of each lane and end, and the place among them of every one."""
    own = np.where(solved.status == FitStatus.CONVERGED, 0, 1 + np.arange(len(rows)))
    cells = np.column_stack([rows, own, np.round(solved.theta / SAME)])
    _, first, of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return first, of.reshape(-1)
