"""Error of the model between positions: what leaving each pressed position out leaves.

A fit knows its noise and its parameters; neither says how far the model misses a place that was
not pressed. Each position of a lane is left out in turn and predicted by the others, to first
order in the unknowns (exact for a model linear in them: Cook and Weisberg 1982, Residuals and
Influence in Regression, ch. 3): with z and X the weighted residual and Jacobian of the position
and A the normal matrix of the others,

    e = z + X A^-1 X^T z.

Unknowns that the position alone reads (its onset, its offset) are fitted to it. The error is a
smooth bias of a whole curve, not noise: it is compared with the force as e = F (a + b x + c x^2),
x the depth over the deepest, and what scatters about that is noise and does not count. What noise
of the curve and in the parameters explains, v, is not the model's, and bands have it apart: the
share tau of a depth is that of n positions whose errors have the variance tau^2 + v, by maximum
likelihood. Positions that the others hardly determine, of large v, so count little. Its square is
half that of all depths, half that of this one; it counts with one degree of freedom less than the
positions that tell it, (sum w)^2 / sum w^2 with their weights w = (tau^2 + v)^-2.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.cost import weights
from jaxtrachea.fitting.lane import Lane, precisions
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.holdout_groups import companions
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.prediction.pressed import Pressed, pressed

#: Positions from which the error between them is known well enough for a band.
MIN_POSITIONS = 4
#: Positions closer than this are one, mm.
SAME_PLACE = 1e-6
#: Depths at which the error is kept.
POINTS = 33
#: Powers of the depth that a smooth error has beside the force.
SHAPES = 3
#: Eigenvalues of the scaled normal matrix, over the largest, that determine nothing.
_SINGULAR = 1e-10
#: Slope along such a direction, over the largest of the position, from which it counts.
_ACTS = 1e-4
#: Iterations of the likelihood.
_ITERATIONS = 200


class ModelError(NamedTuple):
    """Of one lane.

    Attributes:
        depth: from first touch, mm; (points,).
        share: standard deviation of the model's error between positions at these depths, share of
            the force; NaN where too few positions tell it; (points,).
        positions: that could be left out.
        quantile: of a 95 % interval with a degree of freedom less than the positions that tell it;
            NaN likewise.
        growth: by which standard errors from the parameters grow, since neighbouring residuals are
            alike; inf where the samples are worth no more than the unknowns. Then `share` is all
            that is known of the band, with what the parameters err.
        pressed: contact positions of the fit, mm; (n,).
    """

    @property
    def known(self) -> bool:
        """Whether there are positions enough to know it."""
        return bool(np.isfinite(self.share).all())

    depth: Float[np.ndarray, " points"]
    share: Float[np.ndarray, " points"]
    positions: int
    quantile: float
    growth: float
    pressed: np.ndarray

    @property
    def message(self) -> str:
        """Why a band between positions is as wide as it is, in words."""
        if not self.known:
            few = f"{self.positions} of {MIN_POSITIONS} positions that could be left out"
            return f"{few}: the model's error between positions is unknown"
        low, high = 100 * np.min(self.share), 100 * np.max(self.share)
        size = f"{low:.2g}" if high < 1.1 * low or high == 0 else f"{low:.2g} to {high:.2g}"
        return (
            f"with the model's error between positions, {size} % of the force "
            f"({self.positions} left out in turn)"
        )

    def share_at(self, depth: np.ndarray) -> np.ndarray:
        """The share at depths from first touch, mm; that of the deepest beyond."""
        return np.interp(depth, self.depth, self.share)

    @property
    def growth_message(self) -> str:
        """Why standard errors are larger than perfect residuals would have them; "" if not."""
        if np.isinf(self.growth):
            return "neighbouring residuals are so alike that they determine nothing"
        if self.growth < 1.05:
            return ""
        return f"standard errors times {self.growth:.2g}, as neighbouring residuals are alike"

    def at_pressed(self, s: float) -> bool:
        """Whether the fit has pressed at s, mm: there is nothing between positions."""
        return bool(np.isnan(s) or np.any(np.abs(self.pressed - s) <= SAME_PLACE))


@full_precision
def weighted_rows(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, sigma: Float[Array, "2"]
) -> tuple[Float[Array, "T m"], Float[Array, "T Jf m"], Float[Array, "T m"]]:
    """Residual and Jacobian of every trial, weighted as the fit does it, and these weights.

    Weights are of residuals in N and mm, 0 of what was not observed.
    """
    r = residual(model, theta, lane)
    _, root = weights(model, r.value, lane, sigma)
    return r.value * root, r.jacobian * root[:, None], root * precisions(lane)


def rows_of(
    stored: FitResult, lanes: Int[np.ndarray, " n"], theta: Float[np.ndarray, "n P"]
) -> tuple[Study, Float[np.ndarray, "n T m"], Float[np.ndarray, "n T Jf m"], np.ndarray]:
    """The study of some lanes, and their `weighted_rows` at `theta`, with the noise of the fit."""
    study = stored.study.take(lanes)
    sigma = np.where(study.noise_given, 1.0, stored.observed_sigma[lanes])
    sigma = np.where(np.isfinite(sigma), sigma, 1.0)
    found = map_lanes(
        weighted_rows, study, theta, sigma, batch=study.batch_size(len(lanes), 256)
    )  # fmt: skip
    return study, *found


def model_errors(stored: FitResult, lanes: list[int]) -> dict[int, ModelError]:
    """Error between positions of some lanes of a fit, each computed once."""
    kept: dict[int, ModelError] = pressed(stored).errors
    missing = [lane for lane in dict.fromkeys(lanes) if lane >= 0 and lane not in kept]
    if missing:
        study, value, jacobian, root = rows_of(stored, np.array(missing), stored.theta[missing])
        for k, lane in enumerate(missing):
            X = over_unknowns(study, k, jacobian[k], stored.at_bound[lane])
            left = _LeftOut(value[k], X, root[k], study.lanes.force.shape[-1])
            kept[lane] = _of_lane(stored, lane, study.curves[k], left)
    return {lane: kept[lane] for lane in lanes if lane >= 0}


def over_unknowns(
    study: Study, lane: int, jacobian: Float[np.ndarray, "T Jf m"], at_bound: np.ndarray
) -> Float[np.ndarray, "T P m"]:
    """Jacobian by the lane's unknowns; 0 for what is held, or shared with other lanes."""
    index = np.asarray(study.lanes.index)[lane][:, study.free_columns]
    out = np.zeros((len(jacobian), study.size, jacobian.shape[-1]))
    for t, columns in enumerate(index):
        for j, i in enumerate(columns):
            if i >= 0:
                out[t, i] += jacobian[t, j]
    held = np.zeros(study.size, bool)
    held[: len(at_bound)] = at_bound[: study.size]
    held[study.shared[lane]] = True
    out[:, held] = 0
    return out


