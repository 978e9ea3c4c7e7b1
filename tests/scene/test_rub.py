"""Friction in a session: the return map of `press_path`, on a place that may follow the hand."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from small_scenes import BALL, BARE, MATERIAL, MESH, OUTER, TUBE, ball, bend, on_arc
from tool_ways import closed_loop, placed, random_way, turn

from jaxtrachea import Poses, PressStatus, Session, make_scene, simulate
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.facts import SceneFacts
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.stage import Tool

pytestmark = [pytest.mark.long, pytest.mark.compiling]


EYE, MU = np.eye(3), 0.66
RUBBED = dataclasses.replace(
    BARE, contact_point="fixed", friction="on", axial="on", second_plane="on", want_joints=False,
    want_ring_ends=False,
)  # fmt: skip
START = ball([75, 1, 0], [76, -2, 0])


@pytest.fixture(scope="module")
def session():
    """Of the ball with the paper's friction, compiled for all tests here."""
    return Session(make_scene(TUBE, MATERIAL, START, tool=Tool(BALL, MU), effects=RUBBED), MATERIAL)


def line(*corners, step=0.05):
    """Centres of the ball whose lowest point goes from corner to corner (s, phi, depth)."""
    rows = [np.asarray(corners[0], float)[None]]
    for a, b in zip(corners, corners[1:], strict=False):
        a, b = np.asarray(a, float), np.asarray(b, float)
        count = int(np.ceil(np.linalg.norm((b - a) * [1, OUTER, 1]) / step))
        rows.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return placed(np.concatenate(rows), OUTER)


def led(session, centres, rotation=None):
    """All steps of a way, afresh, stacked."""
    session.reset()
    turns = np.broadcast_to(EYE, (len(centres), 3, 3)) if rotation is None else rotation
    rows = [session.step(*pose) for pose in zip(turns, centres, strict=True)]
    return jax.tree.map(lambda *v: np.stack([np.array(one) for one in v]), *rows)


def split(found):
    """Normal force (positive: pressing) and size of the tangential one."""
    inward = np.stack([0 * found.phi, -np.cos(found.phi), -np.sin(found.phi)], axis=1)
    normal = np.sum(found.force * inward, axis=1)
    return normal, np.linalg.norm(found.force - normal[:, None] * inward, axis=1)


def work(found, centres):
    """What the hand does in every step, by the trapezoidal rule, N mm."""
    mean = (found.force[1:] + found.force[:-1]) / 2
    return np.sum(mean * np.diff(centres, axis=0), axis=1)


TRIP = ([75, 0, -0.5], [75, 0, 2], [78, 0, 2], [74.5, 0, 2], [75, 0.1, 1.5], [75, 0, 2.5])


def test_it_is_the_simulation_of_the_same_path(session):
    centres = line(*TRIP)
    path = Poses(np.broadcast_to(EYE, (len(centres), 3, 3)), centres)
    whole = jax.jit(simulate)(session.scene, MATERIAL, path)
    found = led(session, centres)
    touched = int(np.argmax(np.asarray(whole.gap) < 0))
    assert np.linalg.norm(whole.slip[-1]) > 0.3
    for name, value in found._asdict().items():
        expected = getattr(whole, name)
        assert (value is None) == (expected is None), name
        if value is not None:
            np.testing.assert_allclose(
                value[touched:], expected[touched:], atol=1e-9, rtol=0, err_msg=name
            )


@pytest.mark.slow
def test_it_is_the_simulation_on_a_bent_mesh():
    """With the surface, whose dent goes with the slip."""
    s, up, aside = [72, 73, 74, 74.5, 75, 74], [3, 1, -1, -3, -4, -2], [0, 0, 0, 0, 0.2, 0]
    places = np.stack([s, up, aside], axis=1)
    centre, frame = on_arc(places[:, 0], 200.0)
    up = places[:, 1:] + [OUTER + 5, 0]
    path = Poses(np.broadcast_to(EYE, (6, 3, 3)),
                 centre + np.einsum("rij,rj->ri", frame[:, :, 1:], up))  # fmt: skip
    effects = dataclasses.replace(RUBBED, want_surface=True, want_joints=True)
    scene = make_scene(
        TUBE, MATERIAL, path, tool=Tool(BALL, 0.2), mesh=bend(MESH, 200.0), effects=effects
    )
    whole = jax.jit(simulate)(scene, MATERIAL, path)
    found = led(Session(scene, MATERIAL), np.asarray(path.translation))
    touched = int(np.argmax(np.asarray(whole.gap) < 0))
    assert np.linalg.norm(whole.slip[-1]) > 0.05
    for name in ("force", "slip", "dissipated", "vertices", "joints", "status"):
        expected = np.asarray(getattr(whole, name))[touched:]
        np.testing.assert_allclose(getattr(found, name)[touched:], expected, atol=1e-9, rtol=0)


