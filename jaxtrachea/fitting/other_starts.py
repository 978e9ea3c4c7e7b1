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
from jaxtrachea.mechanics.force_law import coefficient, power
from jaxtrachea.optimisation.batching import batch_size, max_in_cache

#: Indentation over skeleton deflection, and its inverse, of the two starts.
SOFT = 19.0
#: Skeletons with the same compliances: how many are tried, and the grid they are looked for on
#: (half width in natural logarithms, points of each axis).
TWINS, TWIN_REACH, TWIN_POINTS = 3, 9.0, 41


def soft_starts(result: FitResult, lanes) -> list[Float[np.ndarray, "n P"]]:
    """The local law as the soft part of the curve's secant stiffness, then the skeleton as it."""
    study = result.study
    if not any(p.name in SKELETON for p in study.free) or study.model.options.coupling != "series":
        return []
    guess, low, high = box(study, 0.0)[0][lanes], study.lanes.lower, study.lanes.upper
    data = study.lanes
    seen = data.precision[lanes] > 0
    compliance = np.mean(
        _compliance(result, lanes, guess[:, None])[:, 0], axis=1, where=seen.any(axis=2)
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


def _compliance(result: FitResult, lanes, theta) -> Float[np.ndarray, "n points T"]:
    """Compliance at every trial of lanes, mm/N, each at many points; `theta` is (n, points, P).

    The program is as for all lanes of the result: it is called for each one.
    """
    study = result.study
    count, points, size = theta.shape
    bare = without_curves(study)
    read = bare.lanes._replace(others={})  # their motion is not asked for
    bare = dataclasses.replace(bare, lanes=read)
    # Of few points too: one program.
    batch = batch_size(TWIN_POINTS**2, max_in_cache(bare.bytes_per_lane))
    c = map_lanes(
        _felt_compliance, bare, theta.reshape(-1, size), batch=batch,
        rows=np.repeat(lanes, points), unoptimised=study.unoptimised(result.lanes),
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
    out = np.repeat(result.theta[lanes][None], TWINS, axis=0)
    several = positions(study) > 1
    for n, lane in enumerate(lanes):
        place = {p.name: i for i, (p, _, _) in enumerate(study.unknowns[lane])}
        if not {"EI_L", "k_M"} <= place.keys() or not several[lane]:
            continue
        low, high, best = (v[lane] for v in (study.lanes.lower, study.lanes.upper, result.theta))
        beam = [place["EI_L"], place["k_M"]]
        axes = [_axis(float(best[i]), float(low[i]), float(high[i])) for i in beam]
        mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        theta = np.repeat(best[None], len(mesh) + 1, axis=0)
        theta[1:, beam] = mesh
        observed = (study.lanes.precision[lane] > 0).any(axis=1)
        c = _compliance(result, [lane], theta[None])[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.log(c[1:] / c[0])[:, observed]
        misfit = np.sum(change**2, axis=1).reshape(*map(len, axes))
        for k, cell in enumerate(_valleys(misfit)[:TWINS]):
            out[k, n, beam] = mesh[cell]
    return list(out)


def _axis(middle: float, low: float, high: float) -> Float[np.ndarray, " n"]:
    """Grid of a logarithmic coordinate around the estimate, inside the bounds."""
    return np.linspace(max(low, middle - TWIN_REACH), min(high, middle + TWIN_REACH), TWIN_POINTS)


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
