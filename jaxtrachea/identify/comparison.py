"""Which of several models the same curves prefer: information criteria and cross-validation."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea.identify.criteria import weights
from jaxtrachea.identify.fit import FitResult, Settings, fit
from jaxtrachea.identify.predictions import lag_correlation, predictions, rms, without
from jaxtrachea.identify.problem import Problem

#: Difference of AICc up to which models cannot be told apart, and from which on they clearly can
#: (Burnham and Anderson 2002, sec. 2.6).
ALIKE, DECISIVE = 2.0, 10.0
#: Correlation of neighbouring residuals from which a difference of AICc says too much.
CORRELATED = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """One of the models compared, fitted.

    Attributes:
        name: for tables.
        result: the fit.
        left_out: rms force residual at contact positions left out, over the largest force of the
            lane; (lanes,), NaN where a lane has one position; None: not asked for.
    """

    name: str
    result: FitResult
    left_out: Float[np.ndarray, " lanes"] | None


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
        AICc: -
        BIC: -
        delta: AICc less the smallest of the models.
        weight: Akaike weight.
        left_out: as `Model.left_out`; of all lanes the root mean square.
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


def same_data(problems: Sequence[Problem], names: Sequence[str]) -> None:
    """Refuse models that were not fitted to the same samples in the same way.

    Raises:
        ValueError: which two differ, in what, and the cure.
    """
    first = problems[0]
    for problem, name in zip(problems[1:], names[1:], strict=True):
        pair = f"{names[0]} and {name}"
        if problem.loss != "linear" or first.loss != "linear":
            raise ValueError(f"fit.loss of {pair}: criteria need a likelihood; use 'linear'")
        if _curves(problem) != _curves(first):
            raise ValueError(f"{pair} use different samples; give both the same [data] section")
        if problem.noise_given != first.noise_given or not _same_noise(problem, first):
            raise ValueError(
                f"{pair} count noise or curves differently; give both the same [noise], "
                "fit.balance and data.tool_radius"
            )


def _curves(problem: Problem) -> set[tuple]:
    """Every curve as something that can be compared."""
    said = lambda v: None if v is None else v.tobytes()  # noqa: E731
    return {
        (c.specimen, c.trial, c.s_c, *map(said, (c.displacement, c.force, c.joint_displacement)))
        for lane in problem.curves
        for c in lane
    }


def _same_noise(a: Problem, b: Problem) -> bool:
    """Whether weights of samples agree, in whatever lanes they are."""

    def known(problem):
        lanes = problem.lanes
        seen = [lanes.precision, lanes.joint_precision]
        weighted = (np.ravel(v) for v in seen if v is not None)
        curves = sum(map(len, problem.curves))
        balance = np.ravel(lanes.balance * np.any(lanes.precision > 0, axis=2))
        parts = [*weighted, balance]
        return curves, [np.sort(v[v > 0]) for v in parts]

    (count, ours), (other, theirs) = known(a), known(b)
    same = (len(x) == len(y) and np.allclose(x, y) for x, y in zip(ours, theirs, strict=True))
    return count == other and len(ours) == len(theirs) and all(same)


def leave_position_out(
    problem: Problem, settings: Settings, progress: Callable[[int, int], None] | None = None
) -> Float[np.ndarray, " lanes"]:
    """Fit every lane without each of its contact positions and predict the curves there.

    Args:
        problem: the study.
        settings: as for `fit`.
        progress: as for `fit`.

    Returns:
        Root mean square force residual of the curves left out, over the lane's largest force;
        (lanes,), NaN where a lane has fewer than two positions or an unknown of a curve alone.
    """
    error = np.full(len(problem.curves), np.nan)
    if any(p.scope == "trial" and not p.fixed for p in problem.parameters):
        return error
    lanes, held = _positions(problem)
    if not len(lanes):
        return error
    chosen = problem.take(lanes)
    blind = dataclasses.replace(settings, scrutiny=False)
    result = fit(without(chosen, held), blind, progress)
    seen = predictions(chosen, result.theta).force
    solved = result.succeeded
    missed = np.where((held & solved[:, None])[:, :, None], seen, np.nan)
    for lane in np.unique(lanes):
        mine = lanes == lane
        if solved[mine].all():
            peak = np.max(np.abs(problem.lanes.force[lane]))
            error[lane] = float(rms(missed[mine].ravel())) / peak
    return error


def _positions(problem: Problem) -> tuple[np.ndarray, Bool[np.ndarray, "jobs T"]]:
    """Lane of each position that can be left out, and which trials are there."""
    lanes, held = [], []
    for lane, curves in enumerate(problem.curves):
        s = [c.s_c for c in curves]
        places = list(dict.fromkeys(s))
        for place in places if len(places) > 1 else ():
            row = np.zeros(problem.lanes.s_c.shape[1], bool)
            row[: len(s)] = [at == place for at in s]
            lanes.append(lane)
            held.append(row)
    return np.array(lanes, int), np.array(held, bool).reshape(len(held), problem.lanes.s_c.shape[1])


def compared(models: Sequence[Model]) -> tuple[list[Row], int]:
    """Rows of all lanes and of their sum, model by model, and lanes left out of the sum.

    Lanes that a model could not fit count for none. Where the models divide the study in different
    lanes (one shares a parameter, another not) only the sum is compared.
    """
    names = [[m.result.problem.lane_name(k) for k in range(m.result.lanes)] for m in models]
    if any(n != names[0] for n in names):
        usable = [m.result.succeeded for m in models]
        if not all(u.all() for u in usable):
            return [], sum(int(np.sum(~u)) for u in usable)
        return _rows("(all)", models, [np.arange(m.result.lanes) for m in models]), 0
    usable = np.all([m.result.succeeded for m in models], axis=0)
    rows = []
    for lane in np.flatnonzero(usable):
        specimen, trial = names[0][lane]
        label = specimen if trial == "(all)" else f"{specimen} {trial}"
        rows += _rows(label, models, [np.array([lane])] * len(models))
    every = np.flatnonzero(usable)
    if len(every) > 1:
        rows += _rows("(all)", models, [every] * len(models))
    return rows, int(np.sum(~usable))


def _rows(specimen: str, models: Sequence[Model], lanes: Sequence[np.ndarray]) -> list[Row]:
    """One row per model of the sum over its lanes."""
    of = [m.result.criteria for m in models]
    total = lambda v, at: float(np.sum(v[at]))  # noqa: E731
    AICc = np.array([total(c.AICc, at) for c, at in zip(of, lanes, strict=True)])
    with np.errstate(invalid="ignore"):
        delta = AICc - np.min(AICc)
    share = weights(AICc)
    return [
        Row(
            specimen, m.name, int(np.sum(c.unknowns[at])), int(np.sum(m.result.samples[at])),
            total(m.result.cost, at), total(c.deviance, at), total(c.AIC, at), float(AICc[i]),
            total(c.BIC, at), float(delta[i]), float(share[i]),
            np.nan if m.left_out is None else float(rms(m.left_out[at])),
        )
        for i, (m, c, at) in enumerate(zip(models, of, lanes, strict=True))
    ]  # fmt: skip


def sentence(rows: Sequence[Row], correlated: bool) -> str:
    """Which model a specimen (or all) prefers, and whether that is decisive.

    Args:
        rows: of one specimen, one per model.
        correlated: neighbouring residuals of the best model are correlated.
    """
    best, second = sorted(rows, key=lambda row: row.AICc)[:2]
    if not np.isfinite(best.AICc):
        return "too few samples to compare these models"
    left = [row.left_out for row in rows]
    known = np.isfinite(left).all()
    predicts = min(rows, key=lambda row: row.left_out).model if known else ""
    gap = second.AICc - best.AICc
    said = f"AICc {gap:.1f} below {second.model}"
    if gap < ALIKE:
        simple = min((best, second), key=lambda row: row.unknowns)
        return (
            f"these data cannot tell {best.model} from {second.model} (AICc differs by {gap:.1f}); "
            f"{simple.model} has no more unknowns than the other"
        )
    against = known and predicts != best.model
    if gap >= DECISIVE and not correlated and not against:
        more = ", and it predicts positions left out best" if known else ""
        return f"the data prefer {best.model} decisively ({said}{more})"
    doubts = [
        (gap < DECISIVE, f"the difference is below {DECISIVE:g}"),
        (correlated, "neighbouring residuals are correlated, so that it says too much"),
        (against, f"{predicts} predicts positions left out better"),
    ]
    why = "; ".join(text for doubt, text in doubts if doubt)
    why += "; positions left out agree with it" if known and not against else ""
    return f"the data prefer {best.model} ({said}), but not decisively: {why}"


def is_correlated(model: Model) -> Bool[np.ndarray, " lanes"]:
    """Lanes whose neighbouring force residuals are correlated."""
    r = lag_correlation(predictions(model.result.problem, model.result.theta))
    return np.nan_to_num(r) > CORRELATED
