"""The written report of predictions, and their tables on the terminal."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.files.tables import markdown_table, number
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.measurements.curve import BAD_HEAD, BadCurve
from jaxtrachea.prediction.held_out import Compared
from jaxtrachea.prediction.predict import CurvePrediction
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.status import PredictionStatus

#: Rows of a table; the files hold all.
MANY = 12
ERROR_HEAD = ["specimen", "trial", "s [mm]", "in fit", "n", "rms / peak", "worst / peak", "in band",
              "outcome"]  # fmt: skip
AT_HEAD = ["specimen", "trial", "s [mm]", "D [mm]", "force [N]", "95 % of the curve",
           "95 % with noise", "outcome"]  # fmt: skip
BANDS = (
    "Bands are 95 %: of the curve itself (covariance of the parameters, linear: the delta method), "
    "and of a new sample (with the noise as well). The covariance is widened where neighbouring "
    "residuals are alike. Between the positions of the fit both have the error of the model there, "
    "as leaving each position out in turn leaves it; where too few positions tell it (few "
    "positions) the bands are not of 95 %. "
    "Where an unknown lies on its bound they leave out its uncertainty; where the data do not "
    "determine what a prediction needs they are infinite; where the model bends within the band "
    "they are off, and the outcome says so (docs/predict.md)."
)


def error_table(rows: Sequence[dict[str, object]], of: str = "curve") -> list[list[str]]:
    """Rows of errors.csv for people, worst first; curves without a prediction come first."""
    chosen = [row for row in rows if row["of"] == of]

    def badness(row):
        share = row.get("rms / peak", "")
        return np.inf if share == "" else share

    return [_error_cells(row) for row in sorted(chosen, key=badness, reverse=True)]


def _error_cells(row: dict[str, object]) -> list[str]:
    def share(name):
        value = row.get(name, "")
        return "–" if value == "" else f"{100 * float(str(value)):.3g} %"

    s = row.get("s [mm]", "")
    return [
        str(row["specimen"]),
        str(row["trial"]),
        "–" if s == "" else f"{float(str(s)):.4g}",
        str(row.get("in_fit", "–")),
        str(row.get("samples", 0)),
        share("rms / peak"),
        share("worst / peak"),
        share("coverage95"),
        str(row["status"]).replace("_", " "),
    ]


def at_table(curves: Sequence[CurvePrediction]) -> list[list[str]]:
    """Every curve at its deepest displacement, for people."""
    rows = []
    for p in curves:
        i = int(np.argmax(np.abs(p.displacement)))

        def pair(low, high, i=i):
            return f"{number(float(low[i]))} … {number(float(high[i]))}"

        rows.append(
            [
                p.specimen,
                p.trial or "–",
                "–" if np.isnan(p.s) else f"{p.s:.4g}",
                f"{p.displacement[i]:.4g}",
                number(float(p.force[i])),
                pair(p.curve_low95, p.curve_high95),
                pair(p.low95, p.high95),
                p.status.name.lower().replace("_", " "),
            ]
        )
    return rows


def shortened(rows: list[list[str]], file: str) -> tuple[list[list[str]], str]:
    """The first rows of a table, and how many are not shown."""
    left = len(rows) - MANY
    return rows[:MANY], f"and {left} more, see {file}" if left > 0 else ""


def _table(head, rows, file: str) -> str:
    shown, more = shortened(rows, file)
    return "\n\n".join(filter(None, [markdown_table(head, shown), more and f"... {more}."]))


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
        "## At the deepest displacement of each curve",
        _table(AT_HEAD, at_table(curves), "bands.csv"),
        BANDS,
        "![predictions](predictions.png)",
    ]
    return "\n\n".join(parts) + "\n"


def report_data(
    stored: FitResult,
    digest: str,
    compared: Sequence[Compared],
    bad: Sequence[BadCurve],
    rows: Sequence[dict[str, object]],
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
    parts += ["## Curves, worst first", _table(ERROR_HEAD, error_table(rows), "errors.csv")]
    positions = error_table(rows, "position")
    if positions:
        parts += ["## Contact positions, worst first", _table(ERROR_HEAD, positions, "errors.csv")]
    parts += [
        "rms and worst: predicted minus measured force over the largest measured force; in band: "
        "share of samples with force (above twice the noise) in the 95 % band with noise. " + BANDS,
    ]
    parts += ["![curves](curves.png)", "![measured against predicted](measured_predicted.png)"]
    if bad:
        cells = [b.cells for b in bad]
        parts += ["## Curves that could not be used", _table(BAD_HEAD, cells, "errors.csv")]
    return "\n\n".join(parts) + "\n"
