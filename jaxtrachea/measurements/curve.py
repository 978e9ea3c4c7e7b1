"""What a reader hands over: curves, what could not be used, and the errors in between."""

import dataclasses
import fnmatch
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Integer

from jaxtrachea._errors import InputError
from jaxtrachea.measurements.observed import OBSERVED
from jaxtrachea.measurements.roles import RING_ROLES, ROLES, is_role, role_dimension
from jaxtrachea.measurements.usage import Usage
from jaxtrachea.units import UnitError, parse_quantity, unit_factor


class DataError(InputError):
    """A whole file or study cannot be read; the message names file, place, expectation and cure."""


class Fault(Exception):
    """One curve cannot be used; becomes a `BadCurve`, or a `DataError` if it spoils the file."""

    def __init__(self, kind: str, message: str, cure: str) -> None:
        """Say what is wrong."""
        super().__init__(f"{message}; {cure}")
        self.kind, self.message, self.cure = kind, message, cure


@dataclass(frozen=True, eq=False)
class Curve:
    """One trial: force against displacement at one contact point, in mm, N, rad.

    Vectors in the plane of the section at the contact have two components: along the inward
    normal at `phi_c`, and along the circumference, towards growing phi ("side").

    Attributes:
        specimen: name of the specimen.
        trial: name of the trial, unique within the specimen.
        s_c: contact position along the centreline, mm; None if the file does not say.
        phi_c: contact angle from the anterior midline, rad.
        displacement: (N,) mm of the tool along `direction`, positive inward (press).
        force: (N,) N, component along `direction` of the force of the tool on the wall, positive
            resisting.
        sigma: (N,) N, standard deviation of each sample of the force, and of `side_force`, or None.
        joint_rings: (M,) 0-based ring index of each marker, or None.
        joint_displacement: (N, M) mm along the inward normal at `phi_c`, NaN where not observed, or
            None.
        source: file, and lines or group, it came from.
        usage: what of the record this is, or None if nobody says.
        direction: unit vector of the tool's displacement: components along the inward normal and
            along the circumference, without unit.
        side_force: (N,) N, component of the same force along `direction` turned by 90 degrees from
            the inward normal towards growing phi: for a press along the normal the force along the
            circumference. NaN where not observed, or None.
        joint_side_displacement: (N, M) mm of the markers of `joint_rings` along the circumference
            at `phi_c`, NaN where not observed, or None.
        end_rings: (K,) 0-based index of each ring whose ends are observed, or None.
        end_U: (N, K, 2) mm, displacement of the outer surface at the ring's end U, phi = -alpha:
            components y (anterior) and z (to the side of positive phi); NaN where not observed, or
            None.
        end_V: (N, K, 2) mm, likewise at the end V, phi = +alpha, or None.
        time: (N,) s of each sample, never falling but with ``loading = "all"``, or None.
        conditions: names and numbers that a file gives for the whole curve and that nothing reads
            (speed, temperature, cycle), as they stand there.
        rise: first sample of the first loading and first after it, where the curve is a whole
            record (``loading = "record"``); else None.
    """

    specimen: str
    trial: str
    s_c: float | None
    phi_c: float
    displacement: Float64[np.ndarray, " n"]
    force: Float64[np.ndarray, " n"]
    sigma: Float64[np.ndarray, " n"] | None = None
    joint_rings: Integer[np.ndarray, " m"] | None = None
    joint_displacement: Float64[np.ndarray, "n m"] | None = None
    source: str = ""
    usage: Usage | None = None
    direction: tuple[float, float] = (1.0, 0.0)
    side_force: Float64[np.ndarray, " n"] | None = None
    joint_side_displacement: Float64[np.ndarray, "n m"] | None = None
    end_rings: Integer[np.ndarray, " k"] | None = None
    end_U: Float64[np.ndarray, "n k 2"] | None = None
    end_V: Float64[np.ndarray, "n k 2"] | None = None
    time: Float64[np.ndarray, " n"] | None = None
    conditions: tuple[tuple[str, float], ...] = ()
    rise: tuple[int, int] | None = None

    @property
    def rising(self) -> "Curve":
        """The first loading of a whole record; else the curve itself."""
        if self.rise is None:
            return self
        part = slice(*self.rise)
        arrays = ("displacement", "force", "sigma", "time", *_OF_SAMPLES)
        cut = {n: v[part] for n in arrays if (v := getattr(self, n)) is not None}
        return dataclasses.replace(self, rise=None, **cut)


@dataclass(frozen=True)
class BadCurve:
    """What could not be used, one per (specimen, trial).

    Attributes:
        specimen: name of the specimen.
        trial: name of the trial.
        source: file, and lines or group, it came from.
        kind: short code: "empty", "too_few_points", "unparsable", "ragged", "column_missing",
            "ambiguous", "unit_missing", "unit_unknown", "shape", "non_finite", "bad_sigma",
            "position", "direction", "absurd_scale", "time", "non_monotone", "no_signal", "sign",
            "metadata_missing", "unreadable", "baseline".
        message: one line: file, place, what was found and what expected.
        cure: one line.
    """

    specimen: str
    trial: str
    source: str
    kind: str
    message: str
    cure: str

    @property
    def reason(self) -> str:
        """Kind, place, what is wrong and the cure, in one line."""
        place = "" if self.message.startswith(self.source) else f"{self.source}: "
        return f"{self.kind}: {place}{self.message}; {self.cure}"