def test_it_sticks_and_slides(session):
    """To and fro: exactly no slip below the cone, exactly mu on it, nothing between."""
    found = led(session, line([75, 0, -0.5], [75, 0, 2], [77, 0, 2], [75, 0, 2], [75, 0, -0.5]))
    normal, tangential = split(found)
    moved = np.linalg.norm(np.diff(found.slip, axis=0), axis=1)
    on = (found.gap[1:] < 0) & (found.gap[:-1] < 0)
    sliding = on & (found.dissipated[1:] > 0)
    sticking = on & ~sliding
    assert min(sliding.sum(), sticking.sum()) > 20
    assert (moved[1:][sticking[1:] & sticking[:-1]] == 0).all()
    # Where it stops, the sum of two numbers is rounded once in one result and twice in the other.
    assert (moved[sticking] < 1e-15).all()
    np.testing.assert_allclose(tangential[1:][sliding], MU * normal[1:][sliding], rtol=1e-12)
    assert (tangential[1:][sticking] <= MU * normal[1:][sticking] * (1 + 1e-12)).all()
    assert (found.force[found.gap >= 0] == 0).all()


def test_a_hand_that_wanders(session):
    """30 mm along and back: the place follows, nothing jumps, nothing is refused."""
    centres = line([75, 0, -0.5], [75, 0, 2], [105, 0, 2], [75, 0, 2], [75, 0, -0.5])
    found = led(session, centres)
    normal, tangential = split(found)
    touching = found.gap < 0
    assert (found.status[touching] == PressStatus.OK).all()
    assert (tangential <= MU * normal * (1 + 1e-12) + 1e-15).all()
    assert np.abs(found.s - centres[:, 0])[touching].max() < 5.1  # half a ring spacing
    assert np.linalg.norm(np.diff(found.force, axis=0), axis=1).max() < 0.02
    assert 25 < found.slip[:, 0].max() < 30
    lost = found.dissipated.sum()
    assert lost > 2
    np.testing.assert_allclose(work(found, centres).sum(), lost, rtol=2e-3)


def small_loop(seed, steps, aside=0.03):
    """A closed way near one place, along the tube and round it; `aside` 0: on the midline."""
    rng, share = np.random.default_rng(seed), np.linspace(0, 2 * np.pi, steps + 1)
    phi = 0.5 if aside else 0.0
    first = np.array([rng.uniform(60, 100), rng.uniform(-phi, phi), 0.0])
    wave = [np.sin(k * share + a) - np.sin(a) for k, a in enumerate(rng.uniform(0, 6, 3), 1)]
    way = first + (rng.normal(size=(3, 3)) @ np.array(wave)).T * [0.8, aside, 0]
    way[:, 2] = -0.3 + rng.uniform(1, 3) * np.sin(share / 2) ** 2
    return placed(way, OUTER)


def check_loops(session, ways, bound):
    """All work of the hand is `dissipated`, but for the first power of the step.

    A place that follows a tool which sticks may take up energy, and one that is pressed deeper.
    """
    for centres in ways:
        found = led(session, centres)
        assert found.gap[0] > 0 > found.gap.min()
        done, lost = work(found, centres), found.dissipated
        size = np.abs(done).sum()
        assert done.sum() > 0
        assert abs(done.sum() - lost.sum()) < bound * size
        assert lost[lost < 0].sum() > -1e-3 * size


