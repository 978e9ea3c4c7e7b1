"""Several tools in one scene: what each does to the others, the surface, and bad input."""

import base64
import dataclasses
import functools
import json
import re
import tomllib

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from small_scenes import BALL, BARE, MATERIAL, OUTER, SPRINGS, TUBE, ball, poses, presses

from jaxtrachea import (
    EffectOptions,
    PlanError,
    Poses,
    Presses,
    Session,
    Tool,
    init_state,
    make_scene,
    press_contacts,
    press_contacts_oblique,
    read_simulation,
    simulate,
    step,
)
from jaxtrachea.contact.pose import Pose
from jaxtrachea.contact.shapes import box, compound, sphere
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.output.results import write_forces, write_simulation
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.dents import fit, lay_out
from jaxtrachea.scene.instruments import scene_of
from jaxtrachea.scene.overlap import overlapping
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.simulation import of_tool
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.status import PressStatus
from jaxtrachea.surface import local
from jaxtrachea.surface.lines import weigh_lines
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

OK, NO_CONTACT, LIFTED = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.LIFTED
#: Round, with a vertex at 70 and 75 mm on the midline.
ROUND = make_tube(TUBE, around=9, along=40, relief=0.0)
NEXT = 75.0
LEFT, RIGHT = presses([0, -4, 0], s=70.0, rows=5), presses([0, -1.2, 0], s=NEXT)
PRESSED = {"left": LEFT, "right": RIGHT}


@functools.cache
def scene_of_presses(**effects):
    mesh = None if effects.get("want_surface") is False else ROUND
    return make_scene(TUBE, SPRINGS, PRESSED, mesh=mesh, effects=EffectOptions(**effects))


@functools.cache
def pressed():
    return jax.device_get(simulate(scene_of_presses(), SPRINGS, PRESSED))


def ways(*paths):
    """Displacements inwards, side by side; shorter ones rest."""
    rows = max(len(p.s) for p in paths)
    columns = [-np.asarray(p.displacement)[:, 1] for p in paths]
    return np.stack([np.append(v, [v[-1]] * (rows - len(v))) for v in columns], axis=1)


@pytest.mark.long
def test_forces_are_those_of_press_contacts():
    out, D = pressed(), ways(LEFT, RIGHT)
    found = press_contacts(TUBE, SPRINGS, [70.0, NEXT], D)
    np.testing.assert_allclose(-out.force[:, :, 1], found.force, rtol=0, atol=1e-15)
    np.testing.assert_allclose(-out.joints[:, :, 1], found.joints, rtol=0, atol=1e-15)
    np.testing.assert_allclose(-out.loads[:, :, 1], found.reactions, rtol=0, atol=1e-15)
    assert out.status.tolist() == found.status.tolist()
    assert out.status[-1].tolist() == [OK, LIFTED]  # the wall comes away from the right one
    np.testing.assert_allclose(-out.depth[:, :, 1], np.maximum(found.depth, 0), atol=1e-15)


@pytest.mark.long
def test_surface_passes_through_every_contact():
    """The vertex at a contact moves as the tool does, to the last digits; the far ones do not."""
    out, D = pressed(), ways(LEFT, RIGHT)
    there = (np.abs(ROUND.phi) < 1e-9) & np.isclose(ROUND.distance, 12.6)
    for j, s in enumerate((70.0, NEXT)):
        (vertex,) = np.flatnonzero(there & np.isclose(ROUND.s, s))
        moved = out.vertices[:, vertex] - np.asarray(ROUND.vertices)[vertex]
        touching = out.status[:, j] == OK
        np.testing.assert_allclose(-moved[touching, 1], D[touching, j], rtol=0, atol=1e-9)
    far = np.abs(np.asarray(ROUND.s) - 75) > 70
    assert np.abs(out.vertices[:, far] - np.asarray(ROUND.vertices)[far]).max() < 1e-4


@pytest.mark.slow
def test_surface_of_one_pressing_tool_is_that_of_one_tool():
    """A second tool that stays off the wall changes nothing."""
    away = presses([0, 3.0, 0], s=83.0, rows=5)
    out = simulate(scene_of_presses(), SPRINGS, {"left": LEFT, "right": away})
    alone = make_scene(TUBE, SPRINGS, LEFT, mesh=ROUND)
    one = simulate(alone, SPRINGS, LEFT)
    assert (np.asarray(out.status[:, 1]) == NO_CONTACT).all()
    np.testing.assert_allclose(out.force[:, 0], one.force, rtol=0, atol=2e-5)  # the rounded touch
    np.testing.assert_allclose(out.vertices, one.vertices, rtol=0, atol=1e-4)


