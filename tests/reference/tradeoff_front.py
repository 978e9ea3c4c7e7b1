"""The Pareto front of the levels of a scene: what no other beats in error and time together."""

from typing import Any

import numpy as np


def worst(point: dict[str, Any]) -> float:
    """Largest of the relative errors of force, joints and surface."""
    values = [point["errors"][k] for k in ("force", "joints", "surface")]
    return max(float(v) for v in values if v is not None)


def pareto(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Indices of the points that no other beats in both, by rising x."""
    order = np.lexsort((y, x))
    best, front = np.inf, []
    for i in order:
        if np.isfinite(x[i]) and y[i] < best:
            best = y[i]
            front.append(i)
    return np.array(front, int)


def error(point: dict[str, Any], which: str) -> float:
    """Relative error of derivatives, or the worst of the others."""
    return float(point["errors"]["gradient"]) if which == "gradient" else worst(point)


def front(points: list[dict[str, Any]], which: str) -> np.ndarray:
    """Indices of the Pareto front of error and time."""
    errors = np.array([error(p, which) for p in points])
    times = np.array([time(p, which) for p in points])
    return pareto(np.where(np.isfinite(times), errors, np.nan), times)


def time(point: dict[str, Any] | None, which: str) -> float:
    """Median seconds, NaN where that was not timed."""
    return point["times"][which]["median"] if point and which in point["times"] else np.nan
