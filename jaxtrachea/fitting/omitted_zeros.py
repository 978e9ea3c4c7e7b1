"""Onsets and force offsets that a record does not show, but the fit asks for.

Whether a curve takes an onset or a force offset is decided before the fit, by its record alone
(`zeros`). A soft beginning hides some air there, and the other parameters follow it: they come out
wrong, with narrow intervals. After the fit the model itself can tell. The score (Lagrange
multiplier) test asks whether the cost has a slope along a zero that is fixed (Rao 1948,
doi:10.1017/S0305004100023987; Breusch and Pagan 1980, doi:10.2307/2297111): with the derivative c
of the whitened residuals r by the zero, and M c what the Jacobian's columns leave of it,

    z^2 = (c^T M r)^2 / (c^T M B^2 M c) / s^2

is the fall of the sum of squares, in variances of the noise, that the zero promises. B are the
weights of the curves: the residuals of a short curve that weighs as much as long ones are so much
larger than the noise. s^2, and the independent samples that z^2 counts by (`effective`), are those
of the residuals that would be left, without B. Where these are still correlated, the model misses
the curve and a zero is not what it lacks.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrachea.fitting.cost import robust
from jaxtrachea.fitting.covariance import Uncertainty
from jaxtrachea.fitting.effective import CORRELATED, lag_correlation, share_independent
from jaxtrachea.fitting.force_share import with_found_shares
from jaxtrachea.fitting.lane import force_entries
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.result import OF_UNKNOWNS, FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.record_zeros import LEAST_NOISE, SHOWN, TOLD_APART

#: Probability by which chance asks for a zero, on each side: three standard errors of many samples.
#: Less than a record must show (`record_zeros.EVIDENCE`): no shape of the press is looked for here.
CHANCE = 0.00135
#: Zeros that are looked for.
ZEROS = ("onset", "force_offset")
#: Differences for derivatives, relative to the size of an unknown or of the press.
_STEP = 1e-5
#: Part of a column that others leave below which it is a combination of them.
_ALIKE = 1e-6
#: What products of whole columns may be rounded by.
_ROUNDING = 1e-3
#: Gauss-Newton steps, the first one included, after which residuals must not be correlated.
STEPS = 4
#: Lanes looked at together: of many, what they are looked at by takes more memory than all curves.
TOGETHER = 256
#: Number in `ZEROS` and trial, with the value that is promised, mm or N.
Chosen = dict[tuple[int, int], float]


class Asked(NamedTuple):
    """Zeros that fits ask for.

    Attributes:
        names: by specimen and trial.
        value: promised, mm or N; by specimen, trial and name.
    """

    names: dict[tuple[str, str], set[str]]
    value: dict[tuple[str, str, str], float]


class _Columns(NamedTuple):
    """Whitened residuals of lanes that may ask, and their derivatives.

    Attributes:
        lanes: of the result.
        residual: (n, T, m).
        unknowns: derivative by each unknown, 0 where it is not free; (n, P, T, m).
        zeros: by each of `ZEROS` of each trial, mm and N; (n, Z, T, m).
        balance: weight of each trial, which is in all of these; (n, T).
    """

    lanes: Int[np.ndarray, " n"]
    residual: Float[np.ndarray, "n T m"]
    unknowns: Float[np.ndarray, "n P T m"]
    zeros: Float[np.ndarray, "n Z T m"]
    balance: Float[np.ndarray, "n T"]


def asked_for(result: FitResult, among: Int[np.ndarray, " n"]) -> Asked:
    """Zeros of the curves of a fit that are fixed, `auto`, and not to be fixed by its residuals.

    Costs nothing where no zero is `auto`: bonded contact, or zeros that the user names. Else the
    model is evaluated once for each unknown, and twice, by the program of its residuals. A joint
    fit asks for none: what one lane lacks its shared unknowns spread over the residuals of all.

    Args:
        among: lanes that are looked at, in order.
    """
    able = able_zeros(result)
    lanes = among[able[among].any(axis=(1, 2))]
    out = Asked({}, {})
    for first in range(0, len(lanes) if result.study.size else 0, TOGETHER):
        _ask(result, lanes[first : first + TOGETHER], able, out)
    return out


def asking(study: Study, asked: Asked) -> Int[np.ndarray, " n"]:
    """Lanes of a study that ask for a zero."""
    each = [any((c.specimen, c.trial) in asked.names for c in lane) for lane in study.curves]
    return np.flatnonzero(each)


def _ask(result: FitResult, lanes: Int[np.ndarray, " n"], able, out: Asked) -> None:
    """Add what some lanes ask for."""
    columns = _columns(result, lanes, result.theta[lanes], result.study.take(lanes))
    may = np.flatnonzero(_may_ask(result, columns, able[lanes]))
    found = {n: v for n in may.tolist() if (v := _chosen(result, columns, n, able[lanes[n]]))}
    if not found:
        return
    chosen, columns = list(found.values()), _Columns(*(v[list(found)] for v in columns))
    for lane, names, fits in zip(
        columns.lanes, chosen, _fitting(result, columns, chosen), strict=True
    ):
        for (z, trial), value in names.items() if fits else ():
            curve = result.study.curves[lane][trial]
            out.names.setdefault((curve.specimen, curve.trial), set()).add(ZEROS[z])
            out.value[curve.specimen, curve.trial, ZEROS[z]] = value


def _fitting(result: FitResult, columns: _Columns, chosen: list[Chosen]) -> list[bool]:
    """Whether the residuals that zeros would leave are no longer correlated.

    By the linear model; where it says no, by a few Gauss-Newton steps, since air of a tenth of the
    press is far from none. A model that misses the curve anyway leaves them correlated.
    """
    lanes = columns.lanes
    study, theta = result.study.take(lanes), result.theta[lanes].copy()
    shift = np.zeros((len(ZEROS), *study.lanes.s_c.shape))
    good = np.zeros(len(lanes), bool)
    for turn in range(STEPS):
        if turn:
            later = study.lanes._replace(
                displacement=study.lanes.displacement - shift[0][..., None],
                force=study.lanes.force - shift[1][..., None],
            )
            columns = _columns(result, lanes, theta, dataclasses.replace(study, lanes=later))
        for n in np.flatnonzero(~good).tolist():
            places = list(chosen[n])
            J, C = _rows(columns, n, places)
            X = np.concatenate([J, C])
            size = np.maximum(np.linalg.norm(X, axis=1), 1e-300)
            r = columns.residual[n].ravel()
            if not np.isfinite(X).all() or not np.isfinite(r).all():
                continue
            step = -np.linalg.lstsq((X / size[:, None]).T, r, rcond=1e-10)[0] / size
            remaining = (r + step @ X) / _of_entries(columns, n)
            _, correlation = _unit(result, int(lanes[n]), remaining, len(places))
            good[n] = correlation <= CORRELATED
            theta[n] += step[: len(J)]
            for (z, t), v in zip(places, step[len(J) :], strict=True):
                shift[z, n, t] += v
        theta = np.clip(theta, study.lanes.lower, study.lanes.upper)
        if good.all():
            break
    return good.tolist()


def _rows(columns: _Columns, n: int, places) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the residual of lane n by the unknowns, and by the zeros of some curves."""
    J = columns.unknowns[n].reshape(len(columns.unknowns[n]), -1)
    C = np.zeros((len(places), *columns.residual[n].shape))
    for k, (z, t) in enumerate(places):
        C[k, t] = columns.zeros[n, z, t]
    return J, C.reshape(len(places), J.shape[1])


