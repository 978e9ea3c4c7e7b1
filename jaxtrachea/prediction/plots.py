"""Pictures of predictions: bands, and measured curves against them."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from jaxtrachea.files.pictures import STYLE, plain, save_each
from jaxtrachea.prediction.curves import CurvePrediction
from jaxtrachea.prediction.held_out import Compared

#: Panels of a picture, curves of a panel, and curves of the picture of all samples.
PANELS, LINES, MAX_CURVES = 12, 10, 200
_ALL = "all: predictions.csv"


def draw_predictions(folder: Path, curves: Sequence[CurvePrediction]) -> dict[str, str]:
    """Write predictions.png: predicted force with both bands, a panel for each specimen.

    Returns:
        By file name, why a picture could not be drawn: it costs itself only.
    """
    return _save(folder, {"predictions.png": partial(_panels, [(p, None) for p in curves])})


def draw_compared(folder: Path, compared: Sequence[Compared]) -> dict[str, str]:
    """Write curves.png and measured_predicted.png."""
    pairs = [(c.prediction, c.curve.force) for c in compared]
    drawings = {
        "curves.png": partial(_panels, pairs),
        "measured_predicted.png": partial(_against, compared),
    }
    return _save(folder, drawings)


def _save(folder: Path, drawings: Mapping[str, Callable[[], Figure]]) -> dict[str, str]:
    with mpl.rc_context(STYLE):
        return save_each(folder, drawings)[1]


def _panels(curves: Sequence[tuple[CurvePrediction, np.ndarray | None]]) -> Figure:
    """A panel for each specimen; of many specimens and curves the first ones."""
    groups: dict[str, list] = {}
    for pair in curves:
        groups.setdefault(pair[0].specimen, []).append(pair)
    shown = list(groups.items())[:PANELS]
    columns = min(3, max(len(shown), 1))
    rows = -(-max(len(shown), 1) // columns)
    figure = Figure(figsize=(max(4.6, 3.6 * columns), 2.9 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flat
    for axis, (name, members) in zip(axes, shown, strict=False):
        _one_panel(axis, members[:LINES])
        left = len(members) - LINES
        more = f" (the first {LINES} of {len(members)} curves)" if left > 0 else ""
        axis.set(title=plain(name) + more, xlabel=_along(members[0][0])[1], ylabel="force [N]")
    for axis in list(figure.axes)[len(shown) :]:
        axis.set_visible(False)
    most = max(map(len, groups.values()), default=0)
    if len(groups) > PANELS:
        figure.suptitle(f"the first {PANELS} of {len(groups)} specimens; {_ALL}")
    elif most > LINES:
        figure.suptitle(_ALL)
    return figure


def _along(p: CurvePrediction) -> tuple[np.ndarray, str]:
    """What a curve is drawn along, from its first sample: time where the force relaxes."""
    if p.time is None:
        return p.displacement, "displacement [mm]"
    return p.time - p.time[0], "time [s]"


def _one_panel(axis, members) -> None:
    """Curves of one specimen: dots measured, line predicted, shades both bands."""
    colours = mpl.colormaps["viridis"](np.linspace(0.05, 0.9, len(members)))
    for (p, measured), colour in zip(members, colours, strict=True):
        along = _along(p)[0]
        order = np.argsort(along, kind="stable")
        D = along[order]
        for low, high, alpha in (
            (p.low95, p.high95, 0.15),
            (p.curve_low95, p.curve_high95, 0.3),
        ):
            known = np.isfinite(low[order]) & np.isfinite(high[order])
            axis.fill_between(
                D, low[order], high[order], where=known, color=colour, alpha=alpha, lw=0
            )
        place = "" if np.isnan(p.s) else f"s = {p.s:.4g} mm"
        label = " ".join(filter(None, [plain(p.trial), place]))
        marker = "o" if len(D) == 1 else ""
        axis.plot(D, p.force[order], "-", marker=marker, color=colour, lw=1.2, label=label, ms=3)
        if measured is not None:
            step = max(1, len(D) // 60)
            axis.plot(D[::step], measured[order][::step], ".", color=colour, ms=4)
    if any(str(line.get_label())[:1] not in ("", "_") for line in axis.lines):
        axis.legend(ncols=1 + (len(members) > 5))


def _against(compared: Sequence[Compared]) -> Figure:
    """Every sample: predicted over measured force, and the difference over the noise band."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    ends = [0.0]
    for c in compared[:MAX_CURVES]:
        force, guess = c.curve.force, c.prediction.force
        known = np.isfinite(guess)
        new = c.in_fit != "yes"
        left.plot(force[known], guess[known], "." if new else "+", ms=3, alpha=0.6)
        right.plot(_along(c.prediction)[0][known], c.residual[known], lw=0.8, alpha=0.7)
        ends += [*force[known], *guess[known]]
    line = [min(ends), max(ends)]
    left.plot(line, line, "k-", lw=0.6)
    left.set(xlabel="measured [N]", ylabel="predicted [N]", title="+: used by the fit")
    right.axhline(0, color="k", lw=0.6)
    along = _along(compared[0].prediction)[1] if compared else ""
    right.set(xlabel=along, ylabel="predicted - measured [N]", title="differences")
    if len(compared) > MAX_CURVES:
        figure.suptitle(f"the first {MAX_CURVES} of {len(compared)} curves; {_ALL}")
    return figure
