"""Several tools with friction in one scene: path and steps, the surface, and what a hand may do."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, MATERIAL, MESH, OUTER, TUBE

from jaxtrachea import (
    EffectOptions,
    PlanError,
    Poses,
    Session,
    Tool,
    init_state,
    make_scene,
    press_contacts_path,
    simulate,
    step,
)
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.status import PressStatus

pytestmark = pytest.mark.compiling
long = pytest.mark.long

OK, NO_CONTACT = PressStatus.OK, PressStatus.NO_CONTACT
MU = {"left": 0.3, "right": 0.2}
TOOLS = {name: Tool(BALL, mu) for name, mu in MU.items()}
BARE = EffectOptions(want_surface=False)


def led(places):
    """A path of the ball's origin."""
    return Poses(np.broadcast_to(np.eye(3), (len(places), 3, 3)), np.asarray(places, float))


def press_and_drag(s, along, round_=0.0, deep=3.0, rows=12):
    """Down from 0.5 mm over the tube and aslant, then along it and round it."""
    t = np.linspace(0, 1, rows)
    down, side = np.clip(2 * t, 0, 1), np.clip(2 * t - 1, 0, 1)
    height = OUTER + 5.5 - (deep + 0.5) * down
    aside = 0.8 * (1 - down)
    return led(np.stack([s + along * side - aside, height, round_ * side + aside / 2], axis=1))


PATHS = {"left": press_and_drag(62.0, 2.0), "right": press_and_drag(95.0, -1.5, 0.8)}


@functools.cache
def scene(mesh=True):
    if mesh:
        return make_scene(TUBE, MATERIAL, PATHS, tool=TOOLS, mesh=MESH)
    return make_scene(TUBE, MATERIAL, PATHS, tool=TOOLS, effects=BARE)


@functools.cache
def program(mesh=True):
    return jax.jit(functools.partial(simulate, scene(mesh)))


@functools.cache
def simulated():
    return jax.device_get(program()(MATERIAL, PATHS))


def row_of(paths, i):
    return {n: (np.asarray(p.rotation)[i], np.asarray(p.translation)[i]) for n, p in paths.items()}


@long
def test_forces_are_those_of_press_contacts_path():
    """From the first touch on; Coulomb's cone; what one drags along moves the other."""
    out = simulated()
    assert (np.asarray(out.status)[2:] == OK).all()
    touch = np.argmax(out.status == OK, axis=0)
    D = np.where(np.arange(12)[:, None, None] < touch[:, None], 0, out.displacement)
    found = press_contacts_path(
        TUBE, MATERIAL, out.s[0], out.phi[0], D, Coulomb(jnp.asarray(list(MU.values())))
    )
    after = slice(touch.max(), None)
    for name in ("force", "depth", "skeleton", "joints", "slip"):
        got, true = (np.asarray(getattr(v, name))[after] for v in (out, found))
        np.testing.assert_allclose(got, true, rtol=0, atol=1e-12, err_msg=name)
    tangential = np.linalg.norm(np.asarray(found.force)[:, :, [0, 2]], axis=2)
    assert np.asarray(found.sliding)[-1].all()
    assert (out.dissipated >= 0).all()
    assert tangential[-1].min() > 0.02
    alone = make_scene(TUBE, MATERIAL, PATHS["left"], tool=TOOLS["left"], effects=BARE)
    one = jax.jit(simulate)(alone, MATERIAL, PATHS["left"])
    assert np.abs(one.force[-1] - out.force[-1, 0]).max() > 1e-4


