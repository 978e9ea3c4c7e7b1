"""Where a plan and its levels hold: every row is answered as by a plan of its own, or refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp
from small_scenes import (
    BALL,
    BARE,
    DOWN,
    MATERIAL,
    MESH,
    OFF,
    SPRINGS,
    TUBE,
    ball,
    bend,
    on_arc,
    poses,
    presses,
)

from jaxtrachea import Poses, Presses, Session, make_scene, simulate, sweep
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.scene.assemble import with_mesh
from jaxtrachea.scene.build import dropped_effects
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.plan import ValidRange
from jaxtrachea.scene.ranges import depth_share, lacking, outside_plan
from jaxtrachea.scene.refusals import status_of, without_negative_values
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.stage import Tool
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.sizes import SizeError
from jaxtrachea.trachea.tube import make_tube

pytestmark = [pytest.mark.long, pytest.mark.compiling]

run = jax.jit(simulate)
OK, OFF_PLAN = PressStatus.OK, PressStatus.OFF_PLAN
#: Forces only: quick to compile.
ONE = dataclasses.replace(BARE, want_joints=False, want_ring_ends=False)
VECTORS = dataclasses.replace(ONE, second_plane="on")


def needing_more(scene, material, presses):
    """Rows that press and are off the plan."""
    pressing = jnp.ones(len(presses.s), bool)
    asked = jax.jit(outside_plan)(scene, material, presses, pressing)
    return [0] * len(presses.s) if asked is None else np.asarray(asked).astype(int).tolist()


#: Rows along the tube: none, a little, a lot.
LED = Presses([75.0] * 3, [0.5] * 3, [[0, -3, -1.0], [0.5, -3, -1], [4, -3, -1]])


def test_a_plan_without_stretch_refuses_a_path_along_the_tube():
    """It gave 8 times the force with OK: the ligament cannot stretch in it."""
    scene = make_scene(TUBE, SPRINGS, OFF, effects=ONE)
    assert not scene.plan.axial
    out = run(scene, SPRINGS, LED)
    assert out.status.tolist() == [OK, OFF_PLAN, OFF_PLAN]
    assert np.isnan(out.force[1:]).all()
    # Left out because the user says so, or because the material has no EA_L: as it was.
    wished = make_scene(TUBE, SPRINGS, OFF, effects=dataclasses.replace(ONE, axial="off"))
    stiff = dataclasses.replace(SPRINGS, EA_L=None)
    assert needing_more(scene, SPRINGS, LED) == [0, 1, 1]
    assert needing_more(wished, SPRINGS, LED) == needing_more(scene, stiff, LED) == [0, 0, 0]


#: A press at 60 degrees.
ASIDE = Presses([75.0], [1.0], [[0, -2 * np.cos(1.0), -2 * np.sin(1.0)]])


def test_what_a_material_gives_and_a_plan_lacks():
    """By name; and rows that need it, with one program of small ones."""
    scene = make_scene(TUBE, SPRINGS, ASIDE, effects=ONE)
    assert scene.plan.rings == "mat"
    more = dataclasses.replace(MATERIAL, GA_L=jnp.array(9.0), k_1_ring=jnp.array(0.6))
    assert lacking(scene, SPRINGS) == ["axial"]
    assert lacking(scene, MATERIAL) == ["rings", "axial"]
    assert lacking(scene, more) == ["rings", "axial", "shear", "two_material"]
    assert needing_more(scene, SPRINGS, ASIDE) == [0]
    assert needing_more(scene, MATERIAL, ASIDE) == [1]


def test_ends_that_move_and_a_dent_are_effects_too():
    """The surface stayed at its ends, or flat under the tool, with OK."""
    path = presses([-2, -4, 0], s=75.0)
    scene = make_scene(TUBE, SPRINGS, path, mesh=MESH)
    soft = dataclasses.replace(SPRINGS, k_A=jnp.array(0.2))
    assert scene.plan.axial
    assert needing_more(scene, SPRINGS, path) == [0, 0, 0]
    assert needing_more(scene, soft, path) == [1, 1, 1]
    held = dataclasses.replace(scene.plan, ignored=frozenset({"end_motion"}))
    assert needing_more(dataclasses.replace(scene, plan=held), soft, path) == [0, 0, 0]
    short = dataclasses.replace(MESH, s=MESH.s / 4)  # the surface ends at 40 mm
    far = make_scene(TUBE, SPRINGS, path, mesh=short)
    assert far.plan.dent == 0
    assert needing_more(far, SPRINGS, path) == [0, 0, 0]
    assert needing_more(far, SPRINGS, presses([-2, -4, 0], s=30.0)) == [1, 1, 1]


def test_a_negative_friction_is_a_bad_material():
    scene = make_scene(TUBE, SPRINGS, presses([-2, -4, 0]), tool=Tool(friction=0.5), effects=ONE)
    assert scene.plan.friction
    for mu, expected in ((0.5, False), (-0.1, True)):
        scene = dataclasses.replace(scene, friction=jnp.asarray(mu))
        assert bool(without_negative_values(scene, SPRINGS)[1]) == expected


def test_another_mesh_says_whether_it_is_bent():
    """A program for a straight mesh took the motions of a bent one as they were."""
    scene = make_scene(TUBE, SPRINGS, DOWN, mesh=MESH)
    scene = dataclasses.replace(scene, plan=dataclasses.replace(scene.plan, contact=True))
    assert not scene.plan.curved
    bent = with_mesh(scene, bend(MESH, 200.0))
    assert bent.plan.curved
    assert not with_mesh(bent, MESH).plan.curved


@pytest.mark.slow
def test_a_plan_without_bending_rings_refuses_a_material_with_them():
    """Rings as springs at 60 degrees were 83 % off, with OK, in sweeps too."""
    material, expected = MATERIAL, OFF_PLAN
    scene = make_scene(TUBE, SPRINGS, ASIDE, effects=ONE)
    assert run(scene, material, ASIDE).status.tolist() == [expected]
    out = jax.jit(sweep)(scene, material, [75.0] * 3, [1.0] * 3, [2.0, 0.0, -1.0])
    assert out.status.tolist() == [expected, PressStatus.NO_CONTACT, PressStatus.NO_CONTACT]
    assert np.isnan(out.force[0]) == (expected == OFF_PLAN)
    assert out.force[1:].tolist() == [0, 0]


def test_a_plan_of_a_tolerance_serves_what_it_was_measured_for():
    """Rings as springs, right within 1 % at the place measured, are nowhere near it elsewhere."""
    valid_range = ValidRange((70.0, 80.0), angle=0.1, along=0.0, across=0.0, inward=3.0)
    path = Presses(
        [75.0, 75, 75, 75, 90], [0.0, 0.5, 0.0, 0.0, 0.0],
        [[0, -3.0, 0], [0, -2, -1], [1, -3, 0], [0, -4, 0], [0, -3, 0]],
    )  # fmt: skip
    effects = dataclasses.replace(ONE, rings="mat", axial="off")
    scene = make_scene(TUBE, MATERIAL, path, effects=effects)
    chosen = dataclasses.replace(
        scene, plan=dataclasses.replace(scene.plan, valid_range=valid_range)
    )
    assert needing_more(scene, MATERIAL, path) == [0] * 5
    assert needing_more(chosen, MATERIAL, path) == [0, 1, 1, 1, 1]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"length": 1200.0}, "geometry.length is 1200 mm"),
        ({"length": 0.16}, "It would be 160 mm"),
        ({"radius": 0.0113}, "geometry.radius is 0.0113 mm"),
        ({"outer": 30.0}, "radius of the outside is 30 mm"),
        ({"tool": 1000.0}, "tool is 2000 mm across; expected at most 1000 mm"),
    ],
)
def test_sizes_of_another_unit_are_refused_with_the_cause(change, says):
    """A tool of a metre's radius and a tube of 1.2 m were taken."""
    own = {k: jnp.asarray(v) for k, v in change.items() if k in ("length", "radius")}
    tube, path = dataclasses.replace(TUBE, **own), ball([0.08, 1, 0], [0.08, -2, 0])
    tool = sphere(change.get("tool", 5.0))
    with pytest.raises(SizeError, match=says) as caught:
        make_scene(tube, MATERIAL, path, tool=tool, effects=BARE, radius=change.get("outer"))
    assert "unit" in str(caught.value)


