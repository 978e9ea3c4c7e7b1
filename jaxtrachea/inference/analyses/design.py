"""Where to press next, in tables and picture (docs/after_a_fit.md)."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.table import Column, Table
from jaxtrachea.fitting.assessment import unknown_label
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analysis import (
    Analysis,
    AnalysisResults,
    Cells,
    Progress,
    Request,
    Unavailable,
)
from jaxtrachea.inference.design.candidates import (
    Candidates,
    beyond_records,
    candidates_of,
    extrapolation,
    pressed_specimen,
)
from jaxtrachea.inference.design.choice import (
    Choice,
    Criterion,
    gains,
    next_points,
    scores,
    scores_after,
)
from jaxtrachea.inference.design.identifiability import Map, identifiability
from jaxtrachea.inference.design.situation import Situation, situation


@dataclasses.dataclass(frozen=True, eq=False)
class Design:
    """The next presses, and what they were chosen from.

    Attributes:
        known: what is known before.
        at: candidates.
        added: what each would tell.
        choice: those chosen.
        charts: identifiability along the tube, at every angle, on the specimen of the first press.
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
        raise SpecError("design: no free parameter; free what the presses shall tell")
    candidates_of(request.spec, request.study)


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> Design:
    section = request.spec.design
    try:
        known = situation(findings.result, findings.get("bootstrap"))
    except ValueError as error:
        raise Unavailable(str(error)) from None
    at = candidates_of(request.spec, request.study, known.reach)
    added = gains(known, at)
    choice = next_points(known, at, section.points, section.criterion, added)
    s = np.linspace(at.s.min(), at.s.max(), 121)
    angles = [0.0] if at.phi is None else np.unique(at.phi).tolist()
    first, deepest = int(choice.chosen[0]), float(at.depth.max())
    curve = 0 if at.curve is None else int(at.curve[first])
    charts = [identifiability(known, s, deepest, phi, curve, _pace(at, first)) for phi in angles]
    return Design(known, at, added, choice, charts, names(known, findings.result))


def _pace(at: Candidates, k: int) -> tuple[float, float] | None:
    """Speed, mm/s, and hold, s, of a candidate; None: the force knows no time."""
    if at.speed is None or at.hold is None:
        return None
    return float(at.speed[k]), float(at.hold[k])


def names(known: Situation, result) -> list[str]:
    """Unknowns of the first guess's lane that a new press shares; all lanes have the same ones."""
    lane = int(known.lane[0])
    count = len(result.study.unknowns[lane])
    return [unknown_label(result, lane, int(i)) for i in known.kept[0] if i < count]


def choice_rows(found: Design) -> Iterator[dict[str, object]]:
    """One row before any press, then one per press chosen, with the errors expected after it."""
    at, study = found.at, found.known.study
    names = _specimens(study, at)
    for step, error in enumerate(found.choice.error):
        k = int(found.choice.chosen[step - 1])
        place = _place(at, k, names)
        place = place if step else dict.fromkeys(place)
        pairs = zip(found.unknowns, error, strict=False)
        errors = {f"{name} relative se": float(e) for name, e in pairs}
        message, pace = "", _pace(at, k)
        if step:
            depth = float(at.depth[k])
            said = [extrapolation(study, depth, found.known.reach)]
            said += [] if pace is None else [beyond_records(study, *pace, depth)]
            message = "; ".join(filter(None, said))
        yield {"press": step, **place, **errors, "message": message}


def _specimens(study: Study, at: Candidates) -> dict[int, str]:
    """Name of the specimen that is pressed, by its curve."""
    curves = [0] if at.curve is None else np.unique(at.curve).tolist()
    return {curve: pressed_specimen(study, curve) for curve in curves}


def _place(at: Candidates, k: int, names: dict[int, str]) -> dict[str, object]:
    """Where a candidate is, on which specimen; angle, speed and hold where candidates have one."""
    turned = {} if at.phi is None else {"phi_deg": float(np.degrees(at.phi[k]))}
    specimen = names[0 if at.curve is None else int(at.curve[k])]
    pace = _pace(at, k)
    timed = {} if pace is None else dict(zip(("speed_mm_s", "hold_s"), pace, strict=True))
    place = {"specimen": specimen, "s_mm": float(at.s[k]), **turned}
    return {**place, "depth_mm": float(at.depth[k]), **timed}


