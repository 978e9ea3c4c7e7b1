"""The figures of a fit (matplotlib, imported only here, and without a global backend)."""

from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxtrachea.files.pictures import STYLE, of_all, plain, save_each
from jaxtrachea.fitting.assessment import unknown_label
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.rows import ONE_BY_ONE, worst_first
from jaxtrachea.measurements.observed import FITTED_NUMBERS
from jaxtrachea.report.captions import captions
from jaxtrachea.report.fit_pictures import draw_force, draw_joints
from jaxtrachea.report.shown import Shown, along, position_signs

#: Residuals of many lanes that are drawn, about, since more tell the same; intervals of
#: displacement, and samples in one at least.
DRAWN, BINS, FEWEST = 400_000, 60, 20
#: Lanes of a waterfall at most; share of the cost up to which two starts end in one minimum.
FALLS, SAME = 8, 1e-6


def draw_all(
    folder: Path, findings: AnalysisResults, ending: str = "png"
) -> tuple[list[Path], dict[str, str]]:
    """Write the pictures of `captions`, and those of the analyses.

    Returns:
        The paths; and by file name, why a picture could not be drawn: it costs itself only.
    """
    shown = Shown(findings.result)
    drawings: dict[str, Any] = {
        "fit": partial(draw_force, shown),
        "joints": partial(draw_joints, shown),
        "residuals": partial(draw_residuals, shown),
        "waterfall": partial(draw_waterfall, findings.result),
        "correlation": partial(draw_correlation, findings.result),
    }
    drawings |= {name: partial(draw_force, shown, name) for name in FITTED_NUMBERS}
    mine = {f"{name}.png": drawings[name] for name in captions(findings.result)}
    return _save(folder, mine | _drawings(findings), ending)


def draw_analyses(folder: Path, findings: AnalysisResults, ending: str = "png") -> dict[str, str]:
    """Write the pictures of the analyses alone; why one could not be drawn, by file name."""
    return _save(folder, _drawings(findings), ending)[1]


def _drawings(findings: AnalysisResults) -> dict[str, Any]:
    figures = (analysis.figures(found) for analysis, found in findings.found)
    return {name: draw for drawings in figures for name, draw in drawings.items()}


def _save(folder: Path, drawings: dict[str, Any], ending: str) -> tuple[list[Path], dict[str, str]]:
    drawings = {f"{Path(name).stem}.{ending}": draw for name, draw in drawings.items()}
    with mpl.rc_context(STYLE):
        return save_each(folder, drawings)