@long
def test_beside_a_tool_in_the_air_one_is_as_by_itself():
    straight = np.asarray(press_and_drag(95.0, -1.5).translation)[6:]
    away = led(np.concatenate([straight[:1] + [[0, h, 0]] for h in range(14, 8, -1)] + [
        straight + [0, 8, 0]
    ]))  # fmt: skip
    out = program()(MATERIAL, PATHS | {"right": away})
    alone = make_scene(TUBE, MATERIAL, PATHS["left"], tool=TOOLS["left"], mesh=MESH)
    one = jax.jit(simulate)(alone, MATERIAL, PATHS["left"])
    assert (np.asarray(out.status)[:, 1] == NO_CONTACT).all()
    for name in ("force", "depth", "skeleton", "joints", "slip", "dissipated"):
        got, true = np.asarray(getattr(out, name))[:, 0], np.asarray(getattr(one, name))
        np.testing.assert_allclose(got, true, rtol=0, atol=1e-13, err_msg=name)
    np.testing.assert_allclose(out.end_U, one.end_U, rtol=0, atol=1e-13)
    # Off the midline each tool has its line of joints, so that round the tube it is linear twice.
    np.testing.assert_allclose(out.vertices, one.vertices, rtol=0, atol=0.02)


@long
def test_the_surface_touches_both_tools_where_they_have_slid_to():
    """A vertex lies on each ball; none deeper in it than of one tool by itself (0.14 mm) or so."""
    out = simulated()
    for path in PATHS.values():
        off = np.asarray(out.vertices)[-1] - np.asarray(path.translation)[-1]
        gap = np.linalg.norm(off, axis=1) - 5
        assert np.abs(gap).min() < 1e-9
        assert gap.min() > -0.4


@long
def test_a_session_is_the_path_and_functional_steps_are_the_session():
    true, session = simulated(), Session(scene(), MATERIAL)
    state = init_state(scene(), MATERIAL)
    move = jax.jit(functools.partial(step, scene(), MATERIAL))
    for i in range(12):
        found = session.step(row_of(PATHS, i))
        for name in ("force", "slip", "dissipated", "vertices"):
            got, row = getattr(found, name), getattr(true, name)[i]
            np.testing.assert_allclose(got, row, rtol=0, atol=1e-12, err_msg=f"{name} {i}")
        state, same = move(state, row_of(PATHS, i))
        np.testing.assert_array_equal(same.force, found.force)
    # A pose that is no number takes the numbers of all, and nothing of what follows.
    R, T = row_of(PATHS, 11)["left"]
    lost = session.step({"left": (R, T * np.nan)})
    assert lost.status.tolist() == [PressStatus.NON_FINITE] * 2
    assert np.isnan(lost.force).all()
    again = session.step(row_of(PATHS, 11))
    np.testing.assert_allclose(again.force, true.force[-1], rtol=0, atol=1e-12)
    lifted = session.step({}, present={"right": False})
    assert lifted.status.tolist() == [OK, NO_CONTACT]
    assert np.abs(lifted.force[1]).max() == 0


@long
def test_a_tool_that_lands_on_a_dragged_wall_is_not_pulled_along():
    """Along a path and in a session: what touches now has stretched nothing."""
    t = np.linspace(0, 1, 6)[:, None]
    down = [62, OUTER + 5.5, 0] + t * [0, -3.5, 0]
    drag = down[-1] + t * [2, 0, 0]
    wait = np.repeat([[95, OUTER + 5.5, 0]], 12, axis=0)
    paths = {
        "left": led(np.concatenate([down, drag, np.repeat(drag[-1:], 6, axis=0)])),
        "right": led(np.concatenate([wait, wait[:1] + t * [0, -2, 0]])),
    }
    session = Session(scene(False), MATERIAL)
    out = jax.device_get(jax.jit(simulate)(scene(False), MATERIAL, paths))
    dragged = np.abs(out.skeleton[11, 0, 0])
    assert dragged > 0.5
    for i in range(18):
        found = session.step(row_of(paths, i))
        np.testing.assert_allclose(found.force, out.force[i], rtol=0, atol=1e-9)
    assert out.status[-1].tolist() == [OK, OK]
    assert np.abs(out.force[-1, 1, 0]) < 2e-3 * np.abs(out.force[-1, 1, 1])


