"""What it is good for: a material read off a deformed surface, a network trained through it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from small_scenes import BARE, DOWN, MATERIAL, TUBE

from jaxtrachea import Presses, make_scene, simulate

pytestmark = pytest.mark.compiling


@pytest.mark.slow
def test_a_network_learns_which_motion_reaches_a_force():
    """Depth of the tool from the force wanted: nothing is shown to it but the simulated force."""
    scene = make_scene(TUBE, MATERIAL, DOWN, effects=BARE)
    wanted = jnp.linspace(0.05, 0.6, 12)

    def forces(depths):
        D = jnp.stack([0 * depths, -depths, 0 * depths], axis=1)
        at = jnp.full(12, 75.0), jnp.zeros(12)
        return -simulate(scene, MATERIAL, Presses(*at, D)).force[:, 1]

    def loss(net):
        return jnp.mean((forces(jax.vmap(net)(wanted[:, None])[:, 0]) - wanted) ** 2)

    net = eqx.nn.MLP(1, 1, 8, 1, jnp.tanh, jax.nn.softplus, key=jax.random.key(0))
    optimiser = optax.adam(0.03)

    def step(carry, _):
        net, memory = carry
        value, slope = jax.value_and_grad(loss)(net)
        change, memory = optimiser.update(slope, memory)
        return (eqx.apply_updates(net, change), memory), value

    net, fixed = eqx.partition(net, eqx.is_inexact_array)
    whole = loss

    def loss(net):
        return whole(eqx.combine(net, fixed))

    train = jax.jit(lambda c: jax.lax.scan(step, c, length=600))
    with jax.numpy_dtype_promotion("standard"):  # optax counts in int32
        (net, _), losses = train((net, optimiser.init(net)))
    found = jax.jit(lambda net: forces(jax.vmap(eqx.combine(net, fixed))(wanted[:, None])[:, 0]))(
        net
    )
    assert losses[-1] < 1e-3 * losses[0]
    np.testing.assert_allclose(found, wanted, atol=0.02)
