"""Information matrices and residual statistics of lanes at their estimates (Gauss-Newton)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.cost import assemble, entry_scale, robust
from jaxtrachea.fitting.lane import Lane, force_entries, observations, precisions
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual, residual_value
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.schur import eliminate_others


class Information(NamedTuple):
    """One lane at its estimate; m entries of the residual, P unknowns.

    Attributes:
        bread: sum of b^2 J^T J (b: curve weight), whitened; (P, P).
        meat: sum of b^4 J^T J; (P, P).
        gradient: of the cost; (P,).
        squares: sum of squared residuals of force (N^2) and markers (mm^2) in units of the given
            precision; (2,).
        plain: sum of squared residuals in N^2 and mm^2, whatever their precision; (2,).
        counts: observed entries of each; (2,).
        spread: median absolute residual of each, same units, 0 with a linear loss; (2,).
        psi2: mean of psi(z)^2 over observed entries of each; (2,).
        dpsi: mean of psi'(z).
    """

    bread: Float[Array, "P P"]
    meat: Float[Array, "P P"]
    gradient: Float[Array, " P"]
    squares: Float[Array, "2"]
    plain: Float[Array, "2"]
    counts: Float[Array, "2"]
    spread: Float[Array, "2"]
    psi2: Float[Array, "2"]
    dpsi: Float[Array, ""]

    def rescaled(self, ratio: np.ndarray) -> "Information":
        """The same lanes with sigma smaller by `ratio`, (lanes,): linear loss, no markers."""
        square = ratio * ratio
        return self._replace(
            bread=self.bread * square[:, None, None],
            meat=self.meat * square[:, None, None],
            gradient=self.gradient * square[:, None],
            psi2=self.psi2 * square[:, None],
        )


@full_precision
def information(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, sigma: Float[Array, "2"]
) -> Information:
    """Information matrices and residual statistics of one lane."""
    r = residual(model, theta, lane)
    seen, forces = observations(lane)
    precision = precisions(lane)
    scale = entry_scale(lane, sigma)
    z = r.value * scale[None]
    J = r.jacobian * (scale[None] * seen)[:, None]
    b2 = (lane.balance * lane.balance)[:, None, None]
    _, slope = robust(model.loss, z * z, model.loss_scale)

    def psi(z):
        return z * robust(model.loss, z * z, model.loss_scale)[1]

    _, dpsi = jax.jvp(psi, (z,), (jnp.ones_like(z),))
    gram = jnp.einsum("tim,tjm->tij", J, J)
    gradient = jnp.einsum("tim,tm->ti", J * b2, z * slope)
    total = jnp.sum(seen)
    kinds = jnp.arange(seen.shape[1]) < forces

    def by_kind(v):
        return jnp.stack([jnp.sum(v[:, :forces]), jnp.sum(v[:, forces:])])

    def spread(force):
        # A sort, and the dearest part of all this: only where the noise is taken from it.
        if model.loss == "linear":
            return jnp.zeros((), theta.dtype)
        mine = (seen > 0) & (kinds == force)[None]
        return jnp.nanmedian(jnp.where(mine, jnp.abs(r.value), jnp.nan))

    return Information(
        bread=assemble(model, b2 * gram, lane),
        meat=assemble(model, b2 * b2 * gram, lane),
        gradient=assemble(model, gradient, lane),
        squares=by_kind(r.value**2 * seen),
        plain=by_kind((r.value / jnp.where(precision > 0, precision, 1)) ** 2 * seen),
        counts=by_kind(seen),
        spread=jnp.stack([spread(True), spread(False)]),
        psi2=by_kind(psi(z) ** 2 * seen) / jnp.maximum(by_kind(seen), 1),
        dpsi=jnp.sum(dpsi * seen) / total,
    )


def informations(
    study: Study, lanes: np.ndarray, theta: np.ndarray, sigma: np.ndarray, batch: int = 128
) -> Information:
    """`information` of many lanes, on the host; leading axis = order of `lanes`."""
    batch = study.batch_size(len(lanes), batch)
    return map_lanes(information, study, theta, sigma, rows=lanes, batch=batch)


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


def fixed_count(study: Study, held: Bool[np.ndarray, "L P"], alive) -> int:
    """Distinct unknowns of the lanes that count and are held on a bound."""
    row, shared = np.arange(len(held))[:, None], study.shared
    mine = (held & (study.lanes.active > 0))[alive]
    repeated = held[row, shared][alive]
    return int(mine.sum() - repeated.sum() + repeated.any(axis=0).sum())
