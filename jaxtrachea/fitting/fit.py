"""One fit from study to result: starts, noise levels, best start, what may be believed."""

import dataclasses
import logging
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxtrachea.fitting.build import with_zeros, without_markers, without_zeros
from jaxtrachea.fitting.covariance import Uncertainty, analyse
from jaxtrachea.fitting.criteria import criteria
from jaxtrachea.fitting.evaluate import evaluated
from jaxtrachea.fitting.force_share import (
    MAX_ITERATIONS,
    changed,
    next_levels,
    with_found_shares,
    with_levels,
)
from jaxtrachea.fitting.hidden_air import hidden_air, with_doubts
from jaxtrachea.fitting.information import fixed_count, marginal, summed_gradient
from jaxtrachea.fitting.lane import markers
from jaxtrachea.fitting.minima import (
    Minima,
    information_per_lane,
    lowest_minima,
    refit_with_noise,
)
from jaxtrachea.fitting.needs_review import needs_review, still_needs_review
from jaxtrachea.fitting.noise import next_sigma, normal_psi2, precision_unit
from jaxtrachea.fitting.omitted_zeros import asked_for, asking, merged, near_estimates
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings, check_precision
from jaxtrachea.fitting.starts import scales, unscaled
from jaxtrachea.fitting.structure import Structure, null_spaces, reduced, structure_of, suspicious
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.verify import no_evidence, verify_minimum
from jaxtrachea.optimisation.levenberg_marquardt import Solved
from jaxtrachea.status import FitStatus

#: Condition number of the Jacobian up to which it proves that the structure leaves nothing open.
PROVEN = 1e5
#: Times that a better minimum found by the scrutiny takes the place of the estimate.
REPLACED = 3
#: Times that a fit is made again with zeros that it asks for.
MORE_ZEROS = 3
#: Starts of lanes without zeros from which a program of their own takes less time than it saves.
MANY_WITHOUT = 2048
#: Starts of lanes without markers from which the same holds where other lanes have some.
MANY_UNMARKED = 32

_log = logging.getLogger(__name__)


def fit(
    study: Study,
    settings: Settings = Settings(),
    progress: Callable[[int, int], None] | None = None,
    starts: np.ndarray | None = None,
    beside: np.ndarray | None = None,
) -> FitResult:
    """Fit every lane from every start, keep the best, and find out what may be believed.

    Failed lanes are rows with a status. Where the structure leaves a combination of unknowns open
    (`structure`), one of them is held, so that there is no valley to follow; where an estimate
    gives cause for doubt, other minima are looked for and unknowns are profiled (`verify`). A
    lane that gives no cause costs nothing more. Where the residuals ask for an `auto` onset or
    offset that the record of a curve does not show (`omitted_zeros`, `hidden_air`), its lane is
    fitted again with it, and the study of the result has it. Where the noise of forces has a share
    of the force to be found (`Noise.force_share`), the fit is made in turns with it; the study of
    the result keeps what was found, and refits from it do, too. Each stage is logged (`logging`,
    level INFO).

    Args:
        study: from `build.build_study`.
        settings: how to solve.
        progress: called with (starts finished since the last call, starts in all).
        starts: where to start, scaled coordinates, (lanes * settings.starts, P); None: drawn.
        beside: one more start of each lane, first of those drawn; (lanes, P), NaN: the guess.

    Returns:
        The `FitResult`. It never raises for a lane's sake. Without unknowns (every parameter is
        fixed) nothing is solved: the model is evaluated.
    """
    check_precision(settings)
    lanes = len(study.curves)
    _log.info("%d fits of %d unknowns, %d starts each", lanes, study.size, settings.starts)
    if study.size == 0:
        return evaluated(study)
    result = _by_zeros(study, settings, progress, starts, beside)
    return with_omitted_zeros(study, result, settings, progress)


