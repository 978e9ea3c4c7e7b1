"""The bootstrap in tables, report and results.h5."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.table import Column, Table, ends
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.bootstrap import FEWEST, Bootstrap, bootstrap, check_block
from jaxtrachea.inference.labels import unknown_rows
from jaxtrachea.inference.rows import and_more

COLUMNS = (
    Column("specimen"),
    Column("parameter"),
    Column("value"),
    Column("std. error", "bootstrap_se", digits=2),
    Column("local", digits=2),
    Column("95 % of replicates", ends("bootstrap_low95", "bootstrap_high95")),
)


def _refuse(request: Request) -> None:
    try:
        check_block(request.study, request.spec.uncertainty.block)
    except ValueError as error:
        raise SpecError(f"uncertainty.block: {error}") from None


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> Bootstrap:
    asked = request.spec.uncertainty
    return bootstrap(
        findings.result, request.settings, count=asked.bootstrap, kind=asked.kind,
        block=asked.block, progress=progress,
    )  # fmt: skip


def _cells(found: Bootstrap, lane: int, i: int) -> Cells:
    """Standard error and percentile interval of the replicates."""
    return {
        "bootstrap_se": float(found.standard_error[lane, i]),
        "bootstrap_low95": float(found.lower[lane, i]),
        "bootstrap_high95": float(found.upper[lane, i]),
    }


def bootstrap_table(found: Bootstrap, lanes: Sequence[int]) -> Table:
    """Value, standard error by bootstrap and local, percentile interval of every unknown."""
    result = found.result

    def cells(lane: int, i: int) -> Cells:
        return {"local": float(result.standard_error[lane, i]), **_cells(found, lane, i)}

    return Table(
        unknown_rows(result, lanes, cells),
        COLUMNS,
        title="Bootstrap",
        more=and_more(result.lanes, len(lanes), "parameters.csv"),
    )


def _section(found: Bootstrap) -> list[str]:
    """What was resampled, and how much of it was lost."""
    lost = int(np.sum(~found.usable))
    blocks = f" in blocks of {found.block} samples" if found.block > 1 else ""
    return [
        f"{found.usable.shape[1]} replicates of every lane ({found.kind}{blocks}); "
        f"{lost} of {found.usable.size} refits did not converge and are left out; a lane with "
        f"fewer than {FEWEST} others has no interval. All numbers: `results.h5` "
        "(docs/read_a_fit.md).",
        *([f"{found.note}."] if found.note else []),
    ]


BOOTSTRAP = Analysis(
    name="bootstrap",
    after="profiles",
    compute=_compute,
    work="resampling",
    key="bootstrap",
    commands=("fit", "design"),
    refuse=_refuse,
    parameter_cells=_cells,
    datasets=("theta", "usable", "lower", "upper", "standard_error"),
    attributes=("kind", "block"),
    table=bootstrap_table,
    section=_section,
    sentences=lambda found: [found.note] if found.note else [],
)