def _of_entries(columns: _Columns, n: int) -> Float[np.ndarray, " m"]:
    """Weight of its curve, of every entry of the residual of lane n."""
    return np.repeat(columns.balance[n], columns.residual.shape[2])


def able_zeros(result: FitResult) -> Bool[np.ndarray, "lanes Z T"]:
    """Zeros that curves have not taken and might, of lanes that have an estimate to be wrong."""
    study = result.study
    out = np.zeros((result.lanes, len(ZEROS), study.lanes.s_c.shape[1]), bool)
    if study.joint or study.model.options.contact != "unilateral":
        return out
    there = (study.lanes.precision > 0).any(axis=2)
    for z, name in enumerate(ZEROS):
        for j, p in enumerate(study.parameters):
            if p.name == name and p.auto:
                out[:, z] = there & (study.lanes.index[:, :, j] < 0)
    if out.any():
        out &= result.succeeded[:, None, None]
    return out


def _columns(result: FitResult, lanes: Int[np.ndarray, " n"], theta, study: Study) -> _Columns:
    """Residuals and derivatives of some lanes, by differences.

    Args:
        result: whose noise and free unknowns.
        lanes: which; n.
        theta: where; (n, P).
        study: of these lanes, as they are or with shifted records.
    """
    relative = result.relative[lanes]
    free = (study.lanes.active > 0) & ~result.at_bound[lanes]
    batch = study.batch_size(result.lanes, 256)  # as `predictions` has it: its program

    def values(study: Study, theta) -> np.ndarray:
        return map_lanes(
            residual_value, study, theta, batch=batch,
            unoptimised=study.evaluates_few(result.lanes),
        )  # fmt: skip

    base = values(study, theta)
    weight = _weights(result, lanes, base)

    def slope(study: Study, theta, step) -> np.ndarray:
        return (values(study, theta) - base) / step[..., None] * weight

    unknowns = np.zeros((len(lanes), study.size, *base.shape[1:]))
    for i in range(study.size):
        step = np.where(free[:, i], _STEP * relative[:, i], 1.0)
        moved = theta.copy()
        moved[:, i] += np.where(free[:, i], step, 0.0)
        unknowns[:, i] = slope(study, moved, step[:, None])
    # A tool that goes h less deep meets what one with an onset of h does.
    D = study.lanes.displacement
    step = _STEP * np.where(study.lanes.precision > 0, np.abs(D), 0).max(axis=2)
    step = np.where(step > 0, step, 1.0)
    later = study.lanes._replace(displacement=D - step[..., None])
    by_onset = slope(dataclasses.replace(study, lanes=later), theta, step)
    by_offset = np.zeros_like(base)
    N = D.shape[2]
    by_offset[..., :N] = study.lanes.precision * weight[..., :N]
    zeros = np.stack([by_onset, by_offset], axis=1)
    balance = np.asarray(study.lanes.balance, float)
    balance = np.where(balance > 0, balance, 1.0)
    return _Columns(lanes, base * weight, unknowns, zeros, balance)