def test_mapping_of_one_tool_has_the_axis():
    path = {"left": LEFT}
    scene = make_scene(TUBE, SPRINGS, path, effects=BARE)
    out = simulate(scene, SPRINGS, path)
    one = simulate(make_scene(TUBE, SPRINGS, LEFT, effects=BARE), SPRINGS, LEFT)
    assert scene.plan.tools == "one"
    np.testing.assert_array_equal(out.force[:, 0], one.force)
    assert out.s.shape == (5, 1)
    assert out.joints.shape == one.joints.shape


@pytest.mark.slow
def test_apart_every_force_is_that_of_its_tool_alone():
    scene = scene_of_presses(want_surface=False, tools="apart")
    assert scene.plan.tools == "apart"
    out = simulate(scene, SPRINGS, PRESSED)
    for j, (s, D) in enumerate(zip((70.0, NEXT), ways(LEFT, RIGHT).T, strict=True)):
        alone = press_contacts(TUBE, SPRINGS, [s], D[:, None]).force[:, 0]
        np.testing.assert_allclose(-out.force[:, j, 1], alone, rtol=0, atol=2e-4)


@pytest.mark.long
def test_a_row_in_which_one_is_refused_has_no_numbers():
    D = np.zeros((3, 3))
    D[:, 1] = [-1, np.nan, -1]
    bad = Presses(np.full(3, 80.0), np.zeros(3), D)
    out = simulate(scene_of_presses(want_surface=False), SPRINGS, {"left": LEFT, "right": bad})
    assert out.status[:, 0].tolist() == [NO_CONTACT, PressStatus.NON_FINITE, *[OK] * 3]
    assert np.isnan(out.force[1]).all()
    assert np.isnan(out.joints[1]).all()
    assert np.isfinite(np.delete(np.asarray(out.force), 1, axis=0)).all()
    off = dataclasses.replace(RIGHT, s=np.full(3, 170.0))
    out = simulate(scene_of_presses(want_surface=False), SPRINGS, {"left": LEFT, "right": off})
    assert (np.asarray(out.status)[1:] == PressStatus.OFF_TUBE).all()


@pytest.mark.long
def test_past_the_fold_stays_so_whatever_waits_in_the_air():
    """Behind the ends of the rings no force of others puts the waiting tool anywhere."""
    down = [[75, OUTER + 6 - d, 0] for d in (0, 1.5, 3, 4)]
    paths = {
        name: Poses(np.broadcast_to(np.eye(3), (4, 3, 3)), np.array(at, float))
        for name, at in (("a", down), ("b", [[60, -(OUTER + 7.0), 0.5]] * 4))
    }
    tools = dict.fromkeys(paths, BALL)
    scene = make_scene(TUBE, SPRINGS, paths, tool=tools, effects=EffectOptions(want_surface=False))
    out = jax.jit(simulate)(scene, dataclasses.replace(SPRINGS, k_3=-0.5), paths)
    assert out.status[1].tolist() == [OK, NO_CONTACT]
    assert (np.asarray(out.status)[2:] == PressStatus.PAST_FOLD).all()


