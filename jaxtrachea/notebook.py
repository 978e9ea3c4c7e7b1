"""Fits, scenes and simulations as pictures in a notebook: `%load_ext jaxtrachea`."""

import base64
import io
from typing import Any

import jax
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxtrachea.files.pictures import STYLE
from jaxtrachea.files.table import words
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.output.plots import draw_tools
from jaxtrachea.output.results import plan_rows
from jaxtrachea.output.surface_plot import draw_rest
from jaxtrachea.report.fit_pictures import draw_force
from jaxtrachea.report.shown import Shown
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Scene


def load_ipython_extension(ipython: Any) -> None:
    """Show `FitResult`, `Scene` and `Simulation` as tables and pictures: `%load_ext jaxtrachea`.

    Args:
        ipython: the shell, as IPython gives it.
    """
    formatter = ipython.display_formatter.formatters["text/html"]
    for kind, shown in ((FitResult, of_fit), (Scene, of_scene), (Simulation, of_simulation)):
        formatter.for_type(kind, shown)


def of_fit(result: FitResult) -> str:
    """Estimates with their verdicts, and curves above their residuals, as HTML."""
    with mpl.rc_context(STYLE):
        return result.table()._repr_html_() + _picture(draw_force(Shown(result)))


def of_scene(scene: Scene) -> str:
    """Which effects are simulated and why, and the tube at rest, as HTML."""
    head = ["effect", "level", "chosen", "operations", "reason"]
    table = words("Plan", head, plan_rows(scene.plan, {}), ("reason",))
    return table._repr_html_() + ("" if scene.mesh is None else _picture(draw_rest(scene)))


def of_simulation(out: Simulation) -> str:
    """Force, indentation and motion of the skeleton, row by row, as HTML."""
    several = np.asarray(out.s).ndim == 2
    if not several:
        out = jax.tree.map(lambda v: np.asarray(v)[:, None], out)
    names = [f"tool {j + 1}" for j in range(out.s.shape[1])] if several else ["tool"]
    return _picture(draw_tools(names, out))


def _picture(figure: Figure) -> str:
    memory = io.BytesIO()
    FigureCanvasAgg(figure).print_png(memory)
    return f'<img src="data:image/png;base64,{base64.b64encode(memory.getvalue()).decode()}">'
