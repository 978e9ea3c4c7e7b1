"""Verdicts in words: which parameters the data determine, and what they determine instead."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import scipy.linalg
from jaxtyping import Float

from jaxtrachea.status import ProfileEnd

#: Relative standard error up to which a parameter counts as identifiable, and as weakly so.
IDENTIFIABLE, WEAK = 0.1, 0.5
#: All verdicts on an estimate, best first.
VERDICTS = ("identifiable", "weak", "practically not", "structurally not", "at bound")
#: Component of an undetermined direction, exponent of a combination: below, it is not named.
_PART, _EXPONENT = 0.1, 0.02


def verdict(relative_se: float, held: bool, profile: tuple[float, ProfileEnd] | None = None) -> str:
    """One of `VERDICTS` for a parameter.

    Structurally not: the model itself, at these contact points, does not let it be told, whatever
    the noise (to first order at the estimate). Practically not: it would, but with this noise the
    relative error exceeds 50 %, or the profile is open on a side.

    Args:
        relative_se: local; inf where undetermined.
        held: the estimate is on its bound.
        profile: half the relative width of the profile interval over that of one standard error
            (it then takes the place of `relative_se`), and the worse of its ends.
    """
    if held:
        return "at bound"
    if np.isinf(relative_se):
        return "structurally not"
    if profile is not None and profile[1] != ProfileEnd.FAILED:
        relative_se = np.inf if profile[1] == ProfileEnd.OPEN else profile[0]
    if relative_se <= IDENTIFIABLE:
        return "identifiable"
    return "weak" if relative_se <= WEAK else "practically not"


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
    press: Mapping[int, tuple[float, str]] = MappingProxyType({}),
) -> str:
    """What the data leave open, in words.

    Args:
        names: unknowns, in the order of `flat`.
        flat: least determined direction in relative coordinates, see `Uncertainty.flat`.
        flat_se: relative standard error along it.
        blind: all undetermined directions, see `Uncertainty.blind`; None: `flat` alone.
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
    ways = flat[None]
    if blind is not None and np.isinf(flat_se) and np.any(blind):
        ways = blind[np.any(blind, axis=1)]
    involved, products = combinations(names, ways)
    alone = involved[0] if len(involved) == 1 else None
    if np.isfinite(flat_se):
        if alone:
            return f"{alone} alone is known to {_percent(flat_se)} only"
        return f"{_list(involved)} little more than through {_list(products)}"
    if not products:
        return f"{_list(involved)} change{'s' if alone else ''} no curve at all"
    return f"{_list(involved)} only through {_list(products)}"


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