def _over(v: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Without the weight; NaN where it is 0: not observed."""
    return np.where(weight > 0, v / np.where(weight > 0, weight, 1), np.nan)


class _LeftOut(NamedTuple):
    """One lane, weighted as the fit has it.

    Attributes:
        z: residual; (T, m).
        X: its derivative by the unknowns, 0 for what is held; (T, P, m).
        root: weight of each residual, 1/N and 1/mm; (T, m).
        samples: entries that are normal forces; they come first.
    """

    z: Float[np.ndarray, "T m"]
    X: Float[np.ndarray, "T P m"]
    root: Float[np.ndarray, "T m"]
    samples: int

    def predicted(self, out: list[int]):
        """Force errors of the trials `out`, N, and their variance by the parameters, N^2.

        None where the others do not determine what the prediction needs.
        """
        reads = np.any(self.X != 0, axis=2)
        others = np.setdiff1d(np.arange(len(self.z)), out)
        kept = np.any(reads[others], axis=0)
        own = np.any(reads[out], axis=0) & ~kept
        X, z = self.X[:, kept], self.z
        A = np.einsum("tim,tjm->ij", X[others], X[others])
        all_of = A + np.einsum("tim,tjm->ij", X[out], X[out])
        size = 1 / np.sqrt(np.diagonal(all_of))
        values, vectors = np.linalg.eigh(A * size * size[:, None])
        V = vectors * size[:, None]
        sees = values > _SINGULAR * max(values[-1], 1e-300) if len(values) else values > 0
        rows = X[out][:, :, : self.samples]
        lost = np.einsum("tim,ik->tkm", rows, V[:, ~sees])
        if np.any(np.abs(lost) > _ACTS * np.max(np.abs(rows * size[:, None]), initial=0)):
            return None
        half = V[:, sees] / np.sqrt(values[sees])
        step = half @ (half.T @ np.einsum("tim,tm->i", X[out], z[out]))
        e = z[out][:, : self.samples] + np.einsum("tim,i->tm", rows, step)
        variance = np.sum(np.einsum("tim,ik->tkm", rows, half) ** 2, axis=1)
        if own.any():
            B = np.moveaxis(self.X[out][:, own, : self.samples], 1, 2).reshape(e.size, -1)
            e = (e.ravel() - B @ np.linalg.lstsq(B, e.ravel(), rcond=None)[0]).reshape(e.shape)
        root = self.root[out][:, : self.samples]
        return _over(e, root), _over(variance, root**2)


def _of_lane(stored: FitResult, lane: int, curves: tuple[Curve, ...], left: _LeftOut) -> ModelError:
    """Every position of a lane left out in turn."""
    fitted = pressed(stored)
    places: dict[object, list[int]] = {}
    for curve, group in zip(curves, companions(curves, stored.study.holdout_groups), strict=True):
        s = np.nan if curve.s_c is None else round(curve.s_c / SAME_PLACE)
        places.setdefault((curve.specimen, s, curve.phi_c, *curve.direction), []).extend(group)
    at = np.array([c.s_c for c in curves if c.s_c is not None], float)
    deepest = max(float(np.max(fitted.above_touch(c)[0], initial=0)) for c in curves)
    grid = np.linspace(0, deepest, POINTS)
    found_at = []
    for out in places.values():
        out = sorted(set(out))
        found = left.predicted(out) if len(out) < len(curves) else None
        if found is not None:
            found_at.append(_squares(fitted, [curves[t] for t in out], *found, grid))
    from scipy.special import stdtrit

    found_at = [v for v in found_at if np.isfinite(v).all()]
    n, growth = len(found_at), float(stored.effective.growth[lane]) if stored.study.free else 1.0
    if n < MIN_POSITIONS or deepest <= 0:
        return ModelError(grid, np.full(POINTS, np.nan), n, np.nan, growth, at)
    square, explained = np.swapaxes(found_at, 0, 1)
    by_depth, telling = _share(square, explained)
    sampled = np.concatenate([fitted.above_touch(c)[0] for c in curves])
    sampled = sampled[sampled > 0]
    pooled, telling = (np.mean(np.interp(sampled, grid, v)) for v in (by_depth, telling))
    # Few positions tell the square at one depth badly, all depths together none of its growth.
    share = np.sqrt(np.maximum((pooled + by_depth) / 2, 0))
    return ModelError(grid, share, n, float(stdtrit(max(telling - 1, 1), 0.975)), growth, at)


def _share(square, explained) -> Float[np.ndarray, "2 points"]:
    """Variance tau^2 of what `square` is beyond what is explained; and positions that tell it.

    Of n errors of mean 0 and variance tau^2 + v each, (n, points), by maximum likelihood; where
    they are less than what is explained, it is negative, so that depths together tell no more.
    """
    v = np.maximum(explained, 1e-12 * np.max(square + explained))
    variance = np.mean(square, axis=0)
    for _ in range(_ITERATIONS):
        w = (np.maximum(variance, 0) + v) ** -2
        variance = np.sum(w * (square - v), axis=0) / np.sum(w, axis=0)
    return np.stack([variance, np.sum(w, axis=0) ** 2 / np.sum(w**2, axis=0)])


def _squares(fitted: Pressed, curves, error, variance, grid) -> Float[np.ndarray, "2 points"]:
    """Square of the smooth error of one position over the force, at the depths `grid`.

    And the variance that noise of the curve and in the parameters explains. Means over curves of
    the position; NaN where none has a force.
    """
    out = []
    for curve, e, v in zip(curves, error, variance, strict=True):
        depth, F = fitted.above_touch(curve)
        e, v = e[: len(F)], v[: len(F)]
        seen = (depth > 0) & np.isfinite(e) & (F != 0)
        if not seen.any():
            continue
        e, v, F, depth = e[seen], v[seen], F[seen], depth[seen]
        size = np.max(depth)
        k = min(SHAPES, max(len(np.unique(depth)) - 1, 1))
        powers = np.arange(k)
        basis = F[:, None] * (depth / size)[:, None] ** powers
        at = np.clip(grid / size, np.min(depth) / size, 1)[:, None] ** powers
        inverse = np.linalg.pinv(basis)
        left = np.sum((e - basis @ (inverse @ e)) ** 2) / max(len(e) - k, 1)
        noise = left * np.sum((at @ inverse) ** 2, axis=1)
        order = np.argsort(depth)
        known = np.interp(grid, depth[order], (v / F**2)[order])
        out.append(np.stack([(at @ (inverse @ e)) ** 2, noise + known]))
    return np.mean(out, axis=0) if out else np.full((2, len(grid)), np.nan)
