"""Bounded least-squares problems with noise and random boxes, and what SciPy makes of them."""

import dataclasses
import functools

import jax
import numpy as np
import synthetic
from scipy.optimize import least_squares

from jaxtrachea.fitting.cost import evaluate
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.residual import residual_value
from jaxtrachea.fitting.study import Study

#: Truths that four curves with 1 % noise identify: a soft contact that hardens early.
CLEAR = np.array([300.0, 1.0, 0.5, 0.2])


def random_study(seed: int, count: int, level: float = 0.01) -> tuple[Study, np.ndarray]:
    """Lanes with noise whose bounds cut off the optimum in about half of all unknowns.

    Args:
        seed: of truths, noise and bounds.
        count: lanes.
        level: noise over the peak force.

    Returns:
        The study, and a start inside the bounds for each lane, (lanes, 4).
    """
    rng = np.random.default_rng(seed)
    truth = synthetic.draw(seed, count, 2.0, CLEAR)
    depths = synthetic.DEPTHS[::2]
    force, _ = synthetic.forces(truth, displacement=depths)
    force = force + level * np.abs(force).max((1, 2), keepdims=True) * rng.normal(size=force.shape)
    study = synthetic.build_study(
        synthetic.curves(force, displacement=depths),
        synthetic.GEOMETRY,
        synthetic.OPTIONS,
        synthetic.parameters(),
    )
    scaled = np.log(truth)
    side = rng.choice([-1, 0, 1], size=scaled.shape, p=[0.25, 0.5, 0.25])
    cut = scaled + side * rng.uniform(0.05, 1.5, scaled.shape)
    lower = np.where(side > 0, cut, scaled - 4)
    upper = np.where(side < 0, cut, scaled + 4)
    start = lower + rng.uniform(0.1, 0.9, scaled.shape) * np.minimum(upper - lower, 3.0)
    return with_lanes(study, study.lanes._replace(lower=lower, upper=upper)), start


@functools.cache
def _evaluated(model: FitModel):
    return jax.jit(jax.vmap(functools.partial(evaluate, model)))


@functools.cache
def _residual_and_jacobian(model: FitModel):
    def whole(theta, lane):
        return residual_value(model, theta, lane).ravel()

    return jax.jit(whole), jax.jit(jax.jacfwd(whole))


def kkt_residual(study: Study, theta: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Largest gain in residual norm that any unknown alone still offers inside its bounds.

    sqrt(H_ii) |P(theta - g / H) - theta|_i over the norm of the residual: 0 at a point that
    satisfies the Karush-Kuhn-Tucker conditions; away from bounds the cosine between the residual
    and a column of the Jacobian. (lanes,), float64 whatever the solver computed in.
    """
    lanes = study.lanes
    point = jax.tree.map(np.asarray, _evaluated(study.model)(theta, lanes, sigma))
    diagonal = np.diagonal(point.hessian, axis1=1, axis2=2)
    newton = -point.gradient / np.where(diagonal > 0, diagonal, 1)
    step = lanes.active * (np.clip(theta + newton, lanes.lower, lanes.upper) - theta)
    return np.max(np.abs(step) * np.sqrt(diagonal), axis=1) / np.sqrt(2 * point.cost)


def scipy_costs(study: Study, starts: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Cost that SciPy's `trf` reaches from each lane's start, same residual; (lanes,)."""
    run, by = _residual_and_jacobian(study.model)
    costs = []
    for k, start in enumerate(starts):
        lane = jax.tree.map(lambda v, row=k: v[row], study.lanes)

        def value(theta, lane=lane, scale=sigma[k, 0]):
            return np.asarray(run(theta, lane)) / scale

        def slope(theta, lane=lane, scale=sigma[k, 0]):
            return np.asarray(by(theta, lane)) / scale

        margin = 1e-10 * (lane.upper - lane.lower)
        inside = np.clip(start, lane.lower + margin, lane.upper - margin)
        costs.append(
            least_squares(
                value, inside, slope, bounds=(lane.lower, lane.upper), method="trf",
                xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=2000,
            ).cost
        )  # fmt: skip
    return np.array(costs)


def with_lanes(study: Study, lanes) -> Study:
    """The same study with other arrays."""
    return dataclasses.replace(study, lanes=lanes)


def costs(study: Study, theta: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Cost of every lane at `theta` in float64, half the sum of squares written out; (lanes,)."""
    run, _ = _residual_and_jacobian(study.model)

    def lane(k):
        return jax.tree.map(lambda v: v[k], study.lanes)

    z = np.stack([np.asarray(run(theta[k], lane(k))) for k in range(len(theta))]) / sigma[:, :1]
    return 0.5 * np.sum(z * z, axis=1)


def dense_theta(joint: Study, dense: Study, theta: np.ndarray) -> np.ndarray:
    """Unknowns of a joint study, (lanes, P), in the order of the one dense lane; (1, all)."""
    names = [(p.name, specimen) for p, specimen, _ in dense.unknowns[0]]
    whole = np.zeros((1, len(names)))
    for row, unknowns in zip(theta, joint.unknowns, strict=True):
        for value, (p, specimen, _) in zip(row, unknowns, strict=True):
            whole[0, names.index((p.name, specimen))] = value
    return whole
