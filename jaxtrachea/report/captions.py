"""Which pictures of a fit there are, and what stands below each; matplotlib is not needed here."""

from jaxtrachea.fitting.result import FitResult

#: Fits whose positions have a panel each; of more, a panel is a fit.
FEW = 3


def captions(result: FitResult) -> dict[str, str]:
    """By name of the file without its ending, in the order of the report."""
    seen, few = result.residuals, result.lanes <= FEW
    found = {"fit": "data and fit, with residuals in standard deviations"}
    if few and seen.joints is not None:
        found["joints"] = "markers at the largest displacement, and fit"
    if few and seen.side_force is not None:
        found["side_force"] = "side force and fit"
    if not few:  # else they stand under the curves
        found["residuals"] = "residuals of the force"
    if (result.converged_starts < result.tried).any():
        found["waterfall"] = "where the starts ended, lowest first"
    if result.study.free:
        found["correlation"] = "correlation of the estimates"
    return found
