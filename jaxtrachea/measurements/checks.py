"""The checks every curve passes, whatever its file: sign, loading branch, window, plausibility."""

import dataclasses
import math

import numpy as np

from jaxtrachea.measurements.curve import BadCurve, Curve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.loading import (
    check_one_loading,
    faults_of,
    segments_of,
    selection,
    usage_of,
)
from jaxtrachea.measurements.machine import without_machine
from jaxtrachea.measurements.observed import OBSERVED
from jaxtrachea.measurements.segments import Segments
from jaxtrachea.measurements.vectors import (
    check_vector_shapes,
    check_vector_sizes,
    listed,
    unit_direction,
    vectors_of,
)
from jaxtrachea.measurements.whole_record import (
    averaged,
    averaged_noise,
    block_edges,
    check_rest,
    kept,
    rise_of,
)

#: Positions that differ by less, mm and rad, are one: a stage of the rig stands no steadier.
POSITION_TOLERANCE = {"s": 0.05, "phi": 1e-3}
#: Below this correlation of force with displacement a curve has its force upside down.
MIN_CORRELATION = -0.5


def finish(raw: RawCurve, options: ReadOptions) -> Curve | BadCurve:
    """Turn what a reader found into a usable curve, or into the reason why it is none.

    Order: shapes, finite numbers, position, direction, signs, plausible size, compliance of the
    machine, number of points and their range, segments, faults of the record, displacement window,
    number of points left and their range, monotone displacement (where required), signal.

    Args:
        raw: the curve as read, in mm, N, rad.
        options: signs, loading rule, window and limits.

    Returns:
        The curve with its own float64 arrays, or a `BadCurve`.
    """
    try:
        return _finish(raw, options)
    except Fault as fault:
        return bad(raw.specimen, raw.trial, raw.source, fault)


def bad(specimen: str, trial: str, source: str, fault: Fault) -> BadCurve:
    """The record of a fault, its message headed by the place and kept on one line."""
    message = " ".join(f"{source}: {fault.message}".split())
    return BadCurve(specimen, trial, source, fault.kind, message, fault.cure)


def _finish(raw: RawCurve, options: ReadOptions) -> Curve:
    _check_shapes(raw)
    _check_finite(raw)
    check_vector_sizes(raw, options)
    s_c = position("s", raw.s, options.s_mm, "mm")
    phi_c = position("phi", raw.phi, options.phi_rad, "rad") or 0.0
    if abs(phi_c) > 2 * math.pi:
        raise Fault(
            "absurd_scale", f"phi is {phi_c:g} rad, more than a turn", "is its unit deg, not rad?"
        )
    direction = unit_direction(raw)
    displacement = options.displacement_sign * raw.displacement
    force = options.force_sign * raw.force
    _check_scale(raw, displacement, force, options)
    displacement = without_machine(displacement, force, options.compliance_mm_N)
    _check_amount(np.ones(displacement.shape, bool), displacement, options)
    found = segments_of(raw, displacement, force, options)
    faulty = faults_of(displacement, force, found, options)
    whole = found if options.loading == "record" else None
    flawed = faulty.broken | faulty.saturated
    if whole is None:
        keep = selection(displacement, found, options) & ~flawed
    else:
        check_rest(displacement, force, whole)
        keep = kept(flawed)
    _check_amount(keep, displacement, options)
    if options.loading == "require-monotone":
        check_one_loading(raw, displacement, keep, found)
    _check_signal(displacement[keep], force[keep])
    curve = Curve(
        specimen=raw.specimen,
        trial=raw.trial,
        s_c=s_c,
        phi_c=float(phi_c),
        displacement=np.ascontiguousarray(displacement[keep], dtype=np.float64),
        force=np.ascontiguousarray(force[keep], dtype=np.float64),
        sigma=None if raw.sigma is None else raw.sigma[keep].astype(np.float64),
        source=raw.source,
        usage=usage_of(raw, displacement, force, keep, found, options, faulty),
        direction=direction,
        time=None if raw.time is None else raw.time[keep].astype(np.float64),
        conditions=raw.conditions,
        **vectors_of(raw, keep, options),
    )
    return curve if whole is None else _as_it_went(curve, whole, options.samples)


def _as_it_went(curve: Curve, found: Segments, samples: int | None) -> Curve:
    """A whole record with its first loading, averaged in blocks where it is longer."""
    size = len(curve.force)
    start, stop = rise_of(found, size)
    if samples is None or size <= samples:
        return dataclasses.replace(curve, rise=(start, stop))
    assert curve.time is not None
    edges = block_edges(found, curve.displacement, curve.time, samples)
    arrays = ("displacement", "force", "time", *(q.name for q in OBSERVED if q.gaps))
    changed = {n: averaged(v, edges) for n in arrays if (v := getattr(curve, n)) is not None}
    if curve.sigma is not None:
        changed["sigma"] = averaged_noise(curve.sigma, edges)
    rise = (int(np.searchsorted(edges, start)), int(np.searchsorted(edges, stop)))
    usage = curve.usage
    if usage is not None:
        said = f"averaged to {len(edges)} samples"
        usage = dataclasses.replace(usage, remarks=(*usage.remarks, said))
    return dataclasses.replace(curve, rise=rise, usage=usage, **changed)


