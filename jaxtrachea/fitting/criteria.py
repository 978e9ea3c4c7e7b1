"""Information criteria of a fit: what a model's fit is worth after its unknowns are paid for.

Akaike (1974, doi:10.1109/TAC.1974.1100705), corrected for few samples by Hurvich and Tsai (1989,
doi:10.1093/biomet/76.2.297); Schwarz (1978, doi:10.1214/aos/1176344136).
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.information import Information, unknown_count
from jaxtrachea.fitting.lane import forces, markers, peaks
from jaxtrachea.fitting.study import Study

#: Share of the largest datum that its own rounding may be: no residual counts for less.
ROUNDING = 1e-15


class Criteria(NamedTuple):
    """Of every lane; smaller is better, and differences between models of the same data count.

    Attributes:
        unknowns: k: fitted parameters, those on a bound or undetermined included, and every
            standard deviation that is estimated; (lanes,).
        deviance: -2 ln L at the estimate, normal residuals; NaN with a robust loss; (lanes,).
        AIC: deviance + 2 k.
        AICc: AIC + 2 k (k + 1) / (n - k - 1); inf where n <= k + 1.
        BIC: deviance + k ln n.
    """

    unknowns: Int[np.ndarray, " lanes"]
    deviance: Float[np.ndarray, " lanes"]
    AIC: Float[np.ndarray, " lanes"]
    AICc: Float[np.ndarray, " lanes"]
    BIC: Float[np.ndarray, " lanes"]


def criteria(study: Study, info: Information, alive: Bool[np.ndarray, " lanes"]) -> Criteria:
    """Criteria of all lanes; in a joint study those of the whole study, the same in every lane.

    With a given standard deviation the deviance is sum(z^2 + ln(2 pi sigma^2)), with an estimated
    one n (ln(2 pi S / n) + 1), forces and markers each with their own, where forces have a share of
    the force as sigma of each sample in units of that of none. S is the sum of squares
    without curve weights: with them it would be no likelihood. Where curves of unequal length weigh
    the same the estimate is not quite its maximum.

    Args:
        info: of all lanes at their estimates.
        alive: lanes that count in a joint study.
    """
    lanes, estimated = study.lanes, [not given for given in study.noise_given]

    def whole(v, combine=np.sum):
        return np.broadcast_to(combine(v[alive], axis=0), v.shape) if study.joint else v

    counts, squares = whole(np.asarray(info.counts, float)), whole(np.asarray(info.squares))
    deviance = np.zeros(len(counts))
    for kind, parts in enumerate((forces(lanes), markers(lanes))):
        n, S = counts[:, kind], squares[:, kind]
        if not parts:
            continue
        rows = len(counts)
        seen = np.concatenate([v.precision.reshape(rows, -1) for v in parts], axis=1)
        logs = whole(np.log(seen, where=seen > 0, out=np.zeros(seen.shape)).sum(axis=1))
        if estimated[kind]:
            peak = peaks([v._replace(data=v.data * v.precision) for v in parts])
            peak = whole(peak, functools.partial(np.max, initial=0))
            S = np.maximum(S, np.maximum(n, 1) * (ROUNDING * peak) ** 2)
            with np.errstate(divide="ignore", invalid="ignore"):
                own = n * (np.log(2 * np.pi * S / n) + 1) - 2 * logs
                deviance += np.where(n > 0, own, 0)
        else:
            deviance += S + n * np.log(2 * np.pi) - 2 * logs
    if study.model.loss != "linear":
        deviance = np.full(len(counts), np.nan)
    own = np.sum(lanes.active, axis=1)
    if study.joint:
        own = np.full(len(own), unknown_count(study, alive))
    k = own + np.sum((counts > 0) * np.array(estimated), axis=1)
    if study.shares is not None and study.force_share == "estimate":
        k = k + whole(study.shares.share > 0, np.any)
    return penalised(deviance, k.astype(int), np.sum(counts, axis=1))


def penalised(deviance: np.ndarray, k: np.ndarray, n: np.ndarray) -> Criteria:
    """Criteria from -2 ln L, unknowns and samples."""
    left = n - k - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        more = np.where(left > 0, 2 * k * (k + 1) / left, np.inf)
        return Criteria(k, deviance, deviance + 2 * k, deviance + 2 * k + more,
                        deviance + k * np.log(n))  # fmt: skip
