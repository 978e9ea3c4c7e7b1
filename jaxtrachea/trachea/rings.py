"""Which side of a surface is anterior, and where its rings are: from cartilage or from relief."""

import math
from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.centreline import Shape
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.sections import ANGLES, RAYS

#: The arc on which rings are looked for: the anterior side, clear of the rings' ends.
ARC = np.abs(ANGLES) < 1.6
#: What a row of rings is: their least number; distance of neighbours over the radius (17 rings of a
#: human trachea: 0.7; table 1: 0.9); distance over the median one; share of the length they take.
FEWEST, PITCH, EVEN, SHARE = 4, (0.2, 2.0), (0.4, 2.2), 0.4
#: Cartilage may fork and join, which gives two crests near each other (Visible Human male: 0.35).
FORKED = 0.2


class Rings(NamedTuple):
    """What was found of the rings; `source` in words."""

    positions: np.ndarray
    half_angle: float
    radius: float
    height: float
    source: str


def find_anterior(shape: Shape, given=None) -> Shape:
    """Turn the frames so that angle 0 is the anterior midline.

    In this order: the direction given; opposite the gap of the cartilage; the side on which the
    relief is; opposite the flat side of the wall.
    """
    if given is not None:
        mean = np.asarray(given, float)
        across = np.einsum("nji,j->ni", shape.line.frames, mean).mean(axis=0)
        if np.hypot(across[1], across[2]) < 0.2 * max(np.linalg.norm(mean), 1e-300):
            raise MeshError("anterior= points along the tube; expected a direction across it")
        angle = math.atan2(across[2], across[1])
    elif shape.cartilage is not None:
        angle, _ = _side(shape.cartilage.mean(axis=0))
    else:
        angle, clear = _side(np.nan_to_num(_middle(_relief(shape) ** 2)))
        if not clear or not _has_relief(shape):
            angle = _opposite_flat(shape)
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    line = shape.line._replace(frames=shape.line.frames @ turn)

    def moved(v):
        return np.stack(
            [np.interp(ANGLES + angle, ANGLES, row, period=2 * math.pi) for row in v.astype(float)]
        )

    cartilage = None if shape.cartilage is None else moved(shape.cartilage) > 0.5
    return Shape(line, shape.s, moved(shape.radius), cartilage)


