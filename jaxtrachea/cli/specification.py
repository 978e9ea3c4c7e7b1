"""From a fit specification to a study: opens the files, names what is wrong, builds the lanes."""

import contextlib
import dataclasses
from collections.abc import Mapping

from jaxtrachea._errors import InputError
from jaxtrachea.config import FitSpec, ParameterSection, SpecError
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.parameters import DEFAULTS, Parameter, defaults_of, held, in_model, visible
from jaxtrachea.fitting.refusals import Refusal, Size, as_read, refusal
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.zeros import without_line, zeros_of
from jaxtrachea.inference.holdout_groups import with_holdout_groups
from jaxtrachea.measurements.read import (
    BadCurve,
    Measurements,
)
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.sections.material import LEAST, SECTION_VALUES, Wall
from jaxtrachea.optimisation.batching import MOST_SLOTS
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.trachea.section import geometry_of
from jaxtrachea.trachea.sizes import SizeError
from jaxtrachea.units import UnitError, parse_quantity

#: Parameters of the levels `arch` and `arch2` of scenes, and what a fit takes instead.
OF_THE_ARCH = {
    "EI_C": "on the midline k_M is the whole ring, arch and mat; leave it out, or choose "
    "model.skeleton = 'sections'",
    "k_t": "the tie between its ends is known to scenes alone; leave it out",
}


def parameters_of(spec: FitSpec, options: Options, *, joints: bool) -> tuple[Parameter, ...]:
    """The parameter table of the chosen model with the user's changes.

    Raises:
        SpecError: a parameter the model does not have, values that contradict each other, or a wall
            that the model does not read or that cannot be.
    """
    defaults = _defaults(spec, options)
    known = visible(options, joints=joints)
    for name in spec.parameters:
        if name not in known:
            reason = "not a parameter" if name not in DEFAULTS else _unseen(name, options, joints)
            if name in OF_THE_ARCH:
                reason = f"of a ring that bends; {OF_THE_ARCH[name]}"
            raise SpecError(f"parameters.{name}: {reason}; expected one of {', '.join(known)}")
    sections = {**spec.parameters, **_baseline(spec)}
    names = in_model(options, joints=joints, named=sections)
    return tuple(_parameter(defaults[n], sections.get(n)) for n in names)


#: Keys of [model] that bring parameters along, and their values.
_BRINGS = (
    ("shear", True), ("skeleton", "softening"), ("local", "two-material"), ("coupling", "series"),
    ("contact", "unilateral"), ("relaxation", "uniform"),
)  # fmt: skip


def _unseen(name: str, options: Options, joints: bool) -> str:
    """That the model does not see a parameter, and with which key it would."""
    for key, value in _BRINGS:
        with contextlib.suppress(ValueError):
            if name in visible(dataclasses.replace(options, **{key: value}), joints=joints):
                written = str(value).lower() if isinstance(value, bool) else f'"{value}"'
                return f"not seen by this model; with {key} = {written} in [model] it is"
    return "not seen by this model"


def _baseline(spec: FitSpec) -> Mapping[str, ParameterSection]:
    """The parameter that `data.baseline` stands for."""
    if spec.data.baseline == "auto":
        return {}
    if "force_slope" in spec.parameters:
        raise SpecError(
            f"data.baseline = {spec.data.baseline!r} says what becomes of the line that "
            "parameters.force_slope describes; leave one of them out"
        )
    held = {"fixed": 0.0} if spec.data.baseline == "none" else {}
    return {"force_slope": ParameterSection.model_validate(held)}


def _defaults(spec: FitSpec, options: Options) -> Mapping[str, Parameter]:
    """Parameters as the model begins with them."""
    try:
        wall = None if spec.wall is None else Wall(**spec.wall.model_dump())
    except InputError as error:
        raise SpecError.like(error, key=f"wall.{error.key}") from None
    try:
        return defaults_of(options, geometry_of(spec.trachea), wall, spec.data.tool_radius)
    except SizeError as error:
        raise SpecError.like(error, key=f"data.{error.key}") from None
    except InputError as error:
        raise SpecError.like(error) from None