def test_a_wall_thicker_than_the_radius_is_refused():
    with pytest.raises(ValueError, match=r"wall is 12 mm, thicker than the radius of 11.3 mm"):
        make_tube(TUBE, wall=12.0)


def test_the_outside_is_that_of_the_mesh():
    """Of an imported mesh it was taken 1.3 mm too large."""
    mesh, bare = make_tube(TUBE, around=36, along=160, wall=2.0), {"effects": BARE}
    assert float(make_scene(TUBE, MATERIAL, OFF, mesh=mesh, **bare).radius) == pytest.approx(12.3)
    imported = dataclasses.replace(TUBE, radius=jnp.asarray(12.3))
    scene = make_scene(imported, MATERIAL, OFF, mesh=bend(mesh, 200.0), **bare)
    assert float(scene.radius) == pytest.approx(12.3)


def test_what_a_linear_ring_leaves_out():
    """The figures of `ranges.DEEPEST`: a pinched ring by the elastica, radius and EI 1."""
    s = np.linspace(0, np.pi / 2, 40)
    y, way = np.stack([s, np.ones(40), np.sin(s), 1 - np.cos(s)]), []

    def curve(_, y, load):
        return np.stack([y[1], load / 2 * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

    loads = np.linspace(0.5, 5.0, 10)
    for load in loads:  # a quarter of the ring, from the point of the load to the side
        found = solve_bvp(
            lambda s, y: curve(s, y, load),  # noqa: B023
            lambda a, b: np.array([a[0], b[0] - np.pi / 2, a[2], a[3]]), s, y, tol=1e-5,
        )  # fmt: skip
        assert found.success
        y = found.sol(s)
        way.append(2 - 2 * y[3, -1])
    linear = loads * (np.pi / 4 - 2 / np.pi)
    softer = [1 - np.interp(d, way, linear) / d for d in (0.25, 0.5, 1.0)]
    np.testing.assert_allclose(softer, [0.15, 0.25, 0.35], atol=0.01)


def test_presses_of_a_tool_that_need_friction_or_another_seat():
    """As the tool's way gives them: a tool with friction was stuck, and dragged its first place."""
    plain = make_scene(TUBE, SPRINGS, DOWN, effects=dataclasses.replace(VECTORS, axial="off"))
    plan = dataclasses.replace(plain.plan, contact=True)
    smooth = dataclasses.replace(plain, plan=plan)
    rough = dataclasses.replace(smooth, friction=jnp.asarray(0.66))
    wished = dataclasses.replace(plan, ignored=plan.ignored | {"friction"})
    still = dataclasses.replace(rough, plan=wished)
    way = Presses([75.0] * 4, [0.0] * 4, [[0, -1.0, 0], [2, -2, 0], [0, -2, 0], [20, -1, 0]])
    assert needing_more(smooth, SPRINGS, way) == [0, 0, 0, 1]  # beyond half a ring spacing
    assert needing_more(rough, SPRINGS, way) == [0, 1, 1, 1]  # what slid leaves its trace
    assert needing_more(still, SPRINGS, way) == [0, 0, 0, 1]


@pytest.mark.slow
def test_friction_and_a_seat_that_the_plan_has_not_are_refused():
    """A tool with friction was stuck along the surface, and dragged its first place anywhere."""
    down, led = ball([75, 1, 0], [75, -2, 0]), ball([75, 1, 0], [78, -2, 0])
    far = ball([75, -1, 0], [95, -1, 0])
    unstretched = dataclasses.replace(VECTORS, axial="off")
    rough = make_scene(TUBE, SPRINGS, down, tool=Tool(BALL, 0.66), effects=unstretched)
    smooth = make_scene(TUBE, SPRINGS, led, tool=BALL, effects=ONE)
    assert run(rough, SPRINGS, down).status.tolist() == [1, OK, OK, OK]
    assert run(rough, SPRINGS, led).status.tolist() == [1, OFF_PLAN, OFF_PLAN, OFF_PLAN]
    assert (smooth.plan.contact_point, smooth.plan.axial) == ("fixed", True)
    assert run(smooth, SPRINGS, far).status.tolist() == [OK] + [OFF_PLAN] * 3


@pytest.mark.slow
def test_rows_that_do_not_press_are_no_contact_wherever_they_are():
    """Behind the ends they were NaN; off the midline OFF_PLAN in a program of one plane."""
    around = [0.0, 0.5, 2.5]
    normal = np.array([[0, np.cos(v), np.sin(v)] for v in around])
    away = poses([75, 0, 0], [75, 0, 0], 3)
    start = poses([40, 12, 0], [100, 12, 0], 3)
    scene = make_scene(TUBE, MATERIAL, start, tool=sphere(1.0), effects=ONE)
    assert (scene.plan.contact_point, scene.plan.second_plane) == ("per_step", True)
    for height, expected in ((14.0, [1, 1, 1]), (12.0, [0, 0, 5])):
        path = dataclasses.replace(away, translation=jnp.asarray(height * normal + [75, 0, 0]))
        out = run(scene, MATERIAL, path)
        assert out.status.tolist() == expected
        assert height < 14 or (np.asarray(out.force) == 0).all()


def test_force_is_continuous_across_the_midline():
    """With EI_C and k_t: 0.351 N up to 5e-5 rad, 0.256 N from 1e-4 rad on.

    Steps of 0.01 degrees and a press of 2 mm; no press is stiffer than its local law, whose slope
    is at most k_1 + 3 k_3 d^2 = 0.54 N/mm, and the tool's place moves by 2 mm times the angle.
    """
    steps = np.radians(np.linspace(-2, 2, 401))
    hair = [5e-5, 9.9e-5, 1.01e-4, 1e-3]
    plans = [make_scene(TUBE, MATERIAL, normal([v]), effects=ONE).plan for v in (0.0, *hair)]
    assert all(plan == plans[0] for plan in plans)
    assert plans[0].rings == "arch2"
    effects = dataclasses.replace(ONE, contact_point="per_step")
    path = normal([*steps, *hair])
    scene = make_scene(TUBE, MATERIAL, path, effects=effects)
    out = run(scene, MATERIAL, path)
    force, middle = np.asarray(out.force), 200
    assert (np.asarray(out.status) == OK).all()
    jumps = np.linalg.norm(np.diff(force[:401], axis=0), axis=1)
    assert jumps.max() < 0.54 * 2 * np.radians(0.01)
    size = np.linalg.norm(force, axis=1)
    np.testing.assert_allclose(size[401:], size[middle], rtol=1e-5)
    np.testing.assert_allclose(size[:middle], size[400:middle:-1], rtol=1e-9)  # mirror image


def normal(angles):
    """A press of 2 mm along the normal at each angle."""
    angles = np.asarray(angles, float)
    inward = np.stack([0 * angles, -np.cos(angles), -np.sin(angles)], 1)
    return Presses(np.full(len(angles), 75.0), angles, 2 * inward)


#: Rows of the paths that one program is compiled for.
ROWS = 18


@pytest.fixture(scope="module")
def through():
    """A ball driven 50 mm through the tube: scene, path, result."""
    path = ball([75, 1, 0], [75, -50, 0], ROWS)
    scene = make_scene(TUBE, SPRINGS, path, tool=BALL, effects=ONE)
    assert scene.plan.contact_point == "fixed"
    return scene, path, run(scene, SPRINGS, path)


def too_deep(path, out, contact_point):
    """What is asserted of the ball driven through."""
    depth = np.maximum(-(np.asarray(path.translation)[:, 1] - 5 - 12.6), 0)
    deep = depth > 13.0
    assert (np.asarray(out.status)[deep] != OK).all()
    assert (np.asarray(out.status)[(depth > 0) & (depth < 12)] == OK).all()
    shallow = (depth < 12) & (depth > 0)
    share = np.asarray(out.depth_share)
    np.testing.assert_allclose(share[shallow], depth[shallow] / 12.6, atol=0.02)
    # Contact: sure down to the axes of ball and tube, without a mesh (log(8) / beta: 0.1 mm).
    sure = np.asarray(out.contact_share)[shallow]
    np.testing.assert_allclose(sure, depth[shallow] / 17.6, atol=0.1 / 17.6)
    if contact_point == "fixed":
        assert out.status[-1] == PressStatus.TOO_DEEP
        np.testing.assert_allclose(share[-1], 50 / 12.6, atol=0.02)


@pytest.mark.slow
def test_a_tool_driven_through_the_tube_is_beyond_its_range(through):
    """It was OK with 3.5 to 5 N: the wall may go as far as the axis of the tube."""
    too_deep(*through[1:], "first")


@pytest.mark.slow
def test_only_motion_inwards_counts_as_depth(through):
    """Drawn out by 20 mm, or 2 mm in and 14 mm along, was TOO_DEEP: "pressed in by more"."""
    inward = -np.array([0, np.cos(0.5), np.sin(0.5)])
    depth = np.stack([-15 * inward, 1.5 * inward + [10, 0, 0], 9 * inward, 9 * inward])
    skeleton = np.stack([-5 * inward, 0.5 * inward + [4, 0, 0], 3.5 * inward, 4 * inward])
    share = depth_share(through[0], depth, skeleton, np.tile(inward, (4, 1)))
    np.testing.assert_allclose(share, [0, 2 / 12.6, 12.5 / 12.6, 13 / 12.6], rtol=1e-12)
    status = status_of(jnp.zeros(4, jnp.int8), share, None, {})
    assert status.tolist() == [OK, OK, OK, PressStatus.TOO_DEEP]


def test_a_tool_in_the_lumen_has_no_force(through):
    """Without a mesh the tube is solid: it was pressed out, 0.6 to 1.4 N with OK."""
    out = run(through[0], SPRINGS, poses([60, 0, 0], [90, 1, 0], ROWS))
    assert out.status.tolist() == [PressStatus.IN_LUMEN] * ROWS
    assert np.isnan(out.force).any(axis=1).all()
    # In over the end is in the lumen; in through the wall is a press, and out is outside.
    end = run(through[0], SPRINGS, poses([-20, 0, 0], [60, 0, 0], ROWS))
    assert end.status.tolist()[-1] == PressStatus.IN_LUMEN


def upright(*heights):
    """The ball's centre at s = 75 mm, the last height kept to the end."""
    heights = np.pad(np.asarray(heights, float), (0, ROWS - len(heights)), mode="edge")
    places = np.stack([np.full(ROWS, 75.0), heights, np.zeros(ROWS)], 1)
    return Poses(np.broadcast_to(np.eye(3), (ROWS, 3, 3)), places)


#: Centres of the ball (5 mm), which touches the inner wall (10 mm) from 5 mm on and the outer one
#: (12.6 mm) below 17.6.
LUMEN, NO, LOST = PressStatus.IN_LUMEN, PressStatus.NO_CONTACT, PressStatus.NON_FINITE
WAYS = {
    "from the lumen against the wall": ((0, 5, 8, 9, 5), [LUMEN] * 5),
    "from the air, and back": ((19, 16, 12, 19), [NO, OK, OK, NO]),
    "lost in the air": ((19, np.nan, 18, 16), [NO, LOST, NO, OK]),
    "lost in touch": ((19, 16, np.nan, 15), [NO, OK, LOST, OK]),
    "lost in the lumen": ((0, np.nan, 8, 0), [LUMEN, LOST, LUMEN, LUMEN]),
    "from the lumen into a press: not before it was clear": (
        (0, 16, 15, 18, 16),
        [LUMEN, LUMEN, LUMEN, NO, OK],
    ),
    "never touching, lost": ((19, np.nan, 20), [NO, LOST, NO]),
    "begins just within the inner wall": ((4.9, 8), [LUMEN, LUMEN]),
    "begins in the wall": ((5.5, 16), [OK, OK]),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_tool_keeps_its_side_of_the_wall(through, way):
    """Against the inner wall it was pushed inwards, 0.3 N with OK; NaN spoiled all other rows."""
    heights, expected = WAYS[way]
    out = run(through[0], SPRINGS, upright(*heights))
    assert out.status.tolist() == expected + expected[-1:] * (ROWS - len(heights))
    assert (np.isfinite(out.force).all(axis=1) == np.isin(out.status, [OK, NO])).all()


def test_a_lost_pose_leaves_the_others_as_they_are(through):
    there = run(through[0], SPRINGS, upright(19, 18, 16, 15))
    lost = run(through[0], SPRINGS, upright(19, np.nan, 16, 15))
    np.testing.assert_allclose(np.asarray(lost.force)[2:], np.asarray(there.force)[2:], atol=1e-12)


@pytest.mark.slow
def test_a_tool_in_the_lumen_of_a_mesh_has_no_force():
    """Patches are closed: the gap was that to a face across the tube, or behind the rings.

    Over the end it pressed on the face that closes the last patch.
    """
    radius = 150.0
    mesh = bend(make_tube(TUBE), radius)

    def led(s, height):
        centre, frame = on_arc(s, radius)
        places = centre + height[:, None] * frame[:, :, 1]
        return Poses(np.broadcast_to(np.eye(3), (ROWS, 3, 3)), places)

    def to(a, b):
        return np.linspace(a, b, ROWS)

    down = led(to(75, 75), to(18.6, 15.0))
    scene = make_scene(TUBE, SPRINGS, down, tool=BALL, mesh=mesh, effects=ONE)
    assert scene.plan.curved
    pressed = run(scene, SPRINGS, down).status.tolist()
    assert pressed == [PressStatus.NO_CONTACT] * pressed.count(1) + [OK] * pressed.count(OK)
    assert OK in pressed
    lumen, no = PressStatus.IN_LUMEN, PressStatus.NO_CONTACT
    for s in (to(60, 90), to(100, 130)):
        out = run(scene, SPRINGS, led(s, to(0, 1.0)))
        assert out.status.tolist() == [lumen] * ROWS
        assert np.isnan(out.force).any(axis=1).all()
    for s in (to(-20, 60), to(180, 100)):
        statuses = run(scene, SPRINGS, led(s, to(0, 0))).status.tolist()
        outside = statuses.count(no)
        assert statuses == [no] * outside + [lumen] * (ROWS - outside)
        assert 2 < outside < 6


def test_a_tool_behind_the_ends_of_the_rings_touches_or_does_not(through):
    """Away from the wall it was NaN: there is no contact, and no force."""
    for height, expected in ((18.5, PressStatus.NO_CONTACT), (17.0, PressStatus.BEHIND_GAP)):
        place = [75, height * np.cos(2.5), height * np.sin(2.5)]
        out = run(through[0], SPRINGS, poses(place, place, ROWS))
        assert (np.asarray(out.status) == expected).all()
        assert (np.asarray(out.force) == 0).all() == (height == 18.5)


@pytest.mark.slow
def test_steps_of_a_session_are_refused_alike():
    """In the lumen, out of it, a press, and a jump along the tube: it keeps no old place."""
    scene = make_scene(TUBE, SPRINGS, ball([75, 1, 0], [75, -2, 0]), tool=BALL, effects=ONE)
    session, found = Session(scene, SPRINGS), []
    for place in ([75, 0, 0], [75, 19, 0], [75, 16, 0], [95, 16, 0], [75, 19, 0], [75, -40, 0]):
        found.append(int(session.step(np.eye(3), place).status))
    assert found[:4] == [PressStatus.IN_LUMEN, PressStatus.NO_CONTACT, OK, OK]
    assert found[4:] == [PressStatus.NO_CONTACT] * 2  # above the tube, and 27 mm below it


def test_friction_that_a_plan_drops_is_said():
    facts = SceneFacts(poses=True, slip=40.0, spacing=10.0, friction=True, mesh=False)
    plan = make_plan(facts, BARE)
    assert (plan.contact_point, plan.friction) == ("per_step", False)
    scene = make_scene(TUBE, SPRINGS, DOWN, effects=ONE)
    scene = dataclasses.replace(scene, plan=plan, friction=jnp.asarray(0.5))
    assert [note.split(";")[0] for note in dropped_effects(scene)] == [
        "friction: off, the contact does not keep its place"
    ]
    assert dropped_effects(dataclasses.replace(scene, friction=None)) == ()