def with_omitted_zeros(
    study: Study,
    result: FitResult,
    settings: Settings,
    progress: Callable[[int, int], None] | None = None,
) -> FitResult:
    """The fit with the onsets and force offsets that its residuals ask for.

    Their lanes are fitted again. Of lanes that air explains as well, without anything else that
    speaks for it, intervals hold both readings (`hidden_air`). A study that was changed since it
    was built stays as it is.

    Args:
        study: as `build_study` made it.
        settings: how to solve.
        progress: as for `fit`.
    """
    alive = None if progress is None else lambda done, of: progress(0, of)
    if study.recipe is None:
        return result
    quick = dataclasses.replace(settings, verify=False, starts=1)  # and one beside it
    rows, doubts = np.arange(result.lanes), {}
    for turn in range(MORE_ZEROS):
        asked = asked_for(result, rows)
        if not turn:
            asked, doubts = hidden_air(
                study, result, asked,
                lambda part, near: _without_more_zeros(part, quick, alive, None, near),
            )  # fmt: skip
        if not asked.names:
            break
        study = with_zeros(study, asked.names)
        _log.info("%d curves ask for an onset or an offset; fitted again", len(asked.names))
        again = rows = asking(study, asked)  # who asked for nothing does not later
        part = study.take(again)
        near = near_estimates(result, part, asked, again)
        # As large as the data; who asks for them again has them computed again.
        vars(result).pop("residuals", None)
        new = _without_more_zeros(part, settings, alive, None, near)
        result = merged(study, result, again, new)
    return with_doubts(result, doubts)


def _by_zeros(study: Study, settings: Settings, progress, starts, beside) -> FitResult:
    """As `fit`, without more zeros; many lanes that take none are fitted by a model without them.

    A single record that shows one would let every lane of the study take twice as long.
    """
    takes = study.takes_zeros
    rows, others = np.flatnonzero(takes), np.flatnonzero(~takes)
    refit = starts is not None or beside is not None or study.joint
    seeks = any(p.auto and not p.fixed for p in study.parameters)
    if refit or not seeks or len(others) * settings.starts < MANY_WITHOUT:
        return _without_more_zeros(study, settings, progress, starts, beside)
    jobs = len(takes) * settings.starts
    alive = None if progress is None else lambda done, _: progress(done, jobs)
    part = without_zeros(study.take(others))
    result = _without_more_zeros(part, settings, alive, None, None)
    new = None
    if len(rows):
        new = _without_more_zeros(study.take(rows), settings, alive, None, None)
    return merged(study, result, rows, new)


def _without_more_zeros(study: Study, settings: Settings, progress, starts, beside) -> FitResult:
    """As `fit`, of the study as it is; many lanes without markers are fitted apart from the others.

    Every lane has the arrays of all: with the motions of 15 rings an iteration takes 16 times as
    long as with the forces alone.
    """
    marked = np.zeros(len(study.curves), bool)
    for kind in (kinds := markers(study.lanes)):
        marked |= (kind.precision > 0).any(axis=tuple(range(1, kind.precision.ndim)))
    rows, others = np.flatnonzero(marked), np.flatnonzero(~marked)
    in_one = study.joint or study.model.level.iterates or not kinds
    if in_one or len(others) * settings.starts < MANY_UNMARKED:
        return _in_one_program(study, settings, progress, starts, beside)
    jobs = len(marked) * settings.starts
    alive = None if progress is None else lambda done, _: progress(done, jobs)

    def fitted(part: Study, lanes: np.ndarray) -> FitResult:
        own = None
        if starts is not None:
            own = starts.reshape(len(marked), -1, study.size)[lanes].reshape(-1, study.size)
        return _in_one_program(
            part, settings, alive, own, None if beside is None else beside[lanes]
        )

    result = fitted(without_markers(study.take(others)), others)
    return merged(study, result, rows, fitted(study.take(rows), rows) if len(rows) else None)


def _in_one_program(study: Study, settings: Settings, progress, starts, beside) -> FitResult:
    """As `fit`, of lanes that all have the same arrays."""
    found = _lowest(study, settings, progress, starts, beside)
    if study.force_share is not None and study.shares is None:
        found = _with_force_share(found, settings, progress)
    result, minima, known = found
    if not settings.verify or study.joint:
        return dataclasses.replace(result, unexamined=still_needs_review(result, minima))
    return _verified(result, minima, known, settings, progress)


class _Found(NamedTuple):
    """A fit before its doubts are followed up."""

    result: FitResult
    minima: Minima
    known: Structure


