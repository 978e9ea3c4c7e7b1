"""Unknowns that a further press shares with the curves at hand, and those that it brings itself."""

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.study import Study


def of_a_new_press(
    study: Study, lane: Int[np.ndarray, " G"], theta: Float[np.ndarray, "G P"]
) -> tuple[Int[np.ndarray, "G Q"], Int[np.ndarray, "G R"], Float[np.ndarray, "G P"]]:
    """Unknowns that a new press shares, its own ones, and theta with typical values of these.

    Its own stand where the first trial has them.
    """
    scopes = [[p.scope for p, _, _ in u] + ["specimen"] * (study.size - len(u))
              for u in study.unknowns]  # fmt: skip
    shared = np.array(scopes)[lane] != "trial"
    if shared.all():
        return (
            np.tile(np.arange(study.size), (len(lane), 1)),
            np.zeros((len(lane), 0), int),
            theta,
        )
    theta = theta.copy()
    columns = [j for j in study.free_columns if study.parameters[j].scope == "trial"]
    own = np.asarray(study.lanes.index)[lane, 0][:, columns]
    for g, k in enumerate(lane):
        for i, j in zip(own[g], columns, strict=True):
            every = study.lanes.index[k, : len(study.curves[k]), j]
            theta[g, i] = np.median(theta[g, every])
    return np.stack([np.flatnonzero(row) for row in _as_many(shared)]), own, theta


def _as_many(shared: np.ndarray) -> np.ndarray:
    """Rows of a mask with as many entries as the first: padding beyond it does not count."""
    most = int(np.min(np.sum(shared, axis=1)))
    return shared & (np.cumsum(shared, axis=1) <= most)


def marginal(
    information: Float[np.ndarray, "G *c P P"], kept: Int[np.ndarray, "G Q"]
) -> Float[np.ndarray, "G *c Q Q"]:
    """Information (G, ..., P, P) on the unknowns `kept` (G, Q), all others eliminated."""
    size = information.shape[-1]
    if kept.shape[1] == size:
        return information
    parts = []
    for matrix, rows in zip(information, kept, strict=True):
        others = np.setdiff1d(np.arange(size), rows)
        cross = matrix[..., others[:, None], rows[None]]
        inner = np.linalg.solve(matrix[..., others[:, None], others[None]], cross)
        outer = np.swapaxes(cross, -1, -2) @ inner
        parts.append(matrix[..., rows[:, None], rows[None]] - outer)
    return np.stack(parts)
