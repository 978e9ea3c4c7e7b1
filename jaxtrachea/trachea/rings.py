"""Which side of a surface is anterior, and where its rings are: from cartilage or from relief."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxtrachea.trachea.centreline import Shape
from jaxtrachea.trachea.crests import ARC, crests_at, peaks, profile_of, relief, smoothed
from jaxtrachea.trachea.holes import Hole
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.ring_checks import check_cartilage, check_crests, check_seen
from jaxtrachea.trachea.sections import ANGLES, RAYS

#: What a row of rings is: their least number; distance of neighbours over the radius (17 rings of a
#: human trachea: 0.7; table 1: 0.9); distance over the median one; share of the length they take.
FEWEST, PITCH, EVEN, SHARE = 4, (0.2, 2.0), (0.4, 2.2), 0.4
#: Cartilage may fork and join, which gives two crests near each other (Visible Human male: 0.35).
FORKED = 0.2


class Rings(NamedTuple):
    """What was found of the rings.

    Attributes:
        positions: mm.
        errors: standard errors of these, mm; NaN where they are given.
        shares: of the front that shows each ring; NaN where they are given.
        half_angle: rad.
        radius: mm.
        height: mm.
        notes: from what, and how sure they are.
    """

    positions: np.ndarray
    errors: np.ndarray
    shares: np.ndarray
    half_angle: float
    radius: float
    height: float
    notes: tuple[str, ...]


def find_anterior(shape: Shape, given=None) -> Shape:
    """Turn the frames so that angle 0 is the anterior midline.

    In this order: the direction given; opposite the gap of the cartilage; the side on which the
    relief is; opposite the flat side of the wall.
    """
    if given is not None:
        across = np.einsum("nji,j->ni", shape.line.frames, given).mean(axis=0)
        if np.hypot(across[1], across[2]) < 0.2 * np.linalg.norm(given):
            raise MeshError("anterior= points along the tube; expected a direction across it")
        angle = math.atan2(across[2], across[1])
    elif shape.cartilage is not None:
        angle, _ = _side(shape.cartilage.mean(axis=0))
    else:
        strength = _middle(relief(shape) ** 2)
        angle, clear = _side(np.nan_to_num(strength))
        # Waves of less than 1 % of the radius are no relief.
        if not clear or not np.sqrt(strength).max() > 0.01 * np.nanmean(shape.radius):
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


def find_rings(shape: Shape, positions=None, half_angle=None, holes: Sequence[Hole] = ()) -> Rings:
    """Ring positions, opening and size, from the cartilage or else from the relief of the wall.

    Args:
        shape: the contour, its front at angle 0.
        positions: those known, mm.
        half_angle: that known, rad.
        holes: of the surface that shows the rings, the largest first.

    Raises:
        MeshError: there is no row of rings, or a hole may hide one.
    """
    step, own = shape.s[1] - shape.s[0], shape.cartilage is not None
    radius = float(np.mean(_middle(shape.radius)[ARC]))
    if shape.cartilage is not None:
        source, rows = "the cartilage", shape.cartilage.astype(float)
        strength, profile, fall = rows.mean(axis=0), rows[:, ARC].mean(axis=1), 0.15
    else:
        source, rows = "the relief of the wall", relief(shape, to_ends=True)
        strength = np.sqrt(np.nan_to_num(_middle(relief(shape) ** 2)))
        profile = profile_of(rows)
        inner = profile[np.isfinite(relief(shape)).any(axis=1) & np.isfinite(profile)]
        fall = max(0.01 * radius, 0.3 * float(np.ptp(inner)) if len(inner) else 0.0)
    notes = []
    if positions is not None:
        found, source = positions, "the positions given"
        errors = shares = np.full(found.shape, np.nan)
    else:
        if own:
            check_cartilage(radius, holes)
        smooth = smoothed(profile, step)
        # cartilage may begin or end with the surface
        tops = peaks(np.pad(smooth, 1), fall) - 1 if own else peaks(smooth, fall)
        crests = crests_at(shape.s, rows, smooth, tops, fall)
        found, errors, shares = crests.positions, crests.errors, crests.shares
        if not own:
            check_seen(shape.s, profile, found, holes)
        _check_row(found, source, radius, shape.line.s[-1], own, holes)
        notes = check_crests(crests, shape.s, rows, radius, own)
    if half_angle is None:
        known = own or positions is None
        half_angle = _half_angle(strength) if known else 2 * math.pi / 3
    height = 4.0 / 12.6 * radius if len(found) < 2 else 0.4 * float(np.median(np.diff(found)))
    if own:
        height = float(profile.sum() * step / len(found))
    notes = [f"{len(found)} rings from {source}", *notes]
    return Rings(found, errors, shares, half_angle, radius, height, tuple(notes))


def _check_row(found, source, radius, length, own, holes=()) -> None:
    """Refuse crests that are no row of rings.

    Args:
        found: their positions, mm.
        source: in words.
        radius: of the wall, mm.
        length: of the tube, mm.
        own: whether they come from the cartilage itself: then they may fork, and be fewer.
        holes: of the wall, the largest first.
    """
    gaps, fewest = np.diff(found), 2 if own else FEWEST
    pitch = float(np.median(gaps)) if len(gaps) else 0.0
    least = FORKED if own else EVEN[0]
    if len(found) < fewest:
        fault = f"at least {fewest}"
    elif not PITCH[0] * radius <= pitch <= PITCH[1] * radius:
        fault = f"them {PITCH[0] * radius:.2g} to {PITCH[1] * radius:.2g} mm apart"
    elif gaps.min() < least * pitch or gaps.max() > EVEN[1] * pitch:
        at = int(np.argmax(np.abs(np.log(gaps / pitch))))
        fault = (
            f"them even, {least * pitch:.2g} to {EVEN[1] * pitch:.2g} mm apart (not so from "
            f"{found[at]:.1f} to {found[at + 1]:.1f} mm)"
        )
    elif len(found) * pitch < SHARE * length and not own:
        fault = f"them on {100 * SHARE:.0f} % of its {length:.4g} mm or more"
    else:
        return
    at = ", ".join(f"{v:.1f}" for v in found[:8]) + (", ..." if len(found) > 8 else "")
    cure = "a lumen shows none: give the outer wall, or {}, the cartilage's own surface, or {}"
    arguments = ("rings=", "ring_positions=")
    if own:
        cure, arguments = "where it has no rings of its own (plates, forks) give {}", arguments[1:]
    hole = next((f"; it has {hole.words}" for hole in holes if hole.in_front), "")
    raise MeshError(
        f"found {len(found)} rings in {source}{f' (s = {at} mm)' if at else ''}, expected {fault}"
        f"{hole}",
        cure=cure,
        arguments=arguments,
    )


def _middle(rows):
    """Mean over the stations that see the whole contour; if these are few, of all that is seen."""
    whole = np.isfinite(rows).all(axis=1)
    rows = rows[whole] if whole.mean() > 0.25 else rows
    seen = np.isfinite(rows)
    count = seen.sum(axis=0)
    return np.where(count > 0, np.where(seen, rows, 0).sum(axis=0) / np.maximum(count, 1), np.nan)


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
