"""Outcomes as small integers that survive `vmap`; each member carries the sentence a user reads."""

import enum


class _Described(enum.IntEnum):
    """An integer enumeration whose members carry a message."""

    message: str

    def __new__(cls, value: int, message: str):
        """Attach `message` to the member of this integer value."""
        member = int.__new__(cls, value)
        member._value_ = value
        member.message = message
        return member


class PressStatus(_Described):
    """What became of one press of the tool."""

    OK = 0, "solved"
    NO_CONTACT = 1, "the tool does not touch: no force"
    PAST_FOLD = (
        2,
        "past a fold (law with k_3 or k_5 < 0, softening skeleton, sections): "
        "no stable equilibrium",
    )
    NEGATIVE_LOCAL = 3, "coupling 'total': the skeleton moves further than the tool presses"
    NON_FINITE = 4, "an input or a result is not finite"
    BEHIND_GAP = 5, "the contact lies behind the ends of the rings, where there is no cartilage"
    PULLS = 6, "unilateral contact: the tool would have to pull; it lets go or slides (friction)"
    OFF_PLAN = (
        7,
        "this row needs an effect that the plan leaves out (off-midline, oblique or moved contact)",
    )
    OFF_TUBE = 8, "the contact, or a part of a tool's width, lies beyond an end of the tube"
    CONTACT_UNCERTAIN = (
        9,
        "solved, but the contact point is uncertain: flat contact (round the tool more), deep "
        "contact (press less) or an inaccurate wall of a mesh; see `contact_share`",
    )
    BAD_MATERIAL = (
        10,
        "a stiffness or the coefficient of friction is negative, or one is zero that divides",
    )
    IN_LUMEN = (
        11,
        "the tool lies within the tube and did not come through the wall, or has not been clear of "
        "the wall since: lift it off, or lead it out over an end",
    )
    TOO_DEEP = 12, "solved, but the wall is pressed in by more than the tube's radius"
    NEAR_RING_END = (
        13,
        "solved, but pressed beyond 90 degrees from the midline or within 30 of the ring's end, "
        "where deforming cross-sections are too stiff",
    )
    EXTRAPOLATED = (
        14,
        "solved, but by stiffnesses that moduli give for a tube unlike the one on which their "
        "factors were found: forces up to 30 % off; fit them to presses of this tube",
    )
    BACK_IN_TIME = 15, "the time is before that of an earlier sample, or no number"
    LIFTED = 16, "solved, without a force: another tool holds the wall away from this one"
    NOT_CONVERGED = 17, "the contacts are not in balance: too stiff for these digits; use float64"
    TOOLS_OVERLAP = 18, "solved, but this tool and another overlap in space: lead them apart"

    @property
    def solved(self) -> bool:
        """Whether the row holds a solution, with a warning or without; others hold NaN."""
        return self in (
            PressStatus.OK,
            PressStatus.NO_CONTACT,
            PressStatus.CONTACT_UNCERTAIN,
            PressStatus.TOO_DEEP,
            PressStatus.NEAR_RING_END,
            PressStatus.EXTRAPOLATED,
            PressStatus.LIFTED,
            PressStatus.TOOLS_OVERLAP,
        )


class ContactStatus(_Described):
    """What became of one distance between two convex shapes."""

    OK = 0, "solved"
    FLAT = 1, "solved, but other normals are as right: equal minima, or a level distance"
    NOT_CONVERGED = 2, "the search stopped short of a minimum, or on a saddle of the distance"
    NON_FINITE = 3, "an input or a result is not finite"


class FitStatus(_Described):
    """What became of one lane (one specimen from one start) of a fit."""

    CONVERGED = 0, "converged"
    AT_BOUND = 1, "converged with a parameter on its bound"
    UNIDENTIFIABLE = 2, "converged, but the data leave a combination of parameters undetermined"
    MAX_ITERATIONS = 3, "not converged within the allowed iterations"
    STALLED = 4, "no step lowers the cost, yet the gradient is not small"
    INFEASIBLE_START = 5, "the model gives no finite residual at the start"
    NON_FINITE = 6, "the residual or its Jacobian became non-finite"
    BAD_DATA = 7, "the measurements could not be used"
    TOO_FEW_DATA = 8, "fewer usable samples than free parameters"

    @property
    def succeeded(self) -> bool:
        """Whether the estimate is a minimum that may be read (with its warnings)."""
        return self <= FitStatus.UNIDENTIFIABLE


class PredictionStatus(_Described):
    """What became of one predicted curve; the worst of what is to be said."""

    OK = 0, "predicted"
    AT_BOUND = 1, "predicted, but the bands leave out the uncertainty of an unknown on its bound"
    FEW_POSITIONS = (
        2,
        "predicted, but the bands know noise and parameters alone and are not of 95 %: too few "
        "positions tell the model's error between them",
    )
    BENT = (
        3,
        "predicted, but nonlinear within the band: the delta-method band is inaccurate",
    )
    OTHER_ZERO = (
        4,
        "predicted, but a record has, or may have, a zero that the fit holds at 0: displacement or "
        "force is counted from elsewhere",
    )
    EXTRAPOLATED = (
        5,
        "predicted, but for a press unlike those of the fit, with values fixed that come from the "
        "factors of another tube: up to 30 % off, which the bands do not know",
    )
    UNDETERMINED = 6, "predicted, but the data of the fit do not limit it: infinite bands"
    TOO_DEEP = 7, "predicted, but where the wall moves further than the tube's radius"
    NO_SOLUTION = 8, "no stable solution at some displacements"
    NO_OWN = 9, "the curve's own parameters could not be fitted to it"
    NO_ESTIMATE = 10, "the fit has no estimate for it"
    UNKNOWN_SPECIMEN = 11, "the fit does not know this specimen"
    BAD_DATA = 12, "the measurements could not be used"

    @property
    def predicts(self) -> bool:
        """Whether there is a prediction (with its warnings)."""
        return self <= PredictionStatus.NO_SOLUTION


class RingStatus(_Described):
    """Whether a cartilage ring can answer a load at an angle."""

    OK = 0, "solved"
    BEHIND_GAP = 1, "the angle lies behind the ends of the ring, where there is no cartilage"
    NON_FINITE = 2, "an input or a result is not finite"
    OFF_TUBE = 3, "the contact lies beyond an end of the tube"
    BAD_MATERIAL = 4, "a stiffness is negative, or one is zero that divides"


class ProfileEnd(_Described):
    """How a profile likelihood ends on one side."""

    CLOSED = 0, "the profile rises above the threshold"
    BOUND = 1, "it rises above the threshold only where another unknown is on its bound"
    OPEN = 2, "it stays below the threshold up to the bound of the parameter"
    FAILED = 3, "a fit along it did not converge"
