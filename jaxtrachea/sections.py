"""Sections of the report on influence and on the posterior."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxtrachea.identify.influence import Influence
from jaxtrachea.identify.influence_tables import (
    curve_rows,
    sample_label,
    sample_rows,
    top_samples,
)
from jaxtrachea.identify.posterior import Posterior
from jaxtrachea.identify.results import lane_label, unknown_label, write_csv
from jaxtrachea.report import ONE_BY_ONE, markdown_table, number

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


def posterior_section(drawn: Posterior) -> list[str]:
    """Medians and intervals of the draws, and whether the chains deserve trust."""
    result, rows = drawn.result, []
    shown = range(min(result.lanes, ONE_BY_ONE))
    for lane in shown:
        for i, (p, _, _) in enumerate(result.problem.unknowns[lane]):
            ends = (number(float(v[lane, i])) for v in (drawn.lower, drawn.upper))
            rows.append(
                [
                    lane_label(result, lane),
                    f"{unknown_label(result, lane, i)} [{p.unit}]",
                    number(float(drawn.median[lane, i])),
                    " … ".join(ends),
                    number(float(drawn.rhat[lane, i])),
                    number(float(drawn.ess[lane, i]), 3),
                ]
            )
    words = {lane: drawn.verdict(lane) for lane in range(result.lanes)}
    bad = [k for k, text in words.items() if not text.startswith("good")]
    said = "\n".join(f"- {lane_label(result, k)}: {words[k]}" for k in bad[:ONE_BY_ONE])
    chains, draws = drawn.theta.shape[1:3]
    head = ["specimen", "parameter", "median", "posterior 95 %", "R-hat", "effective draws"]
    lead = f"**{len(bad)} of {result.lanes} lanes have chains not to be trusted as they are:**"
    return [
        "## Posterior",
        markdown_table(head, rows),
        f"{chains} chains of {draws} draws (NUTS), priors uniform in scaled coordinates between "
        "the bounds. Good: R-hat up to 1.01, 400 effective draws, nothing divergent. All draws: "
        "`results.h5` (docs/uncertainty.md).",
        *([lead, said] if bad else ["All chains are good."]),
    ]


def influence_section(found: Influence) -> list[str]:
    """Which curves and samples the estimates hang on."""
    names = [p.name for p in found.result.problem.free]
    head = ["specimen", "curve", *(f"{n}: share, left out" for n in names), "Cook"]
    places = _top_curves(found)
    parts = [
        "## Influence",
        markdown_table(head, [_curve_row(found, *place) for place in places]),
        "Share: part of the variance of an estimate that the noise of this curve makes. Left out: "
        "change of the estimate, in standard errors, if the curve were not there (first order; a "
        "dash: the others do not determine it, or it belongs to the curve alone and goes with it, "
        "as an onset does). All curves: `influence_curves.csv`.",
        *_drivers(found, names),
    ]
    rows = [_sample_row(found, names, *place) for place in top_samples(found, _TOP)]
    head = ["specimen", "curve", "sample", "leverage", "studentised", "Cook", "moves most"]
    return [
        *parts,
        markdown_table(head, rows),
        "The samples whose loss would move the estimates most; studentised residuals beyond 3 to 4 "
        "are outliers. All samples: `influence.csv` (docs/uncertainty.md).",
    ]


def _top_curves(found: Influence) -> list[tuple[int, int]]:
    """All curves of few lanes; of many those with the largest Cook's distance."""
    curves = found.result.problem.curves
    places = [(k, t) for k, of in enumerate(curves) for t in range(len(of))]
    if len(places) <= ONE_BY_ONE:
        return places
    cook = np.nan_to_num(found.of.curve_cook, nan=-1)
    return sorted(places, key=lambda place: -cook[place])[:_TOP]


def _curve_row(found: Influence, lane: int, t: int) -> list[str]:
    curve, of = found.result.problem.curves[lane][t], found.of
    cells = [
        "–" if np.isnan(share) else f"{100 * share:.0f} %, {number(left, 2)}"
        for share, left in zip(of.curve_share[lane, t], of.curve_left_out[lane, t], strict=True)
    ]
    return [curve.specimen, curve.trial, *cells, number(float(of.curve_cook[lane, t]), 2)]


def _sample_row(found: Influence, names: Sequence[str], lane: int, t: int, e: int) -> list[str]:
    curve, of = found.result.problem.curves[lane][t], found.of
    moves = of.left_out[lane, t, :, e]
    most = "–"
    if np.isfinite(moves).any():
        i = int(np.nanargmax(np.abs(moves)))
        most = f"{names[i]} by {moves[i]:+.2g} std. errors"
    numbers = (of.leverage[lane, t, e], found.external[lane, t, e], of.cook[lane, t, e])
    where = sample_label(found, lane, t, e)
    return [curve.specimen, curve.trial, where, *(number(float(v), 2) for v in numbers), most]


def _drivers(found: Influence, names: Sequence[str]) -> list[str]:
    """In words: the curve whose loss moves each parameter most, where it moves it by much."""
    said, moves = [], np.abs(np.nan_to_num(found.of.curve_left_out))
    for i, name in enumerate(names):
        lane, t = np.unravel_index(int(np.argmax(moves[:, :, i])), moves.shape[:2])
        if moves[lane, t, i] >= _MOVES:
            curve, by = found.result.problem.curves[lane][t], found.of.curve_left_out[lane, t, i]
            said.append(f"- {name}: {curve.specimen} {curve.trial} ({by:+.2g} standard errors)")
    lead = "Estimates that hang on one curve, by more than a standard error:"
    return [lead, "\n".join(said)] if said else []
