"""Which pictures of a fit there are, and what stands below each; matplotlib is not needed here."""

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.measurements.observed import FITTED_NUMBERS

#: Fits whose positions have a panel each; of more, a panel is a fit.
FEW = 3


def captions(result: FitResult) -> dict[str, str]:
    """By name of the file without its ending, in the order of the report."""
    seen, few = result.residuals, result.lanes <= FEW
    found = {"fit": "data and fit, with residuals in standard deviations"}
    if few and "joints" in seen:
        found["joints"] = "markers at the largest displacement, and fit"
    found |= {n: f"{q.words} and fit" for n, q in FITTED_NUMBERS.items() if few and n in seen}
    if not few:  # else they stand under the curves
        found["residuals"] = "residuals of the force"
    if (result.converged_starts < result.tried).any():
        found["waterfall"] = "where the starts ended, lowest first"
    if result.study.free:
        found["correlation"] = "correlation of the estimates"
    return found
