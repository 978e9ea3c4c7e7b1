"""Measured trade-offs as a table."""

from typing import Any

from jaxtrachea.files.table import Column, Row, Table

#: Kinds of ladders, and what stands above their tables.
KINDS = {
    "algebra": "Algebra: another way to the same numbers",
    "truncation": "Truncation: how far something is computed",
    "model": "Model: something left out",
    "together": "Together: plans within a tolerance",
}
#: Shown columns: times in microseconds by the program that takes them.
_TIMES = {"part": "part", "call": "call", "part_lane": "part, lane", "gradient": "gradient"}


def measured_table(points: list[dict[str, Any]], title: str = "") -> Table:
    """A row of each level: errors, median seconds of a call of its programs, and of compiling."""
    errors = (
        Column(name.replace("_mm", " [mm]"), f"error_{name}", digits=2, null="-")
        for name in ("force", "joints", "surface", "contact_mm", "gradient")
    )
    times = (
        Column(f"{head} [µs]", lambda row, n=name: 1e6 * _seconds(row, n), digits=3, null="-")
        for name, head in _TIMES.items()
    )
    level = Column("level", lambda row: f"{row['level']}{' *' if row['finest'] else ''}", left=True)
    return Table(map(_row, points), [Column("ladder"), level, *errors, *times], title=title)


def _seconds(row: Row, name: str) -> float:
    return float(row.get(f"{name}_median", float("nan")))  # pyright: ignore[reportArgumentType]


def _row(point: dict[str, Any]) -> Row:
    """Numbers of a point by name."""
    row = {name: point[name] for name in ("kind", "ladder", "level", "finest")}
    row |= {f"error_{name}": _number(v) for name, v in point["errors"].items()}
    row |= {f"data_{name}": _number(v) for name, v in (point.get("data") or {}).items()}
    for name, time in point["times"].items():
        parts = time.items() if isinstance(time, dict) else [("", time)]
        row |= {f"{name}_{part}".rstrip("_"): v for part, v in parts}
    return row


def _number(v: float | str | None) -> float | None:
    """Of an error, which is a word in the JSON lines where it is not finite."""
    return None if v is None else float(v)
