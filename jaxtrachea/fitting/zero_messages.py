"""Sentences on what curves take, from their own records or fits: onset, force offset and line."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxtrachea.fitting.parameters import OF_THE_PRESS
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.zeros import zeros_of
from jaxtrachea.measurements.curve import Curve

#: Units of zeros that a table may hold at 0; a line that is held there is in no table.
UNITS = {"onset": "mm", "force_offset": "N"}
#: Curves named in a sentence; curves.csv holds all.
_NAMES = 4


@dataclasses.dataclass(frozen=True)
class FittedZeros:
    """What the record of a curve shows and what it takes of it; NaN: not taken.

    Attributes:
        curve: the curve.
        onset: displacement at first touch, mm.
        force_offset: force without contact at displacement 0, N.
        force_slope: of the force without contact, N/mm.
    """

    curve: Curve
    onset: float
    force_offset: float
    force_slope: float

    @property
    def loaded(self) -> bool:
        """Whether it begins under load, so that preload and offset look alike."""
        return self.onset <= float(self.curve.displacement.min())

    @property
    def name(self) -> str:
        """Specimen and trial."""
        return f"{self.curve.specimen} {self.curve.trial}"


def fitted_zeros(study: Study) -> list[FittedZeros]:
    """Curves that take something from their records, in the order of the lanes."""
    if study.record_zeros is None:
        return []
    rows = zip(study.curves, study.record_zeros, strict=True)
    every = [
        FittedZeros(c, *map(float, v))
        for lane, row in rows
        for c, v in zip(lane, row, strict=False)
    ]
    return [s for s in every if not np.isnan([s.onset, s.force_offset, s.force_slope]).all()]


def sentences(study: Study) -> list[str]:
    """What the curves of a study take from their records, and what was held against a record."""
    every, count = fitted_zeros(study), sum(map(len, study.curves))
    air = [s for s in every if not s.loaded]
    touched = [s for s in air if not np.isnan(s.onset)]
    out = _listed(
        touched, count, "onset", lambda s: f"{s.onset:.3g} mm",
        lambda s: f", from its record (no force over its first {_share(s):.0f} %)",
    )  # fmt: skip
    offset = [s for s in air if not np.isnan(s.force_offset) and np.isnan(s.force_slope)]
    out += _listed(
        offset, count, "force_offset", lambda s: f"{s.force_offset:.3g} N",
        lambda s: ", from its record",
    )  # fmt: skip
    sloping = [s for s in air if not np.isnan(s.force_slope)]
    out += _listed(
        sloping, count, "force_slope", lambda s: f"{s.force_slope:.3g} N/mm",
        lambda s: ", from its record",
    )  # fmt: skip
    if sloping:
        out[-1] += (
            ": a line is fitted to the force before first touch and taken off the whole record; "
            "where it is of the press itself, set data.baseline = 'none'"
        )
    return [*out, *_under_load([s for s in every if s.loaded], count), *_held(study)]


def asked_by_fits(study: Study, value: Float[np.ndarray, "lanes P"]) -> list[FittedZeros]:
    """Curves that take an onset or a force offset which their fits ask for, with the estimates."""
    shown = study.record_zeros
    column = {p.name: j for j, p in enumerate(study.parameters) if p.auto and not p.fixed}
    out = []
    for lane, curves in enumerate(study.curves):
        for t, curve in enumerate(curves):
            found = dict.fromkeys(OF_THE_PRESS, np.nan)
            for name in {"onset", "force_offset"} & column.keys():
                i = int(study.lanes.index[lane, t, column[name]])
                recorded = shown is not None and not np.isnan(
                    shown[lane, t, OF_THE_PRESS.index(name)]
                )
                if i >= 0 and not recorded:
                    found[name] = float(value[lane, i])
            if not np.isnan(list(found.values())).all():
                out.append(FittedZeros(curve, **found))
    return out


def sentences_of_fits(study: Study, value: Float[np.ndarray, "lanes P"]) -> list[str]:
    """What curves take because their fits ask for it; arguments as for `asked_by_fits`."""
    every, count = asked_by_fits(study, value), sum(map(len, study.curves))
    why = " (its record alone shows none, the fit is not explained without)"
    out = []
    for name, unit in (("onset", "mm"), ("force_offset", "N")):
        some = [s for s in every if not np.isnan(getattr(s, name))]
        out += _listed(
            some, count, name, lambda s, name=name, unit=unit: f"{getattr(s, name):.3g} {unit}",
            lambda s: f", from its fit{why}", "fits",
        )  # fmt: skip
    return out


def _share(s: FittedZeros) -> float:
    D = s.curve.displacement
    return 100 * max(s.onset - float(D.min()), 0.0) / float(np.ptp(D))


def _listed(
    some: Sequence[FittedZeros], count: int, what: str, value, more, source: str = "records"
) -> list[str]:
    """One sentence a curve of few, one for all of many."""
    if len(some) <= _NAMES:
        return [f"{what} of {s.name}: {value(s)}{more(s)}" for s in some]
    first = ", ".join(f"{s.name} {value(s)}" for s in some[:_NAMES])
    rest = len(some) - _NAMES
    return [
        f"{what} of {len(some)} of {count} curves, from their {source}: {first} and {rest} more "
        "(curves.csv)"
    ]


def _under_load(some: Sequence[FittedZeros], count: int) -> list[str]:
    """What is said of records that begin under load."""
    if not some:
        return []
    zeros = zeros_of([s.curve for s in some[:_NAMES]])
    rows = zip(some, zeros.first, zeros.noise, strict=False)
    first = ", ".join(
        f"{s.name} with {F:.3g} N, {abs(F) / noise:.0f} times its noise" for s, F, noise in rows
    )
    rest = f" and {len(some) - _NAMES} more (curves.csv)" if len(some) > _NAMES else ""
    several = len(some) > 1
    begin = f"{len(some)} of {count} curves begin" if several else "a curve begins"
    said = f"{begin} under load: {first}{rest}"
    return [
        f"{said}; a preload and an offset of the load cell look alike there, and both are fitted: "
        "where the displacement was zeroed at first touch, set parameters.onset = { fixed = 0 }; "
        "where the force was zeroed in air, set parameters.force_offset = { fixed = 0 }"
    ]


def _held(study: Study) -> list[str]:
    """Zeros that the specification holds at 0 where records show another."""
    curves = [c for lane in study.curves for c in lane]
    said = []
    for name, shown in zeros_against(study, curves).items():
        against = np.flatnonzero(np.isfinite(shown))
        if len(against):
            k = int(against[0])
            others = f" (and so do {len(against) - 1} others)" if len(against) > 1 else ""
            said.append(
                f"{name} is held at 0, where the record of {curves[k].specimen} {curves[k].trial} "
                f"shows {shown[k]:.3g} {UNITS[name]}{others}: leave parameters.{name} out"
            )
    return said


def zeros_against(study: Study, curves: Sequence[Curve]) -> dict[str, Float[np.ndarray, " C"]]:
    """What curves with air show of zeros that a study holds at 0, by name; NaN: nothing.

    Args:
        study: whose table it is.
        curves: of the study, or measured later.
    """
    if study.model.options.contact != "unilateral":
        return {}
    held = [
        p.name for p in study.parameters
        if p.name in UNITS and p.fixed and not p.auto and p.value == 0
    ]  # fmt: skip
    if not held:
        return {}
    zeros = zeros_of(curves)
    value = {"onset": zeros.touch, "force_offset": zeros.offset}
    return {n: np.where(getattr(zeros, n) & (zeros.air > 1), value[n], np.nan) for n in held}


def cells(study: Study) -> dict[tuple[str, str], dict[str, object]]:
    """Cells of curves.csv on what each curve takes from its record, by specimen and trial."""
    return {
        (s.curve.specimen, s.curve.trial): {
            f"{name}_from_record": value
            for name in OF_THE_PRESS
            if not np.isnan(value := getattr(s, name))
        }
        for s in fitted_zeros(study)
    }
