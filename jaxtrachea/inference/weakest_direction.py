"""Combinations of unknowns that the data leave open, in words, and what they determine instead."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea.fitting.verdict import WEAK

#: Component of an undetermined direction, exponent of a combination: below, it is not named.
_PART, _EXPONENT = 0.1, 0.02


class Direction(NamedTuple):
    """A combination of unknowns and how well it is determined.

    Attributes:
        vector: unit vector in relative coordinates; (P,).
        se: relative standard error along it.
    """

    vector: Float[np.ndarray, " P"]
    se: float


def next_weakest(
    covariance: Float[np.ndarray, "P P"],
    null_space: Float[np.ndarray, "N P"],
    ways: Float[np.ndarray, "M P"],
) -> Direction:
    """Least determined direction of what is left beside `ways`.

    Args:
        covariance: of the estimates in relative coordinates, without the null space.
        null_space: rows: every direction that changes no residual, relative coordinates; 0 or
            of unit length.
        ways: directions that are named as undetermined; relative coordinates, not all zero.

    Returns:
        The direction orthogonal to `ways` with the largest error; inf within the null space.
    """
    beside = np.eye(len(covariance)) - np.linalg.pinv(ways) @ ways
    _, sizes, rows = np.linalg.svd(null_space @ beside)
    # Rows of the null space that are among `ways` leave rounding alone.
    if sizes[0] > 1e-3:
        return Direction(rows[0], np.inf)
    if not np.isfinite(covariance).all():
        return Direction(beside[0], np.inf)
    values, vectors = np.linalg.eigh(beside @ covariance @ beside)
    return Direction(vectors[:, -1], float(np.sqrt(max(values[-1], 0.0))))


def combinations(
    names: list[str], null_space: Float[np.ndarray, "m P"]
) -> tuple[list[str], list[str]]:
    """Who is involved in undetermined directions, and what is determined instead.

    In relative coordinates a direction v changes ln p by v; the products of powers that it leaves
    alone have exponents orthogonal to it. What the curves determine is some function of those
    involved (of a single position the compliance there), of which the products are the tangent at
    this estimate: along a curved valley their exponents change. They are brought to echelon form,
    so that each has few factors and the first one the exponent 1.

    Returns:
        Names involved; products such as "EI_L k_M^3.02" (none if nothing is determined).
    """
    from scipy.linalg import null_space as complement

    parts = np.flatnonzero(np.any(np.abs(null_space[:, : len(names)]) >= _PART, axis=0))
    known = complement(null_space[:, parts]).T
    rows = _echelon(known)
    involved = [names[i] for i in parts]
    products = []
    for row in rows:
        factors = [
            name if abs(e - 1) < _EXPONENT / 2 else f"{name}^{e:.3g}"
            for name, e in zip(involved, row, strict=True)
            if abs(e) >= _EXPONENT
        ]
        products.append(" ".join(factors))
    return involved, products


def _echelon(rows: np.ndarray) -> np.ndarray:
    """Reduced row echelon form of few independent rows."""
    rows, at = rows.copy(), 0
    for column in range(rows.shape[1]):
        if at == len(rows):
            break
        best = at + int(np.argmax(np.abs(rows[at:, column])))
        if abs(rows[best, column]) < 1e-2:
            continue
        rows[[at, best]] = rows[[best, at]]
        rows[at] /= rows[at, column]
        others = np.arange(len(rows)) != at
        rows[others] -= rows[others, column, None] * rows[at]
        at += 1
    return rows


def describe_weakest(
    names: list[str],
    weakest: Float[np.ndarray, " P"],
    weakest_se: float,
    null_space: Float[np.ndarray, "P P"] | None = None,
    undetermined: Bool[np.ndarray, " P"] | None = None,
    press: Mapping[int, tuple[float, str]] = MappingProxyType({}),
    left: Direction | None = None,
) -> str:
    """What the data leave open, in words.

    Combinations are called known only where the least determined direction of what is left has a
    relative standard error up to `WEAK`.

    Args:
        names: unknowns, in the order of `weakest`.
        weakest: `Uncertainty.weakest_direction`, in relative coordinates.
        weakest_se: relative standard error along it.
        null_space: `Uncertainty.structural_null_space`; None: `weakest` if its error is infinite.
        undetermined: unknowns that it leaves open at generic points.
        press: of unknowns that are measured against the press (by position), its size and unit.
        left: from `next_weakest`, beside `undetermined_ways`; None: well determined.
    """
    if not np.any(weakest):
        return "no free parameter"
    if press and np.any(np.abs(weakest[list(press)]) >= _PART * np.max(np.abs(weakest))):
        return _with_units(names, weakest, weakest_se, null_space, press)
    if np.isfinite(weakest_se) and weakest_se <= WEAK:
        return f"least determined: {_least(names, weakest, weakest_se)}"
    structural = bool(np.any(null_space)) if null_space is not None else not np.isfinite(weakest_se)
    ways = undetermined_ways(weakest, null_space)
    involved, products = combinations(names, ways)
    alone = involved[0] if len(involved) == 1 else None
    open_ = [] if undetermined is None else np.flatnonzero(undetermined[: len(names)])
    if structural and len(open_) > len(involved):
        # At this estimate one of them has no effect left at all.
        return f"{_list([names[i] for i in open_])} only in combination"
    if not structural:
        if alone and np.isfinite(weakest_se):
            return f"{alone} alone is known to {_percent(weakest_se)} only"
        if alone or not products:
            return (
                f"{_list(involved)} change{'s' if alone else ''} the curves too little to be told"
            )
        return _in_place_of(names, involved, products, "little more than", left, press)
    if not products:
        return f"{_list(involved)} change{'s' if alone else ''} no curve at all"
    return _in_place_of(names, involved, products, "only", left, press)


def undetermined_ways(
    weakest: Float[np.ndarray, " P"], null_space: Float[np.ndarray, "P P"] | None
) -> Float[np.ndarray, "M P"]:
    """Directions that are said to be open: those of the structure, else the weakest; relative."""
    if null_space is None or not np.any(null_space):
        return weakest[None]
    return null_space[np.any(null_space, axis=1)]


def _in_place_of(names, involved, products, little, left: Direction | None, press) -> str:
    """What is determined in the place of single unknowns; known only if all that is left is."""
    count = "one combination" if len(products) == 1 else f"{len(products)} combinations"
    known = "is known" if len(products) == 1 else "are known"
    poor = left is not None and left.se > WEAK
    said = (
        f"of {_list(involved)} {little} {count} {'can be told' if poor else known}, "
        f"near this estimate {_list(products)}"
    )
    if left is None or not poor:
        return said
    if not np.isfinite(left.se):
        return f"{said}; what is left is not determined, either"
    part = np.abs(left.vector[list(press)])
    if np.any(part >= _PART * np.max(np.abs(left.vector))):
        return f"{said}; then {_with_units(names, left.vector, left.se, None, press)}"
    return f"{said}; then least determined: {_least(names, left.vector, left.se)}"


def _least(names, direction, se) -> str:
    """A direction and its relative error."""
    order = np.argsort(-np.abs(direction))
    main = [i for i in order if abs(direction[i]) >= 0.1 * abs(direction[order[0]])]
    one = f"{names[main[0]]} alone" if len(main) == 1 else None
    return f"{one or f'{_moves(names, direction, main)} together'}, known to {_percent(se)}"


def _with_units(names, weakest, weakest_se, null_space, press) -> str:
    """As `describe_weakest`, where an onset or an offset takes part: in its unit, no power."""
    if np.isinf(weakest_se):
        ways = weakest[None] if null_space is None or not np.any(null_space) else null_space
        parts = [n for i, n in enumerate(names) if np.any(np.abs(ways[:, i]) >= _PART)]
        alone = len(parts) == 1
        return f"{_list(parts)} change{'s' if alone else ' together'} without a change of any curve"
    order = np.argsort(-np.abs(weakest))
    main = [i for i in order if abs(weakest[i]) >= 0.1 * abs(weakest[order[0]])]
    if len(main) == 1:
        size, unit = press[int(main[0])]
        return f"least determined: {names[main[0]]} alone, known to {weakest_se * size:.2g} {unit}"
    step = 0.1 / np.max(np.abs(weakest))
    moves = []
    for i in main:
        size, unit = press.get(int(i), (100.0, "%"))
        moves.append(f"{names[i]} {step * weakest[i] * size:+.3g} {unit}")
    times = f"known to {weakest_se / step:.2g} times that"
    return f"least determined: {', '.join(moves)} together, {times}"


def _moves(names, weakest, main) -> str:
    """Changes that belong together; the largest is 10 %."""
    step = 0.1 / np.max(np.abs(weakest))
    return ", ".join(f"{names[i]} {100 * step * weakest[i]:+.3g} %" for i in main)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _list(words: list[str]) -> str:
    """Words with commas and one "and"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
