"""`step` is a function: the same as a session, of many environments, backwards, saved, branched."""

import copy
import dataclasses
import pickle
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, BARE, MATERIAL, OUTER, SPRINGS, TUBE, ball
from tool_ways import placed, random_way

import jaxtrachea as jt
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.scene import step as stepping
from jaxtrachea.scene.stage import Tool

pytestmark = [pytest.mark.long, pytest.mark.compiling]


EYE = np.eye(3)
HELD = dataclasses.replace(
    BARE, contact_point="fixed", friction="off", axial="on", second_plane="on", want_joints=False,
    want_ring_ends=False,
)  # fmt: skip
RUBBED = dataclasses.replace(HELD, friction="on")
#: What the tests of states need: friction, whose slip is kept, on rings that compile quickly.
SLIPPING = dataclasses.replace(RUBBED, axial="off")
START = ball([75, 1, 0], [76, -2, 0])


def cast(tree, dtype):
    return jax.tree.map(lambda v: jnp.asarray(np.asarray(v, dtype), dtype), tree)


def made(effects=SLIPPING, dtype="float64", tool=BALL, material=SPRINGS):
    """A scene of a ball, and its material."""
    tube, material, tool, start = cast((TUBE, material, tool, START), dtype)
    scene = jt.make_scene(tube, material, start, tool=Tool(tool, 0.3), effects=effects)
    return scene, material


@pytest.fixture(scope="module")
def rubbed():
    """Scene, material and a session of it, compiled for all tests here."""
    scene, material = made()
    return scene, material, jt.Session(scene, material)


def way_of(count, seed=0, dtype="float64"):
    way = random_way(count, OUTER, seed)
    return jnp.asarray(way.rotation, dtype), jnp.asarray(way.translation, dtype)


def scanned(scene, material):
    """From a state and a way to the end state and all results; to be compiled."""

    @jax.jit
    def run(state, rotation, translation):
        return jax.lax.scan(
            lambda state, pose: jt.step(scene, material, state, *pose),
            state,
            (rotation, translation),
        )

    return run


def stepped(session, rotation, translation):
    """All results of a session, stacked."""
    rows = [
        session.step(R, T) for R, T in zip(*map(np.asarray, (rotation, translation)), strict=True)
    ]
    return jax.tree.map(lambda *v: np.stack([np.asarray(one) for one in v]), *rows)


def same(found, expected, tolerance=0.0):
    def one(a, b):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

    jax.tree.map(one, found, expected)


@pytest.fixture(scope="module")
def scan(rubbed):
    """Compiled for 30 steps at a time."""
    return scanned(*rubbed[:2])


def test_a_scan_is_the_session(rubbed, scan):
    """Here compilers do not optimise; they do in the slow test."""
    scene, material, session = rubbed
    way = [np.split(np.asarray(v), 10) for v in way_of(300)]
    session.reset()
    state = jt.init_state(scene, material)
    for part in zip(*way, strict=True):
        state, found = scan(state, *part)
        same(found, stepped(session, *part), 1e-12)
    same(state, session.state, 1e-12)
    assert scan._cache_size() == 1  # the first state is of the types of those after it


@pytest.mark.slow
def test_a_long_scan_is_the_session():
    """To the bit on some processors; on others the two programs round apart from some step on."""
    scene, material = made(RUBBED, material=MATERIAL)
    way = way_of(5000)
    found = scanned(scene, material)(jt.init_state(scene, material), *way)[1]
    same(found, stepped(jt.Session(scene, material), *way), 1e-11)


@pytest.mark.slow
def test_many_environments(rubbed):
    """Each on a way of its own, with a material of its own, are what they are alone."""
    scene, material, session = rubbed
    count = 12
    ways = [random_way(40, OUTER, seed) for seed in range(count)]
    rotation = jnp.asarray(np.stack([w.rotation[:40] for w in ways], 1))
    translation = jnp.asarray(np.stack([w.translation[:40] for w in ways], 1))
    k_1 = material.k_1 * jnp.linspace(0.5, 2, count)

    def with_stiffness(k):
        return dataclasses.replace(material, k_1=k)

    @jax.jit
    def run(states, rotation, translation):
        def step(states, pose):
            many = jax.vmap(lambda k, *given: jt.step(scene, with_stiffness(k), *given))
            return many(k_1, states, *pose)

        return jax.lax.scan(step, states, (rotation, translation))[1]

    states = jax.vmap(lambda _: jt.init_state(scene, material))(jnp.arange(count))
    found = run(states, rotation, translation)
    for i in range(count):
        session.set_material(with_stiffness(k_1[i]))
        session.reset()
        expected = stepped(session, rotation[:, i], translation[:, i])
        same(jax.tree.map(lambda v, i=i: v[:, i], found), expected, 1e-11)
    session.set_material(material)


def history(depth=2.0, count=200):
    """Touches, sticks, slides along and round the tube, and lifts."""
    corners = np.array([[75, 0.1, -0.4], [75, 0.1, depth], [77.3, 0.13, depth], [76, 0.1, -0.5]])
    share = np.linspace(0, 3, count)
    at = np.minimum(share.astype(int), 2)[:, None]
    return placed(
        corners[at[:, 0]] + (share[:, None] - at) * np.diff(corners, axis=0)[at[:, 0]], OUTER
    )