def _check_shapes(raw: RawCurve) -> None:
    n = raw.displacement.shape
    if len(n) != 1 or raw.force.shape != n or (raw.sigma is not None and raw.sigma.shape != n):
        sigma = "" if raw.sigma is None else f", sigma {raw.sigma.shape}"
        raise Fault(
            "shape",
            f"displacement has shape {n}, force {raw.force.shape}{sigma};"
            " expected one value per sample in each",
            "store vectors of one length",
        )
    if n[0] == 0:
        raise Fault("empty", "there are no samples", "remove the curve or export it again")
    if raw.time is not None and raw.time.shape != n:
        raise Fault("shape", f"time has shape {raw.time.shape}, displacement {n}", "store both")
    check_vector_shapes(raw)


def _check_finite(raw: RawCurve) -> None:
    columns = {"displacement": raw.displacement, "force": raw.force, "sigma": raw.sigma}
    columns["time"] = raw.time
    for name, values in columns.items():
        if values is not None and not np.isfinite(values).all():
            rows = raw.rows[~np.isfinite(values)]
            raise Fault(
                "non_finite",
                f"{name} is empty, NaN or infinite in {listed(rows, raw.row_word)}",
                "remove these samples from the file: no sample is used without it",
            )
    if raw.sigma is not None and not (raw.sigma > 0).all():
        raise Fault(
            "bad_sigma",
            f"sigma is not positive in {listed(raw.rows[~(raw.sigma > 0)], raw.row_word)}",
            "give the standard deviation of the force, or no sigma at all",
        )


def position(
    name: str,
    own: float | None,
    common: float | None,
    unit: str,
    places: tuple[str, str] = ("file", "options"),
) -> float | None:
    """Position of the curve from two places, as the file and the options, which must agree.

    Args:
        name: "s" or "phi".
        own: from the first place, mm or rad.
        common: from the second, mm or rad.
        unit: for messages.
        places: the same.

    Raises:
        Fault: they differ, or one is not finite or absurd ("position").
    """
    for value in (own, common):
        if value is not None and not abs(value) <= 1e5:
            raise Fault("position", f"{name} is {value:g} {unit}", "give a finite position")
    if own is None or common is None:
        return common if own is None else own
    if abs(own - common) > POSITION_TOLERANCE[name]:
        raise Fault(
            "position",
            f"{name} is {own:g} {unit} in the {places[0]} but {common:g} {unit} in the {places[1]}",
            f"remove {name} from the {places[1]} if the {places[0]} is right",
        )
    return own


def _check_scale(
    raw: RawCurve, displacement: np.ndarray, force: np.ndarray, options: ReadOptions
) -> None:
    limits = (
        ("displacement", displacement, options.max_displacement, "mm"),
        ("force", force, options.max_force, "N"),
    )
    for name, values, limit, unit in limits:
        worst = int(np.argmax(np.abs(values)))
        if abs(values[worst]) > limit:
            raise Fault(
                "absurd_scale",
                f"{name} reaches {values[worst]:.4g} {unit} in {raw.row_word} {raw.rows[worst]};"
                f" at most {limit:g} {unit} is plausible",
                f"check the unit of the {name} (in Python also ReadOptions(max_{name}=...))",
            )


def _check_amount(keep: np.ndarray, displacement: np.ndarray, options: ReadOptions) -> None:
    if keep.sum() < options.min_points:
        left = "" if keep.all() else f" of {keep.size} after choosing branch and window"
        raise Fault(
            "too_few_points",
            f"{keep.sum()} samples{left}, expected at least {options.min_points}",
            "record more samples, or widen displacement_min and displacement_max",
        )
    extent = float(np.ptp(displacement[keep]))
    if extent < options.min_range:
        raise Fault(
            "absurd_scale",
            f"displacement covers {extent:.4g} mm; at least {options.min_range:g} mm is plausible",
            "check the unit of the displacement (in Python also ReadOptions(min_range=...))",
        )


def _check_signal(displacement: np.ndarray, force: np.ndarray) -> None:
    if np.ptp(force) == 0:
        raise Fault(
            "no_signal",
            f"force is {force[0]:g} N in every sample",
            "check that the load cell was connected and the right column read",
        )
    # Scaled to unit range first: the squares of tiny forces would underflow.
    scaled = (displacement / np.ptp(displacement), force / np.ptp(force))
    if np.corrcoef(*scaled)[0, 1] < MIN_CORRELATION:
        raise Fault(
            "sign",
            "force falls while displacement grows; inward displacement and resisting force count"
            " positive",
            "use force_sign = -1 or displacement_sign = -1 as the file counts them",
        )
