"""Whether the tool has a width along the tube: the rule of `effects`' width.

The punch of `mechanics.punch` is held level in one plane, that of deforming cross-sections wherever
it presses. What of a tool lies on the wall grows
with the depth; a width is that of a flat end, and stiffnesses fitted with one belong to it.
"""

import math

from jaxtrachea.scene.declare import SECTIONS, Case, PlanError, Verdict

#: Half widths per ring spacing that are a point: below, two forces lose their digits in float32.
NARROW = 1 / 200

_STRAIGHT_IN = (
    "press straight in on the midline: no friction, no axial motion, rings 'mat'; or set width "
    "'point', with stiffnesses that were fitted so"
)


def width(case: Case) -> Verdict:
    """A punch where `half_width` is given; never a point without a word.

    Raises:
        PlanError: a width where no punch is defined.
    """
    half = case.options.half_width
    if half == 0:
        why = "half_width is 0", "give it, in [model] of a file, or use 'point'"
        return Verdict("point", "the tool touches at a point (half_width is 0)", {"punch": why})
    cannot, cure = _undefined(case, half)
    if cannot and case.options.width == "auto":
        raise PlanError("width", "'auto'", f"half_width is {half:g} mm, and {cannot}", cure)
    level = f"half_width is {half:g} mm: two forces hold the ligament level over twice that"
    return Verdict("punch", level, {"punch": (cannot, cure)} if cannot else {})


def _undefined(case: Case, half: float) -> tuple[str, str]:
    """Why no punch is defined in this scene, and the cure; empty where one is."""
    if SECTIONS not in case.facts.known and case.levels["second_plane"] != "off":
        why = "a width is for presses straight in on the midline, this scene has a second plane"
        return why, _STRAIGHT_IN
    if math.isfinite(case.facts.spacing) and half < NARROW * case.facts.spacing:
        why = f"that is next to a point where rings stand {case.facts.spacing:g} mm apart"
        return why, "check its unit (mm), or leave it out"
    return "", ""
