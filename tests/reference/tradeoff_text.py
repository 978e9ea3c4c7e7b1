"""Measured trade-offs as Markdown: generated from the JSON lines, nothing else."""

import json
from typing import Any

from jaxtrachea.tradeoff.load import QUIET
from jaxtrachea.tradeoff.table import KINDS

HEAD = ["ladder", "level", "force", "joints", "surface", "contact [mm]", "gradient",
        "part [µs]", "call [µs]", "99 %", "part, lane [µs]", "lane [µs]", "gradient [µs]",
        "compile [s]"]  # fmt: skip

#: What makes two runs different ones.
WHERE = ("date", "device", "processor", "calls", "lanes", "versions")


def lines(rows: list[dict[str, Any]]) -> str:
    """JSON lines of these rows."""
    return "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)


def table(head: list[str], rows: list[list[str]], text: int = 2) -> str:
    """A Markdown table; the first `text` columns are left-aligned."""
    rule = ["---"] * text + ["---:"] * (len(head) - text)
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, rule, *rows]) + "\n"


def cells(point: dict[str, Any]) -> list[str]:
    """A point as the cells of `HEAD`."""
    error, time = point["errors"], point["times"]
    names = ("force", "joints", "surface", "contact_mm", "gradient")
    return [
        point["ladder"], point["level"] + (" *" if point["finest"] else ""),
        *(_error(error[name]) for name in names),
        *(_time(time, v) for v in ("part", "call")), _time(time, "call", "p99"),
        *(_time(time, v) for v in ("part_lane", "lane", "gradient")), f"{time['compile']:.2g}",
    ]  # fmt: skip


def scene_text(rows: list[dict[str, Any]], picture: str = "") -> str:
    """Tables of one scene, the ladders left out, and where it was measured."""
    points = [row for row in rows if "left_out" not in row]
    parts = [f"![{points[0]['scene']}]({picture})\n"] if picture else []
    for kind, title in KINDS.items():
        shown = [cells(point) for point in points if point["kind"] == kind]
        if shown:
            parts.append(f"**{title}**\n\n{table(HEAD, shown)}")
    data = [p for p in points if p.get("data")]
    if data:
        body = [[p["ladder"], p["level"], *(_error(p["data"].get(k)) for k in ("force", "joints"))]
                for p in data]  # fmt: skip
        head = ["ladder", "level", "force", "joints"]
        parts.append(f"**Against the measured curves**\n\n{table(head, body)}")
    left = [f"- `{row['ladder']}`: {row['left_out']}" for row in rows if "left_out" in row]
    if left:
        parts.append("Left out:\n\n" + "\n".join(left) + "\n")
    parts.append(measured(points))
    return "\n".join(parts)


def measured(points: list[dict[str, Any]]) -> str:
    """Where and when, with the load of the machine: a line for each run that differs in these.

    Each names its scenes; where all are rungs of one scene, its ladders.
    """
    rungs = all("ladder" in point for point in points)
    column = "ladder" if rungs and len({point["scene"] for point in points}) == 1 else "scene"
    runs: dict[str, list[dict[str, Any]]] = {}
    for point in points:
        where = {name: point.get(name) for name in WHERE}
        runs.setdefault(json.dumps(where, sort_keys=True), []).append(point)
    return "\n".join(_measured(run, column if len(runs) > 1 else None) for run in runs.values())


def _measured(points: list[dict[str, Any]], column: str | None) -> str:
    first = points[0]
    named = ", ".join(dict.fromkeys(point[column] for point in points)) if column else ""
    versions = ", ".join(f"{name} {v}" for name, v in first["versions"].items())
    lanes = f"batches of {first['lanes']}" if first["lanes"] else "no batches"
    return (
        (f"{named}: measured " if named else "Measured ")
        + f"{first['date']}, {first['device']}, {first['processor']}, {busy(points)}, "
        f"{_much(points)}, {lanes}; {versions}.\n"
    )


def _much(points: list[dict[str, Any]]) -> str:
    """Calls of each program, or turns of them."""
    if "turns" not in points[0]:
        return f"{points[0]['calls']} calls"
    least, most = (f({point["turns"] for point in points}) for f in (min, max))
    return f"{most} turns" if least == most else f"{least} to {most} turns"


def busy(points: list[dict[str, Any]]) -> str:
    """How many cores others kept busy meanwhile, and what follows of it."""
    old = [p["load"] for p in points if "load" in p]
    if old:  # measured before others were told from this run
        return f"**load average up to {max(old)}: compare ratios, not times**"
    loads = [p["others"] for p in points]
    if None in loads:
        return "load of others unknown"
    text = f"others kept up to {max(loads):.2g} cores busy"
    return text if max(loads) < QUIET else f"**{text}: compare ratios, not times**"


def _time(times: dict[str, Any], which: str, part: str = "median") -> str:
    return micro(times[which][part]) if which in times else "-"


def _error(v: float | str | None) -> str:
    if v is None:
        return "-"
    if isinstance(v, str):
        return v
    return "0" if v == 0 else f"{v:.1e}"


def micro(v: float) -> str:
    """Seconds in microseconds, three digits."""
    return f"{float(f'{1e6 * v:.3g}'):,.10g}"
