"""What of every record is used: for `check`, terminal, report.md, summary.csv and curves.csv."""

from collections import Counter
from collections.abc import Iterator, Sequence
from hashlib import sha256

from jaxtrachea.files.table import Column, Table
from jaxtrachea.measurements.observed import FURTHER_FIELDS
from jaxtrachea.measurements.read import BadCurve, Curve
from jaxtrachea.measurements.usage import CAUSES

#: Share of left-out samples from which a fit says so.
CUT = 0.1
#: Names in a sentence; the files hold all.
_NAMES = 10
_BAD = (*map(Column, ("specimen", "trial", "kind")), Column("what", "message"), Column("cure"))


def bad_table(bad: Sequence[BadCurve]) -> Table:
    """What could not be used, and why."""
    return Table(map(vars, bad), _BAD, title="Curves that could not be used")


def usage_rows(curves: Sequence[Curve]) -> Iterator[dict[str, object]]:
    """One row per curve for curves.csv."""
    for curve in curves:
        seen = curve.usage
        if seen is None:
            continue
        row: dict[str, object] = {
            "specimen": curve.specimen,
            "trial": curve.trial,
            "used": seen.used,
            "recorded": seen.recorded,
            "from_mm": float(curve.displacement.min()),
            "to_mm": float(curve.displacement.max()),
            "recorded_from_mm": seen.low,
            "recorded_to_mm": seen.high,
        }
        row |= {
            f"left_out_{cause.replace(' ', '_')}": seen.left_out.get(cause, 0) for cause in CAUSES
        }
        yield row | {"segments": seen.segments, "remarks": "; ".join(seen.remarks)}


def lane_cells(curves: Sequence[Curve]) -> dict[str, object]:
    """Cells of summary.csv on the curves of a lane."""
    known = [(c, c.usage) for c in curves if c.usage is not None]
    recorded = sum(seen.recorded for _, seen in known)
    remarks: dict[str, list[str]] = {}
    for curve, seen in known:
        for remark in seen.remarks:
            remarks.setdefault(remark, []).append(curve.trial)
    several = len(curves) > 1
    return {
        "force_samples": sum(seen.used for _, seen in known),
        "recorded": recorded,
        "cut": 1 - sum(seen.used for _, seen in known) / recorded if recorded else 0.0,
        "remarks": "; ".join(
            f"{', '.join(trials)}: {remark}" if several else remark
            for remark, trials in remarks.items()
        ),
    }


def usage_lines(curves: Sequence[Curve]) -> list[str]:
    """A line for every curve that is not used as it is, and one for each remark on it."""
    lines = []
    for curve in curves:
        seen = curve.usage
        if seen is None or (seen.used == seen.recorded and not seen.remarks):
            continue
        low, high = float(curve.displacement.min()), float(curve.displacement.max())
        lines.append(
            f"{curve.specimen} {curve.trial}: {seen.used} of {seen.recorded} samples, {low:.3g} … "
            f"{high:.3g} of {seen.low:.3g} … {seen.high:.3g} mm"
        )
        causes = ", ".join(f"{CAUSES[cause]} {n}" for cause, n in seen.left_out.items())
        lines += [f"  segments: {seen.segments}"] if len(seen.parts) > 1 else []
        lines += [f"  left out: {causes}"] if causes else []
        lines += [f"  {remark}" for remark in seen.remarks]
    return lines


def sentences(curves: Sequence[Curve]) -> list[str]:
    """What a fit says of its curves: those cut, remarks by kind, and the same curve twice."""
    return [*_cut(curves), *_remarked(curves), *same_curves(curves)]


def _cut(curves: Sequence[Curve]) -> Iterator[str]:
    """Curves that are cut by more than a tenth, counted, with causes and names."""
    cut = [(c, c.usage) for c in curves if c.usage is not None and c.usage.cut > CUT]
    if not cut:
        return
    causes = Counter(
        max(seen.left_out, key=seen.left_out.__getitem__) for _, seen in cut if seen.left_out
    )
    why = ", ".join(f"{CAUSES[cause]} {n}" for cause, n in causes.most_common())
    yield (
        f"more than {100 * CUT:.0f} % of the samples is left out of {len(cut)} of {len(curves)} "
        f"curves (mostly {why}): {_listed([c for c, _ in cut])}"
    )


def _remarked(curves: Sequence[Curve]) -> Iterator[str]:
    """Holds and sizes, which touch what the estimates mean."""
    seen = [(c, remark) for c in curves if c.usage is not None for remark in c.usage.remarks]
    topics = {
        "hold": "holds",
        "hard to believe": "sizes that are hard to believe",
        "the loading ends there": "the force falls while the tool goes on",
        "are no forces": "a flat top",
        "has drifted": "a zero that has drifted",
        "than the first, at": "cycles that differ",
    }
    for word, topic in topics.items():
        hits = [(c, remark) for c, remark in seen if word in remark]
        if hits:
            names = _listed([c for c, _ in hits])
            count = len({id(c) for c, _ in hits})  # one curve may have several remarks
            first = f"{hits[0][0].specimen} {hits[0][0].trial}: {hits[0][1]}"
            yield f"{topic} in {count} of {len(curves)} curves ({first}): {names}"


def same_curves(curves: Sequence[Curve]) -> Iterator[str]:
    """Curves with the same numbers under several names."""
    groups: dict[bytes, list[Curve]] = {}
    for curve in curves:
        digest = sha256(curve.displacement.tobytes())
        digest.update(curve.force.tobytes())
        for name in FURTHER_FIELDS:
            more = getattr(curve, name)
            digest.update(b"" if more is None else more.tobytes())
        groups.setdefault(digest.digest(), []).append(curve)
    for group in groups.values():
        if len(group) > 1:
            yield f"the same curve under {len(group)} names: {_listed(group)}"


def _listed(curves: Sequence[Curve]) -> str:
    """Names of the first curves, and how many more."""
    names = list(dict.fromkeys(f"{c.specimen} {c.trial}" for c in curves))
    more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
    return ", ".join(names[:_NAMES]) + more


def usage_section(
    curves: Sequence[Curve], notes: Sequence[str] = (), more: Sequence[str] = ()
) -> list[str]:
    """The section of the report, if there is anything to say."""
    said = [f"{text[:1].upper()}{text[1:]}" for text in (*sentences(curves), *more)]
    said += notes  # which may begin with the name of a file
    if not said:
        return []
    return [
        "## Curves as used",
        "\n".join(f"- {sentence}." for sentence in said),
        "Where the force relaxes in a hold, an elastic fit gives the stiffness at the speed of the "
        "loading, not at rest. Samples used and left out of every curve, with segments and "
        "reasons: `curves.csv` (docs/measurements.md).",
    ]