def options_of(spec: FitSpec) -> Options:
    """What the [model] section includes.

    Raises:
        SpecError: options that exclude each other.
    """
    try:
        return Options(**spec.model.model_dump())
    except ValueError as error:
        raise SpecError(f"model: {error}") from None


def _parameter(default: Parameter, section: ParameterSection | None) -> Parameter:
    """One row of the table."""
    if section is None:
        return default
    try:
        if section.fixed is True:
            return held(default)
        if section.fixed is not None:
            return _fixed(default, section.fixed)
        return _free(default, section)
    except InputError as error:
        name = f"parameters.{default.name}"
        key = name if error.key == default.name else f"{name}: {error.key}"
        raise SpecError.like(error, key=key) from None


def _number(default: Parameter, key: str, value: str | float | int) -> float:
    """A value in the parameter's unit; a bare number is in it already."""
    if not isinstance(value, str):
        return float(value)
    try:
        return parse_quantity(value, default.dimension)
    except UnitError as error:
        raise InputError.like(error, key=key) from None


def _fixed(default: Parameter, given: str | float | int) -> Parameter:
    value = _number(default, "fixed", given)
    if default.scale == "log" and value <= 0:
        found = f"{value:g} {default.unit} is no stiffness"
        raise InputError(found, key="fixed", expected="more than 0")
    if default.name in SECTION_VALUES and value < (least := LEAST.get(default.name, 0.0)):
        found = f"{value:g} {default.unit}".strip()
        raise InputError(found, key="fixed", expected=f"{least:g} or more")
    return dataclasses.replace(default, value=value, fixed=True, auto=False)


def _free(default: Parameter, section: ParameterSection) -> Parameter:
    lower, upper = default.lower, default.upper
    scale = section.scale or default.scale
    if section.bounds is not None:
        lower, upper = (_number(default, "bounds", v) for v in section.bounds)
    elif scale == "log":
        lower = max(lower, 1e-9)
    if section.initial is not None:
        value = _number(default, "initial", section.initial)
    else:
        value = min(max(default.value, lower), upper)
    scope = section.scope or default.scope
    return dataclasses.replace(
        default, value=value, lower=lower, upper=upper, scale=scale, scope=scope, fixed=False,
        auto=False,
    )  # fmt: skip


def usable(spec: FitSpec, measurements: Measurements) -> Measurements:
    """The measurements with curves that this tube and model cannot press moved to the bad ones.

    What the model does not read of the others is left out, and a note says so.

    Raises:
        SpecError: not one curve is left; the message is that of the first.
    """
    geometry, options = geometry_of(spec.trachea), options_of(spec)
    marked = any(c.joint_displacement is not None for c in measurements.curves)
    table = parameters_of(spec, options, joints=marked)
    good, bad = [], list(measurements.bad)
    reasons = []
    size, lines = Size.of(geometry), _lines(spec, measurements, options, table)
    for curve, no_line in zip(measurements.curves, lines, strict=True):
        refused = refusal(curve, size, options, table)
        refused = refused or (no_line and Refusal("baseline", no_line))
        if refused is None:
            good.append(curve)
            continue
        kind, error = refused
        reasons.append(f"{curve.source}: {error}")
        cure = error.remedy or "correct the file, or the trachea and model sections"
        place = curve.specimen, curve.trial, curve.source
        bad.append(BadCurve(*place, kind, error.problem, cure))
    if reasons and not good:
        raise SpecError(reasons[0])
    good, unused = as_read(good, level_of(options))
    notes = measurements.notes if unused is None else (*measurements.notes, unused)
    return dataclasses.replace(measurements, curves=tuple(good), bad=tuple(bad), notes=notes)


def _lines(spec: FitSpec, measurements: Measurements, options: Options, table):
    """Why each curve has no line below its force, where all are to have one; else None each."""
    if spec.data.baseline == "slope" and options.contact != "unilateral":
        raise SpecError(
            "data.baseline: 'slope' needs samples before first touch, which contact = 'bonded' "
            "does not have; leave it out"
        )
    if not any(p.name == "force_slope" and not p.fixed for p in table):
        return [None] * len(measurements.curves)
    noise = None if isinstance(spec.noise.force, str) else spec.noise.force
    return without_line(measurements.curves, zeros_of(measurements.curves, noise, table))


