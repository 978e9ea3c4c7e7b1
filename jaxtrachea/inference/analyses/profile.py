"""Profile likelihood in tables, report, results.h5 and picture."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.files.pictures import grid, of_all
from jaxtrachea.files.table import Column, Interval, Table, number
from jaxtrachea.fitting.assessment import unknown_label, within_bounds
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.labels import lane_label
from jaxtrachea.inference.profile import Profiles, profiles
from jaxtrachea.inference.rows import LINES, and_more, listed
from jaxtrachea.status import ProfileEnd

COLUMNS = tuple(
    map(Column, ("specimen", "parameter", "value", "profile 95 %", "local 95 %", "ends"))
)


def names_of(request: Request) -> tuple[str, ...]:
    """Names of the parameters to profile: those of the specification, all if only asked for.

    Raises:
        SpecError: one is not fitted.
    """
    names, free = request.spec.uncertainty.profile, tuple(p.name for p in request.study.free)
    for name in names:
        if name not in (*free, "all"):
            raise SpecError(
                f"uncertainty.profile: {name!r} is not fitted; expected 'all' or names out of "
                f"{', '.join(free)}"
            )
    return tuple(names) if names and "all" not in names else free


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> Profiles:
    points = request.spec.uncertainty.profile_points
    names = names_of(request)
    return profiles(findings.result, request.settings, names, points=points, progress=progress)


def _refuse(request: Request) -> None:
    names_of(request)


def _cells(found: Profiles, lane: int, i: int) -> Cells:
    """Interval by profile likelihood, and how it ends."""
    k = found.find(lane, i)
    if k is None:
        return {}
    low, high = (ProfileEnd(int(v)).name.lower() for v in found.end[k])
    return {
        "profile_low95": float(found.lower[k]),
        "profile_high95": float(found.upper[k]),
        "profile_low_end": low,
        "profile_high_end": high,
    }


def profile_rows(found: Profiles) -> Iterator[Cells]:
    """One row per point of each profile for profiles.csv."""
    result = found.result
    for k, (lane, i) in enumerate(found.pairs):
        lane_specimen, _ = result.study.lane_name(lane)
        p, specimen, trial = result.study.unknowns[lane][i]
        for theta, statistic in zip(found.coordinate[k], found.statistic[k], strict=True):
            yield {
                "specimen": specimen or lane_specimen,
                "trial": trial or "(all)",
                "parameter": p.name,
                "unit": p.unit,
                "at": p.from_scaled(float(theta)),
                "statistic": float(statistic),
                "threshold": float(found.threshold[k]),
            }


def profile_table(found: Profiles, lanes: Sequence[int]) -> Table:
    """Value, interval by profile and by standard error, how the profile ends."""
    result, rows = found.result, []
    place = {lane: n for n, lane in enumerate(lanes)}
    pairs = [(k, lane, i) for k, (lane, i) in enumerate(found.pairs) if lane in place]
    for k, lane, i in sorted(pairs, key=lambda pair: place[pair[1]]):
        p = result.study.unknowns[lane][i][0]
        low, high = (ProfileEnd(int(e)).name.lower() for e in found.end[k])
        local = (float(v[lane, i]) for v in (result.lower, result.upper))
        local = within_bounds(result, lane, i, *local)
        rows.append(
            {
                "specimen": lane_label(result, lane),
                "parameter": f"{unknown_label(result, lane, i)} [{p.unit}]",
                "value": float(result.value[lane, i]),
                "profile 95 %": Interval(found.lower[k], found.upper[k], p.scale == "log"),
                "local 95 %": Interval(*local, p.scale == "log"),
                "ends": low if low == high else f"{low}, {high}",
            }
        )
    more = and_more(result.lanes, len(lanes), "parameters.csv")
    return Table(rows, COLUMNS, title="Profile likelihood", more=more)


def _section(found: Profiles) -> list[str]:
    """How the profiles end, and whether one found a better fit."""

    def count(end):
        return int(np.sum((found.end == end).any(axis=1)))

    parts = [
        f"{len(found.lane)} profiles: {count(ProfileEnd.OPEN)} open on a side (the data do not "
        f"limit the parameter there), {count(ProfileEnd.BOUND)} limited only because another "
        f"unknown is on its bound, {count(ProfileEnd.FAILED)} failed. All other unknowns are "
        "fitted anew at every point; points: `profiles.csv` (docs/read_a_fit.md).",
    ]
    better = np.flatnonzero(found.improved)
    if len(better):
        names = sorted({lane_label(found.result, int(found.lane[k])) for k in better})
        parts.append(
            f"**A profile found a better fit than the fit itself** ({', '.join(names[:20])}): "
            "these intervals are wrong. Fit again with more starts."
        )
    return [*parts, "![profiles](profiles.png)"] if len(found.lane) else parts


def _figures(found: Profiles):
    return {"profiles.png": partial(draw_profiles, found)} if len(found.lane) else {}


def draw_profiles(found: Profiles):
    """Rise of the profile against the parameter, a panel for each parameter, a line for each lane.

    Of one lane with the threshold, the estimate, the interval, and the parabola of the local
    standard error.
    """
    import matplotlib as mpl

    result = found.result
    names = list(dict.fromkeys(p.name for p in result.study.free))
    pairs = found.pairs
    place = {lane: n for n, lane in enumerate(listed(result, LINES))}
    groups = {
        name: sorted(
            (
                k
                for k, (lane, i) in enumerate(pairs)
                if result.study.unknowns[lane][i][0].name == name
            ),
            key=lambda k: place.get(pairs[k][0], LINES),
        )
        for name in names
    }
    groups = {name: members for name, members in groups.items() if members}
    figure, axes = grid(len(groups))
    for n, (axis, members) in enumerate(zip(axes, groups.values(), strict=False)):
        first = members[0]
        p, threshold = result.study.unknowns[pairs[first][0]][pairs[first][1]][0], found.threshold
        colours = mpl.colormaps["viridis"](np.linspace(0.05, 0.9, len(members)))
        wide = np.ptp(found.coordinate[members]) > np.log(20)
        axis.set_xscale("log" if p.scale == "log" and wide else "linear")
        for k, colour in zip(members[:LINES], colours, strict=False):
            at = p.from_scaled(found.coordinate[k])
            axis.plot(at, found.statistic[k], ".-", color=colour, lw=0.9, ms=3)
        axis.axhline(threshold[first], ls="--", color="#b4001e", lw=0.9)
        axis.text(0.99, threshold[first], "95 %", transform=axis.get_yaxis_transform(),
                  ha="right", va="bottom", fontsize=7, color="#b4001e")  # fmt: skip
        axis.set_ylim(-0.2, 2.2 * threshold[first])
        title = p.name + of_all(min(len(members), LINES), len(members), "worst fits")
        if len(members) == 1:
            title += f": {_mark_interval(axis, found, first)}"
        axis.set_title(title, fontsize=9)
        axis.set(xlabel=f"{p.name} [{p.unit}]", ylabel="rise of -2 ln L [1]")
        if n == 0 and len(members) == 1:
            axis.legend(loc="upper center", frameon=True, framealpha=0.9, edgecolor="w")
    return figure


def _mark_interval(axis, found: Profiles, k: int) -> str:
    """Estimate, 95 % interval and local parabola of one profile; the numbers in words."""
    result, (lane, i) = found.result, found.pairs[k]
    p, value = result.study.unknowns[lane][i][0], float(result.value[lane, i])
    axis.axvline(value, color="k", lw=0.8, label="estimate")
    ends = [float(v[k]) for v in (found.lower, found.upper)]
    low, high = p.from_scaled(found.coordinate[k][[0, -1]])
    open_low = ends[0] == (0 if p.scale == "log" else -np.inf)
    shown = low if open_low else ends[0], high if ends[1] == np.inf else ends[1]
    if np.isfinite(shown).all():
        axis.axvspan(*shown, color="0.5", alpha=0.18, lw=0, label="95 % interval")
    se = result.uncertainty.se[lane, i]
    if np.isfinite(se) and se > 0:
        theta = np.linspace(found.coordinate[k][0], found.coordinate[k][-1], 101)
        local = ((theta - result.theta[lane, i]) / se) ** 2
        axis.plot(p.from_scaled(theta), local, ":", color="k", lw=1, label="local error")
    cell = Interval(float(found.lower[k]), float(found.upper[k]), p.scale == "log")
    return f"{number(value)} ({Column('', '', digits=4).text({'': cell})})"


PROFILES = Analysis(
    name="profiles",
    compute=_compute,
    work="profiling",
    option="profile",
    key="profile",
    refuse=_refuse,
    tables=lambda found: {"profiles.csv": Table(profile_rows(found))},
    parameter_cells=_cells,
    datasets=("lane", "unknown", "lower", "upper", "threshold", "theta", "statistic", "end"),
    meanings={"end": ProfileEnd},
    table=profile_table,
    section=_section,
    figures=_figures,
)
