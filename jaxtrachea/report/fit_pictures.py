"""Measured and fitted curves, position by position, each above its residuals."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxtrachea.files.pictures import plain
from jaxtrachea.measurements.observed import FITTED_NUMBERS
from jaxtrachea.report.captions import FEW
from jaxtrachea.report.shown import GREY, Shown, along, position_signs
from jaxtrachea.report.small_multiples import Cell, small_multiples

#: Trials of a panel that are told apart, dots of a curve, and points of a line, at most.
APART, DOTS, POINTS = 4, 60, 600
#: 97.5 % of the normal distribution: half the band of the noise, in standard deviations.
NOISE = 1.96
#: Panels share their limits unless the largest force is so many times the usual one.
_ALIKE = 3.0
_MARKERS, _LINES = "o^sD", ("-", "--", ":", "-.")


class Trace(NamedTuple):
    """A curve as it is drawn; (N,) each, NaN where a part of it has no point.

    Attributes:
        x: of every point.
        measured: used by the fit.
        unused: measured, and not used by it.
        fitted: value.
        half: half the 95 % band of the fit.
        studentised: residual.
    """

    x: np.ndarray
    measured: np.ndarray
    unused: np.ndarray
    fitted: np.ndarray
    half: np.ndarray
    studentised: np.ndarray


def draw_force(shown: Shown, name: str = "force"):
    """Measured and fitted `force`, or one of `FITTED_NUMBERS`, of every panel above residuals."""
    result, words = shown.result, []
    unit = FITTED_NUMBERS[name].unit if name in FITTED_NUMBERS else "N"

    def trace(lane: int, t: int) -> Trace | None:
        curve = result.study.curves[lane][t]
        data = getattr(curve, name)
        if data is None:
            return None
        x, label = along(curve)
        words.append(label)
        order = np.arange(len(x)) if curve.rise else np.argsort(x, kind="stable")
        point = lane, t, slice(len(x))
        off, half, over = (v[: len(x)] for v in shown.errors_at(name, *point))
        parts = data, np.full(len(x), np.nan), data + off, half, over
        return Trace(x[order], *(v[order] for v in parts))

    traces = [[(t, trace(p.lane, t)) for t in p.trials] for p in shown.panels]
    return _draw(shown, traces, words[0], f"{name.replace('_', ' ')} [{unit}]")


def draw_joints(shown: Shown):
    """Markers along the tube at the largest displacement, over that of the tool.

    The line is the fit where it was compared.
    """
    study = shown.result.study
    precision = study.lanes.others["joints"].precision
    rings = np.asarray(study.model.geometry.ring_positions, float)

    def trace(lane: int, t: int) -> Trace | None:
        curve = study.curves[lane][t]
        if curve.joint_displacement is None:
            return None
        last = int(np.argmax(np.abs(curve.displacement)))
        D, measured = curve.displacement[last] or np.nan, np.full(rings.shape, np.nan)
        measured[curve.joint_rings] = curve.joint_displacement[last]
        off, half, over = shown.errors_at("joints", lane, t, last)
        used = precision[lane, t, last] > 0
        first, second = np.where(used, measured, np.nan), np.where(used, np.nan, measured)
        return Trace(rings, first / D, second / D, (measured + off) / D, half / abs(D), over)

    traces = [[(t, trace(p.lane, t)) for t in p.trials] for p in shown.panels]
    return _draw(shown, traces, "s [mm]", "marker / tool [mm/mm]", tool=True)


def _draw(shown: Shown, traces: list, x_label: str, y_label: str, *, tool: bool = False):
    """The panels, the residuals below, and what all of it means on top."""
    rows = [[(t, trace) for t, trace in row if trace is not None] for row in traces]
    kept = [(p, row) for p, row in zip(shown.panels, rows, strict=True) if row]
    every = [trace for _, row in kept for _, trace in row]
    shared = _alike([row for _, row in kept])
    words = (x_label, y_label, "residual\n[std. dev.]")
    ends = [_ends([trace.x for _, trace in row]) for _, row in kept]
    figure, cells = small_multiples(ends, shared=shared, words=words)
    limit = scale_of(np.concatenate([trace.studentised for trace in every]))
    beyond = False
    for cell, (panel, row) in zip(cells, kept, strict=True):
        curves, looks = shown.result.study.curves[panel.lane], []
        for i, (t, trace) in enumerate(row):
            looks.append(_look(i, len(row), shown.colour(curves[t].s_c)))
            trace = trace._replace(x=trace.x + cell.shift)
            _draw_trace(cell.upper, trace, looks[-1])
            beyond |= draw_residual(cell.lower, trace.x, trace.studentised, limit, looks[-1])
        for s in {curves[t].s_c for t, _ in row} if tool else ():
            cell.upper.axvline(s + cell.shift, color="0.6", lw=0.8, ls=":", zorder=0)
        cell.title(panel.title)
        if 1 < len(row) <= APART and shown.result.lanes <= FEW:
            _name_trials(cell, [plain(curves[t].trial, 20) for t, _ in row], looks)
    if shared:
        both = [c.upper.get_ylim() for c in cells]
        for cell in cells:
            cell.upper.set_ylim(min(low for low, _ in both), max(high for _, high in both))
    for cell in cells:
        cell.lower.set_ylim(-1.12 * limit, 1.12 * limit)
    _explain(figure, shown, tool=tool, every=every, beyond=beyond)
    return figure


def _ends(x: list[np.ndarray]) -> tuple[float, float]:
    """Limits that hold all points, with a margin."""
    low, high = float(min(map(np.min, x))), float(max(map(np.max, x)))
    margin = 0.04 * (high - low) or 0.5
    return low - margin, high + margin


def _name_trials(cell: Cell, names: list[str], looks: list[dict[str, Any]]) -> None:
    """Which line is which trial."""
    lines = [Line2D([], [], **look, ms=3, lw=1.1) for look in looks]
    low, high = cell.upper.get_xlim()
    right = (cell.shift + cell.ends[1] - low) / (high - low)
    legend = Legend(
        cell.upper, lines, names, fontsize=6, handlelength=3, frameon=False, borderaxespad=0,
        loc="upper right", bbox_to_anchor=(right, 1.0),
    )  # fmt: skip
    cell.upper.add_artist(legend)


def _look(i: int, count: int, colour: Any) -> dict[str, Any]:
    """Colour by position; few trials of a panel differ in marker and line."""
    k = i if count <= APART else 0
    return {"color": colour, "marker": _MARKERS[k], "ls": _LINES[k]}


def _draw_trace(axis, trace: Trace, look: dict[str, Any]) -> None:
    x, n = trace.x, len(trace.x)
    dots, points = slice(None, None, max(1, n // DOTS)), slice(None, None, max(1, n // POINTS))
    band = np.isfinite(trace.half) & np.isfinite(trace.fitted)
    if band.any():
        low, high = trace.fitted - trace.half, trace.fitted + trace.half
        axis.fill_between(
            x[points], low[points], high[points], where=band[points], color=look["color"],
            alpha=0.25, lw=0,
        )  # fmt: skip
    of_dots = {"color": look["color"], "marker": look["marker"], "ls": "", "ms": 3}
    axis.plot(x[dots], trace.measured[dots], **of_dots, mew=0)
    if np.isfinite(trace.unused).any():
        axis.plot(x[dots], trace.unused[dots], **of_dots, mfc="none", mew=0.8)
    axis.plot(x[points], trace.fitted[points], **{**look, "marker": ""}, lw=1.1)


def scale_of(studentised: np.ndarray) -> float:
    """Half the height of residual panels: of nearly all, so that one outlier does not set it."""
    size = np.abs(studentised[np.isfinite(studentised)])
    return max(3.5, 1.5 * float(np.quantile(size, 0.975))) if len(size) else 3.5


def draw_residual(axis, x, studentised, limit: float, look: dict[str, Any]) -> bool:
    """Residuals in the band of the noise; triangles on the edge are beyond it: whether any is."""
    if not axis.patches:  # the first of these axes
        axis.axhspan(-NOISE, NOISE, color="0.5", alpha=0.18, lw=0)
        axis.axhline(0, color="0.4", lw=0.6)
    chosen = np.zeros(len(x), bool)
    chosen[:: max(1, len(x) // (5 * DOTS))] = True
    chosen |= np.abs(studentised) > limit / 2
    r, x = studentised[chosen], x[chosen]
    axis.plot(x, r, color=look["color"], marker=look["marker"], ls="", ms=2, mew=0)
    found = False
    for sign, marker in ((1, "^"), (-1, "v")):
        out = sign * r > limit
        if out.any():
            axis.plot(x[out], np.full(out.sum(), 1.02 * sign * limit), color="#b4001e",
                      marker=marker, ls="", ms=4, mew=0)  # fmt: skip
            found = True
    return found


def _alike(rows: list) -> bool:
    """Whether panels may share their limits: no one has far larger values than the usual one."""
    largest = [
        max(np.nanmax(np.abs([t.measured, t.fitted]), initial=0.0) for _, t in row) for row in rows
    ]
    return bool(max(largest) <= _ALIKE * np.median(largest))


def _explain(figure, shown: Shown, *, tool: bool, every: list[Trace], beyond: bool) -> None:
    """The legend of all panels, and what of all they are."""
    grey: dict[str, Any] = {"color": GREY}
    signs: list[Any] = [Line2D([], [], **grey, marker="o", ls="", ms=3, label="measured")]
    if any(np.isfinite(t.unused).any() for t in every):
        hollow: dict[str, Any] = {"marker": "o", "ls": "", "ms": 3, "mfc": "none"}
        signs.append(Line2D([], [], **grey, **hollow, label="not used"))
    signs.append(Line2D([], [], **grey, lw=1.1, label="fit"))
    if any(np.isfinite(t.half).any() for t in every):
        signs.append(Patch(**grey, alpha=0.3, lw=0, label="95 % band of the fit"))
    signs.append(Patch(color="0.5", alpha=0.25, lw=0, label="95 % of the noise"))
    if tool:
        signs.append(Line2D([], [], color="0.6", lw=0.8, ls=":", label="tool"))
    if beyond:
        red: dict[str, Any] = {"color": "#b4001e", "marker": "^", "ls": "", "ms": 4}
        signs.append(Line2D([], [], **red, label="beyond the scale"))
    if shown.result.lanes > FEW:
        signs += position_signs(shown)
    width = figure.get_size_inches()[0]
    columns = max(2, int(width / 1.45))
    figure.legend(handles=signs, loc="upper left", ncols=columns, fontsize=7,
                  bbox_to_anchor=(0, 1), borderaxespad=0.3, columnspacing=1.2)  # fmt: skip
    if shown.title:
        figure.text(0.995, 0.004, shown.title, fontsize=7, ha="right", va="bottom")
