"""The chain from the tool to the surface: against single presses, spheres, and bent meshes."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import (
    BALL,
    BARE,
    DOWN,
    MATERIAL,
    MESH,
    OFF,
    OUTER,
    SPRINGS,
    TUBE,
    ball,
    bend,
    on_arc,
    poses,
)

from jaxtrachea import (
    EffectOptions,
    Poses,
    Presses,
    make_scene,
    press,
    press_oblique,
    simulate,
    sweep,
)
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.scene.stage import Tool
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

run, swept = jax.jit(simulate), jax.jit(sweep)


@pytest.mark.slow
def test_one_plane_agrees_with_vectors():
    scene = make_scene(TUBE, SPRINGS, DOWN, mesh=MESH)
    full = make_scene(TUBE, SPRINGS, DOWN, mesh=MESH, effects=EffectOptions(second_plane="on"))
    assert not scene.plan.second_plane
    assert full.plan.second_plane
    a, b = (run(s, SPRINGS, DOWN) for s in (scene, full))
    for name, value in a._asdict().items():
        if value is not None and name != "status":
            np.testing.assert_allclose(value, getattr(b, name), atol=1e-12, err_msg=name)


def test_rows_off_the_plan_are_refused_by_status():
    scene = make_scene(TUBE, SPRINGS, DOWN, effects=BARE)
    other = Presses([75.0, 75.0, 75.0], [0.0, 0.3, 0.0], [[0, -2.0, 0], [0, -2.0, 0], [1, -2.0, 0]])
    out = run(scene, SPRINGS, other)
    assert out.status.tolist() == [0, PressStatus.OFF_PLAN, PressStatus.OFF_PLAN]
    assert np.isfinite(out.force[0]).all()
    assert np.isnan(out.force[1:]).any(axis=1).all()


@pytest.mark.slow
def test_a_row_that_is_no_number_says_so():
    """Whatever else it is: off the plan too where the material gives more than the plan has."""
    rows = {"s": np.full(3, 75.0), "phi": np.zeros(3), "depth": np.ones(3)}
    rows["depth"][1] = np.nan
    s, phi, depth = rows.values()
    D = depth[:, None] * np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], 1)
    scene = make_scene(TUBE, SPRINGS, DOWN, effects=BARE)
    wanted = [PressStatus.OFF_PLAN, PressStatus.NON_FINITE, PressStatus.OFF_PLAN]
    out = run(scene, MATERIAL, Presses(s, phi, D))
    for got in (swept(scene, MATERIAL, s, phi, depth), out):
        assert got.status.tolist() == wanted
        assert np.any(np.isnan(got.force[1]))


@pytest.mark.slow
def test_without_a_contact_point_no_row_is_a_number():
    """The place that all rows press is that of the first: where it is NaN, nothing is known.

    Rows that press and one that does not (the first two and the last), with a surface.
    """
    path = Presses(np.full(3, 75.0), np.zeros(3), np.outer([2.0, 1.0, 0.0], [0, -1.0, 0]))
    scene = make_scene(TUBE, SPRINGS, path, mesh=MESH)
    assert scene.plan.contact_point == "fixed"
    whole = run(scene, SPRINGS, path)
    assert whole.status.tolist() == [PressStatus.OK, PressStatus.OK, PressStatus.NO_CONTACT]
    lost = dataclasses.replace(path, s=path.s.at[0].set(np.nan))
    out = run(scene, SPRINGS, lost)
    assert out.status.tolist() == [PressStatus.NON_FINITE] * 3
    assert np.isnan(out.force[:2]).any(axis=1).all()
    # In a later row it is that row alone, and the others are what they were.
    lost = dataclasses.replace(path, s=path.s.at[1].set(np.nan))
    out = run(scene, SPRINGS, lost)
    assert out.status.tolist() == [0, PressStatus.NON_FINITE, PressStatus.NO_CONTACT]
    np.testing.assert_array_equal(out.force[0], whole.force[0])


@pytest.mark.slow
def test_the_dent_follows_the_tool():
    """Under the footprint no vertex stays inside the ball by more than the smoothing."""
    mesh = make_tube(TUBE, around=60, along=160, relief=0.0, flatten=0.0)
    path = ball([75, 0.5, 0], [75, -2.5, 0], 3)
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, mesh=mesh)
    out = run(scene, MATERIAL, path)
    centre = path.translation[-1]

    def inside(v):
        return 5 - np.linalg.norm(np.asarray(v) - np.asarray(centre)[None], axis=1).min()

    before, after = inside(mesh.vertices), inside(out.vertices[-1])
    assert before > 2.4
    assert after < 0.35  # mm; what 16 centres of 4 mm spacing leave


@pytest.mark.slow
def test_sweep_agrees_with_single_presses_whatever_the_chunk():
    scene = make_scene(TUBE, MATERIAL, OFF, effects=BARE)
    grid = list(itertools.product((20.0, 75.0), (-0.4, 0.0, 0.4)))
    s, phi = (jnp.array(v) for v in zip(*grid, strict=True))
    depths = jnp.full(6, 2.0)
    # Behind the ends of the rings: nothing pressed, drawn away, pressed; before them: likewise.
    more = ([75.0] * 5, [2.8, 2.8, 2.8, 0.4, 0.4], [0.0, -1.0, 2.0, 0.0, -1.0])
    points = [jnp.append(v, jnp.array(w)) for v, w in zip((s, phi, depths), more, strict=True)]
    out = jax.jit(sweep, static_argnames="chunk")(scene, MATERIAL, *points, chunk=4)
    none, behind = PressStatus.NO_CONTACT, PressStatus.BEHIND_GAP
    assert out.status.tolist() == [0] * 6 + [none, none, behind, none, none]
    idle = np.asarray(out.status) == none
    for value in (out.force, out.indentation, out.depth_share):
        assert (np.asarray(value)[idle] == 0).all()
    assert np.isnan(out.force[8])
    i, options = 5, ObliqueOptions(axial=False)
    inward = -jnp.array([0, jnp.cos(phi[i]), jnp.sin(phi[i])])
    single = jax.jit(functools.partial(press_oblique, TUBE, MATERIAL, options=options))
    one = single(s[i], phi[i], 2.0 * inward)
    np.testing.assert_allclose(out.force[i], one.force @ inward, rtol=1e-12)
    np.testing.assert_allclose(
        out.compliance[i], (one.skeleton @ inward) / (one.force @ inward), rtol=1e-12
    )
    np.testing.assert_allclose(out.force[3], out.force[5], rtol=1e-9)  # mirror image


@pytest.mark.slow
def test_a_bent_tube_is_pressed_like_the_straight_one():
    """The same tool in the frame of the centreline there: same gap, force and motion of the skin.

    The skeleton is straight in both; what differs is the wall: patches of a bent tube end at
    planes that are not parallel, and its hollows are bridged a little differently. The radius is
    given: of a mesh with frames it is that of the geometry, which an imported one is read with.
    """
    mesh = make_tube(TUBE, around=35, along=96)
    (centre, turn), bent = on_arc(70.0, 150.0), bend(mesh, 150.0)
    led = np.array([[0, 1, 0.0], [0, -1, 0], [1.0, -3, 0.5]]) + [0, OUTER + 5, 0]
    eye = np.broadcast_to(np.eye(3), (3, 3, 3))
    paths = Poses(eye, led + [70, 0, 0]), Poses(eye @ turn, centre + led @ turn.T)
    how = {"tool": Tool(BALL, 0.66), "effects": EffectOptions(rings="mat"), "radius": OUTER}
    outs = []
    for where, path in zip((mesh, bent), paths, strict=True):
        scene = make_scene(TUBE, MATERIAL, path, mesh=where, **how)
        outs.append(run(scene, MATERIAL, path))
    straight, out = outs
    assert (straight.frame is None, out.status.tolist()) == (True, straight.status.tolist())
    np.testing.assert_allclose(out.frame, eye @ turn, atol=1e-3)
    np.testing.assert_allclose(straight.gap[:2], [1, -1], atol=0.05)  # bound of the smoothing
    for name, atol in (("gap", 0.02), ("s", 0.02), ("displacement", 0.005), ("force", 5e-4)):
        np.testing.assert_allclose(getattr(out, name), getattr(straight, name), atol=atol)
    moved = jnp.einsum("vji,rvj->rvi", bent.frames, out.vertices - bent.vertices[None])
    np.testing.assert_allclose(moved, straight.vertices - mesh.vertices[None], atol=0.01)
    assert abs(moved).max() > 2.5


def test_a_path_of_matrices_that_are_no_rotations_is_refused():
    """They gave forces of another tool, with OK; traced ones are not looked at."""
    path = ball([75, 1, 0], [75, -1, 0], 3)
    scene = make_scene(TUBE, SPRINGS, path, tool=BALL, effects=BARE)
    for wrong in (2, 0.9, -1, 0):
        bad = Poses(path.rotation.at[1].multiply(wrong), path.translation)
        message = r"path\.rotation: row 1 .* no rotation.*pose_from_vector"
        with pytest.raises(ValueError, match=message):
            make_scene(TUBE, SPRINGS, bad, tool=BALL, effects=BARE)
        with pytest.raises(ValueError, match=message):
            simulate(scene, SPRINGS, bad)
    jax.eval_shape(simulate, scene, SPRINGS, bad)


@pytest.mark.slow
def test_the_place_of_first_touch_does_not_follow_the_step():
    """It was that of the first row in the tube: with 4 rows s was off by 0.95 mm, force by 2.4 %.

    Errors fall with the square of the step. Measured with 4, 13 and 40 rows against 121: s by 4e-4,
    9e-5, 1e-5 mm, force by 1.5e-4, 3e-5, 5e-6 of it; before s by 0.95, 0.20, 0.027 mm, force by
    2.4e-2, 7e-3, 1e-3.
    """

    def way(rows):  # filled up by its last pose: one program for all
        led = poses([78, 19, 2], [81, 14.5, 3.5], rows)
        return jax.tree.map(lambda v: v[jnp.minimum(jnp.arange(121), rows - 1)], led)

    effects = dataclasses.replace(BARE, contact_point="fixed")
    scene = make_scene(TUBE, MATERIAL, way(4), tool=BALL, effects=effects)
    fine, *coarse = (run(scene, MATERIAL, way(rows)) for rows in (121, 40, 13, 4))
    known = np.asarray(fine.force[-1])
    for out, at, share in zip(coarse, (1e-4, 1e-3, 4e-3), (3e-5, 2e-4, 1e-3), strict=True):
        assert out.status[-1] == PressStatus.OK
        assert abs(out.s[-1] - fine.s[-1]) < at
        assert abs(out.phi[-1] - fine.phi[-1]) * OUTER < at
        off = np.linalg.norm(np.asarray(out.force[-1]) - known)
        assert off < share * np.linalg.norm(known)


@pytest.mark.long
@pytest.mark.parametrize("mu", [None, 0.5])
def test_what_is_clear_of_a_round_wall_does_not_press(mu):
    """The tangent plane at the place of first touch lies above a round wall beside it.

    A ball glides round the tube 0.2 mm clear of it, presses, lifts off and glides on: it touches
    where its middle is nearer to the axis than both radii.
    """
    aside = np.linspace(-4, 0, 6) / (OUTER + 5.2)
    height = np.r_[np.full(5, 5.2), 5.2, 4.4, 3.4, 5.2, np.full(5, 5.2)]
    angle = np.r_[aside[:-1], 0, 0, 0, 0, -aside[-2::-1]]
    r = OUTER + height
    places = np.stack([0 * r + 75, r * np.cos(angle), r * np.sin(angle)], axis=1)
    path = Poses(np.broadcast_to(np.eye(3), (len(r), 3, 3)), places)
    scene = make_scene(TUBE, SPRINGS, path, tool=Tool(BALL, mu), effects=BARE)
    assert scene.plan.contact_point == "fixed"
    out = jax.device_get(run(scene, SPRINGS, path))
    touches = height < 5
    np.testing.assert_array_equal(out.status == PressStatus.OK, touches)
    np.testing.assert_array_equal(out.status == PressStatus.NO_CONTACT, ~touches)
    np.testing.assert_array_equal(out.force[~touches], 0)
    alone = press(TUBE, SPRINGS, 75.0, -out.gap[touches])
    np.testing.assert_allclose(-out.force[touches, 1], alone.force, rtol=1e-5)


@pytest.mark.slow
def test_derivatives_by_the_rows_that_the_first_touch_lies_between():
    """Forward, reverse and by differences, with a row before the touch and without one."""
    path = poses([78, 19, 2], [81, 14.5, 3.5], 4)
    effects = dataclasses.replace(BARE, contact_point="fixed")
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, effects=effects)

    @jax.jit
    def force(x):
        return simulate(scene, MATERIAL, Poses(path.rotation, x)).force[-1]

    x = path.translation
    one, back = jax.jit(jax.jacfwd(force))(x), jax.jit(jax.jacrev(force))(x)
    np.testing.assert_allclose(one, back, atol=1e-9)
    way = np.random.default_rng(3).normal(size=x.shape)
    differences = (force(x + 1e-4 * way) - force(x - 1e-4 * way)) / 2e-4
    np.testing.assert_allclose(np.tensordot(one, way, 2), differences, rtol=1e-5, atol=1e-8)
    assert np.abs(one[:, 1]).max() > 1e-4  # by the row before
    pressed = x.at[:2].set(x[2])
    assert np.isfinite(jax.jit(jax.jacrev(force))(pressed)).all()
