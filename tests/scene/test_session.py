"""Steps of a session are rows of the simulation of their path."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from small_scenes import (
    BALL,
    BARE,
    DOWN,
    MATERIAL,
    MESH,
    OUTER,
    SPRINGS,
    TUBE,
    ball,
    bend,
    on_arc,
)
from tool_ways import closed_loop, placed, random_way, step_lengths

from jaxtrachea import EffectOptions, Poses, Session, make_scene, press, press_oblique, simulate
from jaxtrachea.contact.shapes import capsule, sphere
from jaxtrachea.mechanics.oblique import ObliqueOptions, place_at
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.anchor import yielded
from jaxtrachea.status import PressStatus

pytestmark = [pytest.mark.long, pytest.mark.compiling]

EYE = np.eye(3)
OK, NO_CONTACT, NON_FINITE = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.NON_FINITE
#: Every effect of a press that holds its place, forces only.
HELD = dataclasses.replace(
    BARE,
    contact_point="fixed",
    axial="on",
    second_plane="on",
    want_joints=False,
    want_ring_ends=False,
)
#: Straight down between two rings.
DOWN_BALL = ball([80, 1, 0], [80, -2, 0])
# Comes down slanting, presses, and goes on along the tube, still in contact: s, height, z.
WAY = np.array([[72, 3, 0], [73, 1, 0], [74, -1, 0], [74.5, -3, 0], [75, -4, 0.2], [74, -2, 0]])


def along(radius):
    """The way over a tube bent to an arc."""
    centre, frame = on_arc(WAY[:, 0], radius)
    places = centre + np.einsum("rij,rj->ri", frame[:, :, 1:], WAY[:, 1:] + [OUTER + 5, 0])
    return Poses(np.broadcast_to(EYE, (6, 3, 3)), places)


def rows(session, path):
    """Every step, copied."""
    steps = zip(np.asarray(path.rotation), np.asarray(path.translation), strict=True)
    return [jax.tree.map(np.array, session.step(R, T)) for R, T in steps]


@pytest.mark.slow
def test_steps_are_the_rows_of_one_simulation():
    mesh, path = bend(MESH, 200.0), along(200.0)
    effects = dataclasses.replace(BARE, want_surface=True, contact_point="fixed")
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, mesh=mesh, effects=effects)
    whole = jax.jit(simulate)(scene, MATERIAL, path)
    touched = int(np.argmax(np.asarray(whole.gap) < 0))
    session = Session(scene, MATERIAL)
    found = rows(session, path)
    assert 0 < touched < 4
    for i, step in enumerate(found):
        for name, value in step._asdict().items():
            expected = getattr(whole, name)
            assert (value is None) == (expected is None), name
            if value is not None and (i >= touched or name in ("gap", "force", "status")):
                np.testing.assert_allclose(value, expected[i], atol=1e-9, err_msg=f"{name} {i}")
    session.reset()
    again = rows(session, path)
    for a, b in zip(found, again, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.slow
def test_it_lets_go_and_touches_elsewhere():
    """Two presses with a way through the air between: each is a normal press where it stands."""
    path = ball([40, 1, 0], [40, -2, 0], rows=4), ball([90, 1, 0], [90, -3, 0], rows=5)
    effects = dataclasses.replace(BARE, contact_point="fixed")
    session = Session(make_scene(TUBE, SPRINGS, path[0], tool=BALL, effects=effects), SPRINGS)
    single = jax.jit(press)
    for one, s, depth in zip(path, (40.0, 90.0), (2.0, 3.0), strict=True):
        last = rows(session, one)[-1]
        known = single(TUBE, SPRINGS, s, depth)
        # The smoothed contact sees the ball a little early.
        np.testing.assert_allclose(-last.force[1], known.force, rtol=0.02)
        np.testing.assert_allclose(last.s, s, atol=0.2)


@pytest.mark.slow
def test_latencies_of_the_last_steps():
    scene = make_scene(TUBE, MATERIAL, ball([75, 1, 0], [75, -2, 0]), tool=BALL, mesh=MESH)
    session = Session(scene, MATERIAL, keep=3)
    with pytest.raises(ValueError, match=r"expected \(3, 3\) and \(3,\)"):
        session.step(EYE, [1.0, 2.0])
    with pytest.raises(ValueError, match="no step"):
        session.latency()
    for k in range(5):
        session.step(EYE, [75, OUTER + 5 - 0.1 * k, 0])
    told = session.latency(np.array([0.0, 1e-9, 10.0]))
    assert told.steps == 3
    assert told.counts.tolist() == [0, 3]
    assert 0 < told.median <= told.p99 <= told.worst < 10


@pytest.fixture(scope="module")
def held():
    """A session of a ball that holds its place, in float32; compiled for all tests here."""
    tube, material, tool = cast((TUBE, MATERIAL, BALL), "float32")
    start = cast(ball([75, 1, 0], [76, -2, 0]), "float32")
    return Session(make_scene(tube, material, start, tool=tool, effects=HELD), material)


def led(session, places, rotation=None):
    """Forces, gaps, statuses and s along (s, phi, depth) of the ball's lowest point; afresh."""
    session.reset()
    centres = placed(places, OUTER)
    turns = np.broadcast_to(EYE, (len(centres), 3, 3)) if rotation is None else rotation
    return stepped(session, turns, centres)


