"""Scenes in time: a path and a session against presses in time, energy, refusals, memory."""

import dataclasses
import functools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maxwell import force_in_time
from small_scenes import BALL, BARE, MATERIAL, OUTER, SPRINGS, TUBE

import jaxtrachea as jt
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.status import PressStatus
from jaxtrachea.tradeoff.operations import count_operations

pytestmark = [pytest.mark.long, pytest.mark.compiling]

TWO = jt.Relaxation(jt.Branches(jnp.array([0.9, 0.5]), jnp.array([0.37, 4.3])))
APART = jt.Relaxation(TWO.local, jt.Branches(jnp.array([0.4]), jnp.array([1.5])))
#: Load, hold, unload until the tool has left, wait, load again.
CORNERS, DEPTHS = np.array([0, 2, 6, 7, 9, 10.0]), np.array([0, 4, 4, 0, 0, 3.0])
STEPS = 20, 20, 10, 5, 10
TIME = np.concatenate(
    [[0.0]]
    + [np.linspace(*CORNERS[i : i + 2], n + 1)[1:] for i, n in enumerate(STEPS)]
)  # fmt: skip
DEEP = np.interp(TIME, CORNERS, DEPTHS)
ROWS = len(TIME)
PLACES = np.stack([np.full(ROWS, 75.0), OUTER + 5.2 - DEEP, 0 * DEEP], 1)
EYES = np.broadcast_to(np.eye(3), (ROWS, 3, 3))
simulate = jax.jit(jt.simulate)


def relaxing(material=SPRINGS, relaxation=TWO):
    return jt.RelaxingMaterial(material, relaxation)


def straight(direction=(0.0, -1.0, 0.0), time=TIME, deep=DEEP):
    rows = len(deep)
    return jt.Presses(
        np.full(rows, 75.0), np.zeros(rows), deep[:, None] * np.asarray(direction), time
    )


def made(material, path=None, **effects):
    """A scene of presses at one place, or of the ball."""
    path = straight() if path is None else path
    tool = BALL if isinstance(path, jt.Poses) else None
    bare = dataclasses.replace(BARE, **effects)
    return jt.make_scene(TUBE, material, path, tool=tool, effects=bare), path


def steps_of(scene, material):
    """From a state, poses and times to the end state and all results; compiled."""

    @jax.jit
    def run(material, state, *way):
        def move(state, given):
            return jt.step(scene, material, state, *given)

        return jax.lax.scan(move, state, way)

    return functools.partial(run, material)


@pytest.fixture(scope="module")
def held():
    """Scene of the ball in one plane, its material, steps, and the way with its times."""
    material = relaxing()
    scene, path = made(material, jt.Poses(EYES, PLACES, TIME), contact_point="fixed")
    way = jnp.asarray(EYES), jnp.asarray(PLACES), jnp.asarray(np.diff(TIME, prepend=0.0))
    return scene, material, steps_of(scene, material), way, path


@pytest.fixture(scope="module")
def started(held):
    scene, material, run, way, _ = held
    start = jt.init_state(scene, material)
    return start, *run(start, *way)


@pytest.mark.parametrize("relaxation", [TWO, APART])
def test_a_path_is_a_press_in_time(relaxation):
    material = dataclasses.replace(SPRINGS, k_5=jnp.array(1e-3))
    scene, path = made(relaxing(material, relaxation))
    found = simulate(scene, relaxing(material, relaxation), path)
    motion = Motion(jnp.asarray(75.0), jnp.asarray(DEEP), time=jnp.asarray(TIME))
    known = jt.press_in_time(TUBE, material, motion, relaxation, scene.plan.options)
    for name in ("force", "depth", "skeleton", "joints"):
        mine = -getattr(found, name)[..., 1]
        np.testing.assert_allclose(mine, getattr(known, name), atol=1e-12, err_msg=name)
    np.testing.assert_allclose(-found.loads[..., 1], known.reactions, atol=1e-12)
    assert np.array_equal(found.status, known.status)
    assert (np.asarray(found.status[42:]) == PressStatus.NO_CONTACT).sum() > 5
    np.testing.assert_array_equal(found.time, TIME)


