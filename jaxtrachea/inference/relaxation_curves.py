"""What a fit that relaxes says of times, frequencies and speeds, with 95 % bands.

Bands are those of the parameters, by the delta method (derivatives in forward mode), widened as the
intervals of the estimates are; infinite where the fit leaves open what the quantity depends on.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.fitting.force_share import offsets
from jaxtrachea.fitting.forward_residual import answer
from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.refusals import depths
from jaxtrachea.fitting.relaxing import span_of
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.whole_record import loading_speed
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.optimisation.programs import program
from jaxtrachea.relaxation.laws import Span
from jaxtrachea.relaxation.steps import Branches

#: Points a decade, decades beyond the records on either side, samples of a ramp, speeds a decade.
POINTS, BEYOND, SAMPLES, SPEEDS = 10, 1, 60, 4
#: Slope along a direction that the fit leaves open, over its terms, from which it counts.
_ACTS = 1e-6


class Band(NamedTuple):
    """A quantity with the ends of its 95 % band; (N,) each."""

    value: Float[np.ndarray, " N"]
    low: Float[np.ndarray, " N"]
    high: Float[np.ndarray, " N"]


class Whose(NamedTuple):
    """A specimen of a lane.

    Attributes:
        lane: of the fit.
        specimen: name.
        curves: of it, with their places in the lane.
        span: of their records, s.
        index: unknown that each free column of a new press of it reads; -1: none; (F,).
    """

    lane: int
    specimen: str
    curves: tuple[tuple[int, Curve], ...]
    span: Span
    index: np.ndarray


class Rate(NamedTuple):
    """Force at a depth against speed, of one position.

    Attributes:
        s: mm; NaN without one.
        depth: mm from first touch.
        speed: mm/s; (N,).
        force: N.
        measured: speed and force of each record there, without its offset; (M, 2).
    """

    s: float
    depth: float
    speed: Float[np.ndarray, " N"]
    force: Band
    measured: Float[np.ndarray, "M 2"]


def specimens(result: FitResult) -> Iterator[Whose]:
    """Those of all lanes with an estimate."""
    study = result.study
    for lane in np.flatnonzero(result.succeeded).tolist():
        for name in dict.fromkeys(c.specimen for c in study.curves[lane]):
            own = [(t, c) for t, c in enumerate(study.curves[lane]) if c.specimen == name]
            index = np.array(study.lanes.index[lane, own[0][0]])[np.array(study.free_columns, int)]
            index = [
                -1 if p.name in OF_THE_PRESS else int(i)
                for p, i in zip(study.free, index, strict=True)
            ]
            span = span_of([c for _, c in own])
            yield Whose(lane, name, tuple(own), span, np.array(index, int))


def times(span: Span) -> Float[np.ndarray, " N"]:
    """Evenly in the logarithm, from within the shortest step to beyond the longest record, s."""
    low, high = np.log10(span.shortest) - BEYOND, np.log10(span.longest) + BEYOND
    return np.logspace(low, high, int(np.ceil((high - low) * POINTS)) + 1)


def relaxation(result: FitResult, of: Whose, at: np.ndarray, part: str) -> Band:
    """Force of a sudden press over what lasts, at times after it, s; `part` as `branches_of`."""

    def function(free, value):
        gamma, tau = branches_of(result.study.model, free, value, part)
        return 1 + jnp.exp(-jnp.asarray(at)[:, None] / tau[None]) @ gamma

    return _band(result, of, function)


def moduli(result: FitResult, of: Whose, at: np.ndarray, part: str) -> tuple[Band, Band]:
    """Storage and loss over what lasts, at frequencies, Hz."""

    def function(storage: bool):
        def of_free(free, value):
            gamma, tau = branches_of(result.study.model, free, value, part)
            x = 2 * jnp.pi * jnp.asarray(at)[:, None] * tau[None]
            share = 1 / (1 + 1 / (x * x)) if storage else 1 / (x + 1 / x)
            return (1.0 if storage else 0.0) + share @ gamma

        return _band(result, of, of_free)

    return function(True), function(False)


def branches_of(model: FitModel, free, value, part: str) -> Branches:
    """Branches of the whole organ or the local law ("local"), or of the skeleton."""
    found = model.level.relaxation(values_of(model, free, value))
    assert found is not None
    branches = found.local if part != "skeleton" else found.skeleton
    assert branches is not None
    return branches


def parts_of(result: FitResult) -> tuple[str, ...]:
    """What relaxes apart."""
    apart = result.study.model.options.relaxation == "parts"
    return ("local", "skeleton") if apart else ("all",)


def _estimate(result: FitResult, of: Whose):
    """Free columns of a new press, with all parameters in their units; 0 for those of a press."""
    study = result.study
    known = of.index >= 0
    free = np.where(known, result.theta[of.lane][np.maximum(of.index, 0)], 0.0)
    value = np.array([0.0 if p.name in OF_THE_PRESS else p.value for p in study.parameters])
    return jnp.asarray(free), jnp.asarray(value)


def _band(result: FitResult, of: Whose, function: Callable[..., Float[Array, " N"]]) -> Band:
    """A quantity of the free columns with its band."""
    free, value = _estimate(result, of)
    found = np.asarray(function(free, value))
    slope = np.zeros((len(free), len(found)))
    if len(free):
        slope = np.asarray(jax.jacfwd(lambda free: function(free, value))(free)).T
    return _with_slope(result, of, found, slope)


def _with_slope(result: FitResult, of: Whose, found: np.ndarray, slope: np.ndarray) -> Band:
    """The band of a quantity with its derivative by the free columns, (F, N)."""
    known, u = of.index >= 0, result.uncertainty
    index = of.index[known]
    slope = slope[known]
    variance = np.einsum("fn,fg,gn->n", slope, u.covariance[of.lane][np.ix_(index, index)], slope)
    null = u.null_space[of.lane][:, index]
    acts = np.abs(null @ slope) > _ACTS * (np.abs(null) @ np.abs(slope))
    half = float(u.half_width[of.lane] * result.effective.growth[of.lane])
    with np.errstate(invalid="ignore"):
        wide = half * np.sqrt(np.maximum(variance, 0))
    wide = np.where(acts.any(axis=0), np.inf, wide)
    return Band(found, found - wide, found + wide)


def rates(result: FitResult, of: Whose) -> Iterator[Rate]:
    """Force at the largest depth of each position against the speed of the ramp there."""
    study = result.study
    options, run = study.model.options, program(_ramp, study.model, axes=(None, None, None, 0))
    places: dict[float, list[tuple[int, Curve]]] = {}
    for t, curve in of.curves:
        if curve.phi_c == 0 and tuple(curve.direction) == (1.0, 0.0):
            places.setdefault(np.nan if curve.s_c is None else curve.s_c, []).append((t, curve))
    free, value = _estimate(result, of)
    zero = offsets(study, result.theta)[of.lane]
    for s, own in places.items():
        points, deepest = [], []
        for t, curve in own:
            rise = curve.rising
            depth = depths(rise.displacement, float(result.first_touch[of.lane, t]), options)
            deepest.append(float(depth.max()))
            points.append((loading_speed(curve), float(rise.force[-1] - zero[t])))
        depth, measured = max(deepest), np.array(points)
        alike = np.array(deepest) > 0.98 * depth
        measured = measured[alike & (measured[:, 0] > 0)]
        if not len(measured):
            continue
        low, high = np.log10(measured[:, 0].min()) - 1, np.log10(measured[:, 0].max()) + 1
        speed = np.logspace(low, high, int(np.ceil((high - low) * SPEEDS)) + 1)
        at = float(study.model.geometry.length) / 2 if np.isnan(s) else s
        found, slope = run(free, value, jnp.asarray([at, depth]), jnp.asarray(speed))
        band = _with_slope(result, of, np.asarray(found), np.asarray(slope).T)
        yield Rate(s, depth, speed, band, measured)


def _ramp(model: FitModel, free, value, where, speed):
    """Force at the end of a ramp of one speed, and its derivative by the free columns."""
    displacement = where[1] * jnp.linspace(0, 1, SAMPLES, dtype=free.dtype)
    tube = jax.tree.map(lambda v: jnp.asarray(v, free.dtype), model.geometry)
    motion = Motion(where[0], displacement, time=displacement / speed)

    def at(free):
        return answer(model, free, value, motion, tube).force[-1]

    return at(free), jax.jacfwd(at)(free)


class Loop(NamedTuple):
    """Work that one record takes, N mm.

    Attributes:
        specimen: name.
        trial: name.
        s: mm; NaN without one.
        measured: integral of the measured force over the way.
        model: of that of the model.
    """

    specimen: str
    trial: str
    s: float
    measured: float
    model: float


def loops(result: FitResult, of: Whose) -> Iterator[Loop]:
    """Of every record: what its loop encloses, and of one without unloading its work."""
    for t, c in of.curves:
        model = c.force + result.residuals.force[of.lane, t, : len(c.force)]
        way = np.diff(c.displacement)
        work = (float(way @ (force[1:] + force[:-1])) / 2 for force in (c.force, model))
        yield Loop(c.specimen, c.trial, np.nan if c.s_c is None else c.s_c, *work)
