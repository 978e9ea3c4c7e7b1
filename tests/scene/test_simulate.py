"""The chain from the tool to the surface: against single presses, spheres, and bent meshes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from small_scenes import BALL, BARE, DOWN, MATERIAL, MESH, OFF, OUTER, TUBE, ball, poses

from jaxtrachea import (
    Presses,
    Wishes,
    make_scene,
    press,
    press_oblique,
    simulate,
    sweep,
)
from jaxtrachea.contact.shapes import box
from jaxtrachea.scene.stage import touch_tube
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.tube import make_tube

run = jax.jit(simulate)


def test_one_plane_agrees_with_vectors():
    scene = make_scene(TUBE, MATERIAL, DOWN, mesh=MESH)
    full = make_scene(TUBE, MATERIAL, DOWN, mesh=MESH, wishes=Wishes(second_plane="on"))
    assert not scene.plan.second_plane
    assert full.plan.second_plane
    a, b = (run(s, MATERIAL, DOWN) for s in (scene, full))
    for name, value in a._asdict().items():
        if value is not None and name != "status":
            np.testing.assert_allclose(value, getattr(b, name), atol=1e-12, err_msg=name)


def test_rows_off_the_plan_are_refused_by_status():
    scene = make_scene(TUBE, MATERIAL, DOWN, wishes=BARE)
    other = Presses([75.0, 75.0, 75.0], [0.0, 0.3, 0.0], [[0, -2.0, 0], [0, -2.0, 0], [1, -2.0, 0]])
    out = run(scene, MATERIAL, other)
    assert out.status.tolist() == [0, PressStatus.OFF_PLAN, PressStatus.OFF_PLAN]
    assert np.isfinite(out.force[0]).all()
    assert np.isnan(out.force[1:]).any(axis=1).all()


def test_a_ball_led_down_presses_as_deep_as_it_goes():
    path = ball([75, 1, 0], [75, -3, 0], 5)
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, wishes=BARE)
    out = run(scene, MATERIAL, path)
    # The smoothed distance is at most log(8) / beta too small (docs/contact.md): 0.1 mm here.
    np.testing.assert_allclose(out.gap, [1, 0, -1, -2, -3], atol=0.1)
    np.testing.assert_allclose(out.displacement[1:, 1], out.gap[1:], atol=1e-4)
    np.testing.assert_allclose(out.s, 75, atol=0.02)
    direct = press(TUBE, MATERIAL, jnp.asarray(75.0), -out.displacement[:, 1])
    np.testing.assert_allclose(-out.force[:, 1], direct.force, rtol=1e-3, atol=1e-9)
    assert out.status.tolist()[0] == PressStatus.NO_CONTACT
    np.testing.assert_allclose(out.force[0], 0)


def test_a_ball_beyond_the_end_is_refused_by_status():
    path = poses([75, OUTER + 3, 0], [170, OUTER - 3, 0], 2)
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, wishes=BARE)
    assert scene.plan.seat == "each"
    out = run(scene, MATERIAL, path)
    assert out.status.tolist() == [0, PressStatus.OFF_TUBE]
    assert np.isfinite(out.force[0]).all()


def test_the_dent_follows_the_tool():
    """Under the footprint no vertex stays inside the ball by more than the smoothing."""
    mesh = make_tube(TUBE, around=60, along=160, relief=0.0, flatten=0.0)
    path = ball([75, 0.5, 0], [75, -2.5, 0], 3)
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, mesh=mesh)
    out = run(scene, MATERIAL, path)
    centre = path.translation[-1]
    inside = lambda v: 5 - np.linalg.norm(np.asarray(v) - centre, axis=1).min()  # noqa: E731
    before, after = inside(mesh.vertices), inside(out.vertices[-1])
    assert before > 2.4
    assert after < 0.35  # mm; what 16 centres of 4 mm spacing leave


def test_sweep_agrees_with_single_presses_whatever_the_chunk():
    scene = make_scene(TUBE, MATERIAL, OFF, wishes=BARE)
    grid = list(itertools.product((20.0, 75.0), (-0.4, 0.0, 0.4)))
    s, phi = (jnp.array(v) for v in zip(*grid, strict=True))
    depths = jnp.full(6, 2.0)
    out = jax.jit(sweep, static_argnames="chunk")(scene, MATERIAL, s, phi, depths, chunk=4)
    assert out.status.tolist() == [0] * 6
    i = 5
    inward = -jnp.array([0, jnp.cos(phi[i]), jnp.sin(phi[i])])
    single = jax.jit(lambda s, phi, D: press_oblique(TUBE, MATERIAL, s, phi, D, axial=False))
    one = single(s[i], phi[i], 2.0 * inward)
    np.testing.assert_allclose(out.force[i], one.force @ inward, rtol=1e-12)
    np.testing.assert_allclose(
        out.compliance[i], (one.skeleton @ inward) / (one.force @ inward), rtol=1e-12
    )
    np.testing.assert_allclose(out.force[3], out.force[5], rtol=1e-9)  # mirror image


def test_a_box_touches_flat():
    flat = box([4.0, 3.0, 4.0], 0.5)
    path = poses([75, OUTER + 3.5 - 1, 0], [75, OUTER + 3.5 - 1, 0], 1)
    scene = make_scene(TUBE, MATERIAL, path, tool=flat, wishes=BARE)
    seen = touch_tube(scene, path)
    np.testing.assert_allclose(seen.gap, -1, atol=0.15)
    np.testing.assert_allclose(seen.phi, 0, atol=1e-6)