def stepped(session, rotation, translation):
    found = [
        (np.array(v.force, float), float(v.gap), int(v.status), float(v.s))
        for v in map(session.step, rotation, translation)
    ]
    return tuple(np.array(v) for v in zip(*found, strict=True))


def line(*corners, step=0.02):
    """Places from corner to corner (s, phi, depth), `step` mm apart."""
    rows = [np.asarray(corners[0], float)[None]]
    for a, b in zip(corners, corners[1:], strict=False):
        a, b = np.asarray(a, float), np.asarray(b, float)
        count = int(np.ceil(np.linalg.norm((b - a) * [1, OUTER, 1]) / step))
        rows.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return np.concatenate(rows)


def check_jumps(force, gap, lengths):
    """Each is below the stiffest tangent of the local law times the step (with its rounding)."""
    assert np.isfinite(force).all()
    jump = np.linalg.norm(np.diff(force, axis=0), axis=1)
    depth = np.maximum(-np.minimum(gap[1:], gap[:-1]), 0)
    stiffness = float(MATERIAL.k_1) + 3 * float(MATERIAL.k_3) * depth**2
    assert (jump <= stiffness * (lengths + 1e-4)).all(), (jump / lengths).max()


def test_float32_and_states_by_status(held):
    held.reset()
    step = held.step(EYE, [163, OUTER + 3, 0])
    assert step.force.dtype == held.dtype
    assert step.status == PressStatus.OFF_TUBE
    # It has left its seat beyond the end: it was dragged from there, without an answer.
    step = held.step(EYE, [75, OUTER + 3, 0])
    assert step.status == OK
    assert step.force[1] < -0.1
    assert held.step(EYE, [75, OUTER + 6, 0]).force.tolist() == [0, 0, 0]


@pytest.mark.parametrize("by", [(3.0, 0.0), (0.0, 0.3), (-2.0, -0.2)])
def test_force_ends_where_the_tool_leaves(held, by):
    """Led along the surface and lifted: it fell to 0 within one step, at a gap of -0.2 mm."""
    s, phi = 75 + by[0], by[1]
    places = line([75, 0, -0.5], [75, 0, 2.0], [s, phi, 2.0], [s, phi, 0.1], [s + 1, phi, -0.5])
    force, gap, status, _ = led(held, places)
    assert np.linalg.norm(force, axis=1).max() > 0.1
    np.testing.assert_array_equal(status, np.where(gap < 0, OK, NO_CONTACT))
    check_jumps(force, gap, step_lengths(placed(places, OUTER)))


