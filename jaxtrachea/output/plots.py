"""Pictures of simulations and sweeps (matplotlib without a global backend)."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.scene.sweep import Sweep
from jaxtrachea.status import PressStatus

#: Statuses with a force, how each is marked, and what the mark is called.
MARKS = {
    PressStatus.OK: ("o", "#1b5e9b", "#1b5e9b"),
    PressStatus.NO_CONTACT: ("o", "w", "0.55"),
}
WARNED = ("^", "#e69f00", "#a05f00")
UNSOLVED = ("x", "#b4001e", "#b4001e")


def draw_series(scene: Scene, path: Poses | Presses, out: Simulation) -> Figure:
    """Normal force, force along the surface with the limit of friction, and motion of the wall.

    All are drawn along the way of the tool. A row without a solution is a cross on the axis.
    """
    way, label = _way(path, out)
    status = np.asarray(out.status)
    phi = np.asarray(out.phi, float)
    inward = np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], axis=1)
    round_ = np.stack([0 * phi, -np.sin(phi), np.cos(phi)], axis=1)
    force, depth, skeleton = (np.asarray(v, float) for v in (out.force, out.depth, out.skeleton))
    figure = Figure(figsize=(9.6, 2.9), dpi=110, layout="constrained")
    normal, aside, motion = figure.subplots(1, 3)
    parts = [np.sum(v * inward, axis=1) for v in (force, depth, skeleton)]
    _draw_parts(normal, way, {"": parts[0]}, "0.35")
    _draw_status(normal, way, parts[0], status)
    normal.set(xlabel=label, ylabel="normal force [N]")
    tangential = {"along the tube": force[:, 0], "around it": np.sum(force * round_, axis=1)}
    _draw_parts(aside, way, tangential)
    if scene.friction is not None and scene.plan.friction:
        size = np.linalg.norm(force - parts[0][:, None] * inward, axis=1)
        aside.plot(way, size, color="k", lw=0.8, label="size of both")
        aside.plot(
            way, float(scene.friction) * parts[0], color="#b4001e", ls="--", lw=1.1,
            label=f"limit: {float(scene.friction):.3g} x normal",
        )  # fmt: skip
    aside.set(xlabel=label, ylabel="force along the surface [N]")
    aside.set_xlim(normal.get_xlim())
    if not np.isfinite(aside.dataLim.intervaly).all() or not aside.dataLim.height > 0:
        aside.set(ylim=(-1, 1), yticks=[0])
    _draw_parts(motion, way, {"indentation": parts[1], "skeleton": parts[2]})
    motion.set(xlabel=label, ylabel="motion inwards [mm]")
    for axis in (normal, aside, motion):
        axis.margins(y=0.08)
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.3 * (high - low))  # room for the legend
        axis.legend(frameon=False, fontsize=7, loc="upper left")
        axis.grid(alpha=0.25)
    return figure


def draw_tools(
    names: Sequence[str], out: Simulation, friction: Sequence[float | None] = ()
) -> Figure:
    """Normal force, local indentation and motion of the skeleton of several tools, row by row.

    Where they slide also the force along the surface, with its limit by the friction of each.
    """
    row, status = np.arange(len(out.s)) + 1, np.asarray(out.status)
    inward = -np.stack([0 * out.phi, np.cos(out.phi), np.sin(out.phi)], axis=-1)
    force, depth, skeleton = (np.asarray(v, float) for v in (out.force, out.depth, out.skeleton))
    normal, deep, sunk = (np.sum(v * inward, axis=-1) for v in (force, depth, skeleton))
    shown = {"normal force [N]": normal}
    if out.slip is not None:
        size = np.linalg.norm(force - normal[..., None] * inward, axis=-1)
        shown["force along the surface [N]"] = size
    shown |= {"indentation [mm]": deep, "skeleton inwards [mm]": sunk}
    figure = Figure(figsize=(3.2 * len(shown), 2.9), dpi=110, layout="constrained")
    styles = ("-", "--", "-.")
    for axis, (label, value) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        for j, name in enumerate(names):
            color = f"C{j % 10}"
            axis.plot(row, value[:, j], ls=styles[j % 3], lw=1.1, label=name, color=color)
            if label.startswith("normal"):
                _draw_status(axis, row, value[:, j], status[:, j], counted=False)
            if label.startswith("force along") and friction:
                limit = float(friction[j] or 0) * normal[:, j]
                axis.plot(row, limit, ":", lw=0.9, color=color, label="limit of each")
        axis.set(xlabel="row", ylabel=label)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.margins(y=0.08)
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.4 * (high - low))  # room for the legend
        handles = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
        axis.legend(handles.values(), handles, frameon=False, fontsize=7, loc="upper left")
        axis.grid(alpha=0.25)
    return figure


def _way(path: Poses | Presses, out: Simulation) -> tuple[np.ndarray, str]:
    """What rows are drawn along, mm, and its name."""
    if isinstance(path, Presses):
        size = np.linalg.norm(np.asarray(path.displacement, float), axis=1)
        return size, "displacement of the tool [mm]"
    place = np.asarray(path.translation, float)
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    gap = np.nan_to_num(np.asarray(out.gap, float), nan=np.inf)
    inside = np.flatnonzero(gap <= 0)
    if not len(inside):
        return way, "way of the tool [mm]"
    first = int(inside[0])
    share = 0.0
    if first > 0 and np.isfinite(gap[first - 1]):
        share = gap[first] / (gap[first] - gap[first - 1])
    touch = way[first] - share * (way[first] - way[first - 1 if first else 0])
    return way - touch, "way of the tool from first touch [mm]"


def _draw_parts(axis: Any, way: np.ndarray, parts: dict[str, np.ndarray], colour=None) -> None:
    """A line each; what is zero throughout is named in the legend and not drawn."""
    largest = max(float(np.nanmax(np.abs(v), initial=0)) for v in parts.values())
    looks = (("#1b5e9b", "-", "."), ("#e69f00", "--", "s"))
    for (name, value), (own, style, mark) in zip(parts.items(), looks, strict=False):
        if not np.nanmax(np.abs(value), initial=0) > 1e-9 * max(largest, 1e-9):
            axis.plot([], [], color=own, ls=style, label=f"{name}: zero" if name else "zero")
            continue
        shown = "" if colour else mark
        axis.plot(way, value, color=colour or own, ls=style, marker=shown, ms=3, lw=1, label=name)


def _draw_status(
    axis: Any, way: np.ndarray, force: np.ndarray, status: np.ndarray, counted: bool = True
) -> None:
    """A mark for every row by its status, named in the legend, with the number of rows."""
    for code in np.unique(status):
        which = PressStatus(int(code))
        solved = status == code
        mark, face, edge = MARKS.get(which, WARNED if which.solved else UNSOLVED)
        height = force[solved] if which.solved else np.zeros(solved.sum())
        axis.scatter(
            way[solved], np.nan_to_num(height), marker=mark, s=16, linewidths=0.9,
            zorder=3, label=which.name.lower().replace("_", " ")
            + (f" ({solved.sum()} rows)" if counted else ""),
            **({"color": edge} if mark == "x" else {"facecolors": face, "edgecolors": edge}),
        )  # fmt: skip


def draw_map(s, phi, values: np.ndarray, label: str) -> Figure:
    """Values over the unrolled surface.

    Args:
        s: mm.
        phi: rad.
        values: shape (s, phi).
        label: with its unit.
    """
    figure = Figure(figsize=(7, 3.2), dpi=110)
    axis = figure.subplots()
    image = axis.pcolormesh(s, np.degrees(phi), values.T, shading="nearest", cmap="cividis")
    axis.set(xlabel="s [mm], carina to larynx", ylabel="phi [deg]")
    figure.colorbar(image, ax=axis, label=label)
    figure.tight_layout()
    return figure


def draw_sweep(s, phi, depth: float, out: Sweep) -> dict[str, Callable[[], Figure]]:
    """What draws maps of force and compliance at a depth, mm, by file name."""

    def grid(v):
        return np.asarray(v).reshape(len(s), len(phi))

    return {
        "force.png": partial(draw_map, s, phi, grid(out.force), f"force at {depth:g} mm [N]"),
        "compliance.png": partial(
            draw_map, s, phi, grid(out.compliance), f"compliance at {depth:g} mm [mm/N]"
        ),
    }
