"""Which samples and curves an estimate hangs on: leverage, studentised residuals, Cook's distance.

All from the residual of the fit. Leverage h is that of the tangent plane at the estimate
(Gauss-Newton; sums to the number of free unknowns); studentised residuals are z / sqrt(1 - h), or
what stands for 1 - h where curves are weighted otherwise than by their noise. How the estimate
moves comes from the implicit function theorem, with the full Hessian H of the cost (Cook and
Weisberg 1982, Residuals and Influence in Regression, ch. 3 and 5):

- data of sample e up by one sigma: H^-1 b^2 psi'(z) J;
- sample e left out: one Newton step, H^-1 b^2 psi(z) J / (1 - b^2 psi'(z) J^T H^-1 J), exact for a
  model linear in its unknowns; likewise for a whole curve.

Weights of curves, sigma and, for the leverage, the weights of a robust loss are held. Unknowns on a
bound are held, and so are combinations that the data do not determine.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea._arguments import check_word
from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.cost import assemble, entry_scale, robust
from jaxtrachea.fitting.covariance import SINGULAR
from jaxtrachea.fitting.lane import Lane, force_entries, observations
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.estimate import hessian
from jaxtrachea.inference.labels import succeeded
from jaxtrachea.optimisation.batching import PATHS

#: det(1 - hat matrix of a curve) below which the curve alone determines some combination.
_ALONE = 1e-9


class Diagnostics(NamedTuple):
    """One lane; T curves of m entries (as the residual's row, `Lane`), Jf free parameters each.

    Attributes:
        leverage: (T, m).
        studentised: residual, model - data, over its standard deviation; internal; (T, m).
        cook: 2 / P of the rise of the cost where the sample is left out; (T, m).
        per_sigma: change of the unknowns that the curve reads, scaled coordinates, where the
            sample's value rises by one sigma; (T, Jf, m).
        left_out: the same where the sample is left out; (T, Jf, m).
        curve_cook: where the curve is left out; NaN where the others do not do without it; (T,).
        curve_left_out: NaN for unknowns that go with the curve; (T, Jf).
        curve_share: of the variance of the unknowns, by noise of this curve; (T, Jf).
    """

    leverage: Float[Array, "*l T m"]
    studentised: Float[Array, "*l T m"]
    cook: Float[Array, "*l T m"]
    per_sigma: Float[Array, "*l T Jf m"]
    left_out: Float[Array, "*l T Jf m"]
    curve_cook: Float[Array, "*l T"]
    curve_left_out: Float[Array, "*l T Jf"]
    curve_share: Float[Array, "*l T Jf"]


@dataclasses.dataclass(frozen=True, eq=False)
class Influence:
    """Diagnostics of every lane, NaN where a lane has no estimate or a sample was not observed.

    Attributes:
        result: the fit they belong to.
        of: leading axis = lanes; changes of unknowns here in standard errors (NaN where an unknown
            has none).
        external: studentised residuals with sigma as the other samples give it; as `studentised`
            where sigma is given or the loss is robust; (lanes, T, m).
    """

    result: FitResult
    of: Diagnostics
    external: Float[np.ndarray, "lanes T m"]


class _Inverses(NamedTuple):
    """Inverse Gauss-Newton matrix and inverse Hessian on what is free and determined; (P, P)."""

    gauss_newton: Array
    full: Array


def _invert(A, H, relative, free) -> _Inverses:
    """Invert in relative coordinates, without held unknowns and directions that nothing sees."""
    unit = relative * free
    scale = unit[:, None] * unit[None]
    top = jnp.max(jnp.diagonal(A * scale))
    top = jnp.where(top > 0, top, 1)
    eye = jnp.eye(len(unit), dtype=A.dtype)
    values, vectors = jnp.linalg.eigh(A * scale + eye * (top * (1 - free))[None])
    own = jnp.sum(vectors**2 * free[:, None], axis=0) > 0.5
    keep = own & (values > SINGULAR**2 * jnp.max(jnp.where(own, values, 0)))
    kept = keep.astype(A.dtype)
    V = vectors * kept[None]
    inner = jnp.einsum("pk,pq,ql->kl", V, H * scale, V) + jnp.diag(1.0 - kept)
    inverse = jnp.linalg.inv(inner) * kept[:, None] * kept[None]
    gauss_newton = jnp.einsum("pk,k,qk->pq", V, 1 / jnp.where(keep, values, 1), V)
    full = jnp.einsum("pk,kl,ql->pq", V, inverse, V)
    return _Inverses(gauss_newton * scale, full * scale)


@full_precision
def diagnose(
    model: FitModel,
    theta: Float[Array, " P"],
    lane: Lane,
    sigma: Float[Array, "2"],
    relative: Float[Array, " P"],
    free: Float[Array, " P"],
) -> Diagnostics:
    """Diagnostics of one lane at its estimate.

    Args:
        theta: estimate, scaled coordinates.
        lane: the lane's arrays.
        sigma: as for `evaluate`.
        relative: change of each scaled coordinate that makes a relative change of 1.
        free: 1 for unknowns that exist and are not on a bound, else 0; (P,).
    """
    r, (seen, _) = residual(model, theta, lane), observations(lane)
    scale = entry_scale(lane, sigma)[None]
    z, J = r.value * scale, r.jacobian * (scale * seen)[:, None]

    def psi(z):
        return z * robust(model.loss, z * z, model.loss_scale)[1]

    slope = robust(model.loss, z * z, model.loss_scale)[1]
    pull, stiffness = jax.jvp(psi, (z,), (jnp.ones_like(z),))
    b2 = (lane.balance * lane.balance)[:, None]
    weight, pull, stiffness = b2 * slope, b2 * pull, b2 * stiffness

    def gram(w):
        return jnp.einsum("tim,tm,tjm->tij", J, w, J)

    def whole(w):
        return assemble(model, gram(w), lane)

    A = whole(weight)
    inverse = _invert(A, hessian(model, theta, lane, sigma), relative, free)
    blocks = functools.partial(_blocks, model, lane)
    near, K = blocks(inverse.gauss_newton), blocks(inverse.full)

    def form(block):
        return jnp.einsum("tim,tij,tjm->tm", J, block, J)

    def sandwich(outer, m):
        return outer @ m @ outer

    leverage = weight * form(near)
    left = 1 - 2 * leverage + form(blocks(sandwich(inverse.gauss_newton, whole(weight**2))))
    rise = blocks(sandwich(inverse.full, A)) / jnp.maximum(jnp.sum(free), 1)
    shift = jnp.einsum("tij,tjm->tim", K, J)
    gone = pull / (1 - stiffness * form(K))
    per_sigma = shift * stiffness[:, None]
    own = _of_one_curve(model, lane, free)
    c, cook = _without_curve(J, gram(weight), gram(stiffness), pull, near, K, own)
    variance = jnp.diagonal(sandwich(inverse.full, whole(stiffness**2)))
    variance = jnp.diagonal(blocks(jnp.diag(variance)), axis1=1, axis2=2)
    by_curve = jnp.sum(per_sigma**2, axis=2)
    return Diagnostics(
        leverage=leverage,
        studentised=jnp.where(left > 1e-12, z / jnp.sqrt(jnp.maximum(left, 1e-12)), jnp.nan),
        cook=gone * gone * form(rise),
        per_sigma=per_sigma,
        left_out=shift * gone[:, None],
        curve_cook=jnp.einsum("ti,tij,tj->t", c, rise, c) - cook / jnp.maximum(jnp.sum(free), 1),
        curve_left_out=jnp.where(own, jnp.nan, jnp.einsum("tij,tj->ti", K, c)),
        curve_share=jnp.where(
            variance > 0, by_curve / jnp.where(variance > 0, variance, 1), jnp.nan
        ),
    )


def _blocks(model: FitModel, lane: Lane, matrix: Float[Array, "P P"]) -> Float[Array, "T Jf Jf"]:
    """Of a matrix over the unknowns, the part that each curve reads; 0 where it reads none."""
    index = lane.index[:, model.free_columns]
    at = jnp.maximum(index, 0)
    there = (index >= 0)[:, :, None] & (index >= 0)[:, None]
    return jnp.where(there, matrix[at[:, :, None], at[:, None, :]], 0)


def _of_one_curve(model: FitModel, lane: Lane, free) -> Bool[Array, "T Jf"]:
    """Which free unknowns a curve alone reads; none where it shares no unknown with another."""
    index = lane.index[:, model.free_columns]
    size = lane.lower.shape[0]
    place = jnp.where(index >= 0, index, size)
    readers = jnp.zeros(size + 1, index.dtype).at[place].add(1)
    there = (index >= 0) & (jnp.append(free, 0)[place] > 0)
    own = (readers[place] == 1) & there
    return own & jnp.any(there & ~own, axis=1, keepdims=True)


def _without_curve(J, gram, stiffness, pull, near, K, own):
    """What moves the unknowns, by H^-1, where a curve is left out; NaN where it is needed.

    What the curve alone reads goes with it: a spring of any stiffness in its place holds it, and
    the others do not notice, for nothing else is tied to it.

    Returns:
        (T, Jf), and what is to be taken off twice the rise of the cost: unknowns that go with the
        curve follow the others as they like; (T,).
    """
    eye = jnp.eye(J.shape[1], dtype=J.dtype)[None]
    force = jnp.einsum("tim,tm->ti", J, pull)
    diagonal = jnp.diagonal(gram, axis1=1, axis2=2)
    spring = jnp.where(own, jnp.where(diagonal > 0, diagonal, 1), 0)[:, :, None] * eye
    moved = jnp.linalg.solve(eye - (stiffness - spring) @ K, force[:, :, None])[:, :, 0]
    alone = jnp.linalg.det(eye - (gram - spring) @ near) < _ALONE
    moved = jnp.where(alone[:, None], jnp.nan, moved)
    pushed = jnp.where(own, jnp.einsum("tij,tjk,tk->ti", gram, K, moved), 0)
    both = own[:, :, None] & own[:, None]
    inner = jnp.where(both, gram, eye)
    return moved, jnp.sum(pushed * jnp.linalg.solve(inner, pushed[:, :, None])[:, :, 0], axis=1)


def influence(result: FitResult, batch: int = 128) -> Influence:
    """Diagnostics of all lanes of a fit.

    Args:
        batch: lanes computed together; of a level that iterates no more than `PATHS`.

    Raises:
        ValueError: no `FitResult`, or `batch` is no whole number.
    """
    check_word("result", result, FitResult)
    check_word("batch", batch, int)
    if result.study.model.level.iterates:
        batch = min(batch, PATHS)
    free = np.asarray(result.study.lanes.active) * ~result.at_bound
    diagnostics = map_lanes(
        diagnose, result.study, result.theta, result.whitened_sigma, result.relative, free,
        batch=result.study.batch_size(result.lanes, batch),
    )  # fmt: skip
    return _conclude(result, diagnostics)


def _conclude(result: FitResult, found: Diagnostics) -> Influence:
    """Unknowns in standard errors, NaN where there is nothing, sigma as the others give it."""
    study, lanes = result.study, result.study.lanes
    columns = lanes.index[:, :, study.free_columns]
    rows = np.arange(result.lanes)[:, None, None]
    se = result.uncertainty.se[rows, np.maximum(columns, 0)]
    se = np.where((columns >= 0) & np.isfinite(se) & (se > 0), se, np.nan)
    good = np.array([succeeded(result, k) for k in range(result.lanes)])
    seen = _seen(study) & good[:, None, None]
    curve = good[:, None] & np.array([np.arange(columns.shape[1]) < len(c) for c in study.curves])

    def at(v, there):
        return np.where(there, v, np.nan)

    def moved(v):
        return at(v / se[..., None], seen[:, :, None])

    found = found._replace(
        leverage=at(found.leverage, seen),
        studentised=at(found.studentised, seen),
        cook=at(found.cook, seen),
        per_sigma=moved(found.per_sigma),
        left_out=moved(found.left_out),
        curve_cook=at(found.curve_cook, curve),
        curve_left_out=at(found.curve_left_out / se, curve[:, :, None]),
        curve_share=at(found.curve_share + 0 * se, curve[:, :, None]),
    )
    return Influence(result, found, _external(result, np.asarray(found.studentised)))


def _seen(study: Study) -> np.ndarray:
    """Observed entries of the residual; (lanes, T, m)."""
    return np.asarray(observations(study.lanes)[0]) > 0


def _external(result: FitResult, t: np.ndarray) -> np.ndarray:
    """Studentised t times sqrt((n - 1) / (n - t^2)), n degrees of freedom; t if sigma is given."""
    study, samples = result.study, force_entries(result.study.lanes)
    if study.model.loss != "linear":
        return t
    seen = _seen(study)
    share = 1 - study.lanes.active.sum(axis=1) / np.maximum(seen.sum(axis=(1, 2)), 1)
    out = t.copy()
    for part, given in zip((np.s_[..., :samples], np.s_[..., samples:]), study.noise_given,
                           strict=True):  # fmt: skip
        dof = (seen[part].sum(axis=(1, 2)) * share)[:, None, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            left = (dof - 1) / (dof - t[part] ** 2)
            out[part] = t[part] if given else t[part] * np.sqrt(np.where(left > 0, left, np.nan))
    return out
