"""Results read, and numbers and tables as Markdown."""

import json
import statistics
from pathlib import Path

FOLDER = Path(__file__).parent


def read(suite: str) -> tuple[dict, list[dict]]:
    """Environment and rows (remarks included) of a suite."""
    text = (FOLDER / "results" / f"{suite}.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    return lines[0], lines[1:]


def number(v: float) -> str:
    """Three significant digits without an exponent."""
    return f"{float(f'{v:.3g}'):,.10g}"


def table(head: list[str], lines: list[list[str]]) -> str:
    """Markdown, first column left, the others right."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, rule, *lines]) + "\n"


def microseconds(row: dict) -> tuple[float, float]:
    """Median and smallest sample, per lane where there are lanes."""
    per = 1e6 / row.get("lanes", 1)
    return statistics.median(row["samples"]) * per, min(row["samples"]) * per


def ratio(a: dict, b: dict) -> tuple[float, float]:
    """Median of the paired ratios a / b of one run, and the ratio of the smallest samples."""
    pairs = zip(a["samples"], b["samples"], strict=True)
    scale = b.get("lanes", 1) / a.get("lanes", 1)
    paired = statistics.median(x / y for x, y in pairs) * scale
    return paired, min(a["samples"]) / min(b["samples"]) * scale


def quoted(a: dict, b: dict) -> str:
    """A ratio as text: median of pairs (of the smallest samples)."""
    return "{} ({})".format(*map(number, ratio(a, b)))


def verdict(met: bool) -> str:
    """A goal in a word."""
    return "met" if met else "**missed**"