def draw_residuals(shown: Shown):
    """Force residuals, model - data, against displacement or time, and their distribution.

    Of many lanes those that failed are left out, the worst of the others are lines, and all of them
    bands over these.
    """
    result, prediction = shown.result, shown.result.residuals
    figure = Figure(figsize=(9, 3.2))
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    figure.subplots_adjust(0.08, 0.15, 0.985, 0.82, wspace=0.2)
    many = result.lanes > ONE_BY_ONE
    lanes = list(range(result.lanes))
    if many and result.succeeded.any():
        lanes = [lane for lane in worst_first(result) if result.succeeded[lane]]
    lined = set(lanes[: ONE_BY_ONE // 2] if many else lanes)
    pooled, depths, lines, head = [], [], [], ""
    part, rng = DRAWN / max(result.samples.sum(), 1), np.random.default_rng(0)
    for lane in lanes:
        for t, curve in enumerate(result.study.curves[lane]):
            n = len(curve.force)
            peak = np.max(np.abs(curve.force))
            r = 100 * prediction["force"][lane, t, :n] / (peak if peak > 0 else 1)
            x, head = along(curve)
            drawn = rng.random(n) < part if many and part < 1 else slice(None)
            pooled.append(r[drawn])
            depths.append(x[drawn])
            if lane in lined:
                lines.append((x, r, shown.colour(curve.s_c)))
    values, depth = np.concatenate(pooled), np.concatenate(depths)
    seen = np.isfinite(values)
    values, depth = values[seen], depth[seen]
    limit = _scale(values)
    for x, r, colour in lines:
        left.plot(x, r, lw=0.7, alpha=0.7, color=colour)
    signs = position_signs(shown)
    if many:
        signs += _draw_bands(left, depth, values)
    left.axhline(0, color="k", lw=0.6)
    said = f" of {len(lanes)} fits (bands), the {len(lined)} worst as lines" if many else ""
    left.set(
        xlabel=head,
        ylabel="(model - data) / peak [%]",
        title=f"force residuals{said}",
        ylim=(-limit, limit),
    )
    figure.legend(handles=signs, loc="upper left", ncols=9, fontsize=7, borderaxespad=0.3)
    beyond = int(np.sum(np.abs(values) > limit))
    right.hist(np.clip(values, -limit, limit), bins=np.linspace(-limit, limit, 61), color="0.4")
    drawn = f"{len(values)} drawn" if many and part < 1 else f"{len(values)}"
    more = f"{beyond} of {drawn} beyond the scale" if beyond else ""
    right.set(xlabel="residual / peak [%]", ylabel="samples", title=more)
    return figure


def draw_waterfall(result: FitResult):
    """Cost of every start over that of the best, lowest first; those below `SAME` are one minimum.

    Of many lanes those are drawn whose starts agree least.
    """
    share = result.converged_starts / result.tried
    rows = np.argsort(share, kind="stable")[:FALLS]
    rows = rows[share[rows] < 1].tolist()
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axis = figure.subplots()
    for lane in rows:
        costs = result.start_costs[lane]
        costs = costs[np.isfinite(costs)]
        low = costs[0] if len(costs) and costs[0] > 0 else 1.0
        excess = np.maximum(costs / low - 1, SAME / 10)
        agree = f"{result.converged_starts[lane]} of {result.tried[lane]} agree"
        label = plain(f"{lane_label(result, lane)}: {agree}")
        axis.plot(np.arange(len(costs)) + 1, excess, "o-", ms=3.5, lw=0.9, label=label)
    axis.axhline(SAME, color="0.5", ls="--", lw=0.9)
    axis.set_yscale("log")
    axis.set(
        xlabel="start, lowest first",
        ylabel="cost over that of the best - 1",
        ylim=(SAME / 20, None),
        title=f"starts of {len(rows)} of {result.lanes} fits; below the dashed line: one minimum",
    )
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.legend(fontsize=7)
    return figure


def _scale(values: np.ndarray) -> float:
    """Half the height that shows all residuals, or nearly all where a few are far larger."""
    size = np.abs(values)
    if not len(size):
        return 1.0
    usual, largest = 2.5 * float(np.quantile(size, 0.98)), float(size.max())
    return 1.05 * (largest if largest <= usual or usual == 0 else usual) or 1.0


def _draw_bands(axis, depth, values) -> list[Any]:
    """Median and the middle 50 and 95 % of residuals along the press; what stands for them."""
    if not len(depth) or not np.ptp(depth) > 0:
        return []
    # As many samples in each interval, so that the bands have no gap where samples are few.
    count = max(1, min(BINS, len(depth) // FEWEST))
    edges = np.unique(np.quantile(depth, np.linspace(0, 1, count + 1)))
    bins = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, len(edges) - 2)
    parts = [bins == i for i in np.unique(bins)]
    levels = np.array([np.percentile(values[part], [2.5, 25, 50, 75, 97.5]) for part in parts])
    middle = np.array([np.mean(depth[part]) for part in parts])
    low, lower, median, upper, high = levels.T
    look = {"color": "0.2", "lw": 0, "zorder": 3}
    signs: list[Any] = [
        axis.fill_between(middle, low, high, alpha=0.25, label="95 % of samples", **look),
        axis.fill_between(middle, lower, upper, alpha=0.45, label="50 %", **look),
    ]
    axis.plot(middle, median, color="w", lw=1.4, zorder=4)
    return [*signs, *axis.plot(middle, median, color="k", lw=0.9, zorder=4, label="median")]


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
    # Room for the names by their letters: laid out by hand it takes half the time.
    cells, names_wide = 0.55 * shown, 0.3 + 0.075 * max(map(len, names[:shown]))
    width, height = names_wide + max(cells, 2.6) + 1.1, names_wide + cells + 0.4
    figure = Figure(figsize=(width, height))
    axis = figure.add_axes((names_wide / width, names_wide / height, cells / width, cells / height))
    image = axis.imshow(mean, vmin=-1, vmax=1, cmap="RdBu_r")
    axis.grid(visible=False)
    axis.set_xticks(range(shown), names[:shown], rotation=60, ha="right")
    axis.set_yticks(range(shown), names[:shown])
    for i in range(shown):
        for j in range(shown):
            if shown <= 12:
                dark = "w" if abs(mean[i, j]) > 0.6 else "k"
                text = f"{mean[i, j]:.2f}" if np.isfinite(mean[i, j]) else "none"
                axis.text(j, i, text, ha="center", va="center", color=dark, size=7)
    title = "correlation" + (f", mean of {result.lanes} fits" if result.lanes > 1 else "")
    axis.set_title(title + of_all(shown, len(names), "unknowns"))
    bar = figure.add_axes(
        ((names_wide + cells + 0.2) / width, names_wide / height, 0.15 / width, cells / height)
    )
    figure.colorbar(image, cax=bar, label="correlation [1]")
    return figure
