"""From a fit specification to a problem: opens the files, names what is wrong, builds the lanes."""

import contextlib
import dataclasses
import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from jaxtrachea.config import EvenRings, FitSpec, ParameterSection, SpecError, TracheaSection
from jaxtrachea.fit.fit import Settings
from jaxtrachea.fit.levenberg_marquardt import Tolerances
from jaxtrachea.fit.parameters import DEFAULTS, Parameter, in_model
from jaxtrachea.fit.problem import Noise, Problem, build, check_curve
from jaxtrachea.inference.design import Candidates, check, grid
from jaxtrachea.measurements.names import appearance
from jaxtrachea.measurements.read import (
    BadCurve,
    DataError,
    Measurements,
    ReadOptions,
    read_measurements,
)
from jaxtrachea.measurements.readers.patterns import ensure_quick
from jaxtrachea.measurements.readers.recognise import is_workbook
from jaxtrachea.mechanics.press import Options
from jaxtrachea.runs.chunks import MOST_SEATS
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.units import parse_quantity


def find_files(spec: FitSpec, root: Path) -> list[Path]:
    """Files of `data.files`, patterns expanded, sorted within each pattern.

    Args:
        spec: the specification.
        root: folder that relative paths start from.

    Raises:
        SpecError: a path or pattern matches nothing.
    """
    found: dict[Path, None] = {}
    for i, pattern in enumerate(spec.data.files):
        try:
            matches = _matches(root, pattern)
        except (ValueError, NotImplementedError, IndexError, OSError) as error:
            raise SpecError(
                f"data.files.{i}: {_short(pattern)} is no usable path ({_reason(error)}); "
                "name files, or a pattern such as 'curves/*.csv'"
            ) from None
        files = [path for path in matches if path.is_file()]
        if not files:
            raise SpecError(
                f"data.files.{i}: {_short(pattern)} matches in {root} "
                f"{_what(matches) if matches else _nothing(root / pattern)}"
            )
        found.update(dict.fromkeys(files))
    return list(found)


def _short(pattern: str) -> str:
    """A pattern for a message."""
    return repr(pattern if len(pattern) < 200 else f"{pattern[:196]} ...")


def _what(matches: list[Path]) -> str:
    """What a pattern leads to that is no file, and the cure."""
    if matches[0].is_dir():
        return "a folder; list the files in it, as in 'folder/*.csv'"
    return "a device or a pipe; expected a file"


def _nothing(path: Path) -> str:
    """That there is no such file, the one whose name looks like it if there is any, the cure."""
    with contextlib.suppress(OSError):
        names = sorted(other.name for other in path.parent.iterdir())
        for name in names:
            if name != path.name and appearance(name) == appearance(path.name):
                return f"no file; {ascii(name)}, which looks alike, is there; write its name so"
    return "no file; check the name, or say where the data are with --data"


