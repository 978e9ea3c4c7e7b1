"""Curves that a model cannot press: refused with specimen, trial, reason and cure."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.parameters import OF_THE_PRESS, Parameter
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.level import Size
from jaxtrachea.mechanics.levels.options import Options


class Refusal(NamedTuple):
    """Why a curve cannot be pressed.

    Attributes:
        kind: `position` or `sign`.
        error: reason and cure; specimen and trial are its place.
    """

    kind: str
    error: InputError


def check_noise(curves: Sequence[Curve], force: float | None) -> None:
    """Refuse curves of which some have a sigma and others none, where no noise is given for those.

    Args:
        curves: all that are fitted.
        force: `Noise.force`, N.

    Raises:
        InputError: some curves have a sigma and some none; a curve without is named.
    """
    without = [c for c in curves if c.sigma is None]
    if force is None and 0 < len(without) < len(curves):
        first = without[0]
        raise InputError(
            f"no sigma, as {len(without)} of {len(curves)} curves, where the others have one: "
            "give sigma for all curves or for none",
            place=f"specimen {first.specimen!r} trial {first.trial!r}",
            cure="give noise.force, for curves without a column sigma, or leave sigma out of all "
            "files",
        )


def refusal(
    curve: Curve, size: Size, options: Options, parameters: Sequence[Parameter]
) -> Refusal | None:
    """Why the model cannot press a curve (`check_curve`, `check_touch`); None: it can."""
    kind = "position"
    try:
        onset = next(p.value for p in parameters if p.name == "onset")
        check_curve(curve, size, options, onset)
        kind = "sign"
        check_touch(curve, options, parameters)
    except InputError as error:
        return Refusal(kind, error)
    return None


def check_curve(curve: Curve, size: Size, options: Options, onset: float = 0.0) -> None:
    """Refuse a curve that the model cannot press.

    Args:
        curve: the curve.
        size: of the tube.
        options: of the model.
        onset: displacement at first touch, mm: held there, or the first guess.

    Raises:
        InputError: no contact position, one outside the tube, what the level does not admit, a
            marker or an end of a ring that does not exist; specimen and trial are named.
    """
    where = f"specimen {curve.specimen!r} trial {curve.trial!r}"
    length, rings = size.length, size.rings
    if curve.s_c is None:
        if options.coupling == "series":
            raise InputError(
                "no contact position",
                place=where,
                cure="give a column s, or data.s for all curves (coupling = 'total' needs none)",
            )
    elif not 0 <= curve.s_c <= length:
        raise InputError(
            f"contact at s = {curve.s_c:g} mm, expected on the tube, 0 to {length:g} mm",
            place=where,
        )
    if (refused := level_of(options).admits(curve, size, onset)) is not None:
        raise InputError.like(refused, place=where)
    if curve.joint_rings is not None and np.any(curve.joint_rings >= rings):
        found = f"marker on ring {curve.joint_rings.max() + 1} of {rings}"
        raise InputError(found, place=where)
    if curve.end_rings is not None and np.any(curve.end_rings >= rings):
        found = f"end of ring {curve.end_rings.max() + 1} of {rings}"
        raise InputError(found, place=where)


def check_touch(curve: Curve, options: Options, parameters: Sequence[Parameter]) -> None:
    """Refuse a curve whose largest force is one that a tool which only touches cannot have.

    Args:
        curve: the curve.
        options: with `unilateral` contact; other curves may pull.
        parameters: the table: a fitted onset may lie anywhere, a fitted offset shifts all forces.

    Raises:
        InputError: it pulls, or comes before the onset, both by twice what is left; specimen and
            trial are named.
    """
    if options.contact != "unilateral":
        return
    onset, offset = (next(p for p in parameters if p.name == name) for name in OF_THE_PRESS[:2])
    force = curve.force - (offset.value if offset.fixed else 0)
    pushes = force.max() >= -force.min()
    # Where first touch is may follow from the record; not where both signs may be the other way.
    begin = onset.value if onset.fixed and not (onset.auto and pushes) else -np.inf
    if curve.displacement.min() > begin and pushes:
        return  # as most are: pressed from the first sample on, and it pushes
    pressed = curve.displacement > begin
    lost = np.abs(np.where(pressed, np.minimum(force, 0), force))
    kept = max(float(np.max(force, where=pressed, initial=0)), 0.0)
    nothing_left = np.max(lost) > 2 * kept if offset.fixed else not pressed.any()
    if nothing_left:
        found = f"its largest force is at or before the onset, {onset.value:g} mm"
        if pressed[np.argmax(lost)]:
            found = "its largest force pulls"
        raise InputError(
            f"{found}, where a tool that only touches (contact = 'unilateral') has none",
            place=f"specimen {curve.specimen!r} trial {curve.trial!r}",
            cure="use force_sign = -1 and displacement_sign = -1 where the file counts compression "
            "negative, contact = 'bonded' where it pulls, or fit the onset",
        )
