"""The loading rule: segments of a record, the samples it takes, and what is told of the rest."""

import dataclasses

import numpy as np

from jaxtrachea.measurements.curve import Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.plausible import implausible_size, retracting
from jaxtrachea.measurements.record_faults import Faults, faults
from jaxtrachea.measurements.segments import JITTER, NoLoading, Segments, segment
from jaxtrachea.measurements.usage import CHOOSING, Usage, lasting, usage
from jaxtrachea.measurements.whole_record import check_clock, remarks_of


def usage_of(
    raw: RawCurve,
    displacement: np.ndarray,
    force: np.ndarray,
    keep: np.ndarray,
    found: Segments | None,
    options: ReadOptions,
    faulty: Faults,
) -> Usage:
    """What of the record is used, with a word on faults, and on sizes and signs hard to believe."""
    unit = "samples" if raw.time is None else "s"
    seen = usage(displacement, keep, found, options.loading, unit, faulty)
    taken = displacement[keep], force[keep]
    doubts = [said for said in (implausible_size(*taken), retracting(*taken)) if said is not None]
    if found is not None and raw.time is not None and options.loading in (*CHOOSING, "record"):
        whole = options.loading == "record"
        doubts += remarks_of(raw.time, displacement, found, whole=whole)
    return dataclasses.replace(seen, remarks=(*seen.remarks, *doubts)) if doubts else seen


def segments_of(
    raw: RawCurve, displacement: np.ndarray, force: np.ndarray, options: ReadOptions
) -> Segments | None:
    """Segments of the record; None if it only unloads and every sample is wanted all the same."""
    time = raw.time
    if options.loading == "all" and time is not None and (time[1:] < time[:-1]).any():
        time = None
    _check_time(raw, time)
    whole = options.loading == "record"
    if whole:
        check_clock(time)
    first = whole or options.loading in ("first", "loading")
    try:
        return segment(displacement, force, time, first=first)
    except NoLoading as error:
        if options.loading == "all":
            return None
        start, end = error.args
        falls = f"displacement falls from {start:.4g} to {end:.4g} mm"
        if force[-1] > force[0]:
            raise Fault(
                "non_monotone",
                f"{falls} while the force rises: it is counted the other way",
                "set displacement_sign = -1",
            ) from None
        raise Fault(
            "non_monotone",
            f"{falls}: an unloading branch",
            'give the loading branch, or use loading = "all"',
        ) from None


def _check_time(raw: RawCurve, time: np.ndarray | None) -> None:
    """Samples follow each other in time, where there is one."""
    if time is None:
        return
    back = np.flatnonzero(time[1:] < time[:-1])
    if back.size:
        at = int(back[0]) + 1
        again, cure = "", "put the samples in order"
        if time[at] <= time[1]:
            again = ", where a second record begins its own clock"
            cure = "give each record a trial of its own, put the samples in order"
        raise Fault(
            "time",
            f"time falls from {time[at - 1]:.6g} to {time[at]:.6g} s in"
            f" {raw.row_word} {raw.rows[at]}{again}",
            f'{cure}, or use loading = "all", which needs none',
        )


def selection(displacement: np.ndarray, found: Segments | None, options: ReadOptions) -> np.ndarray:
    """(N,) samples of the loading chosen, within the displacement window."""
    keep = np.ones(displacement.shape, dtype=bool)
    if found is not None and options.loading in CHOOSING:
        keep = found.keep
    if options.displacement_min is not None:
        keep = keep & (displacement >= options.displacement_min)
    if options.displacement_max is not None:
        keep = keep & (displacement <= options.displacement_max)
    return keep


def faults_of(
    displacement: np.ndarray, force: np.ndarray, found: Segments | None, options: ReadOptions
) -> Faults:
    """What is wrong with the record, of which the loading is looked at for a break or a flat top.

    With ``loading = "all"`` every sample is used all the same, and this is said.
    """
    if found is None:
        none = np.zeros(displacement.shape, bool)
        return Faults(none, none)
    within = selection(displacement, None, options)
    seen = faults(displacement, force, found.keep & within, found)
    if options.loading != "all" or not (seen.broken.any() or seen.saturated.any()):
        return seen
    remarks = (*seen.remarks, "every sample is used all the same, as loading = 'all' says")
    return Faults(np.zeros_like(within), np.zeros_like(within), remarks)


def check_one_loading(
    raw: RawCurve, displacement: np.ndarray, keep: np.ndarray, found: Segments | None
) -> None:
    """The samples kept only rise, but for jitter, and do not stand still at their peak."""
    if found is None:
        return
    # The scale of jitter is that of the whole recording, so a narrow window does not tighten it.
    jitter = max(JITTER * float(np.ptp(displacement)), found.tolerance)
    travel = found.direction * displacement[keep]
    rows, cure = raw.rows[keep], 'use loading = "last" for the last full loading'
    back = np.maximum.accumulate(travel) - travel
    if (back > jitter).any():
        at = rows[int(np.argmax(back > jitter))]
        raise Fault(
            "non_monotone",
            f"displacement turns back by {back.max():.4g} mm, first in {raw.row_word} {at};"
            f" up to {jitter:.2g} mm passes as jitter",
            cure + ', or "all" to keep every sample',
        )
    hold = found.hold
    if hold is not None and np.count_nonzero(keep[hold.start : hold.stop]) > 1:
        lasts = lasting(hold, "samples" if raw.time is None else "s")
        raise Fault(
            "non_monotone",
            f"displacement stands still at its peak for {lasts}, from {raw.row_word}"
            f" {raw.rows[hold.start]} on; the force falls by {100 * hold.relaxed:.2g} % in it",
            cure + " without the hold",
        )