@dataclass(frozen=True, eq=False)
class RawCurve:
    """A curve as a reader found it: units converted (mm, N, rad), nothing else checked or changed.

    `rows` numbers the samples for messages: lines of a text file, or samples counted from 1.
    `unused_columns` are the columns of a tidy table that have no role. `notes` say how it was read.
    """

    specimen: str
    trial: str
    source: str
    displacement: np.ndarray
    force: np.ndarray
    rows: np.ndarray
    row_word: str = "line"
    s: float | None = None
    phi: float | None = None
    sigma: np.ndarray | None = None
    joint_rings: np.ndarray | None = None
    joint_displacement: np.ndarray | None = None
    time: np.ndarray | None = None
    direction: tuple[float, ...] = (1.0, 0.0)
    side_force: np.ndarray | None = None
    joint_side_displacement: np.ndarray | None = None
    end_rings: np.ndarray | None = None
    end_U: np.ndarray | None = None
    end_V: np.ndarray | None = None
    unused_columns: tuple[str, ...] = ()
    conditions: tuple[tuple[str, float], ...] = ()
    notes: tuple[str, ...] = ()


#: "loading" means "first".
LOADINGS = ("last", "first", "loading", "record", "all", "require-monotone")
#: Fields of a curve that have a value for every sample, beside displacement, force, noise, time.
_OF_SAMPLES = tuple(q.name for q in OBSERVED if q.gaps)


