"""Presses to choose the next one from, and how deep the curves so far have reached."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.fitting.onset import counted_from
from jaxtrachea.fitting.refusals import depths, unvalidated
from jaxtrachea.fitting.relaxing import beyond_ramps, span_of
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.whole_record import loading_speed, longest_hold

#: Candidates where the user does not say: of a level that iterates, of a force that relaxes, and of
#: a formula, which costs next to nothing.
_FEW, _IN_TIME, _MANY = 250, 1_000, 10_000
#: Speed (mm/s) and hold (s) of a press; None: the force knows no time.
_Pace = tuple[float, float] | None


class Candidates(NamedTuple):
    """Presses to choose from; C of them.

    Attributes:
        s: contact position, mm.
        depth: largest tool displacement from first touch, mm.
        phi: contact angle, rad; None: all on the midline.
        curve: a curve of the lane on whose specimen it is; None: the first.
        speed: of the tool, mm/s; None: the force knows no time.
        hold: how long the tool then stays, s, 0 or more; with `speed`.
    """

    s: Float[np.ndarray, " C"]
    depth: Float[np.ndarray, " C"]
    phi: Float[np.ndarray, " C"] | None = None
    curve: Int[np.ndarray, " C"] | None = None
    speed: Float[np.ndarray, " C"] | None = None
    hold: Float[np.ndarray, " C"] | None = None


def grid(
    s: tuple[float, float],
    depth: tuple[float, float],
    count: int = 10_000,
    phi: Sequence[float] = (0.0,),
    curve: Sequence[int] = (0,),
    pace: Sequence[_Pace] = (None,),
) -> Candidates:
    """About `count` candidates in a reachable region, five depths at even positions.

    Args:
        s: first and last position, mm.
        depth: least and largest, mm.
        count: of all candidates.
        phi: angles, rad; each at every position and depth.
        curve: see `Candidates`; all of it on each of these.
        pace: speed and hold, see `Candidates`; all of it with each of these.
    """
    depths = np.linspace(*depth, 5) if depth[1] > depth[0] else np.array([depth[0]])
    kinds = len(depths) * len(phi) * len(curve) * len(pace)
    positions = np.linspace(*s, max(count // kinds, 1))
    axes = np.meshgrid(curve, range(len(pace)), phi, positions, depths, indexing="ij")
    of, moved, turned, at, down = (v.ravel() for v in axes)
    timed = np.array([p for p in pace if p is not None]).reshape(-1, 2)
    speed, hold = timed[moved].T if len(timed) else (None, None)
    return Candidates(
        at, down, turned if np.any(turned) else None, of.astype(int) if np.any(of) else None,
        speed, hold,
    )  # fmt: skip


def pressed_curves(study: Study) -> list[int]:
    """First curve of every specimen that has unknowns of its own; the first alone elsewhere.

    Where every specimen is a lane a press is one on each of them.
    """
    if len(study.lanes.s_c) > 1:
        return [0]
    columns = [j for j in study.free_columns if study.parameters[j].scope != "trial"]
    rows = study.lanes.index[0, : len(study.curves[0])][:, columns]
    return np.sort(np.unique(rows, axis=0, return_index=True)[1]).tolist()


def pressed_specimen(study: Study, curve: int = 0) -> str:
    """Name of the specimen of a press; "(each)" of several lanes, "(any)" where all are alike."""
    names = {c.specimen for curves in study.curves for c in curves}
    if len(names) > 1 and len(study.lanes.s_c) > 1:
        return "(each)"
    if len(names) > 1 and len(pressed_curves(study)) == 1:
        return "(any)"
    return study.curves[0][curve].specimen


def reached(study: Study, touch: Float[np.ndarray, "lanes T"] | None = None) -> tuple[float, float]:
    """Least and largest depth of the curves, mm from first touch.

    Args:
        touch: as `FitResult.first_touch`; None: as `Study.first_touch` has it before a fit.
    """
    options = study.model.options
    touch = study.first_touch if touch is None else touch
    pressed = [
        depths(c.displacement, at, options)
        for row, curves in zip(touch, study.curves, strict=True)
        for at, c in zip(row[: len(curves)].tolist(), curves, strict=True)
        if np.isfinite(at)  # a lane without an estimate
    ]
    return float(min(map(np.min, pressed))), float(max(map(np.max, pressed)))


def extrapolation(study: Study, depth: float, reach: tuple[float, float] | None = None) -> str:
    """What of a press goes deeper than the curves did, or the model was tested; "" if nothing.

    Args:
        depth: mm from first touch.
        reach: of the curves, as `reached` has it of the fit; None: as before a fit.
    """
    low, high = reached(study) if reach is None else reach
    counted, model = counted_from(study.parameters), study.model
    beyond = depth > high + 1e-9
    known = f"extrapolated from data at D = {low:.3g} to {high:.3g} mm{counted}" if beyond else ""
    tested = unvalidated(model.options, float(model.geometry.radius), depth, counted)
    return "; ".join(filter(None, [known, tested]))


def check(study: Study) -> None:
    """Refuse a study whose unknowns a new curve would not share.

    Raises:
        ValueError: naming the parameters; or a joint study.
    """
    study.refuse_joint("a design")
    own = [p.name for p in study.free if p.scope == "trial"]
    if len(own) == len(study.free):
        raise ValueError(
            f"{', '.join(own)}: every free parameter belongs to single trials, so that a further "
            "press tells nothing of them; give one the scope 'specimen' or 'shared'"
        )


def candidates_of(
    spec: FitSpec, study: Study, reach: tuple[float, float] | None = None
) -> Candidates:
    """The presses of the [design] section; left out: first to last ring, half to full depth.

    From ring to ring as far as all of the tool lies on the tube; of deforming cross-sections at
    every angle that was measured; on every specimen that has unknowns of its own.

    Raises:
        SpecError: as `_paces`; positions outside the tube or where the tool reaches beyond its
            ends, depths of more than its radius, angles that the model does not have, or unknowns
            that a new curve would not share.
    """
    try:
        check(study)
    except ValueError as error:
        raise SpecError(f"parameters: {error}") from None
    section, length = spec.design, float(study.model.geometry.length)
    deepest = (reached(study) if reach is None else reach)[1]
    rings = study.model.geometry.ring_positions
    low, high = study.model.options.places(length)
    s = (max(float(rings[0]), low), min(float(rings[-1]), high)) if section.s is None else section.s
    if s[0] < low or s[1] > high:
        tool = f", the tool (half_width {low:g} mm) fits from {low:g} to {high:g} mm"
        raise SpecError(
            f"design.s: {s[0]:g} to {s[1]:g} mm, tube spans 0 to {length:g} mm"
            f"{tool if low > 0 else ''}; give places on it"
        )
    level, radius = study.model.level, float(study.model.geometry.radius)
    deepest = min(deepest, level.deepest(radius))
    depth = (0.5 * deepest, deepest) if section.depth is None else section.depth
    # Without a skeleton the specimen need not be a tube.
    limited = study.model.options.coupling == "series"
    if section.depth is not None and limited and depth[1] > radius:
        raise SpecError(
            f"design.depth: {depth[1]:g} mm, a tube is pressed no deeper than its radius, expected "
            f"at most {radius:g} mm; give less (trachea.radius is that of the tube)"
        )
    usual = _FEW if level.iterates else _IN_TIME if level.relaxes else _MANY
    count = usual if section.candidates is None else section.candidates
    pace = _paces(section.speed, section.hold, study)
    return grid(s, depth, count, _angles(section.phi, study), pressed_curves(study), pace)


def _paces(
    speed: tuple[float, ...] | None, hold: tuple[float, ...] | None, study: Study
) -> list[_Pace]:
    """Every speed with every hold; left out: the slowest and the fastest, the longest measured."""
    if not study.model.relaxes:
        for key, given in (("speed", speed), ("hold", hold)):
            if given is not None:
                raise SpecError(
                    f"design.{key}: this model is elastic, its force knows no time; leave it out, "
                    "or choose a relaxation"
                )
        return [None]
    curves = [c for lane in study.curves for c in lane]
    if speed is None:
        known = [v for c in curves if (v := loading_speed(c)) > 0]
        if not known:
            raise SpecError("design.speed: no record tells its speed; give one, as in ['1 mm/s']")
        speed = (min(known), max(known))
    if hold is None:
        known = [h.duration for c in curves if (h := longest_hold(c)) is not None]
        hold = (max(known, default=0.0),)
    if min(hold) < 0:
        raise SpecError(f"design.hold: {min(hold):g} s; expected 0 s or more")
    return [(v, t) for v in sorted(set(speed)) for t in sorted(set(hold))]


def beyond_records(study: Study, speed: float, hold: float, depth: float) -> str:
    """Whether a press takes longer than the records, or its ramp is faster; "" if neither.

    Args:
        speed: mm/s.
        hold: s.
        depth: mm from first touch.
    """
    curves = [c for lane in study.curves for c in lane]
    longest, said = span_of(curves).longest, [beyond_ramps(curves, speed, depth)]
    if depth / speed + hold > longest * (1 + 1e-9):
        said.insert(0, f"extrapolated from records of at most {longest:.3g} s")
    return "; ".join(filter(None, said))


def _angles(asked: tuple[float, ...] | None, study: Study) -> list[float]:
    """Angles of the candidates, rad, each once."""
    if not study.model.level.off_midline:
        if asked is not None:
            raise SpecError(
                "design.phi: this model presses on the midline alone; leave it out, or choose "
                "skeleton = 'sections'"
            )
        return [0.0]
    if asked is None:
        measured = (c.phi_c for curves in study.curves for c in curves)
        return sorted({round(float(phi), 9) + 0.0 for phi in measured})
    reach = study.model.level.validated_angle(float(study.model.geometry.half_angle))
    for phi in asked:
        if not abs(phi) <= reach:
            raise SpecError(
                f"design.phi: {np.degrees(phi):.4g} deg; deforming "
                f"cross-sections are right within {np.degrees(reach):.4g} deg of the midline"
            )
    return sorted(set(asked))
