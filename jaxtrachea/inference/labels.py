"""What lanes and unknowns are called, and what is said of them in a sentence."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.fit.parameters import OF_THE_PRESS
from jaxtrachea.fit.press_scale import sizes_of_press
from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.judgement import verdict_of
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.verdict import VERDICTS, describe_flat

#: What reports say in the place of estimates.
NOTHING_FITTED = "every parameter is fixed: nothing was fitted, the model was evaluated"


def unknown_label(result: FitResult, lane: int, i: int) -> str:
    """Name of an unknown: k_M, or onset[t03], or k_M[T01] where a lane holds several of them."""
    unknowns = result.study.unknowns[lane]
    p, specimen, trial = unknowns[i]
    same = [u for u in unknowns if u[0].name == p.name]
    if len(same) == 1:
        return p.name
    several = len({u[1] for u in same}) > 1
    where = "/".join(filter(None, (specimen if several else "", trial)))
    return f"{p.name}[{where}]"


def lane_label(result: FitResult, lane: int) -> str:
    """Specimen of a lane, and its trial if it holds a single one."""
    specimen, trial = result.study.lane_name(lane)
    return specimen if trial == "(all)" else f"{specimen} {trial}"


def succeeded(result: FitResult, lane: int) -> bool:
    """Whether a lane has an estimate."""
    return bool(result.succeeded[lane])


def peak_force(result: FitResult, lane: int) -> float:
    """Largest measured force of a lane, N."""
    return max(float(np.max(np.abs(c.force))) for c in result.study.curves[lane])


def is_own(result: FitResult, lane: int, i: int) -> bool:
    """Whether an unknown belongs to its lane alone, not to all lanes of a joint fit."""
    return not (result.study.joint and result.study.unknowns[lane][i][0].scope == "shared")


def said_before(result: FitResult, lanes: Sequence[int], lane: int, i: int) -> bool:
    """Whether an unknown that all lanes share is listed with another of `lanes`, the first good."""
    first = next((k for k in lanes if succeeded(result, k)), lanes[0])
    return not is_own(result, lane, i) and lane != first


def flat_sentence(result: FitResult, lane: int) -> str:
    """The least determined combination of a lane in words."""
    if not succeeded(result, lane):
        return "no estimate"
    if not result.study.free:
        return NOTHING_FITTED
    names = [unknown_label(result, lane, i) for i in range(len(result.study.unknowns[lane]))]
    u = result.uncertainty
    return describe_flat(
        names, u.flat[lane], float(u.flat_se[lane]), u.blind[lane], result.undetermined[lane],
        press_sizes(result, lane),
    )  # fmt: skip


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


def verdict_sentence(result: FitResult, lane: int, profiles: Profiles | None = None) -> str:
    """Which unknowns of a lane have which verdict, and what is least determined."""
    if not succeeded(result, lane):
        return "no estimate"
    if not result.study.free:
        return NOTHING_FITTED
    groups: dict[str, list[str]] = {}
    for i in range(len(result.study.unknowns[lane])):
        word = verdict_of(result, lane, i, profiles)
        groups.setdefault(word, []).append(unknown_label(result, lane, i))
    said = [f"{word}: {', '.join(groups[word])}" for word in VERDICTS if word in groups]
    said.append(flat_sentence(result, lane))
    if result.study.joint and result.unexamined[lane].any():
        said.append("not shown: only the local error was looked at; --profile looks further")
    if result.minima[lane] > 1:
        said.append("fits that end elsewhere are as good within the noise")
    return "; ".join(said)
