"""Several contacts that relax: against active sets enumerated in numpy, one contact, and scenes."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, BARE, OUTER, SPRINGS, TUBE

import jaxtrachea as jt
from jaxtrachea.mechanics.contacts_in_time import each_at_rest, solve_in_time
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press import Contact
from jaxtrachea.mechanics.press_history import Samples, at_rest, respond_in_time
from jaxtrachea.status import PressStatus

GAMMA, TAU = np.array([0.9, 0.5]), np.array([0.37, 4.3])
BRANCHES = jt.Branches(jnp.array(GAMMA), jnp.array(TAU))
RELAXATION = jt.Relaxation(BRANCHES)
K1, K3 = np.array([0.3, 0.5, 0.25]), np.array([0.02, 0.01, 0.03])
#: Neighbours on one ligament.
C = np.array([[3.0, 2.1, 1.2], [2.1, 3.2, 1.9], [1.2, 1.9, 2.8]])
#: Load, hold; the middle one is lifted by its neighbours, leaves, and comes again.
TIME = np.concatenate([np.linspace(0, 2, 16), np.linspace(2.4, 8, 15), np.linspace(8.1, 12, 17)])
CORNERS = [0, 2, 5, 6, 8, 9, 12]
WAYS = np.stack([
    np.interp(TIME, CORNERS, [-0.5, 4, 4, 4, 1, -1, 3]),
    np.interp(TIME, CORNERS, [-0.2, 1.5, 1.5, 3, -2, -2, 3.5]),
    np.interp(TIME, CORNERS, [-0.1, 3, 3, 0.5, 2.5, 2.5, 0]),
], axis=1)  # fmt: skip


def at_rest_of(m):
    history = each_at_rest(at_rest(RELAXATION, Options(relaxation="uniform"), False), m)
    none = jnp.zeros(len(TIME), jnp.int8)
    dt = jnp.diff(jnp.array(TIME), prepend=TIME[0])
    return Samples(history, RELAXATION, dt, none, none.astype(bool))


def law_of(m):
    return Law(k_1=jnp.array(K1[:m]), k_3=jnp.array(K3[:m]))


def solved(ways, m, width=0.0, **how):
    width = None if width is None else jnp.asarray(width)
    return solve_in_time(ways, jnp.array(C[:m, :m]), law_of(m), at_rest_of(m), width=width, **how)


def law(d, j):
    return K1[j] * d + K3[j] * d**3


def depth_of(e, j):
    """The inverse law, by Cardano (k_3 > 0)."""
    p, q = K1[j] / K3[j], -e / K3[j]
    root = np.sqrt(q * q / 4 + p**3 / 27)
    return np.cbrt(-q / 2 + root) + np.cbrt(-q / 2 - root)


def enumerated(ways):
    """Forces, elastic forces: of every sample the one set of contacts that fits.

    A contact that has let go has no force, and the others press a wall that it still holds down.
    """
    m, h, e, out = ways.shape[1], np.zeros((2, ways.shape[1])), np.zeros(ways.shape[1]), []
    for dt, D in zip(np.diff(TIME, prepend=TIME[0]), ways, strict=True):
        x = dt / TAU[:, None]
        E = np.exp(-x)
        P = GAMMA[:, None] * (np.ones_like(x) if dt == 0 else (1 - E) / x)
        A, B = 1 + P.sum(0), (E * h - P * e).sum(0)
        free, fits = -B / A, []
        for on in itertools.product([False, True], repeat=m):
            on = np.array(on)
            new = np.where(on, np.maximum(e, 0.1), free)
            for _ in range(100):  # Newton on d_j(e_j) + (C e)_j = D_j of those that press
                d = np.array([depth_of(new[j], j) for j in range(m)])
                slope = np.diag(1 / (K1 + 3 * K3 * d * d))
                miss = d + C[:m, :m] @ new - D
                if not on.any():
                    break
                new[on] -= np.linalg.solve((slope + C[:m, :m])[np.ix_(on, on)], miss[on])
            d = np.array([depth_of(new[j], j) for j in range(m)])
            gap = d + C[:m, :m] @ new - D
            if (new[on] > free[on] + 1e-14).all() and (gap[~on] >= 0).all():
                fits.append((new, on))
        assert len(fits) == 1
        (new, on), old = fits[0], e
        h, e = E * h + P * (new - old), new
        out.append((np.where(on, A * new + B, 0), new))
    return map(np.array, zip(*out, strict=True))


@pytest.mark.long
def test_every_sample_has_the_active_set_that_fits():
    found = jax.jit(lambda ways: solved(ways, 3))(jnp.array(WAYS))
    force, elastic = enumerated(WAYS)
    np.testing.assert_allclose(found.force, force, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.elastic, elastic, rtol=0, atol=1e-11)
    gone = force == 0
    assert gone.any(0).all()  # each has let go somewhere
    assert (gone & (elastic > 1e-3)).any()  # on a wall that is not at rest
    np.testing.assert_array_equal(found.force == 0, gone)
    assert set(np.unique(found.status)) == {0, PressStatus.NO_CONTACT, PressStatus.LIFTED}
    for j in range(3):
        np.testing.assert_allclose(found.depth[:, j], depth_of(elastic[:, j], j), atol=1e-10)


@pytest.mark.long
def test_float32_in_lanes():
    """Of records that are scaled: each lane as by itself, to the digits of its dtype."""
    given = jnp.array(C), law_of(3), at_rest_of(3), jnp.asarray(1e-3)
    ways = jnp.stack([jnp.array(WAYS), 0.5 * jnp.array(WAYS)])

    @jax.jit
    def lanes(ways, given):
        C, law, samples, width = given
        return jax.vmap(lambda D: solve_in_time(D, C, law, samples, width=width).force)(ways)

    true = lanes(ways, given)
    as_float32 = jax.tree.map(
        lambda v: v.astype("float32") if v.dtype == "float64" else v, (ways, given)
    )
    found = lanes(*as_float32)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, true, rtol=0, atol=2e-5)
    alone = lanes(ways[1:], given)
    np.testing.assert_allclose(alone[0], true[1], rtol=0, atol=1e-13)


@pytest.mark.long
@pytest.mark.parametrize("contact", ["unilateral", "bonded"])
def test_one_contact_is_a_press_that_relaxes(contact):
    """Outside of the rounding of the first touch; glued, it pulls."""
    options = Options(relaxation="uniform", contact=contact, onset_width=0.0)
    one = jax.tree.map(lambda v: v[0], law_of(1))
    D = jnp.array(WAYS[:, 0])
    history = at_rest(RELAXATION, options, False)
    samples = at_rest_of(1)._replace(history=history)
    contact_of = Contact(one, jnp.zeros(()))

    @jax.jit
    def both(D):
        alone = respond_in_time(D, jnp.asarray(C[0, 0]), contact_of, options, samples)
        return alone, solved(D[:, None], 1, 0.0 if contact == "unilateral" else None)

    alone, found = both(D)
    for a, b in zip(
        (found.force, found.depth, found.elastic), (alone.solved.force, alone.solved.depth,
        alone.solved.load), strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(a[:, 0], b, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.status[:, 0], alone.solved.status)


@pytest.mark.slow
def test_derivatives_through_the_history():
    weights = np.random.default_rng(0).normal(size=WAYS.shape)

    def value(x):
        relaxation = jt.Relaxation(jt.Branches(x[:2], x[2:4]))
        samples = at_rest_of(3)._replace(relaxation=relaxation)
        law = law_of(3)._replace(k_1=x[4] * jnp.array(K1))
        ways, width = x[5] * jnp.array(WAYS), jnp.asarray(0.05)
        found = solve_in_time(ways, x[6] * jnp.array(C), law, samples, width=width)
        return jnp.sum(weights * (found.force + found.depth))

    x = jnp.concatenate([jnp.array(GAMMA), jnp.array(TAU), jnp.ones(3)])
    value, slope = jax.jit(value), jax.jit(jax.grad(value))(x)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(value))(x), slope, rtol=1e-10)
    for i, step in enumerate(1e-6 * np.eye(7)):
        difference = (value(x + step) - value(x - step)) / 2e-6
        np.testing.assert_allclose(slope[i], difference, rtol=1e-5, atol=1e-6)


def timed(path, to):
    """The path of presses at the times of `TIME`, as deep as a column of `WAYS`."""
    D = jnp.array(WAYS[:, to, None] * np.array([0.0, -1.0, 0.0]))
    at = jnp.full(len(TIME), path)
    return jt.Presses(at, jnp.zeros(len(TIME)), D, jnp.array(TIME))


@pytest.mark.long
@pytest.mark.parametrize("level", ["coupled", "apart"])
def test_a_scene_of_tools_relaxes(level):
    """Apart they are scenes of one tool; coupled they are the contacts of `solve_in_time`."""
    material = jt.RelaxingMaterial(SPRINGS, RELAXATION)
    paths = {"left": timed(70.0, 0), "middle": timed(75.0, 1), "right": timed(79.0, 2)}
    effects = dataclasses.replace(BARE, tools=level, want_joints=True)
    scene = jt.make_scene(TUBE, material, paths, effects=effects)
    assert scene.plan.options.relaxation == "uniform"
    out = jax.jit(jt.simulate)(scene, material, paths)
    if level == "coupled":
        one = jt.press_contacts(TUBE, SPRINGS, [70.0, 75.0, 79.0], jnp.zeros(3))
        laws = Law(k_1=jnp.full(3, SPRINGS.k_1), k_3=jnp.full(3, SPRINGS.k_3))
        width = jnp.asarray(1e-3)
        found = solve_in_time(jnp.array(WAYS), one.compliance, laws, at_rest_of(3), width=width)
        np.testing.assert_allclose(-out.force[:, :, 1], found.force, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(out.status, found.status)
        way = found.elastic @ one.compliance
        np.testing.assert_allclose(-out.skeleton[:, :, 1], way, rtol=0, atol=1e-12)
        return
    for j, path in enumerate(paths.values()):
        alone = jt.make_scene(
            TUBE, material, path, effects=dataclasses.replace(effects, tools="auto")
        )
        true = jax.jit(jt.simulate)(alone, material, path)
        # Within the onset's rounding the forces of both differ.
        np.testing.assert_allclose(out.force[:, j], true.force, rtol=0, atol=5e-5)
        np.testing.assert_allclose(out.depth[:, j], true.depth, rtol=0, atol=1e-3)
        np.testing.assert_array_equal(out.status[:, j], true.status)


@pytest.mark.slow
def test_a_session_of_tools_relaxes_as_a_path_does():
    """And a scan is the session; a tool that is taken away leaves a wall that recovers."""
    material = jt.RelaxingMaterial(SPRINGS, RELAXATION)
    rows, names = len(TIME), ("left", "right")
    turns = jnp.broadcast_to(jnp.eye(3), (rows, 3, 3))

    def way(s, to):
        return jnp.stack([np.full(rows, s), OUTER + 5.0 - WAYS[:, to], np.zeros(rows)], axis=1)

    paths = {
        name: jt.Poses(turns, way(70.0 + 10.5 * k, 2 * k), jnp.array(TIME))
        for k, name in enumerate(names)
    }
    scene = jt.make_scene(TUBE, material, paths, tool=dict.fromkeys(paths, BALL), effects=BARE)
    true = jax.device_get(jax.jit(jt.simulate)(scene, material, paths))
    session, steps = jt.Session(scene, material), np.diff(TIME, prepend=TIME[0])

    def poses(row):
        return {name: (p.rotation[row], p.translation[row]) for name, p in paths.items()}

    found = [session.step(poses(row), dt=dt) for row, dt in enumerate(steps)]
    force = np.array([one.force for one in found])
    # A session takes a new place where a tool comes again, some 0.01 mm beside the first.
    first = TIME < 9.3
    np.testing.assert_allclose(force[first], true.force[first], rtol=0, atol=1e-12)
    np.testing.assert_allclose(force, true.force, rtol=0, atol=1e-4)
    np.testing.assert_array_equal([one.status for one in found], true.status)
    assert (true.status == PressStatus.NO_CONTACT).any(0).all()
    with pytest.raises(ValueError, match="dt is None"):
        session.step({})
    kept = session.state

    @jax.jit
    def scan(state):

        def move(state, row):
            return jt.step(scene, material, state, row[0], dt=row[1])

        ways = {name: (p.rotation, p.translation) for name, p in paths.items()}
        return jax.lax.scan(move, state, (ways, steps))

    state, out = scan(jt.init_state(scene, material))
    np.testing.assert_array_equal(out.force, force)
    jax.tree.map(np.testing.assert_array_equal, state, kept)
    back = session.step({"left": poses(0)["left"]}, dt=np.float64(-1))
    assert (back.status == PressStatus.BACK_IN_TIME).all()
    jax.tree.map(np.testing.assert_array_equal, session.state, kept)
    lifted = session.step({}, present={"left": False}, dt=np.float64(0))
    assert lifted.force[0, 1] == 0
    assert -lifted.skeleton[0, 1] > 0.1  # the wall has not come back yet
    late = session.step({}, dt=np.float64(1e3))
    assert abs(late.skeleton[0, 1]) < abs(lifted.skeleton[0, 1])


@pytest.mark.long
def test_a_tool_is_dragged_over_a_wall_that_relaxes():
    """Along and round; after a long rest both forces are the elastic ones of where they stand."""
    material, off = jt.RelaxingMaterial(SPRINGS, RELAXATION), OUTER + 5.0
    turns, times = jnp.stack([jnp.eye(3)] * 2), jnp.array([0.0, 1.0])
    paths = {
        name: jt.Poses(turns, jnp.array([[s, off + 5, 0.0]] * 2), times)
        for name, s in (("left", 70.0), ("right", 97.0))
    }
    effects = dataclasses.replace(BARE, second_plane="on", contact_point="fixed")
    scene = jt.make_scene(TUBE, material, paths, tool=dict.fromkeys(paths, BALL), effects=effects)
    session = jt.Session(scene, material)

    def step(s, phi, depth, dt):
        place = np.array([s, (off - depth) * np.cos(phi), (off - depth) * np.sin(phi)])
        ways = {"left": place, "right": np.array([97.0, off - 1.5, 0])}
        return session.step({n: (np.eye(3), way) for n, way in ways.items()}, dt=np.float64(dt))

    rows = [step(70, 0, d, 0.05) for d in np.linspace(0, 2, 20)]
    rows += [step(s, 0, 2, 0.05) for s in np.linspace(70, 83, 60)]
    rows += [step(83, phi, 2, 0.05) for phi in np.linspace(0, 0.8, 60)]
    rows.append(step(83, 0.8, 2, 1e9))
    assert {int(v) for row in rows for v in row.status} <= {PressStatus.OK, PressStatus.NO_CONTACT}
    D = np.array([[2, 1.5]])
    true = jt.press_contacts_oblique(TUBE, SPRINGS, [83.0, 97.0], [0.8, 0.0], D, scene.plan.oblique)
    size = [np.linalg.norm(v, axis=-1) for v in (rows[-1].force, true.force[0])]
    # The place follows at a distance of a twentieth of the depth.
    np.testing.assert_allclose(*size, rtol=0.02)
    assert np.linalg.norm(rows[-2].force[0]) > 1.05 * size[0][0]
