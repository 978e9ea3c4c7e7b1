"""Curves divided into lanes, each a set of padded arrays.

Lanes have equal shapes (curves of unequal length are padded with weight zero), so that one compiled
program fits any number of them at once.
"""

import dataclasses
import functools
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from jaxtrachea._arguments import check_record
from jaxtrachea._errors import InputError
from jaxtrachea.fitting.lane import Lane, Seen, markers, with_observed
from jaxtrachea.fitting.model import Loss
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.measurements.observed import FITTED, Quantity
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.level import Level
from jaxtrachea.trachea.geometry import Geometry

Balance = Literal["curve", "sample"]
#: An unknown: its parameter, and the specimen and the trial that it belongs to, "" for all.
Unknown = tuple[Parameter, str, str]
#: Names of the `Parameter.auto` that a curve takes, by specimen and trial.
Taken = Mapping[tuple[str, str], Collection[str]]


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations; None: estimated from the residuals.

    Attributes:
        force: N; a curve's own per-sample sigma comes before it.
        joints: mm.
        force_share: of the force, which sigma has beside it (root of the sum of the squares): what
            a model misses in a deep press grows with the force. A number, "estimate" (from the
            residuals), or None: estimated where curves go deeper than a tenth of the radius, sigma
            is estimated and there is a skeleton, else none.
        joints_share: of the tool's displacement from first touch, which `joints` has beside it
            (root of the sum of the squares): what a model errs in markers grows with the press.
        force_by_curve: weigh the forces of each curve by its own noise, found from neighbouring
            samples (`trials.uneven_noise.noise_to_weigh`); how large it is, is estimated.
    """

    force: float | None = None
    joints: float | None = None
    joints_share: float = 0.0
    force_share: float | Literal["estimate"] | None = None
    force_by_curve: bool = False

    def __post_init__(self):
        """Refuse words and numbers that mean nothing (`ValueError`)."""
        check_record(self)
        if isinstance(self.force_share, float) and not 0 <= self.force_share < 1:
            found = f"is {self.force_share:g}"
            expected = 'a share of 0 to 1, as 0.01 or "1 %", "estimate", or None'
            raise InputError(found, key="force_share", expected=expected, joint=" ")
        for name in ("force", "joints"):
            if (value := getattr(self, name)) is not None and value <= 0:
                expected = "a standard deviation of more than 0, or None"
                raise InputError(f"is {value:g}", key=name, expected=expected, joint=" ")
        if self.joints_share < 0:
            found = f"is {self.joints_share:g}"
            raise InputError(found, key="joints_share", expected="0 or more", joint=" ")
        if self.joints_share > 0 and self.joints is None:
            raise InputError(
                "needs joints, the standard deviation of markers at no displacement",
                key="joints_share", cure="give joints as a length", joint=" ",
            )  # fmt: skip

        if self.force_by_curve and self.force is not None:
            expected = "None, with force_by_curve"
            found = f"is {self.force:g}"
            raise InputError(found, key="force", expected=expected, joint=" ")

    def joints_precision(self, displacement: np.ndarray) -> np.ndarray:
        """1 / sigma of markers at each depth of the tool, 1/mm; 1 if it is estimated."""
        if self.joints is None:
            return np.ones_like(displacement)
        return 1 / np.hypot(self.joints, self.joints_share * displacement)


@dataclasses.dataclass(frozen=True)
class Weighting:
    """How much each residual counts, apart from its noise.

    Attributes:
        balance: `curve` (every curve weighs the same, however long) or `sample`.
        loss: see `FitModel`.
        loss_scale: see `FitModel`.
        pressed_ends: whether ends of rings under the tool count, within `tool_radius` along the
            tube; a tool that presses on a ring moves it in more modes than `sections` has: its
            ends err by 5 to 15 % of D on the virtual specimen.
    """

    balance: Balance = "curve"
    loss: Loss = "linear"
    loss_scale: float = 1.345
    pressed_ends: bool = True

    def __post_init__(self):
        """Refuse words and numbers that mean nothing (`ValueError`)."""
        check_record(self)
        if self.loss_scale <= 0:
            raise ValueError(
                f"loss_scale is {self.loss_scale}; expected a finite number, more than 0"
            )


def group(
    curves: Sequence[Curve], parameters: Sequence[Parameter], *, joint: bool = False
) -> list[list[Curve]]:
    """Divide curves into lanes by the widest scope among the free parameters.

    By specimens if joint, or if none is free.
    """
    scopes = {"specimen"} if joint else {p.scope for p in parameters if not p.fixed}
    scopes = scopes or {"specimen"}
    if "shared" in scopes:
        return [list(curves)]
    lanes: dict[tuple[str, str], list[Curve]] = {}
    for curve in curves:
        key = (curve.specimen, "" if "specimen" in scopes else curve.trial)
        lanes.setdefault(key, []).append(curve)
    return list(lanes.values())


def unknowns_of(
    lane: Sequence[Curve], parameters: Sequence[Parameter], taken: Taken | None = None
) -> list[Unknown]:
    """Distinct unknowns of a lane, in parameter order.

    Args:
        lane: its curves.
        taken: what each curve takes of the free parameters that are `auto`; None: all.
    """
    names: dict[Unknown, None] = {}
    for p in parameters:
        if not p.fixed:
            for curve in lane:
                if takes(p, curve, taken):
                    names.setdefault(_key(p, curve))
    return list(names)


def takes(p: Parameter, curve: Curve, taken: Taken | None) -> bool:
    """Whether a curve has an unknown for a free parameter."""
    return taken is None or not p.auto or p.name in taken[curve.specimen, curve.trial]


def _key(p: Parameter, curve: Curve) -> Unknown:
    specimen = "" if p.scope == "shared" else curve.specimen
    return p, specimen, curve.trial if p.scope == "trial" else ""


@dataclasses.dataclass(frozen=True)
class _Layout:
    """What all lanes of a study have in common: their sizes, and how curves become arrays.

    Attributes:
        parameters: the table.
        geometry: the tube.
        noise: known standard deviations.
        reach: markers closer to the contact do not count, mm; below 0: all count.
        pressed_ends: whether ends of rings within reach along the tube count.
        trials: of a lane, at most.
        samples: of a curve, at most.
        unknowns: of a lane, at most.
        level: of the model.
        curves: all of them.
        lanes: how many.
    """

    parameters: Sequence[Parameter]
    geometry: Geometry
    noise: Noise
    reach: float
    pressed_ends: bool
    trials: int
    samples: int
    unknowns: int
    level: Level
    curves: Sequence[Curve]
    lanes: int


def mean_lengths(groups: Sequence[Sequence[Curve]], *, joint: bool) -> Float[np.ndarray, " lanes"]:
    """Samples of a curve in the mean of each lane; of lanes that are fitted jointly, of all."""
    lengths = [[len(c.force) for c in curves] for curves in groups]
    if joint:
        return np.full(len(groups), np.mean(np.concatenate(lengths)))
    return np.array([np.mean(lane) for lane in lengths])


def curve_weights(
    groups: Sequence[Sequence[Curve]], trials: int, *, joint: bool
) -> Float[np.ndarray, "lanes trials"]:
    """Weights of the residuals of curves such that every curve of a lane weighs the same."""
    weights, means = np.ones((len(groups), trials)), mean_lengths(groups, joint=joint)
    for row, curves, mean in zip(weights, groups, means, strict=True):
        row[: len(curves)] = np.sqrt(mean / [len(c.force) for c in curves])
    return weights


def weighed_by_depth(lanes: Lane, noise: Noise, depth: Float[np.ndarray, "lanes T N"]) -> Lane:
    """The lanes with markers weighed by depths from first touch, mm, not by the records' zeros."""
    recorded = noise.joints_precision(np.asarray(lanes.displacement))
    ratio = noise.joints_precision(depth) / recorded
    changed = {
        kind.name: kind.precision * _spread(ratio, kind.precision.ndim) for kind in markers(lanes)
    }
    return with_observed(lanes, precision=changed)


