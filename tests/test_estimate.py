"""The estimate as a function of the data: of deforming cross-sections, and outside of `jit`.

Estimates of a line of rings against refits: test_influence.py.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.inference.estimate import estimate, lane_of
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry

QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation
D = np.array([0.5, 2.0, 5.0])
#: Forces, N, of a press of the default wall at 20 and at 14 mm, rounded.
FORCES = {20.0: [0.49, 1.60, 2.83], 14.0: [0.53, 1.69, 2.87]}
FREE = ("EI_C", "Et_L")
TUBE = Geometry.create(40.0, [10.0, 20.0, 30.0], radius=11.7)


@pytest.mark.slow
@pytest.mark.compiling
def test_derivatives_by_the_data_of_sections():
    """Reverse mode is the change of refits; by forces and by where they were taken.

    Forward mode is the same rule, tested with a line of joints (tests/test_influence.py).
    """
    curves = [Curve("one", f"{s}", s, 0.0, D, np.array(F)) for s, F in FORCES.items()]
    table = {name: {"fixed": True} for name in ("D_L", "c_W", "bed_n", "bed_t")}
    options = Options(skeleton="sections", contact="bonded")
    study = build_study(curves, TUBE, options, table, noise=Noise(force=0.05, joints=0.2))
    assert tuple(p.name for p in study.model.free) == FREE
    lane, sigma = lane_of(study, 0), jnp.ones(2)
    sharp = Tolerances(1e-14, 1e-14, 1e-14, 100)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def fitted(start, weights, force, s_c):
        """The estimate, its status, and by reverse mode the derivative of its weighted sum."""

        def theta(*data):
            moved = lane._replace(force=data[0], s_c=data[1])
            found = estimate(study.model, start, moved, sigma, None, sharp)
            return found.theta, found.status

        found, back, status = jax.vjp(theta, force, s_c, has_aux=True)
        return found, status, back(weights)

    at, one = (lane.force, lane.s_c), jnp.eye(2)
    start, status, _ = fitted(jnp.zeros(2), one[0], *at)
    assert status == FitStatus.CONVERGED
    rng = np.random.default_rng(0)
    along = tuple(jnp.asarray(rng.normal(size=v.shape)) for v in at)
    along = (0.1 * along[0], along[1])
    by = [fitted(start, weights, *at)[2] for weights in one]
    products = [sum(jnp.vdot(r, v) for r, v in zip(row, along, strict=True)) for row in by]
    h = 1e-3
    apart = [
        fitted(start, one[0], *(a + sign * h * v for a, v in zip(at, along, strict=True)))[0]
        for sign in (1, -1)
    ]
    np.testing.assert_allclose(products, (apart[0] - apart[1]) / (2 * h), rtol=1e-5)


def test_what_the_data_leave_open_does_not_move():
    """One depth tells k_1 d + k_3 d^3 alone. Derivatives were the inverse of a rounding."""
    d, force = 2.0, np.array([3.5, 3.1, 3.6])
    curve = Curve("one", "one", 20.0, 0.0, np.full(3, d), force)
    held = {"fixed": True, "value": 0.0}
    table = {"k_1": {}, "k_3": {}, "onset": held, "force_offset": held}
    options = Options(coupling="total", contact="bonded")
    study = build_study([curve], TUBE, options, table, noise=Noise(force=0.1))
    assert [(p.name, p.scale) for p in study.model.free] == [("k_1", "log"), ("k_3", "linear")]
    lane, start = lane_of(study, 0), jnp.array([0.0, 0.05])

    @functools.partial(jax.jit, compiler_options=QUICK)
    def fitted(force):
        def theta(force):
            found = estimate(study.model, start, lane._replace(force=force), jnp.ones(2))
            return found.theta, found

        return jax.jacrev(theta, has_aux=True)(force)

    by_force, found = fitted(lane.force)
    assert found.status == FitStatus.UNIDENTIFIABLE
    step = study.model.free[1].step
    k_1, k_3 = np.exp(found.theta[0]), step * found.theta[1]
    np.testing.assert_allclose(k_1 * d + k_3 * d**3, force.mean(), rtol=1e-6)
    slope = np.array([k_1 * d, step * d**3])  # of the force by theta
    by_force = by_force.reshape(2, 3)
    np.testing.assert_allclose(slope @ by_force, np.full(3, 1 / 3), rtol=1e-6)
    across = np.array([-slope[1], slope[0]])
    np.testing.assert_allclose(across @ by_force / np.linalg.norm(slope), 0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.compiling
def test_outside_of_jit_few_programs_are_compiled():
    """43, of what was one for every operation: 257 of this small model, of sections thousands."""
    curve = Curve("one", "one", 20.0, 0.0, D, 1.3 * D)
    study = build_study([curve], TUBE, Options(coupling="total"))
    lane, start = lane_of(study, 0), jnp.zeros(study.lanes.lower.shape[1])

    def theta(force):
        return estimate(study.model, start, lane._replace(force=force), jnp.ones(2)).theta

    with compilations() as counted:
        by_force = jax.jacrev(theta)(lane.force)
    assert 0 < len(counted) < 80
    assert by_force.shape == (2, *lane.force.shape)