def test_no_seat_pulls(held):
    """Round the tube at 60 degrees: the seat would have to be pulled, NaN in mid-touch."""
    places = line([75, 1.0, -0.2], [75, 1.0, 1.0], [75, 1.3, 1.0], [75, 0.7, 1.0], [75, 0.7, -0.2])
    force, gap, status, _ = led(held, places)
    np.testing.assert_array_equal(status, np.where(gap < 0, OK, NO_CONTACT))
    inward = np.array([0, -np.cos(1.0), -np.sin(1.0)])
    assert (force[gap < -0.5] @ inward > 0).all()
    check_jumps(force, gap, step_lengths(placed(places, OUTER)))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_pose_costs_itself_only(held, bad):
    """All steps after it were NON_FINITE until lift-off."""
    places = line([75, 0.2, -0.2], [75, 0.2, 1.5], [76, 0.2, 1.5], [76, 0.2, -0.2], step=0.1)
    known = led(held, places)
    held.reset()
    for at, (place, *expected) in enumerate(zip(placed(places, OUTER), *known, strict=True)):
        if at % 7 == 3:
            wrong = (EYE + bad, place) if at % 2 else (EYE, place + [0, bad, 0])
            step = held.step(*wrong)
            assert step.status == NON_FINITE
            assert np.isnan(step.force).all()
        step = held.step(EYE, place)
        np.testing.assert_array_equal(np.array(step.force), expected[0])
        assert int(step.status) == expected[2]


def test_a_matrix_that_is_no_rotation_is_refused(held):
    """It gave a force, with OK: twice as large a tool. The state stays as it was."""
    down = [0, OUTER + 4.5, 0] + np.array([75, 0, 0])
    held.reset()
    known = [np.array(held.step(EYE, down).force) for _ in range(2)]
    held.reset()
    held.step(EYE, down)
    for wrong in (2 * EYE, 0.9 * EYE, -EYE, 0 * EYE, EYE + np.diag([0.3, 0], 1)):
        with pytest.raises(ValueError, match=r"rotation: row 0 .* no rotation.*pose_from_vector"):
            held.step(wrong, down)
    np.testing.assert_array_equal(np.array(held.step(EYE, down).force), known[1])


def test_a_jump_grasps_anew(held):
    """The old seat was dragged along: 1.7 N along the tube, with OK, until the tool was lifted."""
    jump = np.concatenate([line([75, 0, -0.5], [75, 0, 2.0], step=0.1), [[95, 0, 2.0]]])
    force, gap, status, s = led(held, jump)
    afresh = led(held, line([95, 0, -0.5], [95, 0, 2.0], step=0.1))
    assert status[-1] == OK
    np.testing.assert_allclose(force[-1], afresh[0][-1], atol=2e-5)
    np.testing.assert_allclose(s[-1], 95, atol=0.01)


def test_a_fresh_seat_is_pressed_straight_in(held):
    """After a jump round the tube as well: the force of a single press there."""
    single = jax.jit(partial(press_oblique, TUBE, MATERIAL))
    force, gap, _, s = led(held, [[75, 0, -0.5], [75, 0, 2.0], [75, 0.8, 2.0], [75, -0.4, 2.0]])
    for at, phi in ((2, 0.8), (3, -0.4)):
        D = gap[at] * np.array([0, np.cos(phi), np.sin(phi)])
        known = single(s_c=s[at], phi_c=phi, displacement=D).force
        np.testing.assert_allclose(force[at], known, rtol=1e-3, atol=1e-4)


