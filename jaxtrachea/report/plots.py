"""The figures of a fit (matplotlib, imported only here, and without a global backend)."""

from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from jaxtrachea.files.pictures import plain, save_each
from jaxtrachea.fit.predictions import Prediction
from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.design import Candidates, Choice, Map
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.results import lane_label, unknown_label
from jaxtrachea.inference.rows import ONE_BY_ONE, listed, worst_first

#: Lanes that have a line of their own in a picture of all; of more, the worst.
LINES = 200
#: What all figures share.
STYLE: dict[Any, object] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "font.size": 9,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "figure.dpi": 130,
    "text.usetex": False,
}


def draw_all(
    folder: Path, result: FitResult, prediction: Prediction, profiles: Profiles | None = None
) -> tuple[list[Path], dict[str, str]]:
    """Write fit.png, residuals.png, if fitted correlation.png, if given profiles.png.

    Returns:
        The paths; and by file name, why a picture could not be drawn: it costs itself only.
    """
    drawings: dict[str, Any] = {
        "fit.png": partial(draw_fit, result, prediction),
        "residuals.png": partial(draw_residuals, result, prediction),
    }
    if result.study.free:
        drawings["correlation.png"] = partial(draw_correlation, result)
    if profiles is not None and len(profiles.lane):
        drawings["profiles.png"] = partial(draw_profiles, profiles)
    with mpl.rc_context(STYLE):
        return save_each(folder, drawings, bbox_inches="tight")


def _panels(result: FitResult) -> list[int]:
    """Lanes drawn one by one: all of few; of many the worst, then some on the way to the best."""
    if result.lanes <= ONE_BY_ONE:
        return list(range(result.lanes))
    order, half = worst_first(result), ONE_BY_ONE // 2
    rest = np.linspace(half, result.lanes - 1, ONE_BY_ONE - half).astype(int)
    return [order[i] for i in [*range(half), *rest]]