def _weights(result: FitResult, lanes: Int[np.ndarray, " n"], value) -> np.ndarray:
    """What multiplies a residual: 1 / sigma, the weight of its curve, that of a robust loss."""
    study = result.study
    of_force = np.arange(value.shape[2]) < force_entries(study.lanes)
    scale = 1 / np.where(of_force, *np.split(result.whitened_sigma[lanes], 2, axis=1))
    weight = np.asarray(study.lanes.balance)[lanes][..., None] * scale[:, None]
    if study.model.loss == "linear":
        return weight
    size = jnp.asarray((value * scale[:, None]) ** 2)
    _, slope = robust(study.model.loss, size, study.model.loss_scale)
    return weight * np.sqrt(np.asarray(slope))


def _may_ask(result: FitResult, columns: _Columns, able) -> Bool[np.ndarray, " n"]:
    """Lanes of which one zero alone promises enough, were the residuals that it leaves independent.

    All at once: of most lanes that says no, as `_chosen` would.
    """
    r, J, C = columns.residual, columns.unknowns, columns.zeros
    JJ = np.einsum("nptm,nqtm->ntpq", J, J, optimize=True)
    Jr, JC = np.einsum("nptm,ntm->ntp", J, r), np.einsum("nztm,nptm->nztp", C, J, optimize=True)
    Cr, size = np.einsum("nztm,ntm->nzt", C, r), np.einsum("nztm,nztm->nzt", C, C)
    share = JC @ np.linalg.pinv(JJ.sum(axis=1), rcond=1e-14, hermitian=True)[:, None]

    def left(power: int):
        """Products of what the unknowns leave of a zero, with the residual and with itself.

        Trials count by a power of their weight; (n, Z, T) each.
        """
        a = columns.balance**power
        with_residual = a[:, None] * Cr - np.einsum("nztp,nsp,ns->nzt", share, Jr, a)
        both = np.einsum("nztp,npq,nztq->nzt", share, np.einsum("nt,ntpq->npq", a, JJ), share)
        return with_residual, a[:, None] * (size - 2 * np.sum(share * JC, axis=3)) + both

    (slope, own), (_, spread), (along, unweighted) = left(0), left(2), left(-2)
    usable = own > 0.5 * _ALIKE * size
    fall = slope**2 / np.where(usable, spread, np.inf)
    value = -slope / np.where(usable, own, np.inf)
    lanes = columns.lanes.tolist()
    beyond = np.array([_left(result, lane, 1) for lane in lanes])
    asked = np.array([_asked(result, lane, 1) for lane in lanes])
    square = np.einsum("ntm,nt->n", r**2, columns.balance**-2)[:, None, None]
    square = square + value * (2 * along + value * unweighted)
    unit = square / np.maximum(beyond, 1)[:, None, None]
    known = result.study.noise_known[lanes][:, None, None]
    unit = np.where(known, np.maximum(unit, 1), unit)
    enough = fall > (1 - _ROUNDING) * asked[:, None, None] * unit
    return np.any(able & enough, axis=(1, 2))


