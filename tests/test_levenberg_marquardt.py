"""The solver on functions of its own, minima in closed form or published."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

from jaxtrachea.optimisation.curvature import Rest, secant_update
from jaxtrachea.optimisation.levenberg_marquardt import levenberg_marquardt
from jaxtrachea.optimisation.trust_region import RUNNING, Tolerances, initial_state, iterate
from jaxtrachea.status import FitStatus


class Point(NamedTuple):
    """What the solver needs, the residual and its Jacobian."""

    cost: Any
    gradient: Any
    hessian: Any
    value: Any
    jacobian: Any


def rosenbrock(theta):
    """Rosenbrock (1960) as least squares: minimum 0 at (1, 1)."""
    return jnp.stack([10 * (theta[1] - theta[0] ** 2), 1 - theta[0]])


def jennrich_sampson(theta):
    """Jennrich and Sampson (1968), ten residuals that stay large at the minimum."""
    i = jnp.arange(1, 11).astype(theta.dtype)
    return 2 + 2 * i - jnp.exp(i * theta[0]) - jnp.exp(i * theta[1])


def brown_dennis(theta):
    """Brown and Dennis (1971), twenty residuals that stay large at the minimum."""
    t = jnp.arange(1, 21).astype(theta.dtype) / 5
    first = theta[0] + t * theta[1] - jnp.exp(t)
    return first**2 + (theta[2] + theta[3] * jnp.sin(t) - jnp.cos(t)) ** 2


class Valley(eqx.Module):
    """The cost of a residual inside a box."""

    lower: Any
    upper: Any
    active: Any
    residual: Any = eqx.field(static=True, default=rosenbrock)

    def evaluate(self, theta):
        r, J = self.residual(theta), jax.jacfwd(self.residual)(theta)
        return Point(0.5 * jnp.sum(r * r), J.T @ r, J.T @ J, r, J)

    def ahead(self, point, theta, step):
        def along(t):
            return jax.jvp(self.residual, (t,), (step,))[1]

        return point.jacobian.T @ jax.jvp(along, (theta,), (step,))[1]

    def cross_gradient(self, point, other):
        return point.jacobian.T @ other.value

    def blank(self):
        shapes = jax.eval_shape(self.evaluate, jnp.zeros(self.lower.shape, self.lower.dtype))
        return jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)

    def rounding(self):
        return jnp.zeros((), self.lower.dtype)


def on_the_floor(y):
    """Minimum over x at given y, beyond the maximum at x = 0: f' is a cubic."""
    roots = np.roots([200, 0, 1 - 200 * y, -1])
    return np.max(roots[np.abs(roots.imag) < 1e-12].real)


#: Lower, upper, active, minimum: free; x held below it; y held above it; y at its start.
BOXES = [
    ((-5.0, -5.0), (5.0, 5.0), (1.0, 1.0), (1.0, 1.0)),
    ((-5.0, -5.0), (0.5, 5.0), (1.0, 1.0), (0.5, 0.25)),
    ((0.0, 2.0), (5.0, 5.0), (1.0, 1.0), (on_the_floor(2.0), 2.0)),
    ((0.0, -5.0), (5.0, 5.0), (1.0, 0.0), (on_the_floor(3.0), 3.0)),
]


def test_a_start_beyond_the_bounds_ends_within():
    """At the free minimum, which is lower than all that the box has."""
    valley = Valley(*(np.array(column) for column in list(zip(*BOXES, strict=True))[:3]))
    rows, starts = np.array([1, 2]), np.ones((2, 2))
    solved = levenberg_marquardt(valley, starts, rows, batch=16)
    assert np.all(solved.status == FitStatus.CONVERGED)
    # A relative fall of the cost by 1e-10 is left.
    assert np.allclose(solved.theta, [BOXES[k][3] for k in rows], rtol=0, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "batch", "unoptimised"), [(1, 16, False), (1, 16, True), (1000, 64, False)]
)
def test_minima_of_a_valley_inside_boxes(count, batch, unoptimised):
    """From `count` starts of each box, in batches with a rest: all end where the algebra says."""
    valley = Valley(*(np.array(column) for column in list(zip(*BOXES, strict=True))[:3]))
    rows = np.tile(np.arange(4), count)
    unit = np.random.default_rng(1).uniform(size=(4 * count, 2))
    starts = valley.lower[rows] + unit * (valley.upper - valley.lower)[rows]
    starts[rows == 3, 1] = 3.0
    solved = levenberg_marquardt(valley, starts, rows, batch=batch, unoptimised=unoptimised)
    minimum = np.array([m for *_, m in BOXES])[rows]
    assert np.all(solved.status == FitStatus.CONVERGED)
    # A relative fall of the cost by 1e-10 is left; with a residual of 1 a distance of its root.
    np.testing.assert_allclose(solved.theta, minimum, rtol=0, atol=1e-5)
    assert np.all(solved.theta[rows == 1, 0] == 0.5)
    assert np.all(solved.theta[rows == 2, 1] == 2.0)
    assert np.all(solved.theta[rows == 3, 1] == 3.0)
    x, y = minimum.T
    truth = 50 * (y - x * x) ** 2 + 0.5 * (1 - x) ** 2
    np.testing.assert_allclose(solved.cost, truth, rtol=1e-9, atol=1e-18)