def _grid(count: int, height: float = 2.7):
    columns = min(3, count)
    rows = -(-count // columns)
    size = (max(4.6, 3.6 * columns), height * rows + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    return figure, axes.flat


def draw_fit(result: FitResult, prediction: Prediction):
    """Data (dots) and fitted force (line) against displacement; markers in a second row of axes."""
    shown = _panels(result)
    with_joints = prediction.joints is not None and result.lanes <= 3
    figure, axes = _grid(len(shown) * (2 if with_joints else 1), 3.2 if with_joints else 2.7)
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
            axis.plot(curve.displacement[::step], curve.force[::step], ".", color=colour, ms=4)
            axis.plot(curve.displacement, model, "-", color=colour, lw=1.2, label=label)
        name = plain(lane_label(result, lane))
        axis.set(title=name, xlabel="displacement [mm]", ylabel="force [N]")
        if 1 < len(curves) <= 12:
            axis.legend(ncols=2, title="dots: measured, lines: model", title_fontsize=7)
        if with_joints:
            _draw_joints(next(axes), result, prediction, lane, colours)
    if len(shown) < result.lanes:
        half = ONE_BY_ONE // 2
        figure.suptitle(
            f"{len(shown)} of {result.lanes} lanes: the {half} worst, then every so many to the "
            "best; all: summary.csv"
        )
    return figure


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
    """Force residuals, model - data, against displacement, and their distribution."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    pooled, lined = [], set(listed(result, LINES))
    for lane in range(result.lanes):
        for t, curve in enumerate(result.study.curves[lane]):
            n = len(curve.force)
            peak = np.max(np.abs(curve.force))
            r = 100 * prediction.force[lane, t, :n] / (peak if peak > 0 else 1)
            pooled.append(r)
            if lane in lined:
                left.plot(curve.displacement, r, lw=0.7, alpha=0.6)
    left.axhline(0, color="k", lw=0.6)
    left.set(
        xlabel="displacement [mm]",
        ylabel="(model - data) / peak [%]",
        title="force residuals" + _of(len(lined), result.lanes, "worst lanes"),
    )
    values = np.concatenate(pooled)
    right.hist(values[np.isfinite(values)], bins=60, color="0.4")
    right.set(xlabel="residual / peak [%]", ylabel="samples")
    return figure


def _of(shown: int, total: int, what: str) -> str:
    """In a title, how much of all is drawn; "" for all."""
    return "" if shown >= total else f", {shown} {what} of {total}"


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
    title = "correlation" + (f", mean of {result.lanes} lanes" if result.lanes > 1 else "")
    axis.set_title(title + _of(shown, len(names), "unknowns"))
    figure.colorbar(image, shrink=0.8)
    return figure


def draw_profiles(profiles: Profiles):
    """Rise of the profile against the parameter, a panel for each parameter, a line for each lane.

    Dotted: the parabola of the local standard error, of the first lane; dashed: threshold.
    """
    result = profiles.result
    names = list(dict.fromkeys(p.name for p in result.study.free))
    of = lambda k: result.study.unknowns[profiles.lane[k]][profiles.unknown[k]][0]  # noqa: E731
    groups = {n: [k for k in range(len(profiles.lane)) if of(k).name == n] for n in names}
    place = {lane: n for n, lane in enumerate(listed(result, LINES))}
    groups = {
        n: sorted(members, key=lambda k: place.get(profiles.lane[k], LINES))
        for n, members in groups.items()
        if members
    }
    figure, axes = _grid(len(groups))
    for axis, members in zip(axes, groups.values(), strict=False):
        p, first = of(members[0]), members[0]
        colours = mpl.colormaps["viridis"](np.linspace(0.05, 0.9, len(members)))
        for k, colour in zip(members[:LINES], colours, strict=False):
            at = np.array([p.from_scaled(v) for v in profiles.coordinate[k]])
            axis.plot(at, profiles.statistic[k], ".-", color=colour, lw=0.9, ms=3)
        lane, unknown = profiles.lane[first], profiles.unknown[first]
        se = result.uncertainty.se[lane, unknown]
        if np.isfinite(se):
            ends = profiles.coordinate[first]
            theta = np.linspace(ends[0], ends[-1], 101)
            local = ((theta - result.theta[lane, unknown]) / se) ** 2
            axis.plot([p.from_scaled(v) for v in theta], local, ":", color="k", lw=1)
        axis.axhline(profiles.threshold[first], ls="--", color="tab:red", lw=0.9)
        wide = np.ptp(profiles.coordinate[members]) > np.log(20)
        axis.set_xscale("log" if p.scale == "log" and wide else "linear")
        axis.set_ylim(-0.2, 2.2 * profiles.threshold[first])
        title = p.name + _of(min(len(members), LINES), len(members), "worst lanes")
        axis.set(title=title, xlabel=f"{p.name} [{p.unit}]", ylabel="rise of the profile")
    return figure


def draw_design(
    path: Path, found: Map, at: Candidates, choice: Choice, rings: np.ndarray
) -> dict[str, str]:
    """Write the identifiability map: over s with the data, of pairs without, and the gains.

    Returns:
        By file name, why it could not be drawn; empty if it could.
    """
    with mpl.rc_context(STYLE):
        draw = partial(_design, found, at, choice, rings)
        return save_each(path.parent, {path.name: draw}, bbox_inches="tight")[1]


def _design(found: Map, at: Candidates, choice: Choice, rings: np.ndarray) -> Figure:
    """The identifiability map."""
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    left.plot(found.s, found.condition, color="0.2")
    left.set(xlabel="s [mm]", ylabel="condition", title="data and a press at s")
    left.plot(rings, np.full(len(rings), found.condition.min()), "|", color="tab:green", ms=9)
    image = middle.pcolormesh(found.s, found.s, np.log10(found.pairs), cmap="viridis_r")
    figure.colorbar(image, label="log10 condition")
    middle.set(xlabel="s [mm]", ylabel="s [mm]", title="two presses, no other data")
    for depth in np.unique(at.depth):
        own = at.depth == depth
        right.plot(at.s[own], choice.score[0, own], lw=1, label=f"{depth:.3g} mm")
    for k in np.unique(choice.chosen):
        order = ", ".join(str(step + 1) for step in np.flatnonzero(choice.chosen == k))
        right.annotate(order, (at.s[k], choice.score[0, k]), color="tab:red")
    right.legend(title="depth")
    right.set(xlabel="s [mm]", ylabel="criterion", title="first press; chosen in order")
    return figure
