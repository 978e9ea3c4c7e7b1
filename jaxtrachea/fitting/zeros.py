"""Which curves have an onset, a force offset or a line of their own, by their own records.

A parameter that is `auto` is held at 0 unless the record of a curve shows that it is not
(`measurements.record_zeros`): then that curve alone has an unknown for it. A study in which no
record shows one has the same model as one that holds them. Bonded contact has no first touch that a
record could show: nothing is taken there.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.lanes import Taken
from jaxtrachea.fitting.parameters import DEFAULTS, OF_THE_PRESS, Parameter
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.record_zeros import CLEAR, LINE, Zeros, record_zeros
from jaxtrachea.mechanics.press import Options


@dataclasses.dataclass(frozen=True, eq=False)
class Resolved:
    """A parameter table of which every row is free or fixed, and what single curves take.

    Attributes:
        parameters: the table; free where at least one curve takes it.
        taken: of the free ones that are `auto`, by specimen and trial.
        zeros: what the records show, in the order of the curves; None: nobody looked.
        recorded: what of `taken` the records show; the rest was asked for.
    """

    parameters: tuple[Parameter, ...]
    taken: Taken
    zeros: Zeros | None
    recorded: Taken


def resolved(
    parameters: Sequence[Parameter],
    curves: Sequence[Curve],
    options: Options,
    sigma: float | None = None,
    asked: Taken | None = None,
    zeros: Zeros | None = None,
) -> Resolved:
    """The table with its `auto` rows decided.

    Args:
        sigma: given standard deviation of a force sample, N; a curve's own comes before it.
        asked: what curves take on top of what their records show (`omitted_zeros`).
        zeros: what the records show, as found before; None: they are looked at.

    Raises:
        InputError: a line is asked for and a curve has too few samples before first touch.
    """
    # A row that is free already, as in the table of another study, is so for every curve.
    parameters = [p if p.fixed else dataclasses.replace(p, auto=False) for p in parameters]
    table = _with_line(parameters, options)
    wanted = any(p.name == "force_slope" and not p.fixed for p in table)
    looked = options.contact == "unilateral" and any(p.auto and p.fixed for p in table)
    if not (wanted or looked):
        return Resolved(without_flat_line(table), {}, None, {})
    zeros = zeros_of(curves, sigma, table) if zeros is None else zeros
    if wanted:
        for curve, reason in zip(curves, without_line(curves, zeros), strict=True):
            if reason is not None:
                raise InputError.like(reason, place=_place(curve))
    others = any(not p.fixed and not p.auto for p in table)
    shown = {"onset": zeros.onset, "force_offset": zeros.force_offset}
    onset = next((p for p in table if p.name == "onset"), None)
    if onset is not None and onset.fixed and not onset.auto:  # then what looks like one is another
        shown["force_offset"] = zeros.force_offset | (zeros.onset & (zeros.air == 0))
        begins = shown["force_offset"] & (zeros.offset == 0)
        zeros = zeros._replace(offset=np.where(begins, zeros.first, zeros.offset))
    shown["force_slope"] = _sloping(curves, zeros)
    shown["force_offset"] = shown["force_offset"] | (wanted | shown["force_slope"])
    recorded: dict[tuple[str, str], set[str]] = {(c.specimen, c.trial): set() for c in curves}
    taken = {key: set(() if asked is None else asked.get(key, ())) for key in recorded}
    wanted_by_fits = set().union(*taken.values())
    out = []
    for p in table:
        some = p.name in wanted_by_fits or (p.name in shown and shown[p.name].any())
        if p.auto and p.fixed and others and some:
            p = dataclasses.replace(p, fixed=False)
            for k in np.flatnonzero(shown[p.name]).tolist():
                recorded[curves[k].specimen, curves[k].trial].add(p.name)
        out.append(p)
    taken = {key: taken[key] | recorded[key] for key in recorded}
    return Resolved(without_flat_line(out), taken, zeros, recorded)


def zeros_of(
    curves: Sequence[Curve], sigma: float | None = None, table: Sequence[Parameter] = ()
) -> Zeros:
    """What the records of curves show, from the onset and the force offset that a table holds.

    Args:
        curves: the curves.
        sigma: as for `resolved`.
        table: whose fixed onset and force offset, if any, are taken off the records first.
    """
    curves = [c.rising for c in curves]
    given = [sigma if c.sigma is None else float(np.median(c.sigma)) for c in curves]
    held = {p.name: p.value for p in table if p.fixed and not p.auto}
    onset, offset = held.get("onset", 0.0), held.get("force_offset", 0.0)
    records = _Records(
        [c.displacement - onset if onset else c.displacement for c in curves],
        [c.force - offset if offset else c.force for c in curves],
        np.array([np.nan if s is None else s for s in given]),
    )
    zeros = _beside_others(record_zeros(*records), curves, records)
    at_zero = np.where(zeros.force_slope, zeros.offset - zeros.slope * onset, zeros.offset)
    return zeros._replace(touch=zeros.touch + onset, offset=at_zero + offset)


class _Records(NamedTuple):
    """As `record_zeros` takes them."""

    displacement: list[np.ndarray]
    force: list[np.ndarray]
    sigma: np.ndarray


def _beside_others(zeros: Zeros, curves: Sequence[Curve], records: _Records) -> Zeros:
    """What records show beside the line of others of their specimen, where theirs is not clear.

    A line is of the rig. A record in which a rising force hides the touch shows it above that line.
    """
    specimen = np.unique([c.specimen for c in curves], return_inverse=True)[1].reshape(-1)
    out = Zeros(*map(np.array, zeros))
    for k in np.unique(specimen[zeros.force_slope]):
        slope = float(np.median(zeros.slope[(specimen == k) & zeros.force_slope]))
        rows = np.flatnonzero((specimen == k) & ~zeros.force_slope)
        level = [records.force[i] - slope * records.displacement[i] for i in rows]
        found = record_zeros([records.displacement[i] for i in rows], level, records.sigma[rows])
        seen = found.onset & (found.air >= LINE)
        for whole, values in zip(out, found._replace(slope=found.slope + slope), strict=True):
            whole[rows[seen]] = values[seen]
    return out


def without_line(curves: Sequence[Curve], zeros: Zeros) -> list[InputError | None]:
    """Why no line can be fitted to the force before first touch of each curve; None: it can."""
    cure = (
        "record more of the approach, leave the curve out, or take baseline = 'auto', which fits a "
        "line where the record shows one"
    )
    return [
        None if n >= LINE else InputError(
            f"no line can be fitted to the force before first touch: {n} samples lie before it",
            expected=f"{LINE} or more", cure=cure, place=_place(curve),
        )
        for curve, n in zip(curves, zeros.air.tolist(), strict=True)
    ]  # fmt: skip


def _place(curve: Curve) -> str:
    return f"specimen {curve.specimen!r} trial {curve.trial!r}"


def _with_line(parameters: Sequence[Parameter], options: Options) -> tuple[Parameter, ...]:
    """The table with a row for the line, where one may be taken: where the force offset may."""
    table = tuple(parameters)
    named = any(p.name == "force_slope" for p in table)
    offset = next((p for p in table if p.name == "force_offset"), None)
    if named or options.contact != "unilateral" or offset is None:
        return table
    return (*table, DEFAULTS["force_slope"]) if offset.auto else table


def without_flat_line(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """The table without a line that is held at 0: such a model has none."""
    return tuple(
        p for p in parameters if not (p.name == "force_slope" and p.fixed and p.value == 0)
    )


def _sloping(curves: Sequence[Curve], zeros: Zeros) -> np.ndarray:
    """Curves with a line: of specimens in which it is clear of one curve, or of all together.

    A line is of the rig. Where it is clear once, curves that are too noisy to show it have it too.
    """
    able = (zeros.air >= LINE) & np.isfinite(zeros.slope)
    error = np.where(able, zeros.slope_error, 1.0)
    z = np.where(able, np.nan_to_num(zeros.slope) / error, 0.0)
    names = np.unique([c.specimen for c in curves], return_inverse=True)[1].reshape(-1)
    count = np.maximum(np.bincount(names, able), 1)
    together = np.abs(np.bincount(names, z)) / np.sqrt(count) > CLEAR
    alone = np.bincount(names, zeros.force_slope) > 0
    return able & (together | alone)[names]


def starts_of(
    resolved: Resolved, groups: Sequence[Sequence[Curve]], curves: Sequence[Curve], trials: int
) -> Float[np.ndarray, "lanes T 3"] | None:
    """Onset, offset and slope that every curve shows; NaN where it does not take it; None: nobody.

    Args:
        resolved: from `resolved`.
        groups: curves of each lane.
        curves: in the order of `resolved`.
        trials: T.
    """
    zeros, free = resolved.zeros, {p.name for p in resolved.parameters if not p.fixed}
    auto = {p.name for p in resolved.parameters if p.auto and not p.fixed}
    if zeros is None or not free & {*auto, "force_slope"}:
        return None
    out = np.full((len(groups), trials, len(OF_THE_PRESS)), np.nan)
    row = {(c.specimen, c.trial): k for k, c in enumerate(curves)}
    shown = zeros.touch, zeros.offset, np.nan_to_num(zeros.slope)
    for lane, group in enumerate(groups):
        for t, curve in enumerate(group):
            key = curve.specimen, curve.trial
            for i, name in enumerate(OF_THE_PRESS):
                if name in resolved.recorded[key] or (
                    name == "force_slope" and name in free - auto
                ):
                    out[lane, t, i] = shown[i][row[key]]
    return None if np.isnan(out).all() else out
