"""Relaxation times of a fit against the times that its records tell anything about.

A branch that fades within a sample is a stiffness of no time, and one that outlasts the record is
a spring: strength and time of neither are estimates, however small their local errors.
"""

from typing import Any

import numpy as np

from jaxtrachea.fitting.relaxing import span_of
from jaxtrachea.relaxation.laws import LAWS, OF_SKELETON, Span

#: Longest record over shortest step from which a power of time is told.
LEAST_SPAN = 10.0


def _product(name: str) -> tuple[str, ...]:
    """Names of the numbers whose product is the time of the branch that a number belongs to."""
    base = name.removesuffix(OF_SKELETON)
    part = name[len(base) :]
    kind, _, number = base.rpartition("_")
    if kind not in ("gamma", "tau_ratio", "tau"):
        return ()
    ratios = (f"tau_ratio_{b}{part}" for b in range(2, int(number) + 1))
    return (f"tau_1{part}", *ratios)


def unsampled_time(result: Any, lane: int, i: int) -> str:
    """Why the branch of an unknown is no estimate, in words; "": it is, or there is no branch.

    Its time, with the 95 % interval, has to lie between the least step of the samples and the
    longest record. The density `C` of `fung` is an estimate where times from tau_1 to tau_2 surely
    lie there, and the numbers of `power` where the records span a decade of time.
    """
    model, (unknown, specimen, trial) = result.study.model, result.study.unknowns[lane][i]
    if not model.relaxes:
        return ""
    base, law = unknown.name.removesuffix(OF_SKELETON), model.options.branches
    part = unknown.name[len(base) :]
    if base not in LAWS[law].names:
        return ""
    curves = [
        c
        for c in result.study.curves[lane]
        if c.specimen == (specimen or c.specimen) and c.trial == (trial or c.trial)
    ]
    span = span_of(curves)
    if law == "power":
        if span.longest >= LEAST_SPAN * span.shortest:
            return ""
        return f"a power of time needs a decade; the records tell {_times(span)}"

    def interval(*names):
        return _interval(result, lane, names, (specimen, trial))

    if base == "C":
        first, last = interval(f"tau_1{part}"), interval(f"tau_2{part}")
        if first[1] <= span.longest and last[0] >= span.shortest:
            return ""
        box = f"tau_1{part} to tau_2{part}"
        return f"{box} may lie beyond what the records tell, {_times(span)}"
    whole = (unknown.name,) if law == "fung" else _product(unknown.name)
    low, high = interval(*whole)
    number = len(whole) if law != "fung" else int(base[-1])
    called = f"tau_{number}{part}"
    if high > span.longest:
        to = f"up to {high:.3g} s" if np.isfinite(high) else "without limit"
        return f"the record is shorter than {called}: {span.longest:.3g} s, {called} {to}"
    if low < span.shortest:
        step = f"{span.shortest:.3g} s"
        return f"samples are further apart than {called}: {step}, {called} down to {low:.3g} s"
    return ""


def _times(span: Span) -> str:
    return f"{span.shortest:.3g} to {span.longest:.3g} s"


def _interval(
    result: Any, lane: int, names: tuple[str, ...], of: tuple[str, str]
) -> tuple[float, float]:
    """95 % interval of a product of numbers, some of which may be held."""
    log, slope = 0.0, np.zeros(result.theta.shape[1])
    places = {
        (p.name, specimen, trial): (i, p)
        for i, (p, specimen, trial) in enumerate(result.study.unknowns[lane])
    }
    held = {p.name: p.value for p in result.study.parameters}
    for name in names:
        found = next((v for key, v in places.items() if key == (name, *of)), None)
        found = found or next((v for key, v in places.items() if key[0] == name), None)
        if found is None:
            log += np.log(held[name])
            continue
        i, p = found
        value = float(result.value[lane, i])
        log += np.log(value)
        slope[i] = 1.0 if p.scale == "log" else p.step / value
    variance = float(slope @ result.uncertainty.covariance[lane] @ slope)
    half = float(result.uncertainty.half_width[lane] * result.effective.growth[lane])
    half = half * np.sqrt(variance) if variance > 0 else 0.0
    if not np.isfinite(half):
        return 0.0, np.inf
    with np.errstate(over="ignore"):
        return float(np.exp(log - half)), float(np.exp(log + half))
