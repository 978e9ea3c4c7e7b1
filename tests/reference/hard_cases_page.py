"""Writes docs/evidence/hard_cases.md: python tests/reference/hard_cases_page.py, from the root."""

import datetime
import pathlib
import re

import jax

from jaxtrachea.selfcheck.assess import Outcome
from jaxtrachea.selfcheck.table import DTYPES, ROUNDINGS, Case, read_cases, read_truth

DOCUMENT = pathlib.Path(__file__).parents[2] / "docs" / "evidence" / "hard_cases.md"
_HEAD = """# Hard cases

*For developers, and for whoever ran `jaxtrachea selfcheck` and got an error.*

Written by `tests/reference/hard_cases_page.py` from `jaxtrachea/selfcheck/cases.toml`. Run them on
your own machine: `jaxtrachea selfcheck` (`--only NAME`, `--dtype float32`, `--out FOLDER`).
Nearly all of the time is compilation of the programs, which are kept for the next start. `--quick`
compiles without optimisation: not the programs that you usually run.

Every case is run by itself and in a batch between healthy neighbours, which must keep every bit:
values, the reverse Jacobian and, in the batch, the forward one. The truth has 25 digits
(`tests/reference/hard_cases_truth.py`: finite elements and closed forms in 260 digits, derivatives
by differences in them) of exactly the numbers given, which both dtypes can hold.

**Errors** are relative to the largest entry of each array (to its spread, see below, where it is
0), in units of the dtype's epsilon (2.2e-16, 1.2e-7). A cell "3.1 of 48" is the error measured, 3.1
epsilon, and the largest allowed, of the array that comes nearest to its limit, in either run and
either mode. A dash: the model has no answer there, and says so by its status, or the dtype cannot
hold it; a question mark: not measured yet.

**Limits** follow from the truth alone in all rows but six, which say why. Every input in turn is
moved by the same small fraction of itself; what the truth moves, added over all inputs, per unit of
that fraction, is its spread (`tests/reference/hard_cases_condition.py`; of derivatives, by second
differences in 260 digits). An error is within its limit up to

    {value:g} epsilon (size + spread), of a derivative {gradient:g} epsilon (size + spread),

in both dtypes: what {value:g} roundings of the inputs would do to exact arithmetic. The two numbers
are chosen (a reverse gradient takes up to four times the operations of its value), the rest is
derived. Positions on one line (rings, ends, C) enter by their differences, which floating point
forms without an error of its own: there it is the spans between neighbours that are moved. Angles
enter by directions, whose entries are of size 1: less than 1 rad is moved as if it were 1 rad.
Where another limit is needed, it is listed with its reason below the table.

Some derivatives are far below y/x, the size of a derivative of a power law: what hardly depends on
an input any more is known to rounding of y, not to its own. Where it is said below a table, the
size of such a derivative is taken as y/x.
"""
_WORST = """
**Worst**, {rows} rows on {where}: {worst}; {nans} numbers that are not finite where they must be.
"""


def page(cases: list[Case], outcomes: list[Outcome], where: str = "") -> str:
    """The page, with the errors measured; `where`: device and versions."""
    by = {(o.case, o.dtype): o for o in outcomes}
    parts = [_HEAD.format(**ROUNDINGS)]
    if outcomes:
        parts.append(_worst(outcomes, where))
    for function in dict.fromkeys(c.function for c in cases):
        rows = [c for c in cases if c.function == function]
        parts.append(f"\n## {function}\n\n{_about(function)}\n\n{_table(rows, by)}\n")
        parts.extend(f"\n{notes}" for notes in [_notes(rows)] if notes)
    return "".join(parts)


def _worst(outcomes: list[Outcome], where: str) -> str:
    """Worst errors over their limits by dtype, and how many numbers are not finite."""
    said = []
    for dtype in dict.fromkeys(o.dtype for o in outcomes):
        own = [o for o in outcomes if o.dtype == dtype]
        value, gradient = max(o.value for o in own), max(o.gradient for o in own)
        said.append(f"{dtype}: values {value:.2g}, derivatives {gradient:.2g} of their limits")
    nans = sum(o.nans for o in outcomes)
    return _WORST.format(rows=len(outcomes), where=where, worst="; ".join(said), nans=nans)


def skeleton(text: str) -> str:
    """The page without its measured numbers: what must follow from the table alone."""
    text = re.sub(r"\n\*\*Worst\*\*[^\n]*\n", "", text)
    return re.sub(r"\| ([-?]|[0-9.e+-]+ of [0-9.e+-]+) (?=\|)", "| # ", text)


def _about(function: str) -> str:
    from jaxtrachea.selfcheck.functions import FUNCTIONS

    return (FUNCTIONS[function].__doc__ or "").strip()


def _table(rows, by) -> str:
    lines = ["| case | what is hard | value 64 | gradient 64 | value 32 | gradient 32 |"]
    lines.append("|---|---|---|---|---|---|")
    for case in rows:
        cells = [_cells(case, by.get((case.name, d)), d) for d in ("float64", "float32")]
        numbers = " | ".join(q for pair in cells for q in pair)
        lines.append(f"| {case.name} | {case.hard} | {numbers} |")
    return "\n".join(lines)


def _cells(case: Case, outcome: Outcome | None, dtype: str):
    if not case.answer or dtype not in case.dtypes:
        return "-", "-"
    if outcome is None:
        return "?", "?"
    tolerance = outcome.tolerance
    pairs = (outcome.value_gap, tolerance.value), (outcome.gradient_gap, tolerance.gradient)
    return tuple(f"{gap.error:.2g} of {gap.limit(most):.2g}" for gap, most in pairs)


def _notes(rows: list[Case]) -> str:
    """What differs from the rule, once for all rows that share it."""
    said: dict[str, list[str]] = {}
    for case in rows:
        for text in _remarks(case):
            said.setdefault(text, []).append(case.name)
    return "".join(f"- {', '.join(names)}: {text}.\n" for text, names in said.items())


def _remarks(case: Case):
    t64, t32 = case.tolerance["float64"], case.tolerance["float32"]
    if t64.why:
        value, gradient = _pair(t64.value, t32.value), _pair(t64.gradient, t32.gradient)
        yield f"{value} roundings in values, {gradient} in derivatives: {t64.why}"
    if case.entrywise:
        yield "every entry is seen against its own size and spread"
    if case.natural:
        yield f"derivatives by {', '.join(case.natural)}: seen against y/x where it is larger"
    if case.scale:
        sizes = ", ".join(f"{n} {v:g}" for n, v in case.scale.items())
        yield f"seen against {sizes}: {case.scale_why}"


def _pair(a: float, b: float) -> str:
    return f"{a:g}" if a == b else f"{a:g} (float32: {b:g})"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    from jaxtrachea.selfcheck.run import run_table

    cases = read_cases()
    where = f"{jax.devices()[0]}, jax {jax.__version__}, {datetime.date.today()}"
    DOCUMENT.write_text(page(cases, list(run_table(cases, read_truth(), DTYPES)), where))
