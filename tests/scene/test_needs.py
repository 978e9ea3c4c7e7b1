"""A plan serves the path that it is made for, however little a row moves beside its press."""

import dataclasses

import jax
import numpy as np
import pytest
from late import late
from small_scenes import BALL, BARE, SPRINGS, TUBE

from jaxtrachea import Poses, Presses, Session, make_scene, simulate
from jaxtrachea.scene.approach import approach
from jaxtrachea.scene.needs import COVERED, PLANNED
from jaxtrachea.scene.refusals import refuse
from jaxtrachea.scene.stage import Tool
from jaxtrachea.status import PressStatus

pytestmark = pytest.mark.long

OK, NO, OFF_PLAN = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.OFF_PLAN
ONE = dataclasses.replace(BARE, want_joints=False, want_ring_ends=False)
#: Along the tube it gives, or not.
MATERIALS = {True: SPRINGS, False: dataclasses.replace(SPRINGS, EA_L=None)}


def off_plan(scene, material, path):
    """Rows that the plan says it does not serve."""
    given = isinstance(path, Presses)
    made = None if given else jax.jit(lambda path: approach(scene, path)._replace(pull=None))(path)
    refused = refuse(scene, material, path if given else None, made, np.asarray(False))[3]
    return np.asarray(refused.get(PressStatus.OFF_PLAN, False))


#: What moves beside a press straight in: the place by s or phi, or the tool by x, y, z.
BESIDE = np.eye(5)


@pytest.mark.parametrize("friction", [None, 0.5])
@pytest.mark.parametrize("stretches", MATERIALS)
@pytest.mark.parametrize("beside", [*BESIDE, np.ones(5)], ids=[*"spxyz", "all"])
def test_presses_with_a_jitter(beside, stretches, friction):
    """From 10 nm to 20 um, beside presses from a micrometre to 10 mm."""
    rng = np.random.default_rng(0)
    material = MATERIALS[stretches]
    for size in np.geomspace(1e-5, 0.02, 8):
        jitter = size * rng.choice([-1, 0, 0, 1], (4, 1)) * rng.uniform(0, 1, (4, 5)) * beside
        depth = np.sort(10.0 ** rng.uniform(-3, 1, 4))
        D = jitter[:, 2:] - depth[:, None] * [0, 1, 0]
        path = Presses(75 + jitter[:, 0], jitter[:, 1], D)
        scene = make_scene(TUBE, material, path, tool=Tool(friction=friction), effects=ONE)
        assert not off_plan(scene, material, path).any(), (size, depth, jitter)


@pytest.mark.parametrize("where", [(0, 0), (0, 1), (0.9, 0), (0.9, 1)])
def test_a_plan_counts_what_a_row_is_refused_for(where):
    """Just beyond the border of each; between both a program of vectors serves what it need not."""
    phi, along = where
    for share, level in ((0.99 * PLANNED, False), (1.01 * PLANNED, True), (COVERED, True)):
        inward = np.array([0, -np.cos(phi), -np.sin(phi)])
        beside = np.array([1, 0, 0] if along else [0, -np.sin(phi), np.cos(phi)])
        D = [2 * inward + share * 3 * beside, 4 * inward]
        plan = make_scene(TUBE, SPRINGS, Presses([75.0] * 2, [phi] * 2, D), effects=ONE).plan
        assert plan.axial == (level and bool(along))
        assert plan.second_plane == (level or phi > 0)


def test_what_is_no_number_hides_no_row():
    """The largest of a path with a NaN was none: a row of 1 mm aside was off its own plan."""
    D = [[0, -1.0, 0], [0, np.nan, 0], [0, -6, 1]]
    path = Presses([75.0] * 3, [0.0] * 3, D)
    scene = make_scene(TUBE, SPRINGS, path, effects=ONE)
    assert scene.plan.second_plane
    assert not off_plan(scene, SPRINGS, path).any()


def led(places):
    """The ball's middle, without turning."""
    return Poses(np.tile(np.eye(3), (len(places), 1, 1)), np.asarray(places, float))


#: Beside a press of 12 mm: 0.001 mm along the tube.
DOWN = np.linspace(18, 5.6, 25)
JITTER = 1e-3 * (np.arange(25) % 3 == 2)
LED = {
    "along": ([[75 + j, y, 0] for j, y in zip(JITTER, DOWN, strict=True)], {}),
    "drawn": (
        [[75, 18.5, 0], [75, 17, 0], [75, 17.6, 0], [75, 18.5, 0.3], [75.5, 19, 0.3]],
        {"contact": "bonded"},
    ),
}


@pytest.mark.parametrize("way", ["along", *late("drawn")])
def test_a_tool_with_a_jitter(way):
    """Also of a tool that is glued, and pulled aside after it has pressed."""
    path, effects = led(LED[way][0]), dataclasses.replace(ONE, **LED[way][1])
    scene = make_scene(TUBE, SPRINGS, path, tool=BALL, effects=effects)
    assert not off_plan(scene, SPRINGS, path).any()


@pytest.mark.slow
@pytest.mark.compiling
def test_a_tool_with_a_jitter_is_pressed_in_every_row():
    """10 of 28 rows of a path of three decimals were NaN.

    Forces are those without the jitter of 0.001 mm: no press of 12 mm is stiffer than its local law
    there, k_1 + k_3 d^2 = 3.2 N/mm along the surface.
    """
    path, still = led(LED["along"][0]), led([[75, y, 0] for y in DOWN])
    scene = make_scene(TUBE, SPRINGS, path, tool=BALL, effects=ONE)
    assert (scene.plan.second_plane, scene.plan.axial) == (True, True)
    found, alone = (jax.jit(simulate)(scene, SPRINGS, v) for v in (path, still))
    assert found.status.tolist() == alone.status.tolist()
    assert set(found.status.tolist()) == {OK, NO}
    np.testing.assert_allclose(found.force, alone.force, atol=3.2e-3)
    session = Session(scene, SPRINGS)
    steps = [int(session.step(np.eye(3), place).status) for place in path.translation]
    assert steps == found.status.tolist()