@pytest.mark.slow
def test_vectors_are_filtered_against_an_ode():
    """Oblique: each component while it presses, all of them where the inward one lets go."""
    corners, deep = CORNERS[:4], np.interp(TIME[:51], CORNERS, DEPTHS)
    time, fine = TIME[:51], np.linspace(0, 7, 281)
    path = straight((0.3, -1.0, 0.2), fine, np.interp(fine, time, deep))
    scene, _ = made(relaxing(MATERIAL), path, axial="off")
    assert scene.plan.second_plane
    found = simulate(scene, relaxing(MATERIAL), path)
    elastic = simulate(*_elastic(scene), path).force
    # The elastic force between rows is a line in both; the inward one tells when the tool leaves.
    force, _ = force_in_time(fine, (fine, -np.asarray(elastic[:, 1])), *TWO.local)
    np.testing.assert_allclose(-found.force[:, 1], force, atol=2e-6)
    left = np.asarray(found.status) == PressStatus.NO_CONTACT
    assert left[-8:].all()
    assert corners[2] < fine[left][1] < corners[3]
    np.testing.assert_array_equal(np.asarray(found.force)[left], 0)
    share = np.asarray(found.force)[~left] / np.asarray(elastic)[~left]
    during = (fine[~left] > 1) & (fine[~left] < 2)
    assert (share[during][:, 1] > 1.2).all()


def _elastic(scene):
    plan = scene.plan.at(relaxation="off")
    plan = dataclasses.replace(plan, ignored=plan.ignored | {"relaxation"})
    return dataclasses.replace(scene, plan=plan), relaxing(MATERIAL)


@pytest.mark.slow
def test_work_is_lost_and_none_is_made():
    """Around a closed way the tool's work is what the dashpots have taken, once all has faded."""
    fast = jt.Relaxation(jt.Branches(jnp.array([0.9, 0.5]), jnp.array([0.1, 0.3])))
    share = np.linspace(0, 1, 401)
    time, deep = np.append(share, 60.0), np.append(3 * np.sin(np.pi * share) ** 2, 0.0)
    path = straight(time=time, deep=deep)
    scene, _ = made(relaxing(relaxation=fast), contact="bonded")
    found = simulate(scene, relaxing(relaxation=fast), path)
    force = -np.asarray(found.force[:, 1])
    work = np.sum((force[1:] + force[:-1]) / 2 * np.diff(deep))
    assert np.all(np.asarray(found.dissipated) >= 0)
    assert work > 0.05
    np.testing.assert_allclose(np.sum(found.dissipated), work, rtol=5e-3)


def test_rows_that_do_not_count():
    """A time that runs back and a lost pose are as if not there; a refused row ends the history."""
    scene, _ = made(relaxing())
    path = straight()
    good = simulate(scene, relaxing(), path)
    time, D = TIME.copy(), np.array(path.displacement)
    time[[5, 30]], D[12] = [0.1, np.nan], np.nan
    found = simulate(scene, relaxing(), dataclasses.replace(path, time=time, displacement=D))
    kept = np.setdiff1d(np.arange(ROWS), [5, 12, 30])
    status = np.asarray(found.status)
    assert (status[[5, 30, 12]] == [*[PressStatus.BACK_IN_TIME] * 2, PressStatus.NON_FINITE]).all()
    assert np.isnan(np.asarray(found.force)[[5, 12, 30]]).all()
    assert np.isnan(np.asarray(found.joints)[[5, 12, 30]]).all()
    shorter = np.asarray(good.force)[6:, 1]
    # Without those rows the elastic force is a line over longer steps: second order.
    np.testing.assert_allclose(np.asarray(found.force)[kept[kept > 5], 1],
                               shorter[kept[kept > 5] - 6], atol=2e-2)  # fmt: skip
    D = np.array(path.displacement)
    D[25] = [0, -2.0, -3.0]  # oblique, and the plan has one plane
    status = np.asarray(
        simulate(scene, relaxing(), dataclasses.replace(path, displacement=D)).status
    )
    assert (status[25:] == PressStatus.OFF_PLAN).all()
    assert (status[:25] == np.asarray(good.status)[:25]).all()


def test_numbers_that_are_none():
    scene, path = made(relaxing())
    for gamma, code in ((-0.1, PressStatus.BAD_MATERIAL), (np.nan, PressStatus.NON_FINITE)):
        bad = jt.Relaxation(jt.Branches(jnp.array([0.9, gamma]), TWO.local.tau))
        found = simulate(scene, relaxing(relaxation=bad), path)
        assert (np.asarray(found.status) == code).all()
        assert np.isnan(np.asarray(found.force[:, 1])).all()


