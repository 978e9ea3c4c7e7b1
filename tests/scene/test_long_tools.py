"""Tools much larger than a patch of the wall: gaps by formula, whatever their length."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxtrachea.contact.shapes import capsule, sphere
from jaxtrachea.scene.assemble import make_scene, with_tool
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses, touch_tube
from jaxtrachea.status import ContactStatus, PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling

TUBE = table_1()
OUTER = 12.6
MATERIAL = Material(EI_L=1.862, k_M=0.1, k_1=0.3, k_3=0.02)
BARE = EffectOptions(want_surface=False, want_joints=False, want_ring_ends=False)
#: Gaps of the tool with the tube at rest, mm.
GAPS = np.array([0.3, 0.15, -0.3, -1.05])


def scene_of(tool, radius, gaps=GAPS, x=75.0):
    """A tool above the tube, its axis across; the scene and its path."""
    at = np.stack([np.full(len(gaps), x), OUTER + radius + gaps, np.zeros(len(gaps))], axis=1)
    path = Poses(np.tile(np.eye(3), (len(gaps), 1, 1)), at)
    scene = make_scene(TUBE, MATERIAL, path, tool=tool, radius=OUTER, effects=BARE)
    return scene, path


@pytest.mark.slow
def test_gaps_do_not_grow_with_the_tool():
    """The smoothing grew with the length: a shaft of 980 mm touched 0.8 mm too early.

    At a depth of 1 mm its force was twice that of one of 20 mm, with status OK.
    """
    long, short = (
        simulate(scene, MATERIAL, path)
        for scene, path in (scene_of(capsule(half, 4.0), 4.0) for half in (490.0, 10.0))
    )
    np.testing.assert_allclose(long.gap, GAPS, atol=0.09)
    assert (np.asarray(long.gap) < GAPS).all()
    assert long.status.tolist() == [PressStatus.NO_CONTACT] * 2 + [PressStatus.OK] * 2
    np.testing.assert_allclose(long.force[-1], short.force[-1], atol=0.03 * abs(short.force[-1, 1]))


@pytest.mark.slow
def test_shafts_in_all_directions_are_solved():
    """Against the distance of the axis' points to that of the tube, where the middle touches."""
    rng = np.random.default_rng(3)
    count, half, radius = 40, 490.0, 4.0
    yaw, tilt = rng.uniform(-1.4, 1.4, count), rng.uniform(-0.3, 0.3, count)
    axis = np.stack([np.sin(yaw), np.tan(tilt), np.cos(yaw)], axis=1)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=1)[:, None]
    turn = np.stack([side, np.cross(axis, side), axis], axis=2)
    at = np.stack([np.full(count, 80.0), np.full(count, OUTER + radius), np.zeros(count)], axis=1)
    along = np.linspace(-half, half, 20_001)
    points = at[:, None] + along[None, :, None] * axis[:, None]
    on = (points[..., 0] > 0) & (points[..., 0] < 160)
    distance = np.where(on, np.hypot(points[..., 1], points[..., 2]), np.inf)
    gap, place = distance.min(axis=1) - OUTER - radius, distance.argmin(axis=1)
    touched = points[np.arange(count), place, 0]
    fair = (touched > 15) & (touched < 145) & (gap > -1.5)
    assert fair.sum() > 15
    scene, _ = scene_of(capsule(half, radius), radius)
    found = jax.jit(touch_tube)(scene, Poses(turn[fair], at[fair]))
    np.testing.assert_array_equal(found.status, ContactStatus.OK)
    np.testing.assert_allclose(found.gap, gap[fair], atol=0.12)


@pytest.mark.long
def test_a_tool_of_a_plan_of_few_steps_may_change():
    """A tolerance leaves steps out; only a longer tool needs more than the one before."""
    scene, _ = scene_of(sphere(5.0), 5.0)
    few = dataclasses.replace(scene.quality, warm_steps=4)
    scene = dataclasses.replace(scene, quality=few)
    assert float(with_tool(scene, sphere(4.0)).tool.radius) == 4.0