@pytest.mark.slow
def test_glued_tools_and_widths():
    model = {"contact": "bonded", "half_width": 2.0}
    scene = scene_of_presses(want_surface=False, **model)
    pulls = {"left": presses([0, 2, 0], s=70.0), "right": presses([0, -1, 0], s=78.0)}
    out = simulate(scene, SPRINGS, pulls)
    D = ways(*pulls.values())
    found = press_contacts(TUBE, SPRINGS, [70.0, 78.0], D, Options(**model))
    np.testing.assert_allclose(-out.force[:, :, 1], found.force, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_derivatives_against_differences():
    """Forces, joints and surface by places, ways and material, forward and reverse."""
    scene = scene_of_presses()
    weights = np.random.default_rng(1).normal(size=pressed().vertices.shape)

    def value(x):
        material = dataclasses.replace(SPRINGS, k_1=x[0], EI_L=x[1], k_M=x[2])
        paths = {
            "left": dataclasses.replace(
                LEFT, s=x[3] + jnp.zeros(5), displacement=x[4] * LEFT.displacement
            ),
            "right": dataclasses.replace(RIGHT, displacement=3 * x[5] * RIGHT.displacement),
        }
        out = simulate(scene, material, paths)
        return jnp.sum(weights * out.vertices) + jnp.sum(out.force) + jnp.sum(out.joints**2)

    x = jnp.array([0.3, 1.86, 0.1, 71.3, 1.0, 1.0])
    slope = jax.jit(jax.grad(value))(x)
    value = jax.jit(value)
    for i, h in enumerate(1e-5 * np.array(x)):
        step = h * np.eye(6)[i]
        difference = (value(x + step) - value(x - step)) / (2 * h)
        np.testing.assert_allclose(slope[i], difference, rtol=2e-6, atol=1e-6)


@pytest.mark.parametrize("count", [8, 16])
def test_overlapping_dents_meet_both_points(count):
    """From a tenth of a footprint to three; a sum of dents fitted singly misses by the figure.

    With 16 centres the tools are round: the deep one asks for more at the contact of the other.
    """
    scene = scene_of_presses()
    plan = dataclasses.replace(scene.plan, dent=count)
    views = [
        dataclasses.replace(scene_of(scene, instrument), plan=plan)
        for instrument in scene.instruments
    ]
    depth, footprint = jnp.array([2.0, 0.6]), float(scene.footprint)

    @jax.jit
    def missed(apart):
        s, phi = jnp.stack([70.0 + 0 * apart, 70.0 + apart]), jnp.zeros(2)
        laid = lay_out(views, s, phi, [LEFT, RIGHT], [None, None])
        C = laid.centres[::count]
        sags = jnp.sum((laid.centres[None] - C[:, None]) ** 2, axis=2) / 20
        laid = laid if count == 8 else dataclasses.replace(laid, sags=sags)
        together = sum(local.correction(dent, C) for dent in fit(laid, depth))
        singly = jnp.zeros((2, 3))
        for j in range(2):
            own = slice(j * count, (j + 1) * count)
            target = local.targets(depth[j] * jnp.array([0, -1.0, 0]), sags[j, own])
            singly += local.correction(local.fit(laid.centres[own], target, laid.reach), C)
        return jnp.stack([jnp.max(jnp.abs(v[:, 1] + depth)) for v in (together, singly)])

    found = np.array([missed(share * footprint) for share in (0.1, 0.3, 1.0, 2.0, 3.0)])
    assert (found[:, 0] < 1e-6).all()
    assert found[0, 1] > 1.5  # a sum counts the other dent twice
    assert found[-1, 1] < 0.2


TWO_BALLS = {
    "left": ball([70, 1, 0], [70, -2.5, 0], rows=5),
    "right": ball([80.5, 1.5, 0], [80.5, -2, 0], rows=4),
}


@functools.cache
def balls():
    scene = make_scene(
        TUBE, SPRINGS, TWO_BALLS, tool={"left": BALL, "right": Tool(BALL)}, mesh=ROUND
    )
    return scene, jax.device_get(simulate(scene, SPRINGS, TWO_BALLS))


@pytest.mark.slow
def test_balls_press_where_they_touch():
    """Place and way by geometry, forces by `press_contacts` there; the surface meets both balls."""
    scene, out = balls()
    assert scene.plan.dent == 16
    np.testing.assert_allclose(out.s[0], [70.0, 80.5], atol=0.02)
    s, D = out.s[0], -out.displacement[:, :, 1]
    found = press_contacts(TUBE, SPRINGS, s, D)
    np.testing.assert_allclose(-out.force[:, :, 1], found.force, rtol=0, atol=1e-14)
    assert out.status[-1].tolist() == [OK, OK]
    alone = press_contacts(TUBE, SPRINGS, s[:1], D[:, :1])
    assert 1.02 < alone.force[-1, 0] / found.force[-1, 0]  # the other ball has made way


@pytest.mark.slow
def test_files_have_all_tools(tmp_path):
    scene, out = balls()
    write_forces(tmp_path / "forces.csv", out, scene.names)
    table = pd.read_csv(tmp_path / "forces.csv")
    assert table.tool.tolist() == ["left", "right"] * 5
    np.testing.assert_array_equal(table.force_y_N, out.force[:, :, 1].ravel())
    write_simulation(tmp_path / "simulation.h5", scene, SPRINGS, TWO_BALLS, out, {})
    read = read_simulation(tmp_path / "simulation.h5")
    np.testing.assert_array_equal(read.simulation.force, out.force)
    assert list(read.tool) == ["left", "right"]
    np.testing.assert_array_equal(read.path["right"].translation, TWO_BALLS["right"].translation)


@pytest.mark.slow
def test_a_page_plays_all_tools(tmp_path):
    """The numbers of its frames, as core.js reads them."""
    pytest.importorskip("nicegui", reason="the extra 'viewer' is not installed")
    from jaxtrachea.viewer.play import of_file

    scene, out = balls()
    write_simulation(tmp_path / "simulation.h5", scene, SPRINGS, TWO_BALLS, out, {})
    (page,) = re.findall('id="packet">([^<]*)<', of_file(tmp_path / "simulation.h5"))
    data = base64.b64decode(page)
    size = int(np.frombuffer(data, np.uint32, 1)[0])
    text = json.loads(data[4 : 4 + size])
    assert text["tools"] == ["left", "right"]
    _, kind, start, count = next(a for a in text["arrays"] if a[0] == "heads")
    touches = np.frombuffer(data, kind, count, 4 + size + start).reshape(5, -1)[:, 2:]
    touches = touches.reshape(5, 2, 8)  # status, force, depth, point
    np.testing.assert_array_equal(touches[..., 0], out.status)
    np.testing.assert_allclose(touches[..., 1:4], out.force, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(touches[..., 4], np.maximum(-out.gap, 0), rtol=1e-6)


@pytest.mark.slow
def test_a_session_goes_the_same_way():
    scene, out = balls()
    session = Session(scene, SPRINGS)

    def pose(name, row):
        path = TWO_BALLS[name]
        return path.rotation[row], path.translation[row]

    for row in range(4):
        found = session.step({name: pose(name, row) for name in TWO_BALLS})
        np.testing.assert_allclose(found.force, out.force[row], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.vertices, out.vertices[row], rtol=0, atol=1e-10)
    kept = session.state
    found = session.step({"left": pose("left", 4)})  # the other stays where it was
    np.testing.assert_allclose(found.force, out.force[4], rtol=0, atol=1e-12)
    held = session.force_or_last
    assert held.status == (OK, OK)
    np.testing.assert_array_equal(held.force, found.force)
    lifted = session.step({}, present={"right": False})
    alone = press_contacts(TUBE, SPRINGS, out.s[0, :1], -out.displacement[4, :1, 1])
    np.testing.assert_allclose(-lifted.force[:, 1], [alone.force[0], 0], rtol=0, atol=1e-12)
    session.state = kept  # with the places of all tools, and which of them are there
    again = session.step({"left": pose("left", 4)})
    np.testing.assert_array_equal(again.force, found.force)
    with pytest.raises(ValueError, match="no tool 'up'; expected 'left', 'right'"):
        session.step({"up": pose("left", 0)})
    with pytest.raises(ValueError, match="expected a mapping of names"):
        session.step(*pose("left", 0))
    with pytest.raises(ValueError, match=r"'left': rotation \(3,\)"):
        session.step({"left": (np.zeros(3), np.zeros(3))})
    broken = session.step({"left": (np.eye(3), np.full(3, np.nan))})
    assert (broken.status == PressStatus.NON_FINITE).all()
    assert np.isnan(broken.force).all()


#: Meridians of vertices of `ROUND`.
SIDE = 4 * np.pi / 9
WAYS = {"left": (3.0, SIDE), "right": (2.0, -SIDE), "front": (0.2, 0.0)}


def inwards(phi):
    return -np.array([0, np.cos(phi), np.sin(phi)])


@functools.cache
def pinched():
    """Two tools pinch the tube; the front bulges against a third."""
    paths = {n: presses(D * inwards(phi), s=NEXT, phi=phi) for n, (D, phi) in WAYS.items()}
    scene = make_scene(TUBE, MATERIAL, paths, mesh=ROUND)
    return scene, paths, jax.device_get(simulate(scene, MATERIAL, paths))


@pytest.mark.long
def test_a_pinch_is_press_contacts_oblique_and_the_wall_meets_all_tools():
    scene, _, out = pinched()
    assert (scene.plan.tools, scene.plan.rings) == ("coupled", "arch2")
    depths, angles = zip(*WAYS.values(), strict=True)
    D = np.linspace(0, 1, 3)[:, None] * depths
    found = press_contacts_oblique(TUBE, MATERIAL, [NEXT] * 3, angles, D)
    for name in ("force", "joints", "loads", "end_U", "end_V", "skeleton"):
        np.testing.assert_allclose(getattr(out, name), getattr(found, name), rtol=0, atol=1e-13)
    assert out.force[-1, 2, 1] < -0.01
    there = np.isclose(ROUND.distance, 12.6) & np.isclose(ROUND.s, NEXT)
    for j, phi in enumerate(angles):
        (vertex,) = np.flatnonzero(there & (np.abs(ROUND.phi - phi) < 1e-9))
        moved = out.vertices[:, vertex] - np.asarray(ROUND.vertices)[vertex]
        np.testing.assert_allclose(moved @ inwards(phi), D[:, j], rtol=0, atol=1e-9)


NAMES = "row", "tool", "ring", "xyz"


@pytest.mark.slow
def test_files_of_a_pinch(tmp_path):
    scene, paths, out = pinched()
    write_simulation(tmp_path / "simulation.h5", scene, MATERIAL, paths, out, {})
    with h5py.File(tmp_path / "simulation.h5") as file:
        joints = file["series/joints"]
        assert [d[0].name for d in joints.dims] == [f"/series/{n}" for n in NAMES]
    read = read_simulation(tmp_path / "simulation.h5").simulation
    np.testing.assert_array_equal(read.joints, out.joints)
    np.testing.assert_array_equal(of_tool(out, 1).joints, out.joints[:, 1])


@pytest.mark.slow
def test_a_session_pinches_as_a_path_does():
    """Balls at both sides; one that is lifted away leaves the others."""
    out = OUTER + 5
    paths = {
        "left": poses([75, 0, out + 0.5], [75, 0, out - 2.5]),
        "right": poses([77, 0, -out - 0.2], [77, 0, -out + 2]),
    }
    scene = make_scene(TUBE, MATERIAL, paths, tool=dict.fromkeys(paths, BALL), effects=BARE)
    true = jax.device_get(simulate(scene, MATERIAL, paths))
    session = Session(scene, MATERIAL)
    steps = [
        session.step({n: (p.rotation[row], p.translation[row]) for n, p in paths.items()})
        for row in range(4)
    ]
    for row, found in enumerate(steps):
        np.testing.assert_allclose(found.force, true.force[row], rtol=0, atol=1e-13)
        np.testing.assert_allclose(found.joints, true.joints[row], rtol=0, atol=1e-13)
    lifted = session.step({}, present={"right": False})
    rows = jax.tree.map(lambda v: v[:4], {n: (p.rotation, p.translation) for n, p in paths.items()})

    @jax.jit
    def scan(state):
        """The same by the function: a scan, then both stay and one is lifted."""
        state, found = jax.lax.scan(lambda *row: step(scene, MATERIAL, *row), state, rows)
        return found, step(scene, MATERIAL, state, {}, present={"right": False})

    found, (state, last) = scan(init_state(scene, MATERIAL))
    same = jax.tree.map(lambda *v: np.stack([np.asarray(one) for one in v]), *steps, lifted)
    found = jax.tree.map(lambda v, w: np.concatenate([v, w[None]]), found, last)
    jax.tree.map(np.testing.assert_array_equal, found, same)
    jax.tree.map(np.testing.assert_array_equal, state, session.state)
    with pytest.raises(ValueError, match="no tool 'up'; expected 'left', 'right'"):
        step(scene, MATERIAL, state, {"up": (np.eye(3), np.zeros(3))})
    with pytest.raises(ValueError, match="stiffness is of one tool"):
        step(scene, MATERIAL, state, {}, stiffness=True)
    assert lifted.status.tolist() == [OK, NO_CONTACT]
    assert np.linalg.norm(lifted.force[0]) < 0.7 * np.linalg.norm(true.force[-1, 0])


#: Round the tube from both sides, closed.
ANGLE = np.linspace(0, 2 * np.pi, 61)
UPRIGHT = np.broadcast_to(np.eye(3), (61, 3, 3))
LOOPS = {
    "left": np.stack([74 + 4 * np.cos(ANGLE), 2 * np.sin(ANGLE),
                      OUTER + 2.8 + np.sin(2 * ANGLE) / 2], axis=1),
    "right": np.stack([77 + 3 * np.sin(ANGLE), 1.5 * np.cos(ANGLE),
                       -OUTER - 3 + 0.4 * np.cos(ANGLE)], axis=1),
}  # fmt: skip


@pytest.mark.long
def test_tools_that_wander():
    """Every row by itself, in a session too; their force is the derivative of the energy of all."""
    paths = {name: Poses(UPRIGHT, places) for name, places in LOOPS.items()}
    scene = make_scene(TUBE, MATERIAL, paths, tool=dict.fromkeys(paths, BALL), effects=BARE)
    assert (scene.plan.contact_point, scene.plan.tools) == ("per_step", "coupled")
    true = jax.device_get(jax.jit(simulate)(scene, MATERIAL, paths))
    assert (true.status == OK).all()
    way = np.stack([np.diff(places, axis=0) for places in LOOPS.values()], axis=1)
    work = np.sum((true.force[1:] + true.force[:-1]) / 2 * way, axis=2)
    assert abs(work.sum()) < 2e-4 * abs(work).sum()  # what the trapezoidal rule leaves
    session = Session(scene, MATERIAL)
    for row in (0, 20, 37):
        s, phi, D = true.s[row], true.phi[row], -true.gap[row]
        found = press_contacts_oblique(TUBE, MATERIAL, s, phi, D[None])
        np.testing.assert_allclose(true.joints[row], found.joints[0], rtol=0, atol=1e-13)
        step = session.step({name: (UPRIGHT[row], p[row]) for name, p in LOOPS.items()})
        np.testing.assert_allclose(step.force, true.force[row], rtol=0, atol=1e-13)
    lifted = session.step({}, present={"right": False})
    assert lifted.status.tolist() == [OK, NO_CONTACT]
    alone = press_contacts_oblique(TUBE, MATERIAL, s[:1], phi[:1], D[None, :1])
    np.testing.assert_allclose(lifted.joints[0], alone.joints[0, 0], rtol=0, atol=1e-13)


@pytest.mark.long
def test_forceps_hold_beside_a_finger():
    """A glued tool presses and draws; the path and a session are `press_contacts`."""
    height = np.concatenate([np.linspace(1, -1.5, 4), np.linspace(-1, 3, 5)])
    paths = {
        name: poses([s, 0, 0], [s, 0, 0], 9) for name, s in (("forceps", 70.0), ("finger", 80.0))
    }
    for name, h in (("forceps", height), ("finger", np.linspace(0.5, -3, 9))):
        up = np.stack([0 * h, OUTER + 5 + h, 0 * h], axis=1)
        paths[name] = dataclasses.replace(paths[name], translation=paths[name].translation + up)
    tools = {"forceps": Tool(BALL, contact="bonded"), "finger": Tool(BALL)}
    scene = make_scene(TUBE, SPRINGS, paths, tool=tools, mesh=ROUND)
    out = jax.device_get(jax.jit(simulate)(scene, SPRINGS, paths))
    found = press_contacts(
        TUBE, SPRINGS, out.s[0], -out.displacement[..., 1], bonded=[True, False], present=True
    )
    np.testing.assert_allclose(
        out.force[2:, :, 1], -np.asarray(found.force)[2:], rtol=0, atol=1e-14
    )
    assert out.force[-1, 0, 1] > 0.2  # it draws
    assert (out.status[2:] == OK).all()
    session = Session(scene, SPRINGS)
    for i in range(9):
        step = session.step(
            {n: (np.eye(3), np.asarray(p.translation)[i]) for n, p in paths.items()}
        )
        np.testing.assert_allclose(step.force, out.force[i], rtol=0, atol=1e-14)
        np.testing.assert_allclose(step.vertices, out.vertices[i], rtol=0, atol=1e-12)
    away = session.step({}, present={"forceps": False})
    assert away.status.tolist() == [NO_CONTACT, OK]
    over = {"forceps": (np.eye(3), np.array([70, OUTER + 6, 0]))}
    assert session.step(over).status.tolist() == [NO_CONTACT, OK]  # glued no more
    # What the finger has pressed down is not where the forceps come to.
    beside = paths | {"forceps": ball([70, 1, 0], [70, -0.1, 0], 9)}
    beside["finger"] = ball([80.5, 0.5, 0], [80.5, -4, 0], 9)
    waits = jax.jit(simulate)(scene, SPRINGS, beside)
    assert waits.status[-1].tolist() == [LIFTED, OK]
    assert np.abs(waits.force[:, 0]).max() == 0
    with pytest.raises(PlanError, match="a tool that is glued holds the wall along the surface"):
        make_scene(TUBE, MATERIAL, paths, tool=tools, effects=BARE)


@pytest.mark.long
def test_a_tool_that_waits_behind_the_tube_changes_nothing():
    """On the midline, of a tool that wanders: all as of the one, the part along the wall too."""
    paths = {"left": ball([70, -2, 0], [78, -3, 0]), "right": poses([110, -27, 0], [112, -27, 0])}
    effects = EffectOptions(want_surface=False, friction="off", axial="off")
    scene = make_scene(TUBE, SPRINGS, paths, tool=dict.fromkeys(paths, BALL), effects=effects)
    out = jax.jit(simulate)(scene, SPRINGS, paths)
    one = make_scene(TUBE, SPRINGS, paths["left"], tool=BALL, effects=effects)
    alone = jax.jit(simulate)(one, SPRINGS, paths["left"])
    assert scene.plan.contact_point == one.plan.contact_point == "per_step"
    assert (np.asarray(out.status) == [OK, NO_CONTACT]).all()
    assert np.abs(out.force[:, 1]).max() < 1e-15
    assert np.abs(alone.force[:, 0]).max() > 0.01
    for name in ("force", "moment", "skeleton"):
        np.testing.assert_allclose(getattr(out, name)[:, 0], getattr(alone, name), atol=1e-14)


@pytest.mark.long
def test_lines_round_the_tube_meet_each_other():
    """Linear between U, the lines and V; on one meridian lines share it."""
    binding = scene_of_presses().binding
    for phi in ([-0.5, 1.2, 0.4], [0.3, 0.3, -1.0], [0.3, 0.3 + 1e-9, -1.0]):
        lines = jax.jit(weigh_lines)(binding, jnp.array(phi))
        angles, alpha = np.asarray(binding.phi), float(TUBE.half_angle)
        on = np.abs(angles) <= alpha
        values = np.cos(np.array([-alpha, *phi, alpha]))
        found = lines[0].U * values[0] + lines[0].V * values[-1]
        found += sum(line.J * v for line, v in zip(lines, values[1:], strict=False))
        at, first = np.unique([-alpha, *phi, alpha], return_index=True)
        true = np.interp(angles, at, values[first])
        np.testing.assert_allclose(np.asarray(found)[on], true[on], rtol=0, atol=1e-7)
        whole = sum(line.U + line.J + line.V for line in lines)
        np.testing.assert_allclose(whole, 1, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_tools_that_overlap_in_space():
    """Two balls by the distance of their centres, and a box beside a ball."""
    at = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0]])
    other = np.array([[6.9, 0, 0], [7.1, 0, 0], [0, 0, 0]])
    turns = np.broadcast_to(np.eye(3), (3, 3, 3))
    paths = [Poses(turns, at), Poses(turns, other), Poses(turns, other + 50)]
    shapes = [sphere(5.0), sphere(2.0), box([1.0, 1.0, 1.0], 0.1)]
    found = jax.jit(overlapping)([jax.tree.map(jnp.asarray, v) for v in shapes], paths)
    assert found.tolist() == [[True, True, False], [False] * 3, [True, True, False]]
    # A fork of two balls, 20 mm apart: its other tine is 13 mm from the ball that passes.
    fork = compound(
        [sphere(5.0), sphere(5.0)], [Pose(jnp.eye(3), jnp.array([0.0, 0, z])) for z in (0, 20)]
    )
    paths[1] = Poses(turns, other + [0, 0, 20.0])
    found = jax.jit(overlapping)([fork, sphere(2.0)], paths[:2])
    assert found.tolist() == [[True, True], [False] * 2, [True, True]]
    # Sharp boxes of 4 mm, one deep in the other, beside it, and on its place.
    sharp, ways = box([2.0, 2.0, 2.0]), np.array([[1.2, 0.3, 0], [4.1, 0, 0], [0, 0, 0]])
    paths = [Poses(turns, at), Poses(turns, at + ways)]
    found = jax.jit(overlapping)([sharp, sharp], paths)
    assert found.tolist() == [[True, True], [False] * 2, [True, True]]


