"""Work-precision diagrams: error along x, time along y, both logarithmic (matplotlib)."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from jaxtrachea.files.pictures import STYLE, plain

#: An error up to this is drawn as exact, left of all others.
EXACT = 1e-17
#: Times that the paper states: skeleton at 10 kHz, surface at 1 kHz; s.
GOALS = {"100 µs": 1e-4, "1 ms": 1e-3}
PANELS = ("algebra", "truncation", "model", "gradient")


def draw(points: list[dict[str, Any]], title: str) -> Figure:
    """The four panels of one scene: three kinds, and the gradient over all kinds.

    Args:
        points: of one scene, as `measure.measure` gives them.
        title: of the figure.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.6, 7.6), layout="constrained")
        figure.suptitle(plain(title, 100))
        colours = _colours(points)
        for axis, panel in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
            _panel(axis, points, panel, colours)
        return figure


def worst(point: dict[str, Any]) -> float:
    """Largest of the relative errors of force, joints and surface."""
    values = [point["errors"][k] for k in ("force", "joints", "surface")]
    return max(float(v) for v in values if v is not None)


def pareto(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Indices of the points that no other beats in both, by rising x."""
    order = np.lexsort((y, x))
    best, front = np.inf, []
    for i in order:
        if np.isfinite(x[i]) and y[i] < best:
            best = y[i]
            front.append(i)
    return np.array(front, int)


def _colours(points) -> dict[str, Any]:
    names = list(dict.fromkeys(point["ladder"] for point in points))
    shades = mpl.colormaps["tab20"](np.linspace(0, 1, max(len(names), 2)))
    return dict(zip(names, shades, strict=False))


def _panel(axis, points, panel: str, colours) -> None:
    gradient = panel == "gradient"
    shown = [p for p in points if gradient or p["kind"] == panel]
    axis.set(xscale="log", yscale="log", title=panel if not gradient else "gradient, all kinds")
    axis.set_ylim(5e-5, 5e-3)
    axis.set_xlabel(
        "error of d force / d log parameter"
        if gradient
        else "largest error: force, joints, surface"
    )
    axis.set_ylabel("time of a call with derivatives [s]" if gradient else "time of a call [s]")
    for name, at in GOALS.items():
        axis.axhline(at, color="0.5", lw=0.8, ls="--")
        axis.annotate(name, (1, at), xycoords=("axes fraction", "data"), fontsize=7, ha="right")
    if not shown:
        axis.text(0.5, 0.5, "no such ladder in this scene", transform=axis.transAxes, ha="center")
        return
    value = (lambda p: float(p["errors"]["gradient"])) if gradient else worst
    x = np.array([value(p) for p in shown])
    time = [p["times"]["gradient" if gradient else "call"] for p in shown]
    y, high = (np.array([t[k] for t in time]) for k in ("median", "p99"))
    low, top = axis.get_ylim()
    axis.set_ylim(min(low, y.min() / 2), max(top, 2 * high.max()))
    lost = ~np.isfinite(x)
    if lost.any():
        axis.plot(np.ones(lost.sum()), y[lost], "x", color="0.3", clip_on=False,
                  transform=axis.get_yaxis_transform(), label="infinite error")  # fmt: skip
    exact = x <= EXACT
    left = x[np.isfinite(x) & ~exact].min(initial=1) / 100
    x = np.where(np.isfinite(x), np.where(exact, left, x), np.nan)
    axis.set_xlim(left / 3, 3 * np.nanmax(x, initial=100 * left))
    if exact.any():
        axis.axvline(left * 10, color="0.8", lw=0.8)
        axis.annotate("exact", (left, 0.97), xycoords=("data", "axes fraction"), fontsize=7,
                      ha="center", va="top")  # fmt: skip
    for name in dict.fromkeys(p["ladder"] for p in shown):
        on = np.array([p["ladder"] == name for p in shown])
        up = np.maximum(high[on] - y[on], 0)
        axis.errorbar(x[on], y[on], yerr=[0 * up, up], fmt="o-", ms=4, lw=0.8, elinewidth=0.6,
                      color=colours[name], label=plain(name))  # fmt: skip
        if not gradient:
            for i in np.flatnonzero(on & np.isfinite(x) & ~exact):
                axis.annotate(plain(shown[i]["level"]), (x[i], y[i]), fontsize=6, xytext=(3, 3),
                              textcoords="offset points")  # fmt: skip
    front = pareto(x, y)
    axis.step(x[front], y[front], where="post", color="k", lw=0.8, label="Pareto front")
    axis.plot(x[front], y[front], "ko", mfc="none", ms=8, lw=0)
    axis.legend(fontsize=6, loc="upper left", bbox_to_anchor=(1, 1))
