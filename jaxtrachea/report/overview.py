"""What the terminal shows of a fit: compact tables, the worst first where they do not hold all."""

from collections.abc import Iterator

from jaxtrachea.files.table import Table
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.labels import lane_label, outcome, verdict_sentence
from jaxtrachea.inference.rows import listed
from jaxtrachea.measurements.usage_tables import sentences
from jaxtrachea.report import tables
from jaxtrachea.trials.repeats import trial_sentences


def overview(findings: AnalysisResults) -> Iterator[Table | str]:
    """Tables and sentences of a run, in the order in which they are shown."""
    result, profiles = findings.result, findings.profiles
    lanes = listed(result)
    cut = result.lanes > len(lanes)
    if not result.study.free:
        yield f"{result.lanes} fits: {verdict_sentence(result, 0)}"
    elif cut:
        yield tables.spread_table(result, profiles)
    else:
        yield tables.estimate_table(result, lanes, profiles)
    for analysis, found in findings.at("quality"):
        yield from analysis.terminal(found, lanes)
    for analysis, found in findings.found:
        yield from (text.replace("**", "") for text in analysis.warning(found))
    for analysis, found in findings.at("estimates"):
        yield from analysis.terminal(found, lanes)
    yield tables.quality_table(result, lanes)
    for analysis, found in findings.found:
        if analysis.report_section not in ("estimates", "quality"):
            yield from analysis.terminal(found, lanes)
    for lane in lanes if result.study.free and not cut else ():
        yield f"{lane_label(result, lane)}: {verdict_sentence(result, lane, profiles)}"
    if cut and result.study.free:
        yield outcome(result, profiles)
    curves = [c for lane in result.study.curves for c in lane]
    more = trial_sentences(curves, weighed=result.study.weighs_noise)
    for sentence in [*sentences(curves), *more]:
        yield f"{sentence} (curves.csv)"
