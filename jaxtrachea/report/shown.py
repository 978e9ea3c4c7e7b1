"""What of a fit is drawn one by one: panels, colours, and what is drawn in them."""

import functools
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.lines import Line2D

from jaxtrachea.files.pictures import plain
from jaxtrachea.fitting.fitted_errors import FittedErrors, fitted_errors
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.rows import ONE_BY_ONE, worst_first
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.report.captions import FEW

#: Positions of a legend, at most.
LEGEND = 8
#: Colour of what has no position.
GREY = "0.35"


class Panel(NamedTuple):
    """What a panel shows: trials of a lane."""

    lane: int
    trials: tuple[int, ...]
    title: str


class Shown:
    """What of a fit is drawn one by one; made once for all its pictures."""

    def __init__(self, result: FitResult):
        """Choose the panels."""
        self.result = result
        self.lanes = _lanes(result)
        every = [c.s_c for k in self.lanes for c in result.study.curves[k]]
        places = sorted({s for s in every if s is not None})
        self._span = (places[0], places[-1]) if places else (0.0, 0.0)
        self.places = places
        panels = [p for k in self.lanes for p in self._panels(k)]
        self.of = len(panels)
        kept = np.unique(np.linspace(0, len(panels) - 1, ONE_BY_ONE).round().astype(int))
        self.panels = panels if len(panels) <= ONE_BY_ONE else [panels[i] for i in kept]

    @functools.cached_property
    def errors(self) -> FittedErrors:
        """Of `lanes`, in their order."""
        return fitted_errors(self.result, np.array(self.lanes))

    def errors_at(self, name: str, lane: int, t: int, sample) -> tuple[np.ndarray, ...]:
        """Model - data, half the 95 % band of the fit, studentised residual of an observation."""
        at = self.lanes.index(lane), t, sample
        result = self.result
        half = result.uncertainty.half_width[lane] * result.effective.growth[lane]
        fitted = self.errors.fitted[name][at]
        band = np.where(np.isfinite(fitted), fitted, np.nan) * (
            half if np.isfinite(half) else np.nan
        )
        return (
            result.residuals[name][lane, t, sample],
            band,
            self.errors.studentised[name][at],
        )

    @property
    def title(self) -> str:
        """What of all is drawn; "" for all."""
        if len(self.lanes) < self.result.lanes:
            half = ONE_BY_ONE // 2
            return (
                f"{len(self.lanes)} of {self.result.lanes} fits: the {half} worst, then every so "
                "many to the best; all: summary.csv"
            )
        if len(self.panels) < self.of:
            return f"{len(self.panels)} of {self.of} positions, evenly chosen; all: results.h5"
        return ""

    def colour(self, s: float | None) -> Any:
        """By the position along the tube."""
        if s is None:
            return GREY
        low, high = self._span
        share = (s - low) / (high - low) if high > low else 0.3
        return mpl.colormaps["viridis"](0.9 * share)

    def _panels(self, lane: int) -> list[Panel]:
        """Positions of a lane, or all of it."""
        curves, name = self.result.study.curves[lane], plain(lane_label(self.result, lane), 30)
        if self.result.lanes > FEW:
            return [Panel(lane, tuple(range(len(curves))), name)]
        groups: dict[tuple[float, float], list[int]] = {}
        for t, c in enumerate(curves):
            groups.setdefault((-1.0 if c.s_c is None else c.s_c, c.phi_c), []).append(t)
        prefix = f"{name}, " if self.result.lanes > 1 else ""
        several = len({phi for _, phi in groups}) > 1
        return [
            Panel(lane, tuple(groups[s, phi]), prefix + _place(s, phi, several) if s >= 0 else name)
            for s, phi in sorted(groups)
        ]


def _place(s: float, phi: float, several: bool) -> str:
    angle = f", {np.degrees(phi):.3g}°" if several else ""
    return f"s = {s:.4g} mm{angle}"


def _lanes(result: FitResult) -> list[int]:
    """Lanes drawn one by one: all of few; of many the worst, then some on the way to the best."""
    if result.lanes <= ONE_BY_ONE:
        return list(range(result.lanes))
    order, half = worst_first(result), ONE_BY_ONE // 2
    rest = np.linspace(half, result.lanes - 1, ONE_BY_ONE - half).astype(int)
    return [order[i] for i in [*range(half), *rest]]


def along(curve: Curve) -> tuple[np.ndarray, str]:
    """What a curve is drawn along: a whole record by its time, else the displacement."""
    if curve.rise is None or curve.time is None:
        return curve.displacement, "displacement [mm]"
    return curve.time - curve.time[0], "time [s]"


def position_signs(shown: Shown) -> list[Any]:
    """What the colours mean: all positions, or of many some."""
    places = np.array(shown.places)
    if len(places) < 2:
        return []
    if len(places) > LEGEND:
        places = places[np.linspace(0, len(places) - 1, LEGEND).round().astype(int)]
    return [Line2D([], [], color=shown.colour(s), lw=2.5, label=f"s = {s:.4g} mm") for s in places]
