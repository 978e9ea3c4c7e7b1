"""Curves left out, in tables and report."""

from collections.abc import Iterator

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.table import Column, Table
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.cross_validation import LeftOut, curves_to_leave_out, leave_one_out
from jaxtrachea.inference.holdout_groups import holdout_sentence
from jaxtrachea.inference.residuals import rms
from jaxtrachea.inference.rows import ONE_BY_ONE, and_more

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
    return [*parts, f"{found.sentence}."] if found.sentence else parts


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
)
