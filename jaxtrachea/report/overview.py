"""What the terminal shows of a fit: compact tables, the worst first where they do not hold all."""

from collections.abc import Iterator

from jaxtrachea.inference.analysis import Findings, Table
from jaxtrachea.inference.labels import lane_label, outcome, verdict_sentence
from jaxtrachea.inference.rows import and_more, listed
from jaxtrachea.measurements.usage_tables import sentences
from jaxtrachea.report import tables
from jaxtrachea.trials.repeats import trial_sentences


def overview(findings: Findings) -> Iterator[Table | str]:
    """Tables and sentences of a run, in the order in which they are shown.

    Args:
        findings: the fit, and what its analyses have found.
    """
    result, profiles = findings.result, findings.profiles
    lanes = listed(result)
    cut = result.lanes > len(lanes)
    if not result.study.free:
        yield f"{result.lanes} fits: {verdict_sentence(result, 0)}"
    elif cut:
        yield "Estimates over fits", tables.SPREAD_HEAD, tables.spread_rows(result, profiles)
    else:
        yield "Estimates", tables.ESTIMATE_HEAD, tables.estimate_rows(result, lanes, profiles)
    for analysis, found in findings.at("quality"):
        yield from analysis.shown(found, lanes)
    for analysis, found in findings.found:
        yield from (text.replace("**", "") for text in analysis.warning(found))
    for analysis, found in findings.at("estimates"):
        yield from analysis.shown(found, lanes)
    yield "Quality", tables.QUALITY_HEAD, tables.quality_rows(result, lanes)
    yield from and_more(result.lanes, len(lanes), "summary.csv")
    for analysis, found in findings.found:
        if analysis.place not in ("estimates", "quality"):
            yield from analysis.shown(found, lanes)
    for lane in lanes if result.study.free and not cut else ():
        yield f"{lane_label(result, lane)}: {verdict_sentence(result, lane, profiles)}"
    if cut and result.study.free:
        yield outcome(result, profiles)
    curves = [c for lane in result.study.curves for c in lane]
    more = trial_sentences(curves, weighed=result.study.weighs_noise)
    for sentence in [*sentences(curves), *more]:
        yield f"{sentence} (curves.csv)"
