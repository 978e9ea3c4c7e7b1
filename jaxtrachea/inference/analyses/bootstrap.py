"""The bootstrap in tables, report and results.h5."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.tables import markdown_table, number
from jaxtrachea.fitting.result import unknown_label
from jaxtrachea.inference.analysis import Analysis, Cells, Findings, Progress, Request, Table
from jaxtrachea.inference.bootstrap import FEWEST, Bootstrap, bootstrap, check_block
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.rows import and_more, listed, more_of

BOOTSTRAP_HEAD = ["specimen", "parameter", "value", "std. error", "local", "95 % of replicates"]


def _refuse(request: Request) -> None:
    try:
        check_block(request.study, request.spec.uncertainty.block)
    except ValueError as error:
        raise SpecError(f"uncertainty.block: {error}") from None


def _compute(request: Request, findings: Findings, progress: Progress) -> Bootstrap:
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


def _datasets(group, found: Bootstrap) -> None:
    group.attrs["kind"], group.attrs["block"] = found.kind, found.block
    for name in ("theta", "usable", "lower", "upper", "standard_error"):
        group.create_dataset(name, data=getattr(found, name), compression="gzip")


def bootstrap_table(found: Bootstrap, lanes: Sequence[int]) -> list[list[str]]:
    """Lane, parameter, value, standard error by bootstrap and local, percentile interval."""
    result, rows = found.result, []
    for lane in lanes:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            low, high = float(found.lower[lane, i]), float(found.upper[lane, i])
            rows.append(
                [
                    lane_label(result, lane),
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    number(result.value[lane, i]),
                    number(found.standard_error[lane, i], 2),
                    number(result.standard_error[lane, i], 2),
                    "–" if np.isnan(low) else f"{number(low)} … {number(high)}",
                ]
            )
    return rows


def _section(found: Bootstrap) -> list[str]:
    """The section on the bootstrap."""
    shown = listed(found.result)
    lost = int(np.sum(~found.usable))
    blocks = f" in blocks of {found.block} samples" if found.block > 1 else ""
    return [
        "## Bootstrap",
        markdown_table(BOOTSTRAP_HEAD, bootstrap_table(found, shown)),
        *more_of(found.result, shown, "parameters.csv"),
        f"{found.usable.shape[1]} replicates of every lane ({found.kind}{blocks}); "
        f"{lost} of {found.usable.size} refits did not converge and are left out; a lane with "
        f"fewer than {FEWEST} others has no interval. All numbers: `results.h5` "
        "(docs/read_a_fit.md).",
        *([f"{found.note}."] if found.note else []),
    ]


def _shown(found: Bootstrap, lanes: list[int]) -> Iterator[Table | str]:
    yield "Bootstrap", BOOTSTRAP_HEAD, bootstrap_table(found, lanes)
    yield from and_more(found.result.lanes, len(lanes), "parameters.csv")
    if found.note:
        yield found.note


BOOTSTRAP = Analysis(
    name="bootstrap",
    after="profiles",
    compute=_compute,
    work="resampling",
    key="bootstrap",
    commands=("fit", "design"),
    refuse=_refuse,
    parameter_cells=_cells,
    datasets=_datasets,
    section=_section,
    shown=_shown,
)
