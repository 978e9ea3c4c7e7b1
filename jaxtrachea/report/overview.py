"""What the terminal shows of a fit: compact tables, the worst first where they do not hold all."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxtrachea.fit.predictions import predictions, rms
from jaxtrachea.inference.cross_validation import LeftOut
from jaxtrachea.inference.effective import CORRELATED, effective
from jaxtrachea.inference.results import lane_label, succeeded, verdict_sentence
from jaxtrachea.inference.rows import and_more, listed
from jaxtrachea.measurements.usage_tables import sentences
from jaxtrachea.report import fit as report
from jaxtrachea.report import sections
from jaxtrachea.report.doubts import distrust

#: Title, head and rows of a table.
Table = tuple[str, list[str], list[list[str]]]


def overview(found: Any) -> Iterator[Table | str]:
    """Tables and sentences of a run, in the order in which they are shown.

    Args:
        found: what the run has computed (`cli_run.Found`).
    """
    result, lanes = found.result, listed(found.result)
    cut = result.lanes > len(lanes)
    wide = effective(result, predictions(result.study, result.theta), found.profiles)
    if not result.study.free:
        yield f"{result.lanes} lanes: {verdict_sentence(result, 0)}"
    elif cut:
        spread = report.spread_rows(result, found.profiles)
        yield "Estimates over lanes", report.SPREAD_HEAD, spread
    else:
        widened = wide if np.any(wide.correlation > CORRELATED) else None
        head = report.ESTIMATE_HEAD if widened is None else report.WIDENED_HEAD
        yield "Estimates", head, report.estimate_rows(result, lanes, found.profiles, widened)
    doubted = int(np.sum(wide.correlation > CORRELATED))
    if doubted and result.study.free:
        yield (
            f"Neighbouring residuals are correlated in {doubted} of {result.lanes} lanes: standard "
            "errors are too small there; wider intervals: low95_widened, high95_widened in "
            "parameters.csv"
        )
    if found.posterior is not None:
        yield from (text.replace("**", "") for text in distrust(found.posterior))
    if found.population is not None:
        yield "Population", report.POPULATION_HEAD, report.population_table(found.population)
    yield "Quality", report.QUALITY_HEAD, report.quality_rows(result, lanes)
    yield from _more(result.lanes, len(lanes), "summary.csv")
    yield from _further(found, lanes)
    for lane in lanes if result.study.free and not cut else ():
        yield f"{lane_label(result, lane)}: {verdict_sentence(result, lane, found.profiles)}"
    if cut and result.study.free:
        good = sum(succeeded(result, lane) for lane in range(result.lanes))
        yield f"{good} of {result.lanes} lanes succeeded"
    for sentence in sentences([c for curves in result.study.curves for c in curves]):
        yield f"{sentence} (curves.csv)"


def _further(found: Any, lanes: list[int]) -> Iterator[Table | str]:
    """What was asked for besides the fit."""
    total = found.result.lanes
    tables: list[Table] = []
    if found.profiles is not None:
        rows = report.profile_table(found.profiles, lanes)
        tables.append(("Profile likelihood", report.PROFILE_HEAD, rows))
    if found.resampled is not None:
        rows = report.bootstrap_table(found.resampled, lanes)
        tables.append(("Bootstrap", report.BOOTSTRAP_HEAD, rows))
    if found.posterior is not None:
        rows = sections.posterior_rows(found.posterior, lanes)
        tables.append(("Posterior", sections.POSTERIOR_HEAD, rows))
    for each in tables:
        yield each
        yield from _more(total, len(lanes), "parameters.csv")
    if found.left_out is not None:
        yield from _left_out(found.result, found.left_out)
    if found.influence is not None:
        curves = sum(map(len, found.result.study.curves))
        rows = sections.influence_rows(found.influence)
        yield "Influence of curves", sections.influence_head(found.influence), rows
        yield from _more(curves, len(rows), "influence_curves.csv")
        said = "\n".join(sections.drivers(found.influence))
        yield from ([said] if said else [])


def _left_out(result, left_out: LeftOut) -> Iterator[Table | str]:
    """Curves left out, of many the worst first, and their root mean square."""
    rows, further = report.left_out_table(result, left_out)
    yield "Leaving one curve out", report.LEFT_OUT_HEAD, rows
    yield from ([further] if further else [])
    if left_out.sentence:
        yield left_out.sentence
    if not np.isfinite(rms(left_out.force)):
        yield "no curve left out could be predicted"


def _more(total: int, shown: int, file: str) -> Iterator[str]:
    text = and_more(total, shown, file)
    if text:
        yield text
