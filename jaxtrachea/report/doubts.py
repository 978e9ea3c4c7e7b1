"""What speaks against the numbers of a fit, in words."""

import numpy as np

from jaxtrachea.fit.result import FitResult
from jaxtrachea.inference.effective import CORRELATED, Effective


def doubts(result: FitResult, wide: Effective) -> list[str]:
    """What speaks against the standard errors of this fit."""
    said = []
    lanes = np.flatnonzero(wide.correlation > CORRELATED)
    if len(lanes) and not result.study.free:
        said.append(
            f"Neighbouring force residuals are correlated in {len(lanes)} of {result.lanes} lanes: "
            "the model misses the shape of these curves, or the noise is not independent from "
            "sample to sample."
        )
    elif len(lanes):
        r = float(np.median(wide.correlation[lanes]))
        worth = float(np.median(wide.samples[lanes] / np.maximum(result.samples[lanes], 1)))
        few = int(np.sum(np.isinf(wide.factor[lanes])))
        factor = float(np.median(wide.factor[lanes]))
        said.append(
            f"Neighbouring force residuals are correlated in {len(lanes)} of {result.lanes} lanes "
            f"(median correlation {r:.2f}): the model misses the shape of these curves, or the "
            "noise is not independent from sample to sample. The standard errors assume that it "
            f"is; there 100 samples are worth {100 * worth:.2g} independent ones, and they are too "
            + (f"small, by a factor of about {factor:.2g} if it is noise" if np.isfinite(factor)
               else "small by a factor that these samples do not tell")
            + ". Intervals for so many samples: `95 % widened`, and `low95_widened`, "
            "`high95_widened` in `parameters.csv` (docs/uncertainty.md)."
            + (f" {few} lanes have no more independent samples than unknowns, and no limits."
               if few else "")
        )  # fmt: skip
    bound = np.flatnonzero(result.at_bound.any(axis=1))
    if len(bound):
        said.append(
            f"In {len(bound)} of {result.lanes} lanes an unknown ended on its bound. The errors of "
            "the other unknowns there hold it fixed: they do not include its own uncertainty."
        )
    return said
