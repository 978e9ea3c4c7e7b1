"""The figures of a fit (matplotlib, imported only here, and without a global backend)."""

from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from jaxtrachea.files.pictures import STYLE, grid, of_all, plain, save_each
from jaxtrachea.fitting.predictions import Prediction
from jaxtrachea.fitting.result import FitResult, unknown_label
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.rows import ONE_BY_ONE, worst_first
from jaxtrachea.measurements.curve import Curve

#: Residuals that bands are made of at most, intervals of displacement, and samples in one at least.
BANDED, BINS, FEWEST = 400_000, 60, 20


def draw_all(folder: Path, findings: AnalysisResults) -> tuple[list[Path], dict[str, str]]:
    """Write fit.png, residuals.png, if fitted correlation.png, and those of the analyses.

    Returns:
        The paths; and by file name, why a picture could not be drawn: it costs itself only.
    """
    result, prediction = findings.result, findings.result.residuals
    drawings: dict[str, Any] = {
        "fit.png": partial(draw_fit, result, prediction),
        "residuals.png": partial(draw_residuals, result, prediction),
    }
    if result.study.free:
        drawings["correlation.png"] = partial(draw_correlation, result)
    return _save(folder, drawings | _drawings(findings))


def draw_analyses(folder: Path, findings: AnalysisResults) -> dict[str, str]:
    """Write the pictures of the analyses alone; why one could not be drawn, by file name."""
    return _save(folder, _drawings(findings))[1]


def _drawings(findings: AnalysisResults) -> dict[str, Any]:
    figures = (analysis.figures(found) for analysis, found in findings.found)
    return {name: draw for drawings in figures for name, draw in drawings.items()}


def _save(folder: Path, drawings: dict[str, Any]) -> tuple[list[Path], dict[str, str]]:
    with mpl.rc_context(STYLE):
        return save_each(folder, drawings)


def _panels(result: FitResult) -> list[int]:
    """Lanes drawn one by one: all of few; of many the worst, then some on the way to the best."""
    if result.lanes <= ONE_BY_ONE:
        return list(range(result.lanes))
    order, half = worst_first(result), ONE_BY_ONE // 2
    rest = np.linspace(half, result.lanes - 1, ONE_BY_ONE - half).astype(int)
    return [order[i] for i in [*range(half), *rest]]


def _along(curve: Curve) -> tuple[np.ndarray, str]:
    """What a curve is drawn along: a whole record by its time, else the displacement."""
    if curve.rise is None or curve.time is None:
        return curve.displacement, "displacement [mm]"
    return curve.time - curve.time[0], "time [s]"