@long
def test_a_tool_that_is_only_reached_by_a_raised_wall_sticks_to_it():
    """Clear of the wall at rest, beyond a stiff ligament's lobe; led along, to and fro."""
    stiff = dataclasses.replace(MATERIAL, EI_L=30 * MATERIAL.EI_L)
    t, reach = np.linspace(0, 1, 12), OUTER + 5.03
    down, go = np.clip(2 * t, 0, 1), np.clip(2 * t - 1, 0, 1)
    aside = 0.05 * np.sin(1.5 * np.pi * go)
    round_, phi, high = 0 * t, 0.1 + 0.001 * go, reach + 0.002 * go
    paths = {
        "left": led(np.stack([75 + round_, OUTER + 5.5 - 4.5 * down, round_], axis=1)),
        "right": led(np.stack([35 + aside, high * np.cos(phi), high * np.sin(phi)], axis=1)),
    }
    out = jax.device_get(program(False)(stiff, paths))
    own = make_scene(TUBE, stiff, paths, tool=TOOLS, effects=BARE).plan
    assert own == scene(False).plan  # the plan of a path serves it
    assert out.gap[:, 1].min() > 0.005
    assert np.abs(out.force[-1, 1, 0]) > 0.1 * np.abs(out.force[-1, 1, 1])
    assert np.ptp(out.force[6:, 1, 0]) > 1e-3
    session = Session(scene(False), stiff)
    for i in range(12):
        found = session.step(row_of(paths, i))
        assert found.status.tolist() == out.status[i].tolist()
        np.testing.assert_allclose(found.force, out.force[i], rtol=0, atol=2e-6)
        np.testing.assert_allclose(found.slip, out.slip[i], rtol=0, atol=2e-4)
    gone = session.step({"left": (np.eye(3), np.array([75, OUTER + 9.0, 0]))})
    assert gone.status.tolist() == [NO_CONTACT, NO_CONTACT]


@long
def test_closed_loops_lose_what_is_told():
    """Two hands that rub round and back: the work is what friction took, to the steps' share."""
    rows = 121
    t = np.linspace(0, 2 * np.pi, rows)
    down = led(np.linspace([70, OUTER + 5.2, 0], [70, OUTER + 2.6, 0], 6))
    loops = {
        "left": np.stack([70 + 1.5 * np.sin(t), OUTER + 2.6 + 0 * t, 0.8 * np.sin(t)], axis=1),
        "right": np.stack([92 - 1.2 * np.sin(t), OUTER + 3.0 + 0.3 * np.sin(t), 0 * t], axis=1),
    }
    session = Session(scene(False), MATERIAL)
    for p in np.asarray(down.translation):
        session.step({"left": (np.eye(3), p), "right": (np.eye(3), p + [22, 0.4, 0])})
    forces, lost = [], []
    for twice in range(2):  # the second loop begins where it ends
        for i in range(1, rows):
            found = session.step({n: (np.eye(3), way[i]) for n, way in loops.items()})
            assert found.status.tolist() == [OK, OK]
            if twice:
                forces.append(found.force)
                lost.append(found.dissipated)
    forces, ways = np.array(forces), np.stack([np.diff(v, axis=0) for v in loops.values()], axis=1)
    # The tool's work on the tube; forces at the ends of steps.
    mean = (forces + np.roll(forces, 1, axis=0)) / 2
    work, told = np.sum(mean * ways), np.sum(lost)
    assert told > 0.1
    assert abs(work - told) < 0.02 * told


@functools.cache
def slopes():
    """A sum of forces by EI_L, EA_L and k_1, its derivatives, and what was simulated."""
    weights, bare = np.random.default_rng(0).normal(size=(12, 2, 3)), scene(False)

    def value(x, paths):
        material = dataclasses.replace(MATERIAL, EI_L=x[0], EA_L=x[1], k_1=x[2])
        out = simulate(bare, material, paths)
        return jnp.sum(jnp.where(jnp.isnan(out.force), 0, out.force) * weights), out

    return jax.jit(jax.value_and_grad(value, has_aux=True))


VALUES = np.array([1.86, 3.9, 0.3])


def one_lands_later():
    """The right one comes down on a wall that the left one has pressed and dragged."""
    t = np.linspace(0, 1, 4)[:, None]
    down = [62, OUTER + 5.5, 0] + t * [0, -3.5, 0]
    drag = down[-1] + t * [2, 0, 0]
    wait = np.repeat([[77, OUTER + 5.5, 0]], 8, axis=0)
    left = np.concatenate([down, drag, np.repeat(drag[-1:], 4, axis=0)])
    return {"left": led(left), "right": led(np.concatenate([wait, wait[:4] + t * [0, -3, 0]]))}