def _spread(values: np.ndarray, ndim: int) -> np.ndarray:
    """The values with so many axes in all, for all that a sample has."""
    return values.reshape(*values.shape, *[1] * (ndim - values.ndim))


def lanes_of(
    groups: Sequence[Sequence[Curve]],
    unknowns: Sequence[Sequence[Unknown]],
    parameters: Sequence[Parameter],
    geometry: Geometry,
    *,
    noise: Noise,
    weighting: Weighting,
    tool_radius: float | None,
    level: Level,
) -> Lane:
    """The lanes of a study, stacked along a leading axis, without their samples (`recorded`).

    Args:
        groups: curves of each lane.
        unknowns: of each lane.
        noise: known standard deviations.
        weighting: whether ends of pressed rings count; `curve_weights` are put in afterwards.
        tool_radius: see `build.build_study`.
        level: of the model: what it observes, and whether it reads angles and the time.
    """
    every = [c for curves in groups for c in curves]
    lengths = [len(c.force) for c in every]
    layout = _Layout(
        parameters=parameters,
        geometry=geometry,
        noise=noise,
        reach=-1.0 if tool_radius is None else tool_radius,
        pressed_ends=weighting.pressed_ends,
        trials=max(map(len, groups)),
        samples=max(lengths),
        unknowns=max(map(len, unknowns)),
        level=level,
        curves=every,
        lanes=len(groups),
    )
    whole = _blank(layout)
    whole["precision"] = _precision(layout, groups)
    for k, (curves, names) in enumerate(zip(groups, unknowns, strict=True)):
        _fill({n: v if v is None else v[k] for n, v in whole.items()}, layout, curves, names)
    return Lane(others=_others(layout, groups, whole["precision"]), **whole)


