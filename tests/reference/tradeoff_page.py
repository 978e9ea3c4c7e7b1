"""The page of the recorded trade-offs: docs/evidence/tradeoff.md from its JSON lines."""

import json
from pathlib import Path
from typing import Any

from tradeoff_front import front, worst
from tradeoff_text import measured, micro, scene_text, table

from jaxtrachea.tradeoff.choice import Choice
from jaxtrachea.tradeoff.cost import HALF, Cost
from jaxtrachea.tradeoff.measure import number

#: Largest error of the plans of a front, for each pair of columns: those of use, and all.
WITHIN = (0.1, float("inf"))
FRONT_HEAD = ["scene", "within 10 %: a call", "a lane", "all: a call", "a lane",
              "error of the quickest call"]  # fmt: skip
CHOICE_HEAD = ["scene", "tolerance", "least", "dropped (changes alone)", "came back",
               "verified error", "time", "operations", "time again", "chosen / full [µs]",
               "time again / operations", "all counted alike"]  # fmt: skip


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a file of JSON lines."""
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def choice_row(name: str, choice: Choice, repeat: Cost, end: dict[str, Any]) -> dict[str, Any]:
    """A choice as a line of JSON."""

    def said(rungs):
        return [
            {"ladder": r.ladder, "level": r.level, "error": number(r.errors.worst)} for r in rungs
        ]

    def short(cost):
        return {k: number(v) for k, v in cost._asdict().items()}

    return {
        "scene": name, "tolerance": choice.tolerance, "by": choice.by,
        "dropped": said(choice.dropped), "refused": said(choice.refused),
        "returned": said(choice.restored), "idle": said(choice.no_gain),
        "errors": {k: number(v) for k, v in choice.errors._asdict().items()},
        "cost": short(choice.cost), "operations": round(choice.operations, 4),
        "repeat": short(repeat),
    } | end  # fmt: skip


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
            f"{micro(repeat['full'] * repeat['share'])} / {micro(repeat['full'])}",
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


def _percent(v: float | str) -> str:
    return v if isinstance(v, str) else f"{float(f'{100 * v:.2g}'):g} %"