def _with_force_share(found: _Found, settings: Settings, progress) -> _Found:
    """The fit in turns with sigma and share of its forces, until these stay.

    Lanes whose residuals show no share are left as they are. A lane that is not fitted again keeps
    the weights that it was fitted with.
    """
    alive = None if progress is None else lambda done, of: progress(0, of)
    result, minima, known = found
    levels, rows = None, np.arange(result.lanes)
    for _ in range(MAX_ITERATIONS):
        wanted, force = next_levels(result, rows)
        moved = changed(levels and levels.take(rows), wanted)
        if result.study.joint and len(moved):
            moved = rows
        if not len(moved):
            if levels is None:  # refits need not look again
                none = dataclasses.replace(result.study, force_share=None)
                result = dataclasses.replace(result, study=none)
            break
        _log.info("%d fits again with a share of the force in the noise", len(moved))
        new, rows = wanted.take(moved), rows[moved]
        levels = wanted if levels is None else levels.replaced(rows, new)
        part = with_levels(result.study.take(rows), new, force[moved])
        study = with_found_shares(found.result.study, result.study, rows, part)
        again = _lowest(part, settings, alive, None, result.theta[rows])
        minima = minima.without_ends(rows).replaced(rows, again.minima)
        result = _conclude(study, minima, known)
    return _Found(result, minima, known)


def _lowest(study: Study, settings: Settings, progress, starts, beside) -> _Found:
    """The lowest minimum of every lane and its errors."""
    known = structure_of(study, suspicious(study))
    minima = lowest_minima(study, settings, starts, progress, known, beside)
    result = _conclude(study, minima, known)
    late = _unproven(result, known)
    if late.any():
        more = structure_of(study, late)
        known = more if study.joint else Structure(*map(np.maximum, known, more))
        rows = np.flatnonzero(late & (known.nullity > 0))
        if len(rows) and not study.joint and starts is None:
            part = study.take(rows)
            near = None if beside is None else beside[rows]
            again = lowest_minima(part, settings, None, progress, known.take(rows), near)
            minima = minima.replaced(rows, again)
        if len(rows):
            result = _conclude(study, minima, known)
    return _Found(result, minima, known)


def _unproven(result: FitResult, known: Structure) -> np.ndarray:
    """Lanes not looked at whose Jacobian at the estimate does not prove that nothing is open."""
    condition = result.uncertainty.condition
    examined = suspicious(result.study)
    if result.study.joint and examined.any():
        examined[:] = True
    return ~examined & ~(condition < PROVEN) & (known.nullity == 0)


def _verified(result, minima: Minima, known: Structure, settings, progress) -> FitResult:
    """With the evidence of `verify`; a better minimum found takes the estimate's place.

    A lane is looked at again where its estimate has moved alone.
    """
    final, left = no_evidence(result), np.ones(result.lanes, bool)
    for turns_left in range(REPLACED, -1, -1):
        doubts = needs_review(result, minima) & left[:, None]
        if not doubts.any():
            break
        _log.info("%d fits give cause for doubt; profiles, other minima", doubts.any(1).sum())
        evidence, better = verify_minimum(
            result, minima, doubts, settings, known, progress, last=not turns_left
        )
        rows = np.flatnonzero(np.isfinite(better).all(axis=1) & bool(turns_left))
        left[:] = False
        left[rows] = True
        settled = doubts.any(axis=1) & ~left
        for all_, new in zip(final, evidence, strict=True):
            all_[settled] = new[settled]
        if not len(rows):
            break
        # As many as the fit computes together: the same program.
        batch = result.study.batch_size(result.lanes * settings.starts, settings.batch)
        full = rows[np.arange(max(len(rows), batch)) % len(rows)]
        part = reduced(result.study.take(full), known.pinned[full])
        one = dataclasses.replace(settings, starts=1)
        solved, sigma = refit_with_noise(part, one, None, minima.sigma[full], better[full])
        solved = Solved(*(v[: len(rows)] for v in solved))
        sigma = sigma[: len(rows)]
        ones, none = np.ones(len(rows), int), np.zeros(0, int)
        moved = Minima(
            solved, ones, minima.tried[rows], sigma, none, np.zeros((0, part.size)), np.zeros(0)
        )
        minima = minima.replaced(rows, moved)
        result = _conclude(result.study, minima, known)
        final.status[rows] = result.status[rows]
    return dataclasses.replace(result, **final._asdict())