def recorded(groups: Sequence[Sequence[Curve]], lanes: Lane) -> Lane:
    """Lanes with displacement, mm, and force, N, of their curves."""
    displacement, force = np.zeros(lanes.precision.shape), np.zeros(lanes.precision.shape)
    for k, curves in enumerate(groups):
        for t, curve in enumerate(curves):
            at = k, t, slice(len(curve.force))
            displacement[at], force[at] = curve.displacement, curve.force
    return lanes._replace(displacement=displacement, force=force)


def _blank(layout: _Layout) -> dict[str, Any]:
    """Padded float64 arrays of all lanes, without their curves."""
    L, T, N, P = layout.lanes, layout.trials, layout.samples, layout.unknowns
    parameters = layout.parameters
    out: dict[str, Any] = {
        "s_c": np.full((L, T), float(layout.geometry.length) / 2),
        "displacement": np.zeros((L, T, N)),
        "force": np.zeros((L, T, N)),
        "balance": np.ones((L, T)),
        "blend": None,
        "value": np.tile(np.array([p.value for p in parameters], np.float64), (L, T, 1)),
        "index": np.full((L, T, len(parameters)), -1, np.int32),
        "lower": np.zeros((L, P)),
        "upper": np.zeros((L, P)),
        "active": np.zeros((L, P)),
    }
    if layout.level.off_midline and any(off_midline(c) for c in layout.curves):
        out |= {"phi_c": np.zeros((L, T)), "direction": np.tile([1.0, 0.0], (L, T, 1))}
    if layout.level.relaxes:
        out |= {"time": np.zeros((L, T, N)), "rising": np.zeros((L, T, N))}
    return out


def _precision(layout: _Layout, groups: Sequence[Sequence[Curve]]) -> np.ndarray:
    """Of forces, 1 / N, or 1 where they have no sigma; 0 where there is no sample."""
    room, force = (layout.lanes, layout.trials, layout.samples), layout.noise.force
    usual = 1.0 if force is None else 1 / force
    full = all(len(lane) == room[1] for lane in groups)
    if full and all(len(c.force) == room[2] and c.sigma is None for c in layout.curves):
        return np.broadcast_to(usual, room)  # one number for all takes no room
    out = np.zeros(room)
    for k, curves in enumerate(groups):
        for t, curve in enumerate(curves):
            weight = usual if curve.sigma is None else 1 / np.asarray(curve.sigma)
            out[k, t, : len(curve.force)] = weight
    return out