def test_what_does_not_go_together():
    scene = scene_of_presses(want_surface=False)
    for path, words in (
        (LEFT, "path is Presses; expected a mapping of the tools 'left', 'right'"),
        ({"left": LEFT}, "path has the tools 'left'; expected 'left', 'right'"),
        ({"left": LEFT, "up": RIGHT}, "path has the tools 'left', 'up'"),
        ({"left": LEFT, "right": TWO_BALLS["left"]}, "path mixes kinds"),
        ({"left": LEFT, "right": dataclasses.replace(RIGHT, phi=np.zeros(2))}, "tool 'right'"),
    ):
        with pytest.raises(ValueError, match=words):
            simulate(scene, SPRINGS, path)
    timed = dataclasses.replace(LEFT, time=np.arange(5.0))
    for right, words in (
        (RIGHT, "path of tool 'right' has no time; expected one, as 'left' has"),
        (dataclasses.replace(LEFT, time=np.arange(5.0) + [0, 0, 1, 0, 0]), "from row 3 on"),
        (dataclasses.replace(RIGHT, time=np.arange(3.0)), "from row 4 on; expected one clock"),
    ):
        with pytest.raises(ValueError, match=words):
            simulate(scene, SPRINGS, {"left": timed, "right": right})
    for paths, tools, words in (
        ({}, None, "path has 0 tools; expected 1 to 16"),
        ({f"{i}": LEFT for i in range(17)}, None, "path has 17 tools; expected 1 to 16"),
        ({"a": LEFT, "b": LEFT}, None, "path of tool 'b' is that of 'a' in every row"),
        (TWO_BALLS, BALL, "tool is Shape; expected a mapping of the names of the paths"),
        (TWO_BALLS, {"left": BALL, "up": BALL}, "tool has the names 'left', 'up'; expected"),
        (TWO_BALLS, {"left": BALL, "right": 3}, "tool 'right' is 3; expected"),
    ):
        with pytest.raises(ValueError, match=words):
            make_scene(TUBE, SPRINGS, paths, tool=tools, effects=BARE)
    with pytest.raises(ValueError, match="the path moves a tool"):
        make_scene(TUBE, SPRINGS, TWO_BALLS, effects=BARE)
    one = {"left": TWO_BALLS["left"]}
    scene = make_scene(TUBE, SPRINGS, one, tool={"left": BALL}, effects=BARE)
    with pytest.raises(ValueError, match="a mapping of one tool goes through simulate alone"):
        Session(scene, SPRINGS)