def _reason(error: Exception) -> str:
    """Why, without repeating the path."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _matches(root: Path, pattern: str) -> list[Path]:
    """Files and folders that a path or pattern names; a name that exists is taken as it is."""
    path = root / pattern
    if pattern and path.exists():
        return [path]
    relative = path.relative_to(path.anchor) if Path(pattern).is_absolute() else pattern
    # Folders below folders once: pathlib walks through all of them for every further "**/".
    once = re.sub(r"(?:\*\*/)+", "**/", str(relative))
    return sorted((Path(path.anchor) if Path(pattern).is_absolute() else root).glob(once))


def read_data(spec: FitSpec, root: Path) -> Measurements:
    """Read all files of a specification.

    Of several files, one that cannot be read at all costs one `BadCurve` named after it.

    Raises:
        SpecError: no file, or reading options that contradict each other.
        DataError: the only file cannot be read, or two files hold the same specimen and trial.
    """
    names = {f.name for f in dataclasses.fields(ReadOptions)}
    try:
        options = ReadOptions(**{k: v for k, v in spec.data.model_dump().items() if k in names})
    except ValueError as error:
        raise SpecError(f"data: {error}") from None
    files = find_files(spec, root)
    if options.name_pattern is not None:
        try:
            ensure_quick(options.name_pattern, [path.name for path in files])
        except DataError as error:
            raise SpecError(f"data.specimen: {error}") from None
    if options.sheet is not None and not any(map(is_workbook, files)):
        raise SpecError("data.sheet: none of the files is a workbook (xlsx); remove it")
    if len(files) == 1:
        return read_measurements(files, options)
    parts = [_read_one(path, options) for path in files]
    curves = [curve for part in parts for curve in part.curves]
    bad = [curve for part in parts for curve in part.bad]
    notes = [note for part in parts for note in part.notes]
    _refuse_twice(parts)
    return Measurements(tuple(curves), tuple(bad), tuple(files), tuple(notes))


def _read_one(path: Path, options: ReadOptions) -> Measurements:
    """One file of several; what spoils it becomes its only row."""
    try:
        return read_measurements([path], options)
    except DataError as error:
        text = str(error).removeprefix(f"{path}: ")
        message, _, cure = text.rpartition("; ")
        bad = BadCurve(
            path.stem,
            "(all)",
            str(path),
            "unreadable",
            message or text,
            cure if message else "repair the file or leave it out",
        )
        return Measurements((), (bad,), (path,))


def _refuse_twice(parts: list[Measurements]) -> None:
    """Refuse a specimen and trial that two files hold."""
    seen: dict[tuple[str, str], str] = {}
    for part in parts:
        for curve in (*part.curves, *(b for b in part.bad if b.trial != "(all)")):
            key = (curve.specimen, curve.trial)
            if key in seen:
                raise DataError(
                    f"{curve.source}: specimen {key[0]!r} trial {key[1]!r} was already in "
                    f"{seen[key]}; rename one, or give a specimen pattern that tells files apart"
                )
            seen[key] = curve.source


def geometry_of(section: TracheaSection) -> Geometry:
    """The tube of a [trachea] section.

    Raises:
        SpecError: impossible dimensions, with the key.
    """
    preset = table_1()
    length = float(preset.length) if section.length is None else section.length
    rings = section.rings
    if rings is None:
        rings = np.asarray(preset.ring_positions, np.float64)
    if isinstance(rings, EvenRings):
        rings = np.linspace(rings.first, rings.last, rings.count)
    try:
        return Geometry.create(
            length,
            rings,
            radius=section.radius,
            half_angle=section.half_angle,
            ring_height=section.ring_height,
        )
    except ValueError as error:
        raise SpecError(f"trachea.{str(error).replace('ring_positions', 'rings')}") from None


def parameters_of(spec: FitSpec, options: Options, *, joints: bool) -> tuple[Parameter, ...]:
    """The parameter table of the chosen model with the user's changes.

    Raises:
        SpecError: a parameter the model does not have, or values that contradict each other.
    """
    names = in_model(options, joints=joints)
    for name in spec.parameters:
        if name not in names:
            known = "not a parameter" if name not in DEFAULTS else "not seen by this model"
            raise SpecError(f"parameters.{name}: {known}; expected one of {', '.join(names)}")
    # Unless asked for, a ring hardens like the ligament: k_3_ring is then k_3, not a parameter.
    names = [n for n in names if n != "k_3_ring" or n in spec.parameters]
    return tuple(_parameter(DEFAULTS[n], spec.parameters.get(n)) for n in names)


def _parameter(default: Parameter, section: ParameterSection | None) -> Parameter:
    """One row of the table.

    Raises:
        SpecError: with the dotted key.
    """
    if section is None:
        return default
    try:
        if section.fixed is not None:
            return _fixed(default, section.fixed)
        return _free(default, section)
    except ValueError as error:
        text = str(error).removeprefix(f"{default.name}: ")
        raise SpecError(f"parameters.{default.name}: {text}") from None


def _number(default: Parameter, key: str, value: str | float | int) -> float:
    """A value in the parameter's unit; a bare number is in it already."""
    if not isinstance(value, str):
        return float(value)
    try:
        return parse_quantity(value, default.dimension)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def _fixed(default: Parameter, given: str | float | int) -> Parameter:
    value = _number(default, "fixed", given)
    if default.scale == "log" and value <= 0:
        raise ValueError(f"fixed: {value:g} {default.unit} is no stiffness; expected more than 0")
    return dataclasses.replace(default, value=value, fixed=True)


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
        default, value=value, lower=lower, upper=upper, scale=scale, scope=scope, fixed=False
    )


def usable(spec: FitSpec, measurements: Measurements) -> Measurements:
    """The measurements with curves that this tube and model cannot press moved to the bad ones.

    Raises:
        SpecError: not one curve is left; the message is that of the first.
    """
    geometry, options = geometry_of(spec.trachea), Options(**spec.model.model_dump())
    good, bad = [], list(measurements.bad)
    reasons = []
    for curve in measurements.curves:
        try:
            check_curve(curve, geometry, options)
        except ValueError as error:
            text = str(error)
            reasons.append(f"{curve.source}: {text}")
            text = text.split(": ", 1)[-1]
            cure = "correct the file, or the trachea and model sections"
            bad.append(BadCurve(curve.specimen, curve.trial, curve.source, "position", text, cure))
        else:
            good.append(curve)
    if reasons and not good:
        raise SpecError(reasons[0])
    return dataclasses.replace(measurements, curves=tuple(good), bad=tuple(bad))


#: Unknowns up to which a study with shared parameters is refitted as one dense lane.
MOST_DENSE = 500


