"""From curves to a study: which model can press them, which unknowns they have, what is weighed."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.curve_noise import weighed_by_curve
from jaxtrachea.fitting.lane import Lane, markers
from jaxtrachea.fitting.lanes import (
    Noise,
    Taken,
    Weighting,
    curve_weights,
    group,
    lanes_of,
    recorded,
    unknowns_of,
    weighed_by_depth,
)
from jaxtrachea.fitting.model import Common, FitModel, columns_of, numbers_of
from jaxtrachea.fitting.onset import (
    blends,
    natural_steps,
    onset_is_sought,
    touches,
    within_reach,
)
from jaxtrachea.fitting.parameters import (
    DEFAULTS,
    SKELETON,
    Parameter,
    defaults_of,
    held,
    in_model,
)
from jaxtrachea.fitting.refusals import Size, as_read, check_noise, depths, refusal
from jaxtrachea.fitting.relaxing import by_records, span_of, with_span
from jaxtrachea.fitting.study import Recipe, Study, first_touch_of
from jaxtrachea.fitting.zeros import resolved, starts_of, without_flat_line
from jaxtrachea.measurements.read import BadCurve, Curve, Measurements
from jaxtrachea.measurements.record_zeros import Zeros
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.sizes import TOOLS, check_length, check_tube

#: Depth over the radius of the tube beyond which the noise of forces is looked for a share.
DEEP = 0.1
#: The table of parameters, or what differs from the defaults of the model, by name.
Table = Sequence[Parameter] | Mapping[str, Mapping[str, object]]


def build_study(
    curves: Measurements | Sequence[Curve],
    geometry: Geometry,
    options: Options = Options(),
    parameters: Table | None = None,
    *,
    noise: Noise = Noise(),
    weighting: Weighting = Weighting(),
    tool_radius: float | None = None,
    joint: bool = False,
) -> Study:
    """Put curves, model and parameters together.

    Args:
        curves: at least one; `s_c` set wherever the skeleton enters. Of `Measurements` the usable
            ones; a warning names what could not be used. Side forces, sideward markers and ring
            ends are read by the skeleton `sections` alone; else they are left out of the study,
            and a warning says so.
        geometry: the tube at rest (`Geometry.create` takes plain numbers; kept as float64).
        options: what the model includes.
        parameters: the table, in the order of `parameters.in_model`; or changes to the defaults of
            the model, `{"k_1": {"value": 2.0}, "EI_L": {"fixed": True, "value": 1.9}}`, where what
            is named is fitted unless it says `fixed`; None: the defaults. Of another wall than
            `parameters.defaults_of` takes, the table by `default_parameters`. Rows that are `auto`
            (onset and force offset by default, with them a line of the force before first touch,
            `force_slope`) are fitted to those curves whose records show them. `{"force_slope": {}}`
            fits that line to every curve, `{"force_slope": {"fixed": True, "value": 0}}` to none.
        noise: known standard deviations; `force` is needed where some curves have a sigma of their
            own and others have none.
        weighting: balance between curves, the loss, and whether ends of pressed rings count.
        tool_radius: mm; markers closer to the contact are held by the tool and left out. None: all
            are used.
        joint: one lane per specimen even if parameters are shared; without effect if none is, or
            if there is but one specimen.

    Raises:
        SizeError: a length of tube, tool or options that is most likely in another unit.
        ValueError: a `tool_radius` that is no length, none where `weighting` leaves pressed ends
            out, no curve, one that cannot be pressed (`refusals`), with specimen and trial named;
            a parameter that the model does not have; a `force_slope` that is free, and a curve
            without 5 samples before first touch.
    """
    if tool_radius is not None and not 0 <= tool_radius < np.inf:
        raise ValueError(f"tool_radius is {tool_radius}; expected a length in mm, 0 or more")
    if tool_radius:
        check_length("tool_radius", tool_radius, TOOLS)
    if not weighting.pressed_ends and tool_radius is None:
        raise ValueError("pressed_ends=False needs tool_radius: which rings are under the tool")
    check_tube(geometry, options.onset_width, options.transition)
    curves, table = _admitted(curves, geometry, options, parameters)
    check_noise(curves, noise.force)
    recipe = Recipe(geometry, options, table, noise, weighting, tool_radius, joint, {})
    return _built(curves, recipe)


def with_zeros(study: Study, asked: Taken, lanes: Int[np.ndarray, " n"] | None = None) -> Study:
    """A study built again, in which curves take further zeros.

    Args:
        study: one with a recipe.
        asked: names of `auto` parameters that curves take on top of those which their records show
            and which the study has already.
        lanes: of these alone; None: of all.
    """
    recipe = study.recipe
    assert recipe is not None
    every = {k: {*recipe.asked.get(k, ()), *asked.get(k, ())} for k in {*recipe.asked, *asked}}
    if lanes is not None:
        of = np.repeat(np.arange(len(study.curves)), [len(lane) for lane in study.curves])
        rows = np.concatenate([np.flatnonzero(of == k) for k in lanes])
        zeros = recipe.zeros and Zeros(*(v[rows] for v in recipe.zeros))
        recipe = dataclasses.replace(recipe, asked=every, zeros=zeros)
        return _built([c for k in lanes for c in study.curves[k]], recipe)
    curves = [c for lane in study.curves for c in lane]
    again = _built(curves, dataclasses.replace(recipe, asked=every), study)
    return with_recipe(again, holdout_groups=study.holdout_groups)


def without_zeros(study: Study) -> Study:
    """A study of lanes that take no zero which is `auto`, by the model of one in which none does.

    Args:
        study: lanes of one in which others take some.
    """
    free = [
        dataclasses.replace(p, fixed=True, step=DEFAULTS[p.name].step)
        if p.auto and not p.fixed
        else p
        for p in study.parameters
    ]
    parameters = without_flat_line(free)
    columns = [j for j, p in enumerate(free) if p in parameters]
    P = max(map(len, study.unknowns))
    lanes = study.lanes._replace(
        value=study.lanes.value[..., columns],
        index=study.lanes.index[..., columns],
        **{name: getattr(study.lanes, name)[:, :P] for name in ("lower", "upper", "active")},
    )
    seen = study.change_points
    if not onset_is_sought(parameters, study.model.options):
        lanes, seen = lanes._replace(blend=None), None
    model = dataclasses.replace(
        study.model,
        columns=columns_of(parameters),
        common=_common([list(lane) for lane in study.unknowns], parameters, {}),
    )
    return dataclasses.replace(
        study, model=model, parameters=parameters, lanes=lanes, change_points=seen,
        record_zeros=None,
    )  # fmt: skip


def without_markers(study: Study) -> Study:
    """A study of lanes that have no markers, without the arrays of them.

    Args:
        study: lanes of one in which others have some.
    """
    of_rings = {kind.name for kind in markers(study.lanes)}
    others = {name: v for name, v in study.lanes.others.items() if name not in of_rings}
    return dataclasses.replace(study, lanes=study.lanes._replace(others=others))


def with_recipe(study: Study, **changes: Any) -> Study:
    """The study with changes that its lanes do not depend on, and its recipe."""
    out = dataclasses.replace(study, **changes)
    object.__setattr__(out, "recipe", study.recipe)
    return out


def _built(curves: Sequence[Curve], recipe: Recipe, before: Study | None = None) -> Study:
    """The study of curves that the model can press; `before`: with fewer zeros."""
    geometry, options, noise, weighting = (
        recipe.geometry, recipe.options, recipe.noise, recipe.weighting,
    )  # fmt: skip
    own = resolved(
        recipe.parameters, curves, options, noise.force, recipe.asked, recipe.zeros
    )  # fmt: skip
    parameters = natural_steps(own.parameters, curves, own.recorded, own.taken)
    if level_of(options).relaxes:
        span = span_of(curves)
        parameters = by_records(parameters, options, span)
        options = with_span(options, span)
    joint = recipe.joint and any(p.scope == "shared" for p in parameters if not p.fixed)
    joint = joint and len({c.specimen for c in curves}) > 1
    groups = group(curves, parameters, joint=joint)
    unknowns = [unknowns_of(lane, parameters, own.taken) for lane in groups]
    lanes = lanes_of(
        groups, unknowns, parameters, geometry,
        noise=noise, weighting=weighting, tool_radius=recipe.tool_radius,
        level=level_of(options),
    )  # fmt: skip
    if before is None:
        lanes = recorded(groups, lanes)
    else:  # of the same curves, in memory once
        lanes = lanes._replace(displacement=before.lanes.displacement, force=before.lanes.force)
    if weighting.balance == "curve":
        weights = curve_weights(groups, lanes.s_c.shape[1], joint=joint)
        lanes = lanes._replace(balance=weights)
    if noise.force_by_curve:
        lanes = weighed_by_curve(lanes, groups, joint=joint)
    found = starts_of(own, groups, curves, lanes.s_c.shape[1])
    lanes, change_points = _from_touch(lanes, groups, parameters, options, noise, found)
    known = noise.force is not None or all(c.sigma is not None for c in curves)
    model = FitModel(
        tube=numbers_of(geometry), options=options, columns=columns_of(parameters),
        loss=weighting.loss, loss_scale=float(weighting.loss_scale),
        common=_common(unknowns, parameters, own.taken),
    )  # fmt: skip
    study = Study(
        model=model,
        parameters=tuple(parameters),
        lanes=lanes,
        curves=tuple(map(tuple, groups)),
        unknowns=tuple(map(tuple, unknowns)),
        noise_given=(known, noise.joints is not None),
        marker_noise=None if noise.joints is None else (noise.joints, noise.joints_share),
        joint=joint,
        balance=weighting.balance,
        change_points=change_points,
        record_zeros=found,
        force_share=_force_share(noise, known, lanes, parameters, change_points, model),
    )
    known = dataclasses.replace(recipe, zeros=_by_lanes(own.zeros, curves, groups))
    object.__setattr__(study, "recipe", known)
    return study


def _by_lanes(
    zeros: Zeros | None, curves: Sequence[Curve], groups: Sequence[Sequence[Curve]]
) -> Zeros | None:
    """What the records of curves show, lane after lane."""
    if zeros is None:
        return None
    row = {(c.specimen, c.trial): k for k, c in enumerate(curves)}
    order = [row[c.specimen, c.trial] for lane in groups for c in lane]
    return Zeros(*(v[order] for v in zeros))


def _force_share(
    noise: Noise,
    known: bool,
    lanes: Lane,
    parameters: Sequence[Parameter],
    change_points: np.ndarray | None,
    model: FitModel,
) -> float | Literal["estimate"] | None:
    """The share that is asked for, or estimated by itself: of deep presses, sigma estimated.

    Without a skeleton (coupling `total`) no press is too deep for it.
    """
    if noise.force_share is not None:
        return noise.force_share or None
    if known or model.options.coupling == "total":
        return None
    deepest = 0.0
    touch = first_touch_of(lanes, parameters, change_points)
    for t, of_lanes in enumerate(touch.T):  # one after the other: they are as large as the data
        depth = depths(np.asarray(lanes.displacement[:, t]), of_lanes[:, None], model.options)
        seen = np.asarray(lanes.precision[:, t]) > 0
        deepest = np.max(np.abs(depth), where=seen, initial=deepest)
    return None if deepest <= DEEP * float(model.geometry.radius) else "estimate"


def _admitted(
    curves: Measurements | Sequence[Curve],
    geometry: Geometry,
    options: Options,
    parameters: Table | None,
) -> tuple[Sequence[Curve], Sequence[Parameter]]:
    """The curves as the model reads them, every one of which it can press, and the table."""
    if isinstance(curves, Measurements):
        _warn_of(curves.bad)
        curves = curves.curves
    if not curves:
        raise ValueError("no usable curve; nothing to fit")
    table, size = _table(parameters, options, curves, geometry), Size.of(geometry)
    for curve in curves:
        if (refused := refusal(curve, size, options, table)) is not None:
            raise refused.error
    curves, unused = as_read(curves, level_of(options))
    if unused is not None:
        warnings.warn(unused, stacklevel=3)
    return curves, table


def _from_touch(
    lanes: Lane,
    groups: Sequence[Sequence[Curve]],
    parameters: Sequence[Parameter],
    options: Options,
    noise: Noise,
    found: np.ndarray | None,
) -> tuple[Lane, np.ndarray | None]:
    """What follows from first touch: its rounded corner, its bounds, weights of markers by depth.

    Curves that take no onset have a sharp corner, at 0. `found`: see `Study.record_zeros`; onsets
    in it that lie among the samples are replaced by the change points.

    Returns:
        The lanes, and the change points of the curves (None: no first touch is sought).
    """
    seen = None
    if onset_is_sought(parameters, options):
        corners = touches(lanes, parameters, None if found is None else found[..., 2])
        column = next(j for j, p in enumerate(parameters) if p.name == "onset")
        own = lanes.index[:, :, column] >= 0
        width = np.where(own, blends(corners, groups, noise.force, options), 0.0)
        lanes = within_reach(lanes._replace(blend=width), parameters)
        seen = np.where(own, corners.onset, np.nan)
        if found is not None and parameters[column].auto:
            weighed = lanes.precision > 0
            first = np.min(lanes.displacement, axis=2, where=weighed, initial=np.inf)
            before = found[..., 0] <= first
            seen = np.where(before, found[..., 0], seen)
            found[..., 0] = np.where(np.isnan(found[..., 0]), np.nan, seen)
    if noise.joints_share:
        touch = first_touch_of(lanes, parameters, seen)
        depth = depths(np.asarray(lanes.displacement), touch[..., None], options)
        lanes = weighed_by_depth(lanes, noise, depth)
    return lanes, seen


def _warn_of(bad: Sequence[BadCurve]) -> None:
    """Say what could not be used; it is not forgotten in silence."""
    if bad:
        first = f"{bad[0].specimen} {bad[0].trial}: {bad[0].reason}"
        more = f", and {len(bad) - 1} more" if len(bad) > 1 else ""
        warnings.warn(f"curves left out: {first}{more}", stacklevel=4)


def _table(
    parameters: Table | None, options: Options, curves, geometry: Geometry
) -> Sequence[Parameter]:
    """The table itself, or the defaults of the model with changes."""
    if parameters is not None and not isinstance(parameters, Mapping):
        return parameters
    changes = parameters or {}
    joints = any(c.joint_displacement is not None for c in curves)
    names = in_model(options, joints=joints, named=changes)
    return default_parameters(names, changes, defaults_of(options, geometry))


def _common(unknowns, parameters, taken: Taken) -> Common:
    """See `FitModel.common`."""
    free = [p.name for p in parameters if not p.fixed]
    auto = {p.name for p in parameters if not p.fixed and p.auto}
    names = [[p.name for p, _, _ in lane] for lane in unknowns]
    if all(lane == free for lane in names) and all(auto <= v for v in map(set, taken.values())):
        return "all"
    beams = ([name for name in lane if name in SKELETON] for lane in names)
    return "beam" if all(len(b) == len(set(b)) for b in beams) else "nothing"


def default_parameters(
    names: Sequence[str],
    changes: Mapping[str, Mapping[str, object]],
    defaults: Mapping[str, Parameter] = DEFAULTS,
) -> tuple[Parameter, ...]:
    """Table rows for `names` with the user's changes.

    Args:
        names: parameters of the model.
        changes: fields of `Parameter` by name; whatever is named is fitted, unless `fixed` is true.
        defaults: what is changed; see `parameters.defaults_of`.

    Raises:
        ValueError: a change names a parameter that the chosen model does not contain, or something
            that a parameter does not have, or holds a first guess (`fixed` without `value`), or is
            no mapping.
    """
    unknown = [name for name in changes if name not in names]
    if unknown:
        raise ValueError(
            f"parameters.{unknown[0]}: not part of this model, which has {', '.join(names)}"
        )
    known = [f.name for f in dataclasses.fields(Parameter) if f.name != "name"]
    for name, change in changes.items():
        if not isinstance(change, Mapping):
            raise ValueError(
                f"parameters.{name}: found {change!r}; expected its fields, as in "
                "{'fixed': True, 'value': 1.0}, or {} to fit it"
            )
        for key in change:
            if key not in known:
                raise ValueError(
                    f"parameters.{name}: {key!r} is not known; expected one of {', '.join(known)}"
                )
        if change.get("fixed") is True and "value" not in change:
            try:
                held(defaults[name])
            except InputError as error:
                expected = "a value beside it, as in {'fixed': True, 'value': 1.0}"
                key = f"parameters.{name}: fixed"
                raise InputError.like(error, key=key, expected=expected) from None
    fitted = {name: {"fixed": False, "auto": False, **v} for name, v in changes.items()}
    return tuple(dataclasses.replace(defaults[n], **fitted.get(n, {})) for n in names)