def test_a_seat_follows_the_tool(held):
    """Led 20 mm along the tube: its place is never further behind than the tool is deep.

    Where two patches of the tube meet, the contact itself lies up to 0.036 mm beside the ball.
    """
    places = line([75, 0, -0.5], [75, 0, 2.0], [95, 0, 2.0], step=0.1)
    force, gap, status, s = led(held, places)
    touching = gap < 0
    assert (status[touching] == OK).all()
    assert (np.abs(s - places[:, 0])[touching] < np.maximum(-gap[touching], 0) + 0.05).all()
    assert force[-1, 0] > 0.05  # it drags the tube along
    # To and fro, without a step: the same pose, the same force.
    again = stepped(held, EYE[None].repeat(3, 0), placed(places[-1:].repeat(3, 0), OUTER))[0]
    np.testing.assert_allclose(again, force[-1:].repeat(3, 0), atol=2e-6)


def test_what_gives_way_only_loses_energy(held):
    """Stiff rings at 57 degrees, by numpy: no pull, less energy, the same again."""
    own = {"k_M": 10.0, "k_1": 30.0, "k_3": 0.0}
    stiff = dataclasses.replace(MATERIAL, **{k: jnp.asarray(v) for k, v in own.items()})
    scene = dataclasses.replace(held.scene, geometry=TUBE)
    way = np.random.default_rng(0).normal(size=(4000, 3)) * [2, 6, 6] + [2, 0, 0]
    way[::2] = 2 + (way[::2] - 2) * [0.1, 0.3, 0.3] - [0, 2, 2]  # near what a seat holds

    @jax.jit
    def give(ways):
        place = place_at(TUBE, stiff, 72.0, 1.0, ObliqueOptions(scene.plan.options))

        def one(way):
            return yielded(scene, way, jnp.asarray(2.0), place)

        once = jax.vmap(one)(ways)
        return once, jax.vmap(one)(once), place.unit.compliance

    once, twice, C = give(way)
    frame = np.array(local_frame(jnp.asarray(1.0)))
    stiffness = np.linalg.inv(frame @ C @ frame.T + np.eye(3) / 30)

    def energy(e):
        return np.einsum("ai,ij,aj->a", e, stiffness, e) / 2

    moved = np.abs(once - way).max(axis=1) > 1e-9
    assert 0.5 < moved.mean() < 1
    np.testing.assert_allclose(twice, once, atol=1e-9)
    assert (np.linalg.norm(once[:, 1:], axis=1) < 2 + 1e-9).all()
    assert (np.abs(once[:, 0] - 2) < 1 + 1e-9).all()
    force = once @ stiffness
    assert (force[:, 0] > 0).all()
    assert ((way @ stiffness)[:, 0] < 0).mean() > 0.05  # they would have to be pulled
    deep = way[:, 0] > 2  # less deep they go on in, by the tool's own depth
    assert (energy(once) <= energy(way) + 1e-9)[deep].all()


def check_way(session, count, seed):
    """No jumps along a mixed way, and statuses by what the tool does."""
    session.reset()
    way = random_way(count, OUTER, seed)
    force, gap, status, _ = stepped(session, *way)
    good = np.isfinite(way.translation).all(axis=1)
    np.testing.assert_array_equal(status[~good], NON_FINITE)
    np.testing.assert_array_equal(status[good], np.where(gap < 0, OK, NO_CONTACT)[good])
    check_jumps(force[good], gap[good], step_lengths(way.translation[good], way.rotation[good]))
    return status


def check_loop(session, seed, steps):
    """Work over a closed loop is not negative, but for the trapezoidal rule."""
    centres = closed_loop(seed, steps, OUTER)
    session.reset()
    force, gap, *_ = stepped(session, np.broadcast_to(EYE, (steps + 1, 3, 3)), centres)
    assert gap[0] > 0 > gap.min()
    work = np.sum((force[1:] + force[:-1]) / 2 * np.diff(centres, axis=0), axis=1)
    assert work.sum() > -1e-5 * np.abs(work).sum()


def test_force_is_continuous_along_a_way(held):
    assert (np.bincount(check_way(held, 700, 1))[:2] > 50).all()
    for seed in range(3):
        check_loop(held, seed, 200)


