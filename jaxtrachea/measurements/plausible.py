"""Sizes of force and displacement that a soft tube under a tool does not reach."""

import numpy as np

#: Plausible extent of displacement (mm), of force (N), and stiffness (N/mm) of a press: from thin
#: airways of small animals to silicone cylinders of 50 mm, with room to spare.
DISPLACEMENT, FORCE, STIFFNESS = (0.05, 100.0), (1e-3, 1000.0), (1e-3, 200.0)
#: What a record that only draws may rise above 0, as a share of its depth below: noise.
DRAWN = 0.1
#: Units that are taken for mm and N by mistake, in mm and N.
LENGTHS = {"um": 1e-3, "cm": 10.0, "m": 1000.0}
FORCES = {"mN": 1e-3, "gf": 9.80665e-3, "kN": 1000.0}


def implausible_size(displacement: np.ndarray, force: np.ndarray) -> str | None:
    """What is hard to believe about the size of a curve, with the unit it may be in.

    A displacement and a force that are both tiny are taken for a cantilever's and left alone.

    Args:
        displacement: (N,) mm.
        force: (N,) N.
    """
    return implausible_extent(float(np.ptp(displacement)), float(np.ptp(force)))


def retracting(displacement: np.ndarray, force: np.ndarray) -> str | None:
    """What a record says in which a tool draws from the beginning; one sentence, or None.

    A press whose file counts both the other way looks the same, and where first touch and the zero
    of the force are fitted it could be one of these, too. Not seen where a zero is off by more than
    `DRAWN` of the depth.
    """
    if any(v.size < 2 or v.max() > -DRAWN * v.min() for v in (displacement, force)):
        return None
    if displacement[-1] > displacement[0]:  # it rises, to a zero where it may have been tared
        return None
    return (
        f"displacement and force go down to {displacement.min():.4g} mm and {force.min():.4g} N: a "
        "tool that draws; if it presses, set displacement_sign = -1 and force_sign = -1"
    )


def implausible_extent(extent: float, peak: float) -> str | None:
    """As `implausible_size`, of the range of the displacement (mm) and of the force (N)."""
    if _within(extent, peak) or (extent < DISPLACEMENT[0] and peak < FORCE[0]):
        return None
    units = [f"force in {u} ({peak * f:.3g} N)" for u, f in FORCES.items()
             if _within(extent, peak * f)]  # fmt: skip
    units += [f"displacement in {u} ({extent * f:.3g} mm)" for u, f in LENGTHS.items()
              if _within(extent * f, peak)]  # fmt: skip
    hint = f"likely the {' or the '.join(units)}" if units else "check both units"
    return f"{peak:.4g} N over {extent:.3g} mm is hard to believe of a soft tube: {hint}"


def _within(extent: float, peak: float) -> bool:
    """Whether displacement, force and stiffness are all plausible."""
    values = ((extent, DISPLACEMENT), (peak, FORCE), (peak / extent, STIFFNESS))
    return all(low <= value <= high for value, (low, high) in values)
