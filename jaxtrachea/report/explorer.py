"""The explorer of report.html: curves, and where the estimates go without some of them.

Numbers are those of `influence`, to first order; the page has no server and asks for nothing.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_hex

from jaxtrachea.fitting.assessment import unknown_label
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analyses.influence import influence_cell
from jaxtrachea.inference.influence import Influence
from jaxtrachea.inference.labels import lane_label, succeeded
from jaxtrachea.inference.rows import worst_first
from jaxtrachea.report.fit_pictures import scale_of
from jaxtrachea.report.shown import Shown, along

#: Curves of a page, and points of a curve, at most.
CURVES, POINTS = 300, 60

_STYLE = """
#explorer svg { width: 100%; max-width: 34rem; font: 11px system-ui, sans-serif; }
#explorer svg text { fill: currentColor; stroke: none; }
#explorer .pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(18rem, 1fr)); }
#explorer .grid { stroke: #8884; }
#explorer path { fill: none; }
#explorer .line { stroke-width: 1.5; }
#explorer .dots { stroke-width: 4; stroke-linecap: round; opacity: .6; }
#explorer .curve { cursor: pointer; }
#explorer .lit .line { stroke-width: 4; }
#explorer .lit .dots { stroke-width: 8; opacity: 1; }
#explorer .out .line { stroke-dasharray: 3 4; }
#explorer .out .line, #explorer .out .dots { opacity: .3; }
tr.lit { background: #e69f0044; }
tr.out { text-decoration: line-through; }
tr.moved { font-weight: bold; }
#explorer pre { background: #8881; padding: .6rem; white-space: pre-wrap; }
"""
_BODY = """<section id="explorer" class="screen">
<style>{style}</style>
<h2>Explorer</h2>
<p>Point at a curve to see it everywhere; click it to leave it out. Estimates then move to first
order, by the numbers of <code>influence_curves.csv</code>, and those of several curves add up.
The columns of the table are these changes, in standard errors of independent residuals.{more}</p>
<select id="explorer-choice" aria-label="fit"></select> <b id="explorer-name"></b>
<div id="explorer-lane"></div>
<div class="wide"><table id="explorer-estimates"></table></div>
<pre id="explorer-toml"></pre>
<script type="application/json" id="explorer-data">{data}</script>
<script>{script}</script>
</section>
"""


def explorer(found: Influence, command: str, excluded: Sequence[str] = ()) -> str:
    """The section of report.html; "" where no fit has two curves that can do without each other."""
    result = found.result
    lanes = [
        k for k in worst_first(result) if succeeded(result, k) and len(result.study.curves[k]) > 1
    ]
    count = np.cumsum([len(result.study.curves[k]) for k in lanes])
    kept = [k for k, n in zip(lanes, count, strict=True) if n <= CURVES]
    if not kept or not result.study.free:
        return ""
    shown, tables = Shown(result), {k: _read_by_several(result, k) for k in kept}
    names = [lane_label(result, k) for k in kept]
    data = {
        "lanes": names,
        "unknowns": [[_unknown(result, k, i) for i in tables[k]] for k in kept],
        "curves": [
            _curve(found, shown, k, t, tables[k]) | {"lane": n}
            for n, k in enumerate(kept)
            for t in range(len(result.study.curves[k]))
        ],
        "scale": _number(scale_of(np.asarray(found.of.studentised)[kept])),
        "along": along(result.study.curves[kept[0]][0])[1],
        "command": command,
        "excluded": list(excluded),
    }
    left = len(lanes) - len(kept)
    more = f" The {len(kept)} worst fits, and {left} more in the file." if left else ""
    text = json.dumps(data, ensure_ascii=False).replace("<", "\\u003c")
    script = Path(__file__).with_name("explorer.js").read_text(encoding="utf-8")
    return _BODY.format(style=_STYLE, more=more, data=text, script=script)


def _read_by_several(result: FitResult, lane: int) -> list[int]:
    """Unknowns of a lane that more than one curve reads: the others go with theirs."""
    index = np.asarray(result.study.lanes.index)[lane][:, list(result.study.free_columns)]
    index = index[: len(result.study.curves[lane])]
    return [i for i in range(len(result.study.unknowns[lane])) if np.sum(index == i) > 1]


def _unknown(result: FitResult, lane: int, i: int) -> dict[str, Any]:
    """What the page has of an unknown; `se` of its logarithm where `log`, else in its unit."""
    p, log = result.study.unknowns[lane][i][0], result.study.unknowns[lane][i][0].scale == "log"
    se = float(result.uncertainty.se[lane, i])
    return {
        "label": unknown_label(result, lane, i), "unit": p.unit, "log": log,
        "value": float(result.value[lane, i]),
        "se": _number(se if log else se * p.step) or 0.0,
    }  # fmt: skip


def _curve(found: Influence, shown: Shown, lane: int, t: int, unknowns: list[int]):
    """What the page has of a curve: its points, and what moves where it is left out."""
    result, of = found.result, found.of
    curve, n = result.study.curves[lane][t], len(result.study.curves[lane][t].force)
    at = np.unique(np.linspace(0, n - 1, min(n, POINTS)).round().astype(int))
    fitted = curve.force + result.residuals["force"][lane, t, :n]
    columns = np.asarray(result.study.lanes.index)[lane, t, list(result.study.free_columns)]
    moves, reasons = [], []
    for i in unknowns:
        place = np.flatnonzero(columns == i)
        moves.append(_number(of.curve_left_out[lane, t, place[0]]) if len(place) else 0.0)
        cell = influence_cell(found, lane, t, int(place[0])) if len(place) else ""
        reasons.append(cell.rpartition(", ")[2])
    return {
        "name": f"{curve.specimen}/{curve.trial}", "label": f"{curve.specimen} {curve.trial}",
        "cells": [curve.specimen, curve.trial], "colour": to_hex(shown.colour(curve.s_c)),
        "x": _numbers(along(curve)[0][at]), "measured": _numbers(curve.force[at]),
        "fitted": _numbers(fitted[at]), "residual": _numbers(of.studentised[lane, t, :n][at]),
        "moves": moves, "reasons": reasons, "cook": _number(of.curve_cook[lane, t]),
    }  # fmt: skip


def _number(value: Any) -> float | None:
    """Five digits; None where there is none."""
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _numbers(values: Any) -> list[float | None]:
    return [_number(float(v)) for v in values]
