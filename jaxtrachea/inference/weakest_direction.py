"""Combinations of unknowns that the data leave open, in words, and what they determine instead."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from jaxtrachea.fitting.verdict import WEAK

#: Component of an undetermined direction, exponent of a combination: below, it is not named.
_PART, _EXPONENT = 0.1, 0.02


def combinations(
    names: list[str], null_space: Float[np.ndarray, "m P"]
) -> tuple[list[str], list[str]]:
    """Who is involved in undetermined directions, and the products that are determined instead.

    In relative coordinates a direction v changes ln p by v; the products of powers that it leaves
    alone have exponents orthogonal to it. They are brought to echelon form, so that each has few
    factors and the first one the exponent 1.

    Args:
        names: of the unknowns.
        null_space: undetermined directions, orthonormal.

    Returns:
        Names involved; products such as "EI_L k_M^3.02" (none if nothing is determined).
    """
    parts = np.flatnonzero(np.any(np.abs(null_space[:, : len(names)]) >= _PART, axis=0))
    known = scipy.linalg.null_space(null_space[:, parts]).T
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
) -> str:
    """What the data leave open, in words.

    Args:
        names: unknowns, in the order of `weakest`.
        weakest: `Uncertainty.weakest_direction`, in relative coordinates.
        weakest_se: relative standard error along it.
        null_space: `Uncertainty.structural_null_space`; None: `weakest` if its error is infinite.
        undetermined: unknowns that it leaves open at generic points.
        press: of unknowns that are measured against the press (by position), its size and unit.
    """
    if not np.any(weakest):
        return "no free parameter"
    if press and np.any(np.abs(weakest[list(press)]) >= _PART * np.max(np.abs(weakest))):
        return _with_units(names, weakest, weakest_se, null_space, press)
    if np.isfinite(weakest_se) and weakest_se <= WEAK:
        order = np.argsort(-np.abs(weakest))
        main = [i for i in order if abs(weakest[i]) >= 0.1 * abs(weakest[order[0]])]
        one = f"{names[main[0]]} alone" if len(main) == 1 else None
        what = one or f"{_moves(names, weakest, main)} together"
        return f"least determined: {what}, known to {_percent(weakest_se)}"
    structural = bool(np.any(null_space)) if null_space is not None else not np.isfinite(weakest_se)
    open_ways = weakest[None] if null_space is None else null_space[np.any(null_space, axis=1)]
    ways = open_ways if structural else weakest[None]
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
        return f"of {_list(involved)} little more is known than {_list(products)}"
    if not products:
        return f"{_list(involved)} change{'s' if alone else ''} no curve at all"
    return f"of {_list(involved)} only {_list(products)} is known"


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