def draw_fit(result: FitResult, prediction: Prediction):
    """Data (dots) and fitted force (line), see `_along`; side force and markers beside."""
    shown = _panels(result)
    few = result.lanes <= 3
    with_joints = prediction.joints is not None and few
    side = prediction.side_force if few else None
    more = with_joints + (side is not None)
    figure, axes = grid(len(shown) * (1 + more), 3.2 if more else 2.7)
    axes = iter(axes)
    for lane in shown:
        axis = next(axes)
        curves = result.study.curves[lane]
        colours = mpl.colormaps["viridis"](np.linspace(0.05, 0.9, len(curves)))
        for t, (curve, colour) in enumerate(zip(curves, colours, strict=True)):
            n = len(curve.force)
            model = curve.force + prediction.force[lane, t, :n]
            step = max(1, n // 60)
            label = plain(curve.trial) if len(curves) <= 12 else None
            along, head = _along(curve)
            axis.plot(along[::step], curve.force[::step], ".", color=colour, ms=4)
            axis.plot(along, model, "-", color=colour, lw=1.2, label=label)
        name = plain(lane_label(result, lane))
        axis.set(title=name, xlabel=head, ylabel="force [N]")
        if 1 < len(curves) <= 12:
            axis.legend(ncols=2, title="dots: measured, lines: model", title_fontsize=7)
        if side is not None:
            _draw_side(next(axes), result, side[lane], lane, colours)
        if with_joints:
            _draw_joints(next(axes), result, prediction, lane, colours)
    if len(shown) < result.lanes:
        half = ONE_BY_ONE // 2
        figure.suptitle(
            f"{len(shown)} of {result.lanes} fits: the {half} worst, then every so many to the "
            "best; all: summary.csv"
        )
    return figure


def _draw_side(axis, result, residual, lane, colours) -> None:
    """Force across the tool's direction against displacement; `residual`: (trials, samples)."""
    for t, (curve, colour) in enumerate(zip(result.study.curves[lane], colours, strict=True)):
        if curve.side_force is None:
            continue
        n = len(curve.force)
        axis.plot(curve.displacement, curve.side_force, ".", color=colour, ms=4)
        axis.plot(curve.displacement, curve.side_force + residual[t, :n], "-", color=colour, lw=1.2)
    axis.set(title="side force", xlabel="displacement [mm]", ylabel="side force [N]")


def _draw_joints(axis, result, prediction, lane, colours) -> None:
    """Ligament deflection along the tube at the last sample, per unit of tool displacement."""
    x = np.asarray(result.study.model.geometry.ring_positions)
    for t, (curve, colour) in enumerate(zip(result.study.curves[lane], colours, strict=True)):
        if curve.joint_displacement is None:
            continue
        last = len(curve.force) - 1
        D = curve.displacement[last]
        model = (result.study.lanes.joints[lane, t, last] + prediction.joints[lane, t, last]) / D
        axis.plot(x[curve.joint_rings], curve.joint_displacement[last] / D, "o", color=colour, ms=3)
        axis.plot(x, model, "-", color=colour, lw=1)
    axis.set(
        title="joints at the largest displacement",
        xlabel="s [mm]",
        ylabel="joint / tool displacement",
    )


def draw_residuals(result: FitResult, prediction: Prediction):
    """Force residuals, model - data, against displacement or time, and their distribution.

    Of many lanes those that failed are left out, the worst of the others are lines, and all of them
    bands over these.
    """
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    many = result.lanes > ONE_BY_ONE
    lanes = list(range(result.lanes))
    if many and result.succeeded.any():
        lanes = [lane for lane in worst_first(result) if result.succeeded[lane]]
    lined = set(lanes[: ONE_BY_ONE // 2] if many else lanes)
    pooled, depths, head = [], [], ""
    for lane in lanes:
        for t, curve in enumerate(result.study.curves[lane]):
            n = len(curve.force)
            peak = np.max(np.abs(curve.force))
            r = 100 * prediction.force[lane, t, :n] / (peak if peak > 0 else 1)
            pooled.append(r)
            along, head = _along(curve)
            depths.append(along)
            if lane in lined:
                left.plot(along, r, lw=0.7, alpha=0.6)
    values, depth = np.concatenate(pooled), np.concatenate(depths)
    seen = np.isfinite(values)
    values, depth = values[seen], depth[seen]
    if many:
        _draw_bands(left, depth, values)
    left.axhline(0, color="k", lw=0.6)
    shown = f" of {len(lanes)} fits (bands), the {len(lined)} worst as lines" if many else ""
    left.set(
        xlabel=head,
        ylabel="(model - data) / peak [%]",
        title=f"force residuals{shown}",
    )
    right.hist(values, bins=60, color="0.4")
    right.set(xlabel="residual / peak [%]", ylabel="samples")
    return figure


def _draw_bands(axis, depth, values) -> None:
    """Median and the middle 50 and 95 % of residuals along the press."""
    if len(values) > BANDED:  # as many tell the same
        drawn = np.random.default_rng(0).integers(len(values), size=BANDED)
        depth, values = depth[drawn], values[drawn]
    if not len(depth) or not np.ptp(depth) > 0:
        return
    edges = np.linspace(depth.min(), depth.max(), BINS + 1)
    bins = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, BINS - 1)
    levels = np.full((BINS, 5), np.nan)
    for i in range(BINS):
        if np.sum(bins == i) >= FEWEST:
            levels[i] = np.percentile(values[bins == i], [2.5, 25, 50, 75, 97.5])
    middle = (edges[1:] + edges[:-1]) / 2
    low, lower, median, upper, high = levels.T
    look = {"color": "0.2", "lw": 0, "zorder": 3}
    axis.fill_between(middle, low, high, alpha=0.25, label="95 % of samples", **look)
    axis.fill_between(middle, lower, upper, alpha=0.45, label="50 %", **look)
    axis.plot(middle, median, color="w", lw=1.4, zorder=4)
    axis.plot(middle, median, color="k", lw=0.9, zorder=4, label="median")
    axis.legend(ncols=3, loc="upper left")


def draw_correlation(result: FitResult):
    """Correlation of the estimates: of the lane, or the mean over lanes."""
    count = len(result.study.unknowns[0])
    names = [plain(unknown_label(result, 0, i), 24) for i in range(count)]
    shown = min(len(names), 30)
    with np.errstate(invalid="ignore"):
        stack = result.uncertainty.correlation[:, :shown, :shown]
        known = np.isfinite(stack)
        mean = np.where(known, stack, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    mean = np.where(known.any(axis=0), mean, np.nan)
    size = 1.6 + 0.55 * shown
    figure = Figure(figsize=(size + 1, size), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(mean, vmin=-1, vmax=1, cmap="RdBu_r")
    axis.grid(visible=False)
    axis.set_xticks(range(shown), names[:shown], rotation=60, ha="right")
    axis.set_yticks(range(shown), names[:shown])
    for i in range(shown):
        for j in range(shown):
            if np.isfinite(mean[i, j]) and shown <= 12:
                dark = "w" if abs(mean[i, j]) > 0.6 else "k"
                axis.text(j, i, f"{mean[i, j]:.2f}", ha="center", va="center", color=dark, size=7)
    title = "correlation" + (f", mean of {result.lanes} fits" if result.lanes > 1 else "")
    axis.set_title(title + of_all(shown, len(names), "unknowns"))
    figure.colorbar(image, shrink=0.8)
    return figure
