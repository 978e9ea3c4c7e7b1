"""Curves that were not measured, from a finished fit; and which presses a fit can predict."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.prediction.curves import CurvePrediction, predict_sources
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.prediction.sources import source_of


def predict(
    results: FitResult,
    *,
    s: float,
    displacement: ArrayLike | Sequence[float],
    specimen: str | None = None,
    trial: str | None = None,
    phi: float = 0.0,
    direction: tuple[float, float] = (1.0, 0.0),
    time: ArrayLike | Sequence[float] | None = None,
) -> CurvePrediction:
    """A curve that was not measured, from a finished fit.

        results = jaxtrachea.read_results("out/fit")
        curve = jaxtrachea.predict(results, s=75.0, displacement=[0.5, 1.0, 2.0])
        print(curve.force, curve.low95, curve.high95)

    Computed in float64 where JAX is set to it (`jax_enable_x64`), else in float32.

    Args:
        results: from `read_results` or `fit`.
        s: contact position, mm, on the tube.
        displacement: of the tool, mm; one number or a vector. From first touch; with `trial` as
            that trial records it.
        specimen: whose parameters; may be left out where the fit has one specimen only, or shares
            all parameters.
        trial: of the fit, whose own parameters count: displacement and force are as it records
            them, with its onset and force offset (of any scope, or held) and the rounded corner of
            its onset; None: a new press, both are 0 and certain, whatever the fit has or holds, and
            the corner is sharp (`onset_width` of the model).
        phi: contact angle from the anterior midline, rad; with direction: of a skeleton of
            deforming cross-sections.
        direction: of the tool's displacement along the inward normal and the circumference.
        time: of every displacement, s, never falling, where the force relaxes: from rest before
            the first, with the elastic force even in time between two.

    Raises:
        ValueError: a position outside the tube, a displacement that is no finite number, a time
            that the fit needs or does not have, or that falls, a specimen or trial that the fit
            does not have, one without an estimate; with the cure.
    """
    D = np.atleast_1d(np.asarray(displacement, np.float64))
    if D.ndim != 1 or not D.size or not np.isfinite(D).all():
        raise ValueError("displacement: expected a finite number or a vector of them, mm")
    check_position(results, s)
    check_off_midline(results, phi, direction)
    check_timed(results, time is not None, "time")
    times = None if time is None else [_times(time, D)]
    if specimen is None:
        specimen = _only_specimen(results)
    elif specimen not in (names := pressed(results).specimens):
        raise ValueError(unknown_name("specimen", specimen, names))
    source = source_of(results, specimen, trial)
    if not source.status.predicts:
        raise ValueError(f"{specimen}: {source.message or source.status.message}")
    along = float(direction[0]), float(direction[1])
    aside = [(float(phi), along)]
    return predict_sources(results, [source], [float(s)], [D], aside=aside, times=times)[0]


def _times(time: ArrayLike | Sequence[float], displacement: np.ndarray) -> np.ndarray:
    """Times as a vector."""
    t = np.atleast_1d(np.asarray(time, np.float64))
    if t.shape != displacement.shape:
        raise ValueError(
            f"time has {t.size} numbers, displacement {displacement.size}; expected one for each"
        )
    if not np.isfinite(t).all() or np.any(np.diff(t) < 0):
        raise ValueError("time: expected finite numbers that never fall, s")
    return t


def check_timed(results: FitResult, given: bool, what: str) -> None:
    """Refuse a press without the time that a fit needs, and one with a time that it does not read.

    Raises:
        ValueError: with the cure.
    """
    relaxes = results.study.model.relaxes
    if relaxes and not given:
        raise ValueError(
            f"the force of this fit relaxes (relaxation = "
            f"{results.study.model.options.relaxation!r}), so that it follows from how fast the "
            f"tool comes; give {what}"
        )
    if given and not relaxes:
        raise ValueError(f"this fit is elastic, its force knows no time; leave {what} out")


def check_off_midline(results: FitResult, phi: float, direction: tuple[float, float]) -> None:
    """Refuse a press that the model does not have.

    Raises:
        ValueError: with what is expected.
    """
    model = results.study.model
    if not model.level.off_midline:
        if phi != 0 or tuple(direction) != (1.0, 0.0):
            raise ValueError(
                "this fit presses on the anterior midline along the normal; phi and direction "
                "(tilt) need a fit with skeleton = 'sections'"
            )
        return
    alpha = float(model.geometry.half_angle)
    if not abs(phi) <= alpha:
        raise ValueError(
            f"phi = {phi:g} rad ({np.degrees(phi):.4g} deg) is not on the cartilage; expected "
            f"within {alpha:.4g} rad ({np.degrees(alpha):.4g} deg)"
        )
    if not abs(phi) <= (most := model.level.validated_angle(alpha)):
        raise ValueError(
            f"phi = {phi:g} rad ({np.degrees(phi):.4g} deg) is too near to the ends of the rings, "
            f"where the model is too stiff; expected within {most:.4g} rad "
            f"({np.degrees(most):.4g} deg)"
        )
    if not abs(np.hypot(*direction) - 1) < 1e-6:
        raise ValueError(f"direction is {direction}; expected a unit vector")


def check_position(results: FitResult, s: float) -> None:
    """Refuse a contact position that is not on the tube.

    Raises:
        ValueError: with what is expected.
    """
    model = results.study.model
    low, high = model.options.places(float(model.geometry.length))
    if not low <= s <= high:
        tool = f", with all of the tool (half_width {low:g} mm)" if low > 0 else ""
        raise ValueError(f"s = {s:g} mm is not on the tube{tool}; expected {low:g} to {high:g} mm")


def unknown_name(kind: str, name: str, known) -> str:
    """Message for a name that the fit does not have."""
    listed = ", ".join(map(repr, list(known)[:12])) + (", ..." if len(known) > 12 else "")
    return f"{kind} {name!r} is not in this fit; expected one of {listed}"


def _only_specimen(results: FitResult) -> str:
    names = pressed(results).specimens
    shared = all(p.scope in ("shared", "trial") for p in results.study.free)
    if len(names) > 1 and not shared:
        raise ValueError(
            f"this fit has {len(names)} specimens with parameters of their own; give specimen=, "
            f"one of {', '.join(map(repr, names[:12]))}{', ...' if len(names) > 12 else ''}"
        )
    return next(iter(names))
