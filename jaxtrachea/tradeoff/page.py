"""Measured trade-offs as Markdown: generated from the JSON lines, nothing else."""

import json
from pathlib import Path
from typing import Any

HEAD = ["ladder", "level", "force", "joints", "surface", "contact [mm]", "gradient",
        "call [µs]", "99 %", "gradient [µs]", "lane [µs]", "compile [s]"]  # fmt: skip
KINDS = {
    "algebra": "Algebra: another way to the same numbers",
    "truncation": "Truncation: how far something is computed",
    "model": "Model: something left out",
}


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
        *(_error(error[name]) for name in names), _micro(time["call"]["median"]),
        _micro(time["call"]["p99"]), _micro(time["gradient"]["median"]),
        _micro(time["lane"]["median"]) if "lane" in time else "-", f"{time['compile']:.2g}",
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
    """Where and when, with the load of the machine."""
    first = points[0]
    versions = ", ".join(f"{name} {v}" for name, v in first["versions"].items())
    lanes = f"batches of {first['lanes']}" if first["lanes"] else "no batches"
    return (
        f"Measured {first['date']}, {first['device']}, {first['processor']}, load {first['load']}, "
        f"{first['calls']} calls, {lanes}; {versions}.\n"
    )


def choice_rows(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Scene, tolerance, what was dropped, verified error, times."""
    found = []
    for row in rows:
        error, call = row["errors"], row["times"]
        worst = max(v for k in ("force", "joints", "surface") if (v := error[k]) is not None)
        dropped, refused, returned = (
            ", ".join(f"{d['ladder']} {d['level']} ({_percent(d['error'])})" for d in row[k])
            for k in ("dropped", "refused", "returned")
        )
        found.append([
            row["scene"], f"{100 * row['tolerance']:g} %", dropped or "nothing", refused or "-",
            returned or "-",
            f"{100 * worst:.2g} %", f"{100 * row['cost']:.0f} %",
            f"{_micro(call['chosen'])} / {_micro(call['full'])}",
            f"{call['chosen'] / call['full']:.2f}",
        ])  # fmt: skip
    return found


CHOICE_HEAD = ["scene", "tolerance", "dropped (changes alone)", "too far off alone", "came back",
               "verified error", "cost", "call, chosen / full [µs]", "ratio"]  # fmt: skip


def document(folder: Path, head: str) -> str:
    """docs/tradeoff.md: a head, the choices, every scene.

    Args:
        folder: with `choice.jsonl`, and `NAME.jsonl` and `NAME.png` of each scene.
        head: Markdown; `{choice}` is the table of choices.
    """
    choices = read(folder / "choice.jsonl")
    body = table(CHOICE_HEAD, choice_rows(choices), 5) + "\n" + measured(choices)
    parts = [head.replace("{choice}", body)]
    for path in sorted(folder.glob("*.jsonl")):
        if path.stem != "choice":
            picture = f"{folder.name}/{path.stem}.png"
            parts.append(f"## {path.stem}\n\n{scene_text(read(path), picture)}")
    return "\n".join(parts)


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