@pytest.mark.slow
def test_the_gradient_through_a_contact_history():
    """Of what the tool felt over 200 steps, by depth, sideways way, material and friction."""
    scene, material = made(RUBBED, material=MATERIAL)
    base, start = history(), jt.init_state(scene, material)
    turn, weights = jnp.asarray(EYE), jnp.asarray(np.random.default_rng(0).normal(size=(200, 3)))
    pressed = jnp.asarray(np.linspace(0, 1, 200) ** 2)

    @jax.jit
    def felt(v):
        m = dataclasses.replace(material, k_1=material.k_1 * v[2])
        own = dataclasses.replace(scene, friction=scene.friction * v[3])
        places = jnp.asarray(base) + pressed[:, None] * jnp.stack([v[1], -v[0], v[1] / 2])[None]
        _, out = jax.lax.scan(lambda s, p: jt.step(own, m, s, turn, p), start, places)
        return jnp.sum(weights * out.force)

    at = np.array([0.05, 0.03, 1.1, 1.2])
    found, h = jax.grad(felt)(jnp.asarray(at)), 1e-5
    steps = h * np.eye(4)
    known = [
        (8 * (felt(at + d) - felt(at - d)) - (felt(at + 2 * d) - felt(at - 2 * d))) / (12 * h)
        for d in steps
    ]
    np.testing.assert_allclose(found, known, rtol=1e-6, atol=1e-6)


def test_save_restore_branch(rubbed, scan):
    scene, material, session = rubbed
    way = way_of(60, 2)
    first, rest = zip(*(np.split(np.asarray(v), 2) for v in way), strict=True)
    session.reset()
    stepped(session, *first)
    kept = session.state
    expected = stepped(session, *rest)
    stored = pickle.loads(pickle.dumps(kept))
    session.state = stored
    same(stepped(session, *rest), expected)
    session.state = copy.deepcopy(kept)
    branch = copy.deepcopy(session)
    stepped(session, *first)  # the branch does not notice
    same(stepped(branch, *rest), expected)
    assert branch.latency().steps == session.latency().steps
    # What a session has begun, a scan goes on with.
    same(scan(kept, *rest)[1], expected, 1e-12)


def test_a_state_of_another_scene_is_refused(rubbed):
    scene, material, session = rubbed
    session.reset()
    down = np.array([75, OUTER + 4, 0])
    known = session.step(EYE, down).force
    kept = session.state
    origin = kept.origin
    for other, says in (
        (
            made(dataclasses.replace(SLIPPING, friction="off"))[0],
            "another plan: friction is False; expected True",
        ),
        (made(dtype="float32")[0], "state is float32; expected float64"),
        (made(tool=sphere(4.0))[0], "another scene: of the same plan, but with another tube, tool"),
    ):
        state = jt.init_state(other, cast(SPRINGS, other.footprint.dtype))
        with pytest.raises(ValueError, match=says):
            session.state = state
        with pytest.raises(ValueError, match=says):
            jt.step(scene, material, state, jnp.asarray(EYE), jnp.asarray(down))
    older = dataclasses.replace(kept, origin=origin._replace(version=stepping.STATE_VERSION - 1))
    with pytest.raises(ValueError, match="state has version 4; expected 5"):
        session.state = older
    same(session.state, kept)
    np.testing.assert_array_equal(session.step(EYE, down).force, known)
    changed = copy.deepcopy(session)
    changed.set_tool(sphere(4.0))
    with pytest.raises(ValueError, match="another tube, tool"):
        changed.state = kept


def test_the_numbers_of_a_scene_are_read_once(rubbed, monkeypatch):
    known, digest, calls = stepping.digest_of(rubbed[0]), stepping._digest, []
    monkeypatch.setattr(stepping, "_digest", lambda v: calls.append(0) or digest(v))
    scene = dataclasses.replace(rubbed[0])
    assert [stepping.digest_of(scene) for _ in range(3)] == [known] * 3
    assert len(calls) == 1
    number = id(scene)
    del scene
    assert number not in stepping._DIGESTS
    small = dataclasses.replace(rubbed[0], radius=rubbed[0].radius * 0.99)
    assert stepping.digest_of(small) != known


def test_a_bad_pose_is_refused(rubbed):
    scene, material, _ = rubbed
    state, down = jt.init_state(scene, material), jnp.asarray([75, OUTER + 4, 0])
    eye = jnp.asarray(EYE)
    for rotation, translation, says in (
        (eye[:2], down, r"rotation has shape \(2, 3\); expected shape \(3, 3\)"),
        (eye, down[:2], "translation has 2 values; expected 3 values"),
        (eye.astype("float32"), down, "rotation is float32; expected float64, as the scene has"),
        (eye, down.astype("float32"), "translation is float32; expected float64"),
        (2 * eye, down, "no rotation"),
        ("up", down, "rotation is 'up'; expected a number"),
    ):
        with pytest.raises(ValueError, match=says):
            jt.step(scene, material, state, rotation, translation)


def test_eight_threads_on_one_session(rubbed):
    """Whatever order they come in, it is that of one loop."""
    _, _, session = rubbed
    session.reset()
    way, order, program = way_of(800, 4), [], session._program
    rotation, translation = (np.asarray(v) for v in way)

    class Watched:
        """The program, and the order in which its poses came."""

        def __call__(self, *given):
            result = program(*given)
            order.append((given, result.force.copy(), int(result.status)))
            return result

    errors = []

    def work(start):
        try:
            for i in range(start, 800, 8):
                session.step(rotation[i], translation[i])
        except BaseException as error:
            errors.append(error)

    session._program = Watched()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
    finally:
        session._program = program
        sys.setswitchinterval(interval)
    assert not errors
    assert len(order) == session.latency().steps == 800
    session.reset()
    for given, force, status in order:
        again = session.step(*given[:2])
        np.testing.assert_array_equal(again.force, force)
        assert int(again.status) == status