def test_one_start_takes_the_program_of_a_few():
    valley = Valley(*(np.array(column)[None] for column in BOXES[0][:3]))
    starts, row = np.array([[-1.2, 1.0], [0.5, 2.0]]), np.zeros(1, int)
    levenberg_marquardt(valley, starts, np.zeros(2, int), batch=16)
    with compilations() as seen:
        solved = levenberg_marquardt(valley, starts[:1], row, batch=16)
    assert not seen
    np.testing.assert_allclose(solved.theta, 1.0, atol=1e-8)


def test_a_start_that_cannot_be_evaluated_is_a_status():
    """It touches no other row, and its cost is no minimum: infinite, in a used slot as well."""
    valley = Valley(*(np.array(column)[None] for column in BOXES[0][:3]))
    starts = np.array([[np.nan, 0.0], [-1.2, 1.0]])
    solved = levenberg_marquardt(valley, starts, np.zeros(2, int))
    assert solved.status.tolist() == [FitStatus.INFEASIBLE_START, FitStatus.CONVERGED]
    np.testing.assert_allclose(solved.theta[1], 1.0, atol=1e-8)
    assert solved.cost[0] == np.inf
    good = np.tile([[-1.2, 1.0]], (40, 1))
    late = levenberg_marquardt(valley, np.concatenate([good, starts]), np.zeros(42, int), batch=16)
    assert late.status[40] == FitStatus.INFEASIBLE_START
    assert np.flatnonzero(np.isinf(late.cost)).tolist() == [40]


def test_a_blank_start_that_cannot_be_evaluated_costs_infinitely():
    """`iterate` by itself, from a blank point whose cost is 0; one that can has its own cost."""
    valley = Valley(*map(jnp.array, BOXES[0][:3]))

    @jax.jit
    def first(theta):
        return iterate(Tolerances(), valley, initial_state(theta, valley))

    assert jax.jit(lambda v: v.blank().cost)(valley) == 0
    lost = first(np.array([np.nan, 0.0]))
    assert (lost.status, lost.point.cost) == (FitStatus.INFEASIBLE_START, jnp.inf)
    good = first(np.array([-1.2, 1.0]))
    # 100 (1 - 1.44)^2 / 2 + (1 + 1.2)^2 / 2
    assert good.status == RUNNING
    np.testing.assert_allclose(good.point.cost, 9.68 + 2.42, rtol=1e-14)


def test_float32_ends_on_the_bound_as_given():
    """A bound that float32 has a little lower comes back to the last digit."""
    bound = 0.7
    assert float(np.float32(bound)) < bound
    valley = Valley(np.full((1, 2), -5.0), np.array([[bound, 5.0]]), np.ones((1, 2)))
    solved = levenberg_marquardt(valley, np.zeros((1, 2)), dtype=np.float32)
    assert solved.theta.dtype == np.float64
    assert solved.theta[0, 0] == bound
    np.testing.assert_allclose(solved.theta[0, 1], bound**2, rtol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("residual", "start", "cost", "steps"),
    [(jennrich_sampson, (0.3, 0.4), 124.362, 16), (brown_dennis, (25, 5, -5, -1), 85822.2, 20)],
)
def test_minima_with_large_residuals(residual, start, cost, steps):
    """Published sums of squares (More, Garbow, Hillstrom 1981, doi:10.1145/355934.355936).

    There the Gauss-Newton matrix is wrong by a factor: with it alone this solver takes 20 and 37
    steps in float64, more than the limits here.
    """
    start = np.array(start, float)[None]
    far = np.full_like(start, 100)
    valley = Valley(-far, far, np.ones_like(far), residual)
    solved = levenberg_marquardt(valley, start, dtype="float64")
    assert solved.status[0] == FitStatus.CONVERGED
    np.testing.assert_allclose(2 * solved.cost[0], cost, rtol=4e-6)
    assert solved.iterations[0] <= steps, solved.iterations


def test_a_secant_update_knows_the_step_just_taken():
    """Afterwards the rest times the step is what the residual's second derivatives make of it."""
    far = jnp.full(4, 100, "float64")
    valley = Valley(-far, far, jnp.ones(4, "float64"), brown_dennis)
    step = jnp.array([-0.1, 0.05, 0.02, -0.03], "float64")

    @jax.jit
    def both(theta):
        old, new = valley.evaluate(theta), valley.evaluate(theta + step)
        change = (new.jacobian - old.jacobian).T @ new.value
        return old, new, valley.cross_gradient(old, new), change

    *given, change = both(np.array([-11, 13, -0.4, 0.2], "float64"))
    before = Rest(jnp.eye(4, dtype="float64"), jnp.asarray(False))
    matrix = np.asarray(secant_update(before, *given, step).matrix)
    np.testing.assert_allclose(matrix @ step, change, rtol=1e6 * np.finfo("float64").eps)
    np.testing.assert_array_equal(matrix, matrix.T)
