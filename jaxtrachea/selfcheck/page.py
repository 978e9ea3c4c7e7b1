"""The table as a page (docs/hard_cases.md) and as JSON."""

import dataclasses
import math
import re

from jaxtrachea.selfcheck.run import Outcome
from jaxtrachea.selfcheck.table import Case

_HEAD = """# Hard cases

Written by `tests/reference/hard_cases_page.py` from `jaxtrachea/selfcheck/cases.toml`. Run them on
your own machine: `jaxtrachea selfcheck` (`--only NAME`, `--dtype float32`, `--out FOLDER`).

Every case is run by itself and in a batch between healthy neighbours, which must keep every bit:
values, the reverse Jacobian and, in the batch, the forward one. The truth has 25 digits
(`tests/reference/hard_cases_truth.py`: finite elements and closed forms in 260 digits, derivatives
by differences in them) of exactly the numbers given, which both dtypes can hold. Errors are
relative to the largest entry of each array, in units of the dtype's epsilon (2.2e-16, 1.2e-7); a
dash: the model has no answer there, and says so by its status, or the dtype cannot hold it; a
question mark: not measured yet.
"""


def as_dict(outcome: Outcome) -> dict:
    """An outcome as plain values; what is not finite as null."""
    plain = dataclasses.asdict(outcome) | {"value": outcome.value, "gradient": outcome.gradient}
    plain |= {"passed": outcome.passed, "faults": list(outcome.faults)}
    hide = lambda v: None if isinstance(v, float) and not math.isfinite(v) else v  # noqa: E731
    return {n: hide(v) for n, v in plain.items()}


def page(cases: list[Case], outcomes: list[Outcome]) -> str:
    """The page, with the errors measured."""
    by = {(o.case, o.dtype): o for o in outcomes}
    parts = [_HEAD]
    for function in dict.fromkeys(c.function for c in cases):
        rows = [c for c in cases if c.function == function]
        parts.append(
            f"\n## {function}\n\n{_about(function)}\n\n{_table(rows, by)}\n\n{_why(rows)}\n"
        )
    return "".join(parts)


def skeleton(text: str) -> str:
    """The page without its measured numbers: what must follow from the table alone."""
    return re.sub(r"\| [-0-9.e+]+ (?=\|)|\| [-?] (?=\|)", "| # ", text)


def _about(function: str) -> str:
    from jaxtrachea.selfcheck.functions import FUNCTIONS

    return (FUNCTIONS[function].__doc__ or "").strip()


def _table(rows, by) -> str:
    lines = ["| case | what is hard | value 64 | gradient 64 | value 32 | gradient 32 |"]
    lines.append("|---|---|---|---|---|---|")
    for case in rows:
        cells = [_error(case, by.get((case.name, d)), d) for d in ("float64", "float32")]
        numbers = " | ".join(q for pair in cells for q in pair)
        lines.append(f"| {case.name} | {case.hard} | {numbers} |")
    return "\n".join(lines)


def _error(case: Case, outcome, dtype: str):
    if not case.answer or dtype not in case.dtypes:
        return "-", "-"
    if outcome is None:
        return "?", "?"
    eps = 2.0**-52 if dtype == "float64" else 2.0**-23
    return f"{outcome.value_error / eps:.2g}", f"{outcome.gradient_error / eps:.2g}"


def _why(rows) -> str:
    """Tolerances, once for all rows that share them."""
    said: dict[str, list[str]] = {}
    for case in rows:
        t64, t32 = case.tolerance["float64"], case.tolerance["float32"]
        bounds = [
            f"{_pair(t64.value, t32.value)} value",
            f"{_pair(t64.gradient, t32.gradient)} gradient",
        ]
        said.setdefault(f"{', '.join(bounds)}: {t64.why}.", []).append(case.name)
    longest = max(said, key=lambda text: len(said[text]))
    lines = [f"Tolerance {longest}"]
    for text, names in said.items():
        if text != longest:
            lines.append(f"- {', '.join(names)}: {text}")
    natural = [c.name for c in rows if c.natural]
    if natural:
        lines.append(
            f"- Derivatives seen against y/x where they are far below it: {', '.join(natural)}."
        )
    return "\n".join(lines)


def _pair(a: float, b: float) -> str:
    return f"{a:g}" if a == b else f"{a:g} (float32: {b:g})"