def _conclude(study: Study, minima: Minima, structure: Structure) -> FitResult:
    """Standard errors, intervals and final statuses of all lanes."""
    solved, agree, tried, sigma = minima[:4]
    info, pool, unknowns = information_per_lane(study, solved, sigma)
    before, sigma = sigma, next_sigma(study, pool, sigma, unknowns)
    if study.model.loss == "linear" and "joints" not in study.lanes.others:
        ratio = before[:, 0] / sigma[:, 0]
        info, pool = info.rescaled(ratio), pool.rescaled(ratio)
    else:
        info, pool, unknowns = information_per_lane(study, solved, sigma)
    lanes, theta = study.lanes, solved.theta
    alive = solved.status <= FitStatus.STALLED
    gradient = summed_gradient(study, info, alive) if study.joint else info.gradient
    at_bound = (theta <= lanes.lower) & (gradient > 0)
    at_bound |= (theta >= lanes.upper) & (gradient < 0)
    present = lanes.active > 0
    at_bound &= present
    held = at_bound | ~present
    relative = relative_change(study, theta)
    if study.joint:
        pool = marginal(study, pool, held, alive)
        unknowns = (unknowns or 0) - fixed_count(study, held, alive)
    open_ = _open_directions(study, theta, structure)
    u = analyse(
        pool, relative, held,
        noise_given=study.noise_given, noise_known=study.noise_known,
        least=normal_psi2(study.model.loss, study.model.loss_scale), unknowns=unknowns,
        structural=open_,
    )  # fmt: skip
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        rms = np.sqrt(info.plain / info.counts)
        half = u.half_width[:, None] * u.se
        value, lower, upper = (
            np.where(present, unscaled(study, v), np.nan)
            for v in (theta, theta - half, theta + half)
        )
        log, step = scales(study)
        standard_error = u.se * np.where(log, value, step)
    unit = precision_unit(study)
    samples = np.sum(info.counts, axis=1)
    left = np.sum(pool.counts, axis=1) - (np.sum(~held, axis=1) if unknowns is None else unknowns)
    status = final_status(solved.status, u, at_bound, left)
    return FitResult(
        study=study, theta=theta, value=value, standard_error=standard_error,
        lower=lower, upper=upper, relative_se=u.se / relative,
        at_bound=at_bound, status=status, iterations=solved.iterations, cost=solved.cost,
        converged_starts=agree, tried=tried,
        start_costs=minima.start_costs(), sigma=sigma * unit, rms=rms, samples=samples,
        criteria=criteria(study, info, alive),
        uncertainty=u, undetermined=structure.undetermined,
        unexamined=np.zeros(theta.shape, bool), evidence_low=np.full(theta.shape, np.nan),
        evidence_high=np.full(theta.shape, np.nan),
        evidence_end=np.full((*theta.shape, 2), -1), with_air=np.full((*theta.shape, 2), np.nan),
        minima=np.ones(len(theta), int),
    )  # fmt: skip


def _open_directions(study: Study, theta, structure: Structure) -> np.ndarray:
    """Directions that the structure leaves open, at the estimates; rows, the others 0."""
    out = np.zeros((*theta.shape, theta.shape[1]))
    lanes = np.arange(len(theta)) if study.joint else np.flatnonzero(structure.nullity)
    if not structure.nullity.any():
        return out
    theta = np.where(np.isfinite(theta), theta, 0)[lanes]
    rows = null_spaces(study, lanes, theta, structure.nullity[lanes])
    for lane, directions in zip(lanes, rows, strict=True):
        out[lane, : len(directions)] = directions
    return out


def final_status(status, u: Uncertainty, at_bound, dof) -> np.ndarray:
    """What the solver said, and for what it solved: too few data, undetermined, on a bound."""
    solved = status <= FitStatus.UNIDENTIFIABLE
    fine = np.where(np.any(at_bound, axis=1), FitStatus.AT_BOUND, FitStatus.CONVERGED)
    fine = np.where(np.isfinite(u.condition), fine, FitStatus.UNIDENTIFIABLE)
    return np.where(solved, np.where(dof < 0, FitStatus.TOO_FEW_DATA, fine), status).astype(int)
