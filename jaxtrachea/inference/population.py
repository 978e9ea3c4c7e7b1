r"""Population of specimens: mean and spread of a parameter, and estimates that borrow from it.

Empirical Bayes on the estimates, in scaled coordinates, by `random_effects`: \theta_i ~ N(\mu,
diag(\tau^2)) between specimens, \hat\theta_i ~ N(\theta_i, C_i) with C_i the covariance of specimen
i's own estimates.

In a joint fit the errors of all specimens move together with that of the shared parameters. C_i is
then the covariance at given shared parameters, which is independent from specimen to specimen, and
tau is found at their estimates; their own error, by which the mean and all estimates move together,
is added to the standard errors of the mean and of the estimates.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.assessment import DETERMINED, Intervals, assess
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.verdict import WEAK
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.random_effects import FEWEST, Common, Effects, random_effects

#: Specimens from which a spread is estimated unasked.
ENOUGH = 5
#: Verdicts on estimates that have an error to be weighed by.
WEIGHED = (*DETERMINED, "practically non-identifiable")


@dataclasses.dataclass(frozen=True, eq=False)
class Population:
    """The specimens of a fit as a sample.

    Attributes:
        result: the fit.
        parameters: of scope `specimen`, q of them.
        known: estimates that took part: those with an error to be weighed by; (lanes, q).
        place: unknown of each lane and parameter, -1: none; (lanes, q).
        effects: in scaled coordinates.
    """

    result: FitResult
    parameters: tuple[Parameter, ...]
    known: Bool[np.ndarray, "lanes q"]
    place: np.ndarray
    effects: Effects

    @property
    def left_out(self) -> Int[np.ndarray, " q"]:
        """Specimens that have the parameter and whose estimate took no part; (q,)."""
        return np.sum((self.place >= 0) & ~self.known, axis=0)

    @property
    def at_bound(self) -> Int[np.ndarray, " q"]:
        """Of `left_out` those on a bound, without which the mean is too far from it; (q,)."""
        held = self.result.at_bound[np.arange(len(self.place))[:, None], self.place]
        return np.sum((self.place >= 0) & ~self.known & held, axis=0)

    @property
    def undetermined(self) -> Int[np.ndarray, " q"]:
        """Of those that took part, estimates with an error above half their value; (q,)."""
        error = self.result.relative_se * self.result.effective.growth[:, None]
        error = error[np.arange(len(self.place))[:, None], self.place]
        return np.sum(self.known & ~(error <= WEAK), axis=0)

    def shrunk_cells(self, lane: int, i: int) -> dict[str, object]:
        """Columns `shrunk` and `shrunk_se` of parameters.csv for an unknown; none if not of it."""
        found = np.flatnonzero(self.place[lane] == i)
        if not len(found) or not self.known[lane].any():
            return {}
        j = int(found[0])
        p = self.parameters[j]
        value = p.from_scaled(self.effects.shrunk[lane, j])
        slope = value if p.scale == "log" else p.step
        return {"shrunk": value, "shrunk_se": slope * float(self.effects.shrunk_sd[lane, j])}


def wanted(asked: bool | None, study: Study) -> bool:
    """Whether to take the specimens as a sample: as asked, else if there are enough of them."""
    own = any(p.scope == "specimen" for p in study.free)
    return asked or (asked is None and own and len(study.curves) >= ENOUGH)


def population(result: FitResult, profiles: Profiles | None = None) -> Population:
    """Mean and spread of all parameters that belong to specimens.

    All estimates take part that have an error, weighed by the larger of their local error and that
    of their interval, if it has two ends; also those whose data do not determine them: left out,
    they would bias mean and spread, as an error is relative and small values have large ones. On a
    bound, structurally non-identifiable or inconclusive an estimate has none. Parameters that fewer
    than three specimens determine (identifiable or weak) are left out.

    Raises:
        ValueError: no `FitResult` or `Profiles`, no parameter with the scope `specimen`, or none
            that three specimens determine; several specimens in a lane.
    """
    check_word("result", result, FitResult)
    check_word("profiles", profiles, Profiles | None)
    parameters = tuple(p for p in result.study.free if p.scope == "specimen")
    if not parameters:
        raise ValueError("no free parameter has the scope 'specimen'; a population needs one")
    names = [p.name for p in parameters]
    place = np.full((result.lanes, len(names)), -1)
    separate = {c.specimen for lane in result.study.curves for c in lane}
    if len(separate) != result.lanes:
        raise ValueError(
            f"{len(separate)} specimens are fitted in {result.lanes} fits; a population needs "
            "one for each (a joint fit with profiles, a bootstrap or a posterior has one for all: "
            "leave these out)"
        )
    for lane, unknowns in enumerate(result.study.unknowns):
        for i, (p, _, _) in enumerate(unknowns):
            if p.name in names:
                place[lane, names.index(p.name)] = i
    row = np.arange(result.lanes)[:, None]
    se = result.uncertainty.se[row, place]
    error, determined = weighing_errors(result, profiles)
    error = (error * result.relative)[row, place]
    known = (place >= 0) & np.isfinite(se) & np.isfinite(error)
    se = np.where(known, np.maximum(se, error), se)
    enough = (known & determined[row, place]).sum(axis=0) >= FEWEST
    if not enough.any():
        raise ValueError(f"no parameter is determined in {FEWEST} specimens of their own")
    place, known, se = place[:, enough], known[:, enough], se[:, enough]
    correlation = result.uncertainty.correlation
    correlation = correlation[row[:, :, None], place[:, :, None], place[:, None]]
    se = np.where(known, se, 0)
    covariance = np.nan_to_num(correlation) * se[:, :, None] * se[:, None]
    theta = np.where(known, result.theta[row, place], 0)
    common = _common(result, place, se) if result.study.joint else None
    if common is not None:
        together = common.follow @ common.covariance @ np.swapaxes(common.follow, 1, 2)
        covariance = _not_negative(covariance - together, covariance)
    effects = random_effects(theta, covariance, known, common)
    chosen = tuple(p for p, e in zip(parameters, enough, strict=True) if e)
    return Population(result, chosen, known, place, effects)


def _common(result: FitResult, place, se: Float[np.ndarray, "lanes q"]) -> Common:
    """How the estimates of a joint fit follow what is shared; `place`: see `Population`."""
    row, shared = np.arange(result.lanes)[:, None], result.study.shared
    own = result.uncertainty.se[row, shared]
    own = np.where(np.isfinite(own), own, 0)
    full = np.nan_to_num(result.uncertainty.correlation)
    between = full[row[:, :, None], shared[:, :, None], shared[:, None]]
    across = full[row[:, :, None], place[:, :, None], shared[:, None]]
    first = int(np.argmax(result.succeeded))
    known = (own[first] > 0)[:, None] & (own[first] > 0)
    inverse = np.linalg.pinv(np.where(known, between[first], 0), rcond=1e-12, hermitian=True)
    scale = np.where(own[first] > 0, 1 / np.where(own[first] > 0, own[first], 1), 0)
    follow = se[:, :, None] * (across @ inverse) * scale
    return Common(follow, between[first] * own[first][:, None] * own[first])


def _not_negative(rest: Float[np.ndarray, "m q q"], of: Float[np.ndarray, "m q q"]):
    """A difference of covariances without what rounding has made negative."""
    scale = np.sqrt(np.diagonal(of, axis1=1, axis2=2))
    unit = np.where(scale > 0, scale, 1)
    both = unit[:, :, None] * unit[:, None]
    values, vectors = np.linalg.eigh(rest / both)
    vectors = vectors * np.sqrt(np.maximum(values, 0))[:, None]
    return both * (vectors @ np.swapaxes(vectors, 1, 2))


def weighing_errors(
    result: FitResult, profiles: Intervals | None = None
) -> tuple[Float[np.ndarray, "L P"], Bool[np.ndarray, "L P"]]:
    """Relative error of each unknown, NaN where it has none, and whether it is determined."""
    out = np.full(result.theta.shape, np.nan)
    determined = np.zeros(result.theta.shape, bool)
    for lane, unknowns in enumerate(result.study.unknowns):
        for i in range(len(unknowns)):
            assessed = assess(result, lane, i, profiles)
            determined[lane, i] = assessed.verdict in DETERMINED
            if assessed.verdict in WEIGHED:
                local = float(result.relative_se[lane, i])
                out[lane, i] = assessed.error if np.isfinite(assessed.error) else local
    return out, determined