def find_rings(shape: Shape, positions=None, half_angle=None) -> Rings:
    """Ring positions, opening and size, from the cartilage or else from the relief of the wall."""
    step, mean = shape.s[1] - shape.s[0], _middle(shape.radius)
    radius = float(np.mean(mean[ARC]))
    if shape.cartilage is not None:
        source, strength = "the cartilage", shape.cartilage.mean(axis=0)
        profile, fall = shape.cartilage[:, ARC].mean(axis=1), 0.15
    else:
        source, relief = "the relief of the wall", _relief(shape)
        strength = np.sqrt(np.nan_to_num(_middle(relief**2)))
        inner = np.nan_to_num(np.mean(relief[:, ARC], axis=1))
        fall = max(0.01 * radius, 0.3 * float(np.ptp(inner)))
        profile = np.mean(_relief(shape, to_ends=True)[:, ARC], axis=1)
        seen = np.flatnonzero(np.isfinite(profile))
        profile = np.interp(np.arange(len(profile)), seen, profile[seen]) if len(seen) else inner
    n = max(1, round(1.2 / step))
    padded = np.pad(profile, (n // 2, n - 1 - n // 2), "edge")
    smooth = np.convolve(padded, np.ones(n) / n, "valid")
    if positions is not None:
        found, source = np.asarray(positions, float), "the positions given"
    else:
        if shape.cartilage is not None:  # which may begin or end with the surface
            smooth = np.pad(smooth, 1)
            found = shape.s[np.clip(_peaks(smooth, fall) - 1, 0, len(shape.s) - 1)]
        else:
            found = shape.s[_peaks(smooth, fall)]
        _check_row(found, source, radius, shape.line.s[-1], shape.cartilage is not None)
    if half_angle is None:
        known = shape.cartilage is not None or positions is None
        half_angle = _half_angle(strength) if known else 2 * math.pi / 3
    height = 4.0 / 12.6 * radius if len(found) < 2 else 0.4 * float(np.median(np.diff(found)))
    if shape.cartilage is not None:
        height = float(profile.sum() * step / len(found))
    return Rings(found, half_angle, radius, height, source)


def _check_row(found, source, radius, length, own) -> None:
    """Refuse crests that are no row of rings.

    Args:
        found: their positions, mm.
        source: in words.
        radius: of the wall, mm.
        length: of the tube, mm.
        own: whether they come from the cartilage itself: then they may fork, and be fewer.
    """
    gaps, fewest = np.diff(found), 2 if own else FEWEST
    pitch = float(np.median(gaps)) if len(gaps) else 0.0
    least = FORKED if own else EVEN[0]
    if len(found) < fewest:
        fault = f"at least {fewest}"
    elif not PITCH[0] * radius <= pitch <= PITCH[1] * radius:
        fault = f"them {PITCH[0] * radius:.2g} to {PITCH[1] * radius:.2g} mm apart"
    elif gaps.min() < least * pitch or gaps.max() > EVEN[1] * pitch:
        fault = f"them even, {least * pitch:.2g} to {EVEN[1] * pitch:.2g} mm apart"
    elif len(found) * pitch < SHARE * length and not own:
        fault = f"them on {100 * SHARE:.0f} % of its {length:.4g} mm or more"
    else:
        return
    at = ", ".join(f"{v:.1f}" for v in found[:8]) + (", ..." if len(found) > 8 else "")
    raise MeshError(
        f"found {len(found)} rings in {source}{f' (s = {at} mm)' if at else ''}, expected {fault}",
        cure="a lumen shows none: give the outer wall, or {}, the cartilage's own surface, or {}",
        arguments=("rings=", "ring_positions="),
    )


def _relief(shape: Shape, to_ends: bool = False) -> np.ndarray:
    """How far the contour stands out of its surroundings along s, mm.

    The surroundings: the mean over a window as long as the radius. Within half a window of an end
    the relief is NaN, or else they are continued straight, so that a ring there is seen too; NaN
    then where the contour runs into a lid.
    """
    step = shape.s[1] - shape.s[0]
    span = max(5, int(np.nanmean(shape.radius) / step) | 1)
    out = np.full_like(shape.radius, np.nan)
    if len(shape.s) <= 2 * span:
        return out
    window, half = np.ones(span) / span, span // 2
    level = np.stack([np.convolve(v, window, "valid") for v in shape.radius.T], axis=1)
    out[half:-half] = shape.radius[half:-half] - level
    if not to_ends:
        return out
    i = np.arange(half)[:, None]

    def slope(first, last):
        return (last - first) / (span - 1)

    out[:half] = shape.radius[:half] - level[0] + slope(level[0], level[span - 1]) * (half - i)
    out[-half:] = shape.radius[-half:] - level[-1] - slope(level[-span], level[-1]) * (i + 1)
    steep = np.abs(np.diff(shape.radius, axis=0)).mean(axis=1) > step  # a lid: more than 45 deg
    low, high = np.flatnonzero(steep[:half]), np.flatnonzero(steep[-half:])
    out[: low[-1] + 1 if len(low) else 0] = np.nan
    out[len(out) - half + high[0] if len(high) else len(out) :] = np.nan
    return out


def _middle(rows):
    """Median over the stations that see the whole contour."""
    whole = np.isfinite(rows).all(axis=1)
    return np.mean(rows[whole], axis=0) if whole.any() else np.full(RAYS, np.nan)


def _has_relief(shape: Shape) -> bool:
    """Whether the waves of the relief are more than 1 % of the radius."""
    return bool(np.sqrt(_middle(_relief(shape) ** 2)).max() > 0.01 * np.nanmean(shape.radius))


def _side(strength) -> tuple[float, bool]:
    """Direction in which `strength` lies, and whether it clearly does."""
    total = np.sum(strength * np.exp(1j * ANGLES))
    return float(np.angle(total)), bool(np.abs(total) > 0.1 * max(strength.sum(), 1e-300))


def _opposite_flat(shape: Shape) -> float:
    """Opposite the angle at which a D-shaped contour is nearest to its centre."""
    mean = _middle(shape.radius)
    smooth = np.mean([np.roll(mean, k) for k in range(-4, 5)], axis=0)
    low = int(np.argmin(smooth))
    others = np.roll(smooth, -low)[RAYS // 6 : -RAYS // 6]
    if not others.min() > 1.03 * smooth[low]:
        raise MeshError(
            "no flat side, no relief of rings: which side is anterior?",
            cure="give anterior= or {}",
            arguments=("rings=",),
        )
    return float(ANGLES[low] + math.pi)


def _half_angle(strength) -> float:
    """Half of the arc about 0 on which `strength` is above half its usual value there."""
    level = 0.5 * np.median(strength[ARC])
    right = np.argmax(np.append(strength[RAYS // 2 :] < level, True))
    left = np.argmax(np.append(strength[: RAYS // 2][::-1] < level, True))
    return float(right + left) * math.pi / RAYS


def _peaks(profile, fall) -> np.ndarray:
    """Centres of the waves of `profile` that rise and fall by more than `fall`."""
    found, high, low, rising = [], 0, 0, False
    for i, value in enumerate(profile):
        if value > profile[high]:
            high = i
        if value < profile[low]:
            low = i
        if rising and value < profile[high] - fall:
            found, low, rising = [*found, high], i, False
        elif not rising and value > profile[low] + fall:
            high, rising = i, True
    tops = []
    for top in found:  # a crest cut flat: its middle
        level = profile[top] - fall / 2
        first, last = top, top
        while first > 0 and profile[first - 1] > level:
            first -= 1
        while last < len(profile) - 1 and profile[last + 1] > level:
            last += 1
        tops.append(round((first + last) / 2))
    return np.array(tops, int)