def _fill(
    lane: dict[str, Any], layout: _Layout, curves: Sequence[Curve], unknowns: Sequence[Unknown]
) -> None:
    """Put the curves and unknowns of one lane into its arrays."""
    parameters = layout.parameters
    place = {key: i for i, key in enumerate(unknowns)}
    for i, (p, _, _) in enumerate(unknowns):
        lane["lower"][i], lane["upper"][i] = p.to_scaled(p.lower), p.to_scaled(p.upper)
        lane["active"][i] = 1
    for t, curve in enumerate(curves):
        n = len(curve.force)
        if curve.s_c is not None:
            lane["s_c"][t] = curve.s_c
        if layout.level.relaxes and curve.time is not None:
            lane["time"][t] = curve.time[-1] - curve.time[0]
            lane["time"][t, :n] = curve.time - curve.time[0]
            lane["rising"][t, slice(*(curve.rise or (0, n)))] = 1
        for j, p in enumerate(parameters):
            if not p.fixed:
                lane["index"][t, j] = place.get(_key(p, curve), -1)
        if lane.get("phi_c") is not None:
            lane["phi_c"][t], lane["direction"][t] = curve.phi_c, curve.direction


def _others(
    layout: _Layout, groups: Sequence[Sequence[Curve]], precision: np.ndarray
) -> dict[str, Seen]:
    """What curves have beside the force, by field of `Response`; `precision`: of the forces."""
    room, rings = (layout.lanes, layout.trials, layout.samples), layout.geometry.rings
    level, x, out = layout.level, np.asarray(layout.geometry.ring_positions), {}
    for name, parts in FITTED.items():
        if name in level.observes and any(_given(c, q) for c in layout.curves for q in parts):
            out[name] = Seen(*(np.zeros((*room, *sample_shape(name, rings))) for _ in Seen._fields))
    if any(FITTED[name][0].rings for name in out):  # where there are ends alone, without markers
        out.setdefault("joints", Seen(*(np.zeros((*room, rings)) for _ in Seen._fields)))
    for k, t, curve in ((k, t, c) for k, lane in enumerate(groups) for t, c in enumerate(lane)):
        at = k, t, slice(len(curve.force))
        for name, seen in out.items():
            parts = FITTED[name]
            # By symmetry the model knows nothing but 0 of a normal press on the midline.
            if parts[0].odd and not off_midline(curve):
                continue
            values = measured(curve, name, rings)
            known, weight = np.isfinite(values), precision[at]
            if parts[0].rings is not None:
                weight = layout.noise.joints_precision(curve.displacement)
                far = [_away(x, curve, layout, q) for q in parts]
                far = np.stack(far, axis=1) if len(parts) > 1 else far[0]
                known &= _spread(far, values.ndim - 1)
            seen.data[at] = np.where(known, values, 0)
            seen.precision[at] = np.where(known, _spread(weight, values.ndim), 0)
    return out


def _given(curve: Curve, q: Quantity) -> bool:
    """Whether a curve has a quantity."""
    there = getattr(curve, q.name) is not None
    return there and (q.rings is None or getattr(curve, q.rings) is not None)


@functools.cache
def sample_shape(name: str, rings: int) -> tuple[int, ...]:
    """Shape of a sample of a field of `Response`: rings, quantities of several, components."""
    first, *more = FITTED[name]
    shape = first.shape(0, rings)[1:]
    return (*shape[:1], 1 + len(more), *shape[1:]) if more else shape


def measured(curve: Curve, name: str, rings: int) -> np.ndarray:
    """What a curve has of a field of `Response`, NaN where nothing; (N, sample)."""
    out = np.full((len(curve.force), *sample_shape(name, rings)), np.nan)
    for k, q in enumerate(FITTED[name]):
        if _given(curve, q):
            part = out[:, :, k] if len(FITTED[name]) > 1 else out
            at = ... if q.rings is None else np.s_[:, getattr(curve, q.rings)]
            part[at] = getattr(curve, q.name)
    return out


def off_midline(curve: Curve) -> bool:
    """Whether a press is off the midline, or not along the normal."""
    return curve.phi_c != 0 or tuple(curve.direction) != (1.0, 0.0)


def _away(x: np.ndarray, curve: Curve, layout: _Layout, q: Quantity) -> np.ndarray:
    """Which rings at `x` lie beyond the tool, their ends also along the circumference; (rings,)."""
    tube, around = layout.geometry, 0.0
    if curve.s_c is None:
        return np.ones(len(x), bool)
    if q.end and layout.pressed_ends:
        side = {"U": -1.0, "V": 1.0}[q.end]
        around = abs(side * float(tube.half_angle) - curve.phi_c) * float(tube.radius)
    return np.hypot(x - curve.s_c, around) > layout.reach
