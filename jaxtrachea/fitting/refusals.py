"""Curves that a model cannot press, or not deeper than tested; what of a curve it does not read."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.parameters import OF_THE_PRESS, Parameter
from jaxtrachea.measurements.observed import VECTORS, WITHOUT_VECTORS
from jaxtrachea.measurements.read import Curve
from jaxtrachea.measurements.usage import CAUSES
from jaxtrachea.measurements.vectors import observed
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.level import Level, Size
from jaxtrachea.mechanics.levels.line import VALIDATED_DEPTH
from jaxtrachea.mechanics.levels.options import Options

#: Causes of samples left out of a record after which its force is not that of rest.
_REMEMBERED = ("before", "turning back", "window")
#: Largest error of `uniform` over the peak, by depth over the radius, until the end of a hold and
#: in unloading: of a skeleton that softens, and of the others (tests/test_visco_arch.py).
_DEEP = (1 / 11.7, 2 / 11.7, 3.5 / 11.7)
_ERRORS = {
    "softening": ((0.003, 0.005, 0.009), (0.012, 0.026, 0.045)),
    "others": ((0.008, 0.016, 0.027), (0.022, 0.044, 0.074)),
}
#: From this error on a note says so.
_WORTH_A_NOTE = 0.02
#: Share of its way by which a tool that unloads comes back.
_UNLOADS = 0.1


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
    level = level_of(options)
    if (refused := level.admits(curve, size, onset)) is not None:
        raise InputError.like(refused, place=where)
    if level.relaxes and curve.usage is not None and curve.rise is None:
        cut = [CAUSES[cause] for cause in _REMEMBERED if cause in curve.usage.left_out]
        if cut:
            raise InputError(
                f"{' and '.join(cut)} of the record are left out, which a force that relaxes "
                "remembers",
                place=where,
                cure='take loading = "record", or relaxation = "off"',
            )
    if curve.joint_rings is not None and np.any(curve.joint_rings >= rings):
        found = f"marker on ring {curve.joint_rings.max() + 1} of {rings}"
        raise InputError(found, place=where)
    if curve.end_rings is not None and np.any(curve.end_rings >= rings):
        found = f"end of ring {curve.end_rings.max() + 1} of {rings}"
        raise InputError(found, place=where)


def check_touch(curve: Curve, options: Options, parameters: Sequence[Parameter]) -> None:
    """Refuse a curve whose largest force is one that a tool which only touches cannot have.

    Args:
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


def as_read(curves: Sequence[Curve], level: Level) -> tuple[Sequence[Curve], str | None]:
    """Curves as a level reads them: without vectors where it presses along the normal alone.

    Returns:
        The curves without their vectors, and a sentence on what was left out; None: nothing was.
    """
    if level.off_midline:
        return curves, None
    counts = {name: sum(observed(c, name) for c in curves) for name in VECTORS}
    counts = {name: count for name, count in counts.items() if count}
    plain = [
        dataclasses.replace(c, **WITHOUT_VECTORS)
        if any(getattr(c, name) is not None for name in WITHOUT_VECTORS)
        else c
        for c in curves
    ]
    if not counts:
        return plain, None
    listed = ", ".join(f"{VECTORS[name]} in {n}" for name, n in counts.items())
    return plain, (
        f"Measured and not read: {listed} of {len(curves)} curves; this model presses along the "
        "inward normal and knows only the force and the markers along it"
    )


def tested_depth(options: Options, radius: float) -> float:
    """Depth to which the model was tested, mm; inf without a skeleton (coupling `total`)."""
    return level_of(options).validated_depth * radius * (1 + 1e-9)  # with what rounding takes


def depths(
    displacement: Float[np.ndarray, "*n"], touch: float | np.ndarray, options: Options
) -> Float[np.ndarray, "*n"]:
    """How deep the tool presses, mm from first touch; before it a tool that only touches does not.

    Args:
        displacement: as recorded, mm.
        touch: that at first touch, mm.
        options: with `bonded` contact the tool pulls before it, a negative depth.
    """
    depth = displacement - touch
    return np.maximum(depth, 0) if options.contact == "unilateral" else depth


