"""Starts from which a lane in doubt may come to another minimum than its own.

Where the local law and the skeleton share the softness of a curve otherwise (`soft_starts`), and
where another skeleton has nearly the same compliances at the contacts (`twins`).
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.parameters import SKELETON
from jaxtrachea.fitting.residual import inputs
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.starts import box
from jaxtrachea.fitting.structure import positions, without_curves
from jaxtrachea.fitting.study import Study
from jaxtrachea.mechanics.force_law import coefficient, power
from jaxtrachea.optimisation.batching import batch_size, max_in_cache

#: Indentation over skeleton deflection, and its inverse, of the two starts.
SOFT = 19.0
#: Skeletons with the same compliances: how many are tried, and the grid they are looked for on
#: (half width in natural logarithms, points of each axis).
TWINS, TWIN_REACH, TWIN_POINTS = 3, 9.0, 41
#: Lanes whose grids are computed together.
TOGETHER = 32


def soft_starts(result: FitResult, lanes) -> list[Float[np.ndarray, "n P"]]:
    """The local law as the soft part of the curve's secant stiffness, then the skeleton as it."""
    study = result.study
    if not any(p.name in SKELETON for p in study.free) or study.model.options.coupling != "series":
        return []
    guess, low, high = box(study, 0.0)[0][lanes], study.lanes.lower, study.lanes.upper
    data = study.lanes
    seen = data.precision[lanes] > 0
    compliance = np.mean(
        _compliance(study, lanes, guess[:, None])[:, 0], axis=1, where=seen.any(axis=2)
    )
    force = np.where(seen, np.abs(data.force[lanes]), 0)
    deepest = np.argmax(force, axis=2)[..., None]
    peak = np.take_along_axis(force, deepest, 2)[..., 0]
    depth = np.abs(np.take_along_axis(np.asarray(data.displacement)[lanes], deepest, 2)[..., 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        stiffness = np.nanmedian(np.where(depth > 0, peak / depth, np.nan), axis=1)
        depth = np.nanmedian(np.where(depth > 0, depth, np.nan), axis=1)
    share = 1 / (1 + SOFT)
    out = []
    for of_skeleton in (share, 1 - share):
        k_1 = stiffness / (1 - of_skeleton)
        softer = of_skeleton / stiffness / compliance
        start = result.theta[lanes].copy()
        for n, lane in enumerate(lanes):
            for i, (p, _, _) in enumerate(study.unknowns[lane]):
                if p.name in SKELETON:
                    start[n, i] = guess[n, i] - np.log(softer[n])
                elif coefficient(p.name) == "k_1":
                    start[n, i] = p.to_scaled(max(k_1[n], 1e-300))
                elif coefficient(p.name):
                    local = (depth[n] * (1 - of_skeleton)) ** (power(p.name) - 1)
                    start[n, i] = p.to_scaled(0.1 * k_1[n] / local)
        out.append(np.clip(np.nan_to_num(start), low[lanes], high[lanes]))
    return out


def _compliance(study: Study, lanes, theta) -> Float[np.ndarray, "n points T"]:
    """Compliance at every trial of lanes, mm/N, each at many points; `theta` is (n, points, P).

    The program is as for all lanes of the study: it is called for a few at a time.
    """
    count, points, size = theta.shape
    bare = without_curves(study)
    read = bare.lanes._replace(others={})  # their motion is not asked for
    bare = dataclasses.replace(bare, lanes=read)
    # Of few points too: one program.
    batch = batch_size(TWIN_POINTS**2, max_in_cache(bare.bytes_per_lane))
    c = map_lanes(
        _felt_compliance, bare, theta.reshape(-1, size), batch=batch,
        rows=np.repeat(lanes, points), unoptimised=study.unoptimised(len(study.curves)),
    )  # fmt: skip
    return c.reshape(count, points, -1)


def _felt_compliance(model: FitModel, theta, lane: Lane):
    """Compliance at every trial of one lane, mm/N; (T,)."""
    return inputs(model, theta, lane).compliance


def twins(result: FitResult, lanes) -> list[Float[np.ndarray, "n P"]]:
    """Starts at other skeletons with nearly the same compliances, by a grid of EI_L and k_M.

    Local minima of the squared difference of ln c on the grid, the `TWINS` lowest of each lane;
    the estimate where there are fewer. None where the two are not both free.
    """
    study = result.study
    if not {"EI_L", "k_M"} <= {p.name for p in study.free}:
        return []
    lanes = np.asarray(lanes)
    out = np.repeat(result.theta[lanes][None], TWINS, axis=0)
    names = [[p.name for p, _, _ in study.unknowns[lane]] for lane in lanes]
    several = positions(study)[lanes] > 1
    rows = np.array([n for n in np.flatnonzero(several) if {"EI_L", "k_M"} <= {*names[n]}], int)
    for some in np.split(rows, range(TOGETHER, len(rows), TOGETHER)) if len(rows) else ():
        beam = np.array([[names[n].index(name) for name in ("EI_L", "k_M")] for n in some])
        best = result.theta[lanes[some]]
        axes = _axes(study, lanes[some], best, beam)
        change = _softer(study, lanes[some], best, beam, axes)
        observed = (study.lanes.precision[lanes[some]] > 0).any(axis=2)[:, None, None]
        misfit = np.sum(change**2, axis=3, where=observed)
        for n, unknowns, of_lane, ends in zip(some, beam, misfit, axes, strict=True):
            for k, cell in enumerate(_valleys(of_lane)[:TWINS]):
                i, j = divmod(int(cell), TWIN_POINTS)
                out[k, n, unknowns] = ends[0, i], ends[1, j]
    return list(out)


def _axes(
    study: Study, lanes, best: Float[np.ndarray, "n P"], beam: Int[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2 A"]:
    """Grids of logarithmic coordinates around estimates, inside the bounds, in equal steps."""
    here, middle = (lanes[:, None], beam), np.take_along_axis(best, beam, axis=1)
    low = np.maximum(study.lanes.lower[here], middle - TWIN_REACH)
    high = np.minimum(study.lanes.upper[here], middle + TWIN_REACH)
    return np.linspace(low, high, TWIN_POINTS, axis=-1)


def _softer(
    study: Study, lanes, best: Float[np.ndarray, "n P"], beam: Int[np.ndarray, "n 2"],
    axes: Float[np.ndarray, "n 2 A"],
) -> Float[np.ndarray, "n A A T"]:  # fmt: skip
    """Logarithm of the compliances on a grid of EI_L and k_M, over those of the estimates.

    Where nothing but these two resists, c(EI, k) = f(EI / k) / k: a line of EI / k tells the grid.
    """
    A = axes.shape[2]
    EI, k, step = axes[:, 0], axes[:, 1], axes[:, :, 1] - axes[:, :, 0]
    line = EI[:, :1] + step[:, :1] * np.arange(1 - A, A)
    along = _over_estimates(study, lanes, best, beam, line, np.repeat(k[:, :1], 2 * A - 1, axis=1))
    steps = A - 1 + np.arange(A)[:, None] - np.arange(A)
    out = along[:, steps] - (k - k[:, :1])[:, None, :, None]
    # The estimate is in the middle of a grid that no bound cuts: there the line must tell 0.
    told = np.abs(out[:, A // 2, A // 2]).max(axis=1) < 1e-9
    rest = np.flatnonzero(~(told & (np.abs(step[:, 0] - step[:, 1]) < 1e-9)))
    if len(rest):
        grid = np.repeat(EI[rest], A, axis=1), np.tile(k[rest], A)
        whole = _over_estimates(study, lanes[rest], best[rest], beam[rest], *grid)
        out[rest] = whole.reshape(len(rest), A, A, -1)
    return out


def _over_estimates(
    study: Study, lanes, best, beam, EI: Float[np.ndarray, "n m"], k: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n m T"]:
    """Logarithm of compliances with EI_L and k_M in place of the estimates, over theirs."""
    theta = np.repeat(best[:, None], 1 + EI.shape[1], axis=1)
    row = np.arange(len(lanes))
    theta[row, 1:, beam[:, 0]], theta[row, 1:, beam[:, 1]] = EI, k
    with np.errstate(divide="ignore", invalid="ignore"):
        c = np.log(_compliance(study, lanes, theta))
        return c[:, 1:] - c[:, :1]


def _valleys(misfit: Float[np.ndarray, "a b"]) -> Int[np.ndarray, " n"]:
    """Cells that are lower than all their neighbours, lowest first."""
    padded = np.pad(np.nan_to_num(misfit, nan=np.inf), 1, constant_values=np.inf)
    shape = misfit.shape
    around = [
        padded[1 + i : 1 + i + shape[0], 1 + j : 1 + j + shape[1]]
        for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
    ]  # fmt: skip
    cells = np.flatnonzero((misfit <= np.min(around, axis=0)).ravel())
    return cells[np.argsort(misfit.ravel()[cells])]