def problem_of(spec: FitSpec, measurements: Measurements, *, refits: bool = False) -> Problem:
    """Everything together; parameters that are shared are fitted jointly, specimens as lanes.

    What looks at whole lanes (profiles, bootstrap, posterior, influence, leaving out, design,
    comparison) and methods other than
    Levenberg-Marquardt get one dense lane in place of the joint problem.

    Args:
        spec: the specification.
        measurements: what to fit.
        refits: something that refits lanes was asked for outside the specification.

    Raises:
        SpecError: with the key, or the specimen and trial, that cannot be used.
    """
    u = spec.uncertainty
    asked = u.profile or u.bootstrap or u.posterior or u.influence
    joint = not (refits or asked or spec.fit.method != "levenberg-marquardt")
    problem = _built(spec, measurements, joint)
    shared = [p.name for p in problem.free if p.scope == "shared"]
    if shared and not joint and problem.size > MOST_DENSE:
        raise SpecError(
            f"parameters.{shared[0]}: shared, so that {problem.size} unknowns depend on each "
            "other; profiles, bootstrap, posterior, influence, --leave-one-out, design, compare "
            f"and methods other than levenberg-marquardt take at most {MOST_DENSE}; leave them out "
            "(the joint fit has no limit), or give it the scope 'specimen'"
        )
    return problem


def _built(spec: FitSpec, measurements: Measurements, joint: bool) -> Problem:
    options = Options(**spec.model.model_dump())
    curves = measurements.curves
    joints = any(c.joint_displacement is not None for c in curves)
    given = (spec.noise.force, spec.noise.joints)
    noise = Noise(*(None if sigma == "estimate" else sigma for sigma in given))
    try:
        return build(
            curves,
            geometry_of(spec.trachea),
            options,
            parameters_of(spec, options, joints=joints),
            noise=noise,
            balance=spec.fit.balance,
            loss=spec.fit.loss,
            loss_scale=spec.fit.loss_scale,
            tool_radius=spec.data.tool_radius,
            joint=joint,
        )
    except SpecError:
        raise
    except ValueError as error:
        raise SpecError(str(error)) from None


def profiled(spec: FitSpec, problem: Problem, *, asked: bool) -> tuple[str, ...]:
    """Names of the parameters to profile: those of the specification, all if only asked for.

    Raises:
        SpecError: one is not fitted.
    """
    names, free = spec.uncertainty.profile, tuple(p.name for p in problem.free)
    for name in names:
        if name not in (*free, "all"):
            raise SpecError(
                f"uncertainty.profile: {name!r} is not fitted; expected 'all' or names out of "
                f"{', '.join(free)}"
            )
    return free if "all" in names or (asked and not names) else tuple(names)


def refuse_without_unknowns(spec: FitSpec, problem: Problem, options: Collection[str]) -> None:
    """Say what has no meaning where every parameter is fixed.

    Args:
        spec: the specification.
        problem: the study.
        options: of the command line, without dashes.

    Raises:
        SpecError: something was asked for that needs a free parameter; it is named.
    """
    if problem.free:
        return
    u = spec.uncertainty
    asked = {"profile": u.profile, "bootstrap": u.bootstrap, "posterior": u.posterior,
             "influence": u.influence}  # fmt: skip
    names = [f"--{name}" for name in options]
    names += [f"uncertainty.{name}" for name, wanted in asked.items() if wanted]
    if names:
        raise SpecError(
            f"{', '.join(names)}: every parameter is fixed, so that there is no estimate to be "
            "doubted; leave it out (the model is then evaluated), or free a parameter"
        )


def candidates_of(spec: FitSpec, problem: Problem) -> Candidates:
    """The presses of the [design] section; left out: first to last ring, half to full depth.

    Raises:
        SpecError: positions outside the tube, or unknowns that a new curve would not share.
    """
    try:
        check(problem)
    except ValueError as error:
        raise SpecError(f"parameters: {error}") from None
    section, length = spec.design, float(problem.geometry.length)
    deepest = float(np.max(problem.lanes.displacement))
    rings = problem.geometry.ring_positions
    s = (float(rings[0]), float(rings[-1])) if section.s is None else section.s
    if s[0] < 0 or s[1] > length:
        raise SpecError(
            f"design.s: {s[0]:g} to {s[1]:g} mm, tube spans 0 to {length:g} mm; give places on it"
        )
    depth = (0.5 * deepest, deepest) if section.depth is None else section.depth
    return grid(s, depth, section.candidates)


def settings_of(spec: FitSpec) -> Settings:
    """Solver settings of the [fit] section; `chunk` is its upper bound if left to the machine."""
    f = spec.fit
    limits = Tolerances(f.tolerance, f.tolerance, f.tolerance, f.max_iterations)
    return Settings(
        method=f.method,
        starts=f.starts,
        decades=f.start_decades,
        seed=f.seed,
        more_starts=f.more_starts,
        chunk=MOST_SEATS if f.chunk == "auto" else f.chunk,
        tolerances=limits,
        float32=f.precision == "float32",
    )
