"""Which of several models the same curves prefer: information criteria and cross-validation."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.criteria import Criteria
from jaxtrachea.fitting.effective import CORRELATED, MIN_FREEDOM, effective_samples
from jaxtrachea.fitting.lane import forces, markers
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.repeats import Missed, Worst
from jaxtrachea.inference.residuals import rms
from jaxtrachea.measurements.observed import FURTHER_FIELDS

#: Difference of AICc up to which models cannot be told apart, and from which on they clearly can
#: (Burnham and Anderson 2002, sec. 2.6).
INDISTINGUISHABLE, DECISIVE = 2.0, 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """One of the models compared, fitted.

    Attributes:
        name: for tables.
        result: the fit.
        left_out: errors of what was left out, see `leave_repeats_out`; None: not asked for.
    """

    name: str
    result: FitResult
    left_out: Missed | None


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """One model on one specimen, or on all.

    Attributes:
        specimen: the lane's, or "(all)".
        model: its name.
        unknowns: k, summed.
        samples: n, summed.
        cost: of the fits, summed; with estimated noise each model has its own unit of it.
        deviance: -2 ln L, summed.
        AIC: summed over lanes, as are AICc and BIC.
        delta: AICc less the smallest of the models.
        weight: Akaike weight.
        left_out: rms force residual of what was left out, over the largest force of the lane; of
            all lanes the root mean square; NaN where nothing was, or where a refit of one of them
            predicts nothing.
        worst: largest of the errors of the single parts that were left out (positions, mostly),
            likewise.
        worst_place: which part that is, in words; of several lanes with its specimen.
        deflated: AICc with the deviance of as many samples as are independent, less the smallest of
            the models; see `deflated`.
        effective_samples: that many.
    """

    specimen: str
    model: str
    unknowns: int
    samples: int
    cost: float
    deviance: float
    AIC: float
    AICc: float
    BIC: float
    delta: float
    weight: float
    left_out: float
    worst: float
    worst_place: str
    deflated: float
    effective_samples: float


def same_data(studies: Sequence[Study], names: Sequence[str]) -> None:
    """Refuse models that were not fitted to the same samples in the same way.

    Raises:
        ValueError: which two differ, in what, and the cure.
    """
    first = studies[0]
    for study, name in zip(studies[1:], names[1:], strict=True):
        pair = f"{names[0]} and {name}"
        if study.model.loss != "linear" or first.model.loss != "linear":
            raise ValueError(f"fit.loss of {pair}: criteria need a likelihood; use 'linear'")
        if _curves(study) != _curves(first):
            if len({s.model.level.observes for s in (study, first)}) > 1:
                more = max(study, first, key=lambda s: len(s.model.level.observes)).model.level.name
                raise ValueError(
                    f"{pair} use different samples: skeleton {more!r} reads side forces, "
                    "sideward markers, ring ends and presses off the midline, which the other does "
                    "not; compare them on presses along the normal, from a file without those"
                )
            raise ValueError(f"{pair} use different samples; give both the same [data] section")
        if sorted(map(sorted, study.holdout_groups)) != sorted(map(sorted, first.holdout_groups)):
            raise ValueError(
                f"{pair} leave out different trials together; give both the same data.together"
            )
        if study.noise_given != first.noise_given or not _same_noise(study, first):
            raise ValueError(
                f"{pair} count noise or curves differently; give both the same [noise], "
                "fit.balance, data.tool_radius and data.pressed_ends"
            )


def _curves(study: Study) -> set[tuple]:
    """Every curve as something that can be compared."""

    def said(v):
        return None if v is None else v.tobytes()

    return {
        (
            c.specimen,
            c.trial,
            c.s_c,
            c.phi_c,
            tuple(c.direction),
            *(said(getattr(c, name)) for name in ("displacement", "force", *FURTHER_FIELDS)),
        )
        for lane in study.curves
        for c in lane
    }


def _same_noise(a: Study, b: Study) -> bool:
    """Whether weights of samples agree, in whatever lanes they are."""

    def known(study):
        lanes = study.lanes
        weighted = (np.ravel(kind.precision) for kind in forces(lanes) + markers(lanes))
        curves = sum(map(len, study.curves))
        return (curves, study.balance), [np.sort(v[v > 0]) for v in weighted]

    (count, ours), (other, theirs) = known(a), known(b)
    same = (len(x) == len(y) and np.allclose(x, y) for x, y in zip(ours, theirs, strict=True))
    return count == other and len(ours) == len(theirs) and all(same)


def compared(models: Sequence[Model]) -> tuple[list[Row], int]:
    """Rows of all lanes and of their sum, model by model, and lanes left out of the sum.

    Lanes that a model could not fit count for none. Where the models divide the study in different
    lanes (one shares a parameter, another not) only the sum is compared.
    """
    names = [[m.result.study.lane_name(k) for k in range(m.result.lanes)] for m in models]
    worth = [_worth(m) for m in models]
    if any(n != names[0] for n in names):
        usable = [m.result.succeeded for m in models]
        if not all(u.all() for u in usable):
            return [], sum(int(np.sum(~u)) for u in usable)
        return _rows("(all)", models, [np.arange(m.result.lanes) for m in models], worth), 0
    usable = np.all([m.result.succeeded for m in models], axis=0)
    rows = []
    for lane in np.flatnonzero(usable):
        specimen, trial = names[0][lane]
        label = specimen if trial == "(all)" else f"{specimen} {trial}"
        rows += _rows(label, models, [np.array([lane])] * len(models), worth)
    every = np.flatnonzero(usable)
    if len(every) > 1:
        rows += _rows("(all)", models, [every] * len(models), worth)
    return rows, int(np.sum(~usable))


def _worth(model: Model) -> Float[np.ndarray, " lanes"]:
    """Independent samples that those of each lane are worth by the residuals of a model."""
    result = model.result
    worth = effective_samples(result.residuals)
    return np.where(np.isnan(worth), np.asarray(result.samples, float), worth)


def deflated(criteria: Criteria, share: Float[np.ndarray, " lanes"], at: np.ndarray) -> float:
    """AICc of lanes, their deviances counted for independent samples only, unknowns in full.

    Args:
        criteria: of a model.
        share: of the samples of each lane that is independent.
        at: which lanes are summed.
    """
    penalty = criteria.AICc - criteria.deviance
    return float(np.sum((criteria.deviance * share + penalty)[at]))


def _rows(
    specimen: str, models: Sequence[Model], lanes: Sequence[np.ndarray], worth: Sequence[np.ndarray]
) -> list[Row]:
    """One row per model of the sum over its lanes; samples are worth what the best model says."""
    of = [m.result.criteria for m in models]

    def total(v, at):
        return float(np.sum(v[at]))

    AICc = np.array([total(c.AICc, at) for c, at in zip(of, lanes, strict=True)])
    with np.errstate(invalid="ignore"):
        delta = AICc - np.min(AICc)
    best = int(np.argmin(AICc))
    counts = [np.asarray(m.result.samples, float) for m in models]
    share = [w / np.maximum(n, 1) for w, n in zip(worth, counts, strict=True)]
    if all(len(s) == len(share[best]) for s in share):
        share = [share[best]] * len(models)
    else:  # other lanes: the sum's own share for all
        mean = total(worth[best], lanes[best]) / max(total(counts[best], lanes[best]), 1)
        share = [np.full(len(n), mean) for n in counts]
    fair = np.array([deflated(c, s, at) for c, s, at in zip(of, share, lanes, strict=True)])
    with np.errstate(invalid="ignore"):
        fair = fair - fair[best]
    weight = weights(AICc)
    independent = total(worth[best], lanes[best])
    found = [_worst(m, at) for m, at in zip(models, lanes, strict=True)]
    return [
        Row(
            specimen=specimen,
            model=m.name,
            unknowns=int(np.sum(c.unknowns[at])),
            samples=int(np.sum(m.result.samples[at])),
            cost=total(m.result.cost, at),
            deviance=total(c.deviance, at),
            AIC=total(c.AIC, at),
            AICc=float(AICc[i]),
            BIC=total(c.BIC, at),
            delta=float(delta[i]),
            weight=float(weight[i]),
            left_out=_left_out(m, at),
            worst=worst.error,
            worst_place=worst.place,
            deflated=float(fair[i]),
            effective_samples=independent,
        )
        for i, (m, c, at, worst) in enumerate(zip(models, of, lanes, found, strict=True))
    ]


def _left_out(model: Model, at: np.ndarray) -> float:
    """Error of what was left out of some lanes; NaN where one of them lost what it should have.

    To take the others would spare this model the lanes that it does worst on.
    """
    if model.left_out is None or model.left_out.lost[at].any():
        return np.nan
    return float(rms(model.left_out.error[at]))


def _worst(model: Model, at: np.ndarray) -> Worst:
    """The part of some lanes that a model predicts worst without it; NaN as `_left_out`."""
    missed = model.left_out
    if missed is None or not missed.worst or missed.lost[at].any():
        return Worst(np.nan, "")
    known = [(w, k) for k in at if (w := missed.worst[k]) is not None]
    if not known:
        return Worst(np.nan, "")
    worst, lane = max(known)
    name = "" if len(at) == 1 else f"{model.result.study.lane_name(int(lane))[0]}, "
    return worst._replace(place=name + worst.place)


def sentence(rows: Sequence[Row], left: str = "positions") -> str:
    """Which model a specimen (or all) prefers, and whether that is decisive.

    Decisive is a difference of AICc of `DECISIVE` or more that remains so for as many samples as
    are independent, that no prediction of what was left out contradicts, and where the best model
    follows the curves.
    """
    best, second = sorted(rows, key=lambda row: row.AICc)[:2]
    if not np.isfinite(best.AICc):
        return "too few samples to compare these models"
    known = np.isfinite([row.left_out for row in rows]).all()
    predicts = min(rows, key=lambda row: row.left_out).model if known else ""
    gap = second.AICc - best.AICc
    said = f"AICc {gap:.1f} below {second.model}"
    if gap < INDISTINGUISHABLE:
        simple = min((best, second), key=lambda row: row.unknowns)
        return (
            f"these data cannot tell {best.model} from {second.model} (AICc differs by {gap:.1f}); "
            f"{simple.model} has no more unknowns than the other"
        )
    rival = min((row for row in rows if row is not best), key=lambda row: row.deflated)
    correlated = best.effective_samples < (1 - CORRELATED) / (1 + CORRELATED) * best.samples
    fair = (
        f"{best.samples} correlated samples count as {best.effective_samples:.3g} independent ones"
        f", which leave {max(rival.deflated, 0):.3g} to {rival.model}"
    )
    weak = correlated and not rival.deflated >= DECISIVE
    against = known and predicts != best.model
    misses = best.effective_samples < best.unknowns + MIN_FREEDOM
    if gap >= DECISIVE and not (weak or against or misses):
        more = f"; {fair}" if correlated else ""
        more += f"; and it predicts {left} left out best" if known else ""
        return f"the data prefer {best.model} decisively ({said}{more})"
    doubts = [
        (gap < DECISIVE, f"the difference is below {DECISIVE:g}"),
        (weak, fair),
        (misses, "even this model misses the curves"),
        (against, f"{predicts} predicts {left} left out better"),
    ]
    why = "; ".join(text for doubt, text in doubts if doubt)
    why += f"; {left} left out agree with it" if known and not against else ""
    return f"the data prefer {best.model} ({said}), but not decisively: {why}"


def weights(values: Float[np.ndarray, " models"]) -> Float[np.ndarray, " models"]:
    """Akaike weights exp(-difference / 2) over their sum (Burnham and Anderson 2002, sec. 2.9)."""
    values = np.where(np.isnan(values), np.inf, values)
    if not np.isfinite(values).any():
        return np.full(len(values), np.nan)
    w = np.exp(-0.5 * (values - np.min(values)))
    return w / np.sum(w)