def _chosen(result: FitResult, columns: _Columns, n: int, able) -> Chosen:
    """Zeros that lane n of `columns` asks for, with their promised values.

    One after the other, the one that promises most first. Where the other zero of the same curve
    promises as much, within `TOLD_APART`, both are taken: nothing tells them apart.
    """
    lane = int(columns.lanes[n])
    r = columns.residual[n].ravel()
    places = [(int(z), int(t)) for z, t in np.argwhere(able)]
    J, C = _rows(columns, n, places)
    left = C - (C @ J.T) @ np.linalg.pinv(J @ J.T, rcond=1e-14, hermitian=True) @ J
    gram, slope = C @ left.T, left @ r
    weight = _of_entries(columns, n)
    spread = (left * weight**2) @ left.T
    size = np.sum(C * C, axis=1)
    usable = np.diag(gram) > _ALIKE * size
    chosen: list[int] = []
    while usable.any():
        fall, value = _promise(gram, slope, spread, chosen)
        possible = usable & _possible(result, lane, places, value)
        if not possible.any():
            break
        best = int(np.argmax(np.where(possible, fall, -np.inf)))
        now = [*chosen, best]
        step = np.linalg.solve(gram[np.ix_(now, now)], slope[now])
        unit, _ = _unit(result, lane, (r - step @ left[now]) / weight, len(now))
        if not fall[best] > _asked(result, lane, len(now)) * unit:
            break
        twins = [
            k for k, (_, t) in enumerate(places)
            if possible[k] and t == places[best][1] and (fall[best] - fall[k]) / unit < TOLD_APART
        ]  # fmt: skip
        chosen += twins
        usable[twins] = False
    if not chosen:
        return {}
    value = -np.linalg.lstsq(gram[np.ix_(chosen, chosen)], slope[chosen], rcond=1e-10)[0]
    return {places[k]: float(v) for k, v in zip(chosen, value, strict=True)}


def _promise(gram, slope, spread, chosen: list[int]):
    """Fall of the sum of squares by each zero beside the chosen ones, and its value.

    Args:
        gram: products of what the unknowns leave of the zeros; (K, K).
        slope: and of these with the residual; (K,).
        spread: as `gram`, each entry times the square of the weight of its curve; (K, K).
        chosen: numbers of those that are taken.
    """
    share = gram[:, chosen] @ np.linalg.pinv(gram[np.ix_(chosen, chosen)], hermitian=True)
    slope = slope - share @ slope[chosen]
    own = np.diag(gram) - np.sum(share * gram[:, chosen], axis=1)
    beside = spread[:, chosen]
    noise = np.diag(spread) - 2 * np.sum(share * beside, axis=1)
    noise = noise + np.sum((share @ beside[chosen]) * share, axis=1)
    usable = own > _ALIKE * np.diag(gram)
    return slope**2 / np.where(usable, noise, np.inf), -slope / np.where(usable, own, np.inf)


def _possible(result: FitResult, lane: int, places, value) -> Bool[np.ndarray, " K"]:
    """Whether a record may have such a zero: none before its first sample without a force there."""
    lanes, sigma = result.study.lanes, float(result.sigma[lane, 0])
    out = np.ones(len(places), bool)
    for k, (z, t) in enumerate(places):
        if ZEROS[z] == "onset":
            seen = np.flatnonzero(lanes.precision[lane, t] > 0)
            first = seen[np.argmin(lanes.displacement[lane, t, seen])]
            begins = abs(float(lanes.force[lane, t, first])) > SHOWN * sigma
            out[k] = value[k] > lanes.displacement[lane, t, first] or begins
    return out


def _asked(result: FitResult, lane: int, taken: int) -> float:
    """z^2 from which a zero is asked for; infinite with no sample left to judge it by."""
    from scipy.special import stdtrit  # only those whose fits may ask wait for it

    left = _left(result, lane, taken)
    if left < 1:
        return np.inf
    return float(stdtrit(np.inf if result.study.noise_known[lane] else left, 1 - CHANCE)) ** 2


