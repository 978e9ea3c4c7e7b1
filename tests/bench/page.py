"""Results read, and numbers and tables as Markdown."""

import json
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
