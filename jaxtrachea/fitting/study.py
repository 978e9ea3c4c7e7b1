"""From curves to a study: lanes of padded arrays, with the model they are fitted by.

A *lane* is the smallest set of curves that share unknowns: the whole study if any parameter is
shared, one specimen otherwise, one trial if all free parameters belong to trials. In a *joint*
study lanes are specimens although they share unknowns: every lane holds a copy of the shared
ones, and the solver keeps the copies equal. How curves become arrays is in `lanes`, what these are
compared with in `residual`.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.curve_noise import weighed_by_curve
from jaxtrachea.fitting.lane import Lane, markers
from jaxtrachea.fitting.lane import size as entries_of_trial
from jaxtrachea.fitting.lanes import (
    Balance,
    Noise,
    Taken,
    Unknown,
    Weighting,
    curve_weights,
    group,
    lanes_of,
    unknowns_of,
    weighed_by_depth,
)
from jaxtrachea.fitting.model import Common, FitModel, columns_of, numbers_of
from jaxtrachea.fitting.onset import (
    blends,
    first_touches,
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
from jaxtrachea.fitting.zeros import Resolved, resolved, starts_of
from jaxtrachea.measurements.read import BadCurve, Curve, Measurements
from jaxtrachea.measurements.record_zeros import Zeros
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.optimisation import batching
from jaxtrachea.trachea.geometry import Geometry

#: Depth over the radius of the tube beyond which the noise of forces is looked for a share.
DEEP = 0.1
#: The table of parameters, or what differs from the defaults of the model, by name.
Table = Sequence[Parameter] | Mapping[str, Mapping[str, object]]


class Shares(NamedTuple):
    """Noise of forces that has a share of the force, as found; of every lane.

    Attributes:
        share: of the force; (lanes,).
        sigma: of a sample without force, N; (lanes,); None where it is given.
        plain: precision of the forces without the share; (lanes, T, N).
    """

    share: Float[np.ndarray, " lanes"]
    sigma: Float[np.ndarray, " lanes"] | None
    plain: Float[np.ndarray, "lanes T N"]


@dataclasses.dataclass(frozen=True, eq=False)
class Recipe:
    """Arguments of `build_study` apart from the curves.

    Attributes:
        geometry: the tube.
        options: of the model.
        parameters: the whole table, `auto` rows undecided.
        noise: see `build_study`.
        weighting: likewise.
        tool_radius: likewise.
        joint: likewise.
        asked: onsets and offsets that curves take on top of what their records show.
        zeros: what the records show, in the order of the lanes' curves; None: not looked at.
    """

    geometry: Geometry
    options: Options
    parameters: Sequence[Parameter]
    noise: Noise
    weighting: Weighting
    tool_radius: float | None
    joint: bool
    asked: Taken
    zeros: Zeros | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """Measurements divided into lanes, ready to be fitted with a model; from `build_study`.

    Attributes:
        model: what is fitted (static); programs are compiled for it.
        parameters: all parameters of the model, free and fixed, in column order.
        lanes: stacked arrays with the leading axis `lanes`, numpy.
        curves: for each lane, its curves in trial order.
        unknowns: for each lane, the (parameter, specimen or "", trial or "") of every unknown.
        noise_given: whether sigma of (force, markers) is known.
        marker_noise: given standard deviation of markers, mm, and share of the tool's displacement
            that it has beside it (see `Noise`); None: estimated.
        joint: whether shared unknowns are one and the same in all lanes.
        holdout_groups: names of trials, in groups that are left out together; see
            `inference.holdout_groups.with_holdout_groups`.
        balance: what weighs the same, see `Weighting`.
        change_points: displacement at which each curve shows its first touch, mm, NaN where it
            shows none; (lanes, T); None where no onset is sought.
        record_zeros: onset, force offset and slope that curves take from their own records, as
            these show them, mm, N, N/mm; NaN where they take none; None: no curve takes any.
        force_share: of the noise of forces, see `Noise`; None: it has none.
        shares: what the weights of the lanes have of it; None: nothing yet.
        recipe: how it was built; None of a study that was changed since, or read from a file.
    """

    model: FitModel
    parameters: tuple[Parameter, ...]
    lanes: Lane
    curves: tuple[tuple[Curve, ...], ...]
    unknowns: tuple[tuple[Unknown, ...], ...]
    noise_given: tuple[bool, bool]
    marker_noise: tuple[float, float] | None = None
    joint: bool = False
    holdout_groups: tuple[tuple[str, ...], ...] = ()
    balance: Balance = "curve"
    change_points: Float[np.ndarray, "lanes T"] | None = None
    record_zeros: Float[np.ndarray, "lanes T 3"] | None = None
    force_share: float | Literal["estimate"] | None = None
    shares: Shares | None = None
    # Not an argument, so that `dataclasses.replace` drops it: a changed study has none.
    recipe: Recipe | None = dataclasses.field(default=None, init=False)

    def __post_init__(self):
        """Refuse a model of another parameter table.

        Raises:
            ValueError: with the columns of both.
        """
        if (of_table := columns_of(self.parameters)) != self.model.columns:
            raise ValueError(
                f"the model has the columns {self.model.columns}, the parameter table gives "
                f"{of_table}; replace both together"
            )

    @functools.cached_property
    def noise_known(self) -> Bool[np.ndarray, " lanes"]:
        """Whether the sigma of all that a lane observes is given; jointly fitted: any lane."""
        known = np.full(len(self.unknowns), self.noise_given[0])
        if not self.noise_given[1]:
            for kind in markers(self.lanes):
                known &= ~(kind.precision.reshape(len(known), -1) > 0).any(axis=1)
        return np.full(len(known), known.all()) if self.joint else known

    @property
    def weighs_noise(self) -> bool:
        """Whether forces count by noise of their own, given or found."""
        seen = self.lanes.precision[self.lanes.precision > 0]
        return bool(np.ptp(seen) > 0)

    @property
    def free(self) -> tuple[Parameter, ...]:
        """Parameters that are fitted, in column order."""
        return tuple(p for p in self.parameters if not p.fixed)

    @property
    def free_columns(self) -> tuple[int, ...]:
        """Columns of the parameter table that are fitted."""
        return tuple(j for j, p in enumerate(self.parameters) if not p.fixed)

    @property
    def size(self) -> int:
        """Unknowns per lane, padding included."""
        return self.lanes.lower.shape[1]

    @property
    def first_touch(self) -> Float[np.ndarray, "lanes T"]:
        """Displacement at first touch of every trial before a fit, mm: held, or as curves show it.

        The first guess where they do not; `FitResult.first_touch` has the estimates.
        """
        return _first_touch(self.lanes, self.parameters, self.change_points)

    @functools.cached_property
    def unknown_columns(self) -> Int[np.ndarray, "lanes P"]:
        """Which of `free` every unknown is; -1 where a lane has fewer unknowns."""
        number = {p.name: i for i, p in enumerate(self.free)}
        out = np.full((len(self.unknowns), self.size), -1)
        there = np.arange(self.size) < np.array([len(lane) for lane in self.unknowns])[:, None]
        out[there] = [number[p.name] for lane in self.unknowns for p, _, _ in lane]
        return out

    def of_unknowns(
        self, number: Callable[[Parameter], object], padding
    ) -> Shaped[np.ndarray, "lanes P"]:
        """A number of each unknown's parameter, `padding` where a lane has fewer; of its dtype."""
        return np.array([*map(number, self.free), padding], type(padding))[self.unknown_columns]

    @property
    def shared(self) -> Int[np.ndarray, "lanes k"]:
        """Where the unknowns that all lanes of a joint study share stand in each lane."""
        names = [p.name for p in self.free if p.scope == "shared"] if self.joint else []
        if not names:
            return np.zeros((len(self.unknowns), 0), int)
        rows = [{p.name: i for i, (p, _, _) in enumerate(lane)} for lane in self.unknowns]
        return np.array([[row[name] for name in names] for row in rows], int).reshape(
            len(self.unknowns), len(names)
        )

    def refuse_joint(self, what: str) -> None:
        """Say that something is made for lanes that are fitted one by one.

        Raises:
            ValueError: the study is joint.
        """
        if self.joint:
            raise ValueError(f"{what} needs lanes without shared unknowns; build with joint=False")

    def refuse_sections(self, what: str) -> None:
        """Say that something is too much work for a level that iterates.

        Raises:
            ValueError: this one does.
        """
        if self.model.level.iterates:
            raise ValueError(
                f"{what} is not available for the skeleton {self.model.level.name!r}; leave it out "
                "(standard errors, profiles, the bootstrap, influence, leaving out and designs "
                "are), or choose another skeleton"
            )

    @property
    def one_at_a_time(self) -> bool:
        """Whether lanes are fitted one after the other, whatever batch is asked for.

        Of a level that iterates on a CPU: lanes side by side gain nothing there, wait for the
        slowest of them, and each size is a program of half a minute.
        """
        return self.model.level.iterates and batching.on_cpu()

    @property
    def bytes_per_lane(self) -> int:
        """Memory that one of the lanes computed together takes, from above.

        Five numbers per residual entry and free column, as XLA counts them for a
        Levenberg-Marquardt step in float64 (3.7 to 5 in ten studies), and the matrices of the
        unknowns.
        """
        entries = self.lanes.s_c.shape[1] * entries_of_trial(self.lanes)
        return 8 * (5 * len(self.free) * entries + 8 * self.size**2 + 500)

    @property
    def max_batch(self) -> int:
        """Lanes worth computing together at most, a power of two (see `optimisation.batching`).

        Joint studies and other devices have no such limit; 1 where lanes are fitted
        `one_at_a_time`.
        """
        if self.one_at_a_time:
            return 1
        if self.joint or not batching.on_cpu():
            return 1 << 30
        return batching.max_in_cache(self.bytes_per_lane)

    def batch_size(self, total: int, most: int) -> int:
        """Lanes computed together, of `total`, of `most` and `max_batch`: a size of few."""
        return batching.batch_size(total, min(most, self.max_batch))

    def unoptimised(self, count: int) -> bool:
        """Whether `count` lanes take less time than it takes to optimise their program.

        Joint studies run theirs again and again.
        """
        if self.joint or self.one_at_a_time or not batching.on_cpu():
            return False
        return not batching.worth_optimising(count, self.bytes_per_lane)

    def take(self, lanes: Int[np.ndarray, " n"]) -> "Study":
        """The same study with these lanes, in this order; a lane may come more than once."""
        return dataclasses.replace(
            self,
            lanes=jax.tree.map(lambda v: v[lanes], self.lanes),
            curves=tuple(self.curves[k] for k in lanes),
            unknowns=tuple(self.unknowns[k] for k in lanes),
            change_points=None if self.change_points is None else self.change_points[lanes],
            record_zeros=None if self.record_zeros is None else self.record_zeros[lanes],
            shares=jax.tree.map(lambda v: v[lanes], self.shares),
        )

    def lane_name(self, lane: int) -> tuple[str, str]:
        """Specimen and trial of a lane; "(all)" where it spans several."""

        def one(names):
            return names.pop() if len(names) == 1 else "(all)"

        curves = self.curves[lane]
        return one({c.specimen for c in curves}), one({c.trial for c in curves})


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
        ValueError: a `tool_radius` that is no length, none where `weighting` leaves pressed ends
            out, no curve, one that cannot be pressed (`refusals`), with specimen and trial named;
            a parameter that the model does not have; a `force_slope` that is free, and a curve
            without 5 samples before first touch.
    """
    if tool_radius is not None and not 0 <= tool_radius < np.inf:
        raise ValueError(f"tool_radius is {tool_radius}; expected a length in mm, 0 or more")
    if not weighting.pressed_ends and tool_radius is None:
        raise ValueError("pressed_ends=False needs tool_radius: which rings are under the tool")
    curves, table = _admitted(curves, geometry, options, parameters)
    check_noise(curves, noise.force)
    recipe = Recipe(geometry, options, table, noise, weighting, tool_radius, joint, {})
    return _built(curves, recipe)


def with_zeros(study: Study, asked: Taken) -> Study:
    """A study built again, in which curves take further zeros.

    Args:
        study: one with a recipe.
        asked: names of `auto` parameters that curves take on top of those which their records show
            and which the study has already.
    """
    recipe = study.recipe
    assert recipe is not None
    every = {k: {*recipe.asked.get(k, ()), *asked.get(k, ())} for k in {*recipe.asked, *asked}}
    curves = [c for lane in study.curves for c in lane]
    again = _built(curves, dataclasses.replace(recipe, asked=every), study)
    return with_recipe(again, holdout_groups=study.holdout_groups)


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
    if before is not None:  # of the same curves, in memory once
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
        common=_common(unknowns, parameters, own),
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
    touch = _first_touch(lanes, parameters, change_points)[..., None]
    depth = depths(np.asarray(lanes.displacement), touch, model.options)
    deepest = np.max(np.abs(depth), where=np.asarray(lanes.precision) > 0, initial=0)
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
            first = np.min(np.where(lanes.precision > 0, lanes.displacement, np.inf), axis=2)
            before = found[..., 0] <= first
            seen = np.where(before, found[..., 0], seen)
            found[..., 0] = np.where(np.isnan(found[..., 0]), np.nan, seen)
    if noise.joints_share:
        touch = _first_touch(lanes, parameters, seen)
        depth = depths(np.asarray(lanes.displacement), touch[..., None], options)
        lanes = weighed_by_depth(lanes, noise, depth)
    return lanes, seen


def _first_touch(lanes: Lane, parameters: Sequence[Parameter], seen: np.ndarray | None):
    """As `Study.first_touch`; `seen`: its `change_points`."""
    known = first_touches(lanes, parameters)
    return known if seen is None else np.where(np.isnan(seen), known, seen)


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


def _common(unknowns, parameters, own: Resolved) -> Common:
    """See `FitModel.common`."""
    free = [p.name for p in parameters if not p.fixed]
    auto = {p.name for p in parameters if not p.fixed and p.auto}
    names = [[p.name for p, _, _ in lane] for lane in unknowns]
    if all(lane == free for lane in names) and all(auto <= v for v in map(set, own.taken.values())):
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