def candidate_rows(known: Situation, added: np.ndarray, at: Candidates) -> Iterator[Cells]:
    """One row per candidate: what it would gain by every criterion, as a first further press."""
    names = _specimens(known.study, at)
    criteria: tuple[Criterion, ...] = ("D", "A", "E")
    before = known.base[:, None], known.meat[:, None]
    now = {c: float(scores(*before, c)[0]) for c in criteria}
    then = {c: scores_after(known, added, c) for c in criteria}
    for k in range(len(at.s)):
        gain = {f"gain_{c}": float(then[c][k]) - now[c] for c in criteria}
        yield _place(at, k, names) | gain


def map_rows(design: Design) -> Iterator[Cells]:
    """One row per angle and position: condition, weakest combination, best partner from scratch."""
    for found in design.charts:
        yield from _chart_rows(design, found)


def _chart_rows(design: Design, found: Map) -> Iterator[Cells]:
    """`map_rows` of one angle, which is named where some candidate has one."""
    partner = np.argmin(found.pairs, axis=1)
    angle = {} if design.at.phi is None else {"phi_deg": float(np.degrees(found.phi))}
    specimen = pressed_specimen(design.known.study, found.curve)
    for i, s in enumerate(found.s):
        parts = zip(design.unknowns, found.weakest[i], strict=False)
        yield {
            "specimen": specimen,
            "s_mm": float(s),
            **angle,
            "condition": float(found.condition[i]),
            "partner_s_mm": float(found.s[partner[i]]),
            "pair_condition": float(found.pairs[i, partner[i]]),
        } | {f"weakest {name}": float(v) for name, v in parts}


def _tables(found: Design):
    return {
        "next_points.csv": Table(choice_rows(found)),
        "candidates.csv": Table(candidate_rows(found.known, found.added, found.at)),
        "identifiability.csv": Table(map_rows(found)),
    }


def _table(found: Design, lanes: list[int]) -> Table:
    """The presses that were chosen, and the errors expected after each."""
    rows = list(choice_rows(found))
    heads = {"s_mm": "s [mm]", "phi_deg": "phi [deg]", "depth_mm": "depth [mm]"}
    heads |= {"speed_mm_s": "speed [mm/s]", "hold_s": "hold [s]"}
    columns = [
        Column(heads.get(name, name.removesuffix(" relative se")), name, digits=3, null="")
        for name in rows[0]
        if name != "message"
    ]
    title = "Next presses, relative standard errors that fit would report after each"
    return Table(rows, columns, title=title)


def _shown(found: Design) -> Iterator[str]:
    for row in choice_rows(found):
        if row["message"]:
            yield f"Press {row['press']}: {row['message']}"


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
    curves = np.zeros(len(at.s), int) if at.curve is None else at.curve
    none = np.zeros(len(at.s))
    speeds, holds = (none if v is None else v for v in (at.speed, at.hold))
    # Of many specimens, and speeds with holds, those that are pressed.
    table = np.stack([curves, speeds, holds, angles, at.depth], axis=1)
    pressed = (table[:, None, :3] == table[choice.chosen, :3]).all(axis=2).any(axis=1)
    for row in np.unique(table[pressed], axis=0):
        own, (curve, speed, hold, phi, depth) = (table == row).all(axis=1), row.tolist()
        label = f"{depth:.3g} mm" + (f", {_degrees(phi)}" if several else "")
        if at.curve is not None:
            label += f", {pressed_specimen(design.known.study, int(curve))}"
        if at.speed is not None:
            label += f", {speed:.3g} mm/s, {hold:.3g} s"
        right.plot(at.s[own], choice.score[0, own], lw=1, label=label)
    for k in np.unique(choice.chosen):
        order = ", ".join(str(step + 1) for step in np.flatnonzero(choice.chosen == k))
        right.annotate(order, (at.s[k], choice.score[0, k]), color="tab:red")
    long = several or at.curve is not None or at.speed is not None
    right.legend(title="depth", fontsize="x-small" if long else None)
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
    report_section="design",
    table=_table,
    sentences=_shown,
    figures=lambda found: {"identifiability.png": lambda: draw_design(found)},
)
