"""Information and residual statistics of a joint fit: what its lanes say together."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.lane import Lane, force_entries, observations
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.schur import eliminate_others


def _absolute_residual(model: FitModel, theta: Array, lane: Lane):
    """Sizes of the residuals of one lane, NaN where nothing was observed; (T, m)."""
    seen, _ = observations(lane)
    return jnp.where(seen > 0, jnp.abs(residual_value(model, theta, lane)), jnp.nan)


def pooled(
    study: Study, info: Information, theta: np.ndarray, alive: Bool[np.ndarray, " L"]
) -> Information:
    """Residual statistics of the study in place of each lane's: the noise is one and the same.

    Args:
        study: a joint one.
        info: of each lane.
        theta: where it was taken.
        alive: lanes that count.
    """
    squares, counts = info.squares[alive].sum(axis=0), info.counts[alive].sum(axis=0)

    def mean(v, weight):
        return np.sum(v[alive] * weight, axis=0) / np.maximum(np.sum(weight, axis=0), 1)

    spread = np.zeros(2)
    if study.model.loss != "linear":
        batch, forces = study.batch_size(len(theta), 128), force_entries(study.lanes)
        r = map_lanes(_absolute_residual, study, theta, batch=batch)[alive]
        kinds = (r[..., :forces], r[..., forces:])
        spread = np.array([np.nanmedian(v) if np.any(np.isfinite(v)) else 0.0 for v in kinds])

    def every(v):
        return np.tile(v, (len(alive), *[1] * np.ndim(v)))

    return info._replace(
        squares=every(squares), counts=every(counts), spread=every(spread),
        psi2=every(mean(info.psi2, info.counts[alive])),
        dpsi=every(mean(info.dpsi, info.counts[alive].sum(axis=1))),
    )  # fmt: skip


def summed_gradient(study: Study, info: Information, alive: Bool[np.ndarray, " L"]):
    """Gradient of the whole cost by every lane's unknowns; (L, P)."""
    gradient, shared = info.gradient.copy(), study.shared
    row = np.arange(len(gradient))[:, None]
    gradient[row, shared] = gradient[row, shared][alive].sum(axis=0)
    return gradient


def marginal(study: Study, info: Information, held: Bool[np.ndarray, "L P"], alive) -> Information:
    """Information on each lane's unknowns, those of all other lanes eliminated."""
    bread = np.where(alive[:, None, None], info.bread, 0)
    meat = np.where(alive[:, None, None], info.meat, 0)
    bread, meat = eliminate_others(bread, meat, study.shared, ~held)
    lost = ~alive[:, None, None]
    return info._replace(bread=np.where(lost, np.nan, bread), meat=np.where(lost, np.nan, meat))


def unknown_count(study: Study, alive: Bool[np.ndarray, " L"]) -> int:
    """Distinct unknowns of the lanes that count."""
    k = study.shared.shape[1]
    return int(study.lanes.active[alive].sum()) - k * max(int(np.sum(alive)) - 1, 0)


def held_count(study: Study, held: Bool[np.ndarray, "L P"], alive) -> int:
    """Distinct unknowns of the lanes that count and are held on a bound."""
    row, shared = np.arange(len(held))[:, None], study.shared
    mine = (held & (study.lanes.active > 0))[alive]
    repeated = held[row, shared][alive]
    return int(mine.sum() - repeated.sum() + repeated.any(axis=0).sum())