@long
@pytest.mark.parametrize("paths", [PATHS, one_lands_later()], ids=["side by side", "later"])
def test_gradients_of_a_path_are_those_of_differences(paths):
    by = slopes()(VALUES, paths)[1]
    for i, h in enumerate(np.eye(3) * 1e-6):
        (high, _), (low, _) = (slopes()(VALUES + sign * h, paths)[0] for sign in (1, -1))
        slope = (high - low) / 2e-6
        assert abs(by[i] - slope) < 1e-6 * max(1, abs(slope))


@long
def test_a_row_that_is_refused_has_no_numbers_and_no_derivatives():
    lost = np.array(PATHS["left"].translation)
    lost[7] = np.nan
    (_, out), by = slopes()(VALUES, PATHS | {"left": led(lost)})
    assert (np.asarray(out.status)[7] == PressStatus.NON_FINITE).all()
    assert np.isnan(out.force[7]).all()
    assert np.isfinite(by).all()
    assert (np.asarray(out.status)[8:] == OK).all()


@pytest.mark.parametrize(
    ("facts", "levels"),
    [
        ({"slip": 1.0, "along": 0.5, "friction": True, "drags": True,
          "known": frozenset({"EA_L"})}, ("on", "on", "coupled")),
        ({"angle": 1.0, "slip": 0.0, "friction": True}, ("on", "off", "coupled")),
        ({"along": 0.1, "friction": True, "known": frozenset({"EA_L"})}, ("on", "on", "coupled")),
        ({"friction": True}, ("off", "off", "coupled")),
    ],
)  # fmt: skip
def test_plans_with_friction(facts, levels):
    plan = make_plan(SceneFacts(tools=2, mesh=False, **facts), EffectOptions(want_surface=False))
    assert (plan.has("friction"), plan.has("axial"), plan.tools) == (
        levels[0] == "on", levels[1] == "on", levels[2]
    )  # fmt: skip


def test_every_tool_needs_a_coefficient():
    """What one tool is given is not left out for another that has none."""
    tools = TOOLS | {"right": Tool(sphere(5.0))}
    with pytest.raises(PlanError, match="tool 'right' has none; give each tool its friction"):
        make_scene(TUBE, MATERIAL, PATHS, tool=tools, effects=BARE)
    with pytest.raises(PlanError, match="not every tool has a coefficient"):
        make_scene(TUBE, MATERIAL, PATHS, tool=tools,
                   effects=EffectOptions(want_surface=False, friction="on"))  # fmt: skip


def test_what_is_glued_has_no_friction():
    """Neither its own, nor beside tools that have some."""
    with pytest.raises(ValueError, match="friction is 0.3, and contact is 'bonded'"):
        Tool(BALL, 0.3, "bonded")
    tools = TOOLS | {"right": Tool(BALL, contact="bonded")}
    with pytest.raises(PlanError, match="tool 'right' is glued, and friction beside"):
        make_scene(TUBE, MATERIAL, PATHS, tool=tools, effects=BARE)


@pytest.mark.parametrize("glued", [{"glued": True}, {"tools": 1}])
def test_what_is_glued_does_not_wander(glued):
    """With a press of its own in every row it would hold the wall through the air."""
    contact = "unilateral" if "glued" in glued else "bonded"
    effects = EffectOptions(want_surface=False, contact=contact, contact_point="per_step")
    with pytest.raises(PlanError, match="what is glued stays where it touched"):
        make_plan(SceneFacts(**({"tools": 2, "mesh": False, "poses": True} | glued)), effects)


def test_a_plan_says_that_some_are_glued():
    plan = make_plan(SceneFacts(tools=2, mesh=False, glued=True), BARE)
    (law,) = [e for e in plan.effects if e.name == "contact law"]
    assert (law.level, law.reason) == ("mixed", "some tools are glued")
