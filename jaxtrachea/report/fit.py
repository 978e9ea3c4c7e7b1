"""The written report of a fit."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.labels import (
    NOTHING_FITTED,
    determined_unknowns,
    lane_label,
    outcome,
    succeeded,
    verdict_sentence,
)
from jaxtrachea.inference.residuals import where_missed, worst
from jaxtrachea.inference.rows import ONE_BY_ONE, and_more, listed, over_peak
from jaxtrachea.measurements.curve import BadCurve
from jaxtrachea.measurements.usage_tables import bad_table
from jaxtrachea.report.captions import captions
from jaxtrachea.report.tables import estimate_table, quality_table, spread_table


def report_text(
    title: str,
    findings: AnalysisResults,
    bad: Sequence[BadCurve],
    data: Sequence[str] = (),
    understood: Sequence[str] = (),
) -> str:
    """The whole report.md."""
    result = findings.result
    failed = [k for k in range(result.lanes) if not succeeded(result, k)]
    parts = [
        f"# {title or 'Fit'}",
        *_verdict(findings, len(bad)),
        "A fit is of one specimen, or of one curve. How to read this report: docs/read_a_fit.md. "
        "All numbers: `results.h5`; one row per fit: `summary.csv`; one row per estimate: "
        "`parameters.csv` (docs/results.md).",
        *(["\n".join(f"- {line}." for line in understood)] if understood else []),
        "## Pictures",
        *(f"![{text}]({name}.png)" for name, text in captions(result).items()),
        *_estimates(findings),
        *_sections(findings, "estimates"),
        "## Quality",
        *_quality(result, failed),
        f"Largest residual: {worst(result.residuals, result)}.",
        *_sections(findings, "quality"),
        *_bounds(result),
        *_sections(findings, "checks"),
        *data,
        *_sections(findings, "data"),
    ]
    if bad:
        table = bad_table(bad)
        parts += [f"## {table.title}", *table.paragraphs()]
    return "\n\n".join(parts) + "\n"


def _verdict(findings: AnalysisResults, bad: int) -> list[str]:
    """Whether it was solved, and the worst misfit; a mark for good, fair, poor before each."""
    result = findings.result
    solved = [k for k in range(result.lanes) if succeeded(result, k)]
    every = all(
        determined_unknowns(result, k, findings.profiles) == len(result.study.unknowns[k])
        for k in solved
    )
    mark = "✗" if len(solved) < result.lanes else "✓" if every and not bad else "⚠"
    said = [f"{mark} **{outcome(result, findings.profiles)}; {bad} curves could not be used.**"]
    share = np.where(result.succeeded, over_peak(result), np.nan)
    if not np.isfinite(share).any():
        return said
    lane, beyond = int(np.nanargmax(share)), result.misfit
    grown = np.any(beyond.flagged & (beyond.ratio > 1))
    mark = "✗" if result.effective.misses.any() else "⚠" if grown else "✓"
    return [
        *said,
        f"{mark} **Worst misfit: {100 * share[lane]:.2g} % of the peak** (root mean square) of "
        f"{lane_label(result, lane)}; {where_missed(result, lane)}.",
    ]


def _sections(findings: AnalysisResults, place: str) -> list[str]:
    """Sections of the analyses that have theirs at this place."""
    lanes = listed(findings.result)
    return [
        text for analysis, found in findings.at(place) for text in analysis.report(found, lanes)
    ]


def _estimates(findings: AnalysisResults) -> list[str]:
    """Values with their errors, and what the data leave open."""
    result, profiles = findings.result, findings.profiles
    shown = listed(result)
    tables = estimate_table(result, shown, profiles).paragraphs()
    if result.lanes > len(shown):
        tables = [spread_table(result, profiles).markdown(), *tables]
    if not result.study.free:
        tables = [f"None: {NOTHING_FITTED}."]
    fixed = [f"{p.name} = {p.value:g} {p.unit}" for p in result.study.parameters if p.fixed]
    if not result.study.free:
        return ["## Estimates", *tables, f"Fixed: {', '.join(fixed)}."]
    flat = [f"- {lane_label(result, k)}: {verdict_sentence(result, k, profiles)}." for k in shown]
    more = and_more(result.lanes, len(shown), "summary.csv")
    return [
        "## Estimates",
        *tables,
        *(text for analysis, found in findings.found for text in analysis.warning(found)),
        f"Fixed: {', '.join(fixed) or 'none'}.",
        "## What the data determine",
        "\n".join(flat),
        *([f"{more}."] if more else []),
        "Identifiable: relative error up to 10 %; weak: up to 50 %; practically non-identifiable: "
        "more, or open on a side (limited by a bound, where that is said); structurally "
        "non-identifiable: no data from these contact points can tell, however exact; "
        "inconclusive: the local error is in doubt and the profile could not be followed to its "
        "end, or the model misses the curve. Where there is cause, intervals are those of profile "
        "likelihood and of all other minima found; else of the local standard error "
        "(Gauss-Newton). Both are "
        "for as many samples as are independent. Neither says anything of what the model leaves "
        "out where the curves do not show it. Medians and populations are of identifiable and "
        "weak estimates.",
    ]


def _quality(result: FitResult, failed: list[int]) -> list[str]:
    """Lanes one by one: of many those that failed (50 at most), then the worst."""
    shown = listed(result, max(ONE_BY_ONE, min(len(failed), 50)))
    legend = (
        "iter: iterations; n: samples; rms F: root mean square residual of the force; of peak: the "
        "same over the largest force; rms joints: of the markers; cond: condition number of the "
        "Jacobian; AICc: to compare models of the same data."
    )
    return [*quality_table(result, shown).paragraphs(), legend]


def _bounds(result: FitResult) -> list[str]:
    """That errors leave out the unknowns that ended on a bound."""
    bound = np.flatnonzero(result.at_bound.any(axis=1))
    if not len(bound):
        return []
    return [
        f"In {len(bound)} of {result.lanes} fits an unknown ended on its bound. The errors of "
        "the other unknowns there hold it fixed: they do not include its own uncertainty."
    ]
