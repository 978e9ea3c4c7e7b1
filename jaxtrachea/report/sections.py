"""Sections of the report on influence and on the posterior."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxtrachea.inference.influence import Influence
from jaxtrachea.inference.influence_tables import curve_rows, sample_label, sample_rows, top_samples
from jaxtrachea.inference.posterior import Posterior
from jaxtrachea.inference.results import lane_label, succeeded, unknown_label, write_csv
from jaxtrachea.inference.rows import ONE_BY_ONE, and_more, listed
from jaxtrachea.report.doubts import distrust
from jaxtrachea.report.fit import markdown_table, more_of, number

#: Rows of the tables on influence; the files hold all.
_TOP = 12
#: Change of an estimate, in standard errors, from which a curve is named.
_MOVES = 1.0


def write_more(
    folder: Path, influence: Influence | None, drawn: Posterior | None = None
) -> list[str]:
    """Write the files of what was asked for, and return its sections."""
    parts = []
    if drawn is not None:
        parts += posterior_section(drawn)
    if influence is not None:
        write_csv(folder / "influence.csv", list(sample_rows(influence)))
        write_csv(folder / "influence_curves.csv", list(curve_rows(influence)))
        parts += influence_section(influence)
    return parts


POSTERIOR_HEAD = [
    "specimen", "parameter", "median", "posterior 95 %", "R-hat", "effective draws", "chains",
]  # fmt: skip


def posterior_rows(drawn: Posterior, lanes: Sequence[int]) -> list[list[str]]:
    """Medians, intervals and what they are worth; poor chains have neither median nor interval."""
    result, rows = drawn.result, []
    for lane in lanes:
        grade = drawn.verdict(lane).partition(":")[0]
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            median, low, high = (
                number(float(v[lane, i])) for v in (drawn.median, drawn.lower, drawn.upper)
            )
            rows.append(
                [
                    lane_label(result, lane),
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    "–" if grade == "poor" else median,
                    "–" if grade == "poor" else f"{low} … {high}",
                    number(float(drawn.rhat[lane, i])),
                    number(float(drawn.ess[lane, i]), 3),
                    grade,
                ]
            )
    return rows


def posterior_section(drawn: Posterior) -> list[str]:
    """Medians and intervals of the draws, and whether the chains deserve trust."""
    result = drawn.result
    shown = listed(result)
    chains, draws = drawn.theta.shape[1:3]
    longer = drawn.steps[drawn.steps > draws]
    more = f", {longer.min()} to {longer.max()} in {len(longer)} lanes" if len(longer) else ""
    return [
        "## Posterior",
        markdown_table(POSTERIOR_HEAD, posterior_rows(drawn, shown)),
        *more_of(result, shown, "parameters.csv"),
        f"{chains} chains of {draws} draws (NUTS{more}), priors uniform in scaled coordinates "
        "between the bounds. Good: R-hat up to 1.01, 400 effective draws, nothing divergent. Of "
        "poor chains (R-hat above 1.05, less than 100 effective draws, or more than 2 % divergent) "
        "no interval is given. All draws: `results.h5` (docs/uncertainty.md).",
        *(distrust(drawn) or ["All chains are good."]),
    ]


def influence_head(found: Influence) -> list[str]:
    """Head of `influence_rows`."""
    names = [p.name for p in found.result.study.free]
    return ["specimen", "curve", *(f"{n}: share, left out" for n in names), "Cook"]


def influence_rows(found: Influence, most: int = ONE_BY_ONE) -> list[list[str]]:
    """Curves: all of few; of many those with the largest Cook's distance."""
    return [_curve_row(found, *place) for place in _top_curves(found, most)]


