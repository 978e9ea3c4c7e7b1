"""What lanes and unknowns are called, and what is said of them in a sentence."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from jaxtrachea.fitting.assessment import DETERMINED, assess, limiting_bound, unknown_label
from jaxtrachea.fitting.branch_times import unsampled_time
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.press_scale import sizes_of_press
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.verdict import VERDICTS
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.weakest_direction import (
    Direction,
    describe_weakest,
    next_weakest,
    undetermined_ways,
)

#: What reports say in the place of estimates.
NOTHING_FITTED = "every parameter is fixed: nothing was fitted, the model was evaluated"


def lane_label(result: FitResult, lane: int) -> str:
    """Specimen of a lane, and its trial if it holds a single one."""
    specimen, trial = result.study.lane_name(lane)
    return specimen if trial == "(all)" else f"{specimen} {trial}"


def unknown_rows(
    result: FitResult,
    lanes: Sequence[int],
    cells: Callable[[int, int], Mapping[str, object]],
) -> Iterator[dict[str, object]]:
    """A row for each unknown of some lanes: whose, its estimate, and `cells` of (lane, unknown)."""
    for lane in lanes:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            yield {
                "specimen": lane_label(result, lane),
                "parameter": f"{unknown_label(result, lane, i)} [{p.unit}]",
                "value": float(result.value[lane, i]),
                **cells(lane, i),
            }


def succeeded(result: FitResult, lane: int) -> bool:
    """Whether a lane has an estimate."""
    return bool(result.succeeded[lane])


def outcome(result: FitResult, profiles: Profiles | None = None) -> str:
    """How many lanes are solved, and in how many of these every unknown is determined."""
    solved = [lane for lane in range(result.lanes) if succeeded(result, lane)]
    said = f"{len(solved)} of {result.lanes} fits solved"
    if not result.study.free:
        return said
    determined = sum(determined_unknowns(result, k, profiles) == _count(result, k) for k in solved)
    return f"{said}, {determined} with every unknown determined"


def determined_unknowns(result: FitResult, lane: int, profiles: Profiles | None = None) -> int:
    """Unknowns of a lane that are identifiable or weak."""
    words = (assess(result, lane, i, profiles).verdict for i in range(_count(result, lane)))
    return sum(word in DETERMINED for word in words)


def _count(result: FitResult, lane: int) -> int:
    return len(result.study.unknowns[lane])


def peak_force(result: FitResult, lane: int) -> float:
    """Largest measured force of a lane, N."""
    return max(float(np.max(np.abs(c.force))) for c in result.study.curves[lane])


def weakest_sentence(result: FitResult, lane: int) -> str:
    """The least determined combination of a lane in words."""
    if not succeeded(result, lane):
        return "no estimate"
    if not result.study.free:
        return NOTHING_FITTED
    names = [unknown_label(result, lane, i) for i in range(len(result.study.unknowns[lane]))]
    u, factor = result.uncertainty, float(result.effective.factor[lane])
    return describe_weakest(
        names, u.weakest_direction[lane], factor * float(u.weakest_se[lane]),
        u.structural_null_space[lane], result.undetermined[lane],
        press_sizes(result, lane), _left(result, lane),
    )  # fmt: skip


def _left(result: FitResult, lane: int) -> Direction | None:
    """Least determined direction of a lane beside those that are said to be open."""
    u, relative = result.uncertainty, result.relative[lane]
    if not np.any(u.weakest_direction[lane]):
        return None
    factor = float(result.effective.factor[lane])
    covariance = factor**2 * u.covariance[lane] / relative[:, None] / relative
    rows = u.null_space[lane] / relative
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    ways = undetermined_ways(u.weakest_direction[lane], u.structural_null_space[lane])
    return next_weakest(covariance, rows, ways)


def press_sizes(result: FitResult, lane: int) -> dict[int, tuple[float, str]]:
    """Size of the press in the unit of each onset and offset of a lane, by place of the unknown."""
    unknowns = result.study.unknowns[lane]
    places = [i for i, (p, _, _) in enumerate(unknowns) if p.name in OF_THE_PRESS]
    places = [i for i in places if unknowns[i][0].scale == "linear"]
    if not places:
        return {}
    sizes = sizes_of_press(result.study.take(np.array([lane])))[0]
    found = {i: (float(sizes[i]) * unknowns[i][0].step, unknowns[i][0].unit) for i in places}
    return {i: v for i, v in found.items() if np.isfinite(v[0])}


def _limited(result: FitResult, lane: int, profiles: Profiles | None) -> list[str]:
    """Which unknowns a bound of the user limits on one side; with all the data it would."""
    said = []
    for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
        if (found := limiting_bound(result, lane, i, profiles)) is not None:
            side, bound = found
            name = unknown_label(result, lane, i)
            said.append(
                f"{name} is limited by the {side} bound {bound:.6g} {p.unit}".rstrip()
                + ": widen it before measuring more"
            )
    return said


def _unsampled(result: FitResult, lane: int) -> list[str]:
    """Which branches of the relaxation the records do not show, each once."""
    told = (unsampled_time(result, lane, i) for i in range(_count(result, lane)))
    return list(dict.fromkeys(filter(None, told)))


def _listed(verdict: str, names: list[str]) -> str:
    """``weak: EI_L, k_M``; the reason of a verdict stands in brackets."""
    word, _, reason = verdict.partition(": ")
    return f"{word}{f' ({reason})' if reason else ''}: {', '.join(names)}"


def verdict_sentence(result: FitResult, lane: int, profiles: Profiles | None = None) -> str:
    """Which unknowns of a lane have which verdict, and what is least determined."""
    if not succeeded(result, lane):
        return "no estimate"
    if not result.study.free:
        return NOTHING_FITTED
    groups: dict[str, list[str]] = {}
    for i in range(len(result.study.unknowns[lane])):
        word = assess(result, lane, i, profiles).verdict
        groups.setdefault(word, []).append(unknown_label(result, lane, i))
    said = [_listed(word, groups[word]) for word in VERDICTS if word in groups]
    said += _limited(result, lane, profiles)
    said += _unsampled(result, lane)
    if not result.effective.misses[lane]:
        said.append(weakest_sentence(result, lane))
    if result.study.joint and result.unexamined[lane].any():
        said.append("inconclusive: only the local error was looked at; --profile looks further")
    if result.minima[lane] > 1:
        said.append("other parameter sets fit equally well")
    if not np.isnan(result.with_air[lane]).all():
        said.append(
            "curves may begin in air, which would fit better, but nothing else speaks for it: "
            "intervals hold both; onset = {} in [parameters] takes the air, "
            "onset = { fixed = 0 } excludes it"
        )
    return "; ".join(said)
