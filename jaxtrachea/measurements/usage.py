"""What of a record is used, and what a user should know about the rest."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from jaxtrachea.measurements.holds import Hold
from jaxtrachea.measurements.record_faults import Faults
from jaxtrachea.measurements.segments import FULL, Segment, Segments

#: Loading rules that choose a loading.
CHOOSING = ("last", "first", "loading")
#: A fall of the force in a hold, as a share, from which it is worth a word.
RELAXED = 0.01
#: Causes of samples left out, for people.
CAUSES = {
    "before": "earlier loadings",
    "rest": "rest",
    "hold": "holds",
    "turning back": "turning back",
    "after": "after the loading",
    "break": "after a break",
    "saturation": "saturated",
    "window": "displacement window",
}


@dataclass(frozen=True)
class Usage:
    """What of a record is used.

    Attributes:
        recorded: samples in the file.
        used: samples of the curve.
        low: smallest displacement recorded, mm.
        high: largest displacement recorded, mm.
        parts: segments of the record, in order.
        left_out: cause (see `CAUSES`) -> samples.
        remarks: what should be known, one sentence each.
    """

    recorded: int
    used: int
    low: float
    high: float
    parts: tuple[Segment, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @property
    def cut(self) -> float:
        """Share of the samples that is left out."""
        return 1 - self.used / self.recorded

    @property
    def segments(self) -> str:
        """``load 1-200, hold 201-500``: samples counted from 1."""
        return ", ".join(f"{p.kind} {p.start + 1}-{p.stop}" for p in self.parts)


def usage(
    displacement: np.ndarray,
    keep: np.ndarray,
    found: Segments | None,
    loading: str,
    unit: str,
    faulty: Faults,
) -> Usage:
    """What is used of a record.

    Args:
        displacement: (N,) mm, of the record.
        keep: (N,) samples of the curve.
        found: segments of the record; None: it only unloads.
        unit: of the duration of holds, ``"s"`` or ``"samples"``.
        faulty: samples left out after a break or on a flat top, and what is said of the record.
    """
    used = int(np.count_nonzero(keep))
    chosen = found is not None and loading in CHOOSING
    left_out = dict(found.left_out) if found is not None and chosen else {}
    causes = {"break": faulty.broken, "saturation": faulty.saturated}
    left_out |= {cause: int(which.sum()) for cause, which in causes.items() if which.any()}
    window = keep.size - sum(left_out.values()) - used
    if window > 0:
        left_out["window"] = window
    remarks: tuple[str, ...] = ()
    if found is not None and (len(found.parts) > 1 or left_out):
        remarks = tuple(_remarks(found, unit) if chosen else _mixed(found, unit, loading))
    return Usage(
        recorded=keep.size,
        used=used,
        low=float(displacement.min()),
        high=float(displacement.max()),
        parts=() if found is None else found.parts,
        left_out=left_out,
        remarks=(*remarks, *faulty.remarks),
    )


def lasting(hold: Hold, unit: str) -> str:
    """``10 s``, or ``300 samples`` where there is no time."""
    return f"{hold.duration:.3g} {unit}"


def _relaxing(holds: tuple[Hold, ...]) -> str:
    """What the force does in holds."""
    most = max(hold.relaxed for hold in holds)
    if most < RELAXED:
        return "the force does not fall in it" if len(holds) == 1 else "the force does not fall"
    upto = "" if len(holds) == 1 else "up to "
    return f"the force relaxes by {upto}{100 * most:.2g} %"


def _remarks(found: Segments, unit: str) -> Iterator[str]:
    """On the loading that was chosen."""
    if found.full > 1:
        yield f"full loading {found.chosen} of {found.full} is used"
    if found.last_share < FULL:
        yield (
            f"the last loading reaches {100 * found.last_share:.2g} % of the largest only; "
            "the last full one is used"
        )
    if found.hold is not None:
        holds = (found.hold,)
        yield f"hold of {lasting(found.hold, unit)} at the peak left out: {_relaxing(holds)}"
    if found.steps and found.stepwise:
        yield f"{len(found.steps)} holds on the way up kept as steps: {_relaxing(found.steps)}"
    elif found.steps:
        several = f"{len(found.steps)} holds" if len(found.steps) > 1 else "hold"
        yield f"{several} on the way up left out: {_relaxing(found.steps)}"
    if "turning back" in found.left_out:
        yield "the tool turns back on the way: left out until it is where it was"


def _mixed(found: Segments, unit: str, loading: str) -> Iterator[str]:
    """On what an elastic fit would mix, where every sample is wanted."""
    if loading != "all":
        return
    others = []
    holds = (*found.steps, *(() if found.hold is None else (found.hold,)))
    if holds:
        longest = max(holds, key=lambda hold: hold.duration)
        others.append(f"a hold of {lasting(longest, unit)} ({_relaxing(holds)})")
    if found.loadings > 1:
        others.append(f"{found.loadings} loadings")
    if any(part.kind == "unload" for part in found.parts):
        others.append("unloading")
    if others:
        yield f"every sample is used, with {' and '.join(others)}: an elastic fit mixes them"