def influence_section(found: Influence) -> list[str]:
    """Which curves and samples the estimates hang on."""
    names = [p.name for p in found.result.study.free]
    table, total = influence_rows(found), sum(map(len, found.result.study.curves))
    more = and_more(total, len(table), "influence_curves.csv")
    parts = [
        "## Influence",
        markdown_table(influence_head(found), table),
        *([f"{more}."] if more else []),
        "Share: part of the variance of an estimate that the noise of this curve makes. Left out: "
        "change of the estimate, in standard errors, if the curve were not there (first order). "
        f"{REASONS} All curves: `influence_curves.csv`.",
        *drivers(found),
    ]
    rows = [_sample_row(found, names, *place) for place in top_samples(found, _TOP)]
    head = ["specimen", "curve", "sample", "leverage", "studentised", "Cook", "moves most"]
    return [
        *parts,
        markdown_table(head, rows),
        "The samples whose loss would move the estimates most; studentised residuals beyond 3 to 4 "
        "are outliers. All samples: `influence.csv` (docs/uncertainty.md).",
    ]


#: What stands in a table of influence where a number cannot be given.
REASONS = (
    "`own`: nobody else tells of this unknown. `needed`: without this curve the others do not "
    "determine all unknowns. `held`: the unknown is on its bound. `undetermined`: it has no "
    "standard error. `no estimate`: the fit failed."
)


def _top_curves(found: Influence, most: int) -> list[tuple[int, int]]:
    """All curves if few; of many those that nothing is known of, then by Cook's distance."""
    curves = found.result.study.curves
    places = [(k, t) for k, of in enumerate(curves) for t in range(len(of))]
    if len(places) <= most:
        return places
    cook = np.nan_to_num(found.of.curve_cook, nan=-1)
    return sorted(places, key=lambda place: -cook[place])[:most]


def _curve_row(found: Influence, lane: int, t: int) -> list[str]:
    curve, of = found.result.study.curves[lane][t], found.of
    cells = [influence_cell(found, lane, t, i) for i in range(of.curve_share.shape[2])]
    cook = float(of.curve_cook[lane, t])
    return [curve.specimen, curve.trial, *cells, number(cook, 2) if np.isfinite(cook) else "–"]


def influence_cell(found: Influence, lane: int, t: int, i: int) -> str:
    """Share and change where the curve is left out, or in one word why there is none."""
    result, of = found.result, found.of
    unknown = int(result.study.lanes.index[lane, t, result.study.free_columns[i]])
    if not succeeded(result, lane):
        return "no estimate"
    if result.at_bound[lane, unknown]:
        return "held"
    share, left = float(of.curve_share[lane, t, i]), float(of.curve_left_out[lane, t, i])
    if np.isnan(share):
        return "undetermined"
    if np.isfinite(left):
        return f"{100 * share:.0f} %, {number(left, 2)}"
    column = result.study.lanes.index[lane][:, result.study.free_columns[i]]
    return f"{100 * share:.0f} %, {'own' if np.sum(column == unknown) == 1 else 'needed'}"


def _sample_row(found: Influence, names: Sequence[str], lane: int, t: int, e: int) -> list[str]:
    curve, of = found.result.study.curves[lane][t], found.of
    moves = of.left_out[lane, t, :, e]
    most = "–"
    if np.isfinite(moves).any():
        i = int(np.nanargmax(np.abs(moves)))
        most = f"{names[i]} by {moves[i]:+.2g} std. errors"
    numbers = (of.leverage[lane, t, e], found.external[lane, t, e], of.cook[lane, t, e])
    where = sample_label(found, lane, t, e)
    return [curve.specimen, curve.trial, where, *(number(float(v), 2) for v in numbers), most]


def drivers(found: Influence) -> list[str]:
    """In words: the curve whose loss moves each parameter most, where it moves it by much."""
    names = [p.name for p in found.result.study.free]
    said, moves = [], np.abs(np.nan_to_num(found.of.curve_left_out))
    for i, name in enumerate(names):
        lane, t = np.unravel_index(int(np.argmax(moves[:, :, i])), moves.shape[:2])
        if moves[lane, t, i] >= _MOVES:
            curve, by = found.result.study.curves[lane][t], found.of.curve_left_out[lane, t, i]
            said.append(f"- {name}: {curve.specimen} {curve.trial} ({by:+.2g} standard errors)")
    lead = "Estimates that hang on one curve, by more than a standard error:"
    return [lead, "\n".join(said)] if said else []