@pytest.mark.slow
def test_a_bonded_tool_holds_its_first_place():
    """It pulled the tube before it had touched."""
    path = ball([75, 1, 0], [78, -2, 0], 5)
    path = Poses(*(jnp.concatenate([v, v[::-1]]) for v in (path.rotation, path.translation)))
    scene = make_scene(
        TUBE, MATERIAL, path, tool=BALL, effects=dataclasses.replace(HELD, contact="bonded")
    )
    whole = jax.jit(simulate)(scene, MATERIAL, path)
    force, _, status, _ = stepped(Session(scene, MATERIAL), path.rotation, path.translation)
    np.testing.assert_allclose(force, whole.force, atol=1e-9)
    np.testing.assert_array_equal(status, whole.status)
    assert force[-1, 1] > 0.01  # drawn


def test_refusals():
    with pytest.raises(ValueError, match="no contact"):
        Session(
            make_scene(TUBE, MATERIAL, DOWN, effects=EffectOptions(want_surface=False)), MATERIAL
        )
    with pytest.raises(ValueError, match="keep"):
        Session(make_scene(TUBE, MATERIAL, DOWN_BALL, tool=BALL, effects=BARE), MATERIAL, keep=0)


def cast(tree, dtype):
    return jax.tree.map(lambda v: jnp.asarray(np.asarray(v, dtype), dtype), tree)


OTHER = dataclasses.replace(
    MATERIAL, **{k: 1.7 * getattr(MATERIAL, k) for k in ("EI_L", "k_M", "k_1", "EI_C", "EA_L")}
)


def same_rows(found, expected, dtype):
    for a, b in zip(found, expected, strict=True):
        for name, v, w in zip(a._fields, a, b, strict=True):
            if w is None:
                assert v is None, name
            else:
                assert (v.shape, v.dtype) == (w.shape, w.dtype), name
                tolerance = 1e3 * np.finfo(dtype).eps
                np.testing.assert_allclose(v, w, rtol=tolerance, atol=tolerance, err_msg=name)


@pytest.mark.slow
def test_another_material_and_tool_compile_nothing(held):
    """The same numbers as a session made with them; then those of before again."""
    dtype, way = held.dtype, cast(ball([75, 1, 0], [76, -2, 1], rows=7), held.dtype)
    other, first, tool = cast((OTHER, MATERIAL, sphere(4.0)), dtype)
    held.reset()
    before = rows(held, way)
    with compilations() as counted:
        held.set_material(other)
        held.reset()
        softer = rows(held, way)
        held.set_tool(tool)
        smaller = rows(held, way)
        held.set_material(first)
        held.set_tool(cast(BALL, dtype))
        again = rows(held, way)
    assert not counted
    assert not np.allclose(softer[-1].force, before[-1].force, rtol=0.1)
    assert smaller[-1].gap > softer[-1].gap + 0.5
    for a, b in zip(again, before, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)
    same_rows(softer, rows(Session(held.scene, other), way), dtype)
    scene = make_scene(cast(TUBE, dtype), other, way, tool=tool, effects=HELD)
    assert scene.near <= held.scene.near
    scene = dataclasses.replace(scene, near=held.scene.near)
    same_rows(smaller, rows(Session(scene, other), way), dtype)


@pytest.mark.slow
@pytest.mark.compiling
def test_force_of_another_material_in_closed_form():
    """Springs in series, without seat and program in common: a press on a beam without rings."""
    bare = dataclasses.replace(SPRINGS, k_M=jnp.asarray(0.0), k_3=jnp.asarray(0.0))
    effects = dataclasses.replace(BARE, contact_point="fixed", want_joints=False)
    session = Session(make_scene(TUBE, bare, DOWN_BALL, tool=BALL, effects=effects), bare)
    for EI, k_1 in ((1.86, 0.3), (700.0, 5.0)):
        session.set_material(dataclasses.replace(bare, EI_L=jnp.asarray(EI), k_1=jnp.asarray(k_1)))
        session.reset()
        for depth in (-1.0, 1.5):
            step = session.step(EYE, [80, OUTER + 5 - depth, 0])
        s, C = float(step.s), 160.0**3 / (192 * EI)
        assert abs(s - 80) < 0.05
        np.testing.assert_allclose(-step.force[1], -float(step.gap) / (C + 1 / k_1), rtol=1e-4)


