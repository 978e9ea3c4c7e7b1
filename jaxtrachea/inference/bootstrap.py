"""Bootstrap: the estimate repeated on data as they might have come out, all in batched fits.

`parametric`: model at the estimate plus normal noise of the fitted or given sigma. `residual`: plus
residuals drawn with replacement from the same curve, centred and enlarged by sqrt(n / (n - P))
(Efron and Tibshirani 1993, ch. 9); in blocks of neighbouring samples, wrapped around the end, where
the noise is correlated along the curve (Kuensch 1989, doi:10.1214/aos/1176347265). All markers of a
sample are drawn together.

Centred residuals of a curve sum to zero, so that a block has less spread the more of its curve it
is: the sum of b of n white ones has the variance b (1 - b / n) sigma^2. Residuals drawn in blocks
b_1, b_2, ... (the last one cut) are enlarged by sqrt((1 - 1 / n) / (1 - sum b_k^2 / n^2)), which
makes up for it where the derivatives by the unknowns change little within a block; by no more than
for blocks of half a curve.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lane import Lane, Observed, forces, markers, with_observed
from jaxtrachea.fitting.predictions import Prediction, predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.batching import copied_at_once

Kind = Literal["parametric", "residual"]
#: Replicates below which the ends of a 95 % interval are not read off.
FEWEST = 40
#: Blocks to a curve below which errors are rough, which is said.
FEW_BLOCKS = 10


@dataclasses.dataclass(frozen=True, eq=False)
class Bootstrap:
    """Replicates of every lane and percentile intervals; P unknowns, B replicates.

    Attributes:
        result: the fit they belong to.
        kind: how data were drawn.
        block: samples drawn together.
        theta: estimates, scaled coordinates; (lanes, B, P).
        usable: replicates that converged; (lanes, B).
        lower: 2.5 % quantile in the parameter's unit; NaN with fewer than `FEWEST` usable
            replicates; (lanes, P).
        upper: 97.5 % quantile; (lanes, P).
        standard_error: standard deviation in scaled coordinates times the slope of the unit, as for
            the local one; (lanes, P).
    """

    result: FitResult
    kind: Kind
    block: int
    theta: Float[np.ndarray, "lanes B P"]
    usable: Bool[np.ndarray, "lanes B"]
    lower: Float[np.ndarray, "lanes P"]
    upper: Float[np.ndarray, "lanes P"]
    standard_error: Float[np.ndarray, "lanes P"]

    @property
    def note(self) -> str:
        """What there is to say of blocks that are few to a curve; "" if there is nothing."""
        n = _shortest(self.result.study)
        if self.block == 1 or n >= FEW_BLOCKS * self.block:
            return ""
        lost = 1 / enlargement(n, self.block)
        cure = f"blocks of {n // FEW_BLOCKS} or less" if n >= 2 * FEW_BLOCKS else "longer curves"
        return (
            f"Of blocks of {self.block} samples only {n / self.block:.2g} go to the shortest curve "
            f"({n} samples). So few give errors that are too small, with white residuals about "
            f"{lost:.2g} of the true ones; the residuals are enlarged by {1 / lost:.3g} for it, "
            "which holds in the mean and for 3 blocks or more to a curve; with correlated ones "
            f"errors may still be too small by a third. Better are {cure}"
        )


def bootstrap(
    result: FitResult,
    settings: Settings = Settings(),
    *,
    count: int = 200,
    kind: Kind = "parametric",
    block: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Bootstrap:
    """Refit `count` resampled data sets of every lane, from the estimate, weights and noise anew.

    What a lane draws depends on the seed and its place alone.

    Args:
        result: the fit.
        settings: of the refits (a single start); `seed` of the drawing.
        count: replicates.
        kind: `parametric` or `residual`.
        block: neighbouring samples drawn together (`residual`).
        progress: called with (refits done since the last call, refits in all).

    Raises:
        ValueError: no `FitResult` or `Settings`, too few replicates, an impossible block (longer
            than the shortest curve), or a joint study.
    """
    check_word("kind", kind, Kind)
    check_word("result", result, FitResult)
    check_word("settings", settings, Settings)
    _check(count, kind, block)
    check_block(result.study, block)
    result.study.refuse_joint("the bootstrap")
    seen = predictions(result.study, result.theta)
    one = dataclasses.replace(settings, starts=1, verify=False)
    thetas, usable = [], []
    together = max(copied_at_once(result.study.bytes_per_lane) // count, 1)
    for first in range(0, result.lanes, together):
        lanes = np.arange(first, min(first + together, result.lanes))
        sampled = _draw(result, seen, lanes, count, kind, block, settings.seed)
        rows = lanes.repeat(count)
        chosen = result.study.take(rows)
        again = fit(dataclasses.replace(chosen, lanes=sampled), one, starts=result.theta[rows])
        thetas.append(again.theta.reshape(len(lanes), count, -1))
        usable.append(again.succeeded.reshape(len(lanes), count))
        if progress is not None:
            progress(len(rows), result.lanes * count)
    theta, good = np.concatenate(thetas), np.concatenate(usable)
    return Bootstrap(result, kind, block, theta, good, *_summary(result, theta, good))


def _check(count, kind, block) -> None:
    if count < FEWEST:
        raise ValueError(f"count is {count}; expected at least {FEWEST} for a 95 % interval")
    if block < 1 or (block > 1 and kind == "parametric"):
        raise ValueError(f"block is {block}; expected 1, or more with kind 'residual'")


def check_block(study: Study, block: int) -> None:
    """Refuse a block that is longer than a curve.

    Raises:
        ValueError: naming the samples of the shortest curve, and the cure.
    """
    if block > (n := _shortest(study)):
        raise ValueError(
            f"block is {block}; expected no more than the {n} samples of the shortest curve, "
            f"better {FEW_BLOCKS} blocks to a curve or more (block = {max(n // FEW_BLOCKS, 1)})"
        )


def _shortest(study: Study) -> int:
    """Samples of the shortest curve."""
    return min(len(curve.force) for curves in study.curves for curve in curves)


def enlargement(n: int, block: int) -> float:
    """What white residuals of a curve of n samples, drawn in blocks, lose against single ones."""
    lengths = np.diff([*range(0, n, block), n])
    share = float(np.sum(lengths**2)) / n**2
    return float(np.sqrt(max(1 - 1 / n, 0.5) / max(1 - share, 0.5)))


def _draw(result: FitResult, seen: Prediction, lanes, count, kind, block, seed) -> Lane:
    """Lanes of `count` resampled data sets of each of `lanes`."""
    draw = _normal if kind == "parametric" else _blocks
    channels = [channel for channel, _ in _kinds(result)]
    found: dict[str, list[np.ndarray]] = {channel.name: [] for channel in channels}
    for lane in lanes:
        rng = np.random.default_rng([seed, int(lane)])
        noise = draw(rng, result, seen, lane, count, block)
        for channel in channels:
            model = channel.data[lane] + np.nan_to_num(seen[channel.name][lane])
            found[channel.name].append(model + noise[channel.name])
    sampled = result.study.take(lanes.repeat(count)).lanes
    return with_observed(sampled, {name: np.concatenate(parts) for name, parts in found.items()})


def _kinds(result: FitResult) -> list[tuple[Observed, int]]:
    """What the lanes observe, and which standard deviation each has: of force 0, of markers 1."""
    lanes = result.study.lanes
    return [(kind, 0) for kind in forces(lanes)] + [(kind, 1) for kind in markers(lanes)]


def _normal(rng, result: FitResult, seen: Prediction, lane, count, block):
    """Normal noise of every observed entry by its field, N and mm; (count, *shape of a lane)."""
    sigma, out = result.whitened_sigma[lane], {}
    # Markers first, as ever: the same seed draws the same data.
    for kind, which in sorted(_kinds(result), key=lambda pair: -pair[1]):
        precision = kind.precision[lane]
        known = precision > 0
        level = np.where(known, sigma[which] / np.where(known, precision, 1), 0)
        out[kind.name] = level * rng.normal(size=(count, *precision.shape))
    return out


def _blocks(rng, result: FitResult, seen: Prediction, lane, count, block):
    """Residuals of each curve drawn in blocks, in units of their own sigma; as `_normal`."""
    data, kinds = result.study.lanes, _kinds(result)
    total = float(result.samples[lane])
    unknowns = float(data.active[lane].sum())
    enlarge = np.sqrt(total / max(total - unknowns, 1))
    noise = {kind.name: np.zeros((count, *kind.data[lane].shape)) for kind, _ in kinds}
    for t, curve in enumerate(result.study.curves[lane]):
        n = len(curve.force)
        starts = rng.integers(n, size=(count, -(-n // block)))
        at = ((starts[:, :, None] + np.arange(block)) % n).reshape(count, -1)[:, :n]
        for kind, _ in kinds:
            r, precision = seen[kind.name][lane, t, :n], kind.precision[lane, t, :n]
            own = enlarge * enlargement(n, block)
            noise[kind.name][:, t, :n] = own * _resample(r, precision, at)
    return noise


def _resample(residual, precision, at) -> np.ndarray:
    """Centred residuals of the samples `at`, brought to the precision of where they are put."""
    known = np.isfinite(residual)
    white = np.where(known, residual, 0) * precision
    mean = white.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    white = np.where(known, white - mean, 0)
    return np.where(known, white[at] / np.where(known, precision, 1), 0)


def _summary(result: FitResult, theta, usable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Percentile interval and standard error, units of the parameters."""
    lower, upper, error = (np.full(result.theta.shape, np.nan) for _ in range(3))
    for lane, unknowns in enumerate(result.study.unknowns):
        good = theta[lane][usable[lane]]
        if len(good) < FEWEST:
            continue
        ends = np.quantile(good, [0.025, 0.975], axis=0)
        spread = np.std(good, axis=0, ddof=1)
        for i, (p, _, _) in enumerate(unknowns):
            lower[lane, i], upper[lane, i] = p.from_scaled(ends[:, i])
            slope = result.value[lane, i] if p.scale == "log" else p.step
            error[lane, i] = spread[i] * slope
    return lower, upper, error
