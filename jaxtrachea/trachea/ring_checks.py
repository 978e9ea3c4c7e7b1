"""Whether crests are a row of rings, and whether all that may be there was seen."""

import itertools
import math

import numpy as np

from jaxtrachea.trachea.crests import SMOOTH, Crests, starts
from jaxtrachea.trachea.mesh import MeshError

#: A distance of neighbours that is noted, over the median one; a lean that is, degrees.
WIDE, LEANS = 1.6, 3.0
#: Distance from an end within which no ring is expected, over the usual one.
END = 0.25
#: Share of the front that has to show a ring of the relief; size of a hole in cartilage that may
#: cost a ring, over the radius (Visible Human, pierced at random: lost from 0.25, moved from 0.17).
LEAST_SHARE, HOLE = 0.4, 0.15


def check_cartilage(radius, holes) -> None:
    """Refuse cartilage with a hole that may cost a ring."""
    for hole in holes:
        if hole.in_front and hole.size > HOLE * radius:
            raise _hidden(f"the cartilage has {hole.words}")


def check_seen(s, profile, found, holes) -> None:
    """Refuse a wall of which most of the front is not there where a ring may be."""
    seen = np.flatnonzero(np.isfinite(profile))
    step, far = s[1] - s[0], s[-1] + s[0]
    blind = [(s[i], s[j]) for i, j in itertools.pairwise(seen) if s[j] - s[i] > SMOOTH + 2 * step]
    if len(found) > 1:
        pitch, last = float(np.median(np.diff(found))), far - s[seen[-1]]
        blind += [(0.0, s[seen[0]])] * _goes_on(found[0], s[seen[0]], pitch)
        blind += [(far - last, far)] * _goes_on(far - found[-1], last, pitch)
    for low, high in blind:
        there = (f": {hole.words}" for hole in holes if hole.s[0] < high and hole.s[1] > low)
        raise _hidden(
            f"most of the front is not there at s = {low:.1f} to {high:.1f} mm{next(there, '')}"
        )


def _goes_on(first, blind, pitch) -> bool:
    """Whether a row that begins `first` from an end may go on in the `blind` stretch there."""
    at, near = first - pitch * np.arange(1, first / pitch + 1), END * pitch
    return bool(blind > near and np.any((at > near) & (at < blind + near)))


def _hidden(found: str) -> MeshError:
    return MeshError(
        f"{found}; a ring may be lost there",
        cure="close the hole, or give {}",
        arguments=("ring_positions=",),
    )


def check_crests(crests: Crests, s, rows, radius, own) -> list[str]:
    """Notes on how sure the rings are; refuses a thread, and a ring that few rays see."""
    found, notes = crests.positions, []
    leans = [_usual_lean(v, radius) for v in (crests.sideways, crests.forwards)]
    if turns := starts(s, rows, found):
        raise MeshError(
            f"its crests run on round the tube, by {abs(turns)} of their distance at each turn, "
            f"and lean by {abs(leans[0]):.0f} degrees to the side: a thread or a helix, or rings "
            "that lean; expected rings across the centreline",
            cure="give {} and {} if they are such rings",
            arguments=("ring_positions=", "centreline="),
        )
    worst = int(np.argmin(crests.shares))
    if not own and crests.shares[worst] < LEAST_SHARE:
        raise MeshError(
            f"the ring at s = {found[worst]:.1f} mm is seen on {100 * crests.shares[worst]:.0f} % "
            f"of the front, expected {100 * LEAST_SHARE:.0f} % or more",
            cure="repair the surface there, or give {}",
            arguments=("ring_positions=",),
        )
    unsure = int(np.argmax(crests.errors))
    least = f"on {100 * crests.shares[unsure]:.0f} % of the front"
    error = crests.errors[unsure]
    if np.isfinite(error):
        least = f"+- {max(error, 0.01):.2f} mm, {least}"
    notes.append(f"the least sure ring: s = {found[unsure]:.1f} mm, {least}")
    if max(abs(lean) for lean in leans) > LEANS:
        notes.append(
            f"the rings lean by {abs(leans[0]):.0f} degrees to the side and {abs(leans[1]):.0f} "
            "forwards or backwards; they are read as if they stood across the centreline"
        )
    gaps = np.diff(found)
    for i in np.flatnonzero(gaps > WIDE * np.median(gaps)):
        notes.append(
            f"from s = {found[i]:.1f} to {found[i + 1]:.1f} mm are "
            f"{gaps[i] / np.median(gaps):.1f} of the usual distance: does a ring lack there?"
        )
    return notes


def _usual_lean(slopes, radius) -> float:
    """Median angle of the rings' planes, degrees."""
    seen = np.isfinite(slopes)
    return math.degrees(math.atan(np.median(slopes[seen]) / radius)) if seen.any() else 0.0
