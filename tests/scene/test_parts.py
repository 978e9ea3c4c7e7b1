"""Scenes of a tool of several parts are those of the part that touches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BARE, MATERIAL, OUTER, TUBE

import jaxtrachea as jt
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.contact.shapes import Shape, compound, sphere
from jaxtrachea.scene.lumen import in_lumen
from jaxtrachea.scene.stage import Tool, touch_tube

pytestmark = [pytest.mark.long, pytest.mark.compiling]


RUBBED = dataclasses.replace(
    BARE, contact_point="fixed", friction="on", axial="on", second_plane="on", want_joints=False,
    want_ring_ends=False,
)  # fmt: skip
#: The second ball hangs 12 mm beside the first and 6 mm higher.
AT = np.array([[0.0, 0, 0], [12, 6, 0]])
BALLS = compound([sphere(5.0)] * 2, [pose_from_vector(jnp.zeros(3), jnp.asarray(at)) for at in AT])
ALONE = Shape(BALLS.vertices[0], BALLS.radius[0])


def made(tool, start):
    return jt.make_scene(TUBE, MATERIAL, start, tool=Tool(tool, 0.3), effects=RUBBED)


def way():
    """Down, aside and up again, with rubbing."""
    corners = np.array([[75, 0.5, 0], [75, -1.5, 0], [76, -1.5, 0.3], [76, 0.5, 0.3]])
    share = np.linspace(0, 3, 25)
    at = np.minimum(share.astype(int), 2)
    places = corners[at] + (share - at)[:, None] * np.diff(corners, axis=0)[at]
    return jt.Poses(np.tile(np.eye(3), (25, 1, 1)), places + [0, OUTER + 5, 0])


def test_the_part_that_touches_alone():
    path = way()
    found, expected = (jt.simulate(made(v, path), MATERIAL, path) for v in (BALLS, ALONE))
    assert np.max(-np.asarray(found.force)[:, 1]) > 0.05
    assert np.asarray(found.status).max() <= 1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found, expected)


def test_one_part_in_the_lumen_is_enough():
    """One jaw within, the other outside of the tube; and both outside."""
    jaws = compound(
        [sphere(2.0)] * 2,
        [pose_from_vector(jnp.zeros(3), jnp.array([0, y, 0.0])) for y in (0.0, 18)],
    )
    path = jt.Poses(np.eye(3)[None], np.array([[75, 0.0, 0.0]]))
    outside = jt.Poses(np.eye(3)[None], np.array([[75, OUTER + 1.0, 0.0]]))
    scene = made(jaws, path)
    inside = jax.jit(lambda path: in_lumen(scene, path, touch_tube(scene, path)))
    assert inside(path).tolist() == [True]
    assert inside(outside).tolist() == [False]


@pytest.mark.slow
def test_a_session_of_parts():
    """As that of the part alone; a tool of other sizes, not one of other parts; in a batch."""
    path = way()
    scene = made(BALLS, path)
    session, alone = jt.Session(scene, MATERIAL), jt.Session(made(ALONE, path), MATERIAL)
    for pose in zip(path.rotation, path.translation, strict=True):
        found, expected = session.step(*pose), alone.step(*pose)
        assert found.status == expected.status
        np.testing.assert_allclose(found.force, expected.force, atol=1e-9)
    smaller = dataclasses.replace(BALLS, radius=BALLS.radius * 0.9)
    session.set_tool(smaller)
    assert np.all(session.step(path.rotation[0], path.translation[0]).force == 0)
    with pytest.raises(ValueError, match="tool.vertices"):
        session.set_tool(sphere(5.0))
    state = jt.init_state(scene, MATERIAL)
    many = jax.jit(jax.vmap(lambda R, T: jt.step(scene, MATERIAL, state, R, T)[1].force))
    one = jt.step(scene, MATERIAL, state, path.rotation[8], path.translation[8])[1].force
    np.testing.assert_allclose(many(path.rotation, path.translation)[8], one, atol=1e-9)