def _left(result: FitResult, lane: int, taken: int) -> int:
    """Samples beyond the unknowns, zeros that were taken among them."""
    free = int(np.sum(result.study.lanes.active[lane] > 0))
    return int(result.samples[lane]) - free - taken


def _unit(result: FitResult, lane: int, r: Float[np.ndarray, " m"], taken: int):
    """Fall of the sum of squares that counts as one variance of independent noise.

    And the correlation of neighbours, 0 with too few.
    """
    study = result.study
    precision = study.lanes.precision[lane]
    variance = float(r @ r) / max(_left(result, lane, taken), 1)
    if study.noise_known[lane]:
        variance = max(variance, 1.0)
    # Residuals that are rounding ask for nothing: no model of a press is meant to be closer.
    peak = float(np.max(np.where(precision > 0, np.abs(study.lanes.force[lane]), 0)))
    variance = max(variance, (LEAST_NOISE * peak / max(float(result.sigma[lane, 0]), 1e-300)) ** 2)
    force = r.reshape(len(precision), -1)[:, : precision.shape[1]]
    force = np.where(precision > 0, force, np.nan)[None]
    pairs = np.sum(np.isfinite(force[..., 1:]) & np.isfinite(force[..., :-1]), axis=(1, 2))
    correlation = np.nan_to_num(lag_correlation(force))
    share = share_independent(correlation, np.maximum(pairs, 1))
    return variance / float(share[0]), float(correlation[0])


def near_estimates(
    result: FitResult, again: Study, asked: Asked, lanes: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n P"]:
    """The estimates of a fit, with what further zeros promise, as starts of its lanes with them."""
    out = np.full(again.lanes.lower.shape, np.nan)
    for row, (lane, unknowns) in enumerate(zip(lanes.tolist(), again.unknowns, strict=True)):
        before = {(p.name, *of): i for i, (p, *of) in enumerate(result.study.unknowns[lane])}
        for i, (p, specimen, trial) in enumerate(unknowns):
            j = before.get((p.name, specimen, trial))
            value = asked.value.get((specimen, trial, p.name), np.nan)
            if np.isnan(value) and j is not None:
                value = float(result.value[lane, j])
            if np.isfinite(value) and (value > 0 or p.scale != "log"):
                out[row, i] = p.to_scaled(value)
    return np.clip(out, again.lanes.lower, again.lanes.upper)


#: Fields of a result that are 0, not NaN, where a lane has fewer unknowns than others.
_ZERO = (
    "theta", "weakest_direction", "structural_null_space", "conditional_direction", "covariance",
    "null_space",
)  # fmt: skip


def merged(
    study: Study, result: FitResult, rows: Int[np.ndarray, " n"], new: FitResult | None
) -> FitResult:
    """A result in which some lanes are fitted with more unknowns, the others as they were.

    Args:
        study: of all lanes, with these unknowns.
        result: without them, of all lanes, or of all that are not in `rows`, in their order.
        rows: lanes of `new`.
        new: of these lanes; None where there are none.
    """
    lanes, before = len(study.unknowns), result.study
    if result.lanes < lanes:  # what stands in the place of `rows` is written over
        place = np.cumsum(~np.isin(np.arange(lanes), rows)) - 1
        before = before.take(place)
    else:
        place = np.arange(lanes)
    of_rows = before.take(rows) if new is None else new.study
    study = with_found_shares(study, before, rows, of_rows)

    def both(name, old, other):
        of_unknowns = old.ndim - 1 if name in Uncertainty._fields else int(name in OF_UNKNOWNS)
        more = [(0, 0)] * old.ndim
        for axis in range(1, 1 + of_unknowns):
            more[axis] = 0, study.size - old.shape[axis]
        blank = 0 if name in _ZERO or old.dtype == bool else -1 if old.dtype.kind == "i" else np.nan
        out = np.pad(old, more, constant_values=blank)[place]
        if other is not None:
            out[rows] = getattr(other, name)
        return out

    def every(names, old, other):
        return {n: both(n, getattr(old, n), other) for n in names}

    arrays = [f.name for f in dataclasses.fields(result)]
    arrays = [n for n in arrays if isinstance(getattr(result, n), np.ndarray)]
    records = {
        name: type(old)(**every(old._fields, old, None if new is None else getattr(new, name)))
        for name in ("criteria", "uncertainty")
        for old in [getattr(result, name)]
    }
    return dataclasses.replace(result, study=study, **every(arrays, result, new), **records)
