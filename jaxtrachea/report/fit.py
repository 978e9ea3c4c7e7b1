"""Tables, plots and the written report of a fit."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.fit.evaluate import NOTHING_FITTED
from jaxtrachea.fit.parameters import OF_THE_PRESS
from jaxtrachea.fit.predictions import Prediction, rms
from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.bootstrap import FEWEST, Bootstrap
from jaxtrachea.inference.cross_validation import LeftOut
from jaxtrachea.inference.effective import CORRELATED, Effective, effective
from jaxtrachea.inference.judgement import DETERMINED, judgement, verdict_of, within_bounds
from jaxtrachea.inference.population import Population, population_rows
from jaxtrachea.inference.posterior import Posterior
from jaxtrachea.inference.profile import Profiles
from jaxtrachea.inference.results import (
    is_own,
    lane_label,
    peak_force,
    said_before,
    succeeded,
    unknown_label,
    verdict_sentence,
)
from jaxtrachea.inference.rows import ONE_BY_ONE, and_more, listed
from jaxtrachea.measurements.read import BadCurve
from jaxtrachea.report.doubts import distrust, doubts
from jaxtrachea.status import FitStatus, ProfileEnd


def number(value: float, digits: int = 4) -> str:
    """A number for people: `digits` significant ones, a dash for NaN."""
    return "–" if np.isnan(value) else f"{value:.{digits}g}"


def estimate_rows(
    result: FitResult,
    lanes: Sequence[int],
    profiles: Profiles | None = None,
    wide: Effective | None = None,
) -> list[list[str]]:
    """Lane, parameter, value, standard error, 95 % interval, if given widened, verdict."""
    rows = []
    for lane in lanes:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            if said_before(result, lanes, lane, i):
                continue
            judged = judgement(result, lane, i, profiles)
            rows.append(
                [
                    lane_label(result, lane) if is_own(result, lane, i) else "(all)",
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    number(result.value[lane, i]),
                    number(result.standard_error[lane, i], 2),
                    interval(judged.low, judged.high, log=p.scale == "log"),
                    *([] if wide is None else [_widened(wide, lane, i, log=p.scale == "log")]),
                    judged.verdict,
                ]
            )
    return rows


def _widened(wide: Effective, lane: int, i: int, *, log: bool) -> str:
    """The interval as it is with the samples that correlated ones are worth."""
    return interval(float(wide.lower[lane, i]), float(wide.upper[lane, i]), log=log)


ESTIMATE_HEAD = ["specimen", "parameter", "value", "std. error", "95 % interval", "verdict"]
#: Likewise, with intervals for correlated residuals.
WIDENED_HEAD = [*ESTIMATE_HEAD[:-1], "95 % widened", ESTIMATE_HEAD[-1]]


def spread_rows(result: FitResult, profiles: Profiles | None = None) -> list[list[str]]:
    """Parameter, estimates determined of all, their median, quartiles and median error, and share.

    Determined: identifiable or weak; a median of others would say nothing.
    """
    columns: dict[str, list[tuple[float, float, str]]] = {}
    units: dict[str, str] = {}
    good = [k for k in range(result.lanes) if succeeded(result, k)]
    for lane in good:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            if said_before(result, good, lane, i):
                continue
            verdict = verdict_of(result, lane, i, profiles)
            press = p.name in OF_THE_PRESS and p.scale == "linear"
            error = result.standard_error if press else result.relative_se
            if press:
                units[f"{p.name} [{p.unit}]"] = p.unit
            entry = (float(result.value[lane, i]), float(error[lane, i]), verdict)
            columns.setdefault(f"{p.name} [{p.unit}]", []).append(entry)
    rows = []
    for name, entries in columns.items():
        told = np.array([e[:2] for e in entries if e[2] in DETERMINED]).reshape(-1, 2)
        count = f"{len(told)} of {len(entries)}"
        if not len(told):
            rows.append([name, count, "–", "–", "–", "0 %"])
            continue
        low, mid, high = np.quantile(told[:, 0], [0.25, 0.5, 0.75])
        middle, unit = float(np.median(told[:, 1])), units.get(name)
        error = f"{middle:.2g} {unit}" if unit else f"{100 * middle:.2g} %"
        share = f"{100 * np.mean([e[2] == 'identifiable' for e in entries]):.0f} %"
        rows.append([name, count, number(mid), f"{number(low)} … {number(high)}", error, share])
    return rows


SPREAD_HEAD = ["parameter", "determined", "median", "quartiles", "error", "identifiable"]


def quality_rows(result: FitResult, lanes: Sequence[int]) -> list[list[str]]:
    """Lane, status, iterations, samples, rms residuals, condition number."""
    rows = []
    for lane in lanes:
        peak = peak_force(result, lane)
        status = FitStatus(int(result.status[lane]))
        rows.append(
            [
                lane_label(result, lane),
                status.name.lower().replace("_", " "),
                str(int(result.iterations[lane])),
                str(int(result.samples[lane])),
                f"{number(result.rms[lane, 0], 3)} N",
                f"{100 * result.rms[lane, 0] / peak:.2g} %" if peak > 0 else "–",
                f"{number(result.rms[lane, 1], 3)} mm" if np.isfinite(result.rms[lane, 1]) else "–",
                number(float(result.uncertainty.condition[lane]), 2),
                number(float(result.criteria.AICc[lane]), 5),
            ]
        )
    return rows


QUALITY_HEAD = [
    "specimen",
    "outcome",
    "iter",
    "n",
    "rms F",
    "of peak",
    "rms joints",
    "cond",
    "AICc",
]
LEFT_OUT_HEAD = ["specimen", "left out", "force / model", "rms force / peak", "rms joints / D"]


def left_out_rows(result: FitResult, left_out: LeftOut) -> list[list[str]]:
    """Specimen, curve left out, its errors; the last row is the root mean square."""
    rows = []
    errors = (left_out.ratio, left_out.force, left_out.joints)
    for k, t, *values in zip(left_out.lane, left_out.trial, *errors, strict=True):
        curve = result.study.curves[k][t]
        rows.append([curve.specimen, curve.trial, *map(_percent, values)])
    mean = [float(rms(v)) for v in errors]
    return [*rows, ["(root mean square)", "", *map(_percent, mean)]]


def left_out_table(result: FitResult, left_out: LeftOut) -> tuple[list[list[str]], str]:
    """Rows of `left_out_rows` for people, and what follows: of many the worst, worst first."""
    *rows, mean = left_out_rows(result, left_out)
    if len(rows) <= ONE_BY_ONE:
        return [*rows, mean], ""
    order = np.argsort(-np.nan_to_num(left_out.force, nan=np.inf), kind="stable")
    worst = [rows[k] for k in order[:ONE_BY_ONE]]
    return [*worst, mean], and_more(len(rows), len(worst), "left_out.csv")


def _percent(value: float) -> str:
    return "–" if np.isnan(value) else f"{100 * value:.2f} %"


def own_touch_sentence(result: FitResult, which: str) -> list[str]:
    """That a curve left out has an onset or an offset fitted to itself; empty where it has none."""
    own = [p.name for p in result.study.free if p.scope == "trial" and p.name in OF_THE_PRESS]
    if not own:
        return []
    return [
        f"{which} fits its own {' and '.join(own)}; all other unknowns are those of the others."
    ]


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""

    def line(cells):
        plain = (" ".join(str(cell).split()).replace("|", "\\|") for cell in cells)
        return f"| {' | '.join(plain)} |"

    return "\n".join([line(head), line(["---"] * len(head)), *map(line, rows)])


def report_text(
    title: str,
    result: FitResult,
    bad: Sequence[BadCurve],
    prediction: Prediction,
    left_out: LeftOut | None,
    profiles: Profiles | None = None,
    resampled: Bootstrap | None = None,
    more: Sequence[str] = (),
    population: Population | None = None,
    drawn: Posterior | None = None,
) -> str:
    """The whole report.md; `more`: further sections, before the figures."""
    failed = [k for k in range(result.lanes) if not succeeded(result, k)]
    wide = effective(result, prediction, profiles)
    parts = [
        f"# {title or 'Fit'}",
        f"{result.lanes} lanes, {result.lanes - len(failed)} succeeded, {len(failed)} failed; "
        f"{len(bad)} curves could not be used. All numbers: `results.h5`; one row per lane: "
        "`summary.csv`; one row per estimate: `parameters.csv` (docs/results.md).",
        *_estimates(result, profiles, wide, drawn),
        *([] if population is None else _sampled(population)),
        "## Quality",
        *_quality(result, failed),
        f"Largest residual: {prediction.worst(result)}.",
        *doubts(result, wide),
    ]
    if profiles is not None:
        parts += _profiled(profiles)
    if resampled is not None:
        parts += _bootstrapped(resampled)
    if left_out is not None:
        rows, further = left_out_table(result, left_out)
        parts += ["## Leaving one curve out", markdown_table(LEFT_OUT_HEAD, rows)]
        parts += [f"{further}."] if further else []
        parts += own_touch_sentence(result, "A curve left out")
        parts += [f"{left_out.sentence}."] if left_out.sentence else []
    parts += more
    names = {"fit": "data and fit", "residuals": "residuals"}
    names |= {"correlation": "correlation"} if result.study.free else {}
    parts += [f"![{text}]({name}.png)" for name, text in names.items()]
    if bad:
        rows = [[b.specimen, b.trial, b.kind, b.message, b.cure] for b in bad]
        head = ["specimen", "trial", "kind", "what", "cure"]
        parts += ["## Curves that could not be used", markdown_table(head, rows)]
    return "\n\n".join(parts) + "\n"


def _estimates(
    result: FitResult, profiles: Profiles | None, wide: Effective, drawn: Posterior | None
) -> list[str]:
    """Values with their errors, and what the data leave open."""
    shown = listed(result)
    widened = wide if np.any(wide.correlation > CORRELATED) else None
    head = ESTIMATE_HEAD if widened is None else WIDENED_HEAD
    rows = estimate_rows(result, shown, profiles, widened)
    tables = [markdown_table(head, rows), *more_of(result, shown, "parameters.csv")]
    if result.lanes > len(shown):
        tables = [markdown_table(SPREAD_HEAD, spread_rows(result, profiles)), *tables]
    if not result.study.free:
        tables = [f"None: {NOTHING_FITTED}."]
    fixed = [f"{p.name} = {p.value:g} {p.unit}" for p in result.study.parameters if p.fixed]
    if not result.study.free:
        return ["## Estimates", *tables, f"Fixed: {', '.join(fixed)}."]
    flat = [f"- {lane_label(result, k)}: {verdict_sentence(result, k, profiles)}." for k in shown]
    return [
        "## Estimates",
        *tables,
        *([] if drawn is None else distrust(drawn)),
        f"Fixed: {', '.join(fixed) or 'none'}.",
        "## What the data determine",
        "\n".join(flat),
        *more_of(result, shown, "summary.csv"),
        "Identifiable: relative error up to 10 %; weak: up to 50 %; practically non-identifiable: "
        "more, or open on a side; structurally non-identifiable: no data from these contact points "
        "can tell, however exact; not shown: there was cause to doubt the local error, and the "
        "profile could not be followed to its end. Where there is cause, intervals are those of "
        "profile likelihood and of all other minima found; else of the local standard error "
        "(Gauss-Newton). Neither says anything of what the model leaves out. Medians and "
        "populations are of identifiable and weak estimates.",
    ]


def more_of(result: FitResult, shown: Sequence[int], file: str) -> list[str]:
    """A paragraph that says how many lanes a table leaves out; none if it holds all."""
    text = and_more(result.lanes, len(shown), file)
    return [f"{text}."] if text else []


POPULATION_HEAD = ["parameter", "n", "left out", "mean", "95 % interval", "spread", "95 % interval"]


def population_table(population: Population) -> list[list[str]]:
    """Parameter, specimens, mean and its interval, spread between specimens and its interval."""
    rows = []
    for row in population_rows(population):
        sign = "× / " if row["spread_is"] == "factor" else "± "
        cell = {k: number(v) for k, v in row.items() if isinstance(v, float)}
        rows.append(
            [
                f"{row['parameter']} [{row['unit']}]",
                str(row["specimens"]),
                str(row["left_out"]),
                cell["mean"],
                f"{cell['mean_low95']} … {cell['mean_high95']}",
                f"{sign}{cell['spread']}",
                f"{cell['spread_low95']} … {cell['spread_high95']}",
            ]
        )
    return rows


def _sampled(population: Population) -> list[str]:
    """The section on the population."""
    return [
        "## Population",
        markdown_table(POPULATION_HEAD, population_table(population)),
        "The specimens as a sample, those whose estimate is identifiable or weak: their errors are "
        "taken out of the spread between them. Spread: one standard deviation, with scale `log` as "
        "a factor, and the mean is then the geometric one. Estimates drawn towards the mean by "
        "what they are uncertain: `shrunk` in `parameters.csv`; all numbers: `population.csv` "
        "(docs/joint.md).",
    ]


PROFILE_HEAD = ["specimen", "parameter", "value", "profile 95 %", "local 95 %", "ends"]


def interval(low: float, high: float, *, log: bool) -> str:
    """An interval for people; open sides are left out."""
    open_low, open_high = low == (0 if log else -np.inf), high == np.inf
    if open_low and open_high:
        return "anything"
    if open_low or open_high:
        return f"up to {number(high)}" if open_low else f"from {number(low)}"
    return "–" if np.isnan(low) and np.isnan(high) else f"{number(low)} … {number(high)}"


def profile_table(profiles: Profiles, lanes: Sequence[int]) -> list[list[str]]:
    """Lane, parameter, value, interval by profile and by standard error, how the profile ends."""
    result, rows = profiles.result, []
    place = {lane: n for n, lane in enumerate(lanes)}
    pairs = [(k, lane, i) for k, (lane, i) in enumerate(profiles.pairs) if lane in place]
    for k, lane, i in sorted(pairs, key=lambda pair: place[pair[1]]):
        p = result.study.unknowns[lane][i][0]
        low, high = (ProfileEnd(int(e)).name.lower() for e in profiles.end[k])
        local = (float(v[lane, i]) for v in (result.lower, result.upper))
        local = within_bounds(result, lane, i, *local)
        rows.append(
            [
                lane_label(result, lane),
                f"{unknown_label(result, lane, i)} [{p.unit}]",
                number(float(result.value[lane, i])),
                interval(profiles.lower[k], profiles.upper[k], log=p.scale == "log"),
                interval(*local, log=p.scale == "log"),
                low if low == high else f"{low}, {high}",
            ]
        )
    return rows


def _profiled(profiles: Profiles) -> list[str]:
    """The section on profile likelihood."""
    result = profiles.result
    shown = listed(result)
    count = lambda end: int(np.sum((profiles.end == end).any(axis=1)))  # noqa: E731
    parts = [
        "## Profile likelihood",
        markdown_table(PROFILE_HEAD, profile_table(profiles, shown)),
        *more_of(result, shown, "parameters.csv"),
        f"{len(profiles.lane)} profiles: {count(ProfileEnd.OPEN)} open on a side (the data do not "
        f"limit the parameter there), {count(ProfileEnd.BOUND)} limited only because another "
        f"unknown is on its bound, {count(ProfileEnd.FAILED)} failed. All other unknowns are "
        "fitted anew at every point; points: `profiles.csv` (docs/uncertainty.md).",
    ]
    better = np.flatnonzero(profiles.improved)
    if len(better):
        names = sorted({lane_label(result, int(profiles.lane[k])) for k in better})
        parts.append(
            f"**A profile found a better fit than the fit itself** ({', '.join(names[:20])}): "
            "these intervals are wrong. Fit again with more starts."
        )
    return [*parts, "![profiles](profiles.png)"] if len(profiles.lane) else parts


BOOTSTRAP_HEAD = ["specimen", "parameter", "value", "std. error", "local", "95 % of replicates"]


def bootstrap_table(resampled: Bootstrap, lanes: Sequence[int]) -> list[list[str]]:
    """Lane, parameter, value, standard error by bootstrap and local, percentile interval."""
    result, rows = resampled.result, []
    for lane in lanes:
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            low, high = float(resampled.lower[lane, i]), float(resampled.upper[lane, i])
            rows.append(
                [
                    lane_label(result, lane),
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    number(result.value[lane, i]),
                    number(resampled.standard_error[lane, i], 2),
                    number(result.standard_error[lane, i], 2),
                    "–" if np.isnan(low) else f"{number(low)} … {number(high)}",
                ]
            )
    return rows


def _bootstrapped(resampled: Bootstrap) -> list[str]:
    """The section on the bootstrap."""
    shown = listed(resampled.result)
    lost = int(np.sum(~resampled.usable))
    blocks = f" in blocks of {resampled.block} samples" if resampled.block > 1 else ""
    return [
        "## Bootstrap",
        markdown_table(BOOTSTRAP_HEAD, bootstrap_table(resampled, shown)),
        *more_of(resampled.result, shown, "parameters.csv"),
        f"{resampled.usable.shape[1]} replicates of every lane ({resampled.kind}{blocks}); "
        f"{lost} of {resampled.usable.size} refits did not converge and are left out; a lane with "
        f"fewer than {FEWEST} others has no interval. All numbers: `results.h5` "
        "(docs/uncertainty.md).",
    ]


def _quality(result: FitResult, failed: list[int]) -> list[str]:
    """Lanes one by one: of many those that failed (50 at most), then the worst."""
    shown = listed(result, max(ONE_BY_ONE, min(len(failed), 50)))
    table = markdown_table(QUALITY_HEAD, quality_rows(result, shown))
    return [table, *more_of(result, shown, "summary.csv")]
