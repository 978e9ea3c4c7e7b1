"""Relaxation function, moduli, force against speed, and energy of a fit that relaxes."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.files.pictures import grid, plain
from jaxtrachea.files.table import Table
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.analysis import Analysis, AnalysisResults, Cells, Progress, Request
from jaxtrachea.inference.relaxation_curves import (
    Band,
    Loop,
    Rate,
    Whose,
    curves,
    loops,
    parts_of,
    rates,
    specimens,
    times,
)

#: Specimens that are drawn.
DRAWN = 6


class Curves(NamedTuple):
    """Of one specimen; by part (all, or local and skeleton) where parts relax apart.

    Attributes:
        whose: the specimen.
        time: s; (N,).
        relaxation: over what lasts, by part.
        storage: likewise, at the frequencies 1 / (2 pi time).
        loss: likewise.
        rates: of each position.
        loops: of each record.
    """

    whose: Whose
    time: np.ndarray
    relaxation: dict[str, Band]
    storage: dict[str, Band]
    loss: dict[str, Band]
    rates: tuple[Rate, ...]
    loops: tuple[Loop, ...]

    @property
    def frequency(self) -> np.ndarray:
        """Hz; (N,)."""
        return 1 / (2 * np.pi * self.time)

    @property
    def extrapolated(self) -> np.ndarray:
        """Which times lie beyond the shortest step or the longest record; (N,)."""
        span = self.whose.span
        return (self.time < span.shortest) | (self.time > span.longest)


def _compute(request: Request, findings: AnalysisResults, progress: Progress) -> list[Curves]:
    return [_of(findings.result, of) for of in specimens(findings.result)]


def _of(result: FitResult, of: Whose) -> Curves:
    at = times(of.span)
    found = {part: curves(result, of, at, part) for part in parts_of(result)}
    return Curves(
        whose=of,
        time=at,
        relaxation={part: v[0] for part, v in found.items()},
        storage={part: v[1] for part, v in found.items()},
        loss={part: v[2] for part, v in found.items()},
        rates=tuple(rates(result, of)),
        loops=tuple(loops(result, of)),
    )


def _cells(name: str, band: Band, i: int, unit: str = "") -> Cells:
    return {
        f"{name}{unit}": float(band.value[i]), f"{name}_low95{unit}": float(band.low[i]),
        f"{name}_high95{unit}": float(band.high[i]),
    }  # fmt: skip


def relaxation_rows(found: list[Curves]) -> Iterator[Cells]:
    """Rows of relaxation.csv."""
    for c in found:
        for part, band in c.relaxation.items():
            for i, t in enumerate(c.time.tolist()):
                yield {
                    "specimen": c.whose.specimen, "part": part, "time [s]": t,
                    **_cells("relaxation", band, i), "extrapolated": bool(c.extrapolated[i]),
                }  # fmt: skip


def moduli_rows(found: list[Curves]) -> Iterator[Cells]:
    """Rows of moduli.csv, by growing frequency."""
    for c in found:
        for part, storage in c.storage.items():
            for i in range(len(c.time))[::-1]:
                yield {
                    "specimen": c.whose.specimen, "part": part,
                    "frequency [Hz]": float(c.frequency[i]), **_cells("storage", storage, i),
                    **_cells("loss", c.loss[part], i), "extrapolated": bool(c.extrapolated[i]),
                }  # fmt: skip


def rate_rows(found: list[Curves]) -> Iterator[Cells]:
    """Rows of rates.csv: the model with its band, and the records where they are."""
    for c in found:
        for r in c.rates:
            low, high = r.measured[:, 0].min(), r.measured[:, 0].max()
            where = {
                "specimen": c.whose.specimen, "s [mm]": None if np.isnan(r.s) else r.s,
                "depth [mm]": r.depth,
            }  # fmt: skip
            for i, v in enumerate(r.speed.tolist()):
                beyond = bool(v < 0.999 * low or v > 1.001 * high)
                cells = _cells("force", r.force, i, " [N]")
                yield {**where, "speed [mm/s]": v, **cells, "extrapolated": beyond}
            for v, force in r.measured.tolist():
                yield {**where, "speed [mm/s]": v, "measured [N]": force, "extrapolated": False}


def energy_rows(found: list[Curves]) -> Iterator[Cells]:
    """Rows of energy.csv."""
    for c in found:
        for loop in c.loops:
            yield {
                "specimen": loop.specimen, "trial": loop.trial,
                "s [mm]": None if np.isnan(loop.s) else loop.s,
                "measured [N mm]": loop.measured, "model [N mm]": loop.model,
                "model_low95 [N mm]": loop.low, "model_high95 [N mm]": loop.high,
            }  # fmt: skip


def _tables(found: list[Curves]):
    return {
        "relaxation.csv": Table(relaxation_rows(found)),
        "moduli.csv": Table(moduli_rows(found)),
        "rates.csv": Table(rate_rows(found)),
        "energy.csv": Table(energy_rows(found)),
    }


def _section(found: list[Curves]) -> list[str]:
    if not found:
        return []
    loops_of = [loop for c in found for loop in c.loops]
    off = [abs(v.model / v.measured - 1) for v in loops_of if v.measured != 0]
    return [
        "## Relaxation",
        "Force of a sudden press over what lasts (`relaxation.csv`), storage and loss over what "
        "lasts (`moduli.csv`), force against speed (`rates.csv`), with 95 % bands of the "
        "parameters (delta method). Dotted, and `extrapolated` in the tables: beyond the shortest "
        "step of the samples or the longest record, and beyond the speeds of the records. The "
        f"work of a record is met within {100 * max(off, default=0.0):.2g} % (`energy.csv`).",
        "![relaxation](relaxation.png)",
        "![energy](energy.png)",
    ]


def _figures(found: list[Curves]):
    if not found:
        return {}
    return {
        "relaxation.png": partial(draw_relaxation, found),
        "energy.png": partial(draw_energy, found),
    }


def draw_relaxation(found: list[Curves]):
    """Of the first specimens: relaxation function, moduli, force against speed."""
    figure, axes = grid(3 * min(len(found), DRAWN), 3.0)
    panels = iter(axes)
    for c in found[:DRAWN]:
        first, second, third = (next(panels) for _ in range(3))
        name = plain(c.whose.specimen)
        for part in c.relaxation:
            _draw(first, c.time, c.relaxation[part], c.extrapolated, part)
            _draw(second, c.frequency, c.storage[part], c.extrapolated, f"storage, {part}")
            _draw(second, c.frequency, c.loss[part], c.extrapolated, f"loss, {part}")
        for r in c.rates:
            low, high = r.measured[:, 0].min(), r.measured[:, 0].max()
            beyond = (r.speed < 0.999 * low) | (r.speed > 1.001 * high)
            place = "" if np.isnan(r.s) else f"s = {r.s:.4g} mm, "
            line = _draw(third, r.speed, r.force, beyond, f"{place}D = {r.depth:.3g} mm")
            third.plot(*r.measured.T, "o", ms=3, color=line)
        first.set(title=name, xlabel="time [s]", ylabel="force / what lasts", xscale="log")
        second.set(title=name, xlabel="frequency [Hz]", ylabel="modulus / what lasts")
        third.set(title=name, xlabel="speed [mm/s]", ylabel="force [N]", xscale="log")
        second.set(xscale="log")
        for axis in (first, second, third):
            if axis.lines:
                axis.legend()
    return figure


def draw_energy(found: list[Curves]):
    """Of the first specimens: work of each record against the speed of its loading, by position."""
    figure, axes = grid(min(len(found), DRAWN), 3.0)
    for c, axis in zip(found[:DRAWN], axes, strict=False):
        axis.set(title=plain(c.whose.specimen), xlabel="speed [mm/s]", ylabel="work [N mm]")
        known = [loop for loop in c.loops if loop.speed > 0]
        for s in dict.fromkeys(loop.s for loop in known if not np.isnan(loop.s)) or (np.nan,):
            own = [loop for loop in known if loop.s == s or np.isnan(s)]
            speed, measured, model, low, high = np.array([v[3:] for v in own]).reshape(-1, 5).T
            error = np.where(np.isfinite(high - low), [model - low, high - model], np.nan)
            label = "all records" if np.isnan(s) else f"s = {s:.4g} mm"
            drawn = axis.errorbar(speed, model, yerr=error, fmt="_", ms=9, label=label)
            axis.plot(speed, measured, "o", ms=4, mfc="none", color=drawn[0].get_color())
        axis.set(xscale="log")
        axis.legend(title="o measured, - model")
    return figure


def _draw(axis, at, band: Band, beyond, label: str) -> Any:
    """A line, dotted where it is extrapolated, with its band; returns the colour."""
    order = np.argsort(at)
    at, beyond = np.asarray(at)[order], np.asarray(beyond)[order]
    value, low, high = (v[order] for v in band)
    (line,) = axis.plot(at, np.where(beyond, np.nan, value), label=label)
    axis.plot(at, value, ":", color=line.get_color(), lw=0.8)
    known = np.isfinite(low) & np.isfinite(high)
    axis.fill_between(at, low, high, where=known, color=line.get_color(), alpha=0.2, lw=0)
    return line.get_color()


RELAXATION = Analysis(
    name="relaxation",
    after="misfit",
    compute=_compute,
    asked=lambda request: request.study.model.relaxes,
    tables=_tables,
    report_section="checks",
    section=_section,
    figures=_figures,
)