@pytest.mark.parametrize(
    ("facts", "effects", "words"),
    [
        ({"angle": 0.5}, {"contact": "bonded"}, "set contact 'unilateral'"),
        ({"angle": 0.5, "known": frozenset({"EI_C", "k_t"})}, {"rings": "arch"}, "use 'arch2'"),
        ({"angle": 0.5, "drags": True}, {}, "press straight in"),
        ({"angle": 0.5, "known": frozenset({"EA_L"})}, {"axial": "on"}, "slide on the wall"),
        ({"slip": 1.0, "along": 0.5}, {"friction": "on"}, "not every tool has a coefficient"),
        ({"known": frozenset({"sections"})}, {"contact": "bonded"}, r"give \[material\] in"),
        ({"known": frozenset({"relaxation", "relaxation.skeleton"}), "timed": True}, {},
         "set relaxation 'uniform' or 'off'"),
        ({"known": frozenset({"e_1", "e_2"}), "way_fixed": (0.0, 0.2), "softness": (-1.4, 0.9)}, {},
         "set skeleton 'linear'"),
        ({"glued": True}, {"coupling": "total"}, "set relaxation 'off' and coupling 'series'"),
        ({}, {"tools": "one"}, "2 tools have a path"),
        ({}, {"tools": "coupled", "coupling": "total"}, "contacts do not feel one another"),
        ({"tools": 1}, {"tools": "coupled"}, "one tool has a path"),
    ],
)  # fmt: skip
def test_what_no_plan_couples(facts, effects, words):
    with pytest.raises(PlanError, match=words):
        make_plan(SceneFacts(**({"tools": 2, "mesh": False} | facts)),
                  EffectOptions(want_surface=False, **effects))  # fmt: skip


