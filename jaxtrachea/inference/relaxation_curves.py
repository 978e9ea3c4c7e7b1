"""What a fit that relaxes says of times, frequencies and speeds, with 95 % bands.

Bands are those of the parameters, by the delta method (derivatives in forward mode), widened as the
intervals of the estimates are; infinite where the fit leaves open what the quantity depends on.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.delta_method import Estimate, standard_errors
from jaxtrachea.fitting.force_share import offsets
from jaxtrachea.fitting.forward_residual import answer
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.refusals import depths
from jaxtrachea.fitting.relaxing import span_of
from jaxtrachea.fitting.residual import of_trials, residual
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.whole_record import loading_speed
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.optimisation.programs import program
from jaxtrachea.relaxation.laws import Span
from jaxtrachea.relaxation.steps import Branches

#: Points a decade, decades beyond the records on either side, samples of a ramp, speeds a decade.
POINTS, BEYOND, SAMPLES, SPEEDS = 10, 1, 60, 4


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


def curves(
    result: FitResult, of: Whose, at: Float[np.ndarray, " N"], part: str
) -> tuple[Band, Band, Band]:
    """Force of a sudden press at times after it, s, and storage and loss at 1 / (2 pi time).

    All over what lasts; `part` as `branches_of`.
    """
    run = program(_curves, result.study.model, part, axes=None)
    found, errors = run(_estimate(result, of), jnp.asarray(at))
    first, second, third = (_band(result, of.lane, *v) for v in zip(found, errors, strict=True))
    return first, second, third


def _curves(model: FitModel, part: str, estimate: Estimate, time: Float[Array, " N"]):
    """See `curves`; all three, and their standard errors; (3, N)."""

    def at(free):
        gamma, tau = branches_of(model, free, estimate.value, part)
        x = tau[None] / time[:, None]
        relaxed = 1 + jnp.exp(-1 / x) @ gamma
        return jnp.stack([relaxed, 1 + 1 / (1 + 1 / (x * x)) @ gamma, 1 / (x + 1 / x) @ gamma])

    return _with_errors(at, estimate)


def _with_errors(function: Callable[[Array], Float[Array, "*n"]], estimate: Estimate):
    """A quantity of the free columns, and its standard errors."""
    slope = jnp.moveaxis(jax.jacfwd(function)(estimate.free), -1, 0)
    errors = standard_errors(slope, estimate.covariance, estimate.null_space)
    return function(estimate.free), errors


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


def _estimate(result: FitResult, of: Whose) -> Estimate:
    """What the fit knows of the free columns of a new press; 0 for those of a press."""
    study, u = result.study, result.uncertainty
    known, index = of.index >= 0, np.maximum(of.index, 0)
    value = np.array([0.0 if p.name in OF_THE_PRESS else p.value for p in study.parameters])
    both = known[:, None] & known
    return Estimate(
        free=jnp.asarray(np.where(known, result.theta[of.lane][index], 0.0)),
        value=jnp.asarray(value),
        covariance=jnp.asarray(np.where(both, u.covariance[of.lane][np.ix_(index, index)], 0.0)),
        null_space=jnp.asarray(np.where(known, u.null_space[of.lane][:, index], 0.0)),
        half_width=jnp.asarray(u.half_width[of.lane]),
    )


def _band(result: FitResult, lane: int, value: Any, error: Any) -> Band:
    """The 95 % band of a quantity with its standard error, widened as intervals are."""
    value, error = np.asarray(value), np.asarray(error)
    half = float(result.uncertainty.half_width[lane] * result.effective.growth[lane])
    with np.errstate(invalid="ignore"):
        wide = half * error
    return Band(value, value - wide, value + wide)


def rates(result: FitResult, of: Whose) -> Iterator[Rate]:
    """Force at the largest depth of each position against the speed of the ramp there."""
    study = result.study
    options, run = study.model.options, program(_ramp, study.model, axes=(None, None, 0))
    places: dict[float, list[tuple[int, Curve]]] = {}
    for t, curve in of.curves:
        if curve.phi_c == 0 and tuple(curve.direction) == (1.0, 0.0):
            places.setdefault(np.nan if curve.s_c is None else curve.s_c, []).append((t, curve))
    estimate = _estimate(result, of)
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
        found = run(estimate, jnp.asarray([at, depth]), jnp.asarray(speed))
        yield Rate(s, depth, speed, _band(result, of.lane, *found), measured)


def _ramp(model: FitModel, estimate: Estimate, where, speed):
    """Force at the end of a ramp of one speed, and its standard error."""
    displacement = where[1] * jnp.linspace(0, 1, SAMPLES, dtype=speed.dtype)
    tube = jax.tree.map(lambda v: jnp.asarray(v, speed.dtype), model.geometry)
    motion = Motion(where[0], displacement, time=displacement / speed)

    def at(free):
        return answer(model, free, estimate.value, motion, tube).force[-1]

    return _with_errors(at, estimate)


class Loop(NamedTuple):
    """Work that one record takes, N mm.

    Attributes:
        specimen: name.
        trial: name.
        s: mm; NaN without one.
        speed: of its loading, mm/s; 0: not known.
        measured: integral of the measured force over the way.
        model: of that of the model.
        low: end of its 95 % band, of the parameters.
        high: likewise.
    """

    specimen: str
    trial: str
    s: float
    speed: float
    measured: float
    model: float
    low: float
    high: float


def loops(result: FitResult, of: Whose) -> Iterator[Loop]:
    """Of every record: what its loop encloses, and of one without unloading its work."""
    study, u = result.study, result.uncertainty
    way = np.zeros(study.lanes.force.shape[1:])  # weights of the trapezoidal rule
    for t, c in of.curves:
        step = np.diff(c.displacement) / 2
        way[t, : len(c.force)] = np.append(step, 0) + np.insert(step, 0, 0)
    lane = jax.tree.map(lambda v: jnp.asarray(v[of.lane]), study.lanes)
    estimate = Estimate(
        jnp.asarray(result.theta[of.lane]), lane.value, jnp.asarray(u.covariance[of.lane]),
        jnp.asarray(u.null_space[of.lane]), jnp.asarray(u.half_width[of.lane]),
    )  # fmt: skip
    work, error = program(_work, study.model, axes=None)(estimate, lane, jnp.asarray(way))
    band = _band(result, of.lane, work, error)
    for t, c in of.curves:
        measured = float(way[t, : len(c.force)] @ c.force)
        s = np.nan if c.s_c is None else c.s_c
        ends = (float(v[t]) for v in band)
        yield Loop(c.specimen, c.trial, s, loading_speed(c), measured, *ends)


@full_precision
def _work(model: FitModel, estimate: Estimate, lane: Lane, way: Float[Array, "T N"]):
    """Work of every trial of a lane, N mm, and its standard error; (T,)."""
    found, samples = residual(model, estimate.free, lane), lane.force.shape[1]
    weight = jnp.where(
        lane.precision > 0, way / jnp.where(lane.precision > 0, lane.precision, 1), 0
    )
    off = jnp.sum(weight * found.value[:, :samples], axis=1)
    by_column = jnp.einsum("tn,tjn->tj", weight, found.jacobian[:, :, :samples])
    unit = jnp.eye(estimate.free.shape[0], dtype=way.dtype)
    reads = jax.vmap(lambda v: of_trials(model, v, lane))(unit)  # (P, T, Jf)
    slope = jnp.einsum("tj,ptj->pt", by_column, reads)
    work = jnp.sum(way * lane.force, axis=1) + off
    return work, standard_errors(slope, estimate.covariance, estimate.null_space)
