"""Rows of predictions.csv, bands.csv, joints.csv and errors.csv (docs/after_a_fit.md)."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxtrachea.measurements.observed import FITTED_NUMBERS
from jaxtrachea.measurements.read import BadCurve, Curve
from jaxtrachea.measurements.vectors import tilt_of
from jaxtrachea.prediction.curves import CurvePrediction
from jaxtrachea.prediction.held_out import Compared
from jaxtrachea.status import PredictionStatus, PressStatus

Row = dict[str, object]
#: Columns of predictions.csv, always these.
COLUMNS = (
    "specimen", "trial", "s [mm]", "phi [deg]", "tilt [deg]", "displacement [mm]", "force [N]",
    "predicted [N]", "low95 [N]", "high95 [N]",
)  # fmt: skip


def _cell(value: float) -> object:
    """A number; None for NaN."""
    return None if np.isnan(value) else float(value)


def _place(p: CurvePrediction, i: int) -> Row:
    clock: Row = {} if p.time is None else {"time [s]": float(p.time[i])}
    where: Row = {
        "specimen": p.specimen,
        "trial": p.trial,
        "s [mm]": _cell(p.s),
        "phi [deg]": float(np.degrees(p.phi)),
        "tilt [deg]": float(np.degrees(tilt_of(p.direction))),
        "displacement [mm]": float(p.displacement[i]),
    }
    return where | clock


def prediction_rows(p: CurvePrediction, curve: Curve | None = None) -> Iterator[Row]:
    """One row per displacement; the band is that of a new sample."""
    low, high = p.low95, p.high95
    for i in range(len(p.displacement)):
        force = np.nan if curve is None else float(curve.force[i])
        numbers = (force, float(p.force[i]), float(low[i]), float(high[i]))
        cells = dict(zip(COLUMNS[6:], map(_cell, numbers), strict=True))
        yield _place(p, i) | cells | _other_cells(p, i, curve)


def _other_cells(p: CurvePrediction, i: int, curve: Curve | None) -> Row:
    """What the model has of a sample beside the force."""
    cells: Row = {}
    for name, q in FITTED_NUMBERS.items():
        if name in p.others:
            value, se = (float(v[i]) for v in p.others[name])
            half = p.half_width * float(np.hypot(se, p.sigma[i]))
            given = None if curve is None else getattr(curve, name)
            seen, head = np.nan if given is None else float(given[i]), q.short
            names = (q.words, f"predicted {head}", f"{head} low95", f"{head} high95")
            numbers = (seen, value, value - half, value + half)
            cells |= {f"{n} [{q.unit}]": _cell(v) for n, v in zip(names, numbers, strict=True)}
    return cells


def band_rows(p: CurvePrediction, at: Sequence[int] | None = None) -> Iterator[Row]:
    """One row per displacement (of `at`, if given): both bands, standard errors, statuses."""
    columns = {
        "predicted [N]": p.force,
        "se [N]": p.se,
        "curve_low95 [N]": p.curve_low95,
        "curve_high95 [N]": p.curve_high95,
        "low95 [N]": p.low95,
        "high95 [N]": p.high95,
        "sigma [N]": p.sigma,
        "model_se [N]": np.zeros_like(p.force) + p.model_se,
    }
    for i in range(len(p.displacement)) if at is None else at:
        cells: Row = {name: _cell(float(v[i])) for name, v in columns.items()}
        press = PressStatus(int(p.press_status[i])) if p.status.predicts else None
        words = {
            "press": None if press is None else press.name.lower(),
            "status": p.status.name.lower(),
            "message": p.message,
        }
        yield _place(p, i) | cells | words


def joint_rows(
    p: CurvePrediction,
    rings: np.ndarray,
    at: Sequence[int],
    measured: np.ndarray | None = None,
) -> Iterator[Row]:
    """One row per displacement of `at` and ring: deflection and reaction with their bands.

    Args:
        rings: ring positions, mm.
        at: which displacements.
        measured: marker displacement, mm, NaN where there was none; (N, rings).
    """
    half = p.half_width
    noisy = np.hypot(p.joints_se, p.joint_sigma[:, None])
    for i in at:
        for ring, x in enumerate(rings):
            marker = np.nan if measured is None else float(measured[i, ring])
            w, R = float(p.joints[i, ring]), float(p.reactions[i, ring])
            u, v = half * float(p.joints_se[i, ring]), half * float(p.reactions_se[i, ring])
            n = half * float(noisy[i, ring])
            numbers = {
                "joint [mm]": marker, "predicted [mm]": w, "curve_low95 [mm]": w - u,
                "curve_high95 [mm]": w + u, "low95 [mm]": w - n, "high95 [mm]": w + n,
                "reaction [N]": R, "reaction_low95 [N]": R - v, "reaction_high95 [N]": R + v,
            }  # fmt: skip
            cells: Row = {name: _cell(number) for name, number in numbers.items()}
            where: Row = {"ring": ring + 1, "ring s [mm]": float(x)}
            yield _place(p, i) | where | cells


def error_rows(
    compared: Sequence[Compared],
    bad: Sequence[BadCurve],
    tool_radius: float | None,
    rings: np.ndarray,
) -> list[Row]:
    """One row per curve, per contact position, of all, and per curve that could not be used."""
    rows = [_errors("curve", [c], tool_radius, rings) for c in compared]
    good = [c for c in compared if c.prediction.status.predicts]
    places: dict[tuple[float, ...], list[Compared]] = {}
    for c in good:
        p = c.prediction
        if not np.isnan(p.s):
            places.setdefault((round(p.s, 6), round(p.phi, 9), *p.direction), []).append(c)
    for s in sorted(places):
        rows.append(_errors("position", places[s], tool_radius, rings))
    if good:
        rows.append(_errors("all", good, tool_radius, rings))
    status = PredictionStatus.BAD_DATA.name.lower()
    for b in bad:
        row: Row = {"of": "curve", "specimen": b.specimen, "trial": b.trial, "status": status}
        rows.append(row | {"message": b.reason})
    return rows


def _errors(of: str, group: Sequence[Compared], tool_radius, rings) -> Row:
    """Error measures of some curves together."""
    first = group[0]
    one = of == "curve"
    s = [c.prediction.s for c in group]
    residual = np.concatenate([c.residual for c in group])
    force = np.concatenate([c.curve.force for c in group])
    depth = np.concatenate([c.curve.displacement for c in group])
    markers = [c.joint_residual(tool_radius, rings).ravel() for c in group]
    marker = np.concatenate(markers)
    marker = marker[np.isfinite(marker)]
    off_most = float(marker[np.argmax(np.abs(marker))]) if len(marker) else np.nan
    known = np.isfinite(residual)
    peak = float(np.max(np.abs(force)))
    rms = worst = at = covered = np.nan
    if known.any():
        rms = float(np.sqrt(np.mean(residual[known] ** 2)))
        k = int(np.argmax(np.where(known, np.abs(residual), -1)))
        worst, at = float(residual[k]), float(depth[k])
        counts = known & np.concatenate([c.with_force for c in group])
        if counts.any():
            covered = float(np.mean(np.concatenate([c.covered for c in group])[counts]))
    status = max(c.prediction.status for c in group)
    used = sum(c.in_fit == "yes" for c in group)
    return {
        "of": of,
        "specimen": first.curve.specimen if one else "(all)",
        "trial": first.curve.trial if one else "(all)",
        "s [mm]": _cell(s[0]) if of != "all" else None,
        "in_fit": first.in_fit if one else f"{used} of {len(group)}",
        "curves": len(group),
        "samples": int(known.sum()),
        "rms [N]": _cell(rms),
        "worst [N]": _cell(worst),
        "worst at [mm]": _cell(at),
        "peak [N]": peak,
        "rms / peak": _cell(rms / peak if peak > 0 else np.nan),
        "worst / peak": _cell(abs(worst) / peak if peak > 0 else np.nan),
        "coverage95": _cell(covered),
        "rms joints [mm]": float(np.sqrt(np.mean(marker**2))) if len(marker) else None,
        "worst joint [mm]": _cell(off_most),
        "status": status.name.lower(),
        "message": first.prediction.message if one else status.message,
    } | _other_errors(of, group)  # fmt: skip


def _other_errors(of: str, group: Sequence[Compared]) -> Row:
    """Angle, and errors of what the model has beside the force."""
    first = group[0].prediction
    phi, tilt = np.degrees([first.phi, tilt_of(first.direction)]).tolist()
    numbers = {name: q for name, q in FITTED_NUMBERS.items() if name in first.others}
    angles = {"phi [deg]": phi, "tilt [deg]": tilt} if numbers else {}
    cells: Row = {name: angle if of != "all" else None for name, angle in angles.items()}
    for name, q in numbers.items():
        off = np.concatenate([c.other_residual(name) for c in group])
        off = off[np.isfinite(off)]
        rms = float(np.sqrt(np.mean(off**2))) if len(off) else None
        cells[f"rms {q.short} [{q.unit}]"] = rms
    return cells
