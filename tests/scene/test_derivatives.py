"""Derivatives through the whole chain: forward = reverse = finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, MATERIAL, TUBE, ball

from jaxtrachea import EffectOptions, Poses, Presses, make_scene, simulate, with_geometry
from jaxtrachea.scene.stage import Tool
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

COARSE = make_tube(TUBE, around=5, along=11)  # no row on a ring, where the ends have a kink
FAST = {"xla_backend_optimization_level": 0}


def derivatives(f, x, directions):
    """Values, forward, reverse and finite differences of all results along directions, as rows.

    Reverse mode along one direction of the results is set against forward mode by their product.
    Values and forward mode are one loop over all points, so that `f` is compiled once for both.
    """
    h, count = 1e-5, len(directions)
    points = x[None, None] + h * jnp.array([0, 1, -1, 2, -2.0])[:, None, None] * directions[None]
    along = jnp.tile(directions, (5, 1))
    values, slopes = jax.lax.map(
        lambda at: jax.jvp(f, (at[0],), (at[1],)), (points.reshape(-1, x.size), along)
    )
    value, jvps = values[0], slopes[:count]
    near = values[count:].reshape(4, count, -1)
    steps = (8 * (near[0] - near[1]) - (near[2] - near[3])) / (12 * h)  # fourth order
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(2, value.size)))
    pull = jax.vjp(f, x)[1]
    back = jax.lax.map(lambda w: pull(w)[0], weights)
    return value, jvps, weights @ jvps.T, back @ directions.T, steps


def agree(f, x, directions, tolerance):
    """The truncation error is h^4 f^(5) / 30; rounding 1e-16 |f| / h: below 1e-9 of the scale."""
    made = jax.jit(derivatives, static_argnums=0, compiler_options=FAST)(f, x, directions)
    value, jvps, forward, reverse, steps = made
    assert np.isfinite(value).all()
    np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-9 * abs(forward).max())
    scale = np.maximum(np.abs(jvps).max(axis=1, keepdims=True), 1e-3)  # some are exactly zero
    np.testing.assert_allclose(jvps / scale, steps / scale, atol=tolerance)


def flat(out):
    """Force, joints and every vertex in one row."""
    return jnp.concatenate([v.ravel() for v in (out.force, out.joints, out.vertices)])


def changed(scene, material, x):
    """Nine numbers into the material (logarithms) and the geometry."""
    k = jnp.exp(x[:6])
    names = ("k_M", "k_1", "k_3", "EI_L", "EA_L", "EI_C")
    new = {name: getattr(material, name) * k[i] for i, name in enumerate(names)}
    g = scene.geometry
    shift = jnp.linspace(-1.0, 1.0, g.rings) * x[8]
    g = dataclasses.replace(
        g, length=g.length + x[6], radius=g.radius + x[7], ring_positions=g.ring_positions + shift
    )
    return with_geometry(scene, g), dataclasses.replace(material, **new)


@pytest.mark.slow
def test_of_the_tools_pose_the_material_and_the_geometry():
    """Friction, axial motion, a dent shaped by the tool; in contact from the second row on."""
    path = ball([74, 0.4, 0.5], [76, -2.0, 1.0], 3)
    scene = make_scene(
        TUBE,
        MATERIAL,
        path,
        tool=Tool(BALL, 0.66),
        mesh=COARSE,
        effects=EffectOptions(rings="mat"),
    )
    plan = scene.plan
    assert (plan.friction, plan.axial, plan.dent) == (True, True, 16)

    def f(x):
        there, m = changed(scene, MATERIAL, x[:9])
        return flat(
            simulate(there, m, Poses(path.rotation, path.translation + x[9:].reshape(3, 3)))
        )

    directions = np.eye(18)[[0, 1, 3, 4, 6, 8, 9, 13, 17]]
    agree(f, jnp.zeros(18), jnp.asarray(directions), 1e-6)


@pytest.mark.slow
def test_at_first_touch_on_a_ring_at_rest_and_before():
    """Bending rings, on the sixth ring and off the midline.

    Rows: pressed hard; in the smooth first touch; at its very beginning (no displacement); the
    tool away. Not by the ring positions: the joint under C follows the peak of the axial motion,
    a kink.
    """
    depth = np.array([3.0, 5e-4, 0.0, -0.5])
    inward = np.array([0.2, -np.cos(0.3), -np.sin(0.3)])
    path = Presses(np.full(4, 60.0), np.full(4, 0.3), depth[:, None] * inward)
    effects = EffectOptions(second_plane="on", axial="on", rings="arch2")
    scene = make_scene(TUBE, MATERIAL, path, mesh=COARSE, effects=effects)

    def f(x):
        there, m = changed(scene, MATERIAL, x[:9])
        D = path.displacement + 1e-3 * x[9:].reshape(4, 3)
        return flat(simulate(there, m, Presses(path.s, path.phi, D)))

    directions = np.eye(21)[[0, 1, 5, 6, 9, 10, 13, 16, 20]]
    agree(f, jnp.zeros(21), jnp.asarray(directions), 2e-6)
