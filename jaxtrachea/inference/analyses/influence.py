"""Influence of samples and curves in tables and report."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxtrachea.files.table import Column, Table, number, words
from jaxtrachea.fitting.lane import Lane, forces, markers
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.influence import Influence, influence
from jaxtrachea.inference.labels import succeeded
from jaxtrachea.inference.rows import ONE_BY_ONE, and_more
from jaxtrachea.measurements.observed import FITTED_NUMBERS

#: Rows of the tables on influence; the files hold all.
_TOP = 12
#: Change of an estimate, in standard errors, from which a curve is named.
_MOVES = 1.0
#: What entries of the residual are called, by field of the lane and place at a ring.
_FORCES = {"force": "force"} | {name: q.words for name, q in FITTED_NUMBERS.items()}
_MOTIONS = {
    "joints": ("marker",), "joint_side": ("sideward marker",),
    "ends": ("end U y", "end U z", "end V y", "end V z"),
}  # fmt: skip
#: What stands in a table of influence where a number cannot be given.
REASONS = (
    "`own`: nobody else tells of this unknown. `needed`: without this curve the others do not "
    "determine all unknowns. `held`: the unknown is on its bound. `undetermined`: it has no "
    "standard error. `no estimate`: the fit failed."
)


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> Influence:
    return influence(findings.result, request.settings.batch)


def _tables(found: Influence):
    return {
        "influence.csv": Table(sample_rows(found)),
        "influence_curves.csv": Table(curve_rows(found)),
    }


def sample_rows(found: Influence) -> Iterator[Cells]:
    """One row per observation for influence.csv."""
    study, of = found.result.study, found.of
    names = [p.name for p in study.free]
    for lane, curves in enumerate(study.curves):
        for t, curve in enumerate(curves):
            for e in np.flatnonzero(np.isfinite(of.leverage[lane, t])):
                at = lane, t, e
                place = _place(study.lanes, int(e))
                yield {
                    "specimen": curve.specimen,
                    "trial": curve.trial,
                    "sample": place.sample + 1,
                    "observed": place.observed,
                    "ring": None if place.ring is None else place.ring + 1,
                    "displacement_mm": float(curve.displacement[place.sample]),
                    "leverage": float(of.leverage[at]),
                    "studentised": float(of.studentised[at]),
                    "studentised_external": float(found.external[at]),
                    "cook": float(of.cook[at]),
                } | {
                    f"{name} {what}": float(v[lane, t, i, e])
                    for i, name in enumerate(names)
                    for what, v in (("per sigma", of.per_sigma), ("left out", of.left_out))
                }


def curve_rows(found: Influence) -> Iterator[Cells]:
    """One row per curve for influence_curves.csv."""
    study, of = found.result.study, found.of
    names = [p.name for p in study.free]
    for lane, curves in enumerate(study.curves):
        for t, curve in enumerate(curves):
            r = of.studentised[lane, t]
            worst = np.nanmax(np.abs(r)) if np.isfinite(r).any() else np.nan
            yield {
                "specimen": curve.specimen,
                "trial": curve.trial,
                "leverage": float(np.nansum(of.leverage[lane, t])),
                "largest_studentised": float(worst),
                "cook": float(of.curve_cook[lane, t]),
            } | {
                f"{name} {what}": float(v[lane, t, i])
                for i, name in enumerate(names)
                for what, v in (("share", of.curve_share), ("left out", of.curve_left_out))
            }


def top_samples(found: Influence, count: int) -> list[tuple[int, int, int]]:
    """Lane, curve and entry of the samples with the largest Cook's distance, largest first."""
    cook = np.where(np.isfinite(found.of.cook), found.of.cook, -1)
    order = np.argsort(-cook, axis=None, kind="stable")[:count]
    places = zip(*np.unravel_index(order, cook.shape), strict=True)
    return [(int(k), int(t), int(e)) for k, t, e in places if cook[k, t, e] >= 0]


