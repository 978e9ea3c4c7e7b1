"""Where to press next, in tables and picture (docs/design.md)."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.fitting.result import unknown_label
from jaxtrachea.inference.analysis import (
    Analysis,
    Cells,
    Findings,
    Progress,
    Request,
    Table,
    Unavailable,
)
from jaxtrachea.inference.design import (
    Candidates,
    Choice,
    Criterion,
    Map,
    Situation,
    candidates_of,
    gains,
    identifiability,
    next_points,
    scores,
    situation,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Design:
    """The next presses, and what they were chosen from.

    Attributes:
        known: what is known before.
        at: candidates.
        added: what each would tell.
        choice: those chosen.
        charts: identifiability along the tube, at every angle.
        unknowns: names of what a new press shares.
    """

    known: Situation
    at: Candidates
    added: np.ndarray
    choice: Choice
    charts: list[Map]
    unknowns: list[str]


def _refuse(request: Request) -> None:
    if not request.study.free:
        raise SpecError("design: every parameter is fixed; free what the presses shall tell")
    candidates_of(request.spec, request.study)


def _compute(request: Request, findings: Findings, progress: Progress) -> Design:
    section = request.spec.design
    at = candidates_of(request.spec, request.study)
    try:
        known = situation(findings.result, findings.get("bootstrap"))
    except ValueError as error:
        raise Unavailable(str(error)) from None
    added = gains(known, at)
    choice = next_points(known, at, section.points, section.criterion, added)
    s = np.linspace(at.s.min(), at.s.max(), 121)
    angles = [0.0] if at.phi is None else np.unique(at.phi).tolist()
    charts = [identifiability(known, s, float(at.depth.max()), phi) for phi in angles]
    return Design(known, at, added, choice, charts, names(known, findings.result))


def names(known: Situation, result) -> list[str]:
    """Unknowns of the first guess's lane that a new press shares; all lanes have the same ones."""
    lane = int(known.lane[0])
    count = len(result.study.unknowns[lane])
    return [unknown_label(result, lane, int(i)) for i in known.kept[0] if i < count]


def choice_rows(choice: Choice, at: Candidates, unknowns: list[str]) -> Iterator[Cells]:
    """One row before any press, then one per press chosen, with the errors expected after it."""
    for step, error in enumerate(choice.error):
        k = int(choice.chosen[step - 1])
        place: Cells = _place(at, k)
        place = place if step else dict.fromkeys(place, "")
        pairs = zip(unknowns, error, strict=False)
        yield {"press": step, **place} | {f"{name} relative se": float(e) for name, e in pairs}


def _place(at: Candidates, k: int) -> dict[str, object]:
    """Where a candidate is; its angle only where some candidate has one."""
    turned = {} if at.phi is None else {"phi_deg": float(np.degrees(at.phi[k]))}
    return {"s_mm": float(at.s[k]), **turned, "depth_mm": float(at.depth[k])}


def candidate_rows(known: Situation, added: np.ndarray, at: Candidates) -> Iterator[Cells]:
    """One row per candidate: what it would gain by every criterion, as a first further press."""
    criteria: tuple[Criterion, ...] = ("D", "A", "E")
    now = {c: float(scores(known.base[:, None], c)[0]) for c in criteria}
    then = {c: scores(known.base[:, None] + added, c) for c in criteria}
    for k in range(len(at.s)):
        gain = {f"gain_{c}": float(then[c][k]) - now[c] for c in criteria}
        yield _place(at, k) | gain


def map_rows(charts: list[Map], unknowns: list[str], *, turned: bool) -> Iterator[Cells]:
    """One row per angle and position: condition, weakest combination, best partner from scratch."""
    for found in charts:
        yield from _chart_rows(found, unknowns, turned=turned)


def _chart_rows(found: Map, unknowns: list[str], *, turned: bool) -> Iterator[Cells]:
    """`map_rows` of one angle, which is named if `turned`."""
    partner = np.argmin(found.pairs, axis=1)
    angle = {"phi_deg": float(np.degrees(found.phi))} if turned else {}
    for i, s in enumerate(found.s):
        parts = zip(unknowns, found.weakest[i], strict=False)
        yield {
            "s_mm": float(s),
            **angle,
            "condition": float(found.condition[i]),
            "partner_s_mm": float(found.s[partner[i]]),
            "pair_condition": float(found.pairs[i, partner[i]]),
        } | {f"weakest {name}": float(v) for name, v in parts}


def _tables(found: Design):
    turned = found.at.phi is not None
    return {
        "next_points.csv": choice_rows(found.choice, found.at, found.unknowns),
        "candidates.csv": candidate_rows(found.known, found.added, found.at),
        "identifiability.csv": map_rows(found.charts, found.unknowns, turned=turned),
    }


def _shown(found: Design, lanes: list[int]) -> Iterator[Table]:
    rows = list(choice_rows(found.choice, found.at, found.unknowns))
    errors = [k.removesuffix(" relative se") for k in rows[0] if k.endswith(" relative se")]
    turned = [] if found.at.phi is None else ["phi [deg]"]
    head = ["press", "s [mm]", *turned, "depth [mm]", *errors]
    cells = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    yield "Next presses, relative errors expected after each", head, cells


def draw_design(design: Design):
    """The identifiability map: over s with the data, of pairs without, and the gains.

    A line for each angle; pairs at the first of them.
    """
    from matplotlib.figure import Figure

    found, at, choice = design.charts[0], design.at, design.choice
    rings = np.asarray(design.known.study.model.geometry.ring_positions)
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    several = len(design.charts) > 1
    for n, chart in enumerate(design.charts):
        colour = f"C{n}" if several else "0.2"
        left.plot(chart.s, chart.condition, color=colour, label=_degrees(chart.phi))
    if several:
        left.legend(title="phi")
    left.set(xlabel="s [mm]", ylabel="condition", title="data and a press at s")
    left.plot(rings, np.full(len(rings), found.condition.min()), "|", color="tab:green", ms=9)
    known = np.ma.masked_invalid(np.log10(found.pairs))
    image = middle.pcolormesh(found.s, found.s, known, cmap="viridis_r")
    figure.colorbar(image, label="log10 condition")
    where = f", phi = {_degrees(found.phi)}" if several else ""
    middle.set(xlabel="s [mm]", ylabel="s [mm]", title=f"two presses, no other data{where}")
    angles = np.zeros(len(at.s)) if at.phi is None else at.phi
    for phi, depth in sorted(set(zip(angles.tolist(), at.depth.tolist(), strict=True))):
        own = (at.depth == depth) & (angles == phi)
        label = f"{depth:.3g} mm" + (f", {_degrees(phi)}" if several else "")
        right.plot(at.s[own], choice.score[0, own], lw=1, label=label)
    for k in np.unique(choice.chosen):
        order = ", ".join(str(step + 1) for step in np.flatnonzero(choice.chosen == k))
        right.annotate(order, (at.s[k], choice.score[0, k]), color="tab:red")
    right.legend(title="depth", fontsize="x-small" if several else None)
    right.set(xlabel="s [mm]", ylabel="criterion", title="first press; chosen in order")
    return figure


def _degrees(phi: float) -> str:
    """An angle in degrees."""
    return f"{np.degrees(phi):.3g}°"


DESIGN = Analysis(
    name="design",
    after="effective",
    compute=_compute,
    asked=lambda request: True,
    commands=("design",),
    refuse=_refuse,
    tables=_tables,
    place="design",
    shown=_shown,
    figures=lambda found: {"identifiability.png": lambda: draw_design(found)},
)
