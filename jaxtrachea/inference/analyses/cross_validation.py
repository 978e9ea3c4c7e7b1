"""Curves left out, in tables and report."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.tables import markdown_table
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analysis import Analysis, Cells, Findings, Progress, Request, Table
from jaxtrachea.inference.cross_validation import LeftOut, curves_to_leave_out, leave_one_out
from jaxtrachea.inference.residuals import rms
from jaxtrachea.inference.rows import ONE_BY_ONE, and_more
from jaxtrachea.inference.together import together_sentence

LEFT_OUT_HEAD = ["specimen", "left out", "force / model", "rms force / peak", "rms joints / D"]


def _refuse(request: Request) -> None:
    try:
        curves_to_leave_out(request.study)
    except ValueError as error:
        raise SpecError(f"--leave-one-out: {error}") from None


def _compute(request: Request, findings: Findings, progress: Progress) -> LeftOut:
    return leave_one_out(findings.result, request.settings, progress)


def left_out_cells(left_out: LeftOut) -> list[Cells]:
    """Rows of left_out.csv: a curve left out and its errors each."""
    errors = (left_out.ratio, left_out.force, left_out.joints)
    rows: list[Cells] = []
    columns = (left_out.lane, left_out.trial, left_out.converged.tolist(), *errors)
    for k, t, converged, *values in zip(*columns, strict=True):
        curve = left_out.study.curves[k][t]
        names = ("force_over_model", "rms_over_peak", "rms_joints_over_displacement")
        row: dict[str, object] = {"specimen": curve.specimen, "trial": curve.trial}
        out = zip(names, values, strict=True)
        rows.append(row | {name: float(v) for name, v in out} | {"converged": converged})
    return rows


def left_out_rows(left_out: LeftOut) -> list[list[str]]:
    """Specimen, curve left out, its errors; the last row is the root mean square."""
    rows = []
    errors = (left_out.ratio, left_out.force, left_out.joints)
    for k, t, *values in zip(left_out.lane, left_out.trial, *errors, strict=True):
        curve = left_out.study.curves[k][t]
        rows.append([curve.specimen, curve.trial, *map(_percent, values)])
    mean = [float(rms(v)) for v in errors]
    return [*rows, ["(root mean square)", "", *map(_percent, mean)]]


def left_out_table(left_out: LeftOut) -> tuple[list[list[str]], list[str]]:
    """Rows of `left_out_rows` for people, and what follows: of many the worst, worst first."""
    *rows, mean = left_out_rows(left_out)
    if len(rows) <= ONE_BY_ONE:
        return [*rows, mean], []
    order = np.argsort(-np.nan_to_num(left_out.force, nan=np.inf), kind="stable")
    worst = [rows[k] for k in order[:ONE_BY_ONE]]
    return [*worst, mean], and_more(len(rows), len(worst), "left_out.csv")


def _percent(value: float) -> str:
    return "–" if np.isnan(value) else f"{100 * value:.2f} %"


def own_touch_sentence(study: Study, which: str) -> list[str]:
    """That a curve left out has an onset or an offset fitted to itself; empty where it has none."""
    own = [p.name for p in study.free if p.scope == "trial" and p.name in OF_THE_PRESS]
    if not own:
        return []
    return [
        f"{which} fits its own {' and '.join(own)}; all other unknowns are those of the others."
    ]


def _section(found: LeftOut) -> list[str]:
    rows, further = left_out_table(found)
    parts = ["## Leaving one curve out", markdown_table(LEFT_OUT_HEAD, rows)]
    parts += [f"{text}." for text in further]
    parts += own_touch_sentence(found.study, "A curve left out")
    parts += [f"{text}." for text in together_sentence(found.study.together)]
    return [*parts, f"{found.sentence}."] if found.sentence else parts


def _shown(found: LeftOut, lanes: list[int]) -> Iterator[Table | str]:
    """Curves left out, of many the worst first, and their root mean square."""
    rows, further = left_out_table(found)
    yield "Leaving one curve out", LEFT_OUT_HEAD, rows
    yield from further
    yield from together_sentence(found.study.together)
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
    tables=lambda found: {"left_out.csv": left_out_cells(found)},
    section=_section,
    shown=_shown,
)
