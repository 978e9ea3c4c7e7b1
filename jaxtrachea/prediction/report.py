"""The written report of predictions, and their tables on the terminal."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.files.table import Column, Row, Table, ends
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.measurements.curve import BadCurve
from jaxtrachea.measurements.usage_tables import bad_table
from jaxtrachea.prediction.curves import CurvePrediction
from jaxtrachea.prediction.held_out import Compared
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.prediction.tables import band_rows
from jaxtrachea.status import PredictionStatus

#: Rows of a table; the files hold all.
MANY = 12


def _outcome(row: Row) -> str:
    return str(row["status"]).replace("_", " ")


ERRORS = (
    *map(Column, ("specimen", "trial", "s [mm]")),
    Column("in fit", "in_fit"),
    Column("n", lambda row: row.get("samples", 0)),
    *(Column(head, unit="%", digits=3) for head in ("rms / peak", "worst / peak")),
    Column("in band", "coverage95", unit="%", digits=3),
    Column("outcome", _outcome),
)
DEEPEST = (
    Column("specimen"),
    Column("trial", lambda row: row["trial"] or None),
    Column("s [mm]"),
    Column("D [mm]", "displacement [mm]"),
    Column("force [N]", "predicted [N]"),
    Column("95 % of the curve", ends("curve_low95 [N]", "curve_high95 [N]")),
    Column("95 % with noise", ends("low95 [N]", "high95 [N]")),
    Column("outcome", _outcome),
)
BANDS = (
    "Bands are 95 %: of the curve itself (covariance of the parameters, linear: the delta method), "
    "and of a new sample (with the noise as well). The covariance is widened where neighbouring "
    "residuals are alike. Between the positions of the fit both have the error of the model there, "
    "as leaving each position out in turn leaves it; where too few positions tell it (few "
    "positions) the bands are not of 95 %. "
    "Where an unknown lies on its bound they leave out its uncertainty; where the data do not "
    "determine what a prediction needs they are infinite; where the model bends within the band "
    "they are off, and the outcome says so (docs/after_a_fit.md)."
)


def error_table(rows: Sequence[Row], of: str = "curve") -> Table:
    """Rows of errors.csv for people, worst first; curves without a prediction come first."""
    chosen = [row for row in rows if row["of"] == of]

    def badness(row):
        share = row.get("rms / peak")
        return np.inf if share is None else share

    table = Table(sorted(chosen, key=badness, reverse=True), ERRORS)
    return table.first(MANY, "and {} more, see errors.csv")


def at_table(curves: Sequence[CurvePrediction]) -> Table:
    """Every curve at its deepest displacement, of a hold at its end, for people."""
    depth = [np.abs(p.displacement) for p in curves]
    deepest = [int(np.flatnonzero(d == d.max())[-1]) for d in depth]
    rows = [list(band_rows(p, [i]))[0] for p, i in zip(curves, deepest, strict=True)]
    return Table(rows, DEEPEST).first(MANY, "and {} more, see bands.csv")


def _table(table: Table) -> str:
    more = f"... {table.more}." if table.more else ""
    return "\n\n".join(filter(None, [table.markdown(), more]))


def outcomes(predictions: Sequence[CurvePrediction]) -> list[str]:
    """How many curves came to which outcome, in words; what is particular to some, once each."""
    lines = []
    for status in PredictionStatus:
        own = [p for p in predictions if p.status == status]
        if not own:
            continue
        texts = "; ".join(p.message.removeprefix(status.message) for p in own).split("; ")
        said = list(dict.fromkeys(text for text in texts if text.strip()))
        more = f" ({'; '.join(said[:3])}{'; ...' if len(said) > 3 else ''})" if said else ""
        lines.append(f"{len(own)} of {len(predictions)} curves: {status.message}{more}")
    return lines


def _origin(stored: FitResult, digest: str) -> str:
    files, fitted = list(stored.origin.files), pressed(stored)
    names = ", ".join(files[:8]) + (", ..." if len(files) > 8 else "")
    free = ", ".join(p.name for p in stored.study.free) or "nothing"
    return (
        f"From `{stored.origin.path.name}` (SHA-256 {digest[:16]}...): {free} fitted to "
        f"{len(fitted.curves)} curves of {len(fitted.specimens)} specimen(s)"
        f"{f' in {names}' if names else ''}."
    )


def report_at(stored: FitResult, digest: str, curves: Sequence[CurvePrediction]) -> str:
    """report.md of predictions at chosen positions."""
    parts = [
        "# Predictions",
        _origin(stored, digest),
        "\n".join(f"- {line}." for line in outcomes(curves)),
        "## At the deepest displacement of each curve, of a hold at its end",
        _table(at_table(curves)),
        BANDS,
        "![predictions](predictions.png)",
    ]
    return "\n\n".join(parts) + "\n"


def report_data(
    stored: FitResult,
    digest: str,
    compared: Sequence[Compared],
    bad: Sequence[BadCurve],
    rows: Sequence[Row],
    notes: Sequence[str],
) -> str:
    """report.md of predictions of measured curves."""
    used = sum(c.in_fit == "yes" for c in compared)
    parts = ["# Measured against predicted", _origin(stored, digest)]
    parts.append("\n".join(f"- {t}." for t in outcomes([c.prediction for c in compared])))
    if used:
        parts.append(
            f"{used} of {len(compared)} curves were used by the fit: for them this is its "
            "residual, not a prediction."
        )
    parts += [f"{note}." for note in notes]
    parts += ["## Curves, worst first", _table(error_table(rows))]
    positions = error_table(rows, "position")
    if positions:
        parts += ["## Contact positions, worst first", _table(positions)]
    parts += [
        "rms and worst: predicted minus measured force over the largest measured force; in band: "
        "share of samples with force (above twice the noise) in the 95 % band with noise. " + BANDS,
    ]
    parts += ["![curves](curves.png)", "![measured against predicted](measured_predicted.png)"]
    if bad:
        table = bad_table(bad)
        cut = table.first(MANY, "and {} more, see errors.csv")
        parts += [f"## {table.title}", _table(cut)]
    return "\n\n".join(parts) + "\n"
