"""What each choice costs in accuracy and saves in time: a row a choice, a panel a question."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from tradeoff_front import error, front, time, worst

from jaxtrachea.files.pictures import STYLE, plain

#: An error up to this is drawn as exact, left of all others.
EXACT = 1e-17
#: An error above this has its number in place of a dot: it would squeeze all others together.
WORTHLESS = 10.0
#: Times that the paper states: skeleton at 10 kHz, surface at 1 kHz; s.
GOALS = {"100 µs": 1e-4, "1 ms": 1e-3}
#: Kinds of ladders in the order of their rows, and their colours (Okabe and Ito, for all eyes).
KINDS = {
    "algebra": "#0072B2", "truncation": "#009E73", "model": "#D55E00", "together": "#CC79A7",
}  # fmt: skip
#: What each panel asks: an error or a time, of which programs.
PANELS = {
    ("error", "call"): "How wrong is it?\nlargest relative error:\nforce, joints, surface",
    ("time", "part"): "How long is the part\nthat it changes?\nµs a call; grey: the finest level",
    ("time", "call"): "How long is a call?\nµs; grey: the finest level",
    ("time", "lane"): "How long in a batch?\nµs a lane; grey: the finest level",
    ("error", "gradient"): "How wrong are derivatives?\nrelative error of\n"
    "d force / d log parameter",
    ("time", "gradient"): "How long with derivatives?\nµs; grey: the finest level",
}
QUESTIONS = tuple(PANELS.values())


def draw(points: list[dict[str, Any]], title: str) -> Figure:
    """Panels of one scene, with a row for each level that is not the finest of its ladder.

    A panel for each question that was measured. Levels that no other beats in error and time
    together (the Pareto front) have a black edge.

    Args:
        points: of one scene, as `measure.measure` gives them.
        title: of the figure.
    """
    rows = _rows(points)
    finest = {p["ladder"]: p for p in points if p["finest"]}
    shown = [panel for panel in PANELS if any(panel[1] in p["times"] for p in points)]
    with mpl.rc_context(STYLE):
        size = (2.9 * len(shown), 1.7 + 0.21 * max(len(rows), 4))
        figure = Figure(figsize=size, layout="constrained")
        figure.suptitle(plain(title, 100))
        axes = np.atleast_1d(figure.subplots(1, len(shown), sharey=True))
        for axis, (kind, which) in zip(axes, shown, strict=True):
            axis.set_title(PANELS[kind, which], fontsize=8, loc="left")
            colours = [KINDS[p["kind"]] for p in rows]
            edges = _edges(rows, list(finest.values()), which)
            if kind == "error":
                _errors(axis, np.array([error(p, which) for p in rows]), colours, edges)
                continue
            full = [time(finest.get(p["ladder"]), which) for p in rows]
            times = np.array([time(p, which) for p in rows])
            _times(axis, times, np.array(full), colours, edges)
        _names(axes[0], rows)
        _legend(figure, rows)
        return figure


def _legend(figure: Figure, rows) -> None:
    """Colours of the kinds that are there, and the edge of the front."""
    handles = [
        Line2D([], [], marker="o", ls="", color=colour, label=kind)
        for kind, colour in KINDS.items()
        if any(p["kind"] == kind for p in rows)
    ]
    if handles:
        front = {"mfc": "none", "mec": "k", "mew": 1.3, "label": "Pareto front"}
        handles.append(Line2D([], [], marker="o", ls="", **front))
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))


def _edges(rows, finest, which: str) -> list[str]:
    """Black for levels on the front, else the colour of the kind; a part has no front."""
    best = set() if which == "part" else set(front(rows + finest, which))
    return ["k" if i in best else KINDS[p["kind"]] for i, p in enumerate(rows)]


def _rows(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Levels by kind, ladder and rising error; the finest are what the others are compared with."""
    shown = [p for p in points if not p["finest"]]
    ladders = list(dict.fromkeys(p["ladder"] for p in shown))
    kinds = list(KINDS)

    def place(p):
        return kinds.index(p["kind"]), ladders.index(p["ladder"]), worst(p)

    return sorted(shown, key=place)


def _names(axis, rows) -> None:
    """The rows' names, the first on top; a thin line between ladders."""
    axis.set_yticks(range(len(rows)), [plain(f"{p['ladder']}: {p['level']}") for p in rows])
    axis.set_ylim(max(len(rows), 4) - 0.4, -0.6)
    for panel in axis.figure.axes:
        panel.tick_params(axis="y", length=0)
        for i in range(1, len(rows)):
            if rows[i]["ladder"] != rows[i - 1]["ladder"]:
                panel.axhline(i - 0.5, color="0.85", lw=0.6)


def _errors(axis, errors: np.ndarray, colours, edges) -> None:
    """Dots; an error of 0 stands left as "exact", a `WORTHLESS` one right in words."""
    known = (errors > EXACT) & (errors <= WORTHLESS)
    low, high = errors[known].min(initial=1e-3), errors[known].max(initial=1.0)
    decades = np.log10(high / low) + 1
    left, right = low * 10 ** (-0.22 * decades), high * 10 ** (0.12 * decades)
    axis.set(xscale="log", xlim=(left / 10 ** (0.12 * decades), right * 10 ** (0.12 * decades)))
    x = np.where(known, errors, np.where(errors <= EXACT, left, right))
    for i, at in enumerate(x):
        if known[i]:
            axis.plot(at, i, "o", ms=5.5, color=colours[i], mec=edges[i], mew=1.3)
        else:
            word = f"{errors[i]:.0e}" if np.isfinite(errors[i]) else "infinite"
            word = "exact" if errors[i] <= EXACT else word
            axis.text(at, i, word, fontsize=6, ha="center", va="center", color=colours[i])
    axis.xaxis.set_major_locator(LogLocator(numticks=5))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _times(axis, times: np.ndarray, full: np.ndarray, colours, edges) -> None:
    """A line from the time of the finest level to that of this one."""
    axis.set(xscale="log")
    for i, (seconds, finest) in enumerate(zip(times, full, strict=True)):
        if not np.isfinite(seconds):
            continue
        axis.plot([finest, seconds], [i, i], color=colours[i], lw=1.2, alpha=0.5)
        axis.plot(finest, i, "|", ms=8, color="0.4")
        axis.plot(seconds, i, "o", ms=5.5, color=colours[i], mec=edges[i], mew=1.3)
    ends = [v for v in (*times, *full) if np.isfinite(v)]
    low, high = min(ends, default=1e-4), max(ends, default=1e-3)
    # At least a decade, so that rounding of the clock does not look like a gain.
    spare = max(1.3, np.sqrt(10 / (high / low)))
    axis.set_xlim(low / spare, high * spare)
    for name, goal in GOALS.items():
        if low / spare < goal < high * spare:
            axis.axvline(goal, color="0.5", lw=0.8, ls="--")
            axis.annotate(name, (goal, 0), xycoords=("data", "axes fraction"), fontsize=6,
                          xytext=(2, 2), textcoords="offset points")  # fmt: skip
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(lambda seconds, _: f"{1e6 * seconds:.4g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
