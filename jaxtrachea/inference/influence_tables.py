"""Rows of what `influence` found, for files and report (docs/results.md)."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxtrachea.inference.influence import Influence


def sample_rows(found: Influence) -> Iterator[dict[str, Any]]:
    """One row per observed force and marker for influence.csv."""
    study, of = found.result.study, found.of
    names = [p.name for p in study.free]
    for lane, curves in enumerate(study.curves):
        for t, curve in enumerate(curves):
            for e in np.flatnonzero(np.isfinite(of.leverage[lane, t])):
                at = lane, t, e
                sample, ring = _place(found, int(e))
                yield {
                    "specimen": curve.specimen,
                    "trial": curve.trial,
                    "sample": sample + 1,
                    "ring": "" if ring is None else ring + 1,
                    "displacement_mm": float(curve.displacement[sample]),
                    "leverage": float(of.leverage[at]),
                    "studentised": float(of.studentised[at]),
                    "studentised_external": float(found.external[at]),
                    "cook": float(of.cook[at]),
                } | {
                    f"{name} {what}": float(v[lane, t, i, e])
                    for i, name in enumerate(names)
                    for what, v in (("per sigma", of.per_sigma), ("left out", of.left_out))
                }


def curve_rows(found: Influence) -> Iterator[dict[str, Any]]:
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


def _place(found: Influence, entry: int) -> tuple[int, int | None]:
    """Sample and ring (None: a force) of an entry of the residual."""
    lanes = found.result.study.lanes
    samples = lanes.force.shape[-1]
    if entry < samples or lanes.joints is None:
        return entry, None
    sample, ring = divmod(entry - samples, lanes.joints.shape[-1])
    return sample, ring


def sample_label(found: Influence, lane: int, t: int, entry: int) -> str:
    """Where a sample is, in words: 2.5 mm, or 2.5 mm, ring 3."""
    sample, ring = _place(found, entry)
    where = f"{found.result.study.curves[lane][t].displacement[sample]:.3g} mm"
    return where if ring is None else f"{where}, ring {ring + 1}"