def test_steps_are_the_path(held, started):
    """To rounding while the tool holds its place; after it has left the tube it touches anew."""
    scene, material, _, _, path = held
    found, known = started[2], simulate(scene, material, path)
    first = slice(0, 44)
    np.testing.assert_allclose(found.force[first], known.force[first], atol=1e-12)
    assert found.dissipated is None
    assert np.array_equal(found.status, known.status)
    np.testing.assert_allclose(found.force, known.force, atol=1e-7)  # as without relaxation
    assert float(known.force[-1, 1]) < -0.05  # and it remembers


@pytest.mark.slow
def test_a_session_is_the_scan():
    """To rounding here, as compilers do not optimise; and with the stiffness beside it."""
    material = relaxing(SPRINGS, APART)
    scene, _ = made(material, jt.Poses(EYES, PLACES, TIME), contact_point="fixed")
    way = EYES, PLACES, np.diff(TIME, prepend=0.0)
    start = jt.init_state(scene, material)
    found = steps_of(scene, material)(start, *map(jnp.asarray, way))[1]
    session = jt.Session(scene, material, stiffness=True)
    for i, given in enumerate(zip(*way, strict=True)):
        row = session.step(*given)
        np.testing.assert_allclose(row.force, found.force[i], atol=1e-12)
        assert row.status == found.status[i]
    for dt in ("1 s", np.zeros(2), np.array(True), 1j):
        with pytest.raises(ValueError, match="dt is .* expected one number, s"):
            session.step(*given[:2], dt)
    again = pickle.loads(pickle.dumps(session))
    assert np.array_equal(again.step(*given).force, session.step(*given).force)


def test_a_state_is_saved_and_time_does_not_run_back(held, started):
    _, _, run, way, _ = held
    _, end, _ = started
    read = jax.tree.map(jnp.asarray, pickle.loads(pickle.dumps(jax.tree.map(np.asarray, end))))
    ways = [run(state, *way)[1].force for state in (end, read)]
    assert np.array_equal(*ways, equal_nan=True)
    assert not np.array_equal(ways[0], started[2].force)  # it remembers
    for dt in (-1e-3, np.nan, np.inf):
        after, found = run(end, *way[:2], jnp.full(ROWS, dt))
        assert (np.asarray(found.status) == PressStatus.BACK_IN_TIME).all()
        assert np.isnan(np.asarray(found.force)).all()
        assert all(map(np.array_equal, jax.tree.leaves(after), jax.tree.leaves(end)))


def after_a_wait(held, started):
    """The last force, by way aside and wait: up after a hold, wait, down there or beside."""
    _, _, run, way, _ = held
    up, down = np.array([75.0, OUTER + 8, 0]), np.array([75.0, OUTER + 2.0, 0])

    def last(aside, *waits):
        places, dt = np.tile(down, (ROWS, 1)), np.full(ROWS, 0.5)
        places[0], places[1] = up, down
        rows = [up, *[up] * len(waits), down, down]
        places[-len(rows) :] = np.stack(rows) + np.array([aside, 0, 0])
        dt[-len(rows) :] = 0.01, *waits, 0.01, 0.0
        return float(run(started[0], way[0], jnp.asarray(places), jnp.asarray(dt))[1].force[-1, 1])

    return last


@pytest.mark.slow
def test_another_place_is_at_rest_the_same_is_not(held, started):
    """After a hold the tool goes up, waits, and presses there or two ring spacings aside."""
    last = after_a_wait(held, started)
    fresh, soon, other = last(0, 1e6), last(0, 0.01), last(20.0, 0.01)
    assert soon > 0.8 * fresh  # negative: the wall is not yet back
    assert other < 1.1 * soon


@pytest.mark.slow
def test_a_long_wait_in_the_air_forgets(held, started):
    """Within a step the elastic force is a line, which leaves P = sum(gamma tau) / dt of it.

    The surface then still has P / (1 + P) of the elastic force that it had (B, A of `filter`, with
    E = 0), and a press as deep as before lacks as much at most. In several steps that is a product.
    """
    last, (gamma, tau) = after_a_wait(held, started), TWO.local

    def left(dt):
        P = float(jnp.sum(gamma * tau)) / dt
        return P / (1 + P)

    fresh = last(0, 1e9)
    for waits in ((200.0,), (2000.0,), (100.0, 100.0), (50.0,) * 4):
        lacks = 1 - last(0, *waits) / fresh
        assert -1e-9 < lacks < np.prod([left(dt) for dt in waits])
    assert lacks < 1e-5


