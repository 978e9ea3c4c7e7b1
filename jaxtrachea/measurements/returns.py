"""A record that comes back: its zero at the end, and its last full loading against the first."""

import numpy as np

from jaxtrachea.measurements.segments import Segments
from jaxtrachea.measurements.turning import white_noise

#: The zero has moved, or a cycle is softer, from these shares of the peak on.
DRIFT, SOFTER = 0.02, 0.03
#: Standard errors from which either is no noise.
_SIGMAS = 5.0
#: Share of the travel that counts as one place.
_NEAR = 0.01


def _slope(travel: np.ndarray, force: np.ndarray, sigma: float) -> tuple[float, float]:
    """Slope of a line through samples, N/mm, and its standard error."""
    x = travel - travel.mean()
    square = float(x @ x)
    if not square > 0:
        return 0.0, np.inf
    slope = float(x @ force) / square
    rest = force - force.mean() - slope * x
    scatter = max(sigma, float(np.sqrt(rest @ rest / max(rest.size - 2, 1))))
    return slope, scatter / square**0.5


def drift(displacement: np.ndarray, force: np.ndarray, found: Segments) -> str | None:
    """That the force is another when the tool is back where it began."""
    if not any(p.kind == "unload" for p in found.parts) or displacement.size < 20:
        return None
    travel = found.direction * displacement
    span = float(np.ptp(travel))
    if travel[-1] > travel[0] + _NEAR * span:
        return None
    away = travel <= travel[0] + _NEAR * span
    first = int(np.argmin(away)) or 1
    last = int(np.argmin(away[::-1])) or 1
    begin, end = force[:first], force[-last:]
    peak = float(np.ptp(force))
    error = white_noise(force) * (1 / begin.size + 1 / end.size) ** 0.5
    moved = float(end.mean() - begin.mean())
    if abs(moved) <= max(DRIFT * peak, _SIGMAS * error):
        return None
    return (
        f"the zero has drifted: the force is {begin.mean():.3g} N at first and {end.mean():.3g} N "
        f"when the tool is back ({100 * abs(moved) / peak:.2g} % of the peak), unless the record "
        "begins under load"
    )


def softer(displacement: np.ndarray, force: np.ndarray, found: Segments) -> str | None:
    """That the last full loading is softer, or stiffer, than the first."""
    if len(found.cycles) < 2:
        return None
    travel, values = found.direction * displacement, found.direction * force
    cycles = [slice(foot, peak + 1) for foot, peak in (found.cycles[0], found.cycles[-1])]
    depth = min(float(travel[c].max()) for c in cycles)
    height = min(depth - float(travel[c.start]) for c in cycles)
    sigma, heights, errors = white_noise(values), [], []
    for c in cycles:
        upper = np.abs(travel[c] - depth + 0.1 * height) <= 0.1 * height
        x, y = travel[c][upper] - depth + 0.1 * height, values[c][upper]
        if y.size < 3:
            return None
        slope, _ = _slope(x, y, sigma)
        heights.append(float(y.mean() - slope * x.mean()))
        errors.append(max(sigma, float(np.std(y - slope * x, ddof=2))) / y.size**0.5)
    rise = heights[0] - float(np.mean(values[cycles[0]][:3]))
    change = (heights[1] - heights[0]) / rise if rise > 0 else 0.0
    error = float(np.hypot(*errors)) / max(rise, 1e-300)
    if abs(change) <= max(SOFTER, _SIGMAS * error):
        return None
    word = "softer" if change < 0 else "stiffer"
    return (
        f"the last of {len(found.cycles)} full loadings is {100 * abs(change):.2g} % {word} than "
        f"the first, at {found.direction * (depth - 0.1 * height):.3g} mm"
    )
