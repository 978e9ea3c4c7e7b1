"""Combinations of unknowns that the data leave open, in words, and what they determine instead."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from jaxtrachea.fitting.verdict import WEAK

#: Component of an undetermined direction, exponent of a combination: below, it is not named.
_PART, _EXPONENT = 0.1, 0.02


def combinations(names: list[str], blind: Float[np.ndarray, "m P"]) -> tuple[list[str], list[str]]:
    """Who is involved in undetermined directions, and the products that are determined instead.

    In relative coordinates a direction v changes ln p by v; the products of powers that it leaves
    alone have exponents orthogonal to it. They are brought to echelon form, so that each has few
    factors and the first one the exponent 1.

    Args:
        names: of the unknowns.
        blind: undetermined directions, orthonormal.

    Returns:
        Names involved; products such as "EI_L k_M^3.02" (none if nothing is determined).
    """
    parts = np.flatnonzero(np.any(np.abs(blind[:, : len(names)]) >= _PART, axis=0))
    known = scipy.linalg.null_space(blind[:, parts]).T
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


def describe_flat(
    names: list[str],
    flat: Float[np.ndarray, " P"],
    flat_se: float,
    blind: Float[np.ndarray, "P P"] | None = None,
    undetermined: Bool[np.ndarray, " P"] | None = None,
    press: Mapping[int, tuple[float, str]] = MappingProxyType({}),
) -> str:
    """What the data leave open, in words.

    Args:
        names: unknowns, in the order of `flat`.
        flat: least determined direction in relative coordinates, see `Uncertainty.flat`.
        flat_se: relative standard error along it.
        blind: directions that the structure leaves open, see `Uncertainty.blind`; None: `flat` if
            its error is infinite.
        undetermined: unknowns that it leaves open at generic points.
        press: of unknowns that are measured against the press (by position), its size and unit.
    """
    if not np.any(flat):
        return "no free parameter"
    if press and np.any(np.abs(flat[list(press)]) >= _PART * np.max(np.abs(flat))):
        return _with_units(names, flat, flat_se, blind, press)
    if np.isfinite(flat_se) and flat_se <= WEAK:
        order = np.argsort(-np.abs(flat))
        main = [i for i in order if abs(flat[i]) >= 0.1 * abs(flat[order[0]])]
        one = f"{names[main[0]]} alone" if len(main) == 1 else None
        what = one or f"{_moves(names, flat, main)} together"
        return f"least determined: {what}, known to {_percent(flat_se)}"
    structural = bool(np.any(blind)) if blind is not None else not np.isfinite(flat_se)
    open_ways = flat[None] if blind is None else blind[np.any(blind, axis=1)]
    ways = open_ways if structural else flat[None]
    involved, products = combinations(names, ways)
    alone = involved[0] if len(involved) == 1 else None
    open_ = [] if undetermined is None else np.flatnonzero(undetermined[: len(names)])
    if structural and len(open_) > len(involved):
        # At this estimate one of them has no effect left at all.
        return f"{_list([names[i] for i in open_])} only in combination"
    if not structural:
        if alone and np.isfinite(flat_se):
            return f"{alone} alone is known to {_percent(flat_se)} only"
        if alone or not products:
            return (
                f"{_list(involved)} change{'s' if alone else ''} the curves too little to be told"
            )
        return f"of {_list(involved)} little more is known than {_list(products)}"
    if not products:
        return f"{_list(involved)} change{'s' if alone else ''} no curve at all"
    return f"of {_list(involved)} only {_list(products)} is known"


def _with_units(names, flat, flat_se, blind, press) -> str:
    """As `describe_flat`, where an onset or an offset takes part: in its unit, no power of it."""
    if np.isinf(flat_se):
        ways = flat[None] if blind is None or not np.any(blind) else blind
        parts = [n for i, n in enumerate(names) if np.any(np.abs(ways[:, i]) >= _PART)]
        alone = len(parts) == 1
        return f"{_list(parts)} change{'s' if alone else ' together'} without a change of any curve"
    order = np.argsort(-np.abs(flat))
    main = [i for i in order if abs(flat[i]) >= 0.1 * abs(flat[order[0]])]
    if len(main) == 1:
        size, unit = press[int(main[0])]
        return f"least determined: {names[main[0]]} alone, known to {flat_se * size:.2g} {unit}"
    step = 0.1 / np.max(np.abs(flat))
    moves = []
    for i in main:
        size, unit = press.get(int(i), (100.0, "%"))
        moves.append(f"{names[i]} {step * flat[i] * size:+.3g} {unit}")
    times = f"known to {flat_se / step:.2g} times that"
    return f"least determined: {', '.join(moves)} together, {times}"


def _moves(names, flat, main) -> str:
    """Changes that belong together; the largest is 10 %."""
    step = 0.1 / np.max(np.abs(flat))
    return ", ".join(f"{names[i]} {100 * step * flat[i]:+.3g} %" for i in main)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _list(words: list[str]) -> str:
    """Words with commas and one "and"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
