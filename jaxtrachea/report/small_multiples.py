"""Figures of many small panels, each above a low one, laid out by hand: a third of the time.

Panels that share their limits stand side by side in one pair of axes, shifted along x: of a
picture of ten panels the axes would take most of the time.
"""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

#: Inches: margins, heights of a panel and of the one below it, and spaces between them.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.7, 0.12, 0.6, 0.58
_UPPER, _LOWER, _BETWEEN, _ROW, _NUMBERS = 1.5, 0.62, 0.06, 0.28, 0.36
#: Panels of a row, inches of one and of the space beside it: with shared limits, or its own.
_SHARED, _OWN = (5, 2.1, 0.0), (4, 1.95, 0.55)
#: Space between panels of one pair of axes, as a share of their width.
_GAP = 0.08


class Cell(NamedTuple):
    """A panel.

    Attributes:
        upper: axes of the panel; other panels may lie beside it.
        lower: axes below.
        shift: to be added to x.
        ends: limits of x, before the shift.
        first: whether it is the first of its axes.
    """

    upper: Any
    lower: Any
    shift: float
    ends: tuple[float, float]
    first: bool

    def title(self, text: str) -> None:
        """Write above the panel."""
        middle = self.shift + 0.5 * sum(self.ends)
        self.upper.text(
            middle, 1.03, text, transform=self.upper.get_xaxis_transform(), ha="center", fontsize=8
        )


def small_multiples(
    ends: list[tuple[float, float]], *, shared: bool, words: tuple[str, str, str]
) -> tuple[Figure, list[Cell]]:
    """A figure with its panels, empty; limits of y are left to whoever draws.

    Args:
        ends: limits of x of every panel, at least one.
        shared: all panels have the same limits, those that hold all of them.
        words: label of x, of y, and of y below.
    """
    count = len(ends)
    most, wide, beside = _SHARED if shared else _OWN
    rows = -(-count // most)
    columns = -(-count // rows)
    wide = max(wide, (4.0 - (columns - 1) * beside) / columns)
    below = _ROW if shared else _ROW + _NUMBERS
    size = (
        _LEFT + columns * wide + (columns - 1) * beside + _RIGHT,
        _TOP + rows * (_UPPER + _BETWEEN + _LOWER) + (rows - 1) * below + _BOTTOM,
    )
    figure, cells = Figure(figsize=size), []

    def pair(row: int, x: float, width: float):
        top = size[1] - _TOP - row * (_UPPER + _BETWEEN + _LOWER + below)
        places = (top - _UPPER, _UPPER), (top - _UPPER - _BETWEEN - _LOWER, _LOWER)
        axes = [
            figure.add_axes((x / size[0], y / size[1], width / size[0], high / size[1]))
            for y, high in places
        ]
        for axis, word, small in zip(axes, words[1:], (8, 7), strict=True):
            axis.yaxis.set_major_locator(MaxNLocator(4))
            if x == _LEFT:
                axis.set_ylabel(word, fontsize=small)
        axes[0].xaxis.set_major_locator(NullLocator())
        return axes

    for row in range(rows):
        mine = ends[row * columns : (row + 1) * columns]
        if shared:
            low, high = min(e[0] for e in ends), max(e[1] for e in ends)
            upper, lower = pair(row, _LEFT, len(mine) * wide)
            shifts = (1 + _GAP) * (high - low) * np.arange(len(mine))
            cells += [Cell(upper, lower, v, (low, high), v == 0) for v in shifts]
            last = row * columns + len(mine) + columns > count
            _number(upper, lower, (low, high), shifts, words[0], numbers=last)
            continue
        for column, (low, high) in enumerate(mine):
            upper, lower = pair(row, _LEFT + column * (wide + beside), wide)
            cells.append(Cell(upper, lower, 0.0, (low, high), True))
            for axis in (upper, lower):
                axis.set_xlim(low, high)
            lower.xaxis.set_major_locator(MaxNLocator(4))
            if row * columns + column + columns >= count:
                lower.set_xlabel(words[0], fontsize=8)
    return figure, cells


def _number(upper, lower, ends, shifts, label: str, *, numbers: bool) -> None:
    """Limits, ticks and label of panels beside each other in one pair of axes."""
    low, high = ends
    gap = 0.5 * _GAP * (high - low)
    if numbers:
        ticks = MaxNLocator(3).tick_values(low, high)
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        lower.set_xticks((ticks + shifts[:, None]).ravel(), [f"{v:g}" for v in ticks] * len(shifts))
        lower.set_xlabel(label, fontsize=8)
    else:
        lower.xaxis.set_major_locator(NullLocator())
    for axis in (upper, lower):
        axis.set_xlim(low - gap, high + gap + shifts[-1])
        if len(shifts) > 1:
            edges = shifts[1:] + low - gap
            axis.vlines(edges, 0, 1, transform=axis.get_xaxis_transform(), color="0.7", lw=0.6)