@pytest.mark.slow
def test_stiffness_is_the_derivative_of_the_step(held):
    """Against differences; at once the branches make it stiffer by all of them."""
    scene, material, *_ = held
    place = jnp.array([75.0, OUTER + 3.0, 0.0])
    states = [jt.init_state(scene, material)]
    for height, dt in ((6.0, 0.0), (3.0, 0.5)):
        x = place.at[1].set(OUTER + height)
        states.append(jt.step(scene, material, states[-1], jnp.eye(3), x, dt)[0])

    def at(x, dt):
        return jt.step(scene, material, states[-1], jnp.eye(3), x, dt, stiffness=True)[1]

    x, h = place - jnp.array([0.0, 0.3, 0.0]), 1e-5
    K, aside = at(x, 1e-3).stiffness, h * jnp.eye(3)[1]
    difference = (at(x + aside, 1e-3).force - at(x - aside, 1e-3).force) / (2 * h)
    np.testing.assert_allclose(K[:, 1], difference, atol=1e-6)
    ends = at(x, 0.0).stiffness[1, 1], at(x, 1e9).stiffness[1, 1]
    np.testing.assert_allclose(ends[0] / ends[1], 2.4, rtol=1e-6)


ALONG = np.linspace(0, 1, ROWS)[:, None] * [1.0, 0, 0]
WANDERS = jt.Poses(EYES, PLACES + 30 * ALONG, TIME)
ASIDE = straight((0.0, -1.0, 0.3))
#: name -> (material, path, effects, words of the reason, words of the cure)
REFUSED = {
    "no times": (relaxing(), straight(time=None), {}, "no times", "duration"),
    "wanders": (relaxing(), WANDERS, {}, "keep its place", "fixed"),
    "parts aside": (relaxing(MATERIAL, APART), ASIDE, {}, "one plane", "uniform"),
    "parts in total": (
        relaxing(relaxation=APART), straight(), {"coupling": "total"}, "total", "uniform"
    ),
    "no branches": (
        SPRINGS, straight(), {"relaxation": "uniform"}, "does not say", "[relaxation]"
    ),
    "skeleton": (relaxing(), straight(), {"relaxation": "parts"}, "skeleton", "uniform"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_relax_is_refused(name):
    material, path, effects, why, cure = REFUSED[name]
    with pytest.raises(jt.PlanError) as error:
        made(material, path, **effects)
    assert error.value.key == "relaxation"
    assert why in str(error.value)
    assert cure in str(error.value)
    if name in ("no times", "wanders"):
        assert not made(material, path, **effects, relaxation="off")[0].plan.has("relaxation")


def test_friction_is_refused():
    way = jt.Poses(EYES, PLACES + 3 * ALONG, TIME)
    with pytest.raises(jt.PlanError, match="slip depends on the relaxed force"):
        jt.make_scene(TUBE, relaxing(), way, tool=jt.Tool(BALL, 0.3), effects=BARE)


def test_what_does_not_fit_is_refused(held):
    scene, material, _, _, path = held
    state = jt.init_state(scene, material)
    with pytest.raises(ValueError, match="dt is None"):
        jt.step(scene, material, state, np.eye(3), PLACES[0])
    with pytest.raises(ValueError, match="expected RelaxingMaterial"):
        jt.simulate(scene, SPRINGS, path)
    with pytest.raises(ValueError, match="time"):
        jt.simulate(scene, material, jt.Poses(EYES, PLACES))
    elastic, _ = made(SPRINGS, path, contact_point="fixed")
    with pytest.raises(ValueError, match="make the scene with this material"):
        jt.simulate(elastic, material, path)
    with pytest.raises(ValueError, match="expected \\(B,\\) both"):
        jt.RelaxingMaterial(SPRINGS, jt.Relaxation(jt.Branches([1.0, 2.0], [1.0])))


def test_a_plan_shows_it_and_it_costs_operations():
    scene, path = made(relaxing())
    decision = next(e for e in scene.plan.effects if e.name == "relaxation")
    assert decision.level == "uniform"
    assert "10 s" in decision.reason
    less = dataclasses.replace(scene, plan=scene.plan.without("relaxation"))
    counts = [count_operations(jt.simulate, s, relaxing(), path) for s in (scene, less)]
    assert counts[1] == count_operations(jt.simulate, less, SPRINGS, path)
    assert counts[1] < counts[0]
    with pytest.raises(ValueError, match="history"):
        dataclasses.replace(scene.plan, contact_point="per_step")
