"""Measured trade-offs as Markdown: generated from the JSON lines, nothing else."""

import json
from pathlib import Path
from typing import Any

from jaxtrachea.tradeoff.cost import HALF
from jaxtrachea.tradeoff.front import front, worst
from jaxtrachea.tradeoff.load import QUIET

HEAD = ["ladder", "level", "force", "joints", "surface", "contact [mm]", "gradient",
        "part [µs]", "call [µs]", "99 %", "part, lane [µs]", "lane [µs]", "gradient [µs]",
        "compile [s]"]  # fmt: skip
KINDS = {
    "algebra": "Algebra: another way to the same numbers",
    "truncation": "Truncation: how far something is computed",
    "model": "Model: something left out",
    "together": "Together: plans within a tolerance",
}

#: What makes two runs different ones.
WHERE = ("date", "device", "processor", "calls", "lanes", "versions")


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a file of JSON lines."""
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


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


#: Largest error of the plans of a front, for each pair of columns: those of use, and all.
WITHIN = (0.1, float("inf"))
FRONT_HEAD = ["scene", "within 10 %: a call", "a lane", "all: a call", "a lane",
              "error of the quickest call"]  # fmt: skip
CHOICE_HEAD = ["scene", "tolerance", "least", "dropped (changes alone)", "came back",
               "verified error", "time", "operations", "time again", "chosen / full [µs]",
               "time again / operations", "all counted alike"]  # fmt: skip


def choice_rows(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Scene, tolerances, what was made least, what was dropped, verified error, times.

    Neighbours that differ by the tolerance alone are one row.
    """
    found: list[list[str]] = []
    for row in rows:
        error, repeat = row["errors"], row["repeat"]
        worst = max(v for k in ("force", "joints", "surface") if (v := error[k]) is not None)
        dropped, restored = (
            ", ".join(f"{d['ladder']} {d['level']} ({_percent(d['error'])})" for d in row[k])
            for k in ("dropped", "returned")
        )
        halved = any(d["ladder"] == "dtype" for d in row["dropped"])
        over = repeat["share"] / row["operations"]
        cells = [
            row["scene"], f"{100 * row['tolerance']:g} %", row["by"],
            dropped or "nothing", restored or "-",
            f"{100 * worst:.2g} %", _range(row["cost"]), f"{100 * row['operations']:.0f} %",
            _range(repeat),
            f"{_micro(repeat['full'] * repeat['share'])} / {_micro(repeat['full'])}",
            f"{over:.2f}", f"{over * (HALF if halved else 1):.2f}",
        ]  # fmt: skip
        if found and [found[-1][0], *found[-1][2:]] == [cells[0], *cells[2:]]:
            found[-1][1] += f", {cells[1]}"
        else:
            found.append(cells)
    return found


def _range(cost: dict[str, float]) -> str:
    """Share of the full program's cost, and its interval where it has one."""
    share, low, high = (f"{100 * cost[k]:.0f}" for k in ("share", "low", "high"))
    return f"{share} %" if cost["low"] == cost["high"] else f"{share} % ({low} to {high})"


def fronts(scenes: dict[str, list[dict[str, Any]]]) -> list[list[str]]:
    """Scene; by which factor the times of its Pareto front differ, a call and a lane; an error.

    The factors of plans within 10 % of the full one, then those of all plans; the error is that of
    the plan with the quickest call. Of the ladder `together`: whole plans, timed in the same turns.
    Finest levels of other ladders can be other programs, and were timed at other times.
    """
    found = []
    for name, rows in scenes.items():
        points = [row for row in rows if row.get("ladder") == "together"]
        row = [name]
        for most in WITHIN:
            near = [p for p in points if worst(p) <= most]
            row += [_span([p for p in near if which in p["times"]], which)
                    for which in ("call", "lane")]  # fmt: skip
        quickest = min(points, key=lambda p: p["times"]["call"]["median"], default=None)
        found.append([*row, "-" if quickest is None else _percent(worst(quickest))])
    return found


def _span(points: list[dict[str, Any]], which: str) -> str:
    """Slowest over quickest of a front; - where nothing was timed."""
    times = [points[i]["times"][which]["median"] for i in front(points, which)]
    return f"{max(times) / min(times):.2g}" if times else "-"


def level_rows(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Level of a press, its time against the first, fits a second."""
    call, lane = rows[0]["call"], rows[0]["lane"]
    return [
        [row["level"], f"{row['call'] / call:.2g}", f"{row['lane'] / lane:.2g}",
         "-" if row["fits"] is None else f"{row['fits']:.3g}"]
        for row in rows
    ]  # fmt: skip


def document(folder: Path, head: str) -> str:
    """docs/evidence/tradeoff.md: a head, the choices, every scene.

    Args:
        folder: with `choice.jsonl`, `levels.jsonl`, and `NAME.jsonl` and `NAME.png` of each scene.
        head: Markdown; `{choice}` is the table of choices, `{fronts}` that of the fronts' spans,
            `{levels}` that of the levels of the skeleton.
    """
    choices, levels = (read(folder / f"{name}.jsonl") for name in ("choice", "levels"))
    scenes = {p.stem: read(p) for p in sorted(folder.glob("*.jsonl"))
              if p.stem not in ("choice", "levels")}  # fmt: skip
    tables = {
        "choice": table(CHOICE_HEAD, choice_rows(choices), 5) + "\n" + measured(choices),
        "fronts": table(FRONT_HEAD, fronts(scenes), 1),
        "levels": table(["level", "a call", "a lane of 256", "fits/s"], level_rows(levels), 1)
        + f"\n{levels[0]['where']}\n",
    }
    for name, text in tables.items():
        head = head.replace(f"{{{name}}}", text)
    parts = [head]
    for name, rows in scenes.items():
        parts.append(f"## {name}\n\n{scene_text(rows, f'{folder.name}/{name}.png')}")
    return "\n".join(parts)


def _time(times: dict[str, Any], which: str, part: str = "median") -> str:
    return _micro(times[which][part]) if which in times else "-"


def _error(v: float | str | None) -> str:
    if v is None:
        return "-"
    if isinstance(v, str):
        return v
    return "0" if v == 0 else f"{v:.1e}"


def _percent(v: float | str) -> str:
    return v if isinstance(v, str) else f"{float(f'{100 * v:.2g}'):g} %"


def _micro(v: float) -> str:
    """Seconds in microseconds, three digits."""
    return f"{float(f'{1e6 * v:.3g}'):,.10g}"
