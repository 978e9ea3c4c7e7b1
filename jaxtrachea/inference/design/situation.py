"""What a fit knows before the next press: information of the data so far and of the bounds."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.covariance import noise_factor
from jaxtrachea.fitting.information import Information, informations
from jaxtrachea.fitting.lanes import mean_lengths
from jaxtrachea.fitting.noise import normal_psi2
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.bootstrap import Bootstrap
from jaxtrachea.inference.design.candidates import check, reached
from jaxtrachea.inference.design.press import marginal, of_a_new_press

#: Estimates of a lane, out of its bootstrap replicates, that a design is averaged over.
_DRAWS = 16


@dataclasses.dataclass(frozen=True, eq=False)
class Situation:
    """What is known before the next press, for G guesses of the truth (lanes, replicates).

    Attributes:
        study: the study.
        lane: lane of each guess; (G,).
        theta: guess, scaled coordinates; (G, P).
        relative: change of each scaled coordinate that makes a relative change of 1; (G, P).
        base: bread of the data so far, with the weights of the curves, and of the bounds, on the Q
            unknowns that are not of single trials, relative coordinates; (G, Q, Q).
        meat: likewise; times the factor kappa of the covariance; (G, Q, Q).
        weight: of the squared residuals of a new curve, as the fit will have it.
        factor: what a press adds to the meat over what it adds to the bread; (G,).
        sigma: of a force sample, N; (G,); where it has a share of the force, that of the curves so
            far in the mean over the information, which grows as the square of the force.
        samples: of a curve.
        kept: these unknowns; (G, Q).
        own: unknowns of the first trial alone, which stand for those of a new press; `theta` has
            the median of all trials there; (G, R).
        prior: information of the bounds on all unknowns, relative coordinates; (G, P).
        blend: rounded corner of a new curve, mm, see `Lane`; (G,); None where no onset is fitted.
        approach: how long before first touch the record of a new press begins, mm, by lane.
        reach: least and largest depth of the curves so far, see `reached`.
    """

    study: Study
    lane: Int[np.ndarray, " G"]
    theta: Float[np.ndarray, "G P"]
    relative: Float[np.ndarray, "G P"]
    base: Float[np.ndarray, "G Q Q"]
    meat: Float[np.ndarray, "G Q Q"]
    weight: Float[np.ndarray, " G"]
    factor: Float[np.ndarray, " G"]
    sigma: Float[np.ndarray, " G"]
    samples: int
    kept: Int[np.ndarray, "G Q"]
    own: Int[np.ndarray, "G R"]
    prior: Float[np.ndarray, "G P"]
    blend: Float[np.ndarray, " G"] | None
    approach: Float[np.ndarray, " lanes"]
    reach: tuple[float, float]

    def with_press(self, added: Float[np.ndarray, "G Q Q"]) -> "Situation":
        """The situation after a press that adds so much to the bread."""
        meat = self.meat + self.factor[:, None, None] * added
        return dataclasses.replace(self, base=self.base + added, meat=meat)


def situation(
    result: FitResult,
    resampled: Bootstrap | None = None,
    *,
    samples: int | None = None,
    with_data: bool = True,
) -> Situation:
    """What a fit knows, with the weights that it gives to curves and samples.

    Args:
        result: the fit; the guesses are the succeeded lanes whose curves the model follows.
        resampled: if given, up to 16 replicates of each lane are the guesses.
        samples: of the next curve; None: as the longest measured.
        with_data: False: as before any measurement, with the bounds alone.

    Raises:
        ValueError: no lane succeeded, the model misses the curves of all, or as `check`.
    """
    study = result.study
    check(study)
    lanes = np.flatnonzero(result.succeeded)
    if len(lanes) == 0:
        raise ValueError("no lane has an estimate; nothing to design from")
    lanes = lanes[~result.effective.misses[lanes]]
    if len(lanes) == 0:
        raise ValueError(
            "the model misses the curves, so that its estimates tell nothing of the next press; "
            "mend the fit first (docs/read_a_fit.md)"
        )
    lane, theta = lanes, result.theta[lanes]
    if resampled is not None:
        found = [resampled.theta[k][resampled.usable[k]][:_DRAWS] for k in lanes]
        lane = np.repeat(lanes, [len(rows) for rows in found])
        theta = np.concatenate(found)
    sigma = result.whitened_sigma
    info = informations(study, lane, theta, sigma[lane])
    at_estimate = info
    if resampled is not None:
        at_estimate = informations(study, lanes, result.theta[lanes], sigma[lanes])
    kappa = _kappa(result, lanes, at_estimate)[np.searchsorted(lanes, lane)]
    relative, prior = _prior(study, lane, theta)
    base = np.eye(study.size) * prior[:, :, None]
    meat = base
    if with_data:
        unit = relative[:, :, None] * relative[:, None]
        meat = base + kappa[:, None, None] * info.meat * unit
        base = base + info.bread * unit
    kept, own, theta = of_a_new_press(study, lane, theta)
    base, meat = marginal(base, meat, kept)
    relative, prior = _prior(study, lane, theta)
    n = study.lanes.force.shape[-1] if samples is None else samples
    weight = np.ones(len(lane))
    if study.balance == "curve":
        weight = mean_lengths(study.curves, joint=False)[lane] / n
    blends, counts = study.lanes.blend, [len(c) for c in study.curves]
    blend = None
    if blends is not None:
        blend = np.array([np.median(blends[k, : counts[k]]) for k in lane])
    return Situation(
        study=study, lane=lane, theta=theta, relative=relative,
        base=base, meat=meat, weight=weight, factor=kappa * weight,
        sigma=_sample_sigma(result)[lane], samples=n, kept=kept, own=own, prior=prior, blend=blend,
        approach=_approaches(result), reach=reached(study, result.first_touch),
    )  # fmt: skip


def _approaches(result: FitResult) -> Float[np.ndarray, " lanes"]:
    """How long before first touch the records of each lane begin, median of its curves, mm."""
    rows = zip(result.first_touch, result.study.curves, strict=True)
    before = (
        [
            max(at - c.rising.displacement.min(), 0.0)
            for at, c in zip(row.tolist(), curves, strict=False)
        ]
        for row, curves in rows
    )
    return np.array([np.median(lane) for lane in before])


def _sample_sigma(result: FitResult) -> Float[np.ndarray, " lanes"]:
    """See `Situation.sigma`."""
    lanes = result.study.lanes
    force2 = np.asarray(lanes.force) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        known = np.sum(force2 * (lanes.precision > 0), axis=(1, 2))
        weighted = np.sum(force2 * np.asarray(lanes.precision) ** 2, axis=(1, 2))
        mean = result.whitened_sigma[:, 0] * np.sqrt(known / weighted)
    return np.where(result.force_share > 0, mean, result.sigma[:, 0])


def _kappa(result: FitResult, lanes: Int[np.ndarray, " L"], info: Information) -> np.ndarray:
    """Factor of the covariance of these lanes at their estimates, of correlated samples; (L,)."""
    study = result.study
    held = result.at_bound | (study.lanes.active == 0)
    dof = np.sum(info.counts, axis=1) - np.sum(~held[lanes], axis=1)
    least = normal_psi2(study.model.loss, study.model.loss_scale)
    kappa = noise_factor(info, dof, noise_given=study.noise_given, least=least)
    return kappa * result.effective.factor[lanes] ** 2


def _prior(study: Study, lane: Int[np.ndarray, " G"], theta: Float[np.ndarray, "G P"]):
    """Change that makes a relative change of 1, and information of the bounds, of guesses."""
    absent = study.lanes.active[lane] == 0
    relative = np.where(absent, 1.0, relative_change(study.take(lane), theta))
    return relative, of_bounds(study, lane, relative)


def of_bounds(
    study: Study, lane: Int[np.ndarray, " G"], relative: Float[np.ndarray, "G P"]
) -> Float[np.ndarray, "G P"]:
    """Information of the bounds: that of the variance of a uniform distribution between them."""
    width = (study.lanes.upper - study.lanes.lower)[lane] / relative
    return 12 / np.where(width > 0, width, 1) ** 2
