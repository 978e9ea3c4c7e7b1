"""Curves that a model cannot press: refused with specimen, trial, reason and cure."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.parameters import OF_THE_PRESS, Parameter
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.sections.press import tested_angle
from jaxtrachea.trachea.geometry import Geometry


class Size(NamedTuple):
    """What a press must keep to of a tube, in plain numbers: many curves are held against it.

    Attributes:
        length: mm.
        radius: mm.
        half_angle: half opening of the C-rings, rad.
        rings: how many there are.
    """

    length: float
    radius: float
    half_angle: float
    rings: int

    @classmethod
    def of(cls, geometry: Geometry) -> "Size":
        """The size of a tube."""
        length, radius, angle = map(float, (geometry.length, geometry.radius, geometry.half_angle))
        return cls(length, radius, angle, geometry.rings)


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
        InputError: no contact position, one outside the tube, one off the midline or a tool that
            moves aside where the skeleton is a line of joints, a tool whose width reaches beyond an
            end of the tube, a marker or an end of a ring that does not exist; specimen and trial
            are named.
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
    else:
        _check_width(curve.s_c, length, options, where)
    if options.deforms_sections:
        if not abs(curve.phi_c) <= size.half_angle:
            raise InputError(
                f"contact at phi = {np.degrees(curve.phi_c):.3g} deg, expected on the cartilage, "
                f"within {np.degrees(size.half_angle):.3g} deg of the midline",
                place=where,
            )
        if not abs(curve.phi_c) <= (most := float(tested_angle(size.half_angle)) + 1e-6):
            raise InputError(
                f"contact at phi = {np.degrees(curve.phi_c):.3g} deg, expected within "
                f"{np.degrees(most):.3g} deg of the midline: nearer to the ends of the rings "
                "deforming cross-sections are too stiff",
                place=where,
                cure="leave the curve out",
            )
        if (deepest := float(np.max(np.abs(curve.displacement - onset)))) > size.radius:
            raise InputError(
                f"pressed {deepest:.3g} mm deep, expected no more than the radius, "
                f"{size.radius:g} mm",
                place=where,
                cure="cut the curve off (displacement_max) or leave it out",
            )
    else:
        _check_normal(curve, options, where)
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


def _check_normal(curve: Curve, options: Options, where: str) -> None:
    """Refuse a press that a line of joints does not have.

    Raises:
        InputError: naming specimen and trial, and the level that has it.
    """
    cure = "choose skeleton = 'sections' and contact = 'bonded', or leave the curve out"
    if options.coupling == "series" and abs(curve.phi_c) > 1e-6:
        raise InputError(
            f"contact at phi = {np.degrees(curve.phi_c):.3g} deg; this model presses on the "
            "anterior midline (phi = 0) only",
            place=where,
            cure=cure,
        )
    if abs(curve.direction[1]) > 1e-6:
        shown = ", ".join(f"{v:.4g}" for v in curve.direction)
        raise InputError(
            f"the tool moves in the direction ({shown}); this model presses along the inward "
            "normal (1, 0) only",
            place=where,
            cure=cure,
        )


def _check_width(s_c: float, length: float, options: Options, where: str) -> None:
    """Refuse a tool of which a part lies off the tube.

    Raises:
        InputError: naming the curve, the width and the places for it.
    """
    low, high = options.places(length)
    if low <= s_c <= high:
        return
    expected = f"s from {low:g} to {high:g} mm"
    if low > high:
        expected = f"a tool no wider than the tube is long, {length:g} mm"
    raise InputError(
        f"contact at s = {s_c:g} mm, where a tool of half_width {options.half_width:g} mm reaches "
        "beyond an end of the tube",
        place=where,
        expected=expected,
        cure="leave the curve out, or make half_width smaller (0: the tool touches at a point)",
    )