def test_off_the_midline_tools_slide_without_friction():
    facts = SceneFacts(tools=2, mesh=False, angle=1.5, along=0.01, known=frozenset({"EA_L"}))
    plan = make_plan(facts, EffectOptions(want_surface=False))
    assert (plan.tools, plan.second_plane, plan.axial) == ("coupled", True, False)
    (word,) = [e.reason for e in plan.effects if e.name == "tools"]
    assert word.endswith("they slide without friction")


TOOLS = """
[material]
EI_L = "1.9 N mm^2"
k_M = "0.1 N/mm"
k_1 = "0.3 N/mm"
k_3 = "0.02 N/mm^3"
[[tool]]
name = "left"
shape = "sphere"
radius = "5 mm"
[[tool]]
name = "right"
shape = "sphere"
radius = "4 mm"
[[path]]
tool = "left"
positions = [["70 mm", "17 mm", "0 mm"]]
[[path]]
tool = "right"
positions = [["80 mm", "16 mm", "0 mm"]]
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "right"', 'name = "left"', "tool.1.name: 'left' is the name of tool.0, too"),
        ('name = "right"', "", "tool.1.name: missing"),
        ('tool = "right"', 'tool = "up"', "path.1.tool: there is no tool 'up'; expected 'left'"),
        ('tool = "right"', "", "path.1.tool: missing; name the tool that it moves"),
        ('tool = "right"', 'tool = "left"', "tool.1: no path moves 'right'"),
        ('[[tool]]\nname = "left"', "[plan]\ntolerance = \"1 %\"\n[[tool]]\nname = \"left\"",
         "plan: a tolerance is for one tool"),
        ('radius = "4 mm"', 'radius = "4 mm"\nlength = "3 mm"', "length: not for shape 'sphere'"),
    ],
)  # fmt: skip
def test_tables_that_do_not_belong_together(old, new, words):
    assert SceneSpec.model_validate(tomllib.loads(TOOLS)).names == ["left", "right"]
    with pytest.raises(ValueError, match=words.replace("[", r"\[")):
        SceneSpec.model_validate(tomllib.loads(TOOLS.replace(old, new)))


def test_one_tool_has_no_name():
    one = {"shape": "sphere", "radius": "5 mm"}
    path = {"positions": [["70 mm", "17 mm", "0 mm"]]}
    material = tomllib.loads(TOOLS)["material"]
    for tool, leg, words in (
        (one | {"name": "left"}, path, "tool.name: of several tools alone"),
        (one, path | {"tool": "left"}, r"path.0.tool: there is one \[tool\]"),
    ):
        with pytest.raises(ValueError, match=words):
            SceneSpec.model_validate({"material": material, "tool": tool, "path": [leg]})
    many = [{"shape": "sphere", "radius": "5 mm", "name": f"{i}"} for i in range(17)]
    with pytest.raises(ValueError, match="17 tools; expected at most 16"):
        SceneSpec.model_validate({"material": material, "tool": many, "path": [path]})