def unvalidated(options: Options, radius: float, depth: float, counted: str = "") -> str:
    """Whether a press of `depth` goes deeper than the model was tested, in words; "" if not.

    `counted`: see `onset.counted_from`.
    """
    most = tested_depth(options, radius)
    return f"the model was tested to D = {most:.3g} mm{counted}" if depth > most else ""


def mixed_in_time(curves: Sequence[Curve], options: Options) -> str | None:
    """A sentence on whole records that an elastic model is fitted to; None: there are none."""
    whole = sum(c.rise is not None for c in curves)
    if not whole or level_of(options).relaxes:
        return None
    return (
        f"{whole} of {len(curves)} curves are whole records, with all of their speeds, holds and "
        "unloading: an elastic model mixes them; choose relaxation = 'uniform', or loading = 'last'"
    )


def too_deep_for_uniform(
    curves: Sequence[Curve],
    options: Options,
    radius: float,
    touch: Sequence[float] | None = None,
) -> str | None:
    """A sentence on curves so deep that `uniform` errs by more than 2 % of the peak; None: none.

    The tube flattens under the tool, and its shape forgets at once what its stresses remember.

    Args:
        curves: as recorded.
        radius: of the tube, mm.
        touch: displacement of each curve at first touch, mm; None: 0.
    """
    if options.relaxation != "uniform" or options.coupling != "series":
        return None
    softens = "e_1" in level_of(options).needs(joints=False)
    errors = _ERRORS["softening" if softens else "others"]
    found = []
    for c, at in zip(curves, [0.0] * len(curves) if touch is None else touch, strict=True):
        depth = depths(c.displacement, at, options)
        fall = np.max(np.maximum.accumulate(depth) - depth)
        back = bool(fall > _UNLOADS * np.max(np.abs(depth)))
        deep = float(np.max(np.abs(depth)))
        found.append((float(np.interp(deep / radius, (0, *_DEEP), (0, *errors[back]))), deep, back))
    most, deep, back = max(found)
    if most <= _WORTH_A_NOTE:
        return None
    count = sum(error > _WORTH_A_NOTE for error, *_ in found)
    cure = "end the records with their holds" if back else "press less deep"
    cure = cure if softens else f"choose skeleton = 'softening', or {cure}"
    return (
        f"relaxation = 'uniform' errs by more than 2 % of the peak in {count} of {len(curves)} "
        f"curves: by {'more than ' if deep > _DEEP[-1] * radius else ''}{100 * most:.2g} % "
        f"{'in unloading from' if back else 'at'} {deep:.3g} mm, as an arch that flattens does "
        f"(docs/validity.md); {cure}"
    )


def deeper_than_validated(
    curves: Sequence[Curve],
    options: Options,
    radius: float,
    touch: Sequence[float] | None = None,
    counted: str = "",
) -> str | None:
    """A sentence on curves that go deeper than the model was tested; None: there are none.

    Args:
        curves: as recorded.
        radius: of the tube, mm.
        touch: displacement of each curve at first touch, mm; None: 0.
        counted: see `onset.counted_from`.
    """
    most = tested_depth(options, radius)
    touch = [0.0] * len(curves) if touch is None else touch
    deepest = (
        float(np.max(np.abs(depths(c.displacement, at, options))))
        for c, at in zip(curves, touch, strict=True)
    )
    deep = [d for d in deepest if d > most]
    if not deep:
        return None
    cure = "cut them off or leave them out where that matters"
    if level_of(options).validated_depth < VALIDATED_DEPTH["softening"]:
        cure = "choose skeleton = 'softening' or 'sections'"
    return (
        f"{len(deep)} of {len(curves)} curves go to {max(deep):.3g} mm{counted}; skeleton = "
        f"{options.skeleton!r} was tested to {most:.3g} mm "
        f"({level_of(options).validated_depth:g} of the radius), beyond it the model may be off by "
        f"more than its bands say; {cure}"
    )
