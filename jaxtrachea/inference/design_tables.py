"""Rows of what `design` found, for files and terminal (docs/design.md)."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxtrachea.inference.design import Candidates, Choice, Criterion, Map, Situation, scores
from jaxtrachea.inference.results import unknown_label


def names(known: Situation, result) -> list[str]:
    """Unknowns of the first guess's lane that a new press shares; all lanes have the same ones."""
    lane = int(known.lane[0])
    count = len(result.study.unknowns[lane])
    return [unknown_label(result, lane, int(i)) for i in known.kept[0] if i < count]


def choice_rows(choice: Choice, at: Candidates, unknowns: list[str]) -> Iterator[dict[str, Any]]:
    """One row before any press, then one per press chosen, with the errors expected after it."""
    for step, error in enumerate(choice.error):
        k = int(choice.chosen[step - 1])
        place = {"s_mm": float(at.s[k]), "depth_mm": float(at.depth[k])} if step else {}
        before: dict[str, Any] = {"press": step, "s_mm": "", "depth_mm": ""}
        pairs = zip(unknowns, error, strict=False)
        yield before | place | {f"{name} relative se": float(e) for name, e in pairs}


def candidate_rows(known: Situation, added: np.ndarray, at: Candidates) -> Iterator[dict[str, Any]]:
    """One row per candidate: what it would gain by every criterion, as a first further press."""
    criteria: tuple[Criterion, ...] = ("D", "A", "E")
    now = {c: float(scores(known.base[:, None], c)[0]) for c in criteria}
    then = {c: scores(known.base[:, None] + added, c) for c in criteria}
    for k in range(len(at.s)):
        gain = {f"gain_{c}": float(then[c][k]) - now[c] for c in criteria}
        yield {"s_mm": float(at.s[k]), "depth_mm": float(at.depth[k])} | gain


def map_rows(found: Map, unknowns: list[str]) -> Iterator[dict[str, Any]]:
    """One row per position: condition, weakest combination, and its best partner from scratch."""
    partner = np.argmin(found.pairs, axis=1)
    for i, s in enumerate(found.s):
        parts = zip(unknowns, found.weakest[i], strict=False)
        yield {
            "s_mm": float(s),
            "condition": float(found.condition[i]),
            "partner_s_mm": float(found.s[partner[i]]),
            "pair_condition": float(found.pairs[i, partner[i]]),
        } | {f"weakest {name}": float(v) for name, v in parts}
