"""Standard deviations of force and markers: given, guessed first, estimated from residuals."""

import jax.numpy as jnp
import numpy as np

from jaxtrachea.fitting.cost import robust
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.lane import forces, markers, peaks
from jaxtrachea.fitting.model import Loss
from jaxtrachea.fitting.study import Study


def noise_rounds(study: Study) -> int:
    """Re-weightings: needed where an estimated sigma changes the estimate, not only its error."""
    both = bool(markers(study.lanes))
    return 4 if not study.noise_known.all() and (both or study.model.loss != "linear") else 0


def first_sigma(study: Study) -> np.ndarray:
    """Standard deviations to begin with: 1 where given, else 2 % of the peak; (lanes, 2).

    Of the lane's peak, or that of the study if it is fitted jointly; that of `Study.shares` where
    forces have a share.
    """
    lanes = study.lanes

    def peak(kinds):
        of_lane = np.maximum(peaks(kinds), 1e-300)
        if not study.joint:
            return of_lane
        return np.full(len(of_lane), np.max(np.nan_to_num(of_lane, nan=1e-300)))

    if study.noise_given[0]:
        force = np.ones(len(lanes.s_c))
    elif study.shares is not None and study.shares.sigma is not None:
        force = study.shares.sigma
    else:
        force = 0.02 * peak(forces(lanes))
    joints = np.ones(len(lanes.s_c))
    if markers(lanes) and not study.noise_given[1]:
        joints = 0.02 * peak(markers(lanes))
    return np.stack([force, joints], axis=1)


def next_sigma(
    study: Study, info: Information, sigma: np.ndarray, unknowns: int | None = None
) -> np.ndarray:
    """Standard deviations from the residuals, where they are not given.

    Mean square, less the share of the unknowns (`unknowns`, or those of each lane); with a robust
    loss 1.4826 times the median.
    """
    total = info.counts.sum(axis=1, keepdims=True)
    own = study.lanes.active.sum(axis=1)[:, None] if unknowns is None else unknowns
    share = np.maximum(1 - own / np.maximum(total, 1), 0.05)
    with np.errstate(invalid="ignore", divide="ignore"):
        estimate = np.sqrt(info.squares / (info.counts * share))
        if study.model.loss != "linear":
            estimate = 1.4826 * info.spread
    keep = np.array(study.noise_given)[None] | ~np.isfinite(estimate) | (info.counts == 0)
    floor = 1e-9 * first_sigma(study)
    return np.where(keep, sigma, np.maximum(estimate, floor))


def normal_psi2(loss: Loss, scale: float) -> float | None:
    """Mean of psi(z)^2 of standard normal z, by Simpson's rule; None: the loss is linear."""
    if loss == "linear":
        return None
    z = np.linspace(-8, 8, 1601)
    psi = z * np.asarray(robust(loss, jnp.asarray(z * z), scale)[1])
    weight = np.where(np.arange(z.size) % 2, 4, 2) / 3 * (z[1] - z[0])
    weight[[0, -1]] /= 2
    return float(weight @ (psi**2 * np.exp(-(z**2) / 2)) / np.sqrt(2 * np.pi))


def precision_unit(study: Study) -> np.ndarray:
    """Given sigma that one unit of whitened residual stands for (median); (lanes, 2)."""

    def typical(kinds, given):
        if not kinds or not given:
            return np.ones(len(study.lanes.s_c))
        flat = np.concatenate([v.precision.reshape(len(v.data), -1) for v in kinds], axis=1)
        return np.array([1 / np.median(row[row > 0]) if np.any(row > 0) else 1.0 for row in flat])

    pressed, (force, joints) = forces(study.lanes), study.noise_given
    if study.shares is not None:
        pressed = [pressed[0]._replace(precision=study.shares.plain)]
    return np.stack([typical(pressed, force), typical(markers(study.lanes), joints)], 1)
