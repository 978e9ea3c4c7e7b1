"""Curves left out, in tables and report."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.pictures import of_all
from jaxtrachea.files.table import Column, Table
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.cross_validation import LeftOut, curves_to_leave_out, leave_one_out
from jaxtrachea.inference.holdout_groups import holdout_sentence
from jaxtrachea.inference.residuals import rms
from jaxtrachea.inference.rows import LINES, ONE_BY_ONE, and_more

_ERRORS = {
    "force_over_model": "force / model",
    "rms_over_peak": "rms force / peak",
    "rms_joints_over_displacement": "rms joints / D",
}
COLUMNS = (
    Column("specimen"),
    Column("left out", "trial"),
    *(Column(head, name, unit="%", decimals=2) for name, head in _ERRORS.items()),
)


def _refuse(request: Request) -> None:
    try:
        curves_to_leave_out(request.study)
    except ValueError as error:
        raise SpecError(f"--leave-one-out: {error}") from None


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> LeftOut:
    return leave_one_out(findings.result, request.settings, progress)


def left_out_rows(left_out: LeftOut) -> list[Cells]:
    """Rows of left_out.csv: a curve left out and its errors each."""
    errors = (left_out.ratio, left_out.force, left_out.joints)
    rows: list[Cells] = []
    columns = (left_out.lane, left_out.trial, left_out.converged.tolist(), *errors)
    for k, t, converged, *values in zip(*columns, strict=True):
        curve = left_out.study.curves[k][t]
        found = {name: float(v) for name, v in zip(_ERRORS, values, strict=True)}
        names = {"specimen": curve.specimen, "trial": curve.trial}
        rows.append(names | found | {"converged": converged})
    return rows


def left_out_table(left_out: LeftOut) -> Table:
    """Curves left out, of many the worst first; the last row is the root mean square."""
    rows = left_out_rows(left_out)
    errors = (left_out.ratio, left_out.force, left_out.joints)
    mean: dict[str, object] = {"specimen": "(root mean square)", "trial": ""}
    mean |= {name: float(rms(v)) for name, v in zip(_ERRORS, errors, strict=True)}
    more = and_more(len(rows), ONE_BY_ONE, "left_out.csv")
    if more:
        order = np.argsort(-np.nan_to_num(left_out.force, nan=np.inf), kind="stable")
        rows = [rows[k] for k in order[:ONE_BY_ONE]]
    return Table([*rows, mean], COLUMNS, title="Leaving one curve out", more=more)


def own_onset_sentence(study: Study, which: str) -> list[str]:
    """That a curve left out has an onset or an offset fitted to itself; empty where it has none."""
    own = [p.name for p in study.free if p.scope == "trial" and p.name in OF_THE_PRESS]
    if not own:
        return []
    return [
        f"{which} fits its own {' and '.join(own)}; all other unknowns are those of the others."
    ]


def _section(found: LeftOut) -> list[str]:
    parts = own_onset_sentence(found.study, "A curve left out")
    parts += [f"{text}." for text in holdout_sentence(found.study.holdout_groups)]
    parts += [f"{found.sentence}."] if found.sentence else []
    return [*parts, "![curves left out: measured and predicted](left_out.png)"]


def draw_left_out(found: LeftOut):
    """Predicted over measured force of every curve left out, and its error by position."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    curves = [found.study.curves[k][t] for k, t in zip(found.lane, found.trial, strict=True)]
    places = np.array([np.nan if c.s_c is None else c.s_c for c in curves])
    low, high = np.nanmin([*places, 0.0]), np.nanmax([*places, 1.0])
    colours = mpl.colormaps["viridis"](0.9 * (np.nan_to_num(places) - low) / (high - low))
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    ends = [0.0]
    order = np.argsort(-np.nan_to_num(found.force, nan=np.inf), kind="stable")[:LINES]
    for k in order:
        measured = curves[k].force
        predicted = measured + found.residual[k, : len(measured)]
        step = slice(None, None, max(1, len(measured) // 60))
        left.plot(measured[step], predicted[step], ".", ms=3, color=colours[k])
        ends += [*measured[np.isfinite(predicted)], *predicted[np.isfinite(predicted)]]
    left.plot(
        [min(ends), max(ends)], [min(ends), max(ends)], "k-", lw=0.7, label="predicted = measured"
    )
    left.legend(loc="upper left")
    title = "curves left out" + of_all(len(order), len(curves), "worst")
    left.set(xlabel="measured force [N]", ylabel="predicted force [N]", title=title)
    x = places if np.isfinite(places).any() else np.arange(1, len(curves) + 1)
    right.scatter(x, 100 * found.force, c=colours, s=14)
    label = "s [mm]" if np.isfinite(places).any() else "curve [number]"
    right.set(xlabel=label, ylabel="rms error / peak [%]", title="error of the prediction")
    right.set_ylim(bottom=0)
    return figure


def _shown(found: LeftOut) -> Iterator[str]:
    yield from holdout_sentence(found.study.holdout_groups)
    if found.sentence:
        yield found.sentence
    if not np.isfinite(rms(found.force)):
        yield "no curve left out could be predicted"


LEFT_OUT = Analysis(
    name="left_out",
    after="posterior",
    compute=_compute,
    work="leaving curves out",
    option="leave-one-out",
    refuse=_refuse,
    tables=lambda found: {"left_out.csv": Table(left_out_rows(found))},
    table=lambda found, lanes: left_out_table(found),
    section=_section,
    sentences=_shown,
    figures=lambda found: {"left_out.png": partial(draw_left_out, found)},
)
