"""Which estimates give cause for doubt: what a local standard error cannot tell.

A lane gives cause where a direction is long (relative standard error above `LONG`) or the Jacobian
ill-conditioned, where an unknown is on its bound, or where another start has ended as low
elsewhere.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea.fitting.covariance import Uncertainty
from jaxtrachea.fitting.minima import Minima
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.parameters import OF_THE_PRESS, SKELETON
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.structure import positions
from jaxtrachea.fitting.study import Study
from jaxtrachea.mechanics.force_law import coefficient, power
from jaxtrachea.status import FitStatus

#: Relative standard error along a direction, and condition number, from which there is doubt about
#: the unknowns with a part in it; and from which there is about all unknowns.
LONG, ILL_CONDITIONED, VERY_LONG = 0.1, 1e4, 0.3
#: Part of an unknown's relative error by a doubtful direction, below which it is left in peace.
PART = 0.02
#: Relative distance from which two points are two.
APART = 0.05
#: Lanes that have come to lie somewhere, if only in a valley.
_SITUATED = [
    *(s for s in FitStatus if s.succeeded), FitStatus.MAX_ITERATIONS, FitStatus.STALLED,
]  # fmt: skip


def needs_review(result: FitResult, minima: Minima) -> Bool[np.ndarray, "lanes P"]:
    """Unknowns of succeeded lanes that give cause, but those that the structure leaves open."""
    alive = np.isin(result.status, _SITUATED)
    present = np.asarray(result.study.lanes.active > 0)
    present = present & ~result.undetermined & alive[:, None]
    natural = natural_sizes(result.study, result.relative, result.first_touch)
    doubt = local_doubt(result.uncertainty, natural, present, result.at_bound)
    se = result.uncertainty.se / natural
    se = np.where(present & np.isfinite(se), se, 0)
    failed = result.status > FitStatus.UNIDENTIFIABLE
    everything = failed | _elsewhere_as_low(result, minima, se, natural)
    everything |= barely_determined(result.study)
    return present & (doubt | everything[:, None])


def local_doubt(
    uncertainty: Uncertainty,
    natural: Float[np.ndarray, "lanes P"],
    present: Bool[np.ndarray, "lanes P"],
    at_bound: Bool[np.ndarray, "lanes P"],
) -> Bool[np.ndarray, "lanes P"]:
    """Unknowns that give cause by their errors at the estimate alone."""
    se = uncertainty.se / natural
    known = present & np.isfinite(se)
    se = np.where(known, se, 0)
    both = known[:, :, None] & known[:, None]
    covariance = np.where(both, uncertainty.correlation, 0) * se[:, :, None] * se[:, None]
    values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
    root = np.sqrt(np.maximum(values, 0))
    least = np.min(np.where(np.sum(vectors**2 * known[:, :, None], axis=1) > 0.5, root, np.inf), 1)
    long = (root > LONG) | (root > ILL_CONDITIONED * least[:, None])
    doubt = np.any(long[:, None] & (np.abs(vectors) * root[:, None] > PART), axis=2)
    lost = present & ~known & ~at_bound
    everything = at_bound.any(axis=1) | lost.any(axis=1) | (root.max(axis=1) > VERY_LONG)
    return present & (doubt | everything[:, None])


def still_needs_review(result: FitResult, minima: Minima) -> Bool[np.ndarray, "lanes P"]:
    """`needs_review` unknowns of a fit that nothing further will look at.

    An unknown that all lanes of a joint fit share is in doubt where half of them say so. What is
    measured against the press (onset, offset) is seen by its own curve, whatever the others do: it
    stands by its own error.
    """
    doubt = needs_review(result, minima)
    study = result.study
    shared = study.shared
    if shared.size:
        row, good = np.arange(len(doubt))[:, None], result.succeeded
        votes = doubt[row, shared][good]
        doubt[row, shared] = np.mean(votes, axis=0) >= 0.5 if len(votes) else True
    if not any(p.name in OF_THE_PRESS for p in study.free):
        return doubt
    natural = natural_sizes(result.study, result.relative, result.first_touch)
    error = result.uncertainty.se / natural
    for lane, unknowns in enumerate(study.unknowns):
        for i, (p, _, _) in enumerate(unknowns):
            if p.name in OF_THE_PRESS:
                doubt[lane, i] &= not error[lane, i] <= LONG
    return doubt


def _elsewhere_as_low(result: FitResult, minima: Minima, se, natural) -> Bool[np.ndarray, " lanes"]:
    """Lanes of which a start has ended apart from the estimate, at a cost that is no worse.

    By the covariance at the estimate: what it calls within the interval is no other minimum.
    """
    out = np.zeros(result.lanes, bool)
    lane = minima.lane
    apart = np.abs(minima.end - result.theta[lane]) / natural[lane]
    own = (result.study.lanes.active[lane] > 0) & ~result.undetermined[lane]
    rows = np.flatnonzero(np.any(own & (apart > np.maximum(APART, 2 * se[lane])), axis=1))
    if len(rows):
        low = np.full(result.lanes, np.inf)
        np.minimum.at(low, lane, np.where(np.isfinite(minima.cost), minima.cost, np.inf))
        scale = (first_sigma(result.study) / result.whitened_sigma)[lane[rows], 0] ** 2
        dispersion = np.fmin.reduce(result.uncertainty.dispersion, axis=1)[lane[rows]]
        half = result.uncertainty.half_width[lane[rows]]
        with np.errstate(invalid="ignore"):
            rise = 2 * (minima.cost[rows] - low[lane[rows]]) * scale
        out[lane[rows[rise <= 4 * dispersion * half**2]]] = True
    return out


def barely_determined(study: Study) -> Bool[np.ndarray, " lanes"]:
    """Lanes without markers with at most one position more than unknowns of the skeleton.

    With as many equations as unknowns other skeletons may have the same compliances exactly, with
    one more nearly the same, each a sharp minimum of its own.
    """
    count = np.sum(study.of_unknowns(lambda p: p.name in SKELETON, False), axis=1)
    marked = study.lanes.others.get("joints")
    none = np.zeros(len(count), bool)
    seen = none if marked is None else (marked.precision > 0).any(axis=(1, 2, 3))
    return (positions(study) <= count + 1) & (count > 1) & ~seen


def natural_sizes(
    study: Study, relative: Float[np.ndarray, "L P"], first_touch: Float[np.ndarray, "L T"]
) -> Float[np.ndarray, "L P"]:
    """Change of each scaled coordinate that matters to the curves as a change of 100 % would.

    As `FitResult.relative`, but no smaller than the press itself for what may be zero: an onset
    against the deepest displacement from first touch, an offset against the largest force, a
    coefficient k_n of the local law against that force over the depth to the power n.

    Args:
        relative: as `FitResult.relative`.
        first_touch: as `FitResult.first_touch`, mm.
    """
    lanes, out = study.lanes, relative.copy()
    seen = lanes.precision > 0
    force = np.where(seen, np.abs(lanes.force), 0).max(axis=(1, 2))
    depth = np.abs(lanes.displacement - first_touch[..., None])
    depth = np.where(seen, depth, 0).max(axis=(1, 2))
    depth = np.where(depth > 0, depth, 1)
    sizes = {"onset": depth, "force_offset": force, "force_slope": force / depth}
    law = [p.name for p in study.free if coefficient(p.name)]
    sizes |= {name: force / depth ** power(name) for name in law if power(name) > 1}
    for column, p in enumerate(study.free):
        if p.scale == "linear" and p.name in sizes:
            lane, unknown = np.nonzero(study.unknown_columns == column)
            own = sizes[p.name][lane] / p.step
            before = out[lane, unknown]
            out[lane, unknown] = np.where(own > before, own, before)  # NaN takes no place
    return out
