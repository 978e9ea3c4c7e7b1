"""From a fit specification to a problem: opens the files, names what is wrong, builds the lanes."""

import dataclasses
from pathlib import Path

from jaxtrachea.config import FitSpec, ParameterSection, SpecError, TracheaSection
from jaxtrachea.identify.fit import Settings
from jaxtrachea.identify.measurements import Measurements, ReadOptions, read_measurements
from jaxtrachea.identify.parameters import DEFAULTS, Parameter, in_model
from jaxtrachea.identify.problem import Noise, Problem, build
from jaxtrachea.identify.solve import Tolerances
from jaxtrachea.model import Options
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
        path = Path(pattern)
        base = Path(path.anchor) if path.is_absolute() else root
        relative = str(path.relative_to(path.anchor)) if path.is_absolute() else pattern
        try:
            matches = sorted(p for p in base.glob(relative) if p.is_file())
        except (ValueError, NotImplementedError) as error:
            raise SpecError(f"data.files.{i}: {pattern!r} is no usable path: {error}") from None
        if not matches:
            raise SpecError(
                f"data.files.{i}: {pattern!r} matches no file in {base}; "
                "check the name, or say where the data are with --data"
            )
        found.update(dict.fromkeys(matches))
    return list(found)


def read_data(spec: FitSpec, root: Path) -> Measurements:
    """Read all files of a specification.

    Raises:
        SpecError: no file, or reading options that contradict each other.
        DataError: a file that spoils the whole study.
    """
    d = spec.data
    names = {f.name for f in dataclasses.fields(ReadOptions)}
    try:
        options = ReadOptions(**{k: v for k, v in d.model_dump().items() if k in names})
    except ValueError as error:
        raise SpecError(f"data: {error}") from None
    return read_measurements(find_files(spec, root), options)


def geometry_of(section: TracheaSection) -> Geometry:
    """The tube of a [trachea] section.

    Raises:
        SpecError: impossible dimensions, with the key.
    """
    if section.length is None or section.rings is None:
        return table_1()
    rings = section.rings
    if not isinstance(rings, list):
        step = (rings.last - rings.first) / max(rings.count - 1, 1)
        rings = [rings.first + i * step for i in range(rings.count)]
    try:
        return Geometry.create(
            section.length,
            rings,
            radius=section.radius,
            half_angle=section.half_angle,
            ring_height=section.ring_height,
        )
    except ValueError as error:
        raise SpecError(f"trachea: {error}") from None


def parameters_of(spec: FitSpec, options: Options, *, joints: bool) -> tuple[Parameter, ...]:
    """The parameter table of the chosen model with the user's changes.

    Raises:
        SpecError: a parameter the model does not have, or values that contradict each other.
    """
    names = in_model(options, joints=joints)
    for name in spec.parameters:
        if name not in names:
            known = "not a parameter" if name not in DEFAULTS else "not seen by this model"
            raise SpecError(f"parameters.{name}: {known}; this model has {', '.join(names)}")
    # Unless asked for, a ring hardens like the ligament: k_3_ring is then k_3, not a parameter.
    names = [n for n in names if n != "k_3_ring" or n in spec.parameters]
    return tuple(_parameter(DEFAULTS[n], spec.parameters.get(n)) for n in names)


def _parameter(default: Parameter, section: ParameterSection | None) -> Parameter:
    if section is None:
        return default
    number = lambda v: parse_quantity(v, default.dimension) if isinstance(v, str) else float(v)  # noqa: E731
    key = f"parameters.{default.name}"
    try:
        if section.fixed is not None:
            return dataclasses.replace(default, value=number(section.fixed), fixed=True)
        changes = {"fixed": False}
        if section.initial is not None:
            changes["value"] = number(section.initial)
        if section.bounds is not None:
            changes["lower"], changes["upper"] = map(number, section.bounds)
        for name in ("scale", "scope"):
            if getattr(section, name) is not None:
                changes[name] = getattr(section, name)
        if section.bounds is None and section.scale == "log" and default.lower <= 0:
            changes["lower"] = 1e-9
        if section.bounds is not None and section.initial is None:
            inside = min(max(default.value, changes["lower"]), changes["upper"])
            changes["value"] = inside
        return dataclasses.replace(default, **changes)
    except ValueError as error:
        raise SpecError(f"{key}: {str(error).removeprefix(default.name + ': ')}") from None


def problem_of(spec: FitSpec, measurements: Measurements) -> Problem:
    """Everything together.

    Raises:
        SpecError: with the key, or the specimen and trial, that cannot be used.
    """
    options = Options(**spec.model.model_dump())
    curves = measurements.curves
    joints = any(c.joint_displacement is not None for c in curves)
    known = lambda v: None if v == "estimate" else v  # noqa: E731
    noise = Noise(known(spec.noise.force), known(spec.noise.joints))
    for name in ("force", "joints"):
        sigma = getattr(noise, name)
        if sigma is not None and not sigma > 0:
            raise SpecError(f"noise.{name}: {sigma:g} is not a positive standard deviation")
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
        )
    except SpecError:
        raise
    except ValueError as error:
        raise SpecError(str(error)) from None


def settings_of(spec: FitSpec) -> Settings:
    """Solver settings of the [fit] section."""
    f = spec.fit
    limits = Tolerances(f.tolerance, f.tolerance, f.tolerance, f.max_iterations)
    return Settings(
        method=f.method,
        starts=f.starts,
        decades=f.start_decades,
        seed=f.seed,
        chunk=f.chunk,
        tolerances=limits,
        float32=f.precision == "float32",
    )
