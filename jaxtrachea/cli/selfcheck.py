"""The command selfcheck: the hard cases on the user's own device (docs/evidence/hard_cases.md)."""

import enum
import json
import math
import time
from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea.cli.terminal import Stop, say, say_written, set_up_jax

DtypeOption = Annotated[str, typer.Option("--dtype", help="Precision: float32, float64 or both.")]
OnlyOption = Annotated[
    list[str] | None, typer.Option("--only", help="Only this case or function; may be repeated.")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="New folder for selfcheck.json.")]
QuickOption = Annotated[
    bool,
    typer.Option("--quick", help="Faster start: programs compiled without optimisation."),
]


class _Dtype(enum.Enum):
    both = ("float64", "float32")
    float64 = ("float64",)
    float32 = ("float32",)


def selfcheck(
    dtype: DtypeOption = "both",
    only: OnlyOption = None,
    out_dir: OutOption = None,
    quick: QuickOption = False,
) -> None:
    """Test the numerics here against known 25-digit results."""
    from jaxtrachea.selfcheck.table import read_cases, read_truth

    start = time.perf_counter()
    if dtype not in _Dtype.__members__:
        raise Stop(f"--dtype {dtype}: expected float32, float64 or both")
    cases = _chosen(read_cases(), only)
    if out_dir is not None and out_dir.exists():
        raise Stop(f"{out_dir}: exists; choose another --out")
    set_up_jax()
    from jaxtrachea.selfcheck.run import run_table

    found = list(run_table(cases, read_truth(), _Dtype[dtype].value, unoptimised=quick))
    if not found:
        raise Stop(f"--only, --dtype {dtype}: none of these cases is run in this dtype")
    seconds = time.perf_counter() - start
    say(_table(found))
    for outcome in found:
        for fault in outcome.faults:
            say(f"{outcome.case} ({outcome.dtype}): {fault}")
    failed = sum(not o.passed for o in found)
    say(_summary(found, failed, seconds))
    if out_dir is not None:
        _write(out_dir, found, seconds, quick)
        say_written(out_dir)
    raise typer.Exit(1 if failed else 0)


def _chosen(cases, only):
    """The rows asked for by their name or their function's."""
    if not only:
        return cases
    known = {c.name for c in cases} | {c.function for c in cases}
    for name in only:
        if name not in known:
            near = [n for n in sorted(known) if name.lower() in n.lower()][:5]
            hint = f"; similar: {', '.join(map(repr, near))}" if near else ""
            functions = ", ".join(dict.fromkeys(c.function for c in cases))
            raise Stop(f"--only {name!r}: no such case{hint}; functions: {functions}")
    return [c for c in cases if c.name in only or c.function in only]


def _table(found):
    """A row for each case and dtype."""
    from jaxtrachea.files.table import Column, Table

    columns = [
        Column("case"), Column("dtype"), Column("value", digits=2), Column("gradient", digits=2),
        Column("not finite", "nans"), Column("verdict"),
    ]  # fmt: skip
    names = ("case", "dtype", "value", "gradient", "nans")
    rows = [
        {name: getattr(o, name) for name in names} | {"verdict": "ok" if o.passed else "FAILED"}
        for o in found
    ]
    return Table(rows, columns, title="Errors over their tolerance")


def _summary(found, failed, seconds) -> str:
    import jax

    cases = len({o.case for o in found})
    device = jax.devices()[0]
    said = "all within tolerance" if not failed else f"{failed} NOT within tolerance"
    return f"{cases} cases, {len(found)} rows: {said}; {seconds:.1f} s on {device.device_kind}"


def _write(folder: Path, found, seconds, quick) -> None:
    import jax

    from jaxtrachea import __version__

    made = {
        "version": __version__,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "seconds": round(seconds, 2),
        "optimised": not quick,
        "rows": [_plain(o) for o in found],
    }
    try:
        folder.mkdir(parents=True)
        (folder / "selfcheck.json").write_text(json.dumps(made, indent=1) + "\n")
    except OSError as error:
        raise Stop(
            f"{folder}: cannot be written ({error.strerror}); choose another --out"
        ) from None


def _plain(outcome) -> dict:
    """An outcome as plain values, errors in epsilon; what is not finite as null."""
    value, gradient, most = outcome.value_gap, outcome.gradient_gap, outcome.tolerance
    plain = {
        "case": outcome.case,
        "dtype": outcome.dtype,
        "passed": outcome.passed,
        "value": outcome.value,
        "value_error": value.error,
        "value_limit": value.limit(most.value),
        "value_where": value.where,
        "gradient": outcome.gradient,
        "gradient_error": gradient.error,
        "gradient_limit": gradient.limit(most.gradient),
        "gradient_where": gradient.where,
        "nans": outcome.nans,
        "faults": list(outcome.faults),
        "why": most.why,
    }

    def finite(v):
        return None if isinstance(v, float) and not math.isfinite(v) else v

    return {n: finite(v) for n, v in plain.items()}