class Place(NamedTuple):
    """What an entry of the residual observes.

    Attributes:
        sample: counted from 0.
        observed: `force`, `side force`, `marker`, `sideward marker`, or `end U y` and the like.
        ring: counted from 0; None of a force.
    """

    sample: int
    observed: str
    ring: int | None

    def label(self, displacement: float) -> str:
        """In words: 2.5 mm; 2.5 mm, side force; 2.5 mm, ring 3; 2.5 mm, ring 3, end U y."""
        where = f"{displacement:.3g} mm"
        where += "" if self.ring is None else f", ring {self.ring + 1}"
        return where if self.observed in ("force", "marker") else f"{where}, {self.observed}"


def _place(lanes: Lane, entry: int) -> Place:
    """What an entry of the residual of some lanes observes."""
    samples = lanes.force.shape[-1]
    for channel in forces(lanes) + markers(lanes):
        if entry < samples * channel.places:
            break
        entry -= samples * channel.places
    else:
        raise IndexError("no such entry")
    sample, part = divmod(entry, channel.places)
    if channel.name in _FORCES:
        return Place(sample, _FORCES[channel.name], None)
    rings = channel.data.shape[lanes.force.ndim]
    ring, component = divmod(part, channel.places // rings)
    return Place(sample, _MOTIONS[channel.name][component], ring)


def sample_label(found: Influence, lane: int, t: int, entry: int) -> str:
    """Where a sample is, see `Place.label`."""
    study = found.result.study
    place = _place(study.lanes, entry)
    return place.label(float(study.curves[lane][t].displacement[place.sample]))


def influence_table(found: Influence) -> Table:
    """Curves: all of few; of many those with the largest Cook's distance."""
    names = [p.name for p in found.result.study.free]
    head = ["specimen", "curve", *(f"{n}: share, left out" for n in names), "Cook"]
    rows = [_curve_row(found, *place) for place in _top_curves(found, ONE_BY_ONE)]
    total = sum(map(len, found.result.study.curves))
    table = words("Influence of curves", head, rows)
    table.more = and_more(total, len(rows), "influence_curves.csv")
    return table


_SAMPLES = (
    *map(Column, ("specimen", "curve", "sample")),
    *(Column(name, digits=2) for name in ("leverage", "studentised", "Cook")),
    Column("moves most"),
)


def _section(found: Influence) -> list[str]:
    """Which curves and samples the estimates hang on."""
    rows = [_sample_row(found, *place) for place in top_samples(found, _TOP)]
    return [
        "Share: part of the variance of an estimate that the noise of this curve makes. Left out: "
        "change of the estimate, in standard errors, if the curve were not there (first order). "
        f"{REASONS} All curves: `influence_curves.csv`.",
        *drivers(found),
        Table(rows, _SAMPLES).markdown(),
        "The samples whose loss would move the estimates most; studentised residuals beyond 3 to 4 "
        "are outliers. All samples: `influence.csv` (docs/read_a_fit.md).",
    ]


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


def _sample_row(found: Influence, lane: int, t: int, e: int) -> Cells:
    curve, of = found.result.study.curves[lane][t], found.of
    moves, names = of.left_out[lane, t, :, e], [p.name for p in found.result.study.free]
    most = None
    if np.isfinite(moves).any():
        i = int(np.nanargmax(np.abs(moves)))
        most = f"{names[i]} by {moves[i]:+.2g} std. errors"
    return {
        "specimen": curve.specimen, "curve": curve.trial,
        "sample": sample_label(found, lane, t, e), "leverage": float(of.leverage[lane, t, e]),
        "studentised": float(found.external[lane, t, e]), "Cook": float(of.cook[lane, t, e]),
        "moves most": most,
    }  # fmt: skip


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


def _shown(found: Influence) -> list[str]:
    said = drivers(found)
    return ["\n".join(said)] if said else []


INFLUENCE = Analysis(
    name="influence",
    after="left_out",
    compute=_compute,
    option="influence",
    key="influence",
    tables=_tables,
    report_section="data",
    table=lambda found, lanes: influence_table(found),
    section=_section,
    sentences=_shown,
)