def test_results_last_and_a_negative_stiffness_is_told(held):
    dtype = held.dtype
    held.reset()
    first = held.step(EYE, [75, OUTER + 4, 0])
    force, status = first.force.copy(), int(first.status)
    held.set_material(cast(dataclasses.replace(MATERIAL, k_1=jnp.asarray(-0.3)), dtype))
    bad = held.step(EYE, [75, OUTER + 4, 0])
    assert bad.status == PressStatus.BAD_MATERIAL
    assert np.isnan(bad.force).all()
    held.set_material(cast(MATERIAL, dtype))
    np.testing.assert_array_equal(first.force, force)
    assert int(first.status) == status == OK
    held.reset()
    np.testing.assert_array_equal(held.step(EYE, [75, OUTER + 4, 0]).force, force)


def test_refusals_of_another_material_and_tool(held):
    dtype, old = held.dtype, (held.material, held.scene)
    m = cast(MATERIAL, dtype)
    other = np.float32 if dtype == np.float64 else np.float64
    for change, says in (
        ({"k_M": jnp.ones(4, dtype)}, "Material.k_M has 4 values; expected"),
        ({"k_M": jnp.ones(15, dtype)}, "k_M has 15 values; the program was compiled for no axis"),
        ({"EA_L": None}, "Material.EA_L is missing; the program was compiled with it"),
        ({"GA_L": jnp.ones((), dtype)}, "Material.GA_L is given; .*without it; .*a new Session"),
        ({"k_1": jnp.ones((), other)}, f"k_1 is {np.dtype(other)}; .*compiled for {dtype}"),
        ({"e_1": jnp.ones((), dtype)}, "Material.e_1: given without Material.e_2"),
    ):
        with pytest.raises(ValueError, match=says):
            held.set_material(dataclasses.replace(m, **change))
    for tool, says in (
        (cast(capsule(2.0, 2.0), dtype), r"tool.vertices has shape \(3, 2\);.*for shape \(3, 1\)"),
        (sphere(2.0, dtype=other), f"tool.vertices is {np.dtype(other)}"),
        (cast(sphere(60.0), dtype), "tool lies along up to .* searches .* largest tool"),
        (cast(sphere(5000.0), dtype), "tool is 1e.04 mm across"),
        (cast(sphere(np.nan), dtype), "tool is nan mm across"),
    ):
        with pytest.raises(ValueError, match=says):
            held.set_tool(tool)
    assert held.material is old[0]
    assert held.scene is old[1]


@pytest.mark.slow
def test_the_surface_under_a_smaller_tool():
    """A dent that is no wider than the program's; a wider one is refused."""
    way = ball([75, 1, 0], [75, -2, 0], rows=5)
    large, small = sphere(8.0), sphere(7.0)
    effects = EffectOptions(contact_point="fixed")
    scenes = [make_scene(TUBE, MATERIAL, way, tool=v, mesh=MESH, effects=effects)
              for v in (large, small)]  # fmt: skip
    session = Session(scenes[0], MATERIAL)
    session.set_tool(small)
    found = rows(session, way)
    alone = dataclasses.replace(scenes[1], near=scenes[0].near)
    same_rows(found, rows(Session(alone, MATERIAL), way), "float64")
    with pytest.raises(ValueError, match="largest tool"):
        Session(scenes[1], MATERIAL).set_tool(sphere(12.0))