@pytest.mark.parametrize("aside", [0, 0.03])
def test_closed_loops_only_lose_what_is_told(session, aside):
    check_loops(session, (small_loop(seed, 400, aside) for seed in range(5)), 5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("aside", [0, 0.03])
def test_many_closed_loops_lose_nothing_else(session, aside):
    check_loops(session, (small_loop(seed, 2000, aside) for seed in range(40)), 2e-3)


@pytest.mark.slow
def test_wide_closed_loops(session):
    """Round the tube and over several rings."""
    check_loops(session, (closed_loop(seed, 1000, OUTER) for seed in range(40)), 5e-3)


def test_no_pull_and_no_more_than_the_cone_along_a_random_way(session):
    way = random_way(1500, OUTER, 3)
    found = led(session, way.translation, way.rotation)
    good = np.isfinite(way.translation).all(axis=1)
    touching = good & (np.nan_to_num(found.gap, nan=1.0) < 0)
    assert (found.status[touching] == PressStatus.OK).all()
    normal, tangential = split(found)
    assert (normal[touching] > 0).all()
    assert (tangential[touching] <= MU * normal[touching] * (1 + 1e-12)).all()


@pytest.mark.parametrize("before", [[[75 - 8.0, 60.0, 0.0]], [[75 - 40.0, 300.0, 50.0]]])
def test_a_teleport_is_no_path(session, before):
    """From far: as if it had been let down straight; nothing rubs, though the line is slanted."""
    there = placed([[75.0, 0.0, 2.0]], OUTER)
    found = led(session, np.concatenate([np.asarray(before, float), there]))
    known = led(session, there)
    np.testing.assert_allclose(found.force[-1], known.force[-1], atol=1e-12)
    assert found.dissipated[-1] == 0
    assert found.slip[-1].tolist() == [0, 0, 0]


def test_a_jump_along_the_tube_touches_anew(session):
    centres = np.concatenate(
        [line([75, 0, -0.5], [75, 0, 2], [77, 0, 2]), placed([[97, 0, 2.0]], OUTER)]
    )
    found = led(session, centres)
    known = led(session, centres[-1:])
    np.testing.assert_allclose(found.force[-1], known.force[-1], atol=1e-12)
    assert found.dissipated[-1] == 0


def test_a_tool_that_turns_on_the_spot(session):
    """Its body point goes round and round: it rubs, and stays a contact."""
    start = line([75, 0, -0.5], [75, 0, 2])
    angle = np.linspace(0, 12, 400)
    turns = np.array([turn(np.array([0.0, 0, a])) for a in angle])
    centres = np.concatenate([start, np.repeat(start[-1:], 400, 0)])
    rotation = np.concatenate([np.broadcast_to(EYE, (len(start), 3, 3)), turns])
    found = led(session, centres, rotation)
    normal, tangential = split(found)
    assert (found.status[found.gap < 0] == PressStatus.OK).all()
    np.testing.assert_allclose(tangential[-50:], MU * normal[-50:], rtol=1e-9)


def test_a_bad_pose_costs_itself_only(session):
    centres = line([75, 0.2, -0.2], [75, 0.2, 1.5], [76, 0.2, 1.5], step=0.1)
    known = led(session, centres)
    session.reset()
    for i, place in enumerate(centres):
        if i % 5 == 3:
            assert np.isnan(session.step(EYE, place * np.nan).slip).all()
        np.testing.assert_array_equal(session.step(EYE, place).force, known.force[i])


@pytest.mark.parametrize("mu", [0.0, 0.05])
def test_what_presses_straight_in_off_the_midline_keeps_to_the_cone(mu):
    """The skeleton moves along the surface under it: held there it would carry more."""
    down = placed(np.array([[75, 0.6, 0.0], [75, 0.6, 1], [75, 0.6, 2]]), OUTER)
    path = Poses(np.broadcast_to(EYE, (3, 3, 3)), down)
    scene = make_scene(TUBE, MATERIAL, path, tool=Tool(BALL, mu),
                       effects=EffectOptions(want_surface=False))  # fmt: skip
    out = jax.jit(simulate)(scene, MATERIAL, path)
    normal, tangential = split(out)
    np.testing.assert_allclose(tangential[1:], mu * normal[1:], rtol=1e-9, atol=1e-12)
    assert (normal[1:] > 0.01).all()
    held = dataclasses.replace(scene.plan, friction=False, ignored=frozenset({"friction"}))
    out = jax.jit(simulate)(dataclasses.replace(scene, plan=held), MATERIAL, path)
    normal, tangential = split(out)
    assert (tangential[1:] > 0.1 * normal[1:]).all()


@pytest.mark.slow
def test_off_is_frictionless():
    """A ball led 30 mm along and back: it was held, and lost 8.33 N mm."""
    effects = dataclasses.replace(RUBBED, contact_point="auto", friction="off")
    scene = make_scene(TUBE, MATERIAL, START, tool=Tool(BALL, MU), effects=effects)
    assert scene.plan.contact_point == "per_step"
    centres = line([75, 0, -0.5], [75, 0, 2], [105, 0, 2], [75, 0, 2], [75, 0, -0.5])
    found = led(Session(scene, MATERIAL), centres)
    inward = np.array([0, -1.0, 0])
    assert (found.status[found.gap < 0] == PressStatus.OK).all()
    along = np.diff(centres, axis=0)
    along -= (along @ inward)[:, None] * inward
    mean = (found.force[1:] + found.force[:-1]) / 2
    assert abs(np.sum(mean * along)) < 1e-6
    assert abs(work(found, centres).sum()) < 1e-6


def test_the_plan_says_what_a_hand_wants():
    for options, friction, level, says in (
        ({}, False, "fixed", "a hand that goes on wants tool.friction, or 'per_step'"),
        ({}, True, "fixed", "less than half a ring spacing$"),
        ({"friction": "off"}, True, "per_step", "friction is off as you wish"),
        ({"friction": "off", "contact": "bonded"}, True, "fixed", "half a ring"),
    ):
        facts = SceneFacts(poses=True, slip=1.0, friction=friction)
        plan = make_plan(facts, EffectOptions(**options))
        assert plan.level("contact_point") == level
        (decision,) = (e for e in plan.effects if e.name == "contact_point")
        assert re.search(says, decision.reason)
