"""What a stream of samples can be fitted with: model, noise, and where it may be pressed."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.build import Table, build_study
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.stream import BLOCK
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.design.candidates import Candidates
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.press import Options
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

#: What the curves of a stream belong to.
SPECIMEN = "online"
#: Default places for the next press.
PLACES = 25
#: What to do about whatever takes whole curves.
CURE = "fit the curves together by build_study and fit"


class OnlineState(NamedTuple):
    """What is known after a sample; P unknowns in the order of `names`, numpy float64.

    Attributes:
        names: of the unknowns.
        value: estimates in the units of the parameters; (P,).
        standard_error: likewise, as tables of a fit have it: with the growth of correlated
            residuals; NaN where the samples do not determine the unknown; (P,).
        low: 95 % interval, local, as tables of a fit have it: the bound where the samples leave the
            unknown open, NaN of an estimate on its bound and without one; (P,).
        high: likewise.
        relative_error: `standard_error` over the value (scale `log`: of the logarithm); (P,).
        covariance: in scaled coordinates, of independent residuals, as `Uncertainty.covariance`;
            (P, P).
        verdict: one of `VERDICTS` for every unknown, of the local error alone; "failed" without an
            estimate.
        next_point: position of the most telling next press, mm, as far as estimate and model can
            be trusted; the bounds count as a weak prior, so that there is one before any sample.
        samples: so far.
        status: as of a fit; NON_FINITE: a sample without equilibrium at the estimate.
        message: what speaks against the estimate, "" if nothing does.
    """

    names: tuple[str, ...]
    value: Float[np.ndarray, " P"]
    standard_error: Float[np.ndarray, " P"]
    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    relative_error: Float[np.ndarray, " P"]
    covariance: Float[np.ndarray, "P P"]
    verdict: tuple[str, ...]
    next_point: float
    samples: int
    status: FitStatus
    message: str


def check(options: Options, noise: Noise) -> None:
    """Refuse what takes whole curves, or more than forces on the midline.

    Raises:
        InputError: naming the option or the noise.
    """
    level = level_of(options)
    if level.closed is None or level.relaxes:
        name = "relaxation" if level.relaxes else "skeleton"
        raise InputError(
            f"is {getattr(options, name)!r}, which is not fitted sample by sample",
            key=f"options.{name}", expected="an elastic line of joints", cure=CURE, joint=" ",
        )  # fmt: skip
    if noise.force is None:
        cure = "take the standard deviation of a record at rest"
        raise InputError("is None", key="noise.force", expected="a number, N", cure=cure, joint=" ")
    for name in ("joints", "force_share"):
        if value := getattr(noise, name):
            found = f"is {value}"
            raise InputError(found, key=f"noise.{name}", expected="None", cure=CURE, joint=" ")


def study_of(
    curves: list[Curve],
    geometry: Geometry,
    options: Options,
    parameters: Table | None,
    noise: Noise,
) -> Study:
    """Curves of a stream as a study: every sample weighs the same."""
    weighting = Weighting(balance="sample")
    return build_study(curves, geometry, options, parameters, noise=noise, weighting=weighting)


def blank_study(
    geometry: Geometry, options: Options, parameters: Table | None, noise: Noise
) -> Study:
    """A study of one curve of `BLOCK` samples that shows no zero: the model and its unknowns.

    Raises:
        InputError: an unknown of single presses, or none at all.
    """
    depth = np.linspace(0, 1, BLOCK)
    middle = 0.5 * float(geometry.length)
    curve = Curve(SPECIMEN, "1", middle, 0.0, depth, 100 * (noise.force or 1.0) * depth)
    study = study_of([curve], geometry, options, parameters, noise)
    if own := [p.name for p in study.free if p.scope == "trial"]:
        raise InputError(
            "belongs to single presses, and is not fitted sample by sample",
            key=f"parameters.{own[0]}", expected="scope 'specimen', or a fixed value", cure=CURE,
            joint=" ",
        )  # fmt: skip
    if not study.free:
        raise InputError("every parameter is fixed", key="parameters", expected="a free one")
    return study


def deepest(study: Study) -> float:
    """Displacement at most, mm: a tube is pressed no deeper than its radius."""
    # Without a skeleton the specimen need not be a tube.
    tube = study.model.options.coupling == "series"
    return float(study.model.geometry.radius) if tube else np.inf


def places_of(study: Study, places: ArrayLike | None, depth: float) -> Candidates:
    """Presses to choose the next one from.

    Args:
        places: mm; None: `PLACES`, from the first to the last ring.
        depth: of all of them, mm.

    Raises:
        InputError: a depth that is none, or a place off the tube.
    """
    if not (0 < depth < np.inf and depth <= deepest(study)):
        most = f"above 0 and at most the radius, {deepest(study):g} mm"
        raise InputError(f"is {depth}", key="depth", expected=most, joint=" ")
    geometry = study.model.geometry
    low, high = study.model.options.places(float(geometry.length))
    if places is None:
        rings = np.asarray(geometry.ring_positions)
        places = np.linspace(max(rings[0], low), min(rings[-1], high), PLACES)
    s = np.asarray(places, float)
    if s.ndim != 1 or not s.size or not ((s >= low) & (s <= high)).all():
        expected = f"positions in mm, (C,), from {low:g} to {high:g} mm"
        raise InputError(f"{places}", key="candidates", expected=expected)
    return Candidates(s, np.full(len(s), float(depth)))