@dataclass(frozen=True)
class ReadOptions:
    r"""How to read the files of one study.

    Attributes:
        format: "auto" (by content), or the name of one of `readers.READERS`.
        columns: role -> column name. Roles: specimen, trial, s, phi, displacement, force,
            side_force, sigma, time; of ring number 7 (counted from 1) ``joint_7`` and
            ``joint_7_side`` for the marker, ``end_U_7_y``, ``end_U_7_z``, ``end_V_7_y`` and
            ``end_V_7_z`` for the ends.
        units: role -> unit, for a file that names none; against what the file says, it is an error.
            ``joint`` stands for the markers of all rings, ``end`` for all ends.
        specimen: how a file name gives specimen and trial: a template ``"{specimen}_A{trial}"`` for
            the name without suffix, or a regular expression searched in the name, such as
            ``r"(?P<specimen>EF\d+_\w+T)_A(?P<trial>\d)"``. ``s`` and ``phi`` may be named
            too; their units then stand in `units`.
        s: position of all curves along the centreline as a quantity, ``"35 mm"``.
        phi: contact angle of all curves as a quantity, ``"30 deg"``.
        displacement_min: drop samples below, mm.
        displacement_max: drop samples above, mm.
        loading: "last" or "first" (that full loading, from its foot to its peak, without holds;
            "loading" is "first"), "record" (from rest before first touch to the end, with holds,
            cycles and unloading: needs time, and a model that relaxes), "all" (every sample) or
            "require-monotone" (a record that is more than one loading, or holds its peak, is bad).
        force_sign: -1 if the file counts the resisting force negative; it turns the whole force,
            `side_force` too.
        displacement_sign: -1 if the file counts inward displacement of the tool negative; it turns
            neither the markers nor the ends of the rings nor the direction.
        machine_compliance: of the rig (frame, load cell, grips), ``"0.05 mm/N"``: this times the
            force is taken off the displacement, both with their signs. Or a table of names of
            files, or patterns, to such quantities (the first that fits counts; a file that none
            fits is an error), for `read_measurements`.
        samples: of a whole record, to which it is averaged in blocks (even in ramps, growing in
            holds): about so many; None: all are kept.
        sheet: name of the sheet of a workbook that holds the table, or a pattern ("Trial *"), or
            several of them; of several sheets each is a trial. None: the first that is not hidden.
        min_points: fewest samples of a curve.
        max_displacement: largest plausible displacement, mm.
        min_range: smallest plausible range of displacement, mm.
        max_force: largest plausible force, N.

    Raises:
        ValueError: an option is none of the possible ones (`UnitError` for units).
    """

    format: str = "auto"
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    specimen: str | None = None
    s: str | None = None
    phi: str | None = None
    displacement_min: float | None = None
    displacement_max: float | None = None
    loading: str = "last"
    force_sign: int = 1
    displacement_sign: int = 1
    machine_compliance: str | Mapping[str, str] | None = None
    samples: int | None = None
    sheet: str | Sequence[str] | None = None
    min_points: int = 2
    max_displacement: float = 1000.0
    min_range: float = 1e-6
    max_force: float = 1e5

    def __post_init__(self) -> None:
        """Refuse what can never work before any file is opened."""
        _one_of("loading", self.loading, LOADINGS)
        _one_of("force_sign", self.force_sign, (1, -1))
        _one_of("displacement_sign", self.displacement_sign, (1, -1))
        for role in [*self.columns, *self.units]:
            if not is_role(role):
                table = "columns" if role in self.columns else "units"
                known = ", ".join(ROLES)
                raise ValueError(f"role {role!r} in {table}; expected one of {known}, {RING_ROLES}")
        if "joint" in self.columns:
            raise ValueError("columns: say which ring the marker is on, as in joint_7")
        if "end" in self.columns:
            raise ValueError("columns: say which end of which ring, and y or z, as in end_U_7_y")
        for role, unit in self.units.items():
            if role in ("specimen", "trial"):
                raise ValueError(f"units: {role} is a name and has no unit; remove it")
            _named(f"units.{role}", unit_factor, unit, role_dimension(role))
        window = self.displacement_min is not None or self.displacement_max is not None
        if self.loading == "record" and window:
            raise ValueError(
                "displacement_min and displacement_max take samples out of a record that remembers "
                'them; remove them, or use another loading than "record"'
            )
        if self.samples is not None and (self.samples < 20 or self.loading != "record"):
            raise ValueError(
                f'samples is {self.samples}; expected 20 or more, of records (loading = "record")'
            )
        if self.min_points < 2:
            raise ValueError(f"min_points must be at least 2, got {self.min_points}")
        low, high = self.displacement_min, self.displacement_max
        if low is not None and high is not None and not low < high:
            raise ValueError(f"displacement_min {low} mm must lie below displacement_max {high} mm")
        for name in ("max_displacement", "min_range", "max_force"):
            if not (getattr(self, name) > 0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        _ = self.s_mm, self.phi_rad, self.name_pattern
        given = self.machine_compliance
        table = {"": given} if given is None or isinstance(given, str) else given
        if not table:
            raise ValueError("machine_compliance names no file; remove it, or give a quantity")
        for name, value in table.items():
            _compliance(f"machine_compliance{name and f'.{name!r}'}", value)

    @property
    def s_mm(self) -> float | None:
        """Common position along the centreline, mm."""
        return None if self.s is None else _named("s", parse_quantity, self.s, "length")

    @property
    def phi_rad(self) -> float | None:
        """Common contact angle, rad."""
        return None if self.phi is None else _named("phi", parse_quantity, self.phi, "angle")

    @property
    def compliance_mm_N(self) -> float:
        """Compliance of the rig, mm/N; of a table of files see `of_file`.

        Raises:
            ValueError: `machine_compliance` is a table.
        """
        given = self.machine_compliance
        if isinstance(given, Mapping):
            raise ValueError("machine_compliance is a table of files; take of_file(path) first")
        return _compliance("machine_compliance", given)

    def of_file(self, path: Path) -> "ReadOptions":
        """The options with the compliance of one file.

        Raises:
            DataError: `machine_compliance` is a table that does not name the file.
        """
        table = self.machine_compliance
        if table is None or isinstance(table, str):
            return self
        for pattern, value in table.items():
            if fits(pattern, path):
                return dataclasses.replace(self, machine_compliance=value)
        raise DataError(
            f"machine_compliance names {', '.join(map(repr, table))}, not this file",
            place=str(path),
            cure=f"add {path.name!r}, or '*' for all other files",
        )

    @property
    def name_pattern(self) -> re.Pattern | None:
        """`specimen` as a regular expression to search in a file name."""
        if self.specimen is None:
            return None
        text = self.specimen
        if "(?P<" not in text:
            parts = re.split(r"\{(\w+)\}", text)
            parts = [f"(?P<{p}>.+?)" if i % 2 else re.escape(p) for i, p in enumerate(parts)]
            text = "^" + "".join(parts) + r"(?:\.\w+)?(?:\.gz)?$"
        try:
            pattern = re.compile(text)
        except re.error as error:
            raise ValueError(
                f"specimen pattern {self.specimen!r} is no regular expression: {error}; correct it,"
                ' or write a template "{specimen}_A{trial}"'
            ) from None
        if "specimen" not in pattern.groupindex:
            raise ValueError(
                f"specimen pattern {self.specimen!r} names no specimen: write it as a template"
                ' "{specimen}_A{trial}" or with a group (?P<specimen>...)'
            )
        return pattern


def fits(pattern: str, path: Path) -> bool:
    """Whether a file has this name, or one of this pattern, with or without its folders."""
    return fnmatch.fnmatchcase(path.name, pattern) or path.match(pattern)


def _compliance(key: str, value: str | None) -> float:
    """A compliance of 0 or more, mm/N."""
    if value is None:
        return 0.0
    number = _named(key, parse_quantity, value, "compliance")
    if not 0 <= number < math.inf:
        raise ValueError(f"{key} is {value!r}; expected a finite compliance, 0 or more")
    return number


def _named(key: str, convert: Callable, *arguments: object) -> Any:
    """`convert(*arguments)`, with the key before what it refuses."""
    try:
        return convert(*arguments)
    except UnitError as error:
        raise UnitError(f"{key}: {error}") from None


def _one_of(name: str, value: object, allowed: tuple) -> None:
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(str, allowed))}, got {value!r}")
