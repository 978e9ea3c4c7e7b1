"""What is known of one unknown of one lane: its verdict and its interval, decided in one place.

Terminal, report, tables, results.h5 and the population all ask here.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea.identify.fit import FitResult
from jaxtrachea.identify.profile import Profiles
from jaxtrachea.identify.verdict import verdict
from jaxtrachea.status import ProfileEnd

#: Verdicts on estimates that enter medians and populations.
DETERMINED = ("identifiable", "weak")


class Judgement(NamedTuple):
    """What is known of one unknown of one lane.

    Attributes:
        verdict: one of `VERDICTS`; "failed" without an estimate.
        low: 95 % interval in the parameter's unit: by profile and other minima where there is such
            evidence, else local; -inf (scale `log`: 0) where open.
        high: inf where open.
        ends: `ProfileEnd` of the two; None where the interval is local.
        error: relative error that the verdict rests on: the longer side of the interval over that
            of one standard error, or the local one.
    """

    verdict: str
    low: float
    high: float
    ends: tuple[int, int] | None
    error: float


def judgement(result: FitResult, lane: int, i: int, profiles: Profiles | None = None) -> Judgement:
    """Verdict and interval of an unknown: the one place where both are decided.

    Args:
        result: the fit, with the evidence that it has gathered by itself.
        lane: of the result.
        i: unknown of the lane.
        profiles: further profiles, which come on top.
    """
    low, high = float(result.lower[lane, i]), float(result.upper[lane, i])
    if not result.succeeded[lane]:
        return Judgement("failed", low, high, None, np.nan)
    p = result.problem.unknowns[lane][i][0]
    open_low = 0.0 if p.scale == "log" else -np.inf
    found = _evidence(result, lane, i, profiles)
    structural = bool(result.undetermined[lane, i])
    if structural and not found:
        found = [(open_low, np.inf, (ProfileEnd.OPEN, ProfileEnd.OPEN))]
    held = bool(result.at_bound[lane, i])
    if not found:
        word = verdict(
            float(result.relative_se[lane, i]), structural=structural, held=held,
            unseen=bool(result.unexamined[lane, i]),
        )  # fmt: skip
        return Judgement(word, low, high, None, float(result.relative_se[lane, i]))
    lows, highs = ([(v[side], v[2][side]) for v in found] for side in (0, 1))
    (low, low_end), (high, high_end) = _farthest(lows, min), _farthest(highs, max)
    ends = low_end, high_end
    value, unit = float(result.value[lane, i]), float(result.uncertainty[lane].half_width)
    with np.errstate(divide="ignore", invalid="ignore"):
        if p.scale == "log":
            longer = max(np.log(high / value), np.log(value / low) if low > 0 else np.inf)
        else:
            longer = max(high - value, value - low) / (p.step * result.relative[lane, i])
    error = float(longer) / unit
    word = verdict(error, structural=structural, held=held, ends=ends)
    return Judgement(word, low, high, ends, error)


def _farthest(sides: list[tuple[float, int]], farther: Callable) -> tuple[float, int]:
    """The farthest end of a side, and how it ends; one that was found comes before a lost one."""
    known = [side for side in sides if side[1] != ProfileEnd.FAILED] or sides
    return farther(value for value, _ in known), max(end for _, end in known)


def _evidence(result: FitResult, lane: int, i: int, profiles: Profiles | None) -> list:
    """Intervals (low, high, ends) that rest on more than the local error."""
    found = []
    if result.evidence_end[lane, i, 0] >= 0:
        low, high = float(result.evidence_low[lane, i]), float(result.evidence_high[lane, i])
        found.append((low, high, tuple(map(int, result.evidence_end[lane, i]))))
    k = None if profiles is None else profiles.find(lane, i)
    if profiles is not None and k is not None:
        value = float(result.value[lane, i])
        low, high = (float(v) if np.isfinite(v) or np.isinf(v) else value
                     for v in (profiles.lower[k], profiles.upper[k]))  # fmt: skip
        found.append((low, high, tuple(map(int, profiles.end[k]))))
    return found


def verdict_of(result: FitResult, lane: int, i: int, profiles: Profiles | None = None) -> str:
    """The verdict of `judgement`."""
    return judgement(result, lane, i, profiles).verdict


def relative_errors(
    result: FitResult, profiles: Profiles | None = None
) -> Float[np.ndarray, "L P"]:
    """Relative error of what is determined: of identifiable and weak unknowns; NaN elsewhere."""
    out = np.full(result.theta.shape, np.nan)
    for lane, unknowns in enumerate(result.problem.unknowns):
        for i in range(len(unknowns)):
            judged = judgement(result, lane, i, profiles)
            if judged.verdict in DETERMINED:
                out[lane, i] = judged.error
    return out


def natural_sizes(result: FitResult) -> Float[np.ndarray, "L P"]:
    """Change of each scaled coordinate that matters to the curves as a change of 100 % would.

    As `FitResult.relative`, but no smaller than the press itself for what may be zero: an onset
    against the deepest displacement, an offset against the largest force, k_3 against the secant
    stiffness over the depth squared.
    """
    lanes, out = result.problem.lanes, result.relative.copy()
    seen = lanes.precision > 0
    force = np.where(seen, np.abs(lanes.force), 0).max(axis=(1, 2))
    depth = np.where(seen, np.abs(lanes.displacement), 0).max(axis=(1, 2))
    depth = np.where(depth > 0, depth, 1)
    sizes = {"onset": depth, "force_offset": force, "k_3": force / depth**3}
    sizes["k_3_ring"] = sizes["k_3"]
    for lane, unknowns in enumerate(result.problem.unknowns):
        for i, (p, _, _) in enumerate(unknowns):
            if p.scale == "linear" and p.name in sizes:
                out[lane, i] = max(out[lane, i], sizes[p.name][lane] / p.step)
    return out