#: Unknowns up to which a study with shared parameters is refitted as one dense lane.
MOST_DENSE = 500


def study_of(spec: FitSpec, measurements: Measurements, *, refits: bool = False) -> Study:
    """Everything together; parameters that are shared are fitted jointly, specimens as lanes.

    What looks at whole lanes (profiles, bootstrap, posterior, influence, leaving out, design,
    comparison) and methods other than
    Levenberg-Marquardt get one dense lane in place of the joint study.

    Args:
        refits: something that refits lanes was asked for outside the specification.

    Raises:
        SpecError: with the key, or the specimen and trial, that cannot be used.
    """
    u = spec.uncertainty
    asked = u.profile or u.bootstrap or u.posterior or u.influence
    joint = not (refits or asked or spec.fit.method != "levenberg-marquardt")
    study = _with_groups(_built(spec, measurements, joint), spec, measurements)
    if spec.fit.method != "levenberg-marquardt":
        try:
            study.refuse_sections(f"fit.method = {spec.fit.method!r}")
        except ValueError as error:
            raise SpecError(str(error)) from None
    shared = [p.name for p in study.free if p.scope == "shared"]
    if shared and not joint and study.size > MOST_DENSE:
        raise SpecError(
            f"parameters.{shared[0]}: shared, so that {study.size} unknowns depend on each "
            "other; profiles, bootstrap, posterior, influence, --leave-one-out, design, compare "
            f"and methods other than levenberg-marquardt take at most {MOST_DENSE}; leave them out "
            "(the joint fit has no limit), or give it the scope 'specimen'"
        )
    return study


def _with_groups(study: Study, spec: FitSpec, measurements: Measurements) -> Study:
    """With the groups of `data.together`."""
    if not spec.data.together:
        return study
    try:
        return with_holdout_groups(study, spec.data.together, measurements.bad)
    except InputError as error:
        raise SpecError.like(error, key=f"data.together.{error.key}") from None


def _built(spec: FitSpec, measurements: Measurements, joint: bool) -> Study:
    options = options_of(spec)
    curves = measurements.curves
    joints = any(c.joint_displacement is not None for c in curves)
    noise = _noise(spec)
    try:
        return build_study(
            curves,
            geometry_of(spec.trachea),
            options,
            parameters_of(spec, options, joints=joints),
            noise=noise,
            weighting=Weighting(
                spec.fit.balance, spec.fit.loss, spec.fit.loss_scale, spec.data.pressed_ends
            ),
            tool_radius=spec.data.tool_radius,
            joint=joint,
        )
    except SpecError:
        raise
    except SizeError as error:
        section = "data" if error.key == "tool_radius" else "model"
        raise SpecError.like(error, key=f"{section}.{error.key}") from None
    except ValueError as error:
        raise SpecError(str(error)) from None


def _noise(spec: FitSpec) -> Noise:
    """The [noise] section."""
    force, joints = (
        None if isinstance(sigma, str) else sigma for sigma in (spec.noise.force, spec.noise.joints)
    )
    by_curve = spec.noise.force == "estimate per curve"
    of_joints = spec.noise.joints_share
    share = None if spec.noise.force_share == "auto" else spec.noise.force_share
    try:
        return Noise(
            force=force, joints=joints, joints_share=of_joints, force_share=share,
            force_by_curve=by_curve,
        )  # fmt: skip
    except InputError as error:
        raise SpecError.like(error, key=f"noise.{error.key}") from None


def settings_of(spec: FitSpec) -> Settings:
    """Solver settings of the [fit] section; `batch` is its upper bound if left to the machine."""
    f = spec.fit
    limits = Tolerances(f.tolerance, f.tolerance, f.tolerance, f.max_iterations)
    return Settings(
        method=f.method,
        starts=f.starts,
        decades=f.start_decades,
        seed=f.seed,
        more_starts=f.more_starts,
        batch=MOST_SLOTS if f.batch == "auto" else f.batch,
        tolerances=limits,
        float32=f.precision == "float32",
    )
